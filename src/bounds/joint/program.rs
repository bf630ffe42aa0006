//! One quadratic program of the search: everybody's speeds and instants, linearised around the present ones.

use super::{Drive, Passing, Problem};
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettings, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus, SupportedConeT, ZeroConeT,
};

/// Duties with more time to spare than this are left out, s: no step within the trust region uses it up.
const FAR_S: f64 = 3.0;
/// Speeds are not let lower than this, m/s.
const SLOWEST_MPS: f64 = 0.5;
/// Share of a limit from which on it is a row.
const NEAR_LIMIT: f64 = 0.6;

/// What a program says.
pub(super) struct Step {
    /// Speeds at the places of each drive, m/s.
    pub speeds_mps: Vec<Vec<f64>>,
    /// By how much it expects the merit to fall.
    pub promised: f64,
    /// What a second more on each stretch costs.
    pub prices: Vec<Vec<f64>>,
}

/// A sparse matrix by entries.
#[derive(Default)]
struct Entries {
    row: Vec<usize>,
    column: Vec<usize>,
    value: Vec<f64>,
}

impl Entries {
    fn add(&mut self, row: usize, column: usize, value: f64) {
        self.row.push(row);
        self.column.push(column);
        self.value.push(value);
    }

    fn matrix(self, rows: usize, columns: usize) -> CscMatrix<f64> {
        CscMatrix::new_from_triplets(rows, columns, self.row, self.column, self.value)
    }
}

/// The program under construction: `P`, `q`, and the rows `A x + s = b`.
struct Program<'a> {
    problem: &'a Problem,
    /// Column of each drive's speed at place 1; its instants follow, as many.
    columns: Vec<usize>,
    quadratic: Entries,
    linear: Vec<f64>,
    rows: Entries,
    bounds: Vec<f64>,
}

