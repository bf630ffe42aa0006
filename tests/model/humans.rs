//! Human drivers among automated vehicles: everybody gets through, and whoever is automated stays safe among humans that
//! do as they are told within their limits, whatever its controller wishes.

use crate::adversaries::{always_u_max, leaders_that_stop, random_flips};
use crate::shares::assert_one_hash;
use control_zones::coordination::Coordinator;
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{Override, Scenario, load, load_embedded};
use control_zones::world::{World, WorldSummary};
use ipc_schemas::{STATE_HUMAN, VehicleCommand, VehicleState};
use std::sync::Arc;

/// A network in which some are automated and the others are humans of this kind, as dense as it is told to be.
fn mixed(network: &str, automated: f64, human: &str, rate: f64, vehicles: u32, seed: u64) -> Arc<Scenario> {
    let base = load(Some(network), &[], None).unwrap();
    let mut sets = vec![
        "shield=on".to_owned(),
        "control.law=viable".to_owned(),
        "gate.entry=viable".to_owned(),
        format!("fleet=[{{name=\"automated\"}}, {{name=\"human\", driver=\"human\", {human}}}]"),
        "end.time_s=40000".to_owned(),
        format!("end.vehicles={vehicles}"),
    ];
    for (rank, road) in (1..).zip(&base.network.roads) {
        sets.push(format!("roads.{}.automated={automated}", road.name));
        sets.push(format!("roads.{}.rank={}", road.name, rank % 2));
        let demand = match network {
            "two-merges" => {
                "min_headway_s=1.2, speed_mean_mps=16.0, speed_sd_mps=1.2, speed_min_mps=10.0, speed_max_mps=22.0"
            }
            "intersection" => {
                "min_headway_s=2.0, speed_mean_mps=11.0, speed_sd_mps=1.0, speed_min_mps=8.0, speed_max_mps=14.0"
            }
            _ => {
                "min_headway_s=2.0, speed_mean_mps=8.0, speed_sd_mps=1.0, speed_min_mps=5.0, speed_max_mps=11.0"
            }
        };
        sets.push(format!(
            "roads.{}.demand={{rates=[{{until_s=40000.0, vehicles_per_hour={rate}}}], {demand}}}",
            road.name
        ));
    }
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some(network), &sets, Some(seed)).unwrap())
}

/// A run of the built-in controllers.
fn built_in(scenario: &Arc<Scenario>) -> WorldSummary {
    let mut run = InProcess::new(scenario, 1, 1);
    run.run().unwrap();
    run.world().summary()
}

/// Least margins of those that were safe when they came to owe something: rear end, merging.
fn clean_m(summary: &WorldSummary) -> [f64; 2] {
    let least = |of: fn(&control_zones::world::ZoneSummaryRow) -> Option<f64>| {
        summary.zones.iter().filter_map(of).fold(f64::INFINITY, f64::min)
    };
    [least(|z| z.min_rear_end_margin_clean_m), least(|z| z.min_merge_margin_clean_m)]
}

const NETWORKS: [(&str, f64); 3] = [("two-merges", 400.0), ("intersection", 250.0), ("roundabout", 300.0)];

/// At any share of automated vehicles, in every kind of network, with humans of all kinds.
#[test]
fn everybody_gets_through() {
    for (network, rate) in NETWORKS {
        for automated in [0.0, 0.5, 0.9] {
            for yields in ["order", "priority", "gap"] {
                let human = format!("yields=\"{yields}\", desired_sd_mps=1, scares_per_h=10");
                let scenario = mixed(network, automated, &human, rate, 150, 1);
                let summary = built_in(&scenario);
                let row = &summary.shield.controllers[0];
                let clean_m = clean_m(&summary);
                println!(
                    "{network}, {automated}, {yields}: {} of {} left in {} steps, overlaps {}, clean {clean_m:?}, {row:?}",
                    summary.departed, summary.arrived, summary.steps, summary.overlaps.pairs,
                );
                assert_eq!((summary.departed, summary.waiting), (150, 0), "{network}, {automated}, {yields}");
                if yields == "order" {
                    assert_eq!((row.lost, summary.overlaps.pairs), (0, 0), "{network}, {automated}");
                    assert!(clean_m.iter().all(|m| *m >= 0.0), "{network}, {automated}: {clean_m:?}");
                }
            }
        }
    }
}

