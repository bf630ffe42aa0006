//! Flow policies as a scenario states them: what they are, their keys, how they are read and checked. What they
//! compute is in `coordination::flow`.

use super::fault::{Check, inside, number, require};
use super::keys::{self, Keys, other};
use super::load::error::ScenarioError;
use super::load::table::Table;
use super::network::{Exit, Network, Zone};
use super::params::VehicleParams;
use super::ranges;
use serde::{Deserialize, Serialize};

/// Baseline speed v_b of a feedback policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Baseline {
    /// A given speed, m/s.
    Given(f64),
    /// The mean, over these entry speeds in m/s, of the terminal speed that minimises the cost.
    Optimal(Vec<f64>),
}

/// Which part of the downstream zone a policy observes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Observed {
    /// The whole zone: N.
    Whole,
    /// Its first metres: N(l).
    First(f64),
}

/// How a coordinator sets the terminal speed v_m (paper: `equ:feedback_control`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum FlowPolicy {
    /// No flow control: the terminal speed is free.
    None,
    /// v_m is constant.
    Fixed {
        /// Terminal speed, m/s.
        terminal_mps: f64,
    },
    /// v_m = v_b - k N, with N counted in the downstream zone or its first metres.
    Feedback {
        /// Baseline speed v_b.
        baseline: Baseline,
        /// Gain k, m/s per vehicle.
        gain_mps: f64,
        /// Where vehicles are counted.
        segment: Observed,
        /// v_m is not set lower, m/s.
        min_mps: f64,
    },
    /// v_m = mean speed in the first l metres downstream + offset - k N(l); free while it is empty.
    MeanSpeed {
        /// Offset on the mean speed, m/s.
        offset_mps: f64,
        /// Gain k, m/s per vehicle.
        gain_mps: f64,
        /// Length l, m.
        segment_m: f64,
        /// v_m is not set lower, m/s.
        min_mps: f64,
    },
    /// v_m minimises the objective that is foretold (paper: Problem 2).
    Predicted {
        /// v_m is not set lower, m/s.
        min_mps: f64,
    },
}

/// The keys of `flow`.
pub(in crate::scenario) static KEYS: Keys = &[
    &other(
        "policy",
        "`none`, `fixed`, `feedback`, `mean_speed`, `predicted`",
        "required",
        "how the terminal speed v_m is set",
    ),
    &other("terminal_mps", "a speed from 0.01 m/s to `v_max_mps`", "required with `fixed`", "v_m"),
    &other(
        "baseline_mps",
        "a speed, or `\"optimal\"`",
        "required with `feedback`",
        "v_m = baseline − gain · N; `optimal`: the mean optimal terminal speed over `baseline_entry_speeds_mps`",
    ),
    &other("baseline_entry_speeds_mps", "list of speeds", "10, 11, …, 20", "see `baseline_mps`"),
    &other(
        "gain_mps",
        "0 to 1000 m/s per vehicle",
        "required with `feedback` and `mean_speed`",
        "of the number N of vehicles in the segment",
    ),
    &other(
        "segment_m",
        "a length in m",
        "the whole zone; required with `mean_speed`",
        "the first metres of the zone downstream, in which vehicles are counted",
    ),
    &other("min_mps", "a speed", "5", "v_m is not set lower, nor above `v_max_mps`"),
    &other(
        "offset_mps",
        "-1000 to 1000 m/s",
        "required with `mean_speed`",
        "v_m = mean speed in the segment + offset − gain · N; free while it is empty",
    ),
];

/// What a zone's policy can observe: the lengths of the paths of the zone downstream, if there is one.
pub(in crate::scenario) struct Downstream<'a> {
    pub(in crate::scenario) zone: &'a str,
    pub(in crate::scenario) longest_m: f64,
}

/// `zones.*.flow`, or no flow control.
pub(in crate::scenario) fn flow(
    zone: &Table<'_>,
    downstream: Option<&Downstream<'_>>,
    vehicle: &VehicleParams,
) -> Result<FlowPolicy, ScenarioError> {
    #[derive(Clone, Copy, PartialEq)]
    enum Kind {
        None,
        Fixed,
        Feedback,
        MeanSpeed,
        Predicted,
    }
    let Some(field) = zone.get("flow") else { return Ok(FlowPolicy::None) };
    const POLICY: &str = "a table such as {policy = \"fixed\", terminal_mps = 15}";
    let mut t = field.table(POLICY)?;
    let all = keys::names(KEYS);
    // Without a policy the other keys cannot be judged; a misspelt "policy" is still found here.
    t.only(&all)?;
    let policy = t.need("policy", "\"none\", \"fixed\", \"feedback\", \"mean_speed\" or \"predicted\"")?;
    let kind = policy.choice(&[
        ("none", Kind::None),
        ("fixed", Kind::Fixed),
        ("feedback", Kind::Feedback),
        ("mean_speed", Kind::MeanSpeed),
        ("predicted", Kind::Predicted),
    ])?;
    let known: &[&str] = match kind {
        Kind::None => &["policy"],
        Kind::Fixed => &["policy", "terminal_mps"],
        Kind::Feedback => {
            &["policy", "baseline_mps", "baseline_entry_speeds_mps", "gain_mps", "segment_m", "min_mps"]
        }
        Kind::Predicted => &["policy", "min_mps"],
        Kind::MeanSpeed => &["policy", "offset_mps", "gain_mps", "segment_m", "min_mps"],
    };
    t.only_or_stale(known, if policy.is_set() { &all[..] } else { &[] })?;
    t.blame(&policy);

    let v_max = vehicle.v_max_mps;
    let (is_speed, speed) = flow_speed(v_max);
    if kind == Kind::None {
        return Ok(FlowPolicy::None);
    }
    if kind == Kind::Fixed {
        return Ok(FlowPolicy::Fixed { terminal_mps: t.f64("terminal_mps", is_speed, &speed)? });
    }
    let Some(downstream) = downstream else {
        let problem = "the zone's exit leads out of the network, there is nothing to observe".to_owned();
        return Err(policy.bad_because(Some(problem), "\"none\" or \"fixed\""));
    };
    if kind == Kind::Predicted {
        return Ok(FlowPolicy::Predicted { min_mps: t.f64_or("min_mps", 5.0, is_speed, &speed)? });
    }
    let longest = downstream.longest_m;
    let segment_ok = |l| l > 0.0 && l <= longest;
    let segment = format!(
        "a length with 0 < l <= {longest} m, the longest path of the zone downstream, {}",
        downstream.zone
    );
    let gain_mps = t.within("gain_mps", &ranges::FLOW_GAIN)?;
    let min_mps = t.f64_or("min_mps", 5.0, is_speed, &speed)?;
    if kind == Kind::MeanSpeed {
        return Ok(FlowPolicy::MeanSpeed {
            offset_mps: t.within("offset_mps", &ranges::FLOW_OFFSET)?,
            gain_mps,
            segment_m: t.f64("segment_m", segment_ok, &segment)?,
            min_mps,
        });
    }
    let segment = match t.get("segment_m") {
        None => Observed::Whole,
        Some(field) => Observed::First(field.f64(segment_ok, &segment)?),
    };
    Ok(FlowPolicy::Feedback { baseline: baseline(&t, v_max)?, gain_mps, segment, min_mps })
}

