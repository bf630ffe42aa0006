//! An independent check of the reference: Problem 1 by direct transcription, solved as a QP by Clarabel.
//!
//! For a given duration T the trajectory is cut into steps of constant acceleration; energy is a
//! quadratic form, the dynamics (`VehicleDynamics`), the limits (`VehicleConstraints`), the terminal speed
//! (`equ:vm`) and, when a leader is given, rear-end safety (`Safety`) are linear rows. The best T is found
//! by golden section. Nothing of the analytic solution enters.

use super::ReproduceError;
use super::grid::{Entry, Grid, number};
use crate::conflict::DutyKind;
use crate::control::reference::Problem;
use crate::control::{Law, Ocbf, Partner, Situation, Terminal, Words};
use crate::scenario::{self, ReferenceLaw, Scenario};
use crate::vehicle::Held;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettings, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus, SupportedConeT, ZeroConeT,
};
use serde::Serialize;

/// Steps of the grid.
const STEPS: usize = 160;
/// Duration is found to within this, s; the cost is flat there.
const TOLERANCE_S: f64 = 1e-3;
/// What the analytic reference may cost more, %.
pub const BOUND_PERCENT: f64 = 0.1;

/// A vehicle ahead that keeps its speed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Leader {
    /// Its position at the start, m.
    pub x_m: f64,
    /// Its speed, m/s.
    pub v_mps: f64,
}

/// A case and what came out of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Check {
    /// Weight of time, m^2/s^4.
    pub beta: f64,
    /// Entry speed, m/s.
    pub v0_mps: f64,
    /// Terminal speed, m/s; absent when free.
    pub terminal_mps: Option<f64>,
    /// The leader, if there is one.
    pub leader: Option<Leader>,
    /// Duration and cost of the transcription.
    pub transcription: (f64, f64),
    /// Duration and cost of the corrected reference.
    pub corrected: (f64, f64),
    /// Duration and cost of the reference as printed.
    pub as_printed: (f64, f64),
    /// Least rear-end margin of the corrected reference behind the leader, m.
    pub reference_margin_m: Option<f64>,
    /// Duration and cost of the OCBF controller tracking it under the barrier rows, step 0.1 s.
    pub ocbf: (f64, f64),
}

impl Check {
    /// By how much a cost exceeds the transcription's, %.
    pub fn excess_percent(&self, cost: f64) -> f64 {
        100.0 * (cost / self.transcription.1 - 1.0)
    }

    /// Whether the leader's safety row is what makes the difference.
    pub fn leader_binds(&self) -> bool {
        self.reference_margin_m.is_some_and(|m| m < 0.0)
    }
}

/// Runs all cases.
pub fn checks() -> Result<Vec<Check>, ReproduceError> {
    let base = scenario::load_embedded("paper", &[], Some(1))?;
    let mut checks = Vec::new();
    for beta in [2.0 / 3.0, 8.0 / 3.0] {
        for v0_mps in [10.0, 16.0, 20.0] {
            for terminal in
                [Terminal::Speed(12.0), Terminal::Speed(15.0), Terminal::Speed(18.5), Terminal::Free]
            {
                checks.push(check(&base, beta, v0_mps, terminal, None)?);
            }
        }
    }
    // Far ahead, just right, and slow enough to be in the way.
    for leader in [
        Leader { x_m: 70.0, v_mps: 18.0 },
        Leader { x_m: 40.0, v_mps: 15.0 },
        Leader { x_m: 32.0, v_mps: 13.0 },
    ] {
        for terminal in [Terminal::Speed(15.0), Terminal::Free] {
            checks.push(check(&base, 2.0 / 3.0, 16.0, terminal, Some(leader))?);
        }
    }
    Ok(checks)
}

fn check(
    base: &Scenario,
    beta: f64,
    v0_mps: f64,
    terminal: Terminal,
    leader: Option<Leader>,
) -> Result<Check, ReproduceError> {
    let problem = Problem { beta, v0_mps, length_m: LENGTH_M, terminal };
    let analytic = |law| {
        let optimum = problem.solve(law);
        (optimum.duration_s, optimum.cost(beta))
    };
    let margin = |leader: Leader| {
        let o = problem.solve(ReferenceLaw::Corrected);
        (0..=1000).map(|k| o.duration_s * f64::from(k) / 1000.0).fold(f64::INFINITY, |least, t| {
            let x = ((o.a / 6.0 * t + 0.5 * o.b) * t + v0_mps) * t;
            let v = (0.5 * o.a * t + o.b) * t + v0_mps;
            least.min(leader.x_m + leader.v_mps * t - x - base.vehicle.reaction_time_s * v)
        })
    };
    let mut scenario = base.clone();
    scenario.beta = beta;
    scenario.control.slack_weight = beta;
    Ok(Check {
        beta,
        v0_mps,
        terminal_mps: match terminal {
            Terminal::Speed(w) => Some(w),
            Terminal::Free => None,
        },
        leader,
        transcription: transcribe(&problem, base, leader).ok_or(ReproduceError::Transcription)?,
        corrected: analytic(ReferenceLaw::Corrected),
        as_printed: analytic(ReferenceLaw::AsPrinted),
        reference_margin_m: leader.map(margin),
        ocbf: drive(&scenario, &problem, leader),
    })
}

