//! The reference trajectory against brute force, the paper's equations, and its own promises.

use control_zones::control::reference::{Optimum, Problem, Reference, Terminal, optimal_terminal_speed_mps};
use control_zones::scenario::{PositionFeedback, ReferenceLaw};
use nalgebra::{Matrix4, Vector4};
use proptest::prelude::*;

const LAWS: [ReferenceLaw; 2] = [ReferenceLaw::Corrected, ReferenceLaw::AsPrinted];

/// Failing cases are printed in full and belong in a test of their own, not in a side file.
fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        failure_persistence: None,
        max_global_rejects: 100_000,
        ..ProptestConfig::default()
    }
}

/// Cost of the least-energy trajectory of a given duration.
fn cost_at(p: &Problem, t: f64) -> f64 {
    p.coefficients(t).cost(p.beta)
}

/// Minimum of `f` on `[low, high]`, where it must have a single one.
fn golden(f: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
    let ratio = 0.5 * (5.0_f64.sqrt() - 1.0);
    for _ in 0..80 {
        let (left, right) = (high - ratio * (high - low), low + ratio * (high - low));
        if f(left) < f(right) { high = right } else { low = left }
    }
    0.5 * (low + high)
}

/// All local minima of the cost over the duration: a dense logarithmic grid, each dip refined.
fn minima_by_brute_force(p: &Problem) -> Vec<f64> {
    // Beyond any duration that the tested ranges can make optimal; asserted by the callers, which
    // would find no minimum, or a better one, were it otherwise.
    let (first, last, n) = (0.02_f64, 4000.0_f64, 1500_i32);
    let step = (last / first).powf(1.0 / f64::from(n));
    let grid: Vec<f64> = (0..=n).map(|i| first * step.powi(i)).collect();
    let costs: Vec<f64> = grid.iter().map(|&t| cost_at(p, t)).collect();
    (1..grid.len() - 1)
        .filter(|&i| costs[i] < costs[i - 1] && costs[i] <= costs[i + 1])
        .map(|i| golden(|t| cost_at(p, t), grid[i - 1], grid[i + 1]))
        .collect()
}

fn least_cost_by_brute_force(p: &Problem) -> f64 {
    minima_by_brute_force(p).into_iter().map(|t| cost_at(p, t)).fold(f64::INFINITY, f64::min)
}

fn terminals() -> impl Strategy<Value = Terminal> {
    prop_oneof![
        6 => (0.0..30.0f64).prop_map(Terminal::Speed),
        1 => Just(Terminal::Speed(0.0)),
        3 => Just(Terminal::Free),
    ]
}

fn problems() -> impl Strategy<Value = Problem> {
    let v0 = prop_oneof![9 => 0.0..30.0f64, 1 => Just(0.0)];
    // Logarithmic in beta and length, so that the small ones are not left to chance.
    (v0, terminals(), 20.0_f64.ln()..1000.0_f64.ln(), 0.05_f64.ln()..10.0_f64.ln()).prop_map(
        |(v0_mps, terminal, length, beta)| Problem {
            beta: beta.exp(),
            v0_mps,
            length_m: length.exp(),
            terminal,
        },
    )
}

/// Fast entry, slow exit, short and cheap in time: where the cost tends to have two minima.
fn problems_with_two_minima() -> impl Strategy<Value = Problem> {
    (15.0..30.0f64, 0.0..6.0f64, 20.0..150.0f64, 0.05..0.4f64)
        .prop_map(|(v0_mps, w, length_m, beta)| Problem {
            beta,
            v0_mps,
            length_m,
            terminal: Terminal::Speed(w),
        })
        .prop_filter("one minimum only", |p| minima_by_brute_force(p).len() == 2)
}

fn assert_least_cost(p: &Problem) -> Result<(), TestCaseError> {
    let solved = p.solve(ReferenceLaw::Corrected).cost(p.beta);
    let brute = least_cost_by_brute_force(p);
    prop_assert!(solved <= brute * (1.0 + 1e-9), "{p:?}: {solved} is worse than brute force, {brute}");
    prop_assert!(solved >= brute * (1.0 - 1e-9), "{p:?}: {solved} beats brute force, {brute}: a bad oracle");
    Ok(())
}

