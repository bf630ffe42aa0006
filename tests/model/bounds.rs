//! Lower bounds: each vehicle alone against the reference and against descent, groups that merge against the
//! centralised optimum of both orders.

use control_zones::bounds::alone::{End, Leg, optimum};
use control_zones::bounds::{Traffic, joint, merging};
use control_zones::compare::sample::Sample;
use control_zones::control::Terminal;
use control_zones::control::reference::Problem;
use control_zones::scenario::{ReferenceLaw, load};
use std::sync::Arc;

/// Cost of a speed profile, constant acceleration between equally spaced nodes.
fn cost(beta: f64, legs: &[Leg], speeds: &[Vec<f64>]) -> f64 {
    let of = |(leg, v): (&Leg, &Vec<f64>)| {
        let ds = leg.length_m / (v.len() - 1) as f64;
        let parts = v.windows(2).map(|p| {
            let (sum, rise) = (p[0] + p[1], p[1] - p[0]);
            beta * 2.0 * ds / sum + rise * rise * sum / (4.0 * ds)
        });
        leg.weight * parts.sum::<f64>()
    };
    legs.iter().zip(speeds).map(of).sum()
}

#[test]
fn one_leg_is_the_reference_with_a_free_terminal_speed() {
    for beta in [2.0 / 3.0, 8.0 / 3.0] {
        for v0_mps in [3.0, 10.0, 16.0, 22.0] {
            let ours = optimum(v0_mps, &[Leg::new(200.0, 1.0, beta)], End::Free).unwrap();
            let problem = Problem { beta, v0_mps, length_m: 200.0, terminal: Terminal::Free };
            let theirs = problem.solve(ReferenceLaw::Corrected);
            assert!((ours.cost - theirs.cost(beta)).abs() < 1e-7, "{ours:?} {}", theirs.cost(beta));
            assert!((ours.durations_s[0] - theirs.duration_s).abs() < 1e-4);
        }
    }
}

#[test]
fn two_legs_of_equal_weight_are_one() {
    let whole = optimum(15.0, &[Leg::new(400.0, 1.0, 2.0 / 3.0)], End::Free).unwrap();
    let half = Leg::new(200.0, 1.0, 2.0 / 3.0);
    let parts = optimum(15.0, &[half, half], End::Free).unwrap();
    assert!((whole.cost - parts.cost).abs() < 1e-9);
    assert!((whole.durations_s[0] - parts.durations_s.iter().sum::<f64>()).abs() < 1e-6);
}

#[test]
fn a_given_end_is_the_reference_with_that_terminal_speed() {
    let beta = 2.0 / 3.0;
    for v0_mps in [8.0, 16.0, 22.0] {
        for exit_mps in [9.0, 15.0, 21.0] {
            let end = End::Speed(exit_mps);
            let ours = optimum(v0_mps, &[Leg::new(200.0, 1.0, beta)], end).unwrap();
            let problem = Problem { beta, v0_mps, length_m: 200.0, terminal: Terminal::Speed(exit_mps) };
            let theirs = problem.solve(ReferenceLaw::Corrected);
            assert!((ours.cost - theirs.cost(beta)).abs() < 1e-7, "{ours:?} {}", theirs.cost(beta));
            assert_eq!(ours.exits_mps, [exit_mps]);
        }
    }
    // The free end is the best of them.
    let leg = [Leg::new(200.0, 1.0, beta), Leg::new(100.0, 2.0, beta)];
    let free = optimum(14.0, &leg, End::Free).unwrap();
    let same = optimum(14.0, &leg, End::Speed(free.exits_mps[1])).unwrap();
    assert!((same.cost - free.cost).abs() < 1e-9);
    for off in [-2.0, -0.5, 0.5, 2.0] {
        assert!(optimum(14.0, &leg, End::Speed(free.exits_mps[1] + off)).unwrap().cost > free.cost);
    }
}

#[test]
fn coasting_is_a_last_leg_at_constant_speed() {
    let (beta, price) = (2.0 / 3.0, 0.9);
    let legs = [Leg::new(200.0, 1.0, beta)];
    let end = End::Coasting { length_m: 30.0, faster_mps: 0.4, price };
    let ours = optimum(14.0, &legs, end).unwrap();
    let total = |exit_mps: f64| {
        optimum(14.0, &legs, End::Speed(exit_mps)).unwrap().cost + price * 30.0 / (exit_mps + 0.4)
    };
    let best = (0..4000).map(|i| total(12.0 + 0.005 * f64::from(i))).fold(f64::INFINITY, f64::min);
    assert!((ours.cost - best).abs() < 1e-5, "{} {best}", ours.cost);
    assert!((ours.cost - total(ours.exits_mps[0])).abs() < 1e-9);
}

#[test]
fn no_other_profile_is_cheaper() {
    for (beta, v0) in [(2.0 / 3.0, 8.0), (2.0 / 3.0, 16.0), (8.0 / 3.0, 20.0)] {
        let legs = [(200.0, 1.5), (150.0, 1.0), (80.0, 2.5)].map(|(l, w)| Leg::new(l, w, beta));
        let best = optimum(v0, &legs, End::Free).unwrap();
        // Coordinate descent over profiles from a constant one: convex, so it nears the optimum from above.
        let n = 12;
        let mut speeds: Vec<Vec<f64>> = legs.iter().map(|_| vec![v0; n + 1]).collect();
        let mut step = 1.0;
        let mut least = cost(beta, &legs, &speeds);
        while step > 1e-4 {
            let before = least;
            for at in 1..=3 * n {
                for change in [step, -step] {
                    // A node between two legs belongs to both.
                    let set = |speeds: &mut Vec<Vec<f64>>, by: f64| {
                        let (leg, node) = ((at - 1) / n, (at - 1) % n + 1);
                        speeds[leg][node] += by;
                        if node == n && leg + 1 < 3 {
                            speeds[leg + 1][0] += by;
                        }
                    };
                    set(&mut speeds, change);
                    let now = cost(beta, &legs, &speeds);
                    if now < least { least = now } else { set(&mut speeds, -change) }
                }
            }
            if before - least < 1e-7 {
                step *= 0.5;
            }
        }
        assert!(least >= best.cost - 1e-9, "{least} {best:?}");
        assert!(least < best.cost * 1.004, "{least} {best:?}");
    }
}

