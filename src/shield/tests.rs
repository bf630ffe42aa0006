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

/// Any duty, toward a partner that may brake as hard as the vehicle, less, or harder.
fn owed() -> impl Strategy<Value = (DutyKind, f64)> {
    let kind = prop_oneof![Just(DutyKind::RearEnd), Just(DutyKind::Merge), Just(DutyKind::Cross)];
    (kind, prop_oneof![Just(4.0), 2.0..8.0f64])
}

/// A duty, a state (x, v) at most 80 m before a conflict point at 200 m, and a partner ahead.
fn scenes() -> impl Strategy<Value = ((DutyKind, f64), f64, f64, f64, f64, f64)> {
    (owed(), 120.0..200.0f64, 0.0..30.0f64, -5.0..70.0f64, 0.0..30.0f64, -4.0..4.0f64)
}

fn partner((kind, braking_mps2): (DutyKind, f64), x: f64, v: f64, u: f64) -> Partner {
    Partner { kind, at_m: 200.0, gap_m: 0.5, braking_mps2, motion: Held::new(x, v, u.max(-braking_mps2)) }
}

#[test]
fn who_has_room_is_plainly_admitted() {
    let shield = Shield::new(&VEHICLE, 0.1);
    let seen = |x_m| Seen { x_m, v_mps: 15.0, gap_m: 0.5, braking_mps2: 4.0 };
    let plain =
        |u, kind, at_m, x_m| shield.plainly_admits(&shield.ends(0.0, 15.0, u), kind, at_m, &seen(x_m));
    assert!(plain(1.0, DutyKind::RearEnd, 0.0, 32.0));
    assert!(!plain(1.0, DutyKind::RearEnd, 0.0, 27.0));
    for kind in [DutyKind::Merge, DutyKind::Cross] {
        assert!(plain(1.0, kind, 40.0, -100.0));
        assert!(!plain(1.0, kind, 28.0, -100.0));
    }
}