/// The transversality condition of a law and the size of its largest term.
fn transversality(law: ReferenceLaw, p: &Problem, o: &Optimum) -> (f64, f64) {
    let b_term = match law {
        ReferenceLaw::Corrected => 0.5 * o.b * o.b,
        ReferenceLaw::AsPrinted => 0.5 * o.b,
    };
    let ac = o.a * p.v0_mps;
    (p.beta - b_term + ac, p.beta.max(b_term.abs()).max(ac.abs()))
}

/// The printed cubic `equ:tm`, or its analogue with `u(T) = 0` in place of the terminal speed, term by
/// term.
fn printed_terms(p: &Problem, t: f64) -> [f64; 4] {
    let (beta, v0, l) = (p.beta, p.v0_mps, p.length_m);
    match p.terminal {
        Terminal::Speed(w) => [
            beta * t.powi(3),
            (2.0 * v0 + w) * t.powi(2),
            (-3.0 * l + 6.0 * v0 * w + 6.0 * v0 * v0) * t,
            -12.0 * l * v0,
        ],
        // b = 3 (L - v0 T) / T^2, a = -b / T in beta - b/2 + a v0 = 0, times 2 T^3.
        Terminal::Free => {
            [2.0 * beta * t.powi(3), 3.0 * v0 * t.powi(2), (-3.0 * l + 6.0 * v0 * v0) * t, -6.0 * l * v0]
        }
    }
}

/// `a` to `d` from the linear system `equ:ucp_vm_1` to `equ:ucp_vm_4` for a given duration.
fn coefficients_by_lu(p: &Problem, w: f64, t: f64) -> Vector4<f64> {
    let system = Matrix4::new(
        0.0,
        0.0,
        1.0,
        0.0, //
        0.5 * t * t,
        t,
        1.0,
        0.0, //
        0.0,
        0.0,
        0.0,
        1.0, //
        t * t * t / 6.0,
        0.5 * t * t,
        t,
        1.0,
    );
    let right = Vector4::new(p.v0_mps, w, 0.0, p.length_m);
    system.lu().solve(&right).expect("regular for every duration but 0")
}

fn place(p: &Problem, optimum: Optimum, start_s: f64, origin_m: f64) -> Reference {
    Reference { start_s, origin_m, v0_mps: p.v0_mps, optimum, terminal: p.terminal }
}

/// Least speed on the plan: at an end or where the acceleration vanishes.
fn least_speed(r: &Reference) -> f64 {
    let t = r.optimum.duration_s;
    let turn = (-r.optimum.b / r.optimum.a).clamp(0.0, t);
    let turn = if turn.is_nan() { 0.0 } else { turn };
    r.speed_mps(0.0).min(r.speed_mps(t)).min(r.speed_mps(turn))
}

