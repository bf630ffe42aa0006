//! Arguments of `cz bench`.

use super::ScenarioArgs;
use crate::bench::MEASURED;
use crate::scenario::{Scenario, ScenarioError};
use clap::{Args, Subcommand};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(in crate::app) struct BenchArgs {
    #[command(subcommand)]
    pub kind: BenchKind,
}

#[derive(Debug, Subcommand)]
pub(in crate::app) enum BenchKind {
    /// One step, next to the machine's floor and to what one would write instead.
    Latency(MeasureArgs),
    /// A step under the law `viable` with schedules, next to the same step under the paper's law.
    Law(MeasureArgs),
    /// The closed-form QP next to Clarabel, and the whole controller.
    Solver(MeasureArgs),
    /// Step time from a hundred to a hundred thousand vehicles.
    Scale(ScaleArgs),
    /// The ways of waiting beside each other, on a quiet machine and on a busy one, and what `cz run` does at first.
    Wait(WaitBenchArgs),
    /// A step while somebody looks at the run, beside one while nobody does.
    View(ViewBenchArgs),
    /// The other process of a measurement.
    #[command(hide = true)]
    Peer(PeerArgs),
}

#[derive(Debug, Args)]
pub(in crate::app) struct MeasureArgs {
    /// Fewer repetitions, smaller sizes: a check that it works rather than a measurement.
    #[arg(long)]
    pub quick: bool,
    /// Also write the results as JSON to this file; `-` for stdout, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(in crate::app) struct ScaleArgs {
    #[command(flatten)]
    pub measure: MeasureArgs,
    /// Grids of nine intersections side by side instead of corridors of two merges.
    #[arg(long, conflicts_with = "with_sumo")]
    pub grids: bool,
    /// Also measure SUMO's stepping, with its human drivers on the same corridors. Needs the Python package
    /// eclipse-sumo in the Python that CZ_PYTHON names (default: python3).
    #[arg(long)]
    pub with_sumo: bool,
    /// Beside how many vehicles at most SUMO is measured. Ten thousand take it some minutes, a hundred thousand
    /// far more than ten.
    #[arg(long, value_name = "VEHICLES", default_value_t = 10_000, requires = "with_sumo")]
    pub sumo_up_to: usize,
}

#[derive(Debug, Args)]
pub(in crate::app) struct WaitBenchArgs {
    #[command(flatten)]
    pub measure: MeasureArgs,
    /// Numbers of busy processes beside the runs.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [0, 2, 4, 8])]
    pub busy: Vec<usize>,
    /// Runs of each way of waiting under each load, by turns.
    #[arg(long, value_name = "N", default_value_t = 9)]
    pub repetitions: usize,
    /// The program `cz` of another build, measured beside this one's ways of waiting with its default.
    #[arg(long, value_name = "FILE")]
    pub beside: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(in crate::app) struct ViewBenchArgs {
    #[command(flatten)]
    pub measure: MeasureArgs,
    /// Runs with and without a view of each scene, by turns.
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub repetitions: usize,
}

#[derive(Debug, Args)]
pub(in crate::app) struct PeerArgs {
    #[command(flatten)]
    pub scenario: PeerScenarioArgs,
    pub kind: String,
    pub values: Vec<String>,
}

/// The scenario of a measurement's other process: always the one that is measured, changed.
#[derive(Debug, Args)]
pub(in crate::app) struct PeerScenarioArgs {
    #[arg(long)]
    pub seed: Option<u64>,
    #[arg(long = "set")]
    pub set: Vec<String>,
}

impl PeerScenarioArgs {
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        let (seed, set) = (self.seed, self.set.clone());
        ScenarioArgs { scenario: Some(MEASURED.to_owned()), seed, set, side_by_side: None }.load()
    }
}
