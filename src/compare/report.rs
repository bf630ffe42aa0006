//! Comparisons as tables and JSON.

use super::measure::{ENERGY, MEASURES, PER_VEHICLE, Pool, Pooled, Row, TIME, TOTAL, pool};
use super::policy::Policy;
use super::{CompareError, Comparison, figure};
use crate::reproduce::ReproduceError;
use crate::reproduce::grid::{Entry, Grid, number};
use crate::reproduce::statistics::Interval;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// The report's format, the first key of its JSON.
pub const FORMAT: &str = "cz.compare.v1";

/// One comparison's results.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Block {
    /// Scenario as it was named.
    pub scenario: String,
    /// The command that makes it.
    pub command: String,
    /// Replicates.
    pub seeds: Vec<u64>,
    /// The paper's terminal speed of zones that lead out, m/s; absent when no policy has it.
    pub exit_mps: Option<f64>,
    /// Per policy, in the order they were named.
    pub policies: Vec<PolicyResult>,
}

/// What one policy showed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PolicyResult {
    /// As it was named.
    pub name: String,
    /// What it is.
    pub about: String,
    /// `--set`s of each of its members.
    pub members: Vec<Vec<String>>,
    /// Which member was taken, per replicate.
    pub taken: Vec<usize>,
    /// Mean cost per zone, by name.
    pub zones: Vec<(String, Pooled)>,
    /// Mean exposure per vehicle and zone, m s, by name.
    pub exposures: Vec<(String, Pooled)>,
    /// By the measures' short names.
    pub measures: BTreeMap<&'static str, Pooled>,
    /// Paired differences to the first policy; none for the first.
    pub differences: Vec<Difference>,
}

/// A paired difference to the first policy.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// The measure's short name, or `exposure ZONE`.
    pub measure: String,
    /// Of the values.
    pub absolute: Option<Interval>,
    /// Of the values, in % of the first policy's.
    pub percent: Option<Interval>,
}

impl Block {
    /// The results of the runs, a list of replicates for each policy.
    pub fn new(comparison: &Comparison, policies: &[Policy], exit_mps: f64, rows: &[Vec<Row>]) -> Block {
        let scenario =
            comparison.scenario.clone().unwrap_or_else(|| crate::scenario::DEFAULT_SCENARIO.into());
        let results = policies.iter().zip(rows).map(|(policy, own)| result(policy, own, &rows[0]));
        let mut results: Vec<PolicyResult> = results.collect();
        results[0].differences.clear();
        let uses_exit = policies.iter().flat_map(|p| &p.members).any(|m| !m.measured.is_empty());
        Block {
            scenario,
            command: comparison.command(),
            seeds: comparison.seeds.clone(),
            exit_mps: uses_exit.then_some(exit_mps),
            policies: results,
        }
    }

    /// What decides between policies, a row each.
    pub fn summary(&self) -> Grid {
        let mut grid = Grid::new(
            format!("{}, {} replicates", self.scenario, self.seeds.len()),
            [
                "policy",
                "total",
                "change, %",
                "exposure, m·s",
                "wait, s",
                "infeasible",
                "overlapping pairs",
                "least margin of the viable, m",
                "/ alone",
                "/ merging",
                "/ optimum",
            ],
        );
        for policy in &self.policies {
            let pooled = |id: &str| policy.measures[id].pooled;
            let shown =
                |value: Option<f64>, decimals| value.map_or(Entry::Empty(()), |v| number(v, decimals));
            let change = policy.differences.iter().find(|d| d.measure == TOTAL.id).and_then(|d| d.percent);
            let margins = [pooled("least_safe_rear_end_m"), pooled("least_safe_merge_m")];
            let exposures = policy.exposures.iter().take(4);
            let exposures: Vec<String> =
                exposures.map(|(_, p)| p.pooled.map_or("–".into(), |e| format!("{e:.2}"))).collect();
            grid.row([
                format!("`{}`", policy.name).into(),
                shown(pooled(TOTAL.id), 2),
                change.map_or(Entry::Empty(()), |i| format!("{:+.1} ± {:.1}", i.mean, i.half_width()).into()),
                exposures.join(" / ").into(),
                shown(pooled("wait_s"), 2),
                shown(pooled("infeasible"), 0),
                shown(pooled("overlap_pairs"), 0),
                shown(margins.into_iter().flatten().min_by(f64::total_cmp), 3),
                shown(pooled("of_alone"), 3),
                shown(pooled("of_merging"), 3),
                shown(pooled("of_joint"), 3),
            ]);
        }
        grid
    }