proptest! {
    #![proptest_config(cases(2000))]

    /// Wherever the search begins.
    #[test]
    fn near_a_guess_is_what_is_found_afresh(p in problems(), stretch in prop_oneof![0.5..2.0f64, Just(0.0), -1.0..0.0f64]) {
        let fresh = p.solve_forward(ReferenceLaw::Corrected);
        let near = p.solve_near(stretch * fresh.duration_s);
        prop_assert!((near.duration_s - fresh.duration_s).abs() <= 1e-8 * fresh.duration_s, "{near:?} {fresh:?}");
    }

    #[test]
    fn corrected_plan_has_the_least_cost_over_all_durations(p in problems()) {
        assert_least_cost(&p)?;
    }

    #[test]
    fn both_laws_satisfy_their_transversality_condition(p in problems()) {
        for law in LAWS {
            let o = p.solve(law);
            let (residual, size) = transversality(law, &p, &o);
            prop_assert!(residual.abs() <= 1e-9 * size, "{law:?} {p:?} {o:?}: {residual}");
        }
    }

    #[test]
    fn printed_duration_is_a_root_of_the_printed_cubic(p in problems()) {
        let t = p.solve(ReferenceLaw::AsPrinted).duration_s;
        prop_assert!(t > 0.0 && t.is_finite());
        let terms = printed_terms(&p, t);
        let size = terms.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
        let residual: f64 = terms.iter().sum();
        prop_assert!(residual.abs() <= 1e-12 * size, "{p:?}: T {t}, residual {residual} of {size}");
    }

    #[test]
    fn plans_meet_their_boundary_conditions(p in problems()) {
        for law in LAWS {
            let o = p.solve(law);
            let plan = place(&p, o, 3.0, 7.0);
            prop_assert!(o.duration_s > 0.0 && o.duration_s.is_finite());
            prop_assert_eq!(plan.speed_mps(0.0), p.v0_mps);
            prop_assert_eq!(plan.distance_m(0.0), 0.0);
            prop_assert_eq!(plan.exit_time_s(), 3.0 + o.duration_s);
            // Terms as large as v0 T cancel at the end of a plan that brakes hard.
            let size = p.length_m + p.v0_mps * o.duration_s;
            prop_assert!((plan.distance_m(o.duration_s) - p.length_m).abs() <= 1e-12 * size, "{p:?}");
            match p.terminal {
                Terminal::Speed(w) => {
                    prop_assert!((plan.speed_mps(o.duration_s) - w).abs() <= 1e-12 * (1.0 + size));
                    prop_assert_eq!(plan.exit_speed_mps(), w);
                }
                Terminal::Free => {
                    prop_assert!(plan.acceleration_mps2(o.duration_s).abs() <= 1e-12 * (1.0 + o.b.abs()));
                    prop_assert_eq!(plan.exit_speed_mps(), plan.speed_mps(o.duration_s));
                }
            }
        }
    }

    /// For any duration, not only the optimal one.
    #[test]
    fn coefficients_solve_the_linear_system(p in problems(), t in 0.5..100.0f64) {
        let o = p.coefficients(t);
        // A free terminal speed is the one that the plan itself ends with.
        let w = place(&p, o, 0.0, 0.0).speed_mps(t);
        let w = if let Terminal::Speed(w) = p.terminal { w } else { w };
        let x = coefficients_by_lu(&p, w, t);
        let size = (p.length_m / t + p.v0_mps + w.abs()) / t;
        prop_assert!((x[0] - o.a).abs() <= 1e-11 * size / t, "{p:?} {t}: a {} but LU {}", o.a, x[0]);
        prop_assert!((x[1] - o.b).abs() <= 1e-11 * size, "{p:?} {t}: b {} but LU {}", o.b, x[1]);
        prop_assert!((x[2] - p.v0_mps).abs() <= 1e-12 * (1.0 + p.v0_mps) && x[3].abs() <= 1e-12);
    }

    /// The closed form of the energy against Simpson's rule, which is exact for u^2, a quadratic.
    #[test]
    fn energy_is_the_integral_of_half_the_squared_acceleration(p in problems(), t in 0.5..100.0f64) {
        let o = p.coefficients(t);
        let plan = place(&p, o, 0.0, 0.0);
        let c = |s: f64| 0.5 * plan.acceleration_mps2(s).powi(2);
        let simpson = t / 6.0 * (c(0.0) + 4.0 * c(0.5 * t) + c(t));
        prop_assert!((o.energy() - simpson).abs() <= 1e-11 * (c(0.0) + c(t)) * t + 1e-12);
        prop_assert!((o.cost(p.beta) - o.energy() - p.beta * t).abs() <= 1e-12 * o.cost(p.beta));
    }

    #[test]
    fn corrected_perturbation_equals_a_fresh_plan(p in problems(), w in 0.0..30.0f64) {
        let law = ReferenceLaw::Corrected;
        let old = p.solve_forward(law);
        let new = Problem { terminal: Terminal::Speed(w), ..p };
        let perturbed = new.perturb(law, &old, p.terminal).cost(p.beta);
        let fresh = new.solve_forward(law).cost(p.beta);
        prop_assert!((perturbed - fresh).abs() <= 1e-9 * fresh, "{p:?} -> {w}: {perturbed} for {fresh}");
    }

    /// The plan for driving is the cheapest one, unless that one overshoots the end and comes back.
    #[test]
    fn forward_plans_only_give_up_cost_to_avoid_reversing(p in problems()) {
        let law = ReferenceLaw::Corrected;
        let (best, forward) = (p.solve(law), p.solve_forward(law));
        let least_speed = |o: Optimum| {
            let plan = place(&p, o, 0.0, 0.0);
            (0..=400).map(|i| plan.speed_mps(o.duration_s * f64::from(i) / 400.0)).fold(f64::MAX, f64::min)
        };
        prop_assert!(forward.cost(p.beta) >= best.cost(p.beta));
        if forward != best {
            prop_assert!(least_speed(best) < 0.0, "{p:?}: {best:?} could have been driven");
            prop_assert!(forward.duration_s < best.duration_s);
        }
    }

    /// A vehicle's plan is perturbed again and again on its way: errors must not pile up.
    #[test]
    fn corrected_perturbations_in_a_row_equal_a_fresh_plan(
        p in problems(), ws in prop::collection::vec(terminals(), 1..12),
    ) {
        let law = ReferenceLaw::Corrected;
        let (mut now, mut optimum) = (p, p.solve_forward(law));
        for terminal in ws {
            let next = Problem { terminal, ..p };
            optimum = next.perturb(law, &optimum, now.terminal);
            now = next;
        }
        let (perturbed, fresh) = (optimum.cost(p.beta), now.solve_forward(law).cost(p.beta));
        prop_assert!((perturbed - fresh).abs() <= 1e-9 * fresh, "{now:?}: {perturbed} for {fresh}");
    }

    #[test]
    fn printed_perturbation_is_the_papers_formula(p in problems(), w in 0.0..30.0f64) {
        let Terminal::Speed(w_old) = p.terminal else { return Ok(()) };
        let law = ReferenceLaw::AsPrinted;
        let old = p.solve(law);
        let new = Problem { terminal: Terminal::Speed(w), ..p };
        let (t, v0, l) = (old.duration_s, p.v0_mps, p.length_m);
        let f_v = t.powi(2) + 6.0 * v0 * t;
        let f_t = 3.0 * p.beta * t.powi(2) + (4.0 * v0 + 2.0 * w) * t - 3.0 * l
            + 6.0 * v0 * w + 6.0 * v0.powi(2);
        let expected = t - f_v / f_t * (w - w_old);
        let got = new.perturb(law, &old, p.terminal);
        if expected > 0.0 {
            // Where the denominator all but vanishes, so do the digits of both.
            let size = expected.max(f_v * 30.0 / f_t.abs() * 1e3);
            prop_assert!((got.duration_s - expected).abs() <= 1e-12 * size, "{got:?} for {expected}");
            prop_assert_eq!(got, new.coefficients(got.duration_s));
        } else {
            // The formula knows no bound: where it leaves the positive numbers, the cubic is solved.
            prop_assert_eq!(got, new.solve(law));
        }
    }

    #[test]
    fn transitions_to_and_from_a_free_speed_solve_afresh(p in problems(), w in 0.0..30.0f64) {
        let (free, speed) =
            (Problem { terminal: Terminal::Free, ..p }, Problem { terminal: Terminal::Speed(w), ..p });
        for law in LAWS {
            let (of_free, of_speed) = (free.solve_forward(law), speed.solve_forward(law));
            prop_assert_eq!(free.perturb(law, &of_speed, speed.terminal), of_free);
            prop_assert_eq!(speed.perturb(law, &of_free, free.terminal), of_speed);
        }
    }

    #[test]
    fn exact_feedback_is_at_the_vehicles_position(
        p in problems(), fraction in 0.0..1.0f64, late in -5.0..5.0f64,
    ) {
        for law in LAWS {
            let plan = place(&p, p.solve(law), 40.0, 100.0);
            let x = fraction * p.length_m;
            let (v, u) = plan.at(PositionFeedback::Exact, 40.0 + fraction * plan.optimum.duration_s + late, 100.0 + x);
            let Optimum { a, b, duration_s } = plan.optimum;
            // The acceleration tells the time, unless it hardly changes.
            if (a * duration_s).abs() > 1e-3 {
                let t = (u - b) / a;
                let size = p.length_m + p.v0_mps * duration_s;
                prop_assert!((plan.distance_m(t) - x).abs() <= 1e-9 * size, "{law:?} {p:?} {x}: {t}");
                prop_assert!((plan.speed_mps(t) - v).abs() <= 1e-9 * (1.0 + v.abs()));
            }
        }
    }

    #[test]
    fn approximate_feedback_equals_exact_on_the_plan(p in problems(), fraction in 0.0..1.0f64) {
        for law in LAWS {
            let plan = place(&p, p.solve(law), 40.0, 100.0);
            // A plan that turns back is at one position twice, and either is right.
            if least_speed(&plan) < -1e-9 {
                continue;
            }
            let elapsed = fraction * plan.optimum.duration_s;
            let (t, x) = (40.0 + elapsed, 100.0 + plan.distance_m(elapsed));
            let (v1, u1) = plan.at(PositionFeedback::Approximate, t, x);
            let (v2, u2) = plan.at(PositionFeedback::Exact, t, x);
            prop_assert!((v1 - plan.speed_mps(elapsed)).abs() <= 1e-6);
            prop_assert!((v1 - v2).abs() <= 1e-6 && (u1 - u2).abs() <= 1e-6, "{law:?} {p:?} {fraction}");
        }
    }

    #[test]
    fn feedback_stays_on_the_plan(
        p in problems(), late in -100.0..1000.0f64, beyond in 0.0..500.0f64,
    ) {
        for law in LAWS {
            let plan = place(&p, p.solve(law), 40.0, 100.0);
            let end = plan.optimum.duration_s;
            if least_speed(&plan) < 0.0 {
                continue;
            }
            let after = plan.at(PositionFeedback::Exact, 40.0 + late, 100.0 + p.length_m + beyond);
            prop_assert!((after.0 - plan.speed_mps(end)).abs() <= 1e-6, "{law:?} {p:?}: {after:?}");
            prop_assert!((after.1 - plan.acceleration_mps2(end)).abs() <= 1e-6);
            let before = plan.at(PositionFeedback::Exact, 40.0 + late, 100.0 - beyond);
            prop_assert!((before.0 - p.v0_mps).abs() <= 1e-6, "{law:?} {p:?}: {before:?}");
            prop_assert!((before.1 - plan.optimum.b).abs() <= 1e-6);
            // At the plan's end any position beyond it is beyond for the approximation too.
            let past = plan.at(PositionFeedback::Approximate, 40.0 + end, 100.0 + p.length_m + beyond);
            prop_assert!((past.0 - plan.speed_mps(end)).abs() <= 1e-6, "{law:?} {p:?}: {past:?}");
            prop_assert!((past.1 - plan.acceleration_mps2(end)).abs() <= 1e-6);
        }
    }

    /// Also for plans over next to nothing, which `replan = "from_state"` makes, and long after the end.
    #[test]
    fn feedback_is_finite_and_within_the_plan(
        p in problems(), length in 1e-3..2000.0f64, late in -100.0..1e4f64, x in -100.0..3000.0f64,
    ) {
        for p in [p, Problem { length_m: length, ..p }, Problem { length_m: length, v0_mps: 0.0, ..p }] {
            for law in LAWS {
                let plan = place(&p, p.solve(law), 40.0, 100.0);
                let end = plan.optimum.duration_s;
                let (u0, u1) = (plan.acceleration_mps2(0.0), plan.acceleration_mps2(end));
                for feedback in [PositionFeedback::Approximate, PositionFeedback::Exact] {
                    let (v, u) = plan.at(feedback, 40.0 + late, x);
                    prop_assert!(v.is_finite() && u.is_finite(), "{law:?} {feedback:?} {p:?}");
                    let rounding = 1e-12 * (u0.abs() + u1.abs());
                    prop_assert!(u >= u0.min(u1) - rounding && u <= u0.max(u1) + rounding);
                }
            }
        }
    }
}

