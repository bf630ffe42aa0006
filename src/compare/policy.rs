//! What is compared: fragments of a scenario, by name.
//!
//! A fragment is a list of `--set`s, in a file or in the program. The paper's policies depend on the network (its
//! flow control has one terminal speed inside and one at the end), so they are made for it.

use super::CompareError;
use crate::reproduce::experiment::sweep_speeds;
use crate::reproduce::paper::SECOND_TERMINAL_MPS;
use crate::scenario::{self, Network, Zone};
use serde::Deserialize;
use std::path::Path;

/// Fragments that are part of the program.
const EMBEDDED: [(&str, &str); 5] = [
    ("paper-none", include_str!("policies/paper-none.toml")),
    ("viable", include_str!("policies/viable.toml")),
    ("viable-resequenced", include_str!("policies/viable-resequenced.toml")),
    ("viable-gate", include_str!("policies/viable-gate.toml")),
    ("viable-resequenced-gate", include_str!("policies/viable-resequenced-gate.toml")),
];

/// A policy's file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Fragment {
    /// What it is, in a line.
    about: String,
    /// The policy it changes.
    from: Option<String>,
    /// `--set`s in order.
    #[serde(default)]
    set: Vec<String>,
    /// Controllers of one's own, TARGET=COMMAND as for `cz run --controller`.
    #[serde(default)]
    controllers: Vec<String>,
}

/// A policy as it is compared.
#[derive(Clone, Debug, PartialEq)]
pub struct Policy {
    /// As it was named.
    pub name: String,
    /// What it is, in a line.
    pub about: String,
    /// The best of these per replicate; one unless it is a group.
    pub members: Vec<Member>,
}

/// One way to drive.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Member {
    /// `--set`s in order.
    pub sets: Vec<String>,
    /// Zones whose terminal speed is the mean exit speed without flow control, as the paper has it for its last
    /// one.
    pub measured: Vec<String>,
}

impl Member {
    /// The same with the terminal speed that the paper prints for its last zone.
    fn printed(mut self) -> Member {
        let printed = |zone| format!("zones.{zone}.flow={}", fixed(SECOND_TERMINAL_MPS));
        self.sets.extend(std::mem::take(&mut self.measured).into_iter().map(printed));
        self
    }

    /// All `--set`s, once that speed is known.
    pub fn sets(&self, exit_mps: f64) -> Vec<String> {
        let flow = |zone: &String| format!("zones.{zone}.flow={}", fixed(exit_mps));
        self.measured.iter().map(flow).chain(self.sets.iter().cloned()).collect()
    }
}

/// What is known by name, for messages and help.
pub fn known() -> String {
    let embedded: Vec<&str> = EMBEDDED.iter().map(|(name, _)| *name).collect();
    format!(
        "{}, paper-fixed-SPEED, paper-feedback, paper-mean-speed, paper-predicted, paper-best, or the path of a TOML file; \
         NAME:KEY=VALUE;KEY=VALUE changes keys of one",
        embedded.join(", ")
    )
}

/// The policy without flow control, from which the paper's terminal speed of the last zone is measured.
pub fn without_control() -> Member {
    Member {
        sets: law().chain(["zones.*.flow={ policy = \"none\" }".to_owned()]).collect(),
        measured: Vec::new(),
    }
}

/// The policy of that name on a network.
pub fn find(name: &str, network: &Network) -> Result<Policy, CompareError> {
    resolve(name, network, 0)
}

/// Fragments on fragments, as deep as anybody needs.
const MOST_DEEP: usize = 8;

