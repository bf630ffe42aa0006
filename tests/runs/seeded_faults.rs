//! Faults on purpose: each does what it says, the same for any number of processes, and the shield holds.

use crate::common::{TestRun, hash, part, send, wait_until_stepping};
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{Override, Scenario, load};
use control_zones::world::{FaultCounts, World, WorldSummary};
use ipc_schemas::{
    NO_ZONE, STATE_LEFT, VERDICT_BOUND, VERDICT_FALLBACK, VERDICT_HELD, VehicleCommand, VehicleState,
};
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::sync::Arc;

fn scenario(name: &str, seed: u64, sets: &[&str]) -> Arc<Scenario> {
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some(name), &sets, Some(seed)).unwrap())
}

/// A published frame: the records by zone and vehicle.
type Frame = BTreeMap<(u32, u32), VehicleState>;

/// A command that depends on nothing measured, and tells step and vehicle by its value; small enough that
/// nobody comes to a stop or gets near the greatest speed.
fn scripted(step: u64, vehicle: u32) -> f64 {
    let code = (step * 7 + u64::from(vehicle) * 13) % 101;
    (code as f64 - 50.0) * 0.004
}

/// The frames of a run under scripted commands: without sensors in the loop, the truth is the same whatever
/// they say.
fn scripted_run(scenario: &Arc<Scenario>, steps: usize) -> (Vec<Frame>, WorldSummary) {
    let mut world = World::new(scenario.clone(), 1);
    let mut frames = Vec::new();
    while frames.len() < steps {
        let step = world.step();
        let records: Vec<VehicleState> = world.records().collect();
        frames.push(records.iter().map(|r| ((r.zone, r.vehicle), *r)).collect());
        let commands: Vec<VehicleCommand> = records
            .iter()
            .filter(|r| is_member(r))
            .map(|r| VehicleCommand {
                u_mps2: scripted(step, r.vehicle),
                vehicle: r.vehicle,
                zone: r.zone,
                planned_exit_time_s: step as f64 + 1.0,
                ..VehicleCommand::default()
            })
            .collect();
        world.command(0, &commands).unwrap();
        world.advance().unwrap();
    }
    (frames, world.summary())
}

fn is_member(record: &VehicleState) -> bool {
    record.zone != NO_ZONE && record.flags & STATE_LEFT == 0
}

fn counts(summary: &WorldSummary) -> FaultCounts {
    summary.faults.expect("a scenario with faults counts them")
}

/// A run of the built-in law, in one process.
fn built_in(scenario: &Arc<Scenario>) -> WorldSummary {
    let mut run = InProcess::new(scenario, 1, 1);
    run.run().unwrap();
    run.world().summary()
}

/// Every kind at once.
const EVERYTHING: [&str; 4] = [
    "faults.noise={position_sd_m=0.5,speed_sd_mps=0.2}",
    "faults.commands={loss=0.05,delay_steps=2,delay_probability=0.1}",
    "faults.sensors=[{kind=\"bias\",fraction=0.2,position_m=2,speed_mps=-0.5},\
     {kind=\"frozen\",zones=[\"merge-1\"],from_s=60,until_s=65}]",
    "faults.stalls=[{paths=[\"merge-2.main\"],from_s=80,until_s=82}]",
];