proptest! {
    #![proptest_config(cases(500))]

    #[test]
    fn corrected_plan_has_the_least_cost_where_there_are_two_minima(p in problems_with_two_minima()) {
        assert_least_cost(&p)?;
    }

    #[test]
    fn optimal_terminal_speed_is_the_cheapest_of_all(p in problems()) {
        let (law, beta, v0, length) = (ReferenceLaw::Corrected, p.beta, p.v0_mps, p.length_m);
        let cost = |w: f64| {
            let terminal = Terminal::Speed(w);
            Problem { beta, v0_mps: v0, length_m: length, terminal }.solve(law).cost(beta)
        };
        let grid: Vec<f64> = (0..=400).map(|i| 0.5 * f64::from(i)).collect();
        let best = grid.iter().copied().fold(0.0, |m, w| if cost(w) < cost(m) { w } else { m });
        let brute = golden(cost, (best - 0.5).max(0.0), best + 0.5);
        let w = optimal_terminal_speed_mps(law, beta, v0, length);
        prop_assert!(cost(w) <= cost(brute) * (1.0 + 1e-9), "{p:?}: {w} costs more than {brute}");
        // A flat minimum: half the digits of the cost, and a curvature that falls with the length.
        prop_assert!((w - brute).abs() <= 1e-5 * (1.0 + w), "{p:?}: {w} but brute force {brute}");
    }
}

