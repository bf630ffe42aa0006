//! The paper's tables and the data of its figures, from performed runs.

use super::ReproduceError;
use super::claims::{CLAIMS, Claim, ClaimRow, Judged, judge};
use super::experiment::{FIXED, Policy, Replicate, Setting, Traffic, Variant, sweep_speeds};
use super::grid::{Entry, Grid, number};
use super::paper::{self, Performance};
use super::rate::{self, Curve};
use super::runs::{Outcome, Progress, Run, Runs};
use super::statistics::{Interval, Quadratic};
use serde::Serialize;

/// The columns of the tables: each variant with its setting, in the order of [`Variant::ALL`].
#[derive(Clone, Debug)]
pub struct Columns {
    seeds: u64,
    settings: Vec<Setting>,
}

impl Columns {
    /// Settles the variants for the given kinds of traffic.
    pub fn settle(
        traffics: &[Traffic],
        seeds: u64,
        runs: &mut Runs,
        progress: &mut Progress<'_>,
    ) -> Result<Columns, ReproduceError> {
        let settings = Variant::ALL.iter().map(|v| Setting::new(v.demand, v.sets())).collect();
        Ok(Columns { seeds, settings: Setting::settle(settings, traffics, seeds, runs, progress)? })
    }

    /// Calls `each` with every replicate of a variant, in order.
    fn over<T>(&self, variant: Variant, each: impl FnMut(Replicate<'_>) -> T) -> Vec<T> {
        let at = Variant::ALL.iter().position(|v| *v == variant).expect("one of all variants");
        let setting = &self.settings[at];
        setting.demand.seeds(self.seeds).map(|seed| setting.replicate(seed)).map(each).collect()
    }

    /// v_m2 of each variant, m/s.
    fn second_mps(&self, traffic: Traffic) -> impl Iterator<Item = Entry> + '_ {
        let entry = |second: Option<f64>| second.map_or(Entry::Empty(()), |v| number(v, 1));
        self.settings.iter().map(move |s| entry(s.second_mps[traffic as usize]))
    }
}

/// The runs the claims of a table or figure need.
pub fn claim_runs(label: &str, columns: &Columns) -> Vec<Run> {
    let speeds = sweep_speeds();
    let claims = || CLAIMS.iter().filter(|c| c.label == label);
    let of = |r: Replicate<'_>| claims().flat_map(|c| c.runs(&r, &speeds)).collect::<Vec<_>>();
    Variant::ALL.iter().flat_map(|&v| columns.over(v, of)).flatten().collect()
}

/// Judges the claims of a table or figure.
pub fn judge_claims(label: &str, runs: &Runs, columns: &Columns) -> Vec<ClaimRow> {
    let speeds = sweep_speeds();
    let judged = |claim: &Claim, variant: Variant| {
        let effects = columns.over(variant, |r| claim.effect(runs, &r, &speeds));
        let effect = effects.into_iter().collect::<Option<Vec<f64>>>().and_then(|e| Interval::of(&e));
        Judged { variant: variant.name(), effect, verdict: judge(claim.expectation, effect.as_ref()) }
    };
    CLAIMS
        .iter()
        .filter(|c| c.label == label)
        .map(|claim| ClaimRow {
            id: claim.id,
            label: claim.label,
            text: claim.text,
            unit: claim.unit,
            expectation: claim.expectation,
            verdicts: Variant::ALL.iter().map(|&v| judged(claim, v)).collect(),
        })
        .collect()
}

/// Runs of the given policies under every variant.
fn policy_runs(traffic: Traffic, policies: &[Policy], columns: &Columns) -> Vec<Run> {
    let of = |r: Replicate<'_>| policies.iter().map(|&p| r.run(traffic, p)).collect::<Vec<_>>();
    Variant::ALL.iter().flat_map(|&v| columns.over(v, of)).flatten().collect()
}

fn variant_columns(first: &[&str]) -> Vec<String> {
    first.iter().map(|c| (*c).to_owned()).chain(Variant::ALL.iter().map(|v| v.name())).collect()
}