#[test]
fn a_controller_cannot_claim_the_worlds_own_verdicts() {
    // What the world puts in after a missed deadline is neither lost nor silenced; who claims to be the world
    // does not get away with it.
    let scenario = scenario("paper", 1, &["faults.commands={loss=1.0}"]);
    let mut world = World::new(scenario, 1);
    while !world.records().any(|r| is_member(&r)) {
        world.command(0, &[]).unwrap();
        world.advance().unwrap();
    }
    let of = |world: &World, verdict| -> Vec<VehicleCommand> {
        let commanded = |r: VehicleState| VehicleCommand {
            u_mps2: 1.0,
            vehicle: r.vehicle,
            zone: r.zone,
            verdict,
            ..VehicleCommand::default()
        };
        world.records().filter(is_member).map(commanded).collect()
    };
    for verdict in [VERDICT_HELD, VERDICT_FALLBACK, 6, u16::MAX] {
        let fault = world.command(0, &of(&world, verdict)).unwrap_err();
        let words = format!("field verdict: vehicle 0 has verdict {verdict}, expected 0 to 3");
        assert!(fault.to_string().contains(&words), "{fault}");
    }
    let first_mps2 = |world: &World| world.records().find(is_member).unwrap().u_mps2;
    world.command(0, &of(&world, VERDICT_BOUND)).unwrap();
    world.advance().unwrap();
    assert_eq!((first_mps2(&world), counts(&world.summary()).commands_lost), (0.0, 1));
    world.put_in(0, &of(&world, VERDICT_HELD)).unwrap();
    world.advance().unwrap();
    assert_eq!((first_mps2(&world), counts(&world.summary()).commands_lost), (1.0, 1));
}

#[test]
fn the_number_of_processes_changes_nothing() {
    let run = |arguments: &[&str]| {
        let test_run = TestRun::new("sf");
        let mut all = vec!["faulty-sensors", "--set", "end.vehicles=80"];
        all.extend(arguments);
        let summary = test_run.summary(&all);
        test_run.assert_clean();
        summary
    };
    let expected = run(&["--in-process"]);
    for key in [
        "commands_lost",
        "commands_delayed",
        "commands_stalled",
        "records_noisy",
        "records_biased",
        "records_frozen",
    ] {
        assert!(expected["faults"][key].as_u64().unwrap() > 0, "{key}: {expected}");
    }
    for way in [
        &["--in-process"][..],
        &["--in-process", "--ctrl-procs", "2", "--coord-procs", "2"],
        &[],
        &["--ctrl-procs", "2"],
        &["--coord-procs", "2"],
        &["--ctrl-procs", "2", "--coord-procs", "2"],
    ] {
        let summary = run(way);
        assert_eq!(hash(&summary), hash(&expected), "{way:?}");
        for key in ["steps", "zones", "faults"] {
            assert_eq!(summary[key], expected[key], "{way:?}");
        }
    }
}

#[test]
fn a_killed_participant_is_replaced_without_a_trace() {
    // Long enough to be disturbed in the middle of.
    let mut sets = ["main1", "merge1", "merge2"]
        .map(|r| format!("roads.{r}.demand.rates=[{{until_s=10000.0,vehicles_per_hour=300.0}}]"))
        .to_vec();
    sets.extend(EVERYTHING.map(str::to_owned));
    let mut arguments = vec!["varying-demand", "--set", "end.time_s=10000", "--json", "-"];
    arguments.extend(sets.iter().flat_map(|set| ["--set", set.as_str()]));
    let expected =
        TestRun::new("sf").start("cz", &[&arguments[..], &["--in-process"]].concat()).ended().json();
    for victim in ["ctrl", "coord"] {
        let test_run = TestRun::new("sf");
        let (supervisor, parts) = crate::common::begin(&test_run, &arguments, 3);
        wait_until_stepping(part(&parts, "world"));
        send(part(&parts, victim), Signal::KILL);
        let summary = supervisor.ended().json();
        assert_eq!(summary["replacements"].as_array().unwrap().len(), 1, "{summary}");
        assert_eq!(hash(&summary), hash(&expected), "{victim}");
        assert_eq!(summary["faults"], expected["faults"], "{victim}");
        test_run.assert_clean();
    }
}

#[test]
fn the_table_has_a_line_only_when_there_are_faults() {
    let test_run = TestRun::new("sf");
    for (scenario, has_line) in [("two-merges", false), ("faulty-sensors", true)] {
        let ended = test_run.start("cz", &[scenario, "--in-process", "--set", "end.vehicles=5"]).ended();
        ended.expect(0, &[]);
        assert_eq!(ended.out.contains("\nfaults: commands "), has_line, "{ended:?}");
    }
    let summary = test_run.summary(&["two-merges", "--in-process", "--set", "end.vehicles=5"]);
    assert!(summary.get("faults").is_none(), "{summary}");
}

