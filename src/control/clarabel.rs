//! The same program solved by Clarabel: the reference solver, and the oracle of the property tests.

use super::qp::Tracking;
use super::rows::Row;
use crate::vehicle::Inequality;
use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus};

/// Solves `equ:ocbf_qp` over `(u, e)` as an interior-point problem; `None` when it is infeasible.
///
/// # Panics
/// Never on finite input: the problem data have valid dimensions by construction.
pub fn solve(tracking: &Tracking, rows: &[(Inequality, Row)]) -> Option<f64> {
    let clf = tracking.slack_weight > 0.0;
    let y = tracking.error_mps;
    // Without the CLF row nothing ties the slack; a unit weight keeps it at zero.
    let weight = if clf { tracking.slack_weight } else { 1.0 };
    let p = CscMatrix::from(&[[1.0, 0.0], [0.0, 2.0 * weight]]);
    let q = [-tracking.u_ref_mps2, 0.0];
    let mut a: Vec<[f64; 2]> = rows.iter().map(|(row, _)| [row.coefficient, 0.0]).collect();
    let mut b: Vec<f64> = rows.iter().map(|(row, _)| row.bound).collect();
    if clf {
        a.push([2.0 * y, -1.0]);
        b.push(-tracking.clf_rate_per_s * y * y);
    }
    let a = CscMatrix::from(a.iter());
    let settings = DefaultSettings {
        verbose: false,
        tol_gap_abs: 1e-12,
        tol_gap_rel: 1e-12,
        tol_feas: 1e-12,
        ..DefaultSettings::default()
    };
    let cones = [NonnegativeConeT(b.len())];
    let mut solver = DefaultSolver::new(&p, &q, &a, &b, &cones, settings)
        .expect("dimensions agree: two variables, one bound per row");
    solver.solve();
    match solver.solution.status {
        SolverStatus::Solved
        | SolverStatus::AlmostSolved
        | SolverStatus::InsufficientProgress
        | SolverStatus::MaxIterations => Some(solver.solution.x[0]),
        _ => None,
    }
}
