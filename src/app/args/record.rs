//! Arguments of what works on recordings.

use super::SupervisedArgs;
use clap::Args;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(in crate::app) struct ShowArgs {
    /// The recording; with --network, the scenario: a file, or the name of an embedded one.
    pub file: PathBuf,
    /// Draw the network of a scenario instead.
    #[arg(long, conflicts_with_all = ["step", "vehicle", "scenario", "json"])]
    pub network: bool,
    /// Where to draw it: a file that ends in .svg or .png [default: NAME.svg].
    #[arg(long, value_name = "FILE", requires = "network")]
    pub out: Option<PathBuf>,
    /// Show one step: states, assignments and commands.
    #[arg(long, value_name = "K", conflicts_with = "vehicle")]
    pub step: Option<u64>,
    /// Show the course of one vehicle.
    #[arg(long, value_name = "ID")]
    pub vehicle: Option<u32>,
    /// Print the scenario's text and what was changed in it.
    #[arg(long, conflicts_with_all = ["step", "vehicle", "json"])]
    pub scenario: bool,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub(in crate::app) struct VerifyArgs {
    /// One recording.
    pub first: PathBuf,
    /// The other.
    pub second: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub(in crate::app) struct ReplayArgs {
    /// The recording.
    pub file: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub(in crate::app) struct ResumeArgs {
    /// The recording; it decides the scenario and the numbers of processes.
    pub file: PathBuf,
    /// Record the run in this file, its past included: a recording of the whole run. Not the file it goes on
    /// from; an older recording is replaced.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    #[command(flatten)]
    pub supervised: SupervisedArgs,
}

#[derive(Debug, Args)]
pub(in crate::app) struct BranchArgs {
    /// The recording.
    pub file: PathBuf,
    /// The first step of the other future.
    #[arg(long, value_name = "STEP")]
    pub at: u64,
    /// Change a scenario key from then on, e.g. `--set coordination.price_of_time=0.5`; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE", required = true)]
    pub set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}
