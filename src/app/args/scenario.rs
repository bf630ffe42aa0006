//! Which scenario, and what of it is changed.

use crate::bench::{Family, side_by_side};
use crate::scenario::{Override, Scenario, ScenarioError, load};
use clap::Args;
use std::fmt;
use std::str::FromStr;

/// Which scenario, and what is changed in it.
#[derive(Clone, Debug, Args)]
pub(in crate::app) struct ScenarioArgs {
    /// Scenario: a TOML file, or one of the embedded two-merges (default), paper, varying-demand, corridor-8,
    /// tree, faulty-sensors, intersection, roundabout, lane-drop, grid-3x3.
    pub scenario: Option<String>,
    /// Seed of all random streams, in place of the scenario's.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Change a scenario key, e.g. `--set coordination.price_of_time=0.5`; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// A generated network that holds about this many vehicles at once.
    #[arg(long, hide = true, value_name = "corridors=VEHICLES|grids=VEHICLES")]
    pub side_by_side: Option<SideBySide>,
}

/// A network generated for a measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::app) struct SideBySide {
    pub family: Family,
    /// Vehicles at once, roughly.
    pub vehicles: usize,
}

impl SideBySide {
    /// Simulated time of a run, s: filling up, then thirty seconds to measure.
    fn until_s(self) -> f64 {
        match self.family {
            Family::Corridors => 90.0,
            Family::Grids => 120.0,
        }
    }
}

impl FromStr for SideBySide {
    type Err = String;

    fn from_str(text: &str) -> Result<SideBySide, String> {
        let families = [Family::Corridors, Family::Grids];
        let (name, vehicles) = text.split_once('=').unwrap_or((text, ""));
        let family = families.into_iter().find(|family| family.name() == name);
        let vehicles = vehicles.parse().ok().filter(|&vehicles| vehicles > 0);
        let both = family.zip(vehicles).map(|(family, vehicles)| SideBySide { family, vehicles });
        both.ok_or_else(|| "expected corridors=VEHICLES or grids=VEHICLES, a number > 0".to_owned())
    }
}

impl fmt::Display for SideBySide {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.family.name(), self.vehicles)
    }
}

impl ScenarioArgs {
    /// Nothing said: somebody else decides.
    pub const fn none() -> ScenarioArgs {
        ScenarioArgs { scenario: None, seed: None, set: Vec::new(), side_by_side: None }
    }

    /// Loads and validates the scenario.
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        if let Some(network) = self.side_by_side {
            return side_by_side(network.family, network.vehicles, network.until_s());
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
        self.scenario.is_some() || self.seed.is_some() || !self.set.is_empty() || self.side_by_side.is_some()
    }

    /// The arguments again, for a child process.
    pub fn to_arguments(&self) -> Vec<String> {
        let mut arguments = self.to_flags();
        if let Some(network) = self.side_by_side {
            arguments.extend(["--side-by-side".to_owned(), network.to_string()]);
        }
        if let Some(scenario) = &self.scenario {
            arguments.extend(["--".to_owned(), scenario.clone()]);
        }
        arguments
    }
}
