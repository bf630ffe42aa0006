//! `cz reproduce` as an example, until the command line carries it.

use clap::Parser;
use control_zones::reproduce::cli::{self, ReproduceArgs};

#[derive(Parser)]
struct Cli {
    #[command(flatten)]
    args: ReproduceArgs,
}

fn main() -> Result<(), control_zones::reproduce::ReproduceError> {
    cli::main(&Cli::parse().args)
}
