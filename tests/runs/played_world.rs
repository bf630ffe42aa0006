//! A world that others play: whoever moves the vehicles, the rest of the run does not notice.

use control_zones::lockstep::LockstepError;
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{Override, Scenario, load};
use control_zones::world::{AdvanceError, Coming, Done, Newcomer, Task, Traffic, TrafficError, WorldSummary};
use ipc_schemas::{STATE_WAITS, VehicleState};
use std::collections::BTreeMap;
use std::sync::Arc;

fn scenario(name: &str, sets: &[&str]) -> Arc<Scenario> {
    let sets: Vec<Override> = sets.iter().map(|set| set.parse().expect("a setting")).collect();
    Arc::new(load(Some(name), &sets, None).expect("it loads"))
}

fn played(scenario: &Arc<Scenario>, traffic: Box<dyn Traffic>) -> Result<WorldSummary, LockstepError> {
    let mut run = InProcess::played(scenario, 1, 1, traffic, false);
    run.run()?;
    Ok(run.world().summary())
}

/// Vehicles that do as they are told come to the same results, to rounding, whoever moves them: the seam loses nothing.
#[test]
fn who_does_as_told_comes_to_the_results_of_our_own_world() {
    for (name, sets) in [
        ("paper", &["shield=on", "end.vehicles=40"][..]),
        ("two-merges", &["shield=on", "end.vehicles=40"]),
        ("intersection", &["end.time_s=120"]),
    ] {
        let scenario = scenario(name, sets);
        let mut own = InProcess::new(&scenario, 1, 1);
        own.run().unwrap();
        let own = own.world().summary();
        let other = played(&scenario, Box::<crate::world::Points>::default()).unwrap();
        assert_eq!((other.arrived, other.departed), (own.arrived, own.departed), "{name}");
        assert!(own.departed > 10, "{name}: {} have left", own.departed);
        for (a, b) in own.zones.iter().zip(&other.zones) {
            let near = |x: f64, y: f64| (x - y).abs() < 1e-6 * x.abs().max(1.0);
            assert!(near(a.mean_time_s, b.mean_time_s) && near(a.mean_energy, b.mean_energy), "{a:?}\n{b:?}");
            assert_eq!((a.vehicles, a.order_violations, a.overtakes), (b.vehicles, 0, 0), "{name}");
        }
        let traffic = other.traffic.unwrap();
        assert!(
            traffic.greatest_deviation_m < 1e-9 && traffic.greatest_disobedience_mps2 < 1e-9,
            "{traffic:?}"
        );
        assert_eq!(other.overlaps.pairs, own.overlaps.pairs, "{name}");
    }
}

/// Vehicles by path of the intersection's first zone, each with the step in which it comes, and where.
#[derive(Debug, Default)]
struct Scripted {
    dt_s: f64,
    coming: Vec<(u64, Newcomer)>,
    /// Steps at which vehicles are taken out.
    going: Vec<(u64, u32)>,
    /// Positions from the zone's origin, and speeds.
    here: BTreeMap<u32, (f64, f64)>,
    brought: u32,
    said: Option<Done>,
}

impl Traffic for Scripted {
    fn name(&self) -> String {
        "scripted".to_owned()
    }

    fn begin(&mut self, scenario: &Scenario) {
        self.dt_s = scenario.dt_s();
    }

    fn step(
        &mut self,
        step: u64,
        tasks: &[Task],
        done: &mut [Done],
        newcomers: &mut Vec<Newcomer>,
    ) -> Result<Coming, TrafficError> {
        for (task, done) in tasks.iter().zip(done) {
            if self.going.contains(&(step, task.vehicle)) {
                self.here.remove(&task.vehicle);
            }
            let Some((x_m, v_mps)) = self.here.get_mut(&task.vehicle) else { continue };
            // Whoever is not told drives on, and out of sight at last.
            let u_mps2 = if task.is_held == 1 { task.u_mps2 } else { 0.0 };
            *done = crate::world::moved(*v_mps, u_mps2, self.dt_s);
            (*x_m, *v_mps) = (*x_m + done.advanced_m, done.v_mps);
            if let Some(said) = self.said {
                *done = said;
            }
        }
        self.here.retain(|_, (x_m, _)| *x_m < 400.0);
        for (_, newcomer) in self.coming.iter().filter(|(when, _)| *when == step) {
            self.here.insert(self.brought, (newcomer.x_m, newcomer.v_mps));
            self.brought += 1;
            newcomers.push(*newcomer);
        }
        Ok(if self.coming.iter().any(|(when, _)| *when > step) { Coming::More } else { Coming::Nobody })
    }
}

