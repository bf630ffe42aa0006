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