impl Program<'_> {
    /// Column of a speed; the one at entry is given.
    fn speed(&self, drive: usize, place: usize) -> Option<usize> {
        (place > 0).then(|| self.columns[drive] + place - 1)
    }

    /// Column of an instant; the one of entry is given.
    fn instant(&self, drive: usize, place: usize) -> Option<usize> {
        let stretches = self.problem.drives[drive].lengths_m.len();
        (place > 0).then(|| self.columns[drive] + stretches + place - 1)
    }

    fn row(&mut self, entries: &[(Option<usize>, f64)], bound: f64) {
        let row = self.bounds.len();
        for &(column, value) in entries {
            if let Some(column) = column {
                self.rows.add(row, column, value);
            }
        }
        self.bounds.push(bound);
    }

    fn gradient(&mut self, column: Option<usize>, value: f64) {
        if let Some(column) = column {
            self.linear[column] += value;
        }
    }

    /// Adds a symmetric block over two columns, made positive semidefinite.
    fn curvature(&mut self, columns: [Option<usize>; 2], [aa, ab, bb]: [f64; 3]) {
        let [aa, ab, bb] = positive(aa, ab, bb);
        let [a, b] = columns;
        // Upper triangle: columns ascend.
        if let Some(a) = a {
            self.quadratic.add(a, a, aa);
        }
        if let (Some(a), Some(b)) = (a, b) {
            self.quadratic.add(a, b, ab);
        }
        if let Some(b) = b {
            self.quadratic.add(b, b, bb);
        }
    }

    /// Cost and dynamics of one drive: a row per stretch.
    fn drive(&mut self, at: usize, prices: &[f64]) {
        let problem = self.problem;
        let drive: &Drive = &problem.drives[at];
        for (stretch, second) in prices.iter().enumerate() {
            let (a, b) = (drive.speeds_mps[stretch], drive.speeds_mps[stretch + 1]);
            let (weight, length_m) = (drive.weights[stretch], drive.lengths_m[stretch]);
            let (sum, rise) = (a + b, b - a);
            let columns = [self.speed(at, stretch), self.speed(at, stretch + 1)];
            let instants = [self.instant(at, stretch), self.instant(at, stretch + 1)];
            let price = weight * problem.beta;
            self.gradient(instants[0], -price);
            self.gradient(instants[1], price);
            // Energy rise^2 sum / (4 length): by sum, by rise, and twice.
            let quarter = weight / (4.0 * length_m);
            let (by_sum, by_rise) = (quarter * rise * rise, quarter * 2.0 * rise * sum);
            self.gradient(columns[0], by_sum - by_rise);
            self.gradient(columns[1], by_sum + by_rise);
            let (rise_rise, rise_sum) = (quarter * 2.0 * sum, quarter * 2.0 * rise);
            // Duration 2 length / sum at what a second costs here, others included.
            let bent = second.max(0.0) * 4.0 * length_m / (sum * sum * sum);
            let block =
                [rise_rise - 2.0 * rise_sum + bent, bent - rise_rise, rise_rise + 2.0 * rise_sum + bent];
            self.curvature(columns, block);
            let shorter = 2.0 * length_m / (sum * sum);
            let entries =
                [(instants[1], 1.0), (instants[0], -1.0), (columns[0], shorter), (columns[1], shorter)];
            self.row(&entries, 0.0);
        }
    }

    /// Limits of one drive: trust region, speed, acceleration.
    fn limits(&mut self, at: usize, radius_mps: f64) {
        let problem = self.problem;
        let drive: &Drive = &problem.drives[at];
        let limits = &problem.vehicle;
        for place in 1..drive.places_m.len() {
            let v = drive.speeds_mps[place];
            let column = self.speed(at, place);
            self.row(&[(column, 1.0)], (limits.v_max_mps - v).clamp(0.0, radius_mps));
            self.row(&[(column, -1.0)], (v - SLOWEST_MPS).clamp(0.0, radius_mps));
            let (a, length_m) = (drive.speeds_mps[place - 1], drive.lengths_m[place - 1]);
            let u = 0.5 * (v * v - a * a) / length_m;
            let before = self.speed(at, place - 1);
            let (by_before, by_here) = (-a / length_m, v / length_m);
            if u > NEAR_LIMIT * limits.u_max_mps2 {
                self.row(&[(before, by_before), (column, by_here)], (limits.u_max_mps2 - u).max(0.0));
            }
            if u < NEAR_LIMIT * limits.u_min_mps2 {
                self.row(&[(before, -by_before), (column, -by_here)], (u - limits.u_min_mps2).max(0.0));
            }
        }
    }
}

/// The nearest positive semidefinite matrix, a hair inside.
fn positive(aa: f64, ab: f64, bb: f64) -> [f64; 3] {
    const HAIR: f64 = 1e-6;
    let (mean, half) = (0.5 * (aa + bb), 0.5 * (aa - bb));
    let radius = (half * half + ab * ab).sqrt();
    if mean - radius >= HAIR || radius == 0.0 {
        return [aa.max(HAIR), ab, bb.max(HAIR)];
    }
    // Eigenvalues mean +- radius with projectors (1 +- M / radius) / 2.
    let (high, low) = ((mean + radius).max(HAIR), HAIR);
    let (middle, spread) = (0.5 * (high + low), 0.5 * (high - low) / radius);
    [middle + spread * half, spread * ab, middle - spread * half]
}

