//! Numbers in tables that contradict each other or the text.

use super::super::experiment::{Demand, FIXED, Policy, Replicate, Setting, Traffic};
use super::super::grid::{Entry, Grid, number};
use super::super::paper::{self, COMPARISON, VARYING, alpha_of, beta_of};
use super::super::runs::{Run, Runs};
use super::super::statistics::Interval;
use super::BETA;

const BETA_OF_ALPHA: &str = "objective={ alpha = 0.0625 }";
const POLICIES: [(&str, Policy); 3] =
    [("feedback", Policy::Feedback), ("fixed 15", FIXED), ("none", Policy::None)];

const TRAFFICS: [Traffic; 2] = [Traffic::Constant, Traffic::Varying];

/// The SUMO traces under the weight the tables imply, and under the stated one.
fn settings() -> [Setting; 2] {
    [vec![], vec![BETA_OF_ALPHA.to_owned()]].map(|sets| Setting::new(Demand::Traces, sets))
}

fn measured(runs: &Runs) -> [Setting; 2] {
    settings().map(|s| s.measured(&TRAFFICS, 0, runs))
}

fn replicates(setting: &Setting) -> impl Iterator<Item = Replicate<'_>> {
    Demand::Traces.seeds(0).map(|seed| setting.replicate(seed))
}

/// Simulations without flow control, under both kinds of traffic.
pub(super) fn baselines() -> Vec<Run> {
    settings().iter().flat_map(|s| s.baselines(&TRAFFICS, 0)).collect()
}

/// Simulations of the SUMO traces under constant traffic.
pub(super) fn runs(runs: &Runs) -> Vec<Run> {
    let of = |r: Replicate<'_>| POLICIES.map(|(_, p)| r.run(Traffic::Constant, p));
    measured(runs).iter().flat_map(|s| replicates(s).flat_map(of)).collect()
}

pub(super) fn alpha_beta(runs: &Runs) -> Vec<Grid> {
    let mut implied = Grid::new(
        "β = (obj − e)/t of each printed cell, within rounding, and the α it means",
        [
            "table",
            "stated α",
            "its β",
            "cell",
            "implied β",
            "least",
            "greatest",
            "implied α",
            "stated β possible",
        ],
    );
    for table in [&COMPARISON, &VARYING] {
        for column in &table.columns {
            for (zone, cell) in column.zones.iter().enumerate() {
                let (low, beta, high) = cell.implied_beta();
                let stated = beta_of(table.alpha);
                let possible = low <= stated && stated <= high;
                implied.row([
                    table.label.into(),
                    number(table.alpha, 4),
                    number(stated, 4),
                    format!("CZ{} {}", zone + 1, column.policy).into(),
                    number(beta, 4),
                    number(low, 4),
                    number(high, 4),
                    number(alpha_of(beta), 4),
                    if possible { "yes" } else { "no" }.into(),
                ]);
            }
        }
    }
    let mut simulated = Grid::new(
        "What it changes: our totals on the three SUMO traces, ± 95 %",
        ["policy", "paper", "β = 2/3", "β = 8/15 (α = 0.0625)"],
    );
    let [ours, stated] = measured(runs);
    for ((name, policy), column) in POLICIES.into_iter().zip(&COMPARISON.columns) {
        let total = |setting: &Setting| {
            let of = |r: Replicate<'_>| runs.outcome(&r.run(Traffic::Constant, policy)).total();
            Entry::from(Interval::of(&replicates(setting).map(of).collect::<Vec<f64>>()))
        };
        simulated.row([name.into(), number(column.total, 2), total(&ours), total(&stated)]);
    }
    vec![implied, simulated]
}

pub(super) fn repeated_column(runs: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "No flow control: constant traffic (β = 2/3) and varying traffic (β = 8/3), ours on the three SUMO traces ± 95 %",
        ["metric", "paper constant", "paper varying", "ours constant", "ours varying", "paired difference"],
    );
    let [constant, varying] = [&COMPARISON, &VARYING].map(|t| t.columns[2].zones);
    let [ours, _] = settings();
    for zone in 0..2 {
        for (name, printed, index) in [
            ("time, s", [constant[zone].time_s, varying[zone].time_s], 0),
            ("energy, m²/s³", [constant[zone].energy, varying[zone].energy], 1),
        ] {
            let values = |traffic| -> Vec<f64> {
                let of = |r: Replicate<'_>| {
                    let zone = &runs.outcome(&r.run(traffic, Policy::None)).zones[zone];
                    if index == 0 { zone.mean_time_s } else { zone.mean_energy }
                };
                replicates(&ours).map(of).collect()
            };
            let [a, b] = TRAFFICS.map(values);
            let difference: Vec<f64> = b.iter().zip(&a).map(|(b, a)| b - a).collect();
            grid.row([
                format!("CZ{} {name}", zone + 1).into(),
                number(printed[0], 2),
                number(printed[1], 2),
                Interval::of(&a).into(),
                Interval::of(&b).into(),
                Interval::of(&difference).into(),
            ]);
        }
    }
    vec![grid]
}

pub(super) fn totals(_: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "Printed totals against the sum of the printed parts",
        ["table", "policy", "CZ1", "CZ2", "sum", "printed total", "off by", "explained by rounding"],
    );
    for table in [&COMPARISON, &VARYING] {
        for column in &table.columns {
            let [first, second] = column.zones.map(|z| z.objective);
            // A hair more than the bound, for the decimal fractions that binary cannot hold.
            let explained = column.excess().abs() <= 0.015 + 1e-9;
            grid.row([
                table.label.into(),
                column.policy.into(),
                number(first, 2),
                number(second, 2),
                number(first + second, 2),
                number(column.total, 2),
                number(column.excess(), 2),
                if explained { "yes" } else { "no" }.into(),
            ]);
        }
    }
    let improvement = |i: usize, columns: &[paper::Column; 3]| {
        let printed = 100.0 * (1.0 - columns[i].total / columns[2].total);
        let sum = |c: &paper::Column| c.zones[0].objective + c.zones[1].objective;
        (printed, 100.0 * (1.0 - sum(&columns[i]) / sum(&columns[2])))
    };
    let mut effect = Grid::new(
        "The improvement over no flow control, from the printed totals and from the parts, %",
        ["table", "policy", "from totals", "from parts"],
    );
    for table in [&COMPARISON, &VARYING] {
        for i in [0, 1] {
            let (totals, parts) = improvement(i, &table.columns);
            effect.row([
                table.label.into(),
                table.columns[i].policy.into(),
                number(totals, 2),
                number(parts, 2),
            ]);
        }
    }
    vec![grid, effect]
}

pub(super) fn objectives(_: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "Printed objectives against β t + e with β = 2/3 (tab:feedback1) and 8/3 (tab:feedback)",
        ["table", "cell", "t", "e", "β t + e", "printed", "off by", "explained by rounding"],
    );
    for (table, beta) in [(&COMPARISON, BETA), (&VARYING, 4.0 * BETA)] {
        for column in &table.columns {
            for (zone, cell) in column.zones.iter().enumerate() {
                let computed = beta * cell.time_s + cell.energy;
                let off = cell.objective - computed;
                let explained = off.abs() <= 0.005 * (2.0 + beta) + 1e-9;
                grid.row([
                    table.label.into(),
                    format!("CZ{} {}", zone + 1, column.policy).into(),
                    number(cell.time_s, 2),
                    number(cell.energy, 2),
                    number(computed, 3),
                    number(cell.objective, 2),
                    number(off, 3),
                    if explained { "yes" } else { "no" }.into(),
                ]);
            }
        }
    }
    vec![grid]
}
