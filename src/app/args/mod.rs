//! Command-line arguments.

mod bench;
mod choices;
mod conduct;
mod record;
mod run;
mod scenario;

use crate::compare::cli::CompareArgs;
use crate::compare::study::StudyArgs;
use crate::reproduce::cli::ReproduceArgs;
pub(super) use bench::{BenchArgs, BenchKind, MeasureArgs, PeerArgs, ViewBenchArgs, WaitBenchArgs};
use clap::{Args, Parser, Subcommand};
pub(super) use conduct::{ConductArgs, Restart, ShareArgs, SteeringArgs, TimingArgs, WaitArgs};
pub(super) use record::{BranchArgs, ReplayArgs, ResumeArgs, ShowArgs, VerifyArgs};
pub(super) use run::{KeepArgs, PartArgs, RunArgs, SupervisedArgs, WorldArgs, WorldCheckArgs, WorldOrCheck};
pub(super) use scenario::{ScenarioArgs, SideBySide};
use std::ffi::OsString;
use std::path::PathBuf;

/// Safe, optimal coordination of connected automated vehicles through networks of control zones.
///
/// `cz run` runs the embedded two-zone merging experiment as three processes that exchange frames
/// through shared memory, and prints a table of results.
#[derive(Debug, Parser)]
#[command(name = "cz", version, propagate_version = true)]
pub(super) struct Cz {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Run a scenario: start all processes, show progress, print the results.
    Run(RunArgs),
    /// Start only the world of a run (the same as the program cz-world); or check one of your own.
    World(WorldOrCheck),
    /// Start only a coordinator of a run (the same as the program cz-coord).
    Coord(PartArgs),
    /// Start only a controller of a run (the same as the program cz-ctrl).
    Ctrl(PartArgs),
    /// Start a controller written elsewhere and end it with its supervisor.
    #[command(hide = true)]
    Keep(KeepArgs),
    /// Compute one reference trajectory: duration, coefficients, cost.
    Plan(PlanArgs),
    /// Show a recording: what it is of, one of its steps, or a vehicle's course.
    Show(ShowArgs),
    /// Watch a scenario, a run, or one or two recordings in the browser (the program cz-view).
    #[command(disable_help_flag = true, disable_version_flag = true)]
    View(SiblingArgs),
    /// Watch a run in the terminal (the program cz-top).
    #[command(disable_help_flag = true, disable_version_flag = true)]
    Top(SiblingArgs),
    /// Compare two recordings: the first step, vehicle and field in which they differ.
    Verify(VerifyArgs),
    /// Run every role of a recording again from its recorded inputs and compare.
    Replay(ReplayArgs),
    /// Go on with an interrupted run from its recording, to the same result.
    Resume(ResumeArgs),
    /// Run a recorded run's future from a step on with other settings, beside the one it had.
    Branch(BranchArgs),
    /// Regenerate the paper's tables and figures with intervals, verdicts and errata.
    Reproduce(ReproduceArgs),
    /// Compare policies on the same arrivals: costs, safety, comfort, and how far they are from what is possible.
    Compare(CompareArgs),
    /// Study mixed traffic: the same demand at every share of automated vehicles among human drivers.
    Study(StudyArgs),
    /// Measure latency, the solver, scale, or waiting on this machine.
    Bench(BenchArgs),
    /// Remove the shared memory and files that crashed runs of yours have left; active runs are not touched.
    Clean(CleanArgs),
    /// Controllers of your own: check one against the contract, or numbers against the law.
    Plugin {
        #[command(subcommand)]
        command: PluginCommand,
    },
    /// Run policies by scenarios by seeds into one Parquet table (the program cz-sweep).
    #[command(disable_help_flag = true, disable_version_flag = true)]
    Sweep(SiblingArgs),
    /// Write a recording in the formats of other tools (the program cz-export).
    #[command(disable_help_flag = true, disable_version_flag = true)]
    Export(SiblingArgs),
    /// Make one page of recordings: tables, map, figures, events (the program cz-report).
    #[command(disable_help_flag = true, disable_version_flag = true)]
    Report(SiblingArgs),
    /// SUMO as the world of a run, or a scenario in SUMO (the Python package control-zones[sumo]).
    #[command(disable_help_flag = true, disable_version_flag = true)]
    Sumo(SiblingArgs),
    /// Make a scenario of other tools' networks: `cz import sumo NET.xml`.
    #[command(disable_help_flag = true, disable_version_flag = true)]
    Import(SiblingArgs),
    /// What controllers in C and C++ are built against.
    Sdk {
        #[command(subcommand)]
        command: SdkCommand,
    },
}

