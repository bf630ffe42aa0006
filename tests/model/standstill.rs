//! Runs that get nowhere, and what is said of them.

use control_zones::scenario::{Override, Scenario, load, load_given};
use control_zones::world::{World, WorldSummary};
use ipc_schemas::{NO_ZONE, STATE_LEFT, VehicleCommand, VehicleState};
use std::sync::Arc;

/// Drives every vehicle by a rule, to the end of the run.
fn drive(scenario: Arc<Scenario>, rule: impl Fn(u64, &VehicleState) -> f64) -> WorldSummary {
    let mut world = World::new(scenario, 1);
    while !world.is_finished() {
        let step = world.step();
        let members = world.records().filter(|s| s.zone != NO_ZONE && s.flags & STATE_LEFT == 0);
        let command = |s: VehicleState| VehicleCommand {
            u_mps2: rule(step, &s),
            vehicle: s.vehicle,
            zone: s.zone,
            ..VehicleCommand::default()
        };
        let commands: Vec<VehicleCommand> = members.map(command).collect();
        world.command(0, &commands).unwrap();
        world.advance().unwrap();
    }
    world.summary()
}

fn paper(sets: &[&str]) -> Arc<Scenario> {
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some("paper"), &sets, None).unwrap())
}

/// Both zones come to a stop and stay so; it used to be two hours of simulated time and not a word.
#[test]
fn a_gridlock_under_the_shield_names_the_zones_and_since_when() {
    let summary = drive(paper(&["shield=on", "end.time_s=600"]), |_, _| f64::NAN);
    let stall = summary.stalled.iter().find(|s| s.zone == "merge-1").expect("merge-1 stands");
    assert!(stall.vehicles > 0 && stall.since_s < 60.0, "{stall:?}");
    assert_eq!(stall.since_s, stall.since_step as f64 * 0.1);
    // Nobody is said to stand who moves, or has left.
    let fluent = drive(paper(&["shield=on", "end.vehicles=20"]), |_, _| 2.0);
    assert_eq!((fluent.stalled, fluent.departed), (vec![], 20));
    // A minute is what it takes.
    let early = drive(paper(&["shield=on", "end.time_s=70"]), |_, _| f64::NAN);
    assert_eq!(early.stalled, vec![]);
}

/// Commands that are no number, or beyond the limits, and then bounded by a margin as well: each is one.
#[test]
fn a_command_that_is_changed_for_two_reasons_is_one_command() {
    for u in [f64::NAN, 1e9] {
        let summary = drive(paper(&["shield=on", "end.time_s=200"]), |_, _| u);
        let row = &summary.shield.controllers[0];
        let reasons = row.not_finite + row.limits + row.speed + row.rear_end + row.merge;
        assert_eq!(row.bounded, row.commands, "every one was changed");
        assert!(u.is_nan() || reasons > row.commands, "{reasons} reasons for {} commands", row.commands);
    }
    // Where nothing is beyond the limits, a command has one reason at most.
    let summary = drive(paper(&["shield=on", "end.time_s=200"]), |_, _| 4.0);
    let row = &summary.shield.controllers[0];
    assert_eq!(row.bounded, row.speed + row.rear_end + row.merge);
}

/// It used to go back to the speed it had entered the link with: one that crept crept to the link's end.
#[test]
fn a_vehicle_that_creeps_onto_a_link_goes_over_to_the_links_speed() {
    let text = "name = \"n\"\nobjective = { beta = 1 }\nend = { vehicles = 5, time_s = 2000 }\n\
        [[zones]]\nname = \"a\"\n[[zones.approaches]]\nname = \"a\"\nlength_m = 4\nroad = \"r\"\n\
        [[zones]]\nname = \"b\"\n[[zones.approaches]]\nname = \"b\"\nlength_m = 100\nzone = \"a\"\n\
        link_m = 100\nlink_speed_mps = 12\n\
        [[roads]]\nname = \"r\"\n[roads.demand]\nrates = [{ until_s = 2000, vehicles_per_hour = 60 }]\n\
        min_headway_s = 30\nspeed_mean_mps = 0.1\nspeed_sd_mps = 0\nspeed_min_mps = 0.1\nspeed_max_mps = 0.1\n";
    let load = |text: &str| load_given(text, Vec::new(), &[], Some(1)).map(Arc::new);
    let mut last = None;
    let mut world = World::new(load(text).unwrap(), 1);
    while !world.is_finished() {
        let states: Vec<VehicleState> = world.records().collect();
        let arrived = states.iter().find(|s| s.zone == 1 && s.flags & STATE_LEFT == 0);
        last = arrived.copied().or(last);
        let members = states.iter().filter(|s| s.zone != NO_ZONE && s.flags & STATE_LEFT == 0);
        let creep = |s: &VehicleState| VehicleCommand {
            vehicle: s.vehicle,
            zone: s.zone,
            ..VehicleCommand::default()
        };
        let commands: Vec<VehicleCommand> = members.map(creep).collect();
        world.command(0, &commands).unwrap();
        world.advance().unwrap();
    }
    assert_eq!(world.departed(), 5);
    let entered_at = last.unwrap().entry_speed_mps;
    assert!((11.5..=12.0).contains(&entered_at), "{entered_at} m/s");
    // A speed that vehicles cannot drive is refused, and one for a road's vehicles means nothing.
    let bad = load(&text.replace("link_speed_mps = 12", "link_speed_mps = 40")).unwrap_err().to_string();
    assert!(bad.contains("link_speed_mps = 40: expected a speed") && bad.contains("v_max_mps = 30"), "{bad}");
    let road = text.replace("road = \"r\"\n[[zones]]", "road = \"r\"\nlink_speed_mps = 9\n[[zones]]");
    let bad = load(&road).unwrap_err().to_string();
    assert!(bad.contains("link_speed_mps = 9: the source is a road"), "{bad}");
}