#[test]
fn another_seed_draws_other_faults() {
    // The same arrivals whatever the seed.
    let trace = ["main1", "merge1", "merge2"].map(|r| format!("roads.{r}.demand.trace=sumo-400-1"));
    let sets: Vec<&str> = trace.iter().map(String::as_str).collect();
    let hash = |seed, more: &[&str]| {
        let sets = [&sets[..], &["end.vehicles=30"], more].concat();
        built_in(&scenario("paper", seed, &sets)).state_hash
    };
    assert_eq!(hash(1, &[]), hash(2, &[]));
    for fault in [EVERYTHING[0], EVERYTHING[1], EVERYTHING[2]] {
        assert_eq!(hash(1, &[fault]), hash(1, &[fault]), "{fault}");
        assert_ne!(hash(1, &[fault]), hash(1, &[]), "{fault}");
        assert_ne!(hash(1, &[fault]), hash(2, &[fault]), "{fault}");
    }
    // A stall draws nothing.
    let stall = "faults.stalls=[{from_s=20,until_s=25}]";
    assert_ne!(hash(1, &[stall]), hash(1, &[]));
    assert_eq!(hash(1, &[stall]), hash(2, &[stall]));
}

#[test]
fn faults_of_no_size_change_no_hash() {
    let sets = [
        "faults.noise={position_sd_m=0}",
        "faults.commands={loss=0,delay_steps=3,delay_probability=0}",
        "faults.sensors=[{kind=\"bias\",position_m=0},{kind=\"frozen\",from_s=1e6}]",
        "faults.stalls=[{from_s=1e6}]",
    ];
    let summary = built_in(&scenario("paper", 1, &sets));
    assert_eq!(format!("{:016x}", summary.state_hash), "b56ea7e351b4a6a2", "see tests/runs/run_hashes.rs");
    let records_noisy = counts(&summary).records_noisy;
    assert_eq!(counts(&summary), FaultCounts { records_noisy, ..biased(&summary) });
    assert_eq!(built_in(&scenario("paper", 1, &["faults={}"])).faults, None);
}

fn biased(summary: &WorldSummary) -> FaultCounts {
    FaultCounts { records_biased: counts(summary).records_biased, ..FaultCounts::default() }
}

#[test]
fn noise_is_added_to_every_record() {
    let truth = scripted_run(&scenario("paper", 1, &[]), 1500).0;
    let noise = "faults.noise={position_sd_m=0.5,speed_sd_mps=0.2}";
    let (said, summary) = scripted_run(&scenario("paper", 1, &[noise]), 1500);
    let (mut n, mut sums, mut squares) = (0.0, [0.0; 2], [0.0; 2]);
    for (truth, said) in truth.iter().zip(&said) {
        assert!(truth.keys().eq(said.keys()));
        for (key, truth) in truth {
            let said = &said[key];
            let errors = [said.x_m - truth.x_m, said.v_mps - truth.v_mps];
            assert!(errors[0] != 0.0 && errors[0].abs() < 3.0 && errors[1].abs() < 1.2, "{errors:?}");
            // All but what is measured is as it was.
            assert_eq!(VehicleState { x_m: truth.x_m, v_mps: truth.v_mps, ..*said }, *truth);
            n += 1.0;
            for i in 0..2 {
                sums[i] += errors[i];
                squares[i] += errors[i] * errors[i];
            }
        }
    }
    assert!(n > 10_000.0, "only {n} records");
    for (i, sd) in [0.5, 0.2].into_iter().enumerate() {
        assert!((sums[i] / n).abs() < 0.05 * sd, "mean {}", sums[i] / n);
        assert!(((squares[i] / n).sqrt() / sd - 1.0).abs() < 0.03, "sd {}", (squares[i] / n).sqrt());
    }
    // Counted also for the frame that follows the last one looked at.
    let last = counts(&summary).records_noisy as f64;
    assert!(last >= n && last < n + 100.0, "{last} of {n}");
}