    /// Everything that is told of each policy: a row per measure, a column per policy.
    pub fn values(&self) -> Grid {
        let columns = ["measure".to_owned()].into_iter().chain(self.policies.iter().map(|p| p.name.clone()));
        let mut grid = Grid::new(
            format!("{}, {} replicates: means ± 95 %, or as said", self.scenario, self.seeds.len()),
            columns,
        );
        let entry = |pooled: &Pooled, decimals: usize| match (&pooled.interval, pooled.pooled) {
            (Some(i), _) => Entry::from(format!("{:.decimals$} ± {:.decimals$}", i.mean, i.half_width())),
            (None, Some(value)) => number(value, decimals),
            (None, None) => Entry::Empty(()),
        };
        let mut row = |name: String, decimals, of: &dyn Fn(&PolicyResult) -> Option<Pooled>| {
            let cells: Vec<Entry> = self
                .policies
                .iter()
                .map(|p| of(p).map_or(Entry::Empty(()), |pooled| entry(&pooled, decimals)))
                .collect();
            if cells.iter().any(|cell| !matches!(cell, Entry::Empty(()))) {
                grid.row([name.into()].into_iter().chain(cells));
            }
        };
        for (at, measure) in MEASURES.iter().enumerate() {
            row(measure.label(), measure.decimals, &|p| p.measures.get(measure.id).cloned());
            if at > 0 {
                continue;
            }
            // Of networks with many zones the JSON tells of each.
            for zone in 0..self.policies[0].zones.len().min(4) {
                let name = format!("cost in {}", self.policies[0].zones[zone].0);
                row(name, 3, &|p| p.zones.get(zone).map(|(_, pooled)| pooled.clone()));
            }
            for zone in 0..self.policies[0].exposures.len().min(4) {
                let name = format!("exposure per vehicle in {}, m·s", self.policies[0].exposures[zone].0);
                row(name, 3, &|p| p.exposures.get(zone).map(|(_, pooled)| pooled.clone()));
            }
        }
        grid
    }

    /// Paired differences to the first policy.
    pub fn differences(&self) -> Grid {
        let first = &self.policies[0];
        let mut grid = Grid::new(
            format!("{}: paired differences to {} on the same arrivals ± 95 %", self.scenario, first.name),
            ["policy", "total, %", "total", "per vehicle, %", "time, s", "energy, m²/s³", "exposure, m·s"],
        );
        for policy in &self.policies[1..] {
            let of = |id: &str| policy.differences.iter().find(|d| d.measure == id);
            let percent = |id: &str| -> Entry { of(id).and_then(|d| d.percent).into() };
            let absolute = |id: &str| -> Entry { of(id).and_then(|d| d.absolute).into() };
            grid.row([
                policy.name.as_str().into(),
                percent(TOTAL.id),
                absolute(TOTAL.id),
                percent(PER_VEHICLE.id),
                absolute(TIME.id),
                absolute(ENERGY.id),
                absolute("exposure"),
            ]);
        }
        grid
    }

    /// What the policies are.
    pub fn legend(&self) -> String {
        let mut text = String::new();
        for policy in &self.policies {
            let _ = writeln!(text, "- `{}`: {}", policy.name, policy.about);
        }
        if let Some(exit_mps) = self.exit_mps {
            let _ = writeln!(
                text,
                "- terminal speed of zones that lead out under flow control: {exit_mps:.1} m/s, the mean exit speed without"
            );
        }
        text
    }

    /// As Markdown.
    pub fn markdown(&self) -> String {
        let mut text = format!("    {}\n\n{}\n", self.command, self.legend());
        for grid in self.grids() {
            let _ = writeln!(text, "{}", grid.markdown());
        }
        text
    }

