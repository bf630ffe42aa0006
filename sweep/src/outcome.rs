//! What is kept of a run: its numbers, not its vehicles.

use control_zones::compare::measure::{MEASURES, Measure, Of};
use control_zones::compare::sample::Sample;
use serde::{Deserialize, Serialize};

/// What is kept of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Over all frames, as `cz run` prints it.
    pub state_hash: u64,
    /// Whether every vehicle got through.
    pub complete: bool,
    /// Vehicles that got through.
    pub vehicles: u64,
    /// Mean speed at which they left, m/s: what the paper's flow control of last zones is made of.
    pub exit_mps: f64,
    /// By [`measures`], in their order.
    pub values: Vec<Option<f64>>,
}

/// The measures that a run alone has, without bounds and without other policies.
pub fn measures() -> impl Iterator<Item = &'static Measure> {
    MEASURES.iter().filter(|measure| matches!(measure.of, Of::Sample(_)))
}

impl Outcome {
    /// What is kept of it.
    pub fn of(sample: &Sample) -> Outcome {
        let value = |measure: &Measure| match measure.of {
            Of::Sample(of) => of(sample).filter(|value| value.is_finite()),
            Of::Row(_) => None,
        };
        Outcome {
            state_hash: sample.state_hash,
            complete: sample.complete,
            vehicles: sample.vehicles.len() as u64,
            exit_mps: sample.exit_mps(),
            values: measures().map(value).collect(),
        }
    }
}
