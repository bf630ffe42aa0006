//! Several runs of one scenario side by side, each with a seed of its own.

use crate::run::{FEATURES, Run, RunError};
use control_zones::scenario::{Override, Scenario, ScenarioError, ZoneId, load};
use std::sync::Arc;

/// Why there is no environment, or none any more.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// The scenario cannot be loaded.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// A zone is named that there is not.
    #[error("zones: there is no zone {name} in {scenario}, expected one of {known}")]
    Zone {
        /// What was named.
        name: String,
        /// The scenario.
        scenario: String,
        /// The zones there are.
        known: String,
    },
    /// A run failed.
    #[error("environment {index}: {error}")]
    Run {
        /// Which.
        index: usize,
        /// Why.
        error: RunError,
    },
    /// It has not been reset yet.
    #[error("environment {index} is to be reset before it is used")]
    NotReset {
        /// Which.
        index: usize,
    },
    /// There are not so many.
    #[error("there is no environment {index}, expected less than {count}")]
    NoSuch {
        /// Which.
        index: usize,
        /// How many there are.
        count: usize,
    },
}

/// Runs of one scenario.
#[derive(Debug)]
pub struct Envs {
    argument: Option<String>,
    overrides: Vec<Override>,
    /// The scenario with its own seed.
    scenario: Scenario,
    zones: Arc<[ZoneId]>,
    capacity: usize,
    runs: Vec<Option<Run>>,
}

/// How a run stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// It goes on.
    No,
    /// Everybody has arrived and left.
    Served,
    /// Its time is up.
    OutOfTime,
}

impl Envs {
    /// `count` runs, to be reset, of the scenario that a command line would name by `argument`, changed as by `--set`;
    /// driven from outside in these zones, or in all if none is named, as far as `capacity` vehicles in each.
    ///
    /// # Errors
    /// When the scenario cannot be loaded or has no such zone.
    pub fn new(
        argument: Option<String>,
        sets: &[&str],
        zones: &[&str],
        capacity: usize,
        count: usize,
    ) -> Result<Envs, EnvError> {
        let overrides = sets.iter().map(|set| set.parse()).collect::<Result<Vec<Override>, _>>()?;
        let scenario = load(argument.as_deref(), &overrides, None)?;
        let known = &scenario.network.zones;
        let found = |name: &&str| {
            known.iter().position(|zone| zone.name == *name).map(|at| at as ZoneId).ok_or_else(|| {
                EnvError::Zone {
                    name: (*name).to_owned(),
                    scenario: scenario.name.clone(),
                    known: known.iter().map(|zone| &*zone.name).collect::<Vec<_>>().join(", "),
                }
            })
        };
        let zones: Arc<[ZoneId]> = match zones {
            [] => (0..known.len() as ZoneId).collect(),
            named => named.iter().map(found).collect::<Result<_, _>>()?,
        };
        let runs = (0..count).map(|_| None).collect();
        Ok(Envs { argument, overrides, scenario, zones, capacity, runs })
    }

    /// What does not change, as JSON: names, sizes, limits.
    pub fn description(&self) -> String {
        let Scenario { name, seed, network, fleet, beta, max_time_s, .. } = &self.scenario;
        let limits = |of: fn(f64, f64) -> f64, what: fn(&control_zones::scenario::VehicleParams) -> f64| {
            fleet.iter().map(|kind| what(&kind.vehicle)).reduce(of)
        };
        serde_json::json!({
            "scenario": name,
            "seed": seed,
            "zones": self.zones.iter().map(|&zone| &network.zones[zone as usize].name).collect::<Vec<_>>(),
            "paths": self.zones.iter().map(|&zone| {
                network.zones[zone as usize].paths.iter().map(|path| &path.name).collect::<Vec<_>>()
            }).collect::<Vec<_>>(),
            "features": FEATURES,
            "capacity": self.capacity,
            "count": self.runs.len(),
            "beta": beta,
            "dt_s": self.scenario.dt_s(),
            "max_time_s": max_time_s,
            "u_min_mps2": limits(f64::min, |vehicle| vehicle.u_min_mps2),
            "u_max_mps2": limits(f64::max, |vehicle| vehicle.u_max_mps2),
        })
        .to_string()
    }

    /// Begins a run anew, with the scenario's own seed or another.
    ///
    /// # Errors
    /// When the scenario cannot be loaded with that seed, as when a trace is missing.
    pub fn reset(&mut self, index: usize, seed: Option<u64>) -> Result<(), EnvError> {
        let count = self.runs.len();
        let place = self.runs.get_mut(index).ok_or(EnvError::NoSuch { index, count })?;
        let scenario = load(self.argument.as_deref(), &self.overrides, seed)?.without_plugins();
        let run = Run::new(&Arc::new(scenario), self.zones.clone(), self.capacity);
        *place = Some(run.map_err(|error| EnvError::Run { index, error })?);
        Ok(())
    }

    /// Number of actions of one run, and of rewards.
    pub fn sizes(&self) -> (usize, usize) {
        (self.zones.len() * self.capacity, self.zones.len())
    }

    /// One step of every run that has not ended; run by run in all slices.
    ///
    /// # Errors
    /// When one was not reset, or an action is no number. The runs before that one have been moved.
    pub fn step(&mut self, actions: &[f64], rewards: &mut [f64], ends: &mut [End]) -> Result<(), EnvError> {
        let (count, zones) = self.sizes();
        let parts = actions.chunks(count).zip(rewards.chunks_mut(zones)).zip(ends);
        for ((index, run), ((actions, rewards), end)) in self.runs.iter_mut().enumerate().zip(parts) {
            let run = run.as_mut().ok_or(EnvError::NotReset { index })?;
            run.step(actions, rewards).map_err(|error| EnvError::Run { index, error })?;
            *end = match (run.has_ended(), run.is_out_of_time()) {
                (false, _) => End::No,
                (true, false) => End::Served,
                (true, true) => End::OutOfTime,
            };
        }
        Ok(())
    }

    /// A run that has been reset.
    ///
    /// # Errors
    /// When there is none, or it has not been.
    pub fn run(&self, index: usize) -> Result<&Run, EnvError> {
        let count = self.runs.len();
        self.runs
            .get(index)
            .ok_or(EnvError::NoSuch { index, count })?
            .as_ref()
            .ok_or(EnvError::NotReset { index })
    }
}
