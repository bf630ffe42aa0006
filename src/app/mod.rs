//! The command line: what the four programs have in common, and what they print.

mod args;
mod bench;
mod bench_law;
mod bench_view;
mod bench_wait;
mod clean;
mod controllers;
mod draw;
mod golden;
mod lines;
mod measured;
mod new;
mod parts;
mod plan;
mod plugin;
mod progress;
mod record;
mod report;
mod resume;
mod run;
mod say;
mod sdk;
mod show;
mod sibling;
mod supervise;
mod world;

#[cfg(fuzzing)]
pub use show::everything as show_everything;

use crate::compare::CompareError;
use crate::process::ProcessError;
use crate::reproduce::{self, ReproduceError};
use crate::scenario::ScenarioError;
use crate::scenario::load::printable;
use crate::transport::iox::SpaceError;
use crate::world::Traffic;
use clap::Parser;
pub use record::open as open_recording;
use std::process::ExitCode;

/// Why a command did not succeed; decides the exit code.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The scenario is no good.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// An argument is no good.
    #[error("{0}")]
    Usage(String),
    /// The run failed.
    #[error("{0}")]
    Failed(String),
    /// The run was interrupted.
    #[error("{0}")]
    Interrupted(String),
}

impl AppError {
    /// 1 the run failed, 2 bad input, 130 interrupted.
    fn exit_code(&self) -> u8 {
        match self {
            AppError::Scenario(_) | AppError::Usage(_) => 2,
            AppError::Failed(_) => 1,
            AppError::Interrupted(_) => 130,
        }
    }
}

impl From<ProcessError> for AppError {
    fn from(error: ProcessError) -> AppError {
        match error {
            ProcessError::Interrupted { .. } => AppError::Interrupted(error.to_string()),
            ProcessError::AlreadyActive { .. }
            | ProcessError::TooFewCores { .. }
            | ProcessError::Space(SpaceError::NotOurs { .. }) => AppError::Usage(error.to_string()),
            other => AppError::Failed(other.to_string()),
        }
    }
}

impl From<ReproduceError> for AppError {
    fn from(error: ReproduceError) -> AppError {
        match error {
            ReproduceError::UnknownPart { .. } | ReproduceError::TooFewSeeds(_) => {
                AppError::Usage(error.to_string())
            }
            other => AppError::Failed(other.to_string()),
        }
    }
}

impl From<CompareError> for AppError {
    fn from(error: CompareError) -> AppError {
        match error {
            CompareError::Failed(_) => AppError::Failed(error.to_string()),
            _ => AppError::Usage(error.to_string()),
        }
    }
}

/// `cz study`.
fn study(args: &crate::compare::study::StudyArgs) -> Result<(), AppError> {
    print(&crate::compare::study::main(args)?)
}

/// `cz compare`.
fn compare(args: &crate::compare::cli::CompareArgs) -> Result<(), AppError> {
    print(&crate::compare::cli::main(args)?)
}

/// Has a panic end in one line, the last that is said: a supervisor shows a part's last words.
fn say_panics_in_a_line(program: &'static str) {
    std::panic::set_hook(Box::new(move |panic| {
        use std::io::Write;
        let mut err = std::io::stderr().lock();
        // Where it is asked for (RUST_BACKTRACE). Nobody is left to hear that stderr is full.
        let backtrace = std::backtrace::Backtrace::capture();
        if backtrace.status() == std::backtrace::BacktraceStatus::Captured {
            let _ = write!(err, "{backtrace}");
        }
        let payload = panic.payload();
        let what = payload.downcast_ref::<&str>().copied();
        let what =
            what.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message");
        let at = panic.location().map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(err, "{}", panic_line(program, what, &at));
    }));
}

fn panic_line(program: &str, what: &str, at: &str) -> String {
    format!("{program}: internal error, please report it: {} (at {at})", printable(what))
}