/// Humans who go by their own right of way do not start into one that comes, and sort out by sight who goes first when two
/// have entered at the same instant; and an automated vehicle that stands at its line lets one pass that drives. Each of
/// these runs of the penetration study had bodies that overlapped, or duties that began outside the safe set.
#[test]
fn nobody_starts_into_another() {
    for (automated, seed) in
        [(0.0, 4), (0.0, 5), (0.1, 13), (0.3, 9), (0.4, 5), (0.5, 8), (0.6, 13), (0.7, 13), (0.8, 9)]
    {
        let human = "driver=\"human\", yields=\"priority\", desired_mps=13, desired_sd_mps=1";
        let sets = [
            "shield=on".to_owned(),
            "gate.entry=viable".to_owned(),
            "control.law=viable".to_owned(),
            "coordination.schedule=tandem".to_owned(),
            "coordination.order=resequenced".to_owned(),
            format!("fleet=[{{name=\"automated\"}}, {{name=\"human\", {human}}}]"),
            format!("roads.*.automated={automated}"),
            "roads.0.rank=1".to_owned(),
            "end.vehicles=100".to_owned(),
        ];
        let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
        let summary = built_in(&Arc::new(load_embedded("intersection", &sets, Some(seed)).unwrap()));
        let row = &summary.shield.controllers[0];
        let what = format!("{automated}, seed {seed}: {:?}", summary.overlaps);
        assert_eq!((summary.departed, summary.waiting), (100, 0), "{what}");
        assert_eq!((summary.overlaps.pairs, row.began_unsafe, row.lost), (0, 0, 0), "{what}");
    }
}

/// Where no rank says who goes first, nobody starts together with one that stands beside it. Each of these runs had bodies that
/// overlapped, and that with scares never ended; but the last: three that wait for each other enter a box there and never get out, if they may start together
/// once they have waited long enough.
#[test]
fn nobody_starts_together_with_another() {
    let runs = [
        ("two-merges", 0.2, "desired_sd_mps=1", 1),
        ("two-merges", 0.2, "desired_sd_mps=1", 3),
        ("two-merges", 0.2, "desired_sd_mps=1", 4),
        ("two-merges", 0.5, "desired_sd_mps=1", 2),
        ("two-merges", 0.5, "desired_sd_mps=1", 5),
        ("intersection", 0.0, "desired_sd_mps=1", 3),
        ("roundabout", 0.5, "desired_sd_mps=1", 1),
        ("two-merges", 0.5, "desired_sd_mps=1, scares_per_h=10", 7),
        ("intersection", 0.5, "desired_sd_mps=0", 11),
    ];
    for (network, automated, human, seed) in runs {
        let rate = NETWORKS.iter().find(|(name, _)| *name == network).unwrap().1;
        let human = format!("yields=\"gap\", {human}");
        let summary = built_in(&mixed(network, automated, &human, rate, 150, seed));
        let row = &summary.shield.controllers[0];
        let what = format!("{network}, {automated}, seed {seed}: {:?}", summary.overlaps);
        assert_eq!((summary.departed, summary.waiting), (150, 0), "{what}");
        assert_eq!((summary.overlaps.pairs, row.lost), (0, 0), "{what}");
    }
}

