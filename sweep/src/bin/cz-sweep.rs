//! `cz sweep`.

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    control_zones::app::program("cz", || cz_sweep::cli::main(&cz_sweep::cli::SweepArgs::parse()))
}
