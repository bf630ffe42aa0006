//! Behind a leader, step after step: what the feasibility rows deliver.

use super::{LENGTH, OCBF, ahead, at, cases, permitted, with};
use control_zones::control::rows::Row;
use control_zones::control::{Law, Ocbf, Situation, Terminal, Verdict};
use control_zones::scenario::Scenario;
use control_zones::vehicle::{Held, RearEnd};
use proptest::prelude::*;

fn rear_end(scenario: &Scenario) -> RearEnd {
    RearEnd {
        reaction_s: scenario.vehicle.reaction_time_s,
        gap_m: scenario.vehicle.standstill_gap_m,
        k_per_s: scenario.control.k_rear_end_per_s,
        u_min_mps2: scenario.vehicle.u_min_mps2,
    }
}

/// What one run behind a leader showed.
#[derive(Debug)]
struct Chase {
    least_margin_m: f64,
    /// By how much the upper rows fell short of the lower ones, at worst, m/s^2; <= 0 when never.
    worst_gap_mps2: f64,
    infeasible: u32,
    reached: bool,
    bound_steps: u32,
}

/// Follows a leader that holds each of `leader_us` for half a second, over and over.
fn chase(scenario: &Scenario, v: f64, gap: f64, leader_v: f64, leader_us: &[f64]) -> Chase {
    let (dt, law, rear) = (scenario.dt_s(), Ocbf::new(scenario), rear_end(scenario));
    let hold = (0.5 / dt).round() as usize;
    let (mut x, mut v) = (0.0, v);
    let entry = v;
    // The leader has cruised until now.
    let mut p = ahead(gap, leader_v, 0.0);
    let mut memory = OCBF.words();
    let mut seen = Chase {
        least_margin_m: f64::INFINITY,
        worst_gap_mps2: f64::NEG_INFINITY,
        infeasible: 0,
        reached: false,
        bound_steps: 0,
    };
    for k in 0..(30.0 / dt) as usize {
        let s =
            Situation { entry_speed_mps: entry, terminal: Terminal::Speed(30.0), ..at(k as f64 * dt, x, v) };
        let i = permitted(scenario, &s, &[p]);
        seen.worst_gap_mps2 = seen.worst_gap_mps2.max(i.low - i.high);
        let d = law.decide(&s, std::iter::once(p), &mut memory);
        seen.infeasible += u32::from(d.verdict == Verdict::Infeasible);
        seen.bound_steps +=
            u32::from(matches!(d.verdict, Verdict::Tracked(Some(Row::RearEnd | Row::RearEndFeasibility))));
        let wanted = leader_us[(k / hold) % leader_us.len()];
        // The leader keeps to its speed limits.
        let u = if p.v_mps + wanted * dt > 30.0 { 0.0 } else { wanted };
        let (own, lead) = (Held::new(x, v, d.u_mps2), Held::new(p.x_m, p.v_mps, u));
        let within = own.least_margin_m(&lead, 0.0, rear.reaction_s, rear.gap_m, dt);
        seen.least_margin_m = seen.least_margin_m.min(within);
        (x, v) = (own.position_m(dt), own.speed_mps(dt));
        p = ahead(lead.position_m(dt), lead.speed_mps(dt), lead.observed_mps2(dt));
        if x >= LENGTH {
            seen.reached = true;
            break;
        }
    }
    seen
}

fn leader_commands() -> impl Strategy<Value = Vec<f64>> {
    // Hard switches are the worst a leader can do.
    let u = prop_oneof![1 => Just(-4.0), 1 => Just(4.0), 2 => -4.0..4.0f64];
    prop::collection::vec(u, 1..30)
}

/// States at which all entry conditions of the rear-end constraint hold.
fn good_starts() -> impl Strategy<Value = (f64, f64, f64)> {
    let margin = prop_oneof![1 => Just(0.0), 2 => 0.0..5.0f64, 1 => 0.0..60.0f64];
    let reserve = prop_oneof![1 => Just(0.0), 3 => 0.0..7.2f64, 1 => 0.0..30.0f64];
    (7.2..30.0f64, margin, reserve).prop_map(|(v, margin, reserve)| {
        let leader_v = (v - 7.2 + reserve).min(30.0);
        (v, 1.8 * v + margin, leader_v)
    })
}