/// Solves the program around the present drives; `None` when Clarabel does not.
pub(super) fn step(problem: &Problem, prices: &[Vec<f64>], radius_mps: f64) -> Option<Step> {
    let near: Vec<(usize, f64)> = problem
        .owes
        .iter()
        .enumerate()
        .map(|(at, owes)| (at, problem.slack_s(owes)))
        .filter(|(_, slack_s)| *slack_s < FAR_S)
        .collect();
    let mut columns = Vec::with_capacity(problem.drives.len());
    let mut unknowns = 0;
    for drive in &problem.drives {
        columns.push(unknowns);
        unknowns += 2 * drive.lengths_m.len();
    }
    let penalties = unknowns;
    unknowns += near.len();
    let mut linear = vec![0.0; unknowns];
    linear[penalties..].fill(problem.penalty);
    let mut program = Program {
        problem,
        columns,
        quadratic: Entries::default(),
        linear,
        rows: Entries::default(),
        bounds: Vec::new(),
    };
    for (at, prices) in prices.iter().enumerate() {
        program.drive(at, prices);
    }
    let equalities = program.bounds.len();
    for at in 0..problem.drives.len() {
        program.limits(at, radius_mps);
    }
    for (penalty, &(at, slack_s)) in (penalties..).zip(&near) {
        let owes = &problem.owes[at];
        let Passing { speed_mps, place, by_speeds, .. } =
            problem.drives[owes.to].passing(problem.target_m(owes));
        let end = (place + 1 < problem.drives[owes.to].places_m.len())
            .then(|| program.speed(owes.to, place + 1))
            .flatten();
        let entries = [
            (program.instant(owes.drive, owes.place), -1.0),
            (program.speed(owes.drive, owes.place), problem.vehicle.reaction_time_s / speed_mps),
            (program.instant(owes.to, place), 1.0),
            (program.speed(owes.to, place), by_speeds.0),
            (end, by_speeds.1),
            (Some(penalty), -1.0),
        ];
        program.row(&entries, slack_s);
        program.row(&[(Some(penalty), -1.0)], 0.0);
    }
    let Program { columns, quadratic, linear, rows, bounds, .. } = program;
    let (p, a) = (quadratic.matrix(unknowns, unknowns), rows.matrix(bounds.len(), unknowns));
    let cones: [SupportedConeT<f64>; 2] =
        [ZeroConeT(equalities), NonnegativeConeT(bounds.len() - equalities)];
    let settings = DefaultSettings {
        verbose: false,
        max_iter: 80,
        tol_gap_abs: 1e-7,
        tol_gap_rel: 1e-7,
        tol_feas: 1e-7,
        ..DefaultSettings::default()
    };
    let mut solver = DefaultSolver::new(&p, &linear, &a, &bounds, &cones, settings).ok()?;
    solver.solve();
    if !matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved) {
        return None;
    }
    let (x, z) = (&solver.solution.x, &solver.solution.z);
    let missed: f64 = near.iter().map(|(_, slack_s)| (-slack_s).max(0.0)).sum();
    let (mut speeds_mps, mut prices, mut row) = (Vec::new(), Vec::new(), 0);
    for (drive, &column) in problem.drives.iter().zip(&columns) {
        let stretches = drive.lengths_m.len();
        let mut speeds = drive.speeds_mps.clone();
        for (v, by) in speeds[1..].iter_mut().zip(&x[column..column + stretches]) {
            *v = (*v + by).clamp(SLOWEST_MPS, problem.vehicle.v_max_mps);
        }
        speeds_mps.push(speeds);
        prices.push(z[row..row + stretches].iter().map(|price| -price).collect());
        row += stretches;
    }
    Some(Step { speeds_mps, promised: problem.penalty * missed - solver.solution.obj_val, prices })
}

#[cfg(test)]
mod tests {
    use super::positive;

    #[test]
    fn blocks_become_positive_and_stay_when_they_are() {
        assert_eq!(positive(2.0, 0.5, 1.0), [2.0, 0.5, 1.0]);
        for (aa, ab, bb) in [(1.0, 3.0, -2.0), (-1.0, 0.0, -2.0), (0.0, 2.0, 0.0)] {
            let [a, b, c] = positive(aa, ab, bb);
            assert!(a >= 0.0 && c >= 0.0 && a * c - b * b >= -1e-12, "{a} {b} {c}");
        }
        // Eigenvalues 3 and -1 along the diagonals: only the first is left.
        let [a, b, c] = positive(1.0, 2.0, 1.0);
        assert!((a - 1.5).abs() < 1e-5 && (b - 1.5).abs() < 1e-5 && (c - 1.5).abs() < 1e-5);
    }
}