/// The zone of all cases, m.
const LENGTH_M: f64 = 200.0;

/// Best duration and its cost.
fn transcribe(problem: &Problem, scenario: &Scenario, leader: Option<Leader>) -> Option<(f64, f64)> {
    let cost =
        |t: f64| least_energy(problem, scenario, leader, t).map_or(f64::INFINITY, |e| problem.beta * t + e);
    // From an average speed at the limit to one of 6 m/s. A duration too short to be feasible costs
    // infinity, and with two of them the search moves on to longer ones.
    let (mut low, mut high) = (LENGTH_M / scenario.vehicle.v_max_mps, LENGTH_M / 6.0);
    let ratio = 0.5 * (5f64.sqrt() - 1.0);
    let (mut a, mut b) = (high - ratio * (high - low), low + ratio * (high - low));
    let (mut at_a, mut at_b) = (cost(a), cost(b));
    while high - low > TOLERANCE_S {
        if at_a < at_b {
            (high, b, at_b) = (b, a, at_a);
            a = high - ratio * (high - low);
            at_a = cost(a);
        } else {
            (low, a, at_a) = (a, b, at_b);
            b = low + ratio * (high - low);
            at_b = cost(b);
        }
    }
    let best = if at_a < at_b { (a, at_a) } else { (b, at_b) };
    best.1.is_finite().then_some(best)
}

/// Least energy over a given duration; `None` when no trajectory exists.
///
/// Unknowns: accelerations u_0…, then speeds v_1…, then positions x_1….
fn least_energy(
    problem: &Problem,
    scenario: &Scenario,
    leader: Option<Leader>,
    duration_s: f64,
) -> Option<f64> {
    let (n, h) = (STEPS, duration_s / STEPS as f64);
    let (u, v, x) = (|k: usize| k, |k: usize| n + k - 1, |k: usize| 2 * n + k - 1);
    let mut rows = Rows::default();
    for k in 0..n {
        let mut speed = vec![(v(k + 1), 1.0), (u(k), -h)];
        let mut position = vec![(x(k + 1), 1.0), (u(k), -0.5 * h * h)];
        let (mut speed_0, mut position_0) = (0.0, 0.0);
        if k > 0 {
            speed.push((v(k), -1.0));
            position.extend([(x(k), -1.0), (v(k), -h)]);
        } else {
            speed_0 = problem.v0_mps;
            position_0 = problem.v0_mps * h;
        }
        rows.push(&speed, speed_0);
        rows.push(&position, position_0);
    }
    rows.push(&[(x(n), 1.0)], problem.length_m);
    if let Terminal::Speed(w) = problem.terminal {
        rows.push(&[(v(n), 1.0)], w);
    }
    let equalities = rows.bounds.len();
    let limits = scenario.vehicle;
    for k in 0..n {
        rows.push(&[(u(k), 1.0)], limits.u_max_mps2);
        rows.push(&[(u(k), -1.0)], -limits.u_min_mps2);
        rows.push(&[(v(k + 1), 1.0)], limits.v_max_mps);
        rows.push(&[(v(k + 1), -1.0)], -limits.v_min_mps);
        if let Some(leader) = leader {
            let ahead_m = leader.x_m + leader.v_mps * h * (k + 1) as f64;
            let row = [(x(k + 1), 1.0), (v(k + 1), limits.reaction_time_s)];
            rows.push(&row, ahead_m - limits.standstill_gap_m);
        }
    }
    let inequalities = rows.bounds.len() - equalities;
    // Energy is the sum of h u^2 / 2.
    let p = CscMatrix::new_from_triplets(3 * n, 3 * n, (0..n).collect(), (0..n).collect(), vec![h; n]);
    let a = CscMatrix::new_from_triplets(rows.bounds.len(), 3 * n, rows.row, rows.column, rows.value);
    let cones: [SupportedConeT<f64>; 2] = [ZeroConeT(equalities), NonnegativeConeT(inequalities)];
    let settings = DefaultSettings { verbose: false, ..DefaultSettings::default() };
    let mut solver = DefaultSolver::new(&p, &vec![0.0; 3 * n], &a, &rows.bounds, &cones, settings).ok()?;
    solver.solve();
    matches!(solver.solution.status, SolverStatus::Solved).then_some(solver.solution.obj_val)
}

