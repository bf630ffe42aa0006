//! Commands that are programs of their own: `cz view` is `cz-view`, beside `cz`, as with git and cargo. What they
//! need of other people's crates is not in the runtime.

use super::AppError;
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A program beside `cz`, and the package of this workspace that has it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sibling {
    pub program: &'static str,
    pub package: &'static str,
}

/// `cz view`.
pub(super) const VIEW: Sibling = Sibling { program: "cz-view", package: "cz-view" };
/// `cz top`.
pub(super) const TOP: Sibling = Sibling { program: "cz-top", package: "cz-view" };
/// `cz export`.
pub(super) const EXPORT: Sibling = Sibling { program: "cz-export", package: "cz-export" };
/// `cz sweep`.
pub(super) const SWEEP: Sibling = Sibling { program: "cz-sweep", package: "cz-sweep" };
/// `cz report`.
pub(super) const REPORT: Sibling = Sibling { program: "cz-report", package: "cz-export" };

/// What a Python runs for `cz sumo`; a package that is missing is named in a line.
const SUMO_SCRIPT: &str = "import sys\n\
    try:\n    from control_zones import Error, sumo\n\
    except ImportError:\n    sys.exit(f'cz sumo: {sys.executable} has no package control-zones with SUMO; '\n\
    \x20       \"pip install 'control-zones[sumo]', or name another Python in CZ_PYTHON\")\n\
    try:\n    from control_zones.sumo.command import main\n\
    except Error as error:\n    sys.exit(f'cz sumo: {error}')\n\
    sys.exit(main())";

/// `cz sumo`, which is in the Python package: becomes `cz-sumo` beside this program, where the package has put it, or a
/// Python.
pub(super) fn sumo(arguments: &[OsString]) -> Result<(), AppError> {
    let beside =
        std::env::current_exe().ok().map(|own| own.with_file_name("cz-sumo")).filter(|p| p.is_file());
    let mut command = match beside {
        Some(program) => Command::new(program),
        None => {
            let mut command = Command::new(std::env::var_os("CZ_PYTHON").unwrap_or_else(|| "python3".into()));
            command.args(["-c", SUMO_SCRIPT]);
            command
        }
    };
    // It may have runs to start itself.
    command.envs(std::env::current_exe().ok().map(|own| ("CZ_PROGRAM", own)));
    let error = command.args(arguments).exec();
    Err(AppError::Usage(format!("cannot start a Python for cz sumo: {error}")))
}

/// `cz import sumo NET`: `cz sumo import NET`.
pub(super) fn import(arguments: &[OsString]) -> Result<(), AppError> {
    match arguments.split_first() {
        Some((format, rest)) if format == "sumo" => {
            let own: Vec<OsString> = std::iter::once("import".into()).chain(rest.iter().cloned()).collect();
            sumo(&own)
        }
        _ => Err(AppError::Usage("expected `cz import sumo NET.xml`".to_owned())),
    }
}

impl Sibling {
    /// Becomes that program; returns only why it cannot.
    pub fn run(self, arguments: &[OsString]) -> Result<(), AppError> {
        let mut command = self.command()?;
        let error = command.args(arguments).exec();
        Err(AppError::Failed(format!("cannot start {}: {error}", self.program)))
    }

    fn command(self) -> Result<Command, AppError> {
        // Where cargo has started us it knows whether the sibling is there and up to date, and we do not.
        if let Some(cargo) = std::env::var_os("CARGO").filter(|_| is_run_by_cargo()) {
            let mut command = Command::new(cargo);
            command.args(["run", "--manifest-path"]).arg(manifest());
            command.args((!cfg!(debug_assertions)).then_some("--release"));
            // Not by package: the default members have the same features as when `cz` was built, so only what is new is.
            command.args(["--bin", self.program, "--"]);
            return Ok(command);
        }
        let own = std::env::current_exe().map_err(|error| {
            AppError::Failed(format!("cannot find {}, which is beside this program: {error}", self.program))
        })?;
        let path = own.with_file_name(self.program);
        if !path.is_file() {
            let (path, package) = (path.display(), self.package);
            return Err(AppError::Usage(format!(
                "{path} is not there; `cargo build --release --package {package}` builds it"
            )));
        }
        Ok(Command::new(path))
    }
}

fn manifest() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml")
}

/// Whether `cargo run` has started this program from its own sources.
fn is_run_by_cargo() -> bool {
    std::env::var_os("CARGO_MANIFEST_DIR")
        .is_some_and(|root| Path::new(&root) == Path::new(env!("CARGO_MANIFEST_DIR")))
}
