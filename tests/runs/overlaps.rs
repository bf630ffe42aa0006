//! Bodies that overlap are counted, wherever and however they come to.

use crate::common::TestRun;
use control_zones::scenario::{Scenario, load_given};
use control_zones::world::{OverlapSummary, World};
use ipc_schemas::{NO_ZONE, STATE_LEFT, VehicleCommand, VehicleState};
use proptest::prelude::*;
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

const BODY_M: f64 = 4.5;
const DT_S: f64 = 0.1;

/// A vehicle passes another: the least that may be said of such a run. The measured figures are those of a
/// count of samples made elsewhere.
#[test]
fn a_vehicle_that_passes_another_is_in_table_json_and_stderr() {
    let test_run = TestRun::new("overlap");
    let arguments = [
        "run",
        "paper",
        "--in-process",
        "--seed",
        "3",
        "--set",
        "control.replan=from_state",
        "--set",
        "zones.merge-1.flow={policy=\"none\"}",
        "--set",
        "zones.merge-2.flow={policy=\"none\"}",
    ];
    let output = test_run.command("cz").args(arguments).output().unwrap();
    let (stdout, stderr) =
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    let said = "bodies overlapped: 1 pair of vehicles, 4.67 s in all (47 samples), by up to 4.50 m; first 72 \
                and 73 in merge-2 at 232.7 s";
    assert!(stdout.contains(said), "{stdout}");
    assert!(stderr.contains(&format!("cz: warning: {said}")), "{stderr}");
    let json = test_run.summary(&[&arguments[1..2], &arguments[3..]].concat());
    let overlaps = &json["overlaps"];
    assert_eq!((&overlaps["pairs"], &overlaps["samples"]), (&1.into(), &47.into()));
    assert_eq!(overlaps["first"]["vehicles"], serde_json::json!([72, 73]));
    // Nothing overlaps in what the program does when nothing else is asked of it.
    let quiet = test_run.command("cz").args(["run", "--in-process"]).output().unwrap();
    assert!(!String::from_utf8(quiet.stderr).unwrap().contains("overlapped"));
}

/// A corridor of zones with a side road each, the last one so long that nobody gets out.
fn corridor(zones: &[([f64; 2], f64)], seed: u64) -> Arc<Scenario> {
    let mut text = "name = \"n\"\nobjective = { beta = 1 }\nend = { time_s = 60 }\n".to_owned();
    let mut roads = Vec::new();
    for (i, ([main_m, side_m], link_m)) in zones.iter().enumerate() {
        let main = match i {
            0 => "road = \"main\"".to_owned(),
            _ => format!("zone = \"z{}\"\nlink_m = {link_m}", i - 1),
        };
        let far_m = if i + 1 == zones.len() { 1e5 } else { 0.0 };
        text += &format!(
            "[[zones]]\nname = \"z{i}\"\n[[zones.approaches]]\nname = \"main\"\nlength_m = {}\n{main}\n\
             [[zones.approaches]]\nname = \"side\"\nlength_m = {}\nroad = \"side{i}\"\n",
            main_m + far_m,
            side_m + far_m,
        );
        roads.push(format!("side{i}"));
    }
    roads.push("main".to_owned());
    for road in roads {
        text += &format!(
            "[[roads]]\nname = \"{road}\"\n[roads.demand]\nrates = [{{ until_s = 50, vehicles_per_hour = 700 }}]\n\
             min_headway_s = 1\nspeed_mean_mps = 9\nspeed_sd_mps = 3\nspeed_min_mps = 4\nspeed_max_mps = 14\n"
        );
    }
    Arc::new(load_given(&text, Vec::new(), &[], Some(seed)).unwrap())
}

/// Where a vehicle is: a zone and path, or the link behind a zone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    Path(u32, u32),
    Link(u32),
}

/// What a count by hand comes to: positions along the way each vehicle has come, all pairs, every sample.
#[derive(Default)]
struct Oracle {
    /// The way of each vehicle, with the position of its front in each place of it.
    ways: HashMap<u32, Vec<(Place, f64)>>,
    together: BTreeSet<(u32, u32)>,
    pairs: BTreeSet<(u32, u32)>,
    samples: u64,
    changes: u64,
}

impl Oracle {
    fn length_m(scenario: &Scenario, place: Place) -> f64 {
        match place {
            Place::Path(zone, path) => scenario.network.zones[zone as usize].paths[path as usize].length_m,
            Place::Link(zone) => {
                scenario.network.zones[zone as usize].exits[0].to.map_or(0.0, |to| to.link_m)
            }
        }
    }

