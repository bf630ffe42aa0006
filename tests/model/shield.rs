//! The shield against adversaries, in the world itself: a million vehicle-steps each.

use crate::adversaries::{always_u_max, leaders_that_stop, random_flips};
use crate::shares::assert_one_hash;
use control_zones::coordination::Coordinator;
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{EntryRule, Override, PassingOrder, Scenario, load};
use control_zones::world::{ShieldRow, World};
use ipc_schemas::{NO_VEHICLE, ROW_SPEED, RULE_NONE, STATE_LEFT, VehicleCommand, VehicleState};
use std::collections::BTreeMap;
use std::sync::Arc;

const VEHICLE_STEPS: u64 = 1_000_000;

/// Random arrivals, three roads, eight zones' worth of traffic at most; enough for many pairs.
fn scenario(name: &str, shield: &str, min_headway_s: f64, rate: f64, seed: u64) -> Arc<Scenario> {
    let mut sets = vec![
        format!("shield={shield}"),
        "end.time_s=40000".to_owned(),
        "end.vehicles=4000000000".to_owned(),
        "vehicle.standstill_gap_m=1".to_owned(),
    ];
    let base = load(Some(name), &[], None).unwrap();
    for road in &base.network.roads {
        sets.push(format!(
            "roads.{}.demand={{rates=[{{until_s=40000.0, vehicles_per_hour={rate}}}], \
             min_headway_s={min_headway_s}, speed_mean_mps=16.0, speed_sd_mps=1.0, speed_min_mps=14.0, \
             speed_max_mps=18.0}}",
            road.name
        ));
    }
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some(name), &sets, Some(seed)).unwrap())
}

/// Drives the world with an adversary until so many vehicle-steps have been commanded.
fn attack(
    scenario: &Arc<Scenario>,
    steps: u64,
    mut adversary: impl FnMut(u64, &VehicleState) -> f64,
) -> (ShieldRow, u64, World) {
    let mut world = World::new(scenario.clone(), 1);
    let mut coordinator = Coordinator::new(scenario.clone(), 0..scenario.network.zones.len() as u32);
    let mut commanded = 0;
    while commanded < steps && !world.is_finished() {
        let step = world.step();
        if world.coordinator_masks().acting != 0 {
            let states: Vec<VehicleState> = world.records().collect();
            coordinator.act(step, &states);
            world.coordinate(coordinator.assignments());
        }
        let commands: Vec<VehicleCommand> = world
            .records()
            .filter(VehicleState::is_commanded)
            .map(|s| VehicleCommand {
                u_mps2: adversary(step, &s),
                vehicle: s.vehicle,
                zone: s.zone,
                ..VehicleCommand::default()
            })
            .collect();
        commanded += commands.len() as u64;
        world.command(0, &commands).unwrap();
        world.advance().unwrap();
    }
    let row = world.summary().shield.controllers[0].clone();
    (row, commanded, world)
}

fn assert_holds(row: &ShieldRow, commanded: u64) {
    assert!(commanded >= VEHICLE_STEPS, "only {commanded} vehicle-steps");
    assert_eq!(row.lost, 0);
    let (rear_end, merge) = (row.min_rear_end_margin_m.unwrap(), row.min_merge_margin_m.unwrap());
    println!(
        "{commanded} vehicle-steps; bounded: rear end {}, merge {}, speed {}; least margins {rear_end:.3e} / \
         {merge:.3e} m; {} pairs began unsafe",
        row.rear_end, row.merge, row.speed, row.began_unsafe
    );
    assert!(rear_end >= 0.0, "{rear_end}");
    assert!(merge >= 0.0, "{merge}");
    assert!(row.rear_end > 0 && row.merge > 0);
}

/// The three adversaries, shield on and off, over arrivals of which some enter unsafe.
fn withstands<A: FnMut(u64, &VehicleState) -> f64>(network: &str, adversary: impl Fn() -> A) {
    let (row, commanded, _) = attack(&scenario(network, "on", 2.2, 500.0, 1), VEHICLE_STEPS, adversary());
    assert_holds(&row, commanded);
    // Observing changes nothing, so the same commands do harm.
    let (row, _, _) = attack(&scenario(network, "observe", 2.2, 500.0, 1), 100_000, adversary());
    println!("unshielded: least margins {:?} / {:?} m", row.min_rear_end_margin_m, row.min_merge_margin_m);
    assert!(row.lost > 0);
    assert!(row.min_rear_end_margin_m.unwrap() < 0.0);
    assert!(row.min_merge_margin_m.unwrap() < 0.0);
}