/// Whether a speed is one that vehicles may be told to leave at, and what is expected.
fn flow_speed(v_max: f64) -> (impl Fn(f64) -> bool + Copy, String) {
    let expected = format!("{} and <= v_max_mps = {v_max}", ranges::FLOW_SPEED);
    (move |v| ranges::FLOW_SPEED.contains(v) && v <= v_max, expected)
}

/// `baseline_mps`: a speed, or "optimal" with the entry speeds to take the mean over.
fn baseline(t: &Table<'_>, v_max: f64) -> Result<Baseline, ScenarioError> {
    let (is_speed, speed) = flow_speed(v_max);
    let expected = format!("{speed}, or \"optimal\"");
    let field = t.need("baseline_mps", &expected)?;
    let samples = t.get("baseline_entry_speeds_mps");
    if field.str("").is_ok_and(|word| word == "optimal") {
        let list = format!("a list of speeds, each {speed}");
        let speeds: Vec<f64> = match samples {
            Some(samples) => {
                let items = samples.items(&list)?;
                items.iter().map(|item| item.f64(is_speed, &speed)).collect::<Result<_, _>>()?
            }
            None => (10..=20).map(f64::from).filter(|&v| v <= v_max).collect(),
        };
        if speeds.is_empty() {
            return Err(t.missing("baseline_entry_speeds_mps", &format!("{list} (the defaults exceed it)")));
        }
        return Ok(Baseline::Optimal(speeds));
    }
    let given = field.f64(is_speed, &expected)?;
    match samples {
        // Left over from the file's "optimal" when a --set gives the speed.
        Some(samples) if samples.is_set() || !field.is_set() => {
            Err(samples.bad_because(Some(format!("baseline_mps is {given}")), "it only with \"optimal\""))
        }
        _ => Ok(Baseline::Given(given)),
    }
}

/// Checks a policy that came as bytes as the loader does.
pub(super) fn check(exit: &Exit, network: &Network, v_max_mps: f64) -> Check {
    let speed = |what, value| number(what, value, |v| ranges::FLOW_SPEED.contains(v) && v <= v_max_mps);
    let downstream = exit.to.map(|to| &network.zones[to.zone as usize]);
    let observes = |l: f64| {
        let longest_m = downstream.map_or(0.0, Zone::longest_m);
        number("segment_m", l, |l| l > 0.0 && l <= longest_m)
    };
    let has_downstream =
        || require(downstream.is_some(), || format!("exit {}: nothing to observe", exit.name));
    match &exit.flow {
        FlowPolicy::None => Ok(()),
        FlowPolicy::Fixed { terminal_mps } => speed("terminal_mps", *terminal_mps),
        FlowPolicy::Feedback { baseline, gain_mps, segment, min_mps } => {
            has_downstream()?;
            match baseline {
                Baseline::Given(baseline) => speed("baseline_mps", *baseline)?,
                Baseline::Optimal(speeds) => {
                    require(!speeds.is_empty(), || "no baseline_entry_speeds_mps".to_owned())?;
                    speeds.iter().try_for_each(|v| speed("baseline_entry_speeds_mps", *v))?;
                }
            }
            inside("gain_mps", *gain_mps, &ranges::FLOW_GAIN)?;
            speed("min_mps", *min_mps)?;
            match segment {
                Observed::Whole => Ok(()),
                Observed::First(l) => observes(*l),
            }
        }
        FlowPolicy::Predicted { min_mps } => {
            has_downstream()?;
            speed("min_mps", *min_mps)
        }
        FlowPolicy::MeanSpeed { offset_mps, gain_mps, segment_m, min_mps } => {
            has_downstream()?;
            inside("offset_mps", *offset_mps, &ranges::FLOW_OFFSET)?;
            inside("gain_mps", *gain_mps, &ranges::FLOW_GAIN)?;
            speed("min_mps", *min_mps)?;
            observes(*segment_m)
        }
    }
}