/// Both minima win somewhere, so that a solver that always took one of them would be found out. And
/// the late one is never driven: it overshoots the end and comes back, which no vehicle here can.
#[test]
fn either_minimum_can_be_the_best_one() {
    let (mut early, mut late) = (0, 0);
    for v0 in [18.0, 22.0, 26.0, 30.0] {
        for w in [0.0, 3.0, 6.0] {
            for length_m in [20.0, 50.0, 100.0, 150.0] {
                for beta in [0.05, 0.1, 0.2, 0.4, 0.8] {
                    let p = Problem { beta, v0_mps: v0, length_m, terminal: Terminal::Speed(w) };
                    let minima = minima_by_brute_force(&p);
                    let [first, second] = minima[..] else { continue };
                    let solved = p.solve(ReferenceLaw::Corrected);
                    let late_wins = cost_at(&p, second) < cost_at(&p, first);
                    let best = if late_wins { second } else { first };
                    assert!((solved.duration_s - best).abs() < 1e-5 * best, "{p:?}: {solved:?}, {minima:?}");
                    *(if late_wins { &mut late } else { &mut early }) += 1;
                    let slowest = |t| least_speed(&place(&p, p.coefficients(t), 0.0, 0.0));
                    assert!(slowest(first) >= -1e-9, "{p:?}: the early minimum turns back");
                    assert!(slowest(second) < 0.0, "{p:?}: the late minimum is driven forwards");
                }
            }
        }
    }
    println!("two minima: the early one wins {early} times, the late one {late} times");
    assert!(early >= 5 && late >= 5, "early {early}, late {late}");
}