#[test]
fn withstands_full_acceleration() {
    withstands("paper", always_u_max);
}

#[test]
fn withstands_random_flips() {
    withstands("paper", random_flips);
}

#[test]
fn withstands_leaders_that_stop() {
    withstands("paper", leaders_that_stop);
}

#[test]
fn withstands_them_in_a_tree_and_a_corridor() {
    for network in ["tree", "corridor-8"] {
        withstands(network, always_u_max);
        withstands(network, leaders_that_stop);
    }
}

/// More arrivals than a road carries, a gate, and a standstill gap: by default the vehicles' length.
fn gated(network: &str, entry: EntryRule, gap_m: Option<f64>) -> Arc<Scenario> {
    let base = scenario(network, "on", 1.2, 600.0, 1);
    let mut scenario = (*base).clone();
    scenario.network.roads.iter_mut().for_each(|road| road.entry = entry);
    let fleet = scenario.fleet.iter_mut().map(|kind| &mut kind.vehicle);
    for kind in fleet.chain([&mut scenario.vehicle]) {
        kind.standstill_gap_m = gap_m.unwrap_or(kind.length_m);
    }
    Arc::new(scenario)
}

/// The default scenario under more demand, as it is otherwise, with the shield on.
fn dense_default() -> Arc<Scenario> {
    let own = load(None, &[], None).unwrap();
    let mut dense = (*scenario("two-merges", "on", 1.2, 600.0, 1)).clone();
    (dense.vehicle, dense.fleet) = (own.vehicle, own.fleet);
    assert!(dense.network.roads.iter().all(|road| road.entry == EntryRule::Viable));
    assert!(dense.network.zones.iter().all(|zone| zone.order == PassingOrder::Resequenced));
    Arc::new(dense)
}

/// With a gate that lets in who is viable, approaches on which `v_max` can be braked off, and a standstill gap of a vehicle's
/// length, nobody ever begins unsafe: no negative margin and no contact, for any controller (docs/control.md, T3).
///
/// The default scenario has these itself, and newcomers whom its coordinators put ahead of others.
fn holds_for_everybody<A: FnMut(u64, &VehicleState) -> f64>(what: &str, adversary: impl Fn() -> A) {
    for (network, steps) in
        [("paper", 400_000), ("two-merges", 400_000), ("corridor-8", 200_000), ("tree", 200_000)]
    {
        let scenario = match network {
            "two-merges" => dense_default(),
            _ => gated(network, EntryRule::Viable, None),
        };
        let v = &scenario.vehicle;
        let least_m =
            v.v_max_mps * v.v_max_mps / (2.0 * -v.u_min_mps2) + 0.05 + v.v_max_mps * scenario.dt_s();
        for path in scenario.network.zones.iter().flat_map(|zone| &zone.paths) {
            assert!(path.length_m >= least_m, "{network}: {} m", path.length_m);
        }
        let (row, commanded, world) = attack(&scenario, steps, adversary());
        let summary = world.summary();
        println!(
            "{what}, {network}: {commanded} vehicle-steps, {} bounded, {} held at the gate; {row:?}",
            row.bounded, summary.held_arrivals
        );
        assert_eq!((row.began_unsafe, row.lost), (0, 0), "{what}, {network}");
        assert_eq!(summary.overlaps.pairs, 0, "{what}, {network}: {:?}", summary.overlaps);
        assert!(summary.held_arrivals > 0, "{what}, {network}");
        for zone in &summary.zones {
            for margin in [zone.min_rear_end_margin_m, zone.min_merge_margin_m] {
                assert!(margin.is_none_or(|m| m >= 0.0), "{what}, {network}: {zone:?}");
            }
            assert_eq!(zone.mean_exposure_m_s, 0.0, "{what}, {network}");
        }
    }
}

