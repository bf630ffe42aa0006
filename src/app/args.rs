//! Command-line arguments.

use super::AppError;
use crate::process::{OnMiss, Pace, Placement, Timing, WaitMode};
use crate::reproduce::cli::ReproduceArgs;
use crate::scenario::share::{MAX_CONTROLLERS, MAX_COORDINATORS};
use crate::scenario::{Override, Scenario, ScenarioError, load};
use crate::transport::iox::RunName;
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;
use std::time::Duration;

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
    /// Start only the world of a run (the same as the program cz-world).
    World(WorldArgs),
    /// Start only a coordinator of a run (the same as the program cz-coord).
    Coord(PartArgs),
    /// Start only a controller of a run (the same as the program cz-ctrl).
    Ctrl(PartArgs),
    /// Compute one reference trajectory: duration, coefficients, cost.
    Plan(PlanArgs),
    /// Show a recording: what it is of, one of its steps, or a vehicle's course.
    Show(ShowArgs),
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
    /// Measure latency, the solver, or scale on this machine.
    Bench(BenchArgs),
    /// Remove the shared memory and files that crashed runs of yours have left; active runs are not touched.
    Clean(CleanArgs),
    /// Controllers of your own: check one against the contract, or numbers against the law.
    Plugin {
        #[command(subcommand)]
        command: PluginCommand,
    },
    /// What controllers in C and C++ are built against.
    Sdk {
        #[command(subcommand)]
        command: SdkCommand,
    },
}

#[derive(Debug, Args)]
pub(super) struct CleanArgs {
    /// Only say what would be removed.
    #[arg(long)]
    pub dry_run: bool,
}

#[derive(Debug, Args)]
pub(super) struct BenchArgs {
    #[command(subcommand)]
    pub kind: BenchKind,
}

#[derive(Debug, Subcommand)]
pub(super) enum BenchKind {
    /// One step, next to the machine's floor and to what one would write instead.
    Latency(MeasureArgs),
    /// The closed-form QP next to Clarabel, and the whole controller.
    Solver(MeasureArgs),
    /// Step time from a hundred to a hundred thousand vehicles.
    Scale(ScaleArgs),
    /// The other process of a measurement.
    #[command(hide = true)]
    Peer(PeerArgs),
}

#[derive(Debug, Args)]
pub(super) struct MeasureArgs {
    /// Fewer repetitions, smaller sizes: a check that it works rather than a measurement.
    #[arg(long)]
    pub quick: bool,
    /// Also write the results as JSON to this file; `-` for stdout, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(super) struct ScaleArgs {
    #[command(flatten)]
    pub measure: MeasureArgs,
    /// Also measure SUMO's stepping, with its human drivers on the same corridors. Needs the Python package
    /// eclipse-sumo in the Python that CZ_PYTHON names (default: python3).
    #[arg(long)]
    pub with_sumo: bool,
}

#[derive(Debug, Args)]
pub(super) struct PeerArgs {
    #[command(flatten)]
    pub scenario: PeerScenarioArgs,
    pub kind: String,
    pub values: Vec<String>,
}

/// The scenario of a measurement's other process: always the default one, changed.
#[derive(Debug, Args)]
pub(super) struct PeerScenarioArgs {
    #[arg(long)]
    pub seed: Option<u64>,
    #[arg(long = "set")]
    pub set: Vec<String>,
}

