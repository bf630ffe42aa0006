//! Properties of the safe sets and of the projection, against brute force.

use super::*;
use proptest::prelude::*;

const VEHICLE: VehicleParams = VehicleParams {
    u_min_mps2: -4.0,
    u_max_mps2: 4.0,
    v_min_mps: 0.0,
    v_max_mps: 30.0,
    length_m: 4.5,
    reaction_time_s: 1.8,
    standstill_gap_m: 0.5,
};

fn margin(own: &Held, leader: &Held, t: f64) -> f64 {
    leader.position_m(t) - own.position_m(t) - 1.8 * own.speed_mps(t) - 0.5
}

/// A duty, a state (x, v) at most 80 m before a conflict point at 200 m, and a partner ahead.
fn scenes() -> impl Strategy<Value = (bool, f64, f64, f64, f64, f64)> {
    (any::<bool>(), 120.0..200.0f64, 0.0..30.0f64, -5.0..70.0f64, 0.0..30.0f64, -4.0..4.0f64)
}

fn partner(merge: bool, x: f64, v: f64, u: f64) -> Partner {
    let duty = if merge { Duty::Merge { conflict_m: 200.0 } } else { Duty::RearEnd };
    Partner { duty, motion: Held::new(x, v, u) }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, max_global_rejects: 100_000, ..ProptestConfig::default() })]

    /// The closed form is the least margin while both brake to a stop.
    #[test]
    fn slack_is_the_least_margin_of_both_braking(
        v in 0.0..30.0f64, lead in -10.0..100.0f64, w in 0.0..30.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, 0.1);
        let (own, leader) = (Held::new(0.0, v, -4.0), Held::new(lead, w, -4.0));
        let exact = own.least_margin_m(&leader, 0.0, 1.8, 0.5, 8.0);
        prop_assert!((shield.slack_m(0.0, v, lead, w) - exact).abs() < 1e-9);
    }

    /// From a safe state, u_min ends in a safe state whatever the partner does.
    #[test]
    fn safe_sets_are_invariant_under_full_braking(
        (merge, x, v, ahead, w, u) in scenes(), dt in 0.01..2.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(merge, x + ahead, w, u);
        let before = shield.state_slack_m(x, v, &partner);
        prop_assume!(before >= 0.0);
        let own = Held::new(x, v, -4.0);
        prop_assert!(shield.slack_after_m(&own, &partner) >= -1e-9);
        prop_assert!(shield.least_margin_m(&own, &partner) >= -1e-9);
    }

    /// Less acceleration is never less safe: what makes the projection one number.
    #[test]
    fn admissible_accelerations_are_an_interval(
        (merge, x, v, ahead, w, u) in scenes(), dt in 0.01..1.0f64, a in -4.0..4.0f64, b in -4.0..4.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(merge, x + ahead, w, u);
        let admits = |u: f64| shield.admits(&Held::new(x, v, u), &partner);
        prop_assert!(admits(a.min(b)) || !admits(a.max(b)));
    }

    /// The projection keeps the margin at densely sampled instants, and a little more acceleration would
    /// not have been admissible.
    #[test]
    fn projection_is_safe_and_no_lower_than_needed(
        (merge, x, v, ahead, w, u) in scenes(), dt in 0.01..1.0f64, wish in -4.0..4.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(merge, x + ahead, w, u);
        prop_assume!(shield.state_slack_m(x, v, &partner) >= 2.0 * RESERVE_M);
        let found = shield.project(x, v, wish, std::iter::once(partner));
        let own = Held::new(x, v, found.u_mps2);
        prop_assert!(found.u_mps2 >= -4.0 && found.u_mps2 <= wish);
        prop_assert!(shield.slack_after_m(&own, &partner) >= 0.0);
        for i in 0..=500 {
            let t = dt * f64::from(i) / 500.0;
            if !merge || own.position_m(t) >= 200.0 {
                prop_assert!(margin(&own, &partner.motion, t) >= -1e-11, "at {t}");
            }
        }
        if found.row.is_none() {
            prop_assert_eq!(found.u_mps2, wish);
        } else if found.row != Some(Row::Speed) {
            prop_assert!(!shield.admits(&Held::new(x, v, found.u_mps2 + 1e-9), &partner));
        }
    }

    /// A vehicle that obeys the shield stays safe for good, under whatever two controllers wish.
    #[test]
    fn a_shielded_vehicle_stays_safe(
        (merge, x, v, ahead, w, _) in scenes(),
        wishes in prop::collection::vec((-4.0..4.0f64, -4.0..4.0f64), 1..200),
    ) {
        let dt = 0.1;
        let shield = Shield::new(&VEHICLE, dt);
        prop_assume!(shield.state_slack_m(x, v, &partner(merge, x + ahead, w, 0.0)) >= RESERVE_M);
        let (mut x, mut v, mut y, mut w) = (x, v, x + ahead, w);
        for (wish, lead) in wishes {
            let partner = partner(merge, y, w, if w >= 30.0 { lead.min(0.0) } else { lead });
            let found = shield.project(x, v, wish, std::iter::once(partner));
            let own = Held::new(x, v, found.u_mps2);
            prop_assert!(shield.least_margin_m(&own, &partner) >= 0.0);
            prop_assert!(shield.slack_after_m(&own, &partner) >= 0.0);
            if merge && own.position_m(dt) >= 200.0 {
                break;
            }
            (x, v) = (own.position_m(dt), own.speed_mps(dt));
            (y, w) = (partner.motion.position_m(dt), partner.motion.speed_mps(dt));
        }
    }
}

#[test]
fn the_greatest_speed_is_kept() {
    let shield = Shield::new(&VEHICLE, 0.1);
    let found = shield.project(0.0, 29.9, 4.0, std::iter::empty());
    assert_eq!(found.row, Some(Row::Speed));
    assert!((found.u_mps2 - 1.0).abs() < 1e-12);
    assert_eq!(shield.project(0.0, 29.0, 4.0, std::iter::empty()).row, None);
}

#[test]
fn a_vehicle_waits_before_the_conflict_point_and_goes_when_its_partner_has_gone() {
    let shield = Shield::new(&VEHICLE, 0.1);
    let standing = partner(true, 150.0, 0.0, 0.0);
    let (mut x, mut v) = (100.0, 20.0);
    for _ in 0..600 {
        let u = shield.project(x, v, 4.0, std::iter::once(standing)).u_mps2;
        let own = Held::new(x, v, u);
        (x, v) = (own.position_m(0.1), own.speed_mps(0.1));
    }
    assert!(x < 200.0 && x > 199.9, "{x}");
    let gone = partner(true, 240.0, 10.0, 0.0);
    assert_eq!(shield.project(x, v, 4.0, std::iter::once(gone)).row, None);
}
