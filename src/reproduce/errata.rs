//! What is wrong in the paper, each with the numbers that show it.

use super::experiment::{Demand, FIXED, Policy, Replicate, Traffic};
use super::grid::{Entry, Grid, number};
use super::paper::{self, COMPARISON, VARYING, alpha_of, beta_of};
use super::runs::{Run, Runs};
use super::statistics::Interval;
use crate::control::reference::Problem;
use crate::control::{Optimum, Terminal};
use crate::scenario::ReferenceLaw;
use crate::vehicle::{Merge, Pair};
use serde::Serialize;

/// An erratum's name and where it is in the paper.
#[derive(Clone, Copy, Debug)]
pub struct Topic {
    /// What `--only` takes.
    pub id: &'static str,
    /// Labels concerned.
    pub labels: &'static [&'static str],
    /// What is printed.
    pub printed: &'static str,
    /// What is right, and how one knows.
    pub correct: &'static str,
    needs_runs: bool,
    show: fn(&Runs) -> Vec<Grid>,
}

/// All errata.
pub const TOPICS: [Topic; 9] = [
    Topic {
        id: "lost-square",
        labels: &["equ:ucp_vm_5"],
        printed: "β − ½ b + a c = 0",
        correct: "β − ½ b² + a c = 0: the Hamiltonian vanishes along an optimum with free final time. Brute force over T agrees with it; the printed condition adds m²/s⁴ to m/s² and so gives another answer in feet.",
        needs_runs: false,
        show: lost_square,
    },
    Topic {
        id: "cubic",
        labels: &["equ:tm"],
        printed: "β T³ + (2v0+w) T² + (6v0w+6v0²−3L) T − 12Lv0 = 0",
        correct: "β T⁴ − 2(v0²+v0w+w²) T² + 12L(v0+w) T − 18L² = 0: the printed cubic follows correctly from the printed condition, and inherits its misprint.",
        needs_runs: false,
        show: cubic,
    },
    Topic {
        id: "delta-t",
        labels: &["equ:delta_t", "equ:perturb_tm"],
        printed: "ΔT from the cubic's partial derivatives",
        correct: "ΔT = −(g_w/g_T) Δw with the quartic's, polished by Newton; the printed step follows the printed cubic, not the optimum.",
        needs_runs: false,
        show: delta_t,
    },
    Topic {
        id: "derivative-display",
        labels: &["equ:perturb_tm"],
        printed: "∂f/∂t_m = 3β t_m² + (4v0+2v_m) t_m − 3L + 6v0v_m + 6 v_m²",
        correct: "… + 6 v0²: the derivative of equ:tm, and what equ:delta_t uses two displays later.",
        needs_runs: false,
        show: derivative_display,
    },
    Topic {
        id: "phi2",
        labels: &["SafeMerging", "equ:candidate2"],
        printed: "φ₂, never defined",
        correct: "φ₂ = φ/L: b2 = x_c − x − (φ/L) x v − δ is the merging constraint at x = L and vanishes from the start of the zone; only then does the printed row equal L_f b2 + L_g b2 u + k2 b2.",
        needs_runs: false,
        show: phi2,
    },
    Topic {
        id: "alpha-beta",
        labels: &["tab:feedback1", "eqn:energyobj"],
        printed: "α = 0.0625 under constant traffic",
        correct: "every cell of the table implies β = 2/3, that is α = 1/13 = 0.0769; α = 0.0625 gives β = 8/15. The other table is consistent with its α = 0.25.",
        needs_runs: true,
        show: alpha_beta,
    },
    Topic {
        id: "repeated-column",
        labels: &["tab:feedback", "tab:feedback1"],
        printed: "the same time and energy without flow control under both kinds of traffic",
        correct: "traffic and weight differ between the experiments, so the columns cannot agree in three of four entries: one was copied.",
        needs_runs: true,
        show: repeated_column,
    },
    Topic {
        id: "totals",
        labels: &["tab:feedback1", "tab:feedback"],
        printed: "totals that are not CZ1 + CZ2",
        correct: "the sum of two numbers rounded to 0.01 is within 0.015 of the rounded sum; two of the six totals are further off.",
        needs_runs: false,
        show: totals,
    },
    Topic {
        id: "objectives",
        labels: &["tab:feedback1", "tab:feedback", "eqn:energyobj"],
        printed: "obj. = β t + e",
        correct: "checked cell by cell with the β that the column as a whole implies.",
        needs_runs: false,
        show: objectives,
    },
];

