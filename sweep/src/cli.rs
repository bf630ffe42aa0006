//! `cz sweep`: arguments in, a table and a progress bar out.

use crate::outcome::Outcome;
use crate::plan::{Done, Planned, Sweep};
use crate::table;
use crate::workers::{Request, Workers, work};
use clap::Parser;
use control_zones::app::{AppError, print};
use control_zones::compare::cache::{Cache, own_build};
use control_zones::compare::cli::{Seeds, bar};
use std::path::PathBuf;
use std::time::Duration;

/// Run policies by scenarios by seeds, on all cores, into one Parquet table.
#[derive(Clone, Debug, Parser)]
#[command(name = "cz sweep", version, after_help = after_help())]
pub struct SweepArgs {
    /// Policies, as for cz compare
    #[arg(required_unless_present = "worker")]
    pub policies: Vec<String>,
    /// Scenario: a TOML file, or an embedded one; may be repeated
    #[arg(long, value_name = "S")]
    pub scenario: Vec<String>,
    /// Seeds: how many, from 1, or a range as in 4-23; 20 by default
    #[arg(long, value_name = "N|A-B")]
    pub seeds: Option<Seeds>,
    /// Change a scenario key under all policies; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// The directory for sweep.parquet and, unless told otherwise, what is kept of the runs
    #[arg(long, value_name = "DIR", default_value = "sweep")]
    pub out: PathBuf,
    /// Keep outcomes in this directory, and take from it what is there; DIR/runs by default
    #[arg(long, value_name = "DIR")]
    pub cache: Option<PathBuf>,
    /// Worker processes; as many as there are cores by default. The table does not depend on it
    #[arg(long, value_name = "J")]
    pub jobs: Option<std::num::NonZeroUsize>,
    /// How often a run that failed is tried again
    #[arg(long, value_name = "R", default_value_t = 2)]
    pub retries: u32,
    /// How long a run may take, s
    #[arg(long, value_name = "S", default_value_t = 600)]
    pub run_timeout: u64,
    /// Do nothing but list the runs that are not kept, as requests for workers elsewhere
    #[arg(long, conflicts_with = "worker")]
    pub missing: bool,
    /// Do the runs that standard input asks for
    #[arg(long, hide = true)]
    pub worker: bool,
}

fn after_help() -> String {
    format!("Policies: {}.", control_zones::compare::policy::known())
}

/// Runs the command.
///
/// # Errors
/// When an argument is no good, a file cannot be written, or a run has failed for good; the table is there then.
pub fn main(args: &SweepArgs) -> Result<(), AppError> {
    if args.worker {
        let build = format!("{:016x}", own_build()?);
        return work(&build).map_err(|error| AppError::Failed(format!("worker: {error}")));
    }
    let sweep = Sweep {
        policies: args.policies.clone(),
        scenarios: args.scenario.clone(),
        seeds: args.seeds.unwrap_or(Seeds { from: 1, to: 20 }).all(),
        sets: args.set.clone(),
    };
    let cache = Cache::at(&args.cache.clone().unwrap_or_else(|| args.out.join("runs")))?;
    if args.missing {
        let planned = sweep.plan(&cache)?;
        let lines = planned.missing(&cache).into_iter().map(|wanted| {
            let request = Request::new(wanted, &cache);
            serde_json::to_string(&request).expect("it is made of texts") + "\n"
        });
        return print(&lines.collect::<String>());
    }
    let program = std::env::current_exe()
        .map_err(|error| AppError::Failed(format!("cannot find this program: {error}")))?;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let workers = Workers {
        program,
        jobs: args.jobs.map_or(cores, usize::from),
        retries: args.retries,
        patience: Duration::from_secs(args.run_timeout),
    };
    let (planned, done) = perform(&sweep, &workers, &cache)?;
    let path = args.out.join("sweep.parquet");
    table::write(&path, &planned.runs, &done).map_err(|error| AppError::Failed(error.to_string()))?;
    let failed: Vec<String> = planned
        .runs
        .iter()
        .filter_map(|run| Some(format!("{}: {}", run.name(), done.failures.get(&run.hash)?)))
        .collect();
    print(&format!("{}: {} runs, {} failed\n", path.display(), planned.runs.len(), failed.len()))?;
    match failed.first() {
        None => Ok(()),
        Some(first) => {
            let count = failed.len();
            Err(AppError::Failed(format!("{count} runs failed, the first: {first}")))
        }
    }
}

/// Does what is missing, and gathers all of it.
fn perform(sweep: &Sweep, workers: &Workers, cache: &Cache) -> Result<(Planned, Done), AppError> {
    let mut done = Done::default();
    let bar = bar();
    loop {
        let planned = sweep.plan(cache)?;
        let missing: Vec<_> =
            planned.missing(cache).into_iter().filter(|run| !done.failures.contains_key(&run.hash)).collect();
        if missing.is_empty() {
            bar.finish_and_clear();
            if !planned.all {
                let why = done.failures.values().next().cloned().unwrap_or_default();
                let what = "runs without flow control, which others are made of, failed, the first";
                return Err(AppError::Failed(format!("{what}: {why}")));
            }
            let kept = |run: &crate::plan::Wanted| Some((run.hash, run.outcome(cache)?));
            let kept: Vec<(u64, Outcome)> = planned.runs.iter().filter_map(kept).collect();
            done.outcomes.extend(kept);
            return Ok((planned, done));
        }
        let before = planned.runs.len().saturating_sub(missing.len());
        bar.set_length(planned.runs.len() as u64);
        bar.set_position(before as u64);
        workers.perform(&missing, cache, &mut done, |count| bar.set_position((before + count) as u64));
    }
}
