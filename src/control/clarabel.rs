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
    let Scaled { weight_of_u, pull, rows: scaled } = Scaled::of(tracking, rows);
    let p = CscMatrix::from(&[[weight_of_u, 0.0], [0.0, 1.0]]);
    let a = CscMatrix::from(scaled.iter().map(|(row, _)| row));
    let b: Vec<f64> = scaled.iter().map(|&(_, bound)| bound).collect();
    let cones = [NonnegativeConeT(b.len())];
    let mut unsure = None;
    for max_step_fraction in STEP_FRACTIONS {
        let mut solver = DefaultSolver::new(&p, &[pull, 0.0], &a, &b, &cones, settings(max_step_fraction))
            .expect("dimensions agree: two variables, one bound per row");
        match answer(&mut solver, rows) {
            Ok(answer) => return answer,
            Err(end) => unsure = surer(unsure, end),
        }
    }
    unsure.map(|end| end.u)
}

/// A solver that is set up once and then only given new numbers.
///
/// Updates keep the number of rows and the places of the numbers in the matrices. So there are as many rows
/// for u as the longest program has, the CLF row comes last, and what a program does not need is the row
/// `0 <= 1`.
pub struct Reused {
    /// One for each entry of `STEP_FRACTIONS`.
    solvers: Vec<DefaultSolver<f64>>,
    /// Rows for u.
    capacity: usize,
    /// Numbers of the last program: the column of u, the slack's one entry, and the bounds.
    matrix: Vec<f64>,
    bounds: Vec<f64>,
    /// Diagonal of the quadratic part, and the linear part.
    weights: Vec<f64>,
    pull: Vec<f64>,
}

impl Reused {
    /// Sets up for programs of at most `capacity` rows, not counting the CLF row.
    ///
    /// # Panics
    /// Never: the problem data have valid dimensions by construction.
    pub fn new(capacity: usize) -> Reused {
        let p = CscMatrix::identity(2);
        let rows: Vec<usize> = (0..=capacity).chain([capacity]).collect();
        // The slack is in the CLF row alone.
        let matrix = vec![1.0; capacity + 2];
        let a = CscMatrix::new(capacity + 1, 2, vec![0, capacity + 1, capacity + 2], rows, matrix.clone());
        let bounds = vec![1.0; capacity + 1];
        let cones = [NonnegativeConeT(capacity + 1)];
        let setup = |max_step_fraction| {
            let settings = DefaultSettings {
                presolve_enable: false,
                // Its factors would be those of the numbers above; a program's are scaled already.
                equilibrate_enable: false,
                ..settings(max_step_fraction)
            };
            DefaultSolver::new(&p, &[0.0; 2], &a, &bounds, &cones, settings)
                .expect("dimensions agree: two variables, one bound per row")
        };
        Reused {
            solvers: STEP_FRACTIONS.map(setup).into(),
            capacity,
            matrix,
            bounds,
            weights: vec![1.0; 2],
            pull: vec![0.0; 2],
        }
    }

    /// As [`solve`], with the numbers of this program.
    ///
    /// # Panics
    /// When the program has more rows than the solver was set up for.
    pub fn solve(&mut self, tracking: &Tracking, rows: &[(Inequality, Row)]) -> Option<f64> {
        let Scaled { weight_of_u, pull, rows: scaled } = Scaled::of(tracking, rows);
        (self.weights[0], self.pull[0]) = (weight_of_u, pull);
        self.matrix.fill(0.0);
        self.bounds.fill(1.0);
        let mut next = 0;
        for ([u, slack], bound) in scaled {
            let row = if slack == 0.0 { next } else { self.capacity };
            assert!(slack != 0.0 || row < self.capacity, "more rows than the solver was set up for");
            next += usize::from(slack == 0.0);
            self.matrix[row] = u;
            self.bounds[row] = bound;
            if slack != 0.0 {
                self.matrix[self.capacity + 1] = slack;
            }
        }
        let mut unsure = None;
        for solver in &mut self.solvers {
            solver
                .update_data(&self.weights, &self.pull, &self.matrix, &self.bounds)
                .expect("nothing was presolved and the numbers have the places of those before");
            match answer(solver, rows) {
                Ok(answer) => return answer,
                Err(end) => unsure = surer(unsure, end),
            }
        }
        unsure.map(|end| end.u)
    }
}

/// One program in ten thousand makes the full-length iteration cycle; shorter steps break the cycle.
const STEP_FRACTIONS: [f64; 3] = [0.99, 0.9, 0.7];

fn settings(max_step_fraction: f64) -> DefaultSettings<f64> {
    DefaultSettings {
        verbose: false,
        max_iter: 100,
        max_step_fraction,
        tol_gap_abs: 1e-12,
        tol_gap_rel: 1e-12,
        tol_feas: 1e-12,
        // With both variables in the objective the linear systems are regular as they are.
        static_regularization_enable: false,
        ..DefaultSettings::default()
    }
}

/// Where an attempt ended that is not sure of its answer.
struct Unsure {
    u: f64,
    /// The greatest of the numbers by which the solver knows an optimum; 0 at one.
    residual: f64,
}

/// Solves, and says what comes of it; `Err` when that is no answer, with the last iterate if the rows let it
/// be one.
fn answer(
    solver: &mut DefaultSolver<f64>,
    rows: &[(Inequality, Row)],
) -> Result<Option<f64>, Option<Unsure>> {
    solver.solve();
    let end = &solver.solution;
    let u = end.x[0];
    // A huge slack makes residuals, relative to the solution, small: the rows tell whether this is an answer.
    let permitted = rows.iter().all(|(row, _)| satisfied(row, u));
    match end.status {
        SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible => Ok(None),
        SolverStatus::Solved => Ok(permitted.then_some(u)),
        // Not an answer, whatever it is near to.
        _ => {
            let (value, dual) = (end.obj_val, end.obj_val_dual);
            let gap = (value - dual).abs() / value.abs().min(dual.abs()).max(1.0);
            Err(permitted.then_some(Unsure { u, residual: end.r_prim.max(end.r_dual).max(gap) }))
        }
    }
}

/// The surer of two ends. An attempt that stalls next to the optimum may be followed by one that goes astray.
fn surer(one: Option<Unsure>, other: Option<Unsure>) -> Option<Unsure> {
    match (one, other) {
        (Some(one), Some(other)) => Some(if other.residual < one.residual { other } else { one }),
        (one, other) => one.or(other),
    }
}

/// A program in units in which the solver keeps its digits: `min weight_of_u u^2 / 2 + e^2 / 2 + pull u`
/// subject to rows over `(u, e)` and their bounds.
struct Scaled {
    weight_of_u: f64,
    pull: f64,
    /// Only the CLF row has a coefficient of the slack; it comes last.
    rows: Vec<([f64; 2], f64)>,
}

impl Scaled {
    fn of(tracking: &Tracking, rows: &[(Inequality, Row)]) -> Scaled {
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
        Scaled { weight_of_u, pull: -weight_of_u * tracking.u_ref_mps2, rows: scaled }
    }
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
