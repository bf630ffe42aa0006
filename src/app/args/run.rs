//! Arguments of what runs a scenario, or a part of it.

use super::{ConductArgs, ScenarioArgs, ShareArgs, WaitArgs};
use crate::transport::iox::RunName;
use clap::{ArgMatches, Args, FromArgMatches, Subcommand};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(in crate::app) struct RunArgs {
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// Run everything in this process, without shared memory.
    #[arg(long, conflicts_with = "rt")]
    pub in_process: bool,
    #[command(flatten)]
    pub share: ShareArgs,
    /// Let a program of your own drive zones or paths, e.g. `--controller merge-2="python3 mine.py"`;
    /// may be repeated. TARGET is a list such as `merge-1,merge-2.main`, or the name of a controller that
    /// the scenario declares.
    #[arg(long = "controller", value_name = "TARGET=COMMAND")]
    pub controllers: Vec<String>,
    /// What becomes of the vehicles of such a controller when its process ends in the middle of the run, e.g.
    /// `--on-exit merge-2=restart`; may be repeated. CHOICE is end (the run ends with it, the default), restart (it is
    /// started again), builtin (the built-in law drives from then on) or shield-fallback (they make for their speed
    /// limits as far as the shield allows).
    #[arg(long, value_name = "TARGET=CHOICE")]
    pub on_exit: Vec<String>,
    /// Start such controllers again in the middle of the run when their programs change, unless `--on-exit` is builtin or
    /// shield-fallback; one that dies soon waits for that, and the run with it.
    #[arg(long, conflicts_with_all = ["in_process", "view"])]
    pub reload: bool,
    /// Debug such a controller, e.g. `--debug merge-2`: it has the terminal, and no clock or timeout goes on while it is
    /// waited for.
    #[arg(long, value_name = "TARGET", conflicts_with_all = ["in_process", "view"])]
    pub debug: Option<String>,
    /// The command line of a program that takes the world's place, to which `cz world`'s arguments are added; it brings
    /// in vehicles and moves them (see docs/world-contract.md).
    #[arg(long, value_name = "COMMAND", conflicts_with = "in_process")]
    pub world: Option<String>,
    /// What becomes of commands that are not safe, in place of the scenario's `shield`: off, observe, on.
    #[arg(long, value_name = "MODE")]
    pub shield: Option<String>,
    /// Record every frame of the run in this file (.czlog); an older recording is replaced.
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Write what each process did when, in wall-clock time (computing, publishing, waiting), to this file, which
    /// Perfetto reads.
    #[arg(long, value_name = "FILE.json", conflicts_with = "in_process")]
    pub trace: Option<PathBuf>,
    /// Watch the run in the browser (the program cz-view), which may steer it.
    #[arg(long, conflicts_with = "in_process")]
    pub view: bool,
    #[command(flatten)]
    pub supervised: SupervisedArgs,
}

/// What goes for every run that `cz` starts all processes of.
#[derive(Debug, Args)]
pub(in crate::app) struct SupervisedArgs {
    /// Also write the summary as JSON to this file; `-` for stdout, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
    /// Name of the run; runs of different names do not see each other [default: one of its own].
    #[arg(long, value_name = "NAME")]
    pub run: Option<RunName>,
    #[command(flatten)]
    pub conduct: ConductArgs,
}

#[derive(Debug, Args)]
pub(in crate::app) struct WorldArgs {
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
    /// Index of a controller that is debugged: no clock goes on while it is waited for.
    #[arg(long, hide = true, value_name = "I")]
    pub debugged: Option<u32>,
    /// The run's id.
    #[arg(long, hide = true, value_name = "ID")]
    pub run_id: Option<u64>,
    /// Go on from this recording, which decides the scenario and the numbers of processes.
    #[arg(long, hide = true, value_name = "FILE")]
    pub resume: Option<PathBuf>,
    /// So many of its steps [default: all up to the first that is missing].
    #[arg(long, hide = true, value_name = "N", requires = "resume")]
    pub resume_steps: Option<u64>,
    /// Process id of the supervisor: report to it on stdout, and end with it.
    #[arg(long, hide = true, value_name = "PID")]
    pub supervised: Option<u32>,
}

#[derive(Debug, Subcommand)]
enum WorldCommand {
    /// Start a world of your own between a coordinator and a scripted controller and report, rule by rule, whether it
    /// keeps the contract (docs/world-contract.md).
    Check(WorldCheckArgs),
}

/// `cz world` with its own arguments, or `cz world check`, which asks for none of them.
#[derive(Debug)]
pub(in crate::app) enum WorldOrCheck {
    World(Box<WorldArgs>),
    Check(WorldCheckArgs),
}

impl FromArgMatches for WorldOrCheck {
    fn from_arg_matches(matches: &ArgMatches) -> Result<WorldOrCheck, clap::Error> {
        match matches.subcommand() {
            Some(_) => WorldCommand::from_arg_matches(matches)
                .map(|WorldCommand::Check(args)| WorldOrCheck::Check(args)),
            None => WorldArgs::from_arg_matches(matches).map(|args| WorldOrCheck::World(Box::new(args))),
        }
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = WorldOrCheck::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Args for WorldOrCheck {
    fn augment_args(command: clap::Command) -> clap::Command {
        let command = WorldCommand::augment_subcommands(WorldArgs::augment_args(command));
        command.subcommand_required(false).args_conflicts_with_subcommands(true).subcommand_negates_reqs(true)
    }

    fn augment_args_for_update(command: clap::Command) -> clap::Command {
        WorldOrCheck::augment_args(command)
    }
}

#[derive(Debug, Args)]
pub(in crate::app) struct WorldCheckArgs {
    /// The scenario it plays; the check turns the shield off, lets nobody in where there is no room, and ends after 80 s.
    #[command(flatten)]
    pub scenario: ScenarioArgs,
    /// How far an acceleration may be from the one that was to be held, m/s^2.
    #[arg(long, value_name = "MPS2", default_value_t = 0.01)]
    pub tolerance: f64,
    /// How far a way may be from the one that goes with the speeds at its ends, m.
    #[arg(long, value_name = "M", default_value_t = 0.001)]
    pub way_tolerance: f64,
    /// How long it may take to make a step and to end, s; to open the run, at least 30.
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    pub patience: f64,
    /// Breaches of this rule are told of, and do not count, e.g. `--allow kept` where vehicles change lanes out of a
    /// zone; may be repeated.
    #[arg(long, value_name = "RULE")]
    pub allow: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
    /// The world's command line, after `--`; the arguments of `cz world` are added to it.
    #[arg(last = true, required = true, value_name = "COMMAND")]
    pub command: Vec<String>,
}

#[derive(Debug, Args)]
pub(in crate::app) struct PartArgs {
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
pub(in crate::app) struct KeepArgs {
    /// Process id of the supervisor.
    #[arg(long, value_name = "PID")]
    pub supervised: u32,
    /// Leave it the terminal.
    #[arg(long)]
    pub terminal: bool,
    /// The command, for `sh -c`.
    #[arg(last = true, value_name = "COMMAND")]
    pub command: String,
}
