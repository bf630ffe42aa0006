//! The parts of a run started by hand: in any order, side by side, and turned away where they do not fit.

use crate::common::{Ended, TestRun, files, unique_name, wait_until};
use control_zones::scenario::{decode, load_embedded, scenario_hash};
use control_zones::transport::iox::{AttachLine, RunName, RunSpace, SpaceError};
use ipc_schemas::{
    ANY_INDEX, ANY_SCENARIO, ATTACH_BAD_ROLE, ATTACH_JOIN, ATTACH_OTHER_SCENARIO, ATTACH_OTHER_SCHEMA,
    AttachReply, AttachRequest, Role, schema_hash,
};
use rustix::process::Signal;
use std::time::Duration;

const WORLD: (&str, &[&str]) = ("cz-world", &["--json", "-"]);
const COORDINATOR: (&str, &[&str]) = ("cz-coord", &[]);
const CONTROLLER: (&str, &[&str]) = ("cz-ctrl", &[]);

/// The state hash of the default scenario, as `cz run` gives it.
fn expected() -> String {
    crate::common::hash(&TestRun::new("e").summary(&["--in-process"]))
}

/// Starts the parts in that order, with pauses, and returns how they ended.
fn start(test_run: &TestRun, run: &str, parts: &[(&str, &[&str])]) -> Vec<Ended> {
    let mut started = Vec::new();
    for (program, arguments) in parts {
        started.push(test_run.start_in(program, run, arguments));
        // Long enough for the part to be waiting for the others; the result must not depend on it.
        std::thread::sleep(Duration::from_millis(80));
    }
    started.into_iter().map(|part| part.ended()).collect()
}

/// The hash the world printed, after all parts have ended well.
fn hash(parts: &[Ended]) -> String {
    for part in parts {
        part.expect(0, &[]);
    }
    parts.iter().find(|p| p.what.starts_with("cz-world")).expect("there is a world").hash()
}

#[test]
fn every_order_gives_the_same_hash() {
    let expected = expected();
    for order in [
        [WORLD, COORDINATOR, CONTROLLER],
        [WORLD, CONTROLLER, COORDINATOR],
        [COORDINATOR, WORLD, CONTROLLER],
        [COORDINATOR, CONTROLLER, WORLD],
        [CONTROLLER, WORLD, COORDINATOR],
        [CONTROLLER, COORDINATOR, WORLD],
    ] {
        let test_run = TestRun::new("order");
        let ended = start(&test_run, test_run.name(), &order);
        assert_eq!(hash(&ended), expected, "{:?}", order.map(|(program, _)| program));
        test_run.assert_clean();
    }
}

#[test]
fn a_name_can_be_used_again() {
    let (test_run, expected) = (TestRun::new("again"), expected());
    for _ in 0..3 {
        assert_eq!(hash(&start(&test_run, test_run.name(), &[COORDINATOR, WORLD, CONTROLLER])), expected);
        test_run.assert_clean();
    }
}

#[test]
fn runs_of_different_names_do_not_see_each_other() {
    let test_run = TestRun::new("a");
    // One name begins with the other: a prefix of file names must not match both.
    let second = format!("{}-b", test_run.name());
    let parts = |run| {
        [COORDINATOR, CONTROLLER, WORLD]
            .map(|(program, arguments)| test_run.start_in(program, run, arguments))
    };
    let (one, other) = (parts(test_run.name()), parts(&second));
    let expected = expected();
    for run in [one, other] {
        assert_eq!(hash(&run.map(|part| part.ended())), expected);
    }
    assert_eq!(files(None, &second), Vec::<std::path::PathBuf>::new());
    test_run.assert_clean();
}

#[test]
fn a_second_world_of_an_active_run_is_refused() {
    let test_run = TestRun::new("twice");
    let world = test_run.start("cz-world", WORLD.1);
    test_run.wait_until_settled();
    test_run.start("cz-world", &[]).ended().expect(2, &["cz-world: ", test_run.name(), "active", "--run"]);
    // And so is a whole run: its participants would take the places of this one's.
    test_run.start("cz", &[]).ended().expect(2, &["cz: ", test_run.name(), "active", "--run"]);
    // The first one is none the worse for it.
    let mut parts = start(&test_run, test_run.name(), &[COORDINATOR, CONTROLLER]);
    parts.push(world.ended());
    assert_eq!(hash(&parts), expected());
    test_run.assert_clean();
}