/// The same where paths cross and part: nobody who comes through such a gate is ever unsafe.
fn holds_where_paths_cross<A: FnMut(u64, &VehicleState) -> f64>(what: &str, adversary: impl Fn() -> A) {
    for network in ["intersection", "roundabout", "lane-drop", "grid-3x3"] {
        let mut held = 0;
        for order in [PassingOrder::Fifo, PassingOrder::PerPoint, PassingOrder::Resequenced] {
            let mut scenario = (*busy(network, "on", 900.0, 100_000)).clone();
            scenario.network.roads.iter_mut().for_each(|road| road.entry = EntryRule::Viable);
            scenario.network.zones.iter_mut().for_each(|zone| zone.order = order);
            let (row, commanded, world) = attack(&Arc::new(scenario), 100_000, adversary());
            let summary = world.summary();
            let what = format!("{what}, {network}, {order:?}");
            println!("{what}: {commanded} vehicle-steps, {} held; {row:?}", summary.held_arrivals);
            assert_eq!(
                (row.began_unsafe, row.lost, summary.overlaps.pairs),
                (0, 0, 0),
                "{what}: {summary:?}"
            );
            held += summary.held_arrivals;
            for margin in [row.min_rear_end_margin_m, row.min_merge_margin_m, row.min_cross_margin_m] {
                assert!(margin.is_none_or(|m| m >= 0.0), "{what}: {row:?}");
            }
        }
        assert!(held > 0, "{what}, {network}: the gate has nothing to do");
    }
}

/// Everybody speeds up wherever somebody else may be, and brakes where nobody is.
fn contrary() -> impl FnMut(u64, &VehicleState) -> f64 {
    |step, s| if (step / 40 + u64::from(s.vehicle)).is_multiple_of(2) || s.x_m > 150.0 { 4.0 } else { -4.0 }
}

/// All brake at once, and all let go at once, so that queues are packed as densely as they can be.
fn waves() -> impl FnMut(u64, &VehicleState) -> f64 {
    |step, s| if step % 300 < 60 && s.x_m < 150.0 { -4.0 } else { 4.0 }
}

#[test]
fn a_gate_makes_it_hold_for_everybody() {
    holds_for_everybody("full acceleration", always_u_max);
    holds_for_everybody("random flips", random_flips);
    holds_for_everybody("leaders that stop", leaders_that_stop);
    holds_for_everybody("contrary", contrary);
    holds_for_everybody("waves", waves);
}

#[test]
fn a_gate_makes_it_hold_where_paths_cross() {
    holds_where_paths_cross("full acceleration", always_u_max);
    holds_where_paths_cross("random flips", random_flips);
    holds_where_paths_cross("leaders that stop", leaders_that_stop);
    holds_where_paths_cross("contrary", contrary);
    holds_where_paths_cross("waves", waves);
}

/// What is assumed of the gate and of the gap is needed: without either the same drivers do harm, shield or not.
#[test]
fn without_a_gate_or_a_gap_it_does_not_hold() {
    for (entry, gap_m) in [(EntryRule::Free, None), (EntryRule::Viable, Some(0.0))] {
        let (row, _, world) = attack(&gated("paper", entry, gap_m), 100_000, leaders_that_stop());
        let overlaps = world.summary().overlaps;
        println!("{entry:?}, gap {gap_m:?}: {row:?}, {overlaps:?}");
        match entry {
            EntryRule::Free => assert!(row.began_unsafe > 0),
            _ => assert!(row.began_unsafe == 0 && overlaps.pairs > 0),
        }
    }
}

/// An embedded scenario under another rate on every road, until the given number of vehicles has come.
fn busy(name: &str, shield: &str, rate: f64, vehicles: u32) -> Arc<Scenario> {
    let base = load(Some(name), &[], None).unwrap();
    let mut sets =
        vec![format!("shield={shield}"), "end.time_s=40000".to_owned(), format!("end.vehicles={vehicles}")];
    for road in &base.network.roads {
        let rates = format!("[{{until_s=40000.0, vehicles_per_hour={rate}}}]");
        sets.push(format!("roads.{}.demand.rates={rates}", road.name));
    }
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some(name), &sets, Some(1)).unwrap())
}

