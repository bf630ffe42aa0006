//! Which runs a sweep is made of, and which of them there are.

use crate::outcome::Outcome;
use control_zones::compare::cache::Cache;
use control_zones::compare::policy::{self, Member, Policy};
use control_zones::compare::{CompareError, load, measured_exit_mps};
use control_zones::scenario::{DEFAULT_SCENARIO, Scenario, scenario_hash};
use std::collections::BTreeMap;
use std::sync::Arc;

/// What is swept.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Policies by name, as `cz compare` has them.
    pub policies: Vec<String>,
    /// Scenarios, embedded ones or files; the default one when none is named.
    pub scenarios: Vec<String>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// `--set`s of all policies, before their own.
    pub sets: Vec<String>,
}

/// A run that is wanted.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// The scenario as it was named.
    pub scenario: String,
    /// The policy.
    pub policy: String,
    /// Which member of it.
    pub member: usize,
    /// Seed.
    pub seed: u64,
    /// `--set`s, those of all policies included.
    pub sets: Vec<String>,
    /// What is run.
    pub what: Arc<Scenario>,
    /// Its hash, under which the outcome is kept.
    pub hash: u64,
}

impl Wanted {
    /// For messages.
    pub fn name(&self) -> String {
        format!("policy {}, scenario {}, seed {}", self.policy, self.scenario, self.seed)
    }

    /// The file that keeps its outcome.
    pub fn file(&self, cache: &Cache) -> String {
        cache.file("outcome", self.hash)
    }

    /// Its outcome, if it is kept.
    pub fn outcome(&self, cache: &Cache) -> Option<Outcome> {
        cache.find(&self.file(cache))
    }
}

/// All runs of a sweep, as far as they are known.
#[derive(Clone, Debug)]
pub struct Planned {
    /// In the order of the table.
    pub runs: Vec<Wanted>,
    /// Whether these are all: some can be known only once others have been done.
    pub all: bool,
}

impl Planned {
    /// Those that are not kept, each once.
    pub fn missing<'a>(&'a self, cache: &Cache) -> Vec<&'a Wanted> {
        let mut seen = std::collections::BTreeSet::new();
        let fresh = self.runs.iter().filter(|run| seen.insert(run.hash));
        fresh.filter(|run| run.outcome(cache).is_none()).collect()
    }
}

impl Sweep {
    /// The runs, as far as what is kept lets them be known: flow control that is made of the exit speeds measured without
    /// it has these runs done first.
    ///
    /// # Errors
    /// When a policy or a scenario is no good.
    pub fn plan(&self, cache: &Cache) -> Result<Planned, CompareError> {
        let default = [DEFAULT_SCENARIO.to_owned()];
        let scenarios = if self.scenarios.is_empty() { &default[..] } else { &self.scenarios };
        let mut planned = Planned { runs: Vec::new(), all: true };
        for scenario in scenarios {
            let base = self.load(scenario, "none", self.seeds[0], &[])?.0;
            let policies = self.policies.iter().map(|name| policy::find(name, &base.network));
            let policies: Vec<Policy> = policies.collect::<Result<_, _>>()?;
            let mut exit_mps = Some(0.0);
            if policies.iter().flat_map(|policy| &policy.members).any(|member| !member.measured.is_empty()) {
                let before = self.of_member(scenario, "paper-none", 0, &policy::without_control(), 0.0)?;
                let exits: Option<Vec<f64>> =
                    before.iter().map(|run| run.outcome(cache).map(|outcome| outcome.exit_mps)).collect();
                exit_mps = exits.map(|exits| measured_exit_mps(&exits));
                if exit_mps.is_none() {
                    planned.runs.extend(before);
                    planned.all = false;
                }
            }
            for policy in &policies {
                for (at, member) in policy.members.iter().enumerate() {
                    match exit_mps.or(member.measured.is_empty().then_some(0.0)) {
                        Some(exit_mps) => {
                            planned.runs.extend(self.of_member(
                                scenario,
                                &policy.name,
                                at,
                                member,
                                exit_mps,
                            )?);
                        }
                        None => planned.all = false,
                    }
                }
            }
        }
        Ok(planned)
    }

    /// A run per seed.
    fn of_member(
        &self,
        scenario: &str,
        policy: &str,
        at: usize,
        member: &Member,
        exit_mps: f64,
    ) -> Result<Vec<Wanted>, CompareError> {
        let own = member.sets(exit_mps);
        let wanted = |&seed: &u64| {
            let (what, sets) = self.load(scenario, policy, seed, &own)?;
            if !what.plugins.is_empty() {
                let message = "controllers that are processes of their own are no part of a sweep; cz compare runs them";
                return Err(CompareError::Policy { name: policy.to_owned(), message: message.to_owned() });
            }
            let hash = scenario_hash(&what);
            let (scenario, policy) = (scenario.to_owned(), policy.to_owned());
            Ok(Wanted { scenario, policy, member: at, seed, sets, what, hash })
        };
        self.seeds.iter().map(wanted).collect()
    }

    fn load(
        &self,
        scenario: &str,
        policy: &str,
        seed: u64,
        own: &[String],
    ) -> Result<(Arc<Scenario>, Vec<String>), CompareError> {
        let sets: Vec<String> = self.sets.iter().chain(own).cloned().collect();
        let loaded = load(Some(scenario), seed, &sets);
        let name = policy.to_owned();
        let loaded = loaded.map_err(|source| CompareError::Scenario { name, source: Box::new(source) })?;
        Ok((loaded, sets))
    }
}

/// What is kept of runs that are done, and why others failed, by scenario hash.
#[derive(Debug, Default)]
pub struct Done {
    /// Outcomes.
    pub outcomes: BTreeMap<u64, Outcome>,
    /// What was said of the last attempt.
    pub failures: BTreeMap<u64, String>,
}
