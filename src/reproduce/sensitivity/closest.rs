//! The setting that comes closest to the paper's tables.

use super::super::ReproduceError;
use super::super::experiment::{FIXED, Policy, Setting, Traffic};
use super::super::grid::{Grid, number};
use super::super::paper::{COMPARISON, FEASIBILITY};
use super::super::runs::{Outcome, Progress, Run, Runs};
use super::{Closest, demand, entry_speed, seeded};

const COLUMNS: [(&str, Policy); 3] =
    [("feedback", Policy::Feedback), ("fixed 15", FIXED), ("none", Policy::None)];

pub(super) fn cell_runs(setting: &Setting, n: u64) -> Vec<Run> {
    let of = |seed| COLUMNS.map(|(_, p)| setting.replicate(seed).run(Traffic::Constant, p));
    (1..=n).flat_map(of).collect()
}

/// (name, paper, ours): times and energies of `tab:feedback1`, FE counts and times of `tab:fem_time`.
fn cells(runs: &Runs, setting: &Setting, n: u64) -> Vec<(String, f64, f64)> {
    let mean = |p, value: &dyn Fn(&Outcome) -> f64| {
        let of = |seed| value(runs.outcome(&setting.replicate(seed).run(Traffic::Constant, p)));
        (1..=n).map(of).sum::<f64>() / n as f64
    };
    let mut cells = Vec::new();
    for ((name, p), printed) in COLUMNS.into_iter().zip(&COMPARISON.columns) {
        for zone in 0..2 {
            let label = |what: &str| format!("CZ{} {what}, {name}", zone + 1);
            cells.push((
                label("time, s"),
                printed.zones[zone].time_s,
                mean(p, &|o| o.zones[zone].mean_time_s),
            ));
            cells.push((
                label("energy"),
                printed.zones[zone].energy,
                mean(p, &|o| o.zones[zone].mean_energy),
            ));
        }
    }
    for ((name, p), printed) in [("none", Policy::None), ("fixed 15", FIXED)].into_iter().zip(FEASIBILITY) {
        let count = mean(p, &|o| f64::from(o.zones[1].fe_vehicles));
        cells.push((format!("CZ2 FE count, {name}"), printed.fe_vehicles, count));
        cells.push((
            format!("CZ2 FE time, s, {name}"),
            printed.fe_mean_s,
            mean(p, &|o| o.zones[1].fe_mean_s),
        ));
    }
    cells
}

fn deviation(cells: &[(String, f64, f64)]) -> f64 {
    let squares: f64 = cells.iter().map(|(_, paper, ours)| (ours / paper - 1.0).powi(2)).sum();
    (squares / cells.len() as f64).sqrt()
}

/// Bounds of the search: every level that is tried, per choice, our own first.
fn search_levels() -> Vec<Vec<Vec<String>>> {
    let keyed = |key: &str, values: &[&str]| -> Vec<Vec<String>> {
        values.iter().map(|v| vec![format!("{key}={v}")]).collect()
    };
    let mut all: Vec<Vec<Vec<String>>> = vec![
        [14.0, 15.0, 17.0, 18.0, 19.0, 20.0, 21.0, 22.0].map(|v| entry_speed(v).1).into(),
        [0.6, 1.8, 2.4, 3.0].map(|h| demand("min_headway_s", h)).into(),
        keyed("control.k_rear_end_per_s", &["0.25", "0.5", "2.0", "4.0"]),
        keyed("control.k_merge_per_s", &["0.25", "0.5", "2.0", "4.0"]),
        keyed("control.clf_rate_per_s", &["1.0", "100.0"]),
        keyed("control.slack_weight", &["0.05", "10.0"]),
        keyed("control.fe_conditions", &["barrier"]),
        keyed("control.feasibility_rows", &["false"]),
        keyed("control.replan", &["from_state"]),
        keyed("control.reference", &["as_printed"]),
        keyed("dt_s", &["0.05", "0.2"]),
    ];
    for levels in &mut all {
        levels.insert(0, Vec::new());
    }
    all
}

/// What the search found: see [`Closest`].
pub(super) struct Found {
    pub ours: Setting,
    pub setting: Setting,
    pub deviation: (f64, f64),
    pub tried: usize,
}

/// Coordinate search within the bounds: each choice in turn takes its best level, until a whole pass
/// changes nothing or two have been made.
pub(super) fn search(runs: &mut Runs, n: u64, progress: &mut Progress<'_>) -> Result<Found, ReproduceError> {
    let levels = search_levels();
    let mut at = vec![0; levels.len()];
    let setting = |at: &[usize]| {
        seeded(at.iter().zip(&levels).flat_map(|(&level, levels)| levels[level].clone()).collect())
    };
    let mut measure =
        |settings: Vec<Setting>, runs: &mut Runs| -> Result<Vec<(Setting, f64)>, ReproduceError> {
            let settings = Setting::settle(settings, &[Traffic::Constant], n, runs, progress)?;
            runs.perform(settings.iter().flat_map(|s| cell_runs(s, n)), progress)?;
            let measured = |s: Setting| {
                let value = deviation(&cells(runs, &s, n));
                (s, value)
            };
            Ok(settings.into_iter().map(measured).collect())
        };
    let (ours, start) = measure(vec![setting(&at)], runs)?.remove(0);
    let mut found = ours.clone();
    let (mut best, mut tried) = (start, 1);
    for _ in 0..2 {
        let before = at.clone();
        for choice in 0..levels.len() {
            let candidates: Vec<Vec<usize>> = (0..levels[choice].len())
                .filter(|level| *level != at[choice])
                .map(|level| {
                    let mut candidate = at.clone();
                    candidate[choice] = level;
                    candidate
                })
                .collect();
            let measured = measure(candidates.iter().map(|c| setting(c)).collect(), runs)?;
            for (candidate, (setting, value)) in candidates.into_iter().zip(measured) {
                tried += 1;
                if value < best {
                    (best, at, found) = (value, candidate, setting);
                }
            }
        }
        if at == before {
            break;
        }
    }
    Ok(Found { ours, setting: found, deviation: (start, best), tried })
}

pub(super) fn closest_grids(runs: &Runs, closest: &Closest, found: &Found, n: u64) -> Vec<Grid> {
    let mut setting = Grid::new(
        format!(
            "Closest setting of {} tried: root mean square relative deviation over 16 cells {:.1} % (ours {:.1} %)",
            closest.tried,
            100.0 * closest.deviation.1,
            100.0 * closest.deviation.0
        ),
        ["--set on the seeded process"],
    );
    closest.sets.iter().for_each(|s| setting.row([format!("`{s}`").into()]));
    let mut table = Grid::new(
        format!("The cells, means over {n} seeds"),
        ["cell", "paper", "our setting", "closest setting", "deviation of the closest, %"],
    );
    let ours = cells(runs, &found.ours, n);
    for ((name, paper, value), (_, _, own)) in cells(runs, &found.setting, n).into_iter().zip(ours) {
        let off = 100.0 * (value / paper - 1.0);
        table.row([name.into(), number(paper, 2), number(own, 2), number(value, 2), number(off, 0)]);
    }
    let mut claims = Grid::new("The claims under the closest setting", ["claim", "effect", "verdict"]);
    for e in &closest.effects {
        claims.row([e.claim.into(), e.effect.into(), e.verdict.words().into()]);
    }
    vec![setting, table, claims]
}