/// Intervals of a value over the replicates of each variant.
fn intervals(columns: &Columns, value: impl Fn(Replicate<'_>) -> f64) -> impl Iterator<Item = Entry> {
    let of = |v: Variant| Interval::of(&columns.over(v, &value)).into();
    Variant::ALL.map(of).into_iter()
}

const POLICIES: [(&str, Policy); 3] =
    [("feedback", Policy::Feedback), ("fixed 15", FIXED), ("none", Policy::None)];

/// Runs of `tab:feedback1` or `tab:feedback`.
pub fn performance_runs(traffic: Traffic, columns: &Columns) -> Vec<Run> {
    policy_runs(traffic, &POLICIES.map(|(_, p)| p), columns)
}

/// `tab:feedback1` or `tab:feedback`: means, then paired differences.
pub fn performance(traffic: Traffic, runs: &Runs, columns: &Columns) -> Vec<Grid> {
    let printed: &Performance = match traffic {
        Traffic::Constant => &paper::COMPARISON,
        Traffic::Varying => &paper::VARYING,
    };
    type Ours = fn(&Outcome) -> f64;
    type Theirs = fn(&paper::Column) -> f64;
    const METRICS: [(&str, Ours, Theirs); 7] = [
        ("CZ1 time, s", |o| o.zones[0].mean_time_s, |c| c.zones[0].time_s),
        ("CZ1 energy, m²/s³", |o| o.zones[0].mean_energy, |c| c.zones[0].energy),
        ("CZ1 objective", |o| o.zones[0].mean_objective, |c| c.zones[0].objective),
        ("CZ2 time, s", |o| o.zones[1].mean_time_s, |c| c.zones[1].time_s),
        ("CZ2 energy, m²/s³", |o| o.zones[1].mean_energy, |c| c.zones[1].energy),
        ("CZ2 objective", |o| o.zones[1].mean_objective, |c| c.zones[1].objective),
        ("total objective", Outcome::total, |c| c.total),
    ];
    let outcome = |r: Replicate<'_>, p| runs.outcome(&r.run(traffic, p));
    let mut means = Grid::new(
        format!("{}: means, ours ± 95 %", printed.label),
        variant_columns(&["metric", "policy", "paper"]),
    );
    let mut differences = Grid::new(
        format!("{}: paired differences on the same arrivals, ours ± 95 %", printed.label),
        variant_columns(&["metric", "difference", "paper"]),
    );
    for (name, ours, theirs) in METRICS {
        for ((policy, p), column) in POLICIES.into_iter().zip(&printed.columns) {
            let ours = intervals(columns, |r| ours(outcome(r, p)));
            means.row([name.into(), policy.into(), number(theirs(column), 2)].into_iter().chain(ours));
        }
        for (i, j) in [(0, 2), (1, 2), (0, 1)] {
            let ((a, pa), (b, pb)) = (POLICIES[i], POLICIES[j]);
            let theirs = theirs(&printed.columns[i]) - theirs(&printed.columns[j]);
            let ours = intervals(columns, |r| ours(outcome(r, pa)) - ours(outcome(r, pb)));
            let label = format!("{a} − {b}");
            differences.row([name.into(), label.into(), number(theirs, 2)].into_iter().chain(ours));
        }
    }
    vec![means, differences]
}

/// Runs of `tab:fem_time`.
pub fn feasibility_runs(columns: &Columns) -> Vec<Run> {
    policy_runs(Traffic::Constant, &FEASIBILITY.map(|(_, p)| p), columns)
}

const FEASIBILITY: [(&str, Policy); 3] =
    [("none", Policy::None), ("15 m/s", FIXED), ("12 m/s", Policy::Fixed(12.0))];

/// `tab:fem_time`.
pub fn feasibility(runs: &Runs, columns: &Columns) -> Vec<Grid> {
    let zone = |r: Replicate<'_>, p| &runs.outcome(&r.run(Traffic::Constant, p)).zones[1];
    let mut grid =
        Grid::new("tab:fem_time: entering CZ2, ours ± 95 %", variant_columns(&["metric", "v_m1", "paper"]));
    for ((name, p), printed) in FEASIBILITY.into_iter().zip(paper::FEASIBILITY) {
        let count = intervals(columns, |r| f64::from(zone(r, p).fe_vehicles));
        let time = intervals(columns, |r| zone(r, p).fe_mean_s);
        let infeasible = intervals(columns, |r| f64::from(zone(r, p).infeasible_vehicles));
        grid.row(["FE count".into(), name.into(), number(printed.fe_vehicles, 0)].into_iter().chain(count));
        grid.row(["FE time, s".into(), name.into(), number(printed.fe_mean_s, 2)].into_iter().chain(time));
        let first = ["infeasible count".into(), name.into(), number(printed.infeasible, 0)];
        grid.row(first.into_iter().chain(infeasible));
    }
    let speed =
        intervals(columns, |r| runs.outcome(&r.run(Traffic::Constant, Policy::None)).exit_speeds_mps[1]);
    let mut second = Grid::new(
        "v_m2: mean exit speed of CZ2 without flow control, m/s",
        variant_columns(&["quantity", "paper"]),
    );
    second.row(["mean exit speed".into(), number(paper::SECOND_TERMINAL_MPS, 1)].into_iter().chain(speed));
    let constant = columns.second_mps(Traffic::Constant);
    second.row(["v_m2 used".into(), number(paper::SECOND_TERMINAL_MPS, 1)].into_iter().chain(constant));
    vec![grid, second]
}

/// One variant's curves of `fig:diff_v`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SweepCurve {
    /// Variant's name.
    pub variant: String,
    /// Fixed speeds v_m1, m/s.
    pub speeds_mps: Vec<f64>,
    /// Mean objective of CZ1, of CZ2, and their sum, per speed.
    pub objectives: [Vec<Option<Interval>>; 3],
    /// The same without flow control.
    pub baseline: [Option<Interval>; 3],
    /// Fit of the mean total.
    pub fit: Option<Quadratic>,
    /// The fit's minimum, replicate by replicate, m/s; absent when a replicate's fit has none.
    pub minimum_mps: Option<Interval>,
}

