//! Roles replay from their inputs, and recordings are compared.

use super::*;
use control_zones::record::{ReplayError, Section, compare, replay, replay_world};

#[test]
fn every_role_of_a_run_replays() {
    for (name, sets, coordinators, controllers) in [
        ("two-merges", &["end.vehicles=30"][..], 1, 1),
        ("two-merges", &["end.vehicles=30", "shield=on", "control.fe_conditions=off"], 2, 2),
        ("tree", &["end.time_s=150"], 3, 2),
        ("corridor-8", &["end.time_s=60"], 8, 5),
    ] {
        let run = Run::new(&scenario(name, sets), coordinators, controllers);
        let result = replay(&run.reader(), |_| {});
        assert!(result.same(), "{name}: {result:?}");
        assert_eq!(result.stopped, None);
        assert_eq!(result.state_hash, run.state_hash, "{name}");
        assert_eq!(result.roles.len() as u32, 1 + coordinators + controllers);
        assert_eq!(result.roles[0].steps, run.steps.len() as u64);
        for role in &result.roles {
            // The last step is answered by nobody; coordinators act at events.
            let all = run.steps.len() as u64 - 1;
            let expected = if role.role.starts_with("controller") { all..=all } else { 1..=all + 1 };
            assert!(expected.contains(&role.steps), "{name}: {role:?}");
        }
    }
}

#[test]
fn a_replayed_world_goes_on_as_the_recorded_one_did() {
    let run = small();
    let reader = run.reader();
    let last = run.steps.len() as u64 - 1;
    for until in [0, 1, 57, last] {
        let mut world = replay_world(&reader, until).unwrap();
        assert_eq!(world.step(), until);
        let masks = world.coordinator_masks();
        let next = &run.steps[until as usize];
        assert!(world.records().eq(next.state.iter().copied()));
        assert_eq!(masks.acting, next.header.coordinators_acting);
        world.seal(&next.state);
        assert_eq!(world.state_hash(), next.state_hash);
    }
    let error = replay_world(&reader, last + 1).unwrap_err();
    assert!(matches!(error, ReplayError::TooFar { last: l, .. } if l == last), "{error}");
}

#[test]
fn verify_names_step_vehicle_and_field() {
    let run = small();
    let same = compare(&run.reader(), &run.reader());
    assert!(same.same() && same.steps == run.steps.len() as u64, "{same:?}");
    let at = run.steps.iter().position(|s| s.header.step > 100 && !s.coordination.is_empty()).unwrap();
    let step = run.steps[at].header.step;
    let part = run.steps[at].commands.iter().position(|c| !c.records.is_empty()).unwrap();

    type Change = fn(&mut Step, usize);
    let changes: [(Change, Section, &str); 6] = [
        (|s, _| s.state[0].v_mps += 0.5, Section::State, "v_mps"),
        (|s, _| s.state[0].flags ^= 4, Section::State, "flags"),
        (|s, _| s.coordination[0].partner ^= 1, Section::Coordination, "partner"),
        (|s, p| s.commands[p].records[0].verdict ^= 1, Section::Command, "verdict"),
        (|s, _| s.state_hash ^= 1, Section::Step, "state_hash"),
        (|s, _| s.misses = 2, Section::Step, "misses"),
    ];
    for (change, section, field) in changes {
        let other = run.with(|steps| change(&mut steps[at], part));
        let found = compare(&run.reader(), &other.reader());
        let difference = found.difference.clone().unwrap();
        assert!(!found.same());
        assert_eq!((difference.step, difference.section, difference.field), (step, section, Some(field)));
        let vehicle = match section {
            Section::State => Some(run.steps[at].state[0].vehicle),
            Section::Coordination => Some(run.steps[at].coordination[0].vehicle),
            Section::Command => Some(run.steps[at].commands[part].records[0].vehicle),
            _ => None,
        };
        assert_eq!(difference.vehicle, vehicle, "{difference}");
        assert_eq!(found.steps, step);
    }
    // A vehicle that only one side has.
    let gone = run.steps[at].state.last().unwrap().vehicle;
    let other = run.with(|steps| steps[at].state.truncate(run.steps[at].state.len() - 1));
    let found = compare(&run.reader(), &other.reader()).difference.unwrap();
    assert_eq!((found.step, found.vehicle, found.field), (step, Some(gone), None), "{found}");
    assert_eq!((&found.first[..], &found.second[..]), ("1 record", "no record"));
}

