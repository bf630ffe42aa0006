//! A vehicle-controller pool of a run.

use std::process::ExitCode;

fn main() -> ExitCode {
    control_zones::app::cz_ctrl()
}