impl PeerScenarioArgs {
    pub fn load(&self) -> Result<Scenario, ScenarioError> {
        let (seed, set) = (self.seed, self.set.clone());
        ScenarioArgs { scenario: None, seed, set, corridors: None }.load()
    }
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
    /// Print test vectors of the paper's law as JSON: trajectories, rows and commands.
    Golden,
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

/// Which scenario, and what is changed in it.
#[derive(Clone, Debug, Args)]
pub(super) struct ScenarioArgs {
    /// Scenario: a TOML file, or one of the embedded two-merges (default), varying-demand, corridor-8,
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

/// Into how many processes coordination and control are divided.
#[derive(Clone, Copy, Debug, Args)]
pub(super) struct ShareArgs {
    /// Number of controller processes; zones are shared out evenly.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_CONTROLLERS)))]
    pub ctrl_procs: u32,
    /// Number of coordinator processes; zones are shared out evenly.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_COORDINATORS)))]
    pub coord_procs: u32,
}

impl ShareArgs {
    /// Refuses more processes than there are zones to share out.
    pub fn check(&self, scenario: &Scenario) -> Result<(), AppError> {
        let zones = scenario.network.zones.len() as u32;
        for (name, count) in [("--ctrl-procs", self.ctrl_procs), ("--coord-procs", self.coord_procs)] {
            if count > zones {
                let scenario = &scenario.name;
                return Err(AppError::Usage(format!(
                    "{name} {count}: expected at most {zones}, the number of zones of scenario {scenario}"
                )));
            }
        }
        let (controllers, plugins) = (scenario.controllers(self.ctrl_procs), scenario.plugins.len());
        if controllers > MAX_CONTROLLERS {
            return Err(AppError::Usage(format!(
                "--ctrl-procs {}: with the scenario's {plugins} controllers, expected at most {MAX_CONTROLLERS}",
                self.ctrl_procs
            )));
        }
        Ok(())
    }
}

/// Bounds of all waiting.
#[derive(Clone, Copy, Debug, Args)]
pub(super) struct WaitArgs {
    /// How long to wait for the other processes of the run to appear, s.
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = seconds)]
    pub attach_timeout: Duration,
    /// How long to wait for a frame before giving the run up, s.
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = seconds)]
    pub peer_timeout: Duration,
    /// Pin the processes to cores.
    #[arg(long, value_enum, default_value_t = Placement::None)]
    pub pin: Placement,
    /// Ask for real-time scheduling (SCHED_FIFO) and locked memory, and say what was granted.
    #[arg(long)]
    pub rt: bool,
}

impl WaitArgs {
    /// Whether anything is asked of the system of which it is worth saying what was granted.
    pub fn asks_for_placement(&self) -> bool {
        self.rt || self.pin != Placement::None
    }

    /// As a process of the run is given them.
    pub fn to_flags(self) -> Vec<String> {
        let seconds = |d: Duration| d.as_secs_f64().to_string();
        let mut flags = vec!["--attach-timeout".to_owned(), seconds(self.attach_timeout)];
        flags.extend(["--peer-timeout".to_owned(), seconds(self.peer_timeout)]);
        flags.extend(["--pin".to_owned(), name_of(self.pin)]);
        flags.extend(self.rt.then(|| "--rt".to_owned()));
        flags
    }
}

fn seconds(text: &str) -> Result<Duration, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s <= 86_400.0 => Ok(Duration::from_secs_f64(s)),
        _ => Err("expected a number of seconds > 0 and <= 86400".to_owned()),
    }
}

/// When steps begin, and what becomes of late ones.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(super) struct TimingArgs {
    /// Begin each step as soon as the one before is done, or at its instant in real time.
    #[arg(long, value_enum, default_value_t = Pace::Free)]
    pub pace: Pace,
    /// Time a step may take [default: with `--pace realtime` the step length, otherwise any].
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub deadline: Option<Duration>,
    /// What to do about controllers that have not answered by the deadline.
    #[arg(long, value_enum, default_value_t = OnMiss::Wait)]
    pub on_miss: OnMiss,
}

impl TimingArgs {
    /// What they mean.
    pub fn timing(&self) -> Result<Timing, AppError> {
        let TimingArgs { pace, deadline, on_miss } = *self;
        if on_miss != OnMiss::Wait && pace == Pace::Free && deadline.is_none() {
            let problem =
                "--on-miss: without a deadline nothing is missed; add --pace realtime or --deadline";
            return Err(AppError::Usage(problem.to_owned()));
        }
        Ok(Timing { pace, deadline, on_miss })
    }

    /// Whether anything is asked for.
    pub fn is_given(&self) -> bool {
        self.pace != Pace::Free || self.deadline.is_some()
    }

    /// As a process of the run is given them.
    pub fn to_flags(self) -> Vec<String> {
        let mut flags = vec!["--pace".to_owned(), name_of(self.pace)];
        flags.extend(["--on-miss".to_owned(), name_of(self.on_miss)]);
        flags.extend(self.deadline.map(|d| format!("--deadline={}", d.as_secs_f64())));
        flags
    }
}

/// What becomes of a run when a participant dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Restart {
    /// It ends.
    Never,
    /// Another process takes its place and goes on to the same result.
    OnFailure,
}

/// How the processes of a run wait, keep time, and what becomes of those that die.
#[derive(Clone, Copy, Debug, Args)]
pub(super) struct ConductArgs {
    #[command(flatten)]
    pub wait: WaitArgs,
    /// How the processes of the run wait for frames.
    #[arg(long = "wait", value_enum, default_value_t = WaitMode::Hybrid)]
    pub wait_mode: WaitMode,
    /// What becomes of the run when a coordinator or a process of the built-in pool dies.
    #[arg(long, value_enum, default_value_t = Restart::OnFailure)]
    pub restart: Restart,
    #[command(flatten)]
    pub timing: TimingArgs,
}

