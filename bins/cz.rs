//! The `cz` program: run, plan, and the parts of a run.

use std::process::ExitCode;

fn main() -> ExitCode {
    control_zones::app::cz()
}
