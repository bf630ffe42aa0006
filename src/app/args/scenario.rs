//! Which scenario, and what of it is changed.

use crate::scenario::{Override, Scenario, ScenarioError, load};
use clap::Args;

/// Which scenario, and what is changed in it.
#[derive(Clone, Debug, Args)]
pub(in crate::app) struct ScenarioArgs {
    /// Scenario: a TOML file, or one of the embedded two-merges (default), paper, varying-demand, corridor-8,
    /// tree, faulty-sensors.
    pub scenario: Option<String>,
    /// Seed of all random streams, in place of the scenario's.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Change a scenario key, e.g. `--set zones.merge-1.flow.gain_mps=0.3`; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// A generated network that holds about this many vehicles at once.
    #[arg(long, hide = true, value_name = "VEHICLES")]
    pub corridors: Option<usize>,
}

/// Simulated time of a generated network's run, s: filling up, then thirty seconds to measure.
const CORRIDORS_UNTIL_S: f64 = 90.0;

impl ScenarioArgs {
    /// Nothing said: somebody else decides.
    pub const fn none() -> ScenarioArgs {
        ScenarioArgs { scenario: None, seed: None, set: Vec::new(), corridors: None }
    }

    /// Loads and validates the scenario.
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        if let Some(vehicles) = self.corridors {
            return crate::bench::corridors(vehicles, CORRIDORS_UNTIL_S);
        }
        let overrides = self.set.iter().map(|s| s.parse()).collect::<Result<Vec<Override>, _>>()?;
        load(self.scenario.as_deref(), &overrides, self.seed)
    }

    /// The flags again, without the scenario itself.
    pub fn to_flags(&self) -> Vec<String> {
        let mut arguments: Vec<String> = Vec::new();
        if let Some(seed) = self.seed {
            arguments.extend(["--seed".to_owned(), seed.to_string()]);
        }
        arguments.extend(self.set.iter().map(|set| format!("--set={set}")));
        arguments
    }

    /// Whether the command line says anything about the scenario.
    pub fn is_given(&self) -> bool {
        self.scenario.is_some() || self.seed.is_some() || !self.set.is_empty() || self.corridors.is_some()
    }

    /// The arguments again, for a child process.
    pub fn to_arguments(&self) -> Vec<String> {
        let mut arguments = self.to_flags();
        if let Some(vehicles) = self.corridors {
            arguments.extend(["--corridors".to_owned(), vehicles.to_string()]);
        }
        if let Some(scenario) = &self.scenario {
            arguments.extend(["--".to_owned(), scenario.clone()]);
        }
        arguments
    }
}