/// `cz`.
pub fn cz() -> ExitCode {
    say_panics_in_a_line("cz");
    raise_file_limit();
    let args = args::Cz::parse();
    finish(
        "cz",
        match args.command {
            args::Command::Run(args) => run::run(&args, None),
            args::Command::World(args::WorldOrCheck::World(args)) => parts::world(&args, None),
            args::Command::World(args::WorldOrCheck::Check(args)) => world::check(&args),
            args::Command::Coord(args) => parts::coordinator(&args),
            args::Command::Ctrl(args) => parts::controller(&args),
            args::Command::Keep(args) => supervise::keep(&args),
            args::Command::Plan(args) => plan::plan(&args),
            args::Command::Show(args) => show::show(&args),
            args::Command::Verify(args) => record::verify(&args),
            args::Command::Replay(args) => record::replay(&args),
            args::Command::Resume(args) => resume::resume(&args),
            args::Command::Branch(args) => resume::branch(&args),
            args::Command::Reproduce(args) => reproduce::cli::main(&args).map_err(AppError::from),
            args::Command::Compare(args) => compare(&args),
            args::Command::Study(args) => study(&args),
            args::Command::Clean(args) => clean::clean(&args),
            args::Command::Bench(args) => bench::bench(&args),
            args::Command::Plugin { command } => plugin::plugin(&command),
            args::Command::Sdk { command } => sdk::sdk(&command),
            args::Command::Sweep(args) => sibling::SWEEP.run(&args.arguments),
            args::Command::Export(args) => sibling::EXPORT.run(&args.arguments),
            args::Command::Report(args) => sibling::REPORT.run(&args.arguments),
            args::Command::Sumo(args) => sibling::sumo(&args.arguments),
            args::Command::Import(args) => sibling::import(&args.arguments),
            args::Command::View(args) => sibling::VIEW.run(&args.arguments),
            args::Command::Top(args) => sibling::TOP.run(&args.arguments),
        },
    )
}

/// `cz-world`, the same as `cz world`.
pub fn cz_world() -> ExitCode {
    say_panics_in_a_line("cz-world");
    raise_file_limit();
    finish("cz-world", parts::world(&args::Standalone::<args::WorldArgs>::parse().args, None))
}

/// `cz run --in-process` or `cz world` with a traffic in place of the world's own motion; `arguments` are what stands behind
/// the program's name. Returns the exit code.
pub fn played(arguments: &[String], traffic: Box<dyn Traffic>) -> u8 {
    raise_file_limit();
    let name = traffic.name();
    let own = std::iter::once(name.as_str()).chain(arguments.iter().map(String::as_str));
    let args = match args::Cz::try_parse_from(own) {
        Ok(args) => args,
        Err(error) => {
            let _ = error.print();
            return error.exit_code() as u8;
        }
    };
    let result = match args.command {
        args::Command::Run(args) if args.in_process => run::run(&args, Some(traffic)),
        args::Command::World(args::WorldOrCheck::World(args)) => parts::world(&args, Some(traffic)),
        _ => Err(AppError::Usage("expected `run --in-process` or `world`, with their arguments".to_owned())),
    };
    exit_code(&name, result)
}

/// `cz-coord`, the same as `cz coord`.
pub fn cz_coord() -> ExitCode {
    say_panics_in_a_line("cz-coord");
    raise_file_limit();
    finish("cz-coord", parts::coordinator(&args::Standalone::<args::PartArgs>::parse().args))
}

/// `cz-ctrl`, the same as `cz ctrl`.
pub fn cz_ctrl() -> ExitCode {
    say_panics_in_a_line("cz-ctrl");
    raise_file_limit();
    finish("cz-ctrl", parts::controller(&args::Standalone::<args::PartArgs>::parse().args))
}

/// A program of this project that is not one of the four: says panics and errors in one line, and ends with the exit
/// code they have everywhere.
pub fn program(name: &'static str, main: impl FnOnce() -> Result<(), AppError>) -> ExitCode {
    say_panics_in_a_line(name);
    raise_file_limit();
    finish(name, main())
}

/// Lets this process open as many files as it may: a run with many processes needs more than the usual first bound.
fn raise_file_limit() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let limit = getrlimit(Resource::Nofile);
    let _ = setrlimit(Resource::Nofile, Rlimit { current: limit.maximum, ..limit });
}

fn finish(program: &str, result: Result<(), AppError>) -> ExitCode {
    ExitCode::from(exit_code(program, result))
}

fn exit_code(program: &str, result: Result<(), AppError>) -> u8 {
    match result {
        Ok(()) => 0,
        Err(error) => {
            say::say(format_args!("{program}: {}", error.words()));
            error.exit_code()
        }
    }
}

impl AppError {
    /// The message, in one line whatever characters the input has; but the failure of a run has a line for
    /// each process that has something to say of it.
    fn words(&self) -> String {
        let text = self.to_string();
        match self {
            AppError::Failed(_) => text.split("\n  ").map(printable).collect::<Vec<_>>().join("\n  "),
            _ => printable(&text),
        }
    }
}

/// Writes to stdout; a reader that has gone away is no reason to panic.
pub fn print(text: &str) -> Result<(), AppError> {
    use std::io::{ErrorKind, Write};
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => {
            Err(AppError::Failed(format!("cannot write to stdout: {e}")))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_panic_is_said_in_one_line() {
        let line = super::panic_line("cz", "a \"b\"\nc", "src/x.rs:1:2");
        assert_eq!(line, "cz: internal error, please report it: a \"b\"\\nc (at src/x.rs:1:2)");
    }
}