/// A run of vehicles that arrive on the given roads at the given instants.
fn run_of(arrivals: &[(&str, f64)]) -> (Arc<control_zones::scenario::Scenario>, Sample) {
    let dir = tempfile::tempdir().unwrap();
    let trace = dir.path().join("few.csv");
    let rows: Vec<String> = arrivals.iter().map(|(road, at_s)| format!("{at_s},{road},16\n")).collect();
    std::fs::write(&trace, format!("time_s,road,speed_mps\n{}", rows.concat())).unwrap();
    let set = format!("roads.*.demand={{ trace = \"{}\" }}", trace.display()).parse().unwrap();
    let flow = "zones.*.flow={ policy = \"none\" }".parse().unwrap();
    let scenario = Arc::new(load(Some("paper"), &[set, flow], Some(1)).unwrap());
    let sample = Sample::of(&scenario, "few vehicles").unwrap();
    (scenario, sample)
}

#[test]
fn pairs_that_merge_cost_at_least_their_bound() {
    // Both of the first zone, at once and a little apart; one that comes from it and one of the second zone.
    for (roads, instants_s) in [
        (["main1", "merge1"], [1.0, 1.0]),
        (["main1", "merge1"], [1.0, 1.9]),
        (["main1", "merge2"], [1.0, 11.3]),
    ] {
        let (scenario, sample) = run_of(&[(roads[0], instants_s[0]), (roads[1], instants_s[1])]);
        let entrants = sample.entrants();
        let traffic = Traffic { scenario: &scenario, entrants: &entrants };
        let bound = merging::bound(&traffic).unwrap();
        let alone = traffic.alone().total;
        let mut courses = sample.courses();
        let mut orders = Vec::new();
        for _ in 0..2 {
            let found = joint::seek(&traffic, &courses, f64::INFINITY).unwrap();
            assert!(found.missed_s < 1e-3, "{found:?}");
            orders.push(found.total);
            // The other order: whoever passed first comes to pass last.
            let ahead = usize::from(courses[1].last().unwrap().exit_s < courses[0].last().unwrap().exit_s);
            courses[ahead].iter_mut().for_each(|course| course.exit_s += 6.0);
        }
        let least = orders[0].min(orders[1]);
        assert_eq!(bound.groups, 1, "{roads:?}");
        assert!(alone + 1e-4 < bound.total, "{alone} {bound:?}");
        assert!(bound.total <= least + 1e-9, "{bound:?} {orders:?}");
        // The duality gap, the cells, and the stretches of the centralised optimum.
        assert!(bound.total > alone + 0.5 * (least - alone), "{alone} {bound:?} {orders:?}");
    }
    // Far apart nobody has to merge.
    let (scenario, sample) = run_of(&[("main1", 1.0), ("merge1", 15.0)]);
    let entrants = sample.entrants();
    let traffic = Traffic { scenario: &scenario, entrants: &entrants };
    assert_eq!(merging::bound(&traffic).unwrap().groups, 0);
    assert_eq!(traffic.bounds().merging_total, Some(traffic.alone().total));
}

#[test]
fn three_that_merge_cost_at_least_their_bound_and_more_than_a_pair_of_them() {
    for instants_s in [[1.0, 1.7, 2.4], [1.0, 2.2, 2.6]] {
        // One comes from the ramp, first, between the others or last.
        let arrivals = [("main1", instants_s[0]), ("merge1", instants_s[1]), ("main1", instants_s[2])];
        let (scenario, sample) = run_of(&arrivals);
        let entrants = sample.entrants();
        let traffic = Traffic { scenario: &scenario, entrants: &entrants };
        let bound = merging::bound(&traffic).unwrap();
        let alone = traffic.alone().total;
        let from_the_ramp = entrants.iter().position(|e| e.way[0].1 != entrants[0].way[0].1).unwrap();
        let totals = [-4.0, 0.0, 9.0].map(|later_s| {
            let mut courses = sample.courses();
            courses[from_the_ramp].iter_mut().for_each(|course| course.exit_s += later_s);
            let found = joint::seek(&traffic, &courses, f64::INFINITY).unwrap();
            assert!(found.missed_s < 1e-3, "{found:?}");
            found.total
        });
        let least = totals.iter().copied().fold(f64::INFINITY, f64::min);
        assert_eq!(bound.groups, 1);
        assert!(bound.total <= least + 1e-9, "{bound:?} {totals:?}");
        assert!(bound.total > alone + 0.5 * (least - alone), "{alone} {bound:?} {totals:?}");
        // Any two of them cost less, even for three vehicles' worth of them.
        for left_out in 0..3 {
            let mut pair = arrivals.to_vec();
            pair.remove(left_out);
            let (scenario, sample) = run_of(&pair);
            let entrants = sample.entrants();
            let of_two = Traffic { scenario: &scenario, entrants: &entrants };
            // Of means over two, what it is in means over three.
            let more = (merging::bound(&of_two).unwrap().total - of_two.alone().total) * 2.0 / 3.0;
            assert!(bound.total - alone > 1.5 * more, "{left_out}: {more} {alone} {bound:?}");
        }
    }
}