fn newcomer(path: u32, x_m: f64, v_mps: f64, is_commanded: u32) -> Newcomer {
    Newcomer { x_m, v_mps, path, is_commanded, ..Newcomer::default() }
}

/// A traffic brings vehicles at the entrance and in the midst of a zone, commanded or not, and takes one out: those on
/// a lane pass in the order in which they are on it, and nobody waits for one that is there no more.
#[test]
fn who_is_brought_in_and_taken_out_anywhere_is_reckoned_with() {
    let scenario = scenario("intersection", &["end.time_s=120", "shield=on", "coordination.order=fifo"]);
    let traffic = Scripted {
        coming: vec![
            (0, newcomer(0, 0.5, 10.0, 1)),
            // Ahead of the first on its lane, though it comes after it; somebody else drives it.
            (40, newcomer(0, 80.0, 8.0, 0)),
            (41, newcomer(4, 0.0, 10.0, 1)),
            (42, newcomer(7, 0.0, 10.0, 1)),
        ],
        going: vec![(60, 2)],
        ..Scripted::default()
    };
    let mut run = InProcess::played(&scenario, 1, 1, Box::new(traffic), false);
    let mut orders: Vec<Vec<u32>> = Vec::new();
    while run.step().unwrap() {
        let members: Vec<VehicleState> = run.world().records().filter(|s| !s.has_left()).collect();
        // Nobody is to command the one that somebody else drives, and everybody is told.
        assert!(members.iter().all(|s| s.is_commanded() == (s.vehicle != 1)), "{members:?}");
        let order: Vec<u32> = members.iter().map(|s| s.vehicle).collect();
        if orders.last() != Some(&order) {
            orders.push(order);
        }
    }
    let expected: [&[u32]; 5] = [&[0], &[1, 0], &[1, 0, 2], &[1, 0, 2, 3], &[1, 0, 3]];
    assert_eq!(orders[..5], expected, "{orders:?}");
    let summary = run.world().summary();
    let traffic = summary.traffic.unwrap();
    assert_eq!((summary.arrived, summary.departed, traffic.gone, traffic.uncommanded), (4, 3, 1, 1));
    assert_eq!(summary.overlaps.pairs, 0);
}

/// A human who stands before a merge, perhaps to let others go, holds nobody up for ever: automated vehicles on the other road pass
/// before it, and who is behind it on its lane stays there.
#[test]
fn who_stands_and_waits_is_not_waited_for() {
    let scenario = scenario("two-merges", &["end.time_s=100", "shield=on"]);
    let traffic = Scripted {
        coming: vec![
            (0, newcomer(1, 150.0, 0.0, 0)),
            (0, newcomer(1, 100.0, 0.0, 1)),
            (1, newcomer(0, 0.0, 13.0, 1)),
            (60, newcomer(0, 0.0, 13.0, 1)),
        ],
        ..Scripted::default()
    };
    let mut run = InProcess::played(&scenario, 1, 1, Box::new(traffic), false);
    let (mut first_waits, mut waited) = (None, 0);
    while run.step().unwrap() {
        for state in run.world().records().filter(|state| state.flags & STATE_WAITS != 0) {
            assert_eq!((state.vehicle, state.v_mps), (0, 0.0));
            first_waits = first_waits.or(Some(run.world().step()));
            waited += 1;
        }
    }
    let summary = run.world().summary();
    // It has stood for 2 s then, and does not cease to.
    assert_eq!(first_waits, Some(21));
    assert!(waited > 900, "{waited}");
    assert_eq!((summary.arrived, summary.departed, summary.overlaps.pairs), (4, 2, 0));
    assert_eq!(summary.zones[0].orders_refused, 0);
}