/// An erratum with its evidence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Erratum {
    /// Short name.
    pub id: &'static str,
    /// Labels concerned.
    pub labels: &'static [&'static str],
    /// What is printed.
    pub printed: &'static str,
    /// What is right.
    pub correct: &'static str,
    /// Numbers.
    pub evidence: Vec<Grid>,
}

impl Topic {
    /// The runs its numbers need.
    pub fn runs(&self) -> Vec<Run> {
        if self.needs_runs { runs() } else { Vec::new() }
    }

    /// The erratum with its numbers.
    pub fn erratum(&self, runs: &Runs) -> Erratum {
        let Topic { id, labels, printed, correct, .. } = *self;
        Erratum { id, labels, printed, correct, evidence: (self.show)(runs) }
    }
}

const LENGTH_M: f64 = 200.0;
const BETA: f64 = 2.0 / 3.0;
const FEET: f64 = 1.0 / 0.3048;

/// Entry and terminal speeds of the demonstrations, m/s.
fn speeds() -> impl Iterator<Item = (f64, f64)> {
    [10.0, 13.0, 16.0, 19.0, 22.0].into_iter().flat_map(|v0| [12.0, 15.0, 18.5].map(|w| (v0, w)))
}

fn problem(v0_mps: f64, w: f64) -> Problem {
    Problem { beta: BETA, v0_mps, length_m: LENGTH_M, terminal: Terminal::Speed(w) }
}

/// beta - b^2/2 + a c, which vanishes at the optimum, m^2/s^4.
fn hamiltonian(o: &Optimum, v0: f64) -> f64 {
    BETA - 0.5 * o.b * o.b + o.a * v0
}

/// Duration of least cost among trajectories of fixed duration, by golden section: no condition used.
fn brute_force_s(p: &Problem) -> f64 {
    let cost = |t: f64| p.coefficients(t).cost(p.beta);
    // A coarse scan first: the cost may have two minima.
    let scan = (0..2000).map(|i| 4.0 + 0.02 * f64::from(i));
    let best = scan.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(4.0);
    let (mut low, mut high) = (best - 0.02, best + 0.02);
    for _ in 0..60 {
        let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if cost(a) < cost(b) { high = b } else { low = a }
    }
    0.5 * (low + high)
}

fn lost_square(_: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "β = 2/3, L = 200 m: the duration of least cost, and β − ½b² + ac at each solution",
        [
            "v0, m/s",
            "v_m, m/s",
            "T brute force, s",
            "T corrected, s",
            "T as printed, s",
            "error, %",
            "cost excess, %",
            "residual corrected",
            "residual as printed",
            "T as printed in feet, s",
            "T corrected in feet, s",
        ],
    );
    for (v0, w) in speeds() {
        let p = problem(v0, w);
        let [right, printed] = [ReferenceLaw::Corrected, ReferenceLaw::AsPrinted].map(|law| p.solve(law));
        // The same physical problem in other units: beta is a squared acceleration.
        let feet = Problem {
            beta: BETA * FEET * FEET,
            v0_mps: v0 * FEET,
            length_m: LENGTH_M * FEET,
            terminal: Terminal::Speed(w * FEET),
        };
        grid.row([
            number(v0, 1),
            number(w, 1),
            number(brute_force_s(&p), 4),
            number(right.duration_s, 4),
            number(printed.duration_s, 4),
            number(100.0 * (printed.duration_s / right.duration_s - 1.0), 2),
            number(100.0 * (printed.cost(BETA) / right.cost(BETA) - 1.0), 3),
            number(hamiltonian(&right, v0), 4),
            number(hamiltonian(&printed, v0), 4),
            number(feet.solve(ReferenceLaw::AsPrinted).duration_s, 4),
            number(feet.solve(ReferenceLaw::Corrected).duration_s, 4),
        ]);
    }
    vec![grid]
}

/// Left side of `equ:tm`.
fn cubic_value(t: f64, v0: f64, w: f64) -> f64 {
    ((BETA * t + 2.0 * v0 + w) * t + 6.0 * v0 * w + 6.0 * v0 * v0 - 3.0 * LENGTH_M) * t - 12.0 * LENGTH_M * v0
}