fn resolve(name: &str, network: &Network, depth: usize) -> Result<Policy, CompareError> {
    let bad = |message: String| CompareError::Policy { name: name.to_owned(), message };
    let (base, changes) = name.split_once(':').map_or((name, None), |(base, changes)| (base, Some(changes)));
    let mut policy = match paper(base, network).map_err(bad)? {
        Some(policy) => policy,
        None => {
            let text = match EMBEDDED.iter().find(|(known, _)| *known == base) {
                Some((_, text)) => (*text).to_owned(),
                None if base.ends_with(".toml") || Path::new(base).is_file() => std::fs::read_to_string(base)
                    .map_err(|error| bad(format!("cannot read the policy: {error}")))?,
                None => return Err(bad(format!("no such policy; expected {}", known()))),
            };
            let fragment: Fragment =
                toml::from_str(&text).map_err(|error| bad(error.message().replace('\n', " ")))?;
            let members = match &fragment.from {
                Some(_) if depth == MOST_DEEP => {
                    return Err(bad("policies that begin with each other".into()));
                }
                Some(from) => resolve(from, network, depth + 1)?.members,
                None => vec![Member { sets: Vec::new(), measured: Vec::new() }],
            };
            let declared = scenario::declaration(&fragment.controllers).map_err(bad)?;
            let members = members.into_iter().map(|mut member| {
                member.sets.extend(fragment.set.iter().cloned().chain(declared.clone()));
                member
            });
            Policy { name: name.to_owned(), about: fragment.about.clone(), members: members.collect() }
        }
    };
    if let Some(changes) = changes {
        let changes: Vec<&str> = changes.split(';').map(str::trim).filter(|c| !c.is_empty()).collect();
        for member in &mut policy.members {
            member.sets.extend(changes.iter().map(|c| (*c).to_owned()));
        }
        policy.about = format!("{}, with {}", policy.about, changes.join(", "));
    }
    policy.name = name.to_owned();
    Ok(policy)
}

/// One of the paper's, if it is one.
fn paper(name: &str, network: &Network) -> Result<Option<Policy>, String> {
    const FEEDBACK: &str = "{ policy = \"feedback\", baseline_mps = 18.0, gain_mps = 0.5, segment_m = 50.0 }";
    const MEAN_SPEED: &str =
        "{ policy = \"mean_speed\", offset_mps = 2.0, gain_mps = 0.5, segment_m = 50.0 }";
    let one = |about: &str, flow: &str| Policy {
        name: name.to_owned(),
        about: about.to_owned(),
        members: vec![with_flow(network, flow)],
    };
    let has_inner = network.zones.iter().any(is_inner);
    let refused = || format!("{name}: no zone of this network leads to another with all its exits");
    Ok(match name {
        "paper-feedback" if has_inner => Some(one("v_m = 18 - N(50 m)/2", FEEDBACK)),
        "paper-mean-speed" if has_inner => Some(one("v_m = mean speed + 2 - N(50 m)/2", MEAN_SPEED)),
        "paper-predicted" if has_inner => Some(one("v_m chosen by prediction", "{ policy = \"predicted\" }")),
        "paper-feedback" | "paper-mean-speed" | "paper-predicted" => return Err(refused()),
        "paper-best" => {
            let mut members = vec![without_control()];
            if has_inner {
                let mut flows: Vec<String> = sweep_speeds().into_iter().map(fixed).collect();
                flows.extend([FEEDBACK, MEAN_SPEED].map(str::to_owned));
                members.extend(flows.iter().map(|flow| with_flow(network, flow)));
                members.extend(flows.iter().map(|flow| with_flow(network, flow).printed()));
            }
            let about = "per replicate the cheapest of no flow control, every fixed v_m1 and both feedbacks, with v_m2 by \
                         the paper's rule or as printed";
            Some(Policy { name: name.to_owned(), about: about.to_owned(), members })
        }
        _ => match name.strip_prefix("paper-fixed-") {
            None => None,
            Some(_) if !has_inner => return Err(refused()),
            Some(speed) => {
                let speed: f64 = speed.parse().map_err(|_| format!("{speed}: expected a speed in m/s"))?;
                Some(one("v_m1 given", &fixed(speed)))
            }
        },
    })
}

/// Whether flow control of a zone can look at another one downstream.
fn is_inner(zone: &Zone) -> bool {
    zone.exits.iter().all(|exit| exit.to.is_some())
}

/// The paper's flow control: `flow` in zones that lead to others, the measured exit speed in the rest.
fn with_flow(network: &Network, flow: &str) -> Member {
    let (inner, outer): (Vec<&Zone>, Vec<&Zone>) = network.zones.iter().partition(|zone| is_inner(zone));
    Member {
        sets: law().chain(inner.iter().map(|zone| format!("zones.{}.flow={flow}", zone.name))).collect(),
        measured: outer.iter().map(|zone| zone.name.clone()).collect(),
    }
}

/// What all policies of the paper have in common, whatever the scenario has.
fn law() -> impl Iterator<Item = String> {
    ["control.law=ocbf", "coordination.schedule=none", "gate.entry=free", "zones.*.order=fifo"]
        .into_iter()
        .map(str::to_owned)
}

fn fixed(speed_mps: f64) -> String {
    format!("{{ policy = \"fixed\", terminal_mps = {speed_mps:?} }}")
}