/// From rest the cubic loses its constant term; to rest, the quartic's sums their second half.
#[test]
fn plans_from_rest_and_to_rest() {
    for beta in [0.05, 2.0 / 3.0, 10.0] {
        for length_m in [1e-3, 20.0, 200.0, 1000.0] {
            let rest = |terminal| Problem { beta, v0_mps: 0.0, length_m, terminal };
            // From rest to rest: beta T^4 = 18 L^2; symmetric about the middle.
            let o = rest(Terminal::Speed(0.0)).solve(ReferenceLaw::Corrected);
            let t = (18.0 * length_m * length_m / beta).sqrt().sqrt();
            assert!((o.duration_s - t).abs() <= 1e-12 * t, "{o:?}: {t}");
            assert!((o.b + 0.5 * o.a * t).abs() <= 1e-12 * o.b);
            // As printed the same problem has beta T^2 = 3 L.
            let o = rest(Terminal::Speed(0.0)).solve(ReferenceLaw::AsPrinted);
            let t = (3.0 * length_m / beta).sqrt();
            assert!((o.duration_s - t).abs() <= 1e-12 * t, "{o:?}: {t}");
            // From rest, free: beta T^4 = 4.5 L^2, and 2 beta T^2 = 3 L as printed.
            let o = rest(Terminal::Free).solve(ReferenceLaw::Corrected);
            let t = (4.5 * length_m * length_m / beta).sqrt().sqrt();
            assert!((o.duration_s - t).abs() <= 1e-12 * t, "{o:?}: {t}");
            let o = rest(Terminal::Free).solve(ReferenceLaw::AsPrinted);
            let t = (1.5 * length_m / beta).sqrt();
            assert!((o.duration_s - t).abs() <= 1e-12 * t, "{o:?}: {t}");
            // From next to rest: the root must not jump.
            for law in LAWS {
                for terminal in [Terminal::Free, Terminal::Speed(0.0), Terminal::Speed(15.0)] {
                    let at_rest = rest(terminal).solve(law).duration_s;
                    let moving = Problem { v0_mps: 1e-9, ..rest(terminal) }.solve(law).duration_s;
                    assert!(
                        (moving - at_rest).abs() <= 1e-4 * at_rest,
                        "{law:?} {terminal:?}: {moving}, {at_rest}"
                    );
                }
            }
        }
    }
}