/// Whoever comes to stand behind an exit, without ever having been in the zone, is stopped for by those that are to leave by it.
#[test]
fn who_comes_behind_an_exit_is_in_the_way_of_those_that_leave_by_it() {
    let scenario = scenario("intersection", &["end.time_s=60", "shield=on", "coordination.order=fifo"]);
    let length_m = scenario.network.zones[0].paths[0].length_m;
    let traffic = Scripted {
        coming: vec![
            (0, newcomer(0, length_m - 100.0, 12.0, 1)),
            (1, newcomer(0, length_m + 5.5, 0.0, 0)),
            // Further ahead: it is the one before that matters.
            (2, newcomer(0, length_m + 30.0, 0.0, 0)),
        ],
        going: vec![(400, 1)],
        ..Scripted::default()
    };
    let mut run = InProcess::played(&scenario, 1, 1, Box::new(traffic), false);
    let mut stands_m = f64::NAN;
    while run.step().unwrap() {
        for state in run.world().records().filter(|state| state.vehicle > 0) {
            assert!(state.has_left() && !state.is_commanded(), "{state:?}");
        }
        if run.world().step() == 400 {
            let first = run.world().records().find(|state| state.vehicle == 0).unwrap();
            assert!(first.v_mps < 1e-3, "{first:?}");
            stands_m = first.x_m;
        }
    }
    let summary = run.world().summary();
    let traffic = summary.traffic.unwrap();
    assert!(
        stands_m > length_m - 10.0 && stands_m < length_m + 0.5,
        "it stands at {stands_m} of {length_m} m"
    );
    // Once that one is gone it leaves, and stands behind the other nowhere: that is no business of the zone's.
    assert_eq!((summary.arrived, summary.departed, traffic.behind_exits, traffic.uncommanded), (1, 1, 2, 0));
    assert_eq!(summary.overlaps.pairs, 0);
    assert!(summary.zones[0].min_rear_end_margin_m.unwrap() > -1e-9);
}

/// What a traffic says is checked, and what is wrong with it said in a line.
#[test]
fn what_cannot_be_is_refused() {
    let intersection = scenario("intersection", &["end.time_s=20"]);
    let fails = |traffic: Scripted| match played(&intersection, Box::new(traffic)).unwrap_err() {
        LockstepError::World { error: error @ AdvanceError::Traffic { .. }, .. } => error.to_string(),
        other => panic!("{other:?}"),
    };
    let coming = |newcomer: Newcomer| Scripted { coming: vec![(0, newcomer)], ..Scripted::default() };
    let good = newcomer(0, 0.0, 10.0, 1);
    for (bad, what) in [
        (Newcomer { zone: 9, ..good }, "newcomer 0: zone is 9, expected less than 1"),
        (Newcomer { path: 99, ..good }, "path is 99, expected less than"),
        (Newcomer { x_m: f64::NAN, ..good }, "x_m is NaN, expected from 0"),
        (Newcomer { x_m: 1e9, ..good }, "x_m is 1000000000, expected from 0"),
        (Newcomer { v_mps: -1.0, ..good }, "v_mps is -1, expected a number >= 0"),
        (Newcomer { kind: 3, ..good }, "kind is 3, expected less than 1"),
        (Newcomer { road: 0, route: 0, ..good }, "route is 0, expected one of road 0"),
    ] {
        let said = fails(coming(bad));
        assert!(said.starts_with("scripted: ") && said.contains(what), "{said}");
    }
    for said in [Done { advanced_m: -1.0, v_mps: 1.0 }, Done { advanced_m: 1.0, v_mps: f64::NAN }] {
        let error = fails(Scripted { said: Some(said), ..coming(good) });
        assert!(error.contains("vehicle 0 has come"), "{error}");
    }
}
