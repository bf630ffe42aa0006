//! Every table and figure of the paper, with uncertainty, beside the printed numbers; what holds and what
//! does not; and the paper's errata.
//!
//! [`run`] does it. The parts: [`runs`] executes scenarios on all cores, [`experiment`] says what the
//! paper's experiments are, [`tables`] turns outcomes into its tables, [`claims`] judges its claims,
//! [`errata`], [`sensitivity`] and [`optimality`] are what the paper does not have.

pub mod claims;
pub mod cli;
pub mod equations;
pub mod errata;
pub mod experiment;
pub mod figures;
pub mod grid;
pub mod markdown;
pub mod optimality;
pub mod paper;
pub mod parallel;
pub mod rate;
pub mod runs;
pub mod sensitivity;
pub mod statistics;
pub mod tables;

use crate::scenario::ScenarioError;
use claims::ClaimRow;
use errata::{Erratum, TOPICS};
use experiment::Traffic;
use grid::Grid;
use rate::Curve;
use runs::{Progress, Run, Runs};
use sensitivity::Sensitivity;
use serde::Serialize;
use std::path::{Path, PathBuf};
use tables::{Columns, SweepCurve};

/// What is to be reproduced and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Seeds of the random process, at least 2.
    pub seeds: u64,
    /// Only these parts; all when empty.
    pub only: Vec<Only>,
    /// Threads.
    pub jobs: usize,
}

/// A part of the whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Only {
    /// A table or figure of the paper, by its label.
    Label(&'static str),
    /// All errata.
    Errata,
    /// One erratum.
    Erratum(&'static str),
    /// The unstated choices.
    Sensitivity,
    /// The check by direct transcription.
    Optimality,
}

/// Tables and figures of the paper that are reproduced, in its order.
pub const LABELS: [&str; 5] = ["fig:diff_v", "tab:fem_time", "tab:feedback1", "fig:rate", "tab:feedback"];

impl Only {
    /// Every word `--only` takes.
    pub fn words() -> impl Iterator<Item = &'static str> {
        let rest = ["errata", "sensitivity", "optimality"];
        LABELS.into_iter().chain(rest).chain(TOPICS.iter().map(|t| t.id))
    }
}

impl std::str::FromStr for Only {
    type Err = ReproduceError;

    fn from_str(word: &str) -> Result<Only, ReproduceError> {
        if let Some(label) = LABELS.into_iter().find(|l| *l == word) {
            return Ok(Only::Label(label));
        }
        if let Some(topic) = TOPICS.iter().find(|t| t.id == word) {
            return Ok(Only::Erratum(topic.id));
        }
        match word {
            "errata" => Ok(Only::Errata),
            "sensitivity" => Ok(Only::Sensitivity),
            "optimality" => Ok(Only::Optimality),
            _ => Err(ReproduceError::UnknownPart {
                part: word.to_owned(),
                known: Only::words().collect::<Vec<_>>().join(", "),
            }),
        }
    }
}

/// Why the reproduction failed.
#[derive(Debug, thiserror::Error)]
pub enum ReproduceError {
    /// `--only` names nothing.
    #[error("unknown part {part:?}; expected one of {known}")]
    UnknownPart {
        /// What was named.
        part: String,
        /// What there is.
        known: String,
    },
    /// No interval comes from a single seed.
    #[error("--seeds {0}: at least 2 are needed for an interval")]
    TooFewSeeds(u64),
    /// A scenario does not load.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// A run failed.
    #[error("{command}: {error}")]
    Run {
        /// The run.
        command: String,
        /// What went wrong.
        error: String,
    },
    /// Clarabel found no solution of Problem 1.
    #[error("direct transcription of Problem 1: no solution found")]
    Transcription,
    /// A figure cannot be drawn.
    #[error("{}: {error}", path.display())]
    Figure {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        error: String,
    },
    /// A file cannot be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        source: std::io::Error,
    },
}

/// The report's format, the first key of its JSON.
pub const FORMAT: &str = "cz.reproduce.v1";

/// Everything found. Its JSON depends on the options and the program only, not on time, machine load or
/// number of threads.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// [`FORMAT`].
    pub format: &'static str,
    /// Seeds of the random process.
    pub seeds: u64,
    /// Simulations behind it.
    pub simulations: usize,
    /// Claims with their verdicts.
    pub claims: Vec<ClaimRow>,
    /// Tables by the label they belong to.
    pub tables: Vec<(&'static str, Vec<Grid>)>,
    /// Curves of `fig:diff_v`.
    pub sweep: Vec<SweepCurve>,
    /// Curves of `fig:rate`, by what was pooled.
    pub rate: Vec<(String, Vec<Curve>)>,
    /// Errata.
    pub errata: Vec<Erratum>,
    /// Optimality checks.
    pub optimality: Vec<optimality::Check>,
    /// The unstated choices.
    pub sensitivity: Option<Sensitivity>,
}