/// The printed update is one Newton step on the printed cubic, so its error falls with the square of
/// the change.
#[test]
fn printed_perturbation_is_of_first_order() {
    let law = ReferenceLaw::AsPrinted;
    let with = |w| Problem { beta: 2.0 / 3.0, v0_mps: 15.0, length_m: 200.0, terminal: Terminal::Speed(w) };
    let old = with(16.0).solve(law);
    let error = |dw: f64| {
        let fresh = with(16.0 + dw).solve(law).duration_s;
        (with(16.0 + dw).perturb(law, &old, Terminal::Speed(16.0)).duration_s - fresh).abs()
    };
    for dw in [4.0, -4.0, 1.0, -1.0] {
        let ratio = error(dw) / error(0.5 * dw);
        assert!(ratio > 3.0 && ratio < 5.0, "halving {dw} divides the error by {ratio}");
    }
}

/// How far the misprint matters where the paper drives: the design brief gives up to 1.8 % in the
/// duration and up to 0.15 % in the cost over 15 cases that it does not list; these are 15 of the kind.
#[test]
fn misprint_costs_little_where_the_paper_drives() {
    let (mut worst_t, mut worst_cost) = (0.0_f64, 0.0_f64);
    for v0_mps in [10.0, 12.5, 15.0, 17.5, 20.0] {
        for w in [12.0, 16.0, 20.0] {
            let p = Problem { beta: 2.0 / 3.0, v0_mps, length_m: 200.0, terminal: Terminal::Speed(w) };
            let (right, printed) = (p.solve(ReferenceLaw::Corrected), p.solve(ReferenceLaw::AsPrinted));
            worst_t = worst_t.max((printed.duration_s / right.duration_s - 1.0).abs());
            worst_cost = worst_cost.max(printed.cost(p.beta) / right.cost(p.beta) - 1.0);
            assert!(printed.cost(p.beta) >= right.cost(p.beta) * (1.0 - 1e-12), "{p:?}: the misprint wins");
        }
    }
    println!("misprint: T off by up to {:.2} %, cost by up to {:.3} %", 100.0 * worst_t, 100.0 * worst_cost);
    assert!(worst_t > 0.001 && worst_t < 0.05, "{worst_t}");
    assert!(worst_cost > 1e-5 && worst_cost < 0.005, "{worst_cost}");
}