    fn look(&mut self, scenario: &Scenario, states: &[VehicleState]) {
        let mut present = Vec::new();
        for s in states.iter().filter(|s| s.flags & STATE_LEFT == 0) {
            let way = self.ways.entry(s.vehicle).or_default();
            let before = way.last().map(|(place, _)| *place);
            let place = match before {
                _ if s.zone != NO_ZONE => Place::Path(s.zone, s.path),
                Some(Place::Path(zone, _)) => Place::Link(zone),
                Some(link) => link,
                None => unreachable!("nobody begins on a link"),
            };
            if before != Some(place) {
                way.push((place, 0.0));
            }
            // From the front backwards, each place adds its length.
            let mut front_m = s.x_m;
            for i in (0..way.len()).rev() {
                if i + 1 < way.len() {
                    front_m += Oracle::length_m(scenario, way[i].0);
                }
                way[i].1 = front_m;
            }
            present.push(s.vehicle);
        }
        let mut together = BTreeSet::new();
        for &a in &present {
            let (here, front_m) = *self.ways[&a].last().unwrap();
            for &b in present.iter().filter(|&&b| b != a) {
                let there = self.ways[&b].iter().find(|(place, _)| *place == here);
                if there.is_some_and(|(_, b_m)| (b_m - front_m).abs() < BODY_M - 1e-9) {
                    together.insert((a.min(b), a.max(b)));
                }
            }
        }
        self.samples += together.len() as u64;
        self.changes += self.together.symmetric_difference(&together).count() as u64;
        self.pairs.extend(&together);
        self.together = together;
    }
}

/// Drives at random, a good deal of it slowly and close together.
fn drive(scenario: &Arc<Scenario>, seed: u64) -> (OverlapSummary, Oracle) {
    let mut world = World::new(scenario.clone(), 1);
    let mut oracle = Oracle::default();
    while !world.is_finished() {
        let states: Vec<VehicleState> = world.records().collect();
        oracle.look(scenario, &states);
        let members = states.iter().filter(|s| s.zone != NO_ZONE && s.flags & STATE_LEFT == 0);
        let step = world.step();
        let commands: Vec<VehicleCommand> = members
            .map(|s| {
                let draw =
                    (seed ^ (u64::from(s.vehicle) << 32) ^ (step / 12)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                let draw = (draw ^ (draw >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40;
                let wish = draw as f64 / f64::from(1u32 << 24) * 8.0 - 4.0;
                let u_mps2 = if s.v_mps < 3.0 { wish.abs() } else { wish.min((25.0 - s.v_mps) / DT_S) };
                VehicleCommand {
                    u_mps2: u_mps2.clamp(-4.0, 4.0),
                    vehicle: s.vehicle,
                    zone: s.zone,
                    ..VehicleCommand::default()
                }
            })
            .collect();
        world.command(0, &commands).unwrap();
        world.advance().unwrap();
    }
    (world.summary().overlaps, oracle)
}

fn zone() -> impl Strategy<Value = ([f64; 2], f64)> {
    let length = || prop_oneof![3.0..8.0f64, 10.0..80.0f64];
    (length(), length(), prop_oneof![Just(0.0), 3.0..6.0f64, 20.0..60.0f64])
        .prop_map(|(main, side, link_m)| ([main, side], link_m))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Every sample at which two bodies overlap, found by comparing everybody with everybody along their ways.
    #[test]
    fn overlaps_are_those_that_a_comparison_of_all_pairs_finds(
        zones in prop::collection::vec(zone(), 1..=5), seed in any::<u64>(),
    ) {
        let scenario = corridor(&zones, seed);
        let (seen, oracle) = drive(&scenario, seed);
        prop_assert_eq!(seen.samples, oracle.samples);
        // Between samples there may be more, but not much.
        prop_assert!(seen.pairs >= oracle.pairs.len() as u64);
        let off_s = (seen.time_s - oracle.samples as f64 * DT_S).abs();
        let more = seen.pairs - oracle.pairs.len() as u64;
        prop_assert!(off_s <= (oracle.changes + more + 1) as f64 * DT_S, "{} and {}", seen.time_s, oracle.samples);
        prop_assert!(seen.deepest_m <= BODY_M);
    }
}

/// The property above would hold of a world in which nothing ever overlaps, too.
#[test]
fn the_random_drivers_do_overlap_at_every_kind_of_place() {
    let zones = [
        ([40.0, 30.0], 0.0),
        ([4.0, 5.0], 5.0),
        ([30.0, 60.0], 0.0),
        ([5.0, 3.5], 0.0),
        ([50.0, 50.0], 40.0),
    ];
    let (seen, oracle) = drive(&corridor(&zones, 7), 7);
    assert!(seen.samples > 1000 && oracle.pairs.len() > 50, "{seen:?}");
}