/// Where paths cross, come together on shared lanes and part again, and around circles of zones.
fn withstands_where_paths_cross<A: FnMut(u64, &VehicleState) -> f64>(adversary: impl Fn() -> A) {
    for (network, rate) in [("intersection", 300.0), ("roundabout", 400.0), ("grid-3x3", 200.0)] {
        let (row, commanded, world) =
            attack(&busy(network, "on", rate, u32::MAX), VEHICLE_STEPS, adversary());
        assert!(commanded >= VEHICLE_STEPS, "{network}: only {commanded} vehicle-steps");
        println!("{network}: {row:?}, {:?}", world.summary().overlaps);
        assert_eq!(row.lost, 0, "{network}");
        for (what, margin) in [
            ("rear end", row.min_rear_end_margin_m),
            ("merge", row.min_merge_margin_m),
            ("cross", row.min_cross_margin_m),
        ] {
            assert!(margin.is_none_or(|m| m >= 0.0), "{network}: {what} {margin:?}");
        }
        assert!(row.rear_end > 0 && row.merge > 0, "{network}");
        assert!(network == "roundabout" || row.cross > 0, "{network}");
    }
}

#[test]
fn withstands_full_acceleration_where_paths_cross() {
    withstands_where_paths_cross(always_u_max);
}

#[test]
fn withstands_random_flips_where_paths_cross() {
    withstands_where_paths_cross(random_flips);
}

#[test]
fn withstands_leaders_that_stop_where_paths_cross() {
    withstands_where_paths_cross(leaders_that_stop);
}

/// Under more demand than they carry: everybody gets through, whichever the order, and nobody touches.
/// What a controller written elsewhere is told fits its commands and the states before and after.
#[test]
fn rows_are_named_with_the_vehicle_toward_which_they_are() {
    let set = "controllers=[{name=\"mine\", zones=[\"centre\"]}]".parse().unwrap();
    let sets = ["shield=on".parse().unwrap(), "end.time_s=100".parse().unwrap(), set];
    let scenario = Arc::new(load(Some("intersection"), &sets, Some(1)).unwrap());
    let mut world = World::new(scenario.clone(), 1);
    world.share_out(2);
    let mut coordinator = Coordinator::new(scenario.clone(), 0..1);
    let mut before: Vec<VehicleState> = Vec::new();
    let mut told = BTreeMap::<String, u32>::new();
    while !world.is_finished() {
        let states: Vec<VehicleState> = world.records().collect();
        for row in world.feedback() {
            *told.entry(row.row_name()).or_default() += 1;
            assert_eq!((row.controller, row.rule, row.step + 1), (1, RULE_NONE, world.step()), "{row}");
            let after = states.iter().find(|s| s.vehicle == row.vehicle && s.flags & STATE_LEFT == 0);
            assert!(row.greatest <= row.value && after.is_none_or(|s| s.u_mps2 <= row.greatest), "{row}");
            assert_eq!(row.toward == NO_VEHICLE, row.row == ROW_SPEED, "{row}");
            let is_there = |vehicle| before.iter().any(|s: &VehicleState| s.vehicle == vehicle);
            assert!(row.row == ROW_SPEED || row.toward != row.vehicle && is_there(row.toward), "{row}");
        }
        if world.coordinator_masks().acting != 0 {
            coordinator.act(world.step(), &states);
            world.coordinate(coordinator.assignments());
        }
        let commanded = states.iter().filter(|s| s.is_commanded());
        let all = commanded.map(|s| (s.vehicle, s.zone));
        let commands = all.map(|(vehicle, zone)| VehicleCommand {
            u_mps2: 3.0,
            vehicle,
            zone,
            ..VehicleCommand::default()
        });
        world.command(0, &[]).unwrap();
        world.command(1, &commands.collect::<Vec<_>>()).unwrap();
        world.advance().unwrap();
        before = states;
    }
    println!("{told:?}");
    for name in ["speed", "rear_end", "merge", "cross"] {
        assert!(told.contains_key(name), "{name}: {told:?}");
    }
}

#[test]
fn traffic_never_locks_up() {
    for network in ["intersection", "roundabout", "lane-drop", "grid-3x3"] {
        for order in [PassingOrder::Fifo, PassingOrder::PerPoint, PassingOrder::Resequenced] {
            let base = busy(network, "on", 900.0, 400);
            let mut scenario = (*base).clone();
            scenario.network.zones.iter_mut().for_each(|zone| zone.order = order);
            let summary = built_in(&Arc::new(scenario));
            let ShieldRow { lost, began_unsafe, .. } = summary.shield.controllers[0];
            println!(
                "{network}, {order:?}: {} steps, {} of {} left, {began_unsafe} began unsafe, {:?}, orders refused {}",
                summary.steps,
                summary.departed,
                summary.arrived,
                summary.overlaps,
                summary.zones.iter().map(|z| z.orders_refused).sum::<u32>()
            );
            assert_eq!((summary.departed, summary.waiting), (400, 0), "{network}, {order:?}");
            assert_eq!(lost, 0, "{network}, {order:?}");
        }
    }
}

