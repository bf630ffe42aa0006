//! Model predictive control with Clarabel: per vehicle, a quadratic program over the next six seconds in
//! which partners keep their speed and the safety margins are kept with one slack.
//!
//!     cargo build --release -p control-zones-plugin --example mpc
//!     cz run --controller merge-2=target/release/examples/mpc

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};
use control_zones_plugin::schemas::RunSpec;
use control_zones_plugin::{Controller, PartnerKind, Step, Vehicle, run};

const HORIZON: usize = 15;
const STEP_S: f64 = 0.4;
const SPEED_WEIGHT: f64 = 0.3;
const SLACK_WEIGHT: f64 = 100.0;
/// Speed gone for where the terminal speed is free, m/s.
const FREE_MPS: f64 = 20.0;

/// Rows `a u <= b` over the accelerations of the horizon and the slack.
struct Rows {
    dense: Vec<[f64; HORIZON + 1]>,
    bounds: Vec<f64>,
}

impl Rows {
    fn at_most(&mut self, row: [f64; HORIZON + 1], bound: f64) {
        self.dense.push(row);
        self.bounds.push(bound);
    }

    fn matrix(&self) -> CscMatrix<f64> {
        let rows: Vec<Vec<f64>> = self.dense.iter().map(|r| r.to_vec()).collect();
        CscMatrix::from(&rows)
    }
}

/// Position and speed after `k` steps as rows over the accelerations: `row . u + constant`.
fn position(k: usize) -> [f64; HORIZON + 1] {
    std::array::from_fn(|j| if j < k { STEP_S * STEP_S * (k as f64 - j as f64 - 0.5) } else { 0.0 })
}

fn speed(k: usize) -> [f64; HORIZON + 1] {
    std::array::from_fn(|j| if j < k { STEP_S } else { 0.0 })
}

fn plan(spec: &RunSpec, vehicle: &Vehicle<'_>) -> Option<f64> {
    let (x, v) = (vehicle.state.x_m, vehicle.state.v_mps);
    let wish = vehicle.terminal_mps().unwrap_or(FREE_MPS);
    let n = HORIZON + 1;
    // Cost: sum over the horizon of q (v_k - wish)^2 / 2 + u_k^2 / 2, and the slack.
    let mut p = vec![vec![0.0; n]; n];
    let mut q = vec![0.0; n];
    for k in 1..=HORIZON {
        let row = speed(k);
        for i in 0..n {
            for j in i..n {
                p[i][j] += SPEED_WEIGHT * row[i] * row[j];
            }
            q[i] += SPEED_WEIGHT * row[i] * (v - wish);
        }
        p[k - 1][k - 1] += 1.0;
    }
    p[HORIZON][HORIZON] = SLACK_WEIGHT;
    let mut rows = Rows { dense: Vec::new(), bounds: Vec::new() };
    let unit = |at: usize, value: f64| std::array::from_fn(|j| if j == at { value } else { 0.0 });
    for k in 0..HORIZON {
        rows.at_most(unit(k, 1.0), spec.u_max_mps2);
        rows.at_most(unit(k, -1.0), -spec.u_min_mps2);
        rows.at_most(speed(k + 1), (spec.v_max_mps - v).max(0.0));
        rows.at_most(speed(k + 1).map(|a| -a), v - spec.v_min_mps);
    }
    rows.at_most(unit(HORIZON, -1.0), 0.0);
    for partner in vehicle.partners() {
        for k in 1..=HORIZON {
            let t = k as f64 * STEP_S;
            // A merging partner is owed the whole distance only at the conflict point (paper: phi x / L).
            let share = if partner.kind != PartnerKind::RearEnd {
                ((x + v * t) / partner.conflict_m).min(1.0)
            } else {
                1.0
            };
            let phi = spec.reaction_time_s * share;
            let (px, pv) = (position(k), speed(k));
            let mut row: [f64; HORIZON + 1] = std::array::from_fn(|j| px[j] + phi * pv[j]);
            row[HORIZON] = -1.0;
            let there = partner.x_m + partner.state.v_mps * t - spec.standstill_gap_m - 1.0;
            rows.at_most(row, there - (x + v * t) - phi * v);
        }
    }
    let settings = DefaultSettingsBuilder::default().verbose(false).build().ok()?;
    let cones = [SupportedConeT::NonnegativeConeT(rows.bounds.len())];
    let p = CscMatrix::from(&p);
    let mut solver = DefaultSolver::new(&p, &q, &rows.matrix(), &rows.bounds, &cones, settings).ok()?;
    solver.solve();
    let good = matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved);
    good.then(|| solver.solution.x[0])
}

struct Mpc;

impl Controller for Mpc {
    fn step(&mut self, step: &Step<'_>, u_mps2: &mut [f64]) {
        let spec = &step.run().spec;
        for (u, vehicle) in u_mps2.iter_mut().zip(step.vehicles()) {
            *u = plan(spec, &vehicle).unwrap_or(spec.u_min_mps2).clamp(spec.u_min_mps2, spec.u_max_mps2);
        }
    }
}

fn main() -> std::process::ExitCode {
    match run(&mut Mpc) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            std::process::ExitCode::FAILURE
        }
    }
}