/// Reproduces what the options ask for. `progress` is told how many simulations are done, of how many
/// known so far.
pub fn run(options: &Options, progress: &mut Progress<'_>) -> Result<Report, ReproduceError> {
    if options.seeds < 2 {
        return Err(ReproduceError::TooFewSeeds(options.seeds));
    }
    let seeds = options.seeds;
    let all = options.only.is_empty();
    let has = |part: Only| all || options.only.contains(&part);
    let labels: Vec<&'static str> = LABELS.into_iter().filter(|l| has(Only::Label(l))).collect();
    let topics: Vec<_> = TOPICS.iter().filter(|t| has(Only::Errata) || has(Only::Erratum(t.id))).collect();

    let mut runs = Runs::new(options.jobs);
    let traffics: Vec<Traffic> = labels.iter().flat_map(|l| traffics_of(l)).copied().collect();
    let columns = Columns::settle(&traffics, seeds, &mut runs, progress)?;
    runs.perform(topics.iter().flat_map(|t| t.baselines()), progress)?;
    let mut wanted: Vec<Run> = labels.iter().flat_map(|l| runs_of(l, &columns)).collect();
    wanted.extend(topics.iter().flat_map(|t| t.runs(&runs)));
    runs.perform(wanted, progress)?;
    let sensitivity =
        if has(Only::Sensitivity) { Some(sensitivity::analyse(&mut runs, seeds, progress)?) } else { None };
    let optimality = if has(Only::Optimality) { optimality::checks()? } else { Vec::new() };

    let mut report = Report {
        format: FORMAT,
        seeds,
        simulations: runs.len(),
        claims: labels.iter().flat_map(|l| tables::judge_claims(l, &runs, &columns)).collect(),
        tables: Vec::new(),
        sweep: Vec::new(),
        rate: Vec::new(),
        errata: topics.iter().map(|t| t.erratum(&runs)).collect(),
        optimality,
        sensitivity,
    };
    for label in labels {
        let grids = match label {
            "fig:diff_v" => {
                report.sweep = tables::sweep_curves(&runs, &columns);
                tables::sweep_grids(&report.sweep, &runs, &columns)
            }
            "tab:fem_time" => tables::feasibility(&runs, &columns),
            "tab:feedback1" => tables::performance(Traffic::Constant, &runs, &columns),
            "fig:rate" => {
                report.rate = tables::rate_curves(&runs, &columns);
                vec![tables::rate_grid(&runs, &columns)]
            }
            _ => tables::performance(Traffic::Varying, &runs, &columns),
        };
        report.tables.push((label, grids));
    }
    Ok(report)
}

/// Kinds of traffic a table or figure and its claims are about.
fn traffics_of(label: &str) -> &'static [Traffic] {
    match label {
        "fig:rate" | "tab:feedback" => &[Traffic::Varying],
        _ => &[Traffic::Constant],
    }
}

/// The runs a table or figure and its claims need.
fn runs_of(label: &str, columns: &Columns) -> Vec<Run> {
    let mut runs = tables::claim_runs(label, columns);
    runs.extend(match label {
        "fig:diff_v" => tables::sweep_runs(columns),
        "tab:fem_time" => tables::feasibility_runs(columns),
        "tab:feedback1" => tables::performance_runs(Traffic::Constant, columns),
        _ => tables::performance_runs(Traffic::Varying, columns),
    });
    runs
}

impl Report {
    /// The report as JSON, byte for byte the same for the same options.
    pub fn json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("a report has string keys only");
        text.push('\n');
        text
    }

    /// Names of the figures, with their captions.
    pub fn figures(&self) -> Vec<(String, String)> {
        let sweep = self.sweep.iter().enumerate().map(|(i, c)| {
            (SWEEP_FIGURES[i].to_owned(), format!("fig:diff_v: objectives under fixed v_m1, {}", c.variant))
        });
        let rate = self.rate.iter().enumerate().map(|(i, (title, _))| {
            (RATE_FIGURES[i].to_owned(), format!("fig:rate: objective over time, {title}"))
        });
        sweep.chain(rate).collect()
    }

    /// Writes `report.json`, `report.md` and `figures/` into a directory, making it if need be.
    pub fn write(&self, dir: &Path) -> Result<(), ReproduceError> {
        let figures = dir.join("figures");
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| ReproduceError::Write { path, source }
        };
        std::fs::create_dir_all(&figures).map_err(failed(&figures))?;
        for (name, text) in [("report.json", self.json()), ("report.md", markdown::report(self))] {
            let path = dir.join(name);
            std::fs::write(&path, text).map_err(failed(&path))?;
        }
        for (curve, name) in self.sweep.iter().zip(SWEEP_FIGURES) {
            figures::sweep(&figures, name, curve)?;
        }
        for ((title, curves), name) in self.rate.iter().zip(RATE_FIGURES) {
            figures::rate(&figures, name, title, curves)?;
        }
        Ok(())
    }
}

/// File names, in the order of [`experiment::Variant::ALL`].
const SWEEP_FIGURES: [&str; 4] =
    ["diff_v-seeded", "diff_v-traces", "diff_v-seeded-as-printed", "diff_v-traces-as-printed"];
/// File names, in the order of [`tables::rate_curves`].
const RATE_FIGURES: [&str; 3] = ["rate-seeded", "rate-traces", "rate-trace1"];