#[test]
fn a_vehicle_has_one_error_wherever_it_is_listed() {
    let truth = scripted_run(&scenario("paper", 1, &[]), 900).0;
    let said = scripted_run(&scenario("paper", 1, &[EVERYTHING[0]]), 900).0;
    // With fewer vehicles on the road the draws of the rest stay the same.
    let fewer = scripted_run(&scenario("paper", 1, &[EVERYTHING[0], "end.vehicles=20"]), 900).0;
    let (mut twice, mut shared) = (0, 0);
    for ((truth, said), fewer) in truth.iter().zip(&said).zip(&fewer) {
        for (&(zone, vehicle), record) in said {
            let error_m = record.x_m - truth[&(zone, vehicle)].x_m;
            if let (0, Some(other)) = (zone, said.get(&(1, vehicle))) {
                let other_m = other.x_m - truth[&(1, vehicle)].x_m;
                assert!((error_m - other_m).abs() < 1e-9, "{error_m} {other_m}");
                twice += 1;
            }
            if let Some(other) = fewer.get(&(zone, vehicle)) {
                assert_eq!(other.x_m, record.x_m);
                shared += 1;
            }
        }
    }
    assert!(twice > 100 && shared > 1000, "{twice} {shared}");
}

#[test]
fn a_bias_shifts_what_is_published_by_exactly_that() {
    let bias = "faults.sensors=[{kind=\"bias\",zones=[\"merge-1\"],from_s=30,until_s=60,position_m=-2.5,speed_mps=0.75}]";
    let truth = scripted_run(&scenario("paper", 1, &[]), 900).0;
    let (said, summary) = scripted_run(&scenario("paper", 1, &[bias]), 900);
    let mut struck = 0;
    for (step, (truth, said)) in truth.iter().zip(&said).enumerate() {
        for (key, truth) in truth {
            let is_struck = key.0 == 0 && (300..600).contains(&step);
            let shifted = VehicleState { x_m: truth.x_m - 2.5, v_mps: truth.v_mps + 0.75, ..*truth };
            assert_eq!(said[key], if is_struck { shifted } else { *truth }, "step {step}");
            struck += u64::from(is_struck);
        }
    }
    assert!(struck > 500, "{struck}");
    assert_eq!(counts(&summary), FaultCounts { records_biased: struck, ..FaultCounts::default() });
    // A speed that would be negative is 0.
    let slow = "faults.sensors=[{kind=\"bias\",speed_mps=-1000}]";
    let said = scripted_run(&scenario("paper", 1, &[slow]), 400).0;
    assert!(said.iter().flat_map(|f| f.values()).all(|r| r.v_mps.to_bits() == 0));
}

#[test]
fn a_fraction_of_the_vehicles_is_the_same_for_life() {
    let bias = "faults.sensors=[{kind=\"bias\",fraction=0.3,position_m=1}]";
    let truth = scripted_run(&scenario("paper", 1, &[]), 4000).0;
    let said = scripted_run(&scenario("paper", 1, &[bias]), 4000).0;
    let mut is_struck = BTreeMap::new();
    for (truth, said) in truth.iter().zip(&said) {
        for (key, truth) in truth {
            let struck = said[key].x_m != truth.x_m;
            assert_eq!(*is_struck.entry(key.1).or_insert(struck), struck, "vehicle {}", key.1);
        }
    }
    let struck = is_struck.values().filter(|&&s| s).count();
    assert_eq!(is_struck.len(), 120);
    // Binomial: 0.3 of 120, give or take three standard deviations.
    assert!((21..=51).contains(&struck), "{struck} of {}", is_struck.len());
}