#[test]
fn runs_in_other_numbers_of_processes_are_the_same() {
    let scenario = scenario("tree", &["end.time_s=100"]);
    let (one, many) = (Run::new(&scenario, 1, 1), Run::new(&scenario, 5, 3));
    assert!(many.steps.iter().any(|s| !s.summaries.is_empty()));
    let found = compare(&one.reader(), &many.reader());
    assert!(found.same(), "{found:?}");
    assert_eq!(found.steps, one.steps.len() as u64);
}

#[test]
fn replay_names_the_role_that_did_otherwise() {
    let run = small();
    let busy = |s: &&Step| !s.coordination.is_empty() && s.commands.iter().all(|c| !c.records.is_empty());
    let at = run.steps.iter().filter(busy).nth(3).unwrap().header.step as usize;
    let differing = |run: &Run| {
        let result = replay(&run.reader(), |_| {});
        let names: Vec<_> =
            result.roles.iter().filter(|r| r.difference.is_some()).map(|r| r.role.clone()).collect();
        (names, result)
    };
    // The second controller says it would have braked: it did not, and the world comes out elsewhere.
    let (names, _) = differing(&run.with(|steps| steps[at].commands[1].records[0].u_mps2 -= 1.0));
    assert_eq!(names, ["world", "controller 1"]);
    // What nobody but the controller looks at.
    let (names, result) = differing(&run.with(|steps| steps[at].commands[0].records[0].memory_3 += 1.0));
    assert_eq!(names, ["controller 0"]);
    assert!(result.roles[3].difference.as_ref().unwrap().contains("memory_3"), "{result:?}");
    // A terminal speed the coordinator did not set.
    let zone = run.steps[at].coordination[0].zone;
    let (names, _) = differing(&run.with(|steps| steps[at].coordination[0].flags ^= 1));
    assert_eq!(names[0], format!("coordinator {zone}"));
    // A command the world would have refused.
    let (names, result) = differing(&run.with(|steps| steps[at].commands[0].records[0].vehicle += 50));
    assert_eq!(names, ["world", "controller 0"]);
    assert!(result.roles[0].difference.as_ref().unwrap().contains("does not take"), "{result:?}");
    // A summary one coordinator did not send and the other did not get.
    let told = run.steps.iter().position(|s| !s.summaries.is_empty()).unwrap();
    let (names, _) = differing(&run.with(|steps| steps[told].summaries.clear()));
    assert!(names[0].starts_with("coordinator"), "{names:?}");
    // A controller that did not answer in time is not held to what the world put in its place.
    let late = run.with(|steps| {
        steps[at].misses = 1 << 1;
        steps[at].commands[1].records[0].binding_rows ^= 1;
        steps[at + 1].header.flags |= ipc_schemas::FLAG_MISSED;
    });
    let (names, result) = differing(&late);
    assert_eq!(names, Vec::<String>::new());
    assert_eq!(result.roles[4].inputs_only.map(|(steps, _)| steps), Some(1));
}

#[test]
fn states_no_world_sends_end_a_replay_and_nothing_worse() {
    let run = small();
    let changes: [fn(&mut Step); 6] = [
        |s| s.state[0].entry_speed_mps = 1e300,
        |s| s.state[0].x_m = f64::NAN,
        |s| s.state[0].path = 9,
        |s| s.state[0].zone = 77,
        |s| s.state.reverse(),
        |s| s.header.time_ns = u64::MAX,
    ];
    let busy = |s: &&Step| s.state.len() > 2 && s.state[0].zone != s.state.last().unwrap().zone;
    let at = run.steps.iter().find(busy).unwrap().header.step as usize;
    for (i, change) in changes.into_iter().enumerate() {
        let result = replay(&run.with(|steps| change(&mut steps[at])).reader(), |_| {});
        // No role goes on from there.
        assert!(result.roles.iter().all(|r| r.difference.is_some()), "change {i}: {result:?}");
        assert_eq!(result.roles[0].steps, at as u64, "change {i}");
    }
}