/// The quartic that replaces it.
fn quartic_value(t: f64, v0: f64, w: f64) -> f64 {
    let l = LENGTH_M;
    ((BETA * t * t - 2.0 * (v0 * v0 + v0 * w + w * w)) * t + 12.0 * l * (v0 + w)) * t - 18.0 * l * l
}

fn cubic(_: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "Both polynomials at the duration of least cost found by brute force (0 where the condition is right)",
        ["v0, m/s", "v_m, m/s", "T brute force, s", "dJ/dT there", "quartic / 18L²", "cubic / 12Lv0"],
    );
    for (v0, w) in speeds() {
        let p = problem(v0, w);
        let t = brute_force_s(&p);
        let cost = |t: f64| p.coefficients(t).cost(BETA);
        let slope = (cost(t + 1e-4) - cost(t - 1e-4)) / 2e-4;
        grid.row([
            number(v0, 1),
            number(w, 1),
            number(t, 4),
            number(slope, 5),
            number(quartic_value(t, v0, w) / (18.0 * LENGTH_M * LENGTH_M), 5),
            number(cubic_value(t, v0, w) / (12.0 * LENGTH_M * v0), 5),
        ]);
    }
    vec![grid]
}

fn delta_t(_: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "v0 = 16 m/s, v_m = 15 m/s, L = 200 m, β = 2/3: the duration after a change of v_m, s",
        [
            "Δv, m/s",
            "optimum",
            "corrected step (polished)",
            "error, %",
            "printed cubic, exact",
            "printed step",
            "error, %",
        ],
    );
    let (v0, w) = (16.0, 15.0);
    let [right, printed] =
        [ReferenceLaw::Corrected, ReferenceLaw::AsPrinted].map(|law| (law, problem(v0, w).solve(law)));
    for dv in [-3.0, -1.0, -0.5, 0.5, 1.0, 3.0] {
        let changed = problem(v0, w + dv);
        let optimum = brute_force_s(&changed);
        let step =
            |(law, old): (ReferenceLaw, Optimum)| changed.perturb(law, &old, Terminal::Speed(w)).duration_s;
        let error = |t: f64| number(100.0 * (t / optimum - 1.0), 3);
        grid.row([
            number(dv, 1),
            number(optimum, 4),
            number(step(right), 4),
            error(step(right)),
            number(changed.solve(ReferenceLaw::AsPrinted).duration_s, 4),
            number(step(printed), 4),
            error(step(printed)),
        ]);
    }
    vec![grid]
}

fn derivative_display(_: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "∂f/∂t_m of equ:tm at its root: by central difference, as displayed, as equ:delta_t has it",
        [
            "v0, m/s",
            "v_m, m/s",
            "numerical",
            "displayed (6v_m²)",
            "equ:delta_t (6v0²)",
            "error of the display, %",
        ],
    );
    for (v0, w) in speeds() {
        let t = problem(v0, w).solve(ReferenceLaw::AsPrinted).duration_s;
        let numerical = (cubic_value(t + 1e-4, v0, w) - cubic_value(t - 1e-4, v0, w)) / 2e-4;
        let common = 3.0 * BETA * t * t + (4.0 * v0 + 2.0 * w) * t - 3.0 * LENGTH_M + 6.0 * v0 * w;
        let (displayed, used) = (common + 6.0 * w * w, common + 6.0 * v0 * v0);
        grid.row([
            number(v0, 1),
            number(w, 1),
            number(numerical, 2),
            number(displayed, 2),
            number(used, 2),
            number(100.0 * (displayed / numerical - 1.0), 1),
        ]);
    }
    vec![grid]
}