#[test]
fn a_frozen_sensor_repeats_what_it_said_first() {
    let frozen =
        "faults.sensors=[{kind=\"frozen\",paths=[\"merge-1.main\",\"merge-2.merge\"],from_s=30,until_s=60}]";
    let noise = EVERYTHING[0];
    let noisy = scripted_run(&scenario("paper", 1, &[noise]), 900).0;
    let (said, summary) = scripted_run(&scenario("paper", 1, &[noise, frozen]), 900);
    let mut first: BTreeMap<(u32, u32), VehicleState> = BTreeMap::new();
    let (mut struck, mut moved) = (0, 0);
    for (step, (noisy, said)) in noisy.iter().zip(&said).enumerate() {
        for (key, noisy) in noisy {
            if (key.0, noisy.path) != (0, 0) && (key.0, noisy.path) != (1, 1) || !(300..600).contains(&step) {
                assert_eq!(said[key], *noisy, "step {step}");
                continue;
            }
            // What it measured when the fault began, or when the vehicle came into the zone.
            let first = first.entry(*key).or_insert(*noisy);
            let repeated =
                VehicleState { x_m: first.x_m, v_mps: first.v_mps, u_mps2: first.u_mps2, ..*noisy };
            assert_eq!(said[key], repeated, "step {step}");
            struck += 1;
            moved += u64::from(noisy.x_m > first.x_m + 10.0);
        }
    }
    assert!(first.len() > 5 && moved > 100, "{} {moved}", first.len());
    assert_eq!(counts(&summary).records_frozen, struck);
}

/// Checks what each member did over each step, as the next frame tells, against `expected`: from step,
/// record at the step's beginning. Returns how many were checked.
fn each_step(frames: &[Frame], mut expected: impl FnMut(u64, &VehicleState) -> Option<f64>) -> u64 {
    let mut checked = 0;
    for (step, pair) in (0..).zip(frames.windows(2)) {
        for (key, record) in pair[0].iter().filter(|(_, r)| is_member(r)) {
            let (Some(u), Some(after)) = (expected(step, record), pair[1].get(key)) else { continue };
            if is_member(after) {
                assert_eq!(after.u_mps2, u, "step {step}, zone and vehicle {key:?}");
                checked += 1;
            }
        }
    }
    checked
}

#[test]
fn without_faults_a_vehicle_does_as_it_is_told() {
    let frames = scripted_run(&scenario("paper", 1, &[]), 500).0;
    assert!(each_step(&frames, |step, r| Some(scripted(step, r.vehicle))) > 1000);
}

#[test]
fn a_vehicle_that_hears_nothing_keeps_its_acceleration() {
    let lost = "faults.commands={loss=1,from_s=20,until_s=40}";
    let stalled = "faults.stalls=[{from_s=20,until_s=40}]";
    for set in [lost, stalled] {
        let (frames, summary) = scripted_run(&scenario("paper", 1, &[set]), 500);
        let mut silent = 0;
        let checked = each_step(&frames, |step, r| {
            let is_silent = (200..400).contains(&step);
            silent += u64::from(is_silent);
            // Also across the border of a zone, and for an arrival, which comes in without one.
            Some(if is_silent { r.u_mps2 } else { scripted(step, r.vehicle) })
        });
        assert!(checked > 1000 && silent > 500, "{checked} {silent}");
        let expected = FaultCounts::default();
        assert_eq!(
            counts(&summary),
            if set == lost {
                FaultCounts { commands_lost: silent, ..expected }
            } else {
                FaultCounts { commands_stalled: silent, ..expected }
            }
        );
        // The intent that is passed on is that of the last command heard of.
        for (step, frame) in frames.iter().enumerate().skip(201).take(199) {
            assert!(frame.values().all(|r| r.planned_exit_time_s <= 200.0), "step {step}");
        }
    }
}

#[test]
fn a_stall_reaches_its_paths_only() {
    let set = "faults.stalls=[{paths=[\"merge-1.merge\"],from_s=20,until_s=40}]";
    let frames = scripted_run(&scenario("paper", 1, &[set]), 500).0;
    let checked = each_step(&frames, |step, r| {
        let is_silent = (200..400).contains(&step) && (r.zone, r.path) == (0, 1);
        Some(if is_silent { r.u_mps2 } else { scripted(step, r.vehicle) })
    });
    assert!(checked > 1000);
}

