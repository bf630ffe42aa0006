//! Misprints in equations, shown by what the equations give.

use super::super::grid::{Grid, number};
use super::super::runs::Runs;
use super::BETA;
use crate::control::reference::Problem;
use crate::control::{Optimum, Terminal};
use crate::scenario::ReferenceLaw;
use crate::vehicle::{Merge, Pair};

const LENGTH_M: f64 = 200.0;
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

pub(super) fn lost_square(_: &Runs) -> Vec<Grid> {
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

pub(super) fn cubic(_: &Runs) -> Vec<Grid> {
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

pub(super) fn delta_t(_: &Runs) -> Vec<Grid> {
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

pub(super) fn derivative_display(_: &Runs) -> Vec<Grid> {
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

pub(super) fn phi2(_: &Runs) -> Vec<Grid> {
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