/// For the program it is handed to.
#[derive(Debug, Args)]
pub(super) struct SiblingArgs {
    /// Its arguments; `--help` says which.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    pub arguments: Vec<OsString>,
}

#[derive(Debug, Args)]
pub(super) struct CleanArgs {
    /// Only say what would be removed.
    #[arg(long)]
    pub dry_run: bool,
}

#[derive(Debug, Subcommand)]
pub(super) enum PluginCommand {
    /// Start a controller against a scripted world and report, rule by rule, whether it keeps the contract.
    Check {
        /// Time within which each step is to be answered, ms.
        #[arg(long, value_name = "MS", default_value_t = 100.0)]
        deadline_ms: f64,
        /// Print JSON.
        #[arg(long)]
        json: bool,
        /// The controller's command line, after `--`.
        #[arg(last = true, required = true, value_name = "COMMAND")]
        command: Vec<String>,
    },
    /// Make the project of a new controller, which builds and keeps the contract.
    New(PluginNewArgs),
    /// Drive a controller by a recording instead of a run, and show where its commands differ from those recorded.
    Replay(PluginReplayArgs),
    /// Print test vectors of the paper's law as JSON: trajectories, rows and commands.
    Golden,
}

#[derive(Debug, Args)]
pub(super) struct PluginNewArgs {
    /// What it is written in.
    #[arg(value_enum, value_name = "LANGUAGE")]
    pub language: Language,
    /// Directory to make.
    #[arg(value_name = "DIR")]
    pub directory: PathBuf,
    /// For Rust: a clone of Control Zones to build against [default: the one this program was built in, or the published
    /// package].
    #[arg(long, value_name = "DIR")]
    pub sdk: Option<PathBuf>,
}

/// What a controller is written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Language {
    Python,
    C,
    Cpp,
    Rust,
}

#[derive(Debug, Args)]
pub(super) struct PluginReplayArgs {
    /// The recording (.czlog).
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// What it drives: the name of a controller of the recorded run, or a list such as `merge-1,merge-2.main`, whoever
    /// drove it then [default: the recorded run's controller, where it had one].
    #[arg(long, value_name = "TARGET")]
    pub controller: Option<String>,
    /// First step it is shown.
    #[arg(long, value_name = "STEP", default_value_t = 0)]
    pub from: u64,
    /// Accelerations that differ by no more than this are the same, m/s^2.
    #[arg(long, value_name = "MPS2", default_value_t = 0.0)]
    pub tolerance: f64,
    /// How long it may take to join and to answer each step, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    pub patience: f64,
    /// Leave it the terminal, and wait for it without end: for breakpoints.
    #[arg(long)]
    pub debug: bool,
    /// Print JSON.
    #[arg(long, conflicts_with = "debug")]
    pub json: bool,
    /// The controller's command line, after `--`.
    #[arg(last = true, required = true, value_name = "COMMAND")]
    pub command: Vec<String>,
}

#[derive(Debug, Subcommand)]
pub(super) enum SdkCommand {
    /// Install headers, libraries, and files for pkg-config and CMake.
    Install {
        /// Directory to install under.
        #[arg(long, value_name = "DIR")]
        prefix: PathBuf,
    },
}

/// A program of its own around the arguments of a subcommand.
#[derive(Debug, Parser)]
#[command(version)]
pub(super) struct Standalone<A: Args> {
    #[command(flatten)]
    pub args: A,
}

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("terminal").required(true))]
pub(super) struct PlanArgs {
    /// Entry speed, m/s.
    #[arg(long, value_name = "M_PER_S")]
    pub v0: f64,
    /// Length of the path, m.
    #[arg(long, value_name = "M")]
    pub length: f64,
    /// Weight of time against energy, m^2/s^4.
    #[arg(long, value_name = "BETA")]
    pub beta: f64,
    /// Terminal speed v_m, m/s.
    #[arg(long, value_name = "M_PER_S", group = "terminal")]
    pub vm: Option<f64>,
    /// Leave the terminal speed free.
    #[arg(long, group = "terminal")]
    pub free: bool,
    /// Use the transversality condition as the paper prints it.
    #[arg(long)]
    pub as_printed: bool,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}
