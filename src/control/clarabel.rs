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
    let y = tracking.error_mps;
    // Tolerances are relative to the data as a whole, so data of very different size would cost digits
    // of u. So every row is divided by its largest number (a merge row next to the origin has 1e-6 where
    // others have 1), the slack is counted in `1 / unit`, and the objective divided by the slack's weight.
    // In these units the slack weighs as much as u: right where it can be zero, since then it is small.
    let mut unit = (2.0 * tracking.slack_weight).sqrt();
    if least_slack(tracking, rows) > 0.0 {
        // Active all over the feasible set, the CLF row may be what gives u its weight.
        unit = unit.min(0.5 / y.abs());
    }
    // Without the CLF row nothing ties the slack; any weight keeps it at zero.
    let clf = tracking.slack_weight > 0.0;
    let weight_of_u = if clf { unit * unit / (2.0 * tracking.slack_weight) } else { 1.0 };
    let p = CscMatrix::from(&[[weight_of_u, 0.0], [0.0, 1.0]]);
    let q = [-weight_of_u * tracking.u_ref_mps2, 0.0];
    let mut scaled: Vec<([f64; 2], f64)> = Vec::with_capacity(rows.len() + 1);
    let mut add = |u: f64, slack: f64, bound: f64| {
        let size = u.abs().max(slack.abs()).max(bound.abs());
        if size > 0.0 {
            scaled.push(([u / size, slack / size], bound / size));
        }
    };
    for (row, _) in rows {
        add(row.coefficient, 0.0, row.bound);
    }
    if clf {
        add(2.0 * y * unit, -1.0, -tracking.clf_rate_per_s * y * y * unit);
    }
    let a = CscMatrix::from(scaled.iter().map(|(row, _)| row));
    let b: Vec<f64> = scaled.iter().map(|&(_, bound)| bound).collect();
    let cones = [NonnegativeConeT(b.len())];
    let mut last = f64::NAN;
    // One program in ten thousand makes the full-length iteration cycle; shorter steps break the cycle.
    for max_step_fraction in [0.99, 0.9, 0.7] {
        let settings = DefaultSettings {
            verbose: false,
            max_iter: 100,
            max_step_fraction,
            tol_gap_abs: 1e-12,
            tol_gap_rel: 1e-12,
            tol_feas: 1e-12,
            // With both variables in the objective the linear systems are regular as they are.
            static_regularization_enable: false,
            ..DefaultSettings::default()
        };
        let mut solver = DefaultSolver::new(&p, &q, &a, &b, &cones, settings)
            .expect("dimensions agree: two variables, one bound per row");
        solver.solve();
        let u = solver.solution.x[0];
        match solver.solution.status {
            SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible => return None,
            SolverStatus::Solved => return rows.iter().all(|(row, _)| satisfied(row, u)).then_some(u),
            // Not an answer, whatever it is near to.
            _ => last = u,
        }
    }
    // A huge slack makes residuals, relative to the solution, small: the rows tell whether this is one.
    rows.iter().all(|(row, _)| satisfied(row, last)).then_some(last)
}

/// The least slack that the CLF row needs on the feasible set; negative when it needs none. Only for
/// scaling: the answer does not depend on it.
fn least_slack(tracking: &Tracking, rows: &[(Inequality, Row)]) -> f64 {
    let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
    for (row, _) in rows {
        if row.coefficient > 0.0 {
            high = high.min(row.bound / row.coefficient);
        } else if row.coefficient < 0.0 {
            low = low.max(row.bound / row.coefficient);
        }
    }
    let y = tracking.error_mps;
    2.0 * (y * low).min(y * high) + tracking.clf_rate_per_s * y * y
}

/// Whether a row holds to within what an interior-point solver can be asked for.
fn satisfied(row: &Inequality, u: f64) -> bool {
    let size = row.coefficient.abs().max(row.bound.abs());
    row.coefficient * u <= row.bound + 1e-7 * size
}