/// Rows of a sparse matrix with their right-hand sides.
#[derive(Default)]
struct Rows {
    row: Vec<usize>,
    column: Vec<usize>,
    value: Vec<f64>,
    bounds: Vec<f64>,
}

impl Rows {
    fn push(&mut self, entries: &[(usize, f64)], bound: f64) {
        for &(column, value) in entries {
            self.row.push(self.bounds.len());
            self.column.push(column);
            self.value.push(value);
        }
        self.bounds.push(bound);
    }
}

/// Duration and cost of the built-in law behind the leader.
fn drive(scenario: &Scenario, problem: &Problem, leader: Option<Leader>) -> (f64, f64) {
    let law = Ocbf::new(scenario);
    let (dt_s, mut memory) = (scenario.dt_s(), Words::ENTERED);
    let (mut time_s, mut x_m, mut v_mps, mut energy) = (0.0, 0.0, problem.v0_mps, 0.0);
    loop {
        let situation = Situation {
            time_s,
            x_m,
            v_mps,
            entry_time_s: 0.0,
            entry_speed_mps: problem.v0_mps,
            length_m: problem.length_m,
            terminal: problem.terminal,
            schedule: None,
            kind: 0,
        };
        let partner = leader.map(|l| Partner {
            conflict_m: problem.length_m,
            gap_m: scenario.vehicle.standstill_gap_m,
            ..Partner::unplanned(DutyKind::RearEnd, l.x_m + l.v_mps * time_s, l.v_mps, 0.0)
        });
        let decision = law.decide(&situation, partner.into_iter(), &mut memory);
        let held = Held::new(x_m, v_mps, decision.u_mps2);
        if let Some(after_s) = held.passes_m(problem.length_m, dt_s) {
            time_s += after_s;
            energy += held.energy(after_s);
            return (time_s, problem.beta * time_s + energy);
        }
        time_s += dt_s;
        energy += held.energy(dt_s);
        (x_m, v_mps) = (held.position_m(dt_s), held.speed_mps(dt_s));
    }
}

/// The checks as tables.
pub fn grids(checks: &[Check]) -> Vec<Grid> {
    let terminal = |c: &Check| c.terminal_mps.map_or(Entry::from("free"), |w| number(w, 1));
    let mut alone = Grid::new(
        format!("Problem 1 without constraints: cost above the direct transcription ({STEPS} steps), %"),
        [
            "β",
            "v0, m/s",
            "v_m, m/s",
            "T transcription, s",
            "J transcription",
            "T corrected, s",
            "corrected, %",
            "T as printed, s",
            "as printed, %",
            "OCBF at 0.1 s, %",
        ],
    );
    let mut behind = Grid::new(
        "Problem 1 behind a leader that keeps its speed (v0 = 16 m/s, β = 2/3): cost above the transcription, %",
        [
            "leader ahead, m",
            "its speed, m/s",
            "v_m, m/s",
            "T transcription, s",
            "J transcription",
            "reference's least margin, m",
            "corrected, %",
            "as printed, %",
            "OCBF at 0.1 s, %",
        ],
    );
    for c in checks {
        let excess = |cost| number(c.excess_percent(cost), 3);
        match c.leader {
            None => alone.row([
                number(c.beta, 3),
                number(c.v0_mps, 1),
                terminal(c),
                number(c.transcription.0, 3),
                number(c.transcription.1, 4),
                number(c.corrected.0, 3),
                excess(c.corrected.1),
                number(c.as_printed.0, 3),
                excess(c.as_printed.1),
                excess(c.ocbf.1),
            ]),
            Some(leader) => behind.row([
                number(leader.x_m, 0),
                number(leader.v_mps, 0),
                terminal(c),
                number(c.transcription.0, 3),
                number(c.transcription.1, 4),
                number(c.reference_margin_m.unwrap_or(f64::NAN), 2),
                excess(c.corrected.1),
                excess(c.as_printed.1),
                excess(c.ocbf.1),
            ]),
        }
    }
    vec![alone, behind]
}
