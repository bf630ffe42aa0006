//! The closed form of the tracking program against Clarabel, brute force and the optimality conditions.

use control_zones::control::clarabel;
use control_zones::control::qp::{self, Tracking};
use control_zones::control::rows::{Interval, Row, Rows};
use control_zones::vehicle::Inequality;
use proptest::prelude::*;

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

/// A number spread evenly over orders of magnitude.
fn magnitude(low: f64, high: f64) -> impl Strategy<Value = f64> {
    (low.ln()..high.ln()).prop_map(f64::exp)
}

fn trackings() -> impl Strategy<Value = Tracking> {
    let error = prop_oneof![
        6 => -10.0..10.0f64,
        1 => Just(0.0),
        1 => magnitude(1e-9, 1e-1),
        1 => magnitude(1e-9, 1e-1).prop_map(|y| -y),
    ];
    // The scenario's weight is beta, about 1; users may ask for a hard CLF row.
    let weight = prop_oneof![1 => Just(0.0), 2 => magnitude(1e-3, 1.0), 2 => magnitude(1.0, 1e6)];
    (-10.0..10.0f64, error, 0.1..20.0f64, weight).prop_map(|(u_ref_mps2, error_mps, rate, slack_weight)| {
        Tracking { u_ref_mps2, error_mps, clf_rate_per_s: rate, slack_weight }
    })
}

/// The rows of one program, as the law builds them: limits, then lower and upper rows.
#[derive(Clone, Debug)]
struct Program {
    limits: (f64, f64),
    at_least: Vec<f64>,
    at_most: Vec<Inequality>,
}

impl Program {
    fn interval(&self) -> Interval {
        let mut interval = Interval::limits(self.limits.0, self.limits.1);
        self.add(&mut interval);
        interval
    }

    fn list(&self) -> Vec<(Inequality, Row)> {
        let mut rows = Vec::new();
        rows.at_least(self.limits.0, Row::UMin);
        rows.at_most(Inequality { coefficient: 1.0, bound: self.limits.1 }, Row::UMax);
        self.add(&mut rows);
        rows
    }

    fn add<R: Rows>(&self, rows: &mut R) {
        for &low in &self.at_least {
            rows.at_least(low, Row::VMin);
        }
        for &row in &self.at_most {
            rows.at_most(row, Row::Merge);
        }
    }
}

fn limits() -> impl Strategy<Value = (f64, f64)> {
    (-8.0..-1.0f64, 1.0..8.0f64)
}

/// Coefficients of upper rows: ordinary ones, and `(phi/L) x` next to the origin, down to 0.
fn coefficients() -> impl Strategy<Value = f64> {
    prop_oneof![4 => 0.05..3.0f64, 3 => magnitude(1e-9, 1.0), 1 => Just(0.0)]
}

/// Distance from a feasible point to a row: touching it, near it, or far away.
fn slacks() -> impl Strategy<Value = f64> {
    prop_oneof![1 => Just(0.0), 3 => 0.0..3.0f64, 1 => magnitude(1e-6, 1e6)]
}

/// Programs with at least one feasible acceleration, `limits.0 + fraction * (limits.1 - limits.0)`.
///
/// The lower rows may touch it, the upper ones stay a little off: a set of one point is empty or not by
/// rounding, and no solver is asked to tell.
fn feasible_programs() -> impl Strategy<Value = Program> {
    (
        limits(),
        0.0..0.999f64,
        magnitude(1e-4, 1.0),
        prop::collection::vec(slacks(), 0..3),
        prop::collection::vec((coefficients(), slacks()), 0..6),
    )
        .prop_map(|(limits, fraction, width, lower, upper)| {
            let u = limits.0 + fraction * (limits.1 - limits.0);
            let at_least = lower.into_iter().map(|slack| u - slack).collect();
            let at_most = upper
                .into_iter()
                // A slack in u, so that small coefficients bind as often as others; a row without u
                // needs it in its bound.
                .map(|(c, slack)| {
                    let bound = if c == 0.0 { width + slack } else { c * (u + width + slack) };
                    Inequality { coefficient: c, bound }
                })
                .collect();
            Program { limits, at_least, at_most }
        })
}

/// A feasible program with one more row that contradicts one of the lower ones by a margin.
fn infeasible_programs() -> impl Strategy<Value = Program> {
    let margin = magnitude(1e-4, 1e2);
    (feasible_programs(), coefficients(), margin, any::<prop::sample::Index>()).prop_map(
        |(mut program, c, margin, place)| {
            let low = program.interval().low;
            let bound = if c == 0.0 { -margin } else { c * (low - margin) };
            let place = place.index(program.at_most.len() + 1);
            program.at_most.insert(place, Inequality { coefficient: c, bound });
            program
        },
    )
}