/// Whoever stands on a crossing cannot let those pass that have yet to come over it, wherever else it could wait for them.
#[test]
fn who_stands_on_a_crossing_lets_nobody_pass_it() {
    let scenario = crate::scenario::load_embedded("intersection", &[], None).unwrap();
    let conflicts = Conflicts::of(&scenario.network, 0);
    let (own, shield) = (&scenario.vehicle, Shield::new(&scenario.vehicle, 0.1));
    let mut duties = Duties::default();
    let mut tried = 0;
    for path in 0..scenario.network.zones[0].paths.len() as u32 {
        for passes in conflicts.uses(path).iter().filter(|u| u.area_m > 0.0) {
            let others = (0..).zip(&scenario.network.zones[0].paths).map(|(other, _)| other);
            for other in others.filter(|other| *other != path) {
                let theirs = conflicts.uses(other).iter().find(|u| u.point == passes.point);
                let Some(theirs) = theirs.filter(|theirs| !theirs.on_lane_of(passes)) else { continue };
                let at = |path, x_m| Vehicle { path, x_m, ..Vehicle::new(own, own, 0) };
                let first = at(other, theirs.at_m - 5.0);
                let mut slack_m = |x_m| {
                    yielding_slack_m(
                        &shield,
                        &conflicts,
                        &mut duties,
                        &first,
                        &Vehicle { id: 1, ..at(path, x_m) },
                    )
                };
                assert_eq!(slack_m(passes.at_m + 0.1), f64::NEG_INFINITY);
                assert_eq!(slack_m(passes.at_m + passes.area_m + own.length_m - 0.1), f64::NEG_INFINITY);
                assert!(slack_m(passes.at_m - 60.0) > 0.0);
                tried += 1;
            }
        }
    }
    assert!(tried > 10, "{tried}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, max_global_rejects: 100_000, ..ProptestConfig::default() })]

    /// The closed form is the least margin while both brake to a stop.
    #[test]
    fn slack_is_the_least_margin_of_both_braking(
        v in 0.0..30.0f64, lead in -10.0..100.0f64, w in 0.0..30.0f64,
        braking_mps2 in prop_oneof![Just(4.0), 2.0..8.0f64],
    ) {
        let shield = Shield::new(&VEHICLE, 0.1);
        let (own, leader) = (Held::new(0.0, v, -4.0), Held::new(lead, w, -braking_mps2));
        let exact = own.least_margin_m(&leader, 0.0, 1.8, 0.5, 16.0);
        let seen = Seen { x_m: lead, v_mps: w, gap_m: 0.5, braking_mps2 };
        prop_assert!((shield.slack_m(0.0, v, seen) - exact).abs() < 1e-9);
    }

    /// From a safe state, u_min ends in a safe state whatever the partner does.
    #[test]
    fn safe_sets_are_invariant_under_full_braking(
        (owed, x, v, ahead, w, u) in scenes(), dt in 0.01..2.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(owed, x + ahead, w, u);
        let before = shield.state_slack_m(x, v, &partner);
        prop_assume!(before >= 0.0);
        let own = Held::new(x, v, -4.0);
        prop_assert!(shield.slack_after_m(&own, &partner) >= -1e-9);
        prop_assert!(shield.least_margin_m(&own, &partner) >= -1e-9);
    }

    /// What is plainly admissible is admissible.
    #[test]
    fn what_is_plainly_admitted_is_admitted(
        (owed, x, v, ahead, w, u) in scenes(), dt in 0.01..2.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(owed, x + ahead, w, f64::NEG_INFINITY);
        let seen = Seen { x_m: x + ahead, v_mps: w, gap_m: 0.5, braking_mps2: owed.1 };
        let plain = shield.plainly_admits(&shield.ends(x, v, u), owed.0, 200.0, &seen);
        let admits = shield.admits(&Held::new(x, v, u), &partner);
        prop_assert!(admits || !plain);
    }

    /// Less acceleration is never less safe: what makes the projection one number.
    #[test]
    fn admissible_accelerations_are_an_interval(
        (owed, x, v, ahead, w, u) in scenes(), dt in 0.01..1.0f64, a in -4.0..4.0f64, b in -4.0..4.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(owed, x + ahead, w, u);
        let admits = |u: f64| shield.admits(&Held::new(x, v, u), &partner);
        prop_assert!(admits(a.min(b)) || !admits(a.max(b)));
    }

    /// The projection keeps the margin at densely sampled instants, and a little more acceleration would
    /// not have been admissible.
    #[test]
    fn projection_is_safe_and_no_lower_than_needed(
        (owed, x, v, ahead, w, u) in scenes(), dt in 0.01..1.0f64, wish in -4.0..4.0f64,
    ) {
        let shield = Shield::new(&VEHICLE, dt);
        let partner = partner(owed, x + ahead, w, u);
        prop_assume!(shield.state_slack_m(x, v, &partner) >= 2.0 * RESERVE_M);
        let found = shield.project(x, v, wish, std::iter::once(partner));
        let own = Held::new(x, v, found.u_mps2);
        prop_assert!(found.u_mps2 >= -4.0 && found.u_mps2 <= wish);
        prop_assert!(shield.slack_after_m(&own, &partner) >= 0.0);
        // A leader at every instant, a merging partner from the merge on, a crossing one at the crossing alone.
        if let (DutyKind::Cross, Some(t)) = (owed.0, own.passes_m(200.0, dt)) {
            prop_assert!(margin(&own, &partner.motion, t) >= -1e-11, "at {t}");
        }
        for i in 0..=500 {
            let t = dt * f64::from(i) / 500.0;
            let counts = match owed.0 {
                DutyKind::RearEnd => true,
                DutyKind::Merge => own.position_m(t) >= 200.0,
                DutyKind::Cross => false,
            };
            if counts {
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
        (owed, x, v, ahead, w, _) in scenes(),
        wishes in prop::collection::vec((-4.0..4.0f64, -4.0..4.0f64), 1..200),
    ) {
        let dt = 0.1;
        let shield = Shield::new(&VEHICLE, dt);
        prop_assume!(shield.state_slack_m(x, v, &partner(owed, x + ahead, w, 0.0)) >= RESERVE_M);
        let (mut x, mut v, mut y, mut w) = (x, v, x + ahead, w);
        for (wish, lead) in wishes {
            let partner = partner(owed, y, w, if w >= 30.0 { lead.min(0.0) } else { lead });
            let found = shield.project(x, v, wish, std::iter::once(partner));
            let own = Held::new(x, v, found.u_mps2);
            prop_assert!(shield.least_margin_m(&own, &partner) >= 0.0);
            prop_assert!(shield.slack_after_m(&own, &partner) >= 0.0);
            if owed.0 != DutyKind::RearEnd && own.position_m(dt) >= 200.0 {
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
    let standing = partner((DutyKind::Merge, 4.0), 150.0, 0.0, 0.0);
    let (mut x, mut v) = (100.0, 20.0);
    for _ in 0..600 {
        let u = shield.project(x, v, 4.0, std::iter::once(standing)).u_mps2;
        let own = Held::new(x, v, u);
        (x, v) = (own.position_m(0.1), own.speed_mps(0.1));
    }
    assert!(x < 200.0 && x > 199.9, "{x}");
    let gone = partner((DutyKind::Merge, 4.0), 240.0, 10.0, 0.0);
    assert_eq!(shield.project(x, v, 4.0, std::iter::once(gone)).row, None);
}