/// Drives the automated ones with an adversary until so many steps of vehicles, humans and others, have passed.
fn attack(
    scenario: &Arc<Scenario>,
    steps: u64,
    mut adversary: impl FnMut(u64, &VehicleState) -> f64,
) -> (u64, u64, World) {
    let mut world = World::new(scenario.clone(), 1);
    let mut coordinator = Coordinator::new(scenario.clone(), 0..scenario.network.zones.len() as u32);
    let (mut all, mut humans) = (0, 0);
    while all < steps && !world.is_finished() {
        let step = world.step();
        let states: Vec<VehicleState> = world.records().collect();
        if world.coordinator_masks().acting != 0 {
            coordinator.act(step, &states);
            world.coordinate(coordinator.assignments());
        }
        let command = |s: &VehicleState| VehicleCommand {
            u_mps2: adversary(step, s).clamp(-3.0, 3.0),
            vehicle: s.vehicle,
            zone: s.zone,
            ..VehicleCommand::default()
        };
        let commands: Vec<VehicleCommand> = states.iter().filter(|s| s.is_commanded()).map(command).collect();
        let driven = states.iter().filter(|s| s.flags & STATE_HUMAN != 0 && !s.has_left()).count() as u64;
        (all, humans) = (all + commands.len() as u64 + driven, humans + driven);
        world.command(0, &commands).unwrap();
        world.advance().unwrap();
    }
    (all, humans, world)
}

/// A third of a million steps per network and adversary with humans that brake fully for no reason, never harder than is
/// assumed of them.
fn withstands<A: FnMut(u64, &VehicleState) -> f64>(what: &str, adversary: impl Fn() -> A) {
    let (mut steps, mut humans) = (0, 0);
    for (network, rate) in NETWORKS {
        let human = "yields=\"order\", desired_sd_mps=1, scares_per_h=60, noise_mps2=0.4, u_max_mps2=2";
        let scenario = mixed(network, 0.5, human, rate, u32::MAX, 2);
        let (all, driven, world) = attack(&scenario, 340_000, adversary());
        let summary = world.summary();
        let row = &summary.shield.controllers[0];
        let clean_m = clean_m(&summary);
        println!(
            "{what}, {network}: {all} vehicle-steps, {driven} of humans; {} left; least margins that were {clean_m:?}, reckoned \
             with full braking {:?} {:?} {:?}; bounded {}, began unsafe {}, overlaps {:?}",
            summary.departed,
            row.min_rear_end_margin_m,
            row.min_merge_margin_m,
            row.min_cross_margin_m,
            row.bounded,
            row.began_unsafe,
            summary.overlaps,
        );
        assert_eq!(row.lost, 0, "{what}, {network}");
        let reckoned = [row.min_rear_end_margin_m, row.min_merge_margin_m, row.min_cross_margin_m];
        let margins = reckoned.into_iter().flatten().chain(clean_m);
        assert!(margins.into_iter().all(|m| m >= 0.0), "{what}, {network}");
        assert!(row.rear_end > 0 && row.merge > 0, "{what}, {network}");
        (steps, humans) = (steps + all, humans + driven);
    }
    assert!(steps >= 1_000_000 && humans >= 300_000, "{what}: {steps}, of humans {humans}");
}

#[test]
fn withstands_full_acceleration_among_humans() {
    withstands("full acceleration", always_u_max);
}

#[test]
fn withstands_random_flips_among_humans() {
    withstands("random flips", random_flips);
}

#[test]
fn withstands_leaders_that_stop_among_humans() {
    withstands("leaders that stop", leaders_that_stop);
}

/// However the roles are shared out, and whether humans follow the order or not.
#[test]
fn one_hash_with_humans() {
    for yields in ["order", "priority", "gap"] {
        let set = format!("fleet.human.yields=\"{yields}\"").parse().unwrap();
        let scenario = Arc::new(load_embedded("mixed-merges", &[set], None).unwrap());
        assert_one_hash(&scenario, &[(2, 1), (1, 2), (2, 2)], yields);
    }
}

/// A road's share of automated vehicles goes before the kinds' shares; nobody else's kind depends on it.
#[test]
fn penetration_is_per_road() {
    let scenario = load_embedded("mixed-merges", &[], None).unwrap();
    for (road, share) in [(0, 0.5), (1, 0.4), (2, 0.6)] {
        let automated = (0..10_000).filter(|&v| scenario.human(scenario.kind_of(v, road)).is_none()).count();
        // Three standard deviations.
        assert!((automated as f64 / 10_000.0 - share).abs() < 0.015, "{road}: {automated}");
    }
}