/// Derivative of the objective, from its definition.
fn derivative(t: &Tracking, u: f64) -> f64 {
    let y = t.error_mps;
    let slack = (2.0 * y * u + t.clf_rate_per_s * y * y).max(0.0);
    2.0 * t.slack_weight * slack * 2.0 * y + (u - t.u_ref_mps2)
}

proptest! {
    #![proptest_config(cases(12_000))]

    #[test]
    fn closed_form_equals_clarabel(tracking in trackings(), program in feasible_programs()) {
        let exact = qp::solve(&tracking, &program.interval());
        let u = exact.expect("a feasible point was built in");
        let reference = clarabel::solve(&tracking, &program.list());
        prop_assert!(reference.is_some(), "Clarabel finds it infeasible");
        let reference = reference.unwrap_or(f64::NAN);
        prop_assert!((u - reference).abs() <= 1e-6, "closed form {u}, Clarabel {reference}");
    }

    #[test]
    fn closed_form_satisfies_the_optimality_conditions(
        tracking in trackings(), program in feasible_programs(),
    ) {
        let interval = program.interval();
        let u = qp::solve(&tracking, &interval).expect("a feasible point was built in");
        prop_assert!(u >= interval.low && u <= interval.high);
        for (row, _) in program.list() {
            let rounding = 1e-12 * (row.coefficient * u).abs().max(row.bound.abs());
            prop_assert!(row.coefficient * u <= row.bound + rounding, "{row:?} at {u}");
        }
        let y = tracking.error_mps;
        let curvature = 1.0 + 8.0 * tracking.slack_weight * y * y;
        let size = curvature * (20.0 + tracking.clf_rate_per_s * y.abs());
        let slope = derivative(&tracking, u);
        // The multiplier of the row at an end has the sign that keeps u from going on.
        prop_assert!(slope <= 1e-12 * size || u == interval.low, "{slope} at {u} in {interval:?}");
        prop_assert!(slope >= -1e-12 * size || u == interval.high, "{slope} at {u} in {interval:?}");
    }

    #[test]
    fn closed_form_is_not_beaten_by_a_grid(tracking in trackings(), program in feasible_programs()) {
        let interval = program.interval();
        let u = qp::solve(&tracking, &interval).expect("a feasible point was built in");
        let best = tracking.objective(u);
        for i in 0..=100 {
            let other = interval.low + (interval.high - interval.low) * f64::from(i) / 100.0;
            let cost = tracking.objective(other);
            prop_assert!(best <= cost + 1e-12 * (1.0 + cost.abs()), "{other} costs {cost}, {u} {best}");
        }
    }

    /// The objective in u is that of `equ:ocbf_qp` with the best slack; here with any other slack.
    #[test]
    fn best_slack_is_best(tracking in trackings(), u in -8.0..8.0f64, more in 0.0..10.0f64) {
        let y = tracking.error_mps;
        let least = 2.0 * y * u + tracking.clf_rate_per_s * y * y;
        for slack in [least, least + more, least.max(0.0), least.max(0.0) + more, least.max(more)] {
            let cost = tracking.slack_weight * slack * slack + 0.5 * (u - tracking.u_ref_mps2).powi(2);
            prop_assert!(tracking.objective(u) <= cost * (1.0 + 1e-12));
        }
    }
}

proptest! {
    #![proptest_config(cases(4_000))]

    #[test]
    fn both_find_contradicting_rows_infeasible(tracking in trackings(), program in infeasible_programs()) {
        prop_assert_eq!(qp::solve(&tracking, &program.interval()), None);
        prop_assert_eq!(clarabel::solve(&tracking, &program.list()), None);
    }
}

/// Some programs one after the other, one in four without a feasible point.
fn sequences() -> impl Strategy<Value = Vec<(Tracking, Program)>> {
    let programs = prop_oneof![3 => feasible_programs().boxed(), 1 => infeasible_programs().boxed()];
    prop::collection::vec((trackings(), programs), 1..20)
}

