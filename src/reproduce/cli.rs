//! `cz reproduce`: arguments in, tables, files and a progress bar out.

use super::{Only, Options, ReproduceError, markdown, run};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Arguments of `cz reproduce`.
#[derive(Clone, Debug, Args)]
pub struct ReproduceArgs {
    /// Seeds of the random arrivals, at least 2; the SUMO traces are three in any case
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u64).range(2..))]
    pub seeds: u64,
    /// Write report.json, report.md and figures/ into this directory
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Only this part: a label (fig:diff_v, tab:fem_time, tab:feedback1, fig:rate, tab:feedback), errata,
    /// one erratum (lost-square, cubic, delta-t, derivative-display, phi2, alpha-beta, repeated-column,
    /// totals, objectives), sensitivity or optimality; may be repeated
    #[arg(long, value_name = "ID")]
    pub only: Vec<Only>,
    /// Threads; as many as there are cores by default. Results do not depend on it
    #[arg(long, value_name = "J")]
    pub jobs: Option<std::num::NonZeroUsize>,
}

/// Runs the command: tables on standard output, a progress bar on a terminal's standard error.
pub fn main(args: &ReproduceArgs) -> Result<(), ReproduceError> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let options =
        Options { seeds: args.seeds, only: args.only.clone(), jobs: args.jobs.map_or(cores, usize::from) };
    // Hides itself when standard error is no terminal.
    let bar = ProgressBar::new(0).with_style(
        ProgressStyle::with_template("{bar:30} {pos}/{len} simulations, {elapsed} gone, {eta} to go")
            .expect("the template is a constant"),
    );
    let mut progress = |done: usize, total: usize| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    };
    let report = run(&options, &mut progress);
    bar.finish_and_clear();
    let report = report?;
    if let Some(dir) = &args.out {
        report.write(dir)?;
    }
    let text = markdown::terminal(&report);
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        // The reader has seen enough.
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        Err(source) => Err(ReproduceError::Write { path: Path::new("standard output").to_owned(), source }),
        Ok(()) => Ok(()),
    }
}