#[test]
fn a_participant_without_a_world_says_so() {
    let test_run = TestRun::new("noworld");
    for program in ["cz-ctrl", "cz-coord"] {
        let ended = test_run.start(program, &["--attach-timeout", "1"]).ended();
        ended.expect(1, &[&format!("{program}: "), "1 s", &format!("cz-world --run {}", test_run.name())]);
        test_run.assert_clean();
    }
}

#[test]
fn a_world_without_participants_says_whom_it_misses() {
    let test_run = TestRun::new("nobody");
    let world = test_run.start("cz-world", &["--attach-timeout", "1"]);
    world.ended().expect(1, &["1 s", "coordinator 0", &format!("cz-coord --run {}", test_run.name())]);
    test_run.assert_clean();

    let coordinator = test_run.start("cz-coord", &[]);
    let world = test_run.start("cz-world", &["--attach-timeout", "1"]);
    world.ended().expect(1, &["1 s", "controller 0", &format!("cz-ctrl --run {}", test_run.name())]);
    // The coordinator had been let in and lost its world.
    coordinator.ended().expect(1, &["the world"]);
    test_run.assert_clean();
}

#[test]
fn a_participant_with_another_scenario_is_refused_with_both_hashes() {
    let test_run = TestRun::new("scenario");
    let world = test_run.start("cz-world", WORLD.1);
    let hash_of = |name, seed| format!("{:016x}", scenario_hash(&load_embedded(name, &[], seed).unwrap()));
    let ours = hash_of("two-merges", None);
    test_run.start("cz-ctrl", &["tree"]).ended().expect(1, &["refused", &hash_of("tree", None), &ours]);
    let seed_2 = hash_of("two-merges", Some(2));
    test_run.start("cz-coord", &["--seed", "2"]).ended().expect(1, &["refused", &seed_2, &ours]);
    // The same scenario said again is welcome.
    let mut parts =
        start(&test_run, test_run.name(), &[("cz-coord", &["two-merges"]), ("cz-ctrl", &["--seed", "1"])]);
    parts.push(world.ended());
    assert_eq!(hash(&parts), expected());
    test_run.assert_clean();
}

#[test]
fn an_index_that_is_taken_or_beyond_is_refused() {
    let test_run = TestRun::new("index");
    let world = test_run.start("cz-world", &["--json", "-", "--ctrl-procs", "2"]);
    test_run.start("cz-ctrl", &["--index", "2"]).ended().expect(1, &["refused", "index 2", "beyond"]);
    // Of two that want the same place one gets it, whichever comes first.
    let mut rivals = ["0", "0"].map(|index| Some(test_run.start("cz-ctrl", &["--index", index])));
    let mut refused = None;
    wait_until("one of two rivals to be refused", || {
        refused = rivals.iter().position(|r| r.as_ref().is_some_and(|r| !crate::common::is_alive(r.id())));
        refused.is_some()
    });
    let loser = rivals[refused.expect("the wait ended with one")].take().expect("it is taken once");
    loser.ended().expect(1, &["refused", "index 0", "taken"]);
    let mut parts = start(&test_run, test_run.name(), &[("cz-ctrl", &["--index", "1"]), COORDINATOR]);
    parts.push(world.ended());
    parts.extend(rivals.into_iter().flatten().map(|rival| rival.ended()));
    assert_eq!(hash(&parts), expected());
    test_run.assert_clean();
}

#[test]
fn when_all_places_are_taken_the_next_is_refused() {
    let test_run = TestRun::new("full");
    let world = test_run.start("cz-world", &[]);
    let mut pair = [0, 1].map(|_| Some(test_run.start("cz-ctrl", &[])));
    let mut refused = None;
    wait_until("one of two controllers to be refused", || {
        refused = pair.iter().position(|r| r.as_ref().is_some_and(|r| !crate::common::is_alive(r.id())));
        refused.is_some()
    });
    let loser = pair[refused.expect("the wait ended with one")].take().expect("it is taken once");
    loser.ended().expect(1, &["refused", "all places are taken", "1 controller"]);
    // A place whose owner died before the run began is free again.
    let first = pair.into_iter().flatten().next().expect("the other one is waiting");
    first.signal(Signal::TERM);
    first.ended().expect(130, &["interrupted"]);
    world.signal(Signal::INT);
    world.ended().expect(130, &["interrupted"]);
    test_run.assert_clean();
}

/// What the world answers to a request nobody of this build would send.
fn answer(line: &AttachLine, request: AttachRequest) -> AttachReply {
    line.request(request).unwrap();
    let mut answer = None;
    wait_until("the world to answer", || {
        while let Some(reply) = line.next_reply().unwrap() {
            if reply.reply().instance == request.instance {
                // The scenario is for those who are let in; others are told why they are not.
                assert!(decode(reply.scenario()).is_err(), "a refused participant got the scenario");
                answer = Some(*reply.reply());
            }
        }
        answer.is_some()
    });
    answer.expect("the wait ended with an answer")
}