impl ConductArgs {
    /// As the world of the run is given them.
    pub fn to_flags(self) -> Vec<String> {
        let mut flags = self.wait.to_flags();
        flags.extend(["--wait".to_owned(), name_of(self.wait_mode)]);
        flags.extend(["--restart".to_owned(), name_of(self.restart)]);
        flags.extend(self.timing.to_flags());
        flags
    }
}

/// A choice as it is written on the command line.
fn name_of(choice: impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |v| v.get_name().to_owned())
}

#[derive(Debug, Args)]
pub(super) struct RunArgs {
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Run everything in this process, without shared memory.
    #[arg(long, conflicts_with = "rt")]
    pub in_process: bool,
    #[command(flatten)]
    pub share: ShareArgs,
    /// Let a program of your own drive zones or approaches, e.g. `--controller merge-2="python3 mine.py"`;
    /// may be repeated. TARGET is a list such as `merge-1,merge-2.main`, or the name of a controller that
    /// the scenario declares.
    #[arg(long = "controller", value_name = "TARGET=COMMAND")]
    pub controllers: Vec<String>,
    /// What becomes of commands that are not safe, in place of the scenario's `shield`: off, observe, on.
    #[arg(long, value_name = "MODE")]
    pub shield: Option<String>,
    /// Also write the summary as JSON to this file; `-` for stdout, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
    /// Record every frame of the run in this file (.czlog); an older recording is replaced.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Name of the run; runs of different names do not see each other [default: one of its own].
    #[arg(long, value_name = "NAME")]
    pub run: Option<RunName>,
    #[command(flatten)]
    pub conduct: ConductArgs,
}

#[derive(Debug, Args)]
pub(super) struct WorldArgs {
    /// Name of the run; the other parts are started with the same name.
    #[arg(long, value_name = "NAME")]
    pub run: RunName,
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    #[command(flatten)]
    pub share: ShareArgs,
    /// Also write the summary as JSON to this file; `-` for stdout, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub conduct: ConductArgs,
    /// Record every frame of the run in this file (.czlog); an older recording is replaced.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Begin only once somebody looks on.
    #[arg(long, hide = true)]
    pub observed: bool,
    /// The run's id.
    #[arg(long, hide = true, value_name = "ID")]
    pub run_id: Option<u64>,
    /// Go on from this recording, which decides the scenario and the numbers of processes.
    #[arg(long, hide = true, value_name = "FILE")]
    pub resume: Option<PathBuf>,
    /// Process id of the supervisor: report to it on stdout, and end with it.
    #[arg(long, hide = true, value_name = "PID")]
    pub supervised: Option<u32>,
}

#[derive(Debug, Args)]
pub(super) struct PartArgs {
    /// Name of the run to join.
    #[arg(long, value_name = "NAME")]
    pub run: RunName,
    /// Index among the processes of the same role [default: the first free one].
    #[arg(long, value_name = "I")]
    pub index: Option<u16>,
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    #[command(flatten)]
    pub wait: WaitArgs,
    /// Process id of the supervisor: end with it.
    #[arg(long, hide = true, value_name = "PID")]
    pub supervised: Option<u32>,
}

#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("terminal").required(true))]
pub(super) struct PlanArgs {
    /// Entry speed, m/s.
    #[arg(long, value_name = "M_PER_S")]
    pub v0: f64,
    /// Length of the approach, m.
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

#[derive(Debug, Args)]
pub(super) struct ShowArgs {
    /// The recording.
    pub file: PathBuf,
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
pub(super) struct VerifyArgs {
    /// One recording.
    pub first: PathBuf,
    /// The other.
    pub second: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub(super) struct ReplayArgs {
    /// The recording.
    pub file: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub(super) struct ResumeArgs {
    /// The recording; it decides the scenario and the numbers of processes.
    pub file: PathBuf,
    /// Also write the summary as JSON to this file; `-` for stdout, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
    /// Record the run in this file, its past included: a recording of the whole run. Not the file it goes on
    /// from; an older recording is replaced.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Name of the run; runs of different names do not see each other [default: one of its own].
    #[arg(long, value_name = "NAME")]
    pub run: Option<RunName>,
    #[command(flatten)]
    pub conduct: ConductArgs,
}

#[derive(Debug, Args)]
pub(super) struct BranchArgs {
    /// The recording.
    pub file: PathBuf,
    /// The first step of the other future.
    #[arg(long, value_name = "STEP")]
    pub at: u64,
    /// Change a scenario key from then on, e.g. `--set zones.merge-1.flow.gain_mps=0.3`; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE", required = true)]
    pub set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}
