//! `cz report`.

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    control_zones::app::program("cz", || cz_export::report::main(&cz_export::report::ReportArgs::parse()))
}