#[test]
fn a_participant_of_another_build_is_refused_with_both_hashes() {
    // This process takes part itself, so the run is in its own runtime directory.
    let (test_run, name) = (TestRun::new("unused"), unique_name("schema"));
    let mut command = test_run.command("cz-world");
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(runtime) => command.env("XDG_RUNTIME_DIR", runtime),
        None => command.env_remove("XDG_RUNTIME_DIR"),
    };
    let mut world = command.args(["--run", &name]).spawn().unwrap();
    let run: RunName = name.parse().unwrap();
    {
        let space = RunSpace::enter(&run).unwrap();
        let mut line = None;
        wait_until("the world's attach services", || {
            line = match space.open_attach_line() {
                Ok(line) => Some(line),
                Err(SpaceError::NoService { .. }) => None,
                Err(error) => panic!("{error}"),
            };
            line.is_some()
        });
        let line = line.expect("the wait ended with a line");
        let ours = scenario_hash(&load_embedded("two-merges", &[], None).unwrap());
        let request = AttachRequest {
            instance: 1,
            controller: ipc_schemas::BUILT_IN,
            schema_hash: schema_hash() ^ 1,
            scenario_hash: ANY_SCENARIO,
            process_id: std::process::id(),
            role: Role::Controller as u16,
            wanted_index: ANY_INDEX,
            phase: ATTACH_JOIN,
            index: 0,
        };
        let reply = answer(&line, request);
        assert_eq!(reply.status, ATTACH_OTHER_SCHEMA);
        assert_eq!((reply.schema_hash, reply.scenario_hash), (schema_hash(), ours));
        assert_eq!(reply.world_process_id, world.id());
        let known = AttachRequest { schema_hash: schema_hash(), ..request };
        let reply = answer(&line, AttachRequest { instance: 2, scenario_hash: 7, ..known });
        assert_eq!((reply.status, reply.scenario_hash), (ATTACH_OTHER_SCENARIO, ours));
        let reply = answer(&line, AttachRequest { instance: 3, role: Role::World as u16, ..known });
        assert_eq!(reply.status, ATTACH_BAD_ROLE);
    }
    crate::common::send(world.id(), Signal::TERM);
    assert_eq!(world.wait().unwrap().code(), Some(130));
    assert!(RunSpace::sweep(&run).unwrap(), "somebody is still in the run");
    assert_eq!(files(None, &name), Vec::<std::path::PathBuf>::new());
}

#[test]
fn a_killed_world_can_be_started_again_while_somebody_waits_to_join() {
    let test_run = TestRun::new("second");
    // One joins, and waits for the coordinator; the other finds no place and goes; then the world is killed.
    let world = test_run.start("cz-world", &["--ctrl-procs", "2", "--json", "-"]);
    test_run.wait_until_settled();
    // It cannot be answered while the world is stopped, so it waits to join when the world dies.
    world.signal(Signal::STOP);
    let waiting = test_run.start("cz-ctrl", &[]);
    std::thread::sleep(Duration::from_millis(500));
    world.signal(Signal::KILL);
    assert!(world.ended().was_killed_by(Signal::KILL));
    let mut parts = start(&test_run, test_run.name(), &[("cz-world", &["--json", "-"]), COORDINATOR]);
    parts.push(waiting.ended());
    assert_eq!(hash(&parts), expected());
    test_run.assert_clean();
}

#[test]
fn the_last_part_may_come_as_late_as_the_world_waits_for_it() {
    let test_run = TestRun::new("last");
    // A part that is ready waits for the others longer than for a frame.
    let world = test_run.start("cz-world", &["--json", "-", "--peer-timeout", "1"]);
    let controller = test_run.start("cz-ctrl", &["--peer-timeout", "1"]);
    std::thread::sleep(Duration::from_secs(3));
    let mut parts = start(&test_run, test_run.name(), &[COORDINATOR]);
    parts.extend([world.ended(), controller.ended()]);
    assert_eq!(hash(&parts), expected());
    test_run.assert_clean();
}

#[test]
fn a_name_that_looks_like_an_option_is_refused() {
    let test_run = TestRun::new("dash");
    for program in ["cz", "cz-world", "cz-ctrl"] {
        let mut command = test_run.command(program);
        if program == "cz" {
            command.arg("run");
        }
        let output = command.arg("--run=-x").output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains("not beginning with '-'"), "{said}");
    }
    test_run.assert_clean();
}