#[test]
fn a_vehicle_at_full_speed_does_not_keep_accelerating() {
    let sets = ["faults.commands={loss=1,from_s=20}", "end.vehicles=30", "vehicle.v_max_mps=22"];
    let mut run = InProcess::new(&scenario("varying-demand", 1, &sets), 1, 1);
    let mut fastest_mps: f64 = 0.0;
    for _ in 0..2000 {
        if !run.step().unwrap() {
            break;
        }
        fastest_mps = run.world().records().map(|r| r.v_mps).fold(fastest_mps, f64::max);
    }
    assert!((fastest_mps - 22.0).abs() < 1e-9, "{fastest_mps}");
}

#[test]
fn a_late_command_comes_that_many_steps_later() {
    let set = "faults.commands={delay_steps=3}";
    let (frames, summary) = scripted_run(&scenario("paper", 1, &[set]), 500);
    let mut since: BTreeMap<(u32, u32), u64> = BTreeMap::new();
    let checked = each_step(&frames, |step, r| {
        // A command is for a vehicle in a zone: none is taken along into the next.
        let entered = *since.entry((r.zone, r.vehicle)).or_insert(step);
        Some(if step < entered + 3 { r.u_mps2 } else { scripted(step - 3, r.vehicle) })
    });
    assert!(checked > 1000);
    let delayed = frames.iter().flat_map(|f| f.values()).filter(|r| is_member(r)).count() as u64;
    assert_eq!(counts(&summary), FaultCounts { commands_delayed: delayed, ..FaultCounts::default() });
}

#[test]
fn an_older_command_never_overwrites_a_newer_one() {
    let set = "faults.commands={loss=0.2,delay_steps=4,delay_probability=0.5}";
    let (frames, summary) = scripted_run(&scenario("paper", 1, &[set]), 4000);
    // The intent is the step of the command obeyed, plus 1.
    let mut obeyed: BTreeMap<(u32, u32), f64> = BTreeMap::new();
    let (mut at_once, mut late, mut held) = (0u64, 0u64, 0u64);
    for (step, pair) in (0..).zip(frames.windows(2)) {
        for (key, record) in pair[0].iter().filter(|(_, r)| is_member(r)) {
            let Some(after) = pair[1].get(key).filter(|r| is_member(r)) else { continue };
            let before = obeyed.insert(*key, after.planned_exit_time_s).unwrap_or(0.0);
            let sent = after.planned_exit_time_s - 1.0;
            if sent == before - 1.0 {
                held += 1;
                assert_eq!(after.u_mps2, record.u_mps2);
                continue;
            }
            assert!(sent > before - 1.0, "step {step}: the command of step {sent} came after a newer one");
            let age = step as f64 - sent;
            assert!(age == 0.0 || age == 4.0, "{age}");
            assert_eq!(after.u_mps2, scripted(sent as u64, record.vehicle));
            *(if age == 0.0 { &mut at_once } else { &mut late }) += 1;
        }
    }
    let all = (at_once + late + held) as f64;
    assert!(all > 10_000.0, "{all}");
    // 0.8 are not lost, half of these come at once; the late ones count only if four steps go by without.
    assert!((at_once as f64 / all - 0.4).abs() < 0.02, "{at_once} of {all}");
    assert!((late as f64 / all - 0.4 * 0.6f64.powi(4)).abs() < 0.02, "{late} of {all}");
    let counts = counts(&summary);
    assert!((counts.commands_lost as f64 / all - 0.2).abs() < 0.02, "{counts:?}");
    assert!((counts.commands_delayed as f64 / all - 0.4).abs() < 0.02, "{counts:?}");
}