/// Behind a gate nobody is ever unsafe, and bodies never touch, where paths part either.
#[test]
fn a_gate_keeps_bodies_apart_in_a_full_roundabout() {
    for order in [PassingOrder::Fifo, PassingOrder::PerPoint, PassingOrder::Resequenced] {
        let mut scenario = (*busy("roundabout", "on", 700.0, 300)).clone();
        scenario.network.roads.iter_mut().for_each(|road| road.entry = EntryRule::Viable);
        scenario.network.zones.iter_mut().for_each(|zone| zone.order = order);
        let summary = built_in(&Arc::new(scenario));
        let ShieldRow { lost, began_unsafe, .. } = summary.shield.controllers[0];
        assert_eq!((summary.departed, summary.waiting), (300, 0), "{order:?}");
        assert_eq!(
            (lost, began_unsafe, summary.overlaps.pairs),
            (0, 0, 0),
            "{order:?}: {:?}",
            summary.overlaps
        );
        assert!(summary.held_arrivals > 100, "{order:?}: it is not full");
    }
}

/// However the roles are shared out.
#[test]
fn one_hash_where_paths_cross() {
    for network in ["intersection", "roundabout", "lane-drop", "grid-3x3"] {
        for order in [PassingOrder::Fifo, PassingOrder::PerPoint] {
            let mut scenario = load(Some(network), &[], None).unwrap();
            scenario.max_vehicles = Some(60);
            scenario.network.zones.iter_mut().for_each(|zone| zone.order = order);
            let what = format!("{network}, {order:?}");
            assert_one_hash(&Arc::new(scenario), &[(2, 1), (1, 2), (3, 3), (9, 4)], &what);
        }
    }
}

/// A run of the built-in law, in one process.
fn built_in(scenario: &Arc<Scenario>) -> control_zones::world::WorldSummary {
    let mut run = InProcess::new(scenario, 1, 1);
    run.run().unwrap();
    run.world().summary()
}

#[test]
fn changes_nothing_when_nothing_is_violated() {
    let mut quiet = 0;
    for seed in 1..=20 {
        let with = |shield: &str| {
            let base = scenario("paper", shield, 4.0, 120.0, seed);
            built_in(&Arc::new(Scenario { max_vehicles: Some(60), ..(*base).clone() }))
        };
        let (off, observed) = (with("off"), with("observe"));
        assert_eq!(observed.state_hash, off.state_hash, "observing changes nothing, ever");
        let row = &observed.shield.controllers[0];
        assert!(row.commands > 5_000);
        if (row.rear_end, row.merge, row.speed, row.began_unsafe) == (0, 0, 0, 0) {
            quiet += 1;
            assert_eq!(with("on").state_hash, off.state_hash);
        }
    }
    assert!(quiet >= 5, "only {quiet} runs without a violation");
}

#[test]
fn values_beyond_the_limits_are_bounded_only_with_the_shield_on() {
    let wild = |step: u64, _: &VehicleState| if step.is_multiple_of(2) { f64::NAN } else { 1e9 };
    let (row, commanded, _) = attack(&scenario("paper", "on", 2.2, 500.0, 1), 1000, wild);
    assert_eq!(row.not_finite + row.limits, commanded);
    let mut world = World::new(scenario("paper", "off", 2.2, 500.0, 1), 1);
    while world.records().next().is_none() {
        world.command(0, &[]).unwrap();
        world.advance().unwrap();
    }
    let s = world.records().next().unwrap();
    let bad = VehicleCommand { u_mps2: f64::NAN, vehicle: s.vehicle, zone: s.zone, ..Default::default() };
    let text = world.command(0, &[bad]).unwrap_err().to_string();
    assert_eq!(text, format!("record 0, field u_mps2: vehicle {} is commanded NaN", s.vehicle));
}