fn phi2(_: &Runs) -> Vec<Grid> {
    const PHI_S: f64 = 1.8;
    let merge = Merge { reaction_per_length: PHI_S / LENGTH_M, gap_m: 0.0, k_per_s: 1.0, u_min_mps2: -4.0 };
    let mut grid = Grid::new(
        "x_c = x + 30 m, v = 15 m/s, v_c = 14 m/s, u = 1 m/s², k2 = 1: the barrier and its row",
        [
            "x, m",
            "needed gap with φ₂ = φ/L, m",
            "φ v / 200 m of the way",
            "row slack",
            "ḃ2 + k2 b2 numerically",
            "needed gap with φ₂ = φ, m",
        ],
    );
    for x_m in [0.0, 50.0, 100.0, 200.0] {
        let (v, partner_v, u) = (15.0, 14.0, 1.0);
        let pair =
            Pair { x_m, v_mps: v, partner_x_m: x_m + 30.0, partner_v_mps: partner_v, partner_u_mps2: 0.0 };
        let row = merge.row(&pair);
        let slack = row.bound - row.coefficient * u;
        let margin = |t: f64| {
            merge.margin_m(&Pair {
                x_m: x_m + v * t + 0.5 * u * t * t,
                v_mps: v + u * t,
                partner_x_m: x_m + 30.0 + partner_v * t,
                ..pair
            })
        };
        let numerical = (margin(1e-4) - margin(-1e-4)) / 2e-4 + margin(0.0);
        grid.row([
            number(x_m, 0),
            number(30.0 - merge.margin_m(&pair), 2),
            number(PHI_S * v * x_m / LENGTH_M, 2),
            number(slack, 4),
            number(numerical, 4),
            number(PHI_S * x_m * v, 0),
        ]);
    }
    vec![grid]
}

const BETA_OF_ALPHA: &str = "objective={ alpha = 0.0625 }";
const POLICIES: [(&str, Policy); 3] =
    [("feedback", Policy::Feedback), ("fixed 15", FIXED), ("none", Policy::None)];

/// Simulations of the SUMO traces: both weights under constant traffic, and varying traffic.
fn runs() -> Vec<Run> {
    let stated = [BETA_OF_ALPHA.to_owned()];
    let mut runs = Vec::new();
    for seed in Demand::Traces.seeds(0) {
        for sets in [&[][..], &stated[..]] {
            let replicate = Replicate { demand: Demand::Traces, seed, sets };
            runs.extend(POLICIES.map(|(_, p)| replicate.run(Traffic::Constant, p)));
        }
        let replicate = Replicate { demand: Demand::Traces, seed, sets: &[] };
        runs.push(replicate.run(Traffic::Varying, Policy::None));
    }
    runs
}

fn alpha_beta(runs: &Runs) -> Vec<Grid> {
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
    let stated = [BETA_OF_ALPHA.to_owned()];
    for ((name, policy), column) in POLICIES.into_iter().zip(&COMPARISON.columns) {
        let total = |sets: &[String]| {
            let of = |seed| {
                runs.outcome(&Replicate { demand: Demand::Traces, seed, sets }.run(Traffic::Constant, policy))
                    .total()
            };
            Entry::from(Interval::of(&Demand::Traces.seeds(0).map(of).collect::<Vec<f64>>()))
        };
        simulated.row([name.into(), number(column.total, 2), total(&[]), total(&stated)]);
    }
    vec![implied, simulated]
}

fn repeated_column(runs: &Runs) -> Vec<Grid> {
    let mut grid = Grid::new(
        "No flow control: constant traffic (β = 2/3) and varying traffic (β = 8/3), ours on the three SUMO traces ± 95 %",
        ["metric", "paper constant", "paper varying", "ours constant", "ours varying", "paired difference"],
    );
    let [constant, varying] = [&COMPARISON, &VARYING].map(|t| t.columns[2].zones);
    for zone in 0..2 {
        for (name, printed, index) in [
            ("time, s", [constant[zone].time_s, varying[zone].time_s], 0),
            ("energy, m²/s³", [constant[zone].energy, varying[zone].energy], 1),
        ] {
            let ours = |traffic| -> Vec<f64> {
                let of = |seed| {
                    let replicate = Replicate { demand: Demand::Traces, seed, sets: &[] };
                    let zone = &runs.outcome(&replicate.run(traffic, Policy::None)).zones[zone];
                    if index == 0 { zone.mean_time_s } else { zone.mean_energy }
                };
                Demand::Traces.seeds(0).map(of).collect()
            };
            let [a, b] = [Traffic::Constant, Traffic::Varying].map(ours);
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

fn totals(_: &Runs) -> Vec<Grid> {
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

fn objectives(_: &Runs) -> Vec<Grid> {
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