/// Runs of `fig:diff_v`.
pub fn sweep_runs(columns: &Columns) -> Vec<Run> {
    let mut policies: Vec<Policy> = sweep_speeds().into_iter().map(Policy::Fixed).collect();
    policies.push(Policy::None);
    policy_runs(Traffic::Constant, &policies, columns)
}

/// The curves of `fig:diff_v`.
pub fn sweep_curves(runs: &Runs, columns: &Columns) -> Vec<SweepCurve> {
    let speeds_mps = sweep_speeds();
    let parts: [fn(&Outcome) -> f64; 3] =
        [|o| o.zones[0].mean_objective, |o| o.zones[1].mean_objective, Outcome::total];
    let curve = |variant: Variant| {
        let at = |policy, part: fn(&Outcome) -> f64| {
            columns.over(variant, |r| part(runs.outcome(&r.run(Traffic::Constant, policy))))
        };
        let objectives = parts.map(|part| {
            speeds_mps.iter().map(|&v| Interval::of(&at(Policy::Fixed(v), part))).collect::<Vec<_>>()
        });
        let totals: Option<Vec<f64>> = objectives[2].iter().map(|i| i.map(|i| i.mean)).collect();
        let minima = columns.over(variant, |r| {
            let total = |&v: &f64| runs.outcome(&r.run(Traffic::Constant, Policy::Fixed(v))).total();
            Quadratic::fit(&speeds_mps, &speeds_mps.iter().map(total).collect::<Vec<_>>())?.minimum()
        });
        SweepCurve {
            variant: variant.name(),
            baseline: parts.map(|part| Interval::of(&at(Policy::None, part))),
            fit: totals.and_then(|t| Quadratic::fit(&speeds_mps, &t)),
            minimum_mps: minima.into_iter().collect::<Option<Vec<f64>>>().and_then(|m| Interval::of(&m)),
            objectives,
            speeds_mps: speeds_mps.clone(),
        }
    };
    Variant::ALL.map(curve).into()
}