proptest! {
    #![proptest_config(cases(300))]

    #[test]
    fn feasibility_rows_keep_the_program_feasible_and_the_vehicle_safe(
        (v, gap, leader_v) in good_starts(), us in leader_commands(),
    ) {
        let scenario = Scenario { dt_ns: 1_000_000, ..with(|c| c.clf = false) };
        let seen = chase(&scenario, v, gap, leader_v, &us);
        let dt = scenario.dt_s();
        let floor = -8.0 * dt / 2.0 - 1e-9;
        prop_assert!(seen.least_margin_m >= floor, "{seen:?}");
        prop_assert!(seen.worst_gap_mps2 <= 8.0 * dt + 1e-9, "{seen:?}");
    }
}

/// Worst of a fixed set of hard chases: every start on the edge of the entry conditions, leaders that
/// switch between the limits.
fn hard_chases(scenario: &Scenario) -> Chase {
    let patterns: [&[f64]; 6] = [
        &[-4.0],
        &[4.0, -4.0],
        &[4.0, 4.0, 4.0, 4.0, -4.0, -4.0, -4.0, -4.0],
        &[0.0, 0.0, 0.0, 0.0, -4.0, -4.0, -4.0, -4.0, -4.0, -4.0],
        &[-4.0, 4.0, -4.0, -4.0, 4.0],
        &[1.0, -1.0, 3.0, -4.0, -3.9, -4.0],
    ];
    let mut worst = Chase {
        least_margin_m: f64::INFINITY,
        worst_gap_mps2: f64::NEG_INFINITY,
        infeasible: 0,
        reached: false,
        bound_steps: 0,
    };
    for v in [8.0, 15.0, 22.0, 29.0] {
        for margin in [0.0, 1.0, 10.0, 40.0] {
            for reserve in [0.0, 2.0, 7.2] {
                for us in patterns {
                    let seen = chase(scenario, v, 1.8 * v + margin, (v - 7.2 + reserve).min(30.0), us);
                    worst.least_margin_m = worst.least_margin_m.min(seen.least_margin_m);
                    worst.worst_gap_mps2 = worst.worst_gap_mps2.max(seen.worst_gap_mps2);
                    worst.infeasible += seen.infeasible;
                    worst.reached |= seen.reached;
                    worst.bound_steps += seen.bound_steps;
                }
            }
        }
    }
    worst
}

/// What the feasibility rows deliver, and what they do not: in continuous time the program stays
/// feasible; sampled, with the leader's acceleration known one step late, it may fall short, but by no
/// more than `k1 (u_max - u_min) dt`, and the barrier keeps its floor. Without them it falls short by
/// as much as the leader cares to brake, whatever the step.
#[test]
fn feasibility_rows_bound_the_shortfall_by_the_step() {
    for dt_ns in [1_000_000, 10_000_000, 100_000_000] {
        let run =
            |rows| hard_chases(&Scenario { dt_ns, ..with(|c| (c.clf, c.feasibility_rows) = (false, rows)) });
        let (seen, without) = (run(true), run(false));
        println!("dt {} ms with the rows: {seen:?}", dt_ns / 1_000_000);
        println!("dt {} ms without: {without:?}", dt_ns / 1_000_000);
        let dt = dt_ns as f64 * 1e-9;
        assert!(seen.reached && seen.bound_steps > 1000 * 1_000_000 / dt_ns as u32, "the rows never decide");
        assert!(seen.least_margin_m >= -8.0 * dt / 2.0 - 1e-9, "{dt}: {seen:?}");
        assert!(seen.worst_gap_mps2 <= 8.0 * dt + 1e-9, "{dt}: {seen:?}");
        assert!(without.worst_gap_mps2 > 1.0, "{dt}: the rows are not needed here: {without:?}");
    }
}