    /// Its tables.
    pub fn grids(&self) -> Vec<Grid> {
        let mut grids = vec![self.values()];
        if self.policies.len() > 1 {
            grids.push(self.differences());
        }
        grids.push(self.summary());
        grids
    }
}

fn result(policy: &Policy, own: &[Row], first: &[Row]) -> PolicyResult {
    let over = |of: &dyn Fn(&Row) -> Option<f64>, how| pool(own.iter().map(of).collect(), how);
    let names: Vec<String> = own[0].sample.zones.iter().map(|zone| zone.name.clone()).collect();
    let per_zone = |of: &dyn Fn(&Row, usize) -> Option<f64>| -> Vec<(String, Pooled)> {
        let zone = |(at, name): (usize, &String)| (name.clone(), over(&|row| of(row, at), Pool::Mean));
        names.iter().enumerate().map(zone).collect()
    };
    let complete = |row: &Row, value: f64| row.sample.complete.then_some(value);
    let pair = |name: &str, of: &dyn Fn(&Row) -> Option<f64>| {
        let pairs = own.iter().zip(first).map(|(a, b)| Some((of(a)?, of(b)?)));
        let pairs: Option<Vec<(f64, f64)>> = pairs.collect();
        let interval =
            |of: fn(&(f64, f64)) -> f64| Interval::of(&pairs.as_ref()?.iter().map(of).collect::<Vec<f64>>());
        Difference {
            measure: name.to_owned(),
            absolute: interval(|(a, b)| a - b),
            percent: interval(|(a, b)| 100.0 * (a - b) / b),
        }
    };
    let exposure = |zone: usize| move |row: &Row| Some(row.sample.zones[zone].exposure_ms);
    let mut differences: Vec<Difference> = MEASURES.iter().map(|m| pair(m.id, &|row| m.value(row))).collect();
    differences
        .extend(names.iter().enumerate().map(|(at, name)| pair(&format!("exposure {name}"), &exposure(at))));
    PolicyResult {
        name: policy.name.clone(),
        about: policy.about.clone(),
        members: policy.members.iter().map(|m| m.sets.clone()).collect(),
        taken: own.iter().map(|row| row.member).collect(),
        zones: per_zone(&|row, zone| complete(row, row.sample.zone_costs()[zone])),
        exposures: per_zone(&|row, zone| Some(row.sample.zones[zone].exposure_ms)),
        measures: MEASURES.iter().map(|m| (m.id, over(&|row| m.value(row), m.pool))).collect(),
        differences,
    }
}

/// All blocks of a command.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// [`FORMAT`].
    pub format: &'static str,
    /// Comparisons.
    pub blocks: Vec<Block>,
}

impl Report {
    /// As JSON, the same for the same program and arguments.
    pub fn json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a report has string keys only") + "\n"
    }

    /// For a terminal.
    pub fn terminal(&self) -> String {
        let mut text = String::new();
        for block in &self.blocks {
            let _ = write!(text, "{}\n{}\n", block.command, block.legend());
            block.grids().iter().for_each(|grid| {
                let _ = writeln!(text, "{}", grid.terminal());
            });
        }
        text
    }

    /// Writes `compare.json`, `compare.md`, and a Pareto plot per comparison into a directory, making it if need be.
    pub fn write(&self, directory: &Path) -> Result<(), CompareError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| ReproduceError::Write { path, source }
        };
        std::fs::create_dir_all(directory).map_err(failed(directory))?;
        let mut text = String::new();
        for (at, block) in self.blocks.iter().enumerate() {
            let name = figure_name(at, block);
            let _ =
                write!(text, "{}![{}: time and energy]({name}.svg)\n\n", block.markdown(), block.scenario);
            figure::pareto(directory, &name, block)?;
        }
        for (name, text) in [("compare.json", self.json()), ("compare.md", text)] {
            let path = directory.join(name);
            std::fs::write(&path, text).map_err(failed(&path))?;
        }
        Ok(())
    }
}

/// File name of a block's plot: scenarios may be paths, and one may occur twice.
fn figure_name(at: usize, block: &Block) -> String {
    let stem =
        Path::new(&block.scenario).file_stem().map_or_else(String::new, |s| s.to_string_lossy().into());
    format!("pareto-{}-{stem}", at + 1)
}