/// The numbers behind `fig:diff_v`: the fits, and the totals less the baseline's.
pub fn sweep_grids(curves: &[SweepCurve], runs: &Runs, columns: &Columns) -> Vec<Grid> {
    let mut fits = Grid::new(
        "fig:diff_v: quadratic fit of the total (paper: minimum \"around 15 m/s\")",
        [
            "variant",
            "minimum of the mean curve, m/s",
            "per replicate, m/s",
            "R² of the mean curve",
            "total at 15 m/s",
            "baseline",
        ],
    );
    for curve in curves {
        let fit = curve.fit.as_ref();
        let at_15 = curve.speeds_mps.iter().position(|v| *v == 15.0);
        fits.row([
            curve.variant.as_str().into(),
            fit.and_then(Quadratic::minimum).map_or(Entry::Empty(()), |v| number(v, 2)),
            curve.minimum_mps.into(),
            fit.map_or(Entry::Empty(()), |f| number(f.r_squared, 3)),
            at_15.and_then(|i| curve.objectives[2][i]).into(),
            curve.baseline[2].into(),
        ]);
    }
    let mut differences = Grid::new(
        "fig:diff_v: total with v_m1 less total without flow control, paired, ± 95 %",
        variant_columns(&["v_m1, m/s"]),
    );
    for v in sweep_speeds() {
        let total = |r: Replicate<'_>, p| runs.outcome(&r.run(Traffic::Constant, p)).total();
        let ours = intervals(columns, |r| total(r, Policy::Fixed(v)) - total(r, Policy::None));
        differences.row([number(v, 1)].into_iter().chain(ours));
    }
    vec![fits, differences]
}

/// The curves of `fig:rate`: all replicates of the corrected variant of a demand pooled, then trace 1
/// alone, as a single simulation like the paper's looks.
pub fn rate_curves(runs: &Runs, columns: &Columns) -> Vec<(String, Vec<Curve>)> {
    let pooled = |variant: Variant, name: String| {
        let curves = POLICIES.map(|(policy, p)| {
            let vehicles = columns
                .over(variant, |r| rate::vehicle_objectives(runs.outcome(&r.run(Traffic::Varying, p))));
            Curve {
                policy,
                points: rate::smooth(vehicles.into_iter().flatten().collect(), rate::SMOOTHING_S),
            }
        });
        (name, curves.to_vec())
    };
    let [seeded, traces, ..] = Variant::ALL;
    let single = {
        let at = Variant::ALL.iter().position(|v| *v == traces).expect("one of all variants");
        let replicate = columns.settings[at].replicate(1);
        let curves = POLICIES.map(|(policy, p)| {
            let vehicles = rate::vehicle_objectives(runs.outcome(&replicate.run(Traffic::Varying, p)));
            Curve { policy, points: rate::smooth(vehicles, rate::SMOOTHING_S) }
        });
        ("SUMO trace 1 alone".to_owned(), curves.to_vec())
    };
    vec![
        pooled(seeded, format!("seeded process, {} seeds pooled", columns.seeds)),
        pooled(traces, "SUMO traces, 3 pooled".to_owned()),
        single,
    ]
}

/// Mean objective per rate period, paired differences.
pub fn rate_grid(runs: &Runs, columns: &Columns) -> Grid {
    let mut grid = Grid::new(
        "fig:rate: objective per vehicle over both zones by rate period, paired differences ± 95 %",
        variant_columns(&["period", "rate, veh/h", "difference"]),
    );
    let mut from = 0.0;
    for (index, (until, rate)) in rate::PERIODS.into_iter().enumerate() {
        for (i, j) in [(0, 2), (1, 2), (0, 1)] {
            let ((a, pa), (b, pb)) = (POLICIES[i], POLICIES[j]);
            let mean = |r: Replicate<'_>, p| {
                rate::mean_objective(runs.outcome(&r.run(Traffic::Varying, p)), &[index])
            };
            let ours = intervals(columns, |r| mean(r, pa) - mean(r, pb));
            let first =
                [format!("{from:.0}–{until:.0} s").into(), number(rate, 0), format!("{a} − {b}").into()];
            grid.row(first.into_iter().chain(ours));
        }
        from = until;
    }
    grid
}