proptest! {
    #![proptest_config(cases(400))]

    /// A solver that is given one program after another forgets each before the next.
    #[test]
    fn a_reused_solver_answers_each_program_like_the_closed_form(sequence in sequences()) {
        let longest = sequence.iter().map(|(_, program)| program.list().len()).max().unwrap_or(0);
        let mut reused = clarabel::Reused::new(longest);
        for (tracking, program) in &sequence {
            match (qp::solve(tracking, &program.interval()), reused.solve(tracking, &program.list())) {
                (Some(u), Some(reference)) => {
                    prop_assert!((u - reference).abs() <= 1e-6, "closed form {u}, Clarabel {reference}");
                }
                (ours, theirs) => prop_assert_eq!(ours, theirs),
            }
        }
    }
}

/// The row that sets an end is the one reported, and the first of equals.
#[test]
fn interval_names_the_rows_that_set_its_ends() {
    let mut interval = Interval::limits(-4.0, 4.0);
    interval.at_least(-5.0, Row::VMin);
    interval.at_most(Inequality { coefficient: 2.0, bound: 8.0 }, Row::VMax);
    assert_eq!((interval.low_row, interval.high_row), (Row::UMin, Row::UMax));
    interval.at_least(-1.0, Row::VMin);
    interval.at_most(Inequality { coefficient: 2.0, bound: 6.0 }, Row::RearEnd);
    interval.at_most(Inequality { coefficient: 0.0, bound: 0.0 }, Row::Merge);
    assert_eq!((interval.low, interval.low_row), (-1.0, Row::VMin));
    assert_eq!((interval.high, interval.high_row), (3.0, Row::RearEnd));
    assert!(!interval.is_empty());
    interval.at_most(Inequality { coefficient: 0.0, bound: -1e-300 }, Row::Merge);
    assert!(interval.is_empty() && interval.high_row == Row::Merge);
}

/// Without the CLF row the wish is the reference; with a hard one the error decays at the rate asked
/// for, `2 y u = -epsilon y^2`.
#[test]
fn slack_weight_goes_from_the_reference_to_the_rate() {
    let with =
        |slack_weight| Tracking { u_ref_mps2: 1.0, error_mps: 0.5, clf_rate_per_s: 10.0, slack_weight };
    assert_eq!(with(0.0).free_minimum_mps2(), 1.0);
    assert!((with(1e9).free_minimum_mps2() + 2.5).abs() < 1e-8);
    let mut last = 1.0;
    for weight in [1e-3, 1e-1, 1.0, 1e1, 1e3] {
        let u = with(weight).free_minimum_mps2();
        assert!(u < last && u > -2.5, "{weight}: {u}");
        last = u;
    }
    // A row that the reference satisfies does nothing, however large the weight.
    assert_eq!(Tracking { u_ref_mps2: -3.0, ..with(1e9) }.free_minimum_mps2(), -3.0);
}

/// A plain program that makes Clarabel's full-length iteration cycle until its limit, 1.8 m/s^2 off.
#[test]
fn clarabel_is_retried_where_it_cycles() {
    let tracking = Tracking { u_ref_mps2: 0.0, error_mps: 0.0, clf_rate_per_s: 0.1, slack_weight: 0.0 };
    let program = Program {
        limits: (-3.496254858824285, 1.7376054896745794),
        at_least: vec![-1.8377795265163683],
        at_most: vec![
            Inequality { coefficient: 0.05, bound: 16.87976548189509 },
            Inequality { coefficient: 0.05, bound: 0.6468465763520684 },
        ],
    };
    let u = clarabel::solve(&tracking, &program.list()).expect("0 is feasible");
    assert!(u.abs() <= 1e-6, "{u}");
}

/// A slack of 150 over the whole feasible set keeps every attempt from the tolerance asked for: the first
/// stalls next to the optimum, the last 4e-7 beyond a row, which is no proof that nothing satisfies the rows.
#[test]
fn clarabel_is_believed_where_it_stalls_next_to_the_optimum() {
    let tracking = Tracking {
        u_ref_mps2: 1.6345499838654811,
        error_mps: -24.82493108058734,
        clf_rate_per_s: 12.659730617512835,
        slack_weight: 3.603168538672143,
    };
    let upper = [
        (1.0, 25.481191939658103),
        (1.8, 46.76882292467465),
        (1.0, 20.281102870741126),
        (1.649472170119076, 6.628471430508238),
        (1.0813385450861541, 11.224027960268186),
    ];
    let program = Program {
        limits: (-4.0, 4.0),
        at_least: vec![-4.518808060341896],
        at_most: upper.map(|(coefficient, bound)| Inequality { coefficient, bound }).into(),
    };
    assert_eq!(qp::solve(&tracking, &program.interval()), Some(4.0));
    let u = clarabel::solve(&tracking, &program.list()).expect("4 is feasible");
    assert!((u - 4.0).abs() <= 1e-9, "{u}");
}
