//! `cz export`.

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    control_zones::app::program("cz", || cz_export::export::main(&cz_export::export::ExportArgs::parse()))
}