#[test]
fn the_shield_holds_its_guarantee_whatever_goes_wrong() {
    // Heavy enough a traffic that without the shield the margins are lost.
    let heavy = |seed, shield: &str, more: &[&str]| {
        let shield = format!("shield={shield}");
        let sets =
            [&EVERYTHING[..], &[&shield, "end.vehicles=120", "vehicle.standstill_gap_m=1"], more].concat();
        built_in(&scenario("varying-demand", seed, &sets))
    };
    let more = [
        &[][..],
        &["faults.commands={loss=0.5,delay_steps=20,delay_probability=0.5}"],
        &["faults.noise={position_sd_m=20,speed_sd_mps=5}"],
        &["faults.sensors=[{kind=\"frozen\",from_s=30}]", "end.time_s=300"],
        &["faults.sensors=[{kind=\"bias\",position_m=-50,speed_mps=-5}]"],
        &["faults.stalls=[{from_s=50}]", "end.time_s=300"],
    ];
    let mut worst = [f64::INFINITY; 2];
    for (seed, more) in (1..=8).flat_map(|seed| more.map(|more| (seed, more))) {
        let on = heavy(seed, "on", more);
        let row = &on.shield.controllers[0];
        assert_eq!(row.lost, 0, "seed {seed}, {more:?}");
        for (margin, worst) in [row.min_rear_end_margin_m, row.min_merge_margin_m].into_iter().zip(&mut worst)
        {
            let margin = margin.unwrap_or(f64::INFINITY);
            assert!(margin >= 0.0, "seed {seed}, {more:?}: {margin} m");
            *worst = worst.min(margin);
        }
    }
    println!("least margins of guaranteed vehicles, shielded: {worst:?} m");
    for (more, margins) in more.map(|more| {
        let observed = heavy(1, "observe", more);
        let row = observed.shield.controllers[0].clone();
        (more, (row.min_rear_end_margin_m, row.min_merge_margin_m, row.lost))
    }) {
        println!("unshielded, {more:?}: {margins:?}");
        if !more.is_empty() {
            assert!(margins.2 > 0, "{more:?} harms nobody, so the shield proves nothing");
        }
    }
}

#[test]
fn no_measurement_makes_a_controller_fail() {
    let wild = [
        "faults.noise={position_sd_m=1e6,speed_sd_mps=1e6}",
        "faults.noise={position_sd_m=300,speed_sd_mps=30}",
        "faults.sensors=[{kind=\"bias\",position_m=-1e6,speed_mps=1e6}]",
        "faults.sensors=[{kind=\"bias\",position_m=1e6,speed_mps=-1e6}]",
        "faults.sensors=[{kind=\"frozen\"}]",
    ];
    let laws = [
        &[][..],
        &["control.replan=from_state"],
        &["control.position_feedback=exact", "control.safety_rows=sampled"],
        &["control.reference=as_printed", "control.replan=from_state"],
        &["control.solver=clarabel"],
    ];
    for (wild, law) in wild.iter().flat_map(|wild| laws.map(|law| (wild, law))) {
        for shield in ["shield=off", "shield=on"] {
            let sets = [&[*wild, shield, "end.vehicles=25", "end.time_s=90"], law].concat();
            let mut run = InProcess::new(&scenario("varying-demand", 1, &sets), 1, 1);
            while run.step().unwrap_or_else(|e| panic!("{sets:?}: {e}")) {
                for r in run.world().records() {
                    assert!(r.x_m.is_finite() && r.v_mps.is_finite() && r.v_mps >= 0.0, "{sets:?}: {r:?}");
                    assert!(r.u_mps2.is_finite(), "{sets:?}: {r:?}");
                }
            }
        }
    }
}

#[test]
fn a_recorded_run_replays() {
    let test_run = TestRun::new("sf");
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.czlog");
    let file = file.to_str().unwrap();
    let summary =
        test_run.summary(&["faulty-sensors", "--in-process", "--set", "end.vehicles=60", "--record", file]);
    let output = test_run.command("cz").args(["replay", file]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{output:?}");
    assert!(text.contains(&hash(&summary)), "{text}");
}
