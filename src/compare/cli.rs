//! `cz compare`: arguments in, tables, files and a progress bar out.

use super::cache::Cache;
use super::report::{FORMAT, Report};
use super::{CompareError, Comparison, Means, policy, run, tables};
use crate::reproduce::ReproduceError;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;

/// Arguments of `cz compare`.
#[derive(Clone, Debug, Args)]
#[command(after_help = after_help())]
pub struct CompareArgs {
    /// Policies, the first the one that the others are compared with
    #[arg(required_unless_present = "table")]
    pub policies: Vec<String>,
    /// A comparison of docs/control.md in place of policies, scenario and seeds
    #[arg(long, value_name = "NAME", conflicts_with_all = ["policies", "scenario", "set"], value_parser = clap::builder::PossibleValuesParser::new(tables::names()))]
    pub table: Option<String>,
    /// Scenario: a TOML file, or an embedded one
    #[arg(long, value_name = "S")]
    pub scenario: Option<String>,
    /// Seeds: how many, from 1, or a range as in 4-23; 20 by default
    #[arg(long, value_name = "N|A-B")]
    pub seeds: Option<Seeds>,
    /// Change a scenario key under all policies; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Seek the centralised optimum as well, for the order in which the vehicles of this one of the policies pass, where
    /// the network has merges only
    #[arg(long, value_name = "POLICY", conflicts_with = "table")]
    pub joint: Option<String>,
    /// What it may cost, and where results go
    #[command(flatten)]
    pub lab: LabArgs,
}

/// What many runs may cost, and where their results go.
#[derive(Clone, Debug, Args)]
pub struct LabArgs {
    /// Keep results of runs in this directory, and take from it what is there
    #[arg(long, value_name = "DIR")]
    pub cache: Option<PathBuf>,
    /// Write the results (JSON, Markdown) and figures (SVG, PNG) into this directory
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write the JSON to standard output in place of the tables
    #[arg(long)]
    pub json: bool,
    /// Threads; as many as there are cores by default. Results do not depend on it
    #[arg(long, value_name = "J")]
    pub jobs: Option<std::num::NonZeroUsize>,
}

impl LabArgs {
    /// Threads and cache; the directory of the results is made.
    pub(super) fn means(&self) -> Result<Means, CompareError> {
        // Hours of work are not to be lost to a directory that cannot be.
        if let Some(out) = &self.out {
            let failed = |source| ReproduceError::Write { path: out.clone(), source };
            std::fs::create_dir_all(out).map_err(failed)?;
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let cache = self.cache.as_deref().map_or(Ok(Cache::none()), Cache::at)?;
        Ok(Means { jobs: self.jobs.map_or(cores, usize::from), cache })
    }
}

/// Seeds of the replicates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seeds {
    /// First.
    pub from: u64,
    /// Last.
    pub to: u64,
}

impl Seeds {
    /// All of them.
    pub fn all(self) -> Vec<u64> {
        (self.from..=self.to).collect()
    }
}

/// More replicates than anybody waits for.
const MOST: u64 = 100_000;

impl std::str::FromStr for Seeds {
    type Err = String;

    fn from_str(text: &str) -> Result<Seeds, String> {
        let number = |text: &str| text.trim().parse::<u64>().ok();
        let seeds = match text.split_once('-') {
            Some((from, to)) => number(from).zip(number(to)),
            None => number(text).map(|n| (1, n)),
        };
        let fits = |&(from, to): &(u64, u64)| from <= to && to - from < MOST;
        let (from, to) = seeds
            .filter(fits)
            .ok_or_else(|| format!("expected a number from 1 to {MOST}, or a range such as 4-23"))?;
        Ok(Seeds { from, to })
    }
}

fn after_help() -> String {
    format!("Policies: {}.\nTables: {}.", policy::known(), tables::names().collect::<Vec<_>>().join(", "))
}

/// Shows how much is done.
pub fn bar() -> ProgressBar {
    ProgressBar::new(0).with_style(
        ProgressStyle::with_template("{msg} {bar:30} {pos}/{len}, {elapsed} gone, {eta} to go")
            .expect("the template is a constant"),
    )
}

/// Runs the command and returns what goes to standard output; a progress bar is on a terminal's standard error.
pub fn main(args: &CompareArgs) -> Result<String, CompareError> {
    let means = args.lab.means()?;
    let comparisons = match &args.table {
        Some(name) => tables::comparisons(name, args.seeds),
        None => vec![Comparison {
            policies: args.policies.clone(),
            scenario: args.scenario.clone(),
            seeds: args.seeds.unwrap_or(Seeds { from: 1, to: 20 }).all(),
            sets: args.set.clone(),
            joint: args.joint.clone(),
        }],
    };
    let bar = bar();
    let mut blocks = Vec::new();
    for comparison in &comparisons {
        let scenario = comparison.scenario.clone().unwrap_or_default();
        blocks.push(run(comparison, &means, &mut |work, done, total| {
            bar.set_message(format!("{scenario} {}", work.name()));
            bar.set_length(total as u64);
            bar.set_position(done as u64);
        })?);
    }
    bar.finish_and_clear();
    let report = Report { format: FORMAT, blocks };
    if let Some(directory) = &args.lab.out {
        report.write(directory)?;
    }
    Ok(if args.lab.json { report.json() } else { report.terminal() })
}
