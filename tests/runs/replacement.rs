//! A coordinator or controller that is killed is replaced, and the result does not change by a bit.

use crate::common::{
    Ended, LONG_RUN, Process, TestRun, children, part, send, ticks, wait_until, wait_until_stepping,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::Signal;
use std::time::Duration;

fn undisturbed() -> String {
    crate::common::hash(&TestRun::new("u").summary(&[&LONG_RUN[..], &["--in-process"]].concat()))
}

/// A supervised run that steps.
fn begin(test_run: &TestRun, arguments: &[&str], processes: usize) -> (Process, Vec<(String, u32)>) {
    let json = ["--json", "-"];
    let (supervisor, parts) =
        crate::common::begin(test_run, &[&LONG_RUN[..], &json, arguments].concat(), processes);
    wait_until_stepping(part(&parts, "world"));
    (supervisor, parts)
}

/// Kills the first process of each kind named after a while, and returns how the run ended.
fn disturb(
    test_run: &TestRun,
    arguments: &[&str],
    processes: usize,
    victims: &[&str],
    after: Duration,
) -> (Ended, usize) {
    let (supervisor, parts) = begin(test_run, arguments, processes);
    std::thread::sleep(after);
    let mut killed = 0;
    for victim in victims {
        let id = part(&parts, victim);
        // The run may be over; then there is nobody to be killed.
        killed += usize::from(crate::common::is_alive(id));
        send_if_alive(id);
    }
    (supervisor.ended(), killed)
}

fn send_if_alive(id: u32) {
    if crate::common::is_alive(id) {
        let _ =
            rustix::process::kill_process(rustix::process::Pid::from_raw(id as i32).unwrap(), Signal::KILL);
    }
}

/// Kills each kind of participant, and both, that many times, at random instants of a run each; prints how
/// long the steps took in which the successors came.
fn matrix(times: usize, shares: &[&str], processes: usize) {
    let expected = undisturbed();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for victims in [&["ctrl"][..], &["coord"], &["ctrl", "coord"]] {
        let (mut replaced, mut step_ms) = (0, Vec::new());
        for _ in 0..times {
            let test_run = TestRun::new("kill");
            let after = Duration::from_millis(rng.random_range(0..150));
            let (ended, killed) = disturb(&test_run, shares, processes, victims, after);
            let summary = ended.json();
            assert_eq!(crate::common::hash(&summary), expected, "{ended:?}");
            let replacements = summary["replacements"].as_array().unwrap();
            assert!(replacements.len() <= killed, "{ended:?}");
            assert!(replacements.iter().all(|r| r["generation"] == 1), "{ended:?}");
            replaced += replacements.len();
            step_ms.extend(replacements.iter().map(|r| r["step_ms"].as_f64().unwrap()));
            test_run.assert_clean();
        }
        // Some may have been killed at the very end.
        assert!(replaced * 2 > times * victims.len(), "only {replaced} replacements of {victims:?}");
        step_ms.sort_by(f64::total_cmp);
        let at = |q: f64| step_ms[((step_ms.len() - 1) as f64 * q) as usize];
        println!(
            "{victims:?} {shares:?}: {times} runs, {replaced} replacements, the same hash; recovery in ms: least {:.1}, \
             median {:.1}, p90 {:.1}, greatest {:.1}",
            at(0.0),
            at(0.5),
            at(0.9),
            at(1.0)
        );
    }
}

#[test]
fn whoever_is_killed_is_replaced_without_a_trace_in_the_result() {
    matrix(3, &[], 3);
    matrix(2, &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
}

#[test]
#[ignore = "takes minutes: the kill matrix of 100 runs each"]
fn kill_matrix() {
    matrix(100, &[], 3);
    matrix(100, &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
}

#[test]
fn a_part_killed_again_and_again_is_replaced_each_time() {
    // Long enough that the run is not over before the fifth has been replaced.
    let longer = [
        "--set",
        "end.time_s=60000",
        "--set",
        "roads.main1.demand.rates=[{until_s=60000.0,vehicles_per_hour=300.0}]",
    ];
    let whole = [&LONG_RUN[..], &longer, &["--in-process"]].concat();
    let (test_run, expected) =
        (TestRun::new("again"), crate::common::hash(&TestRun::new("u").summary(&whole)));
    let (supervisor, _) = begin(&test_run, &longer, 3);
    let mut killed = Vec::new();
    wait_until("five controllers to have been killed", || {
        let parts = children(supervisor.id());
        let controller = parts.iter().find(|(id, line)| {
            line.get(1).is_some_and(|p| p == "ctrl") && !killed.contains(id) && ticks(*id) >= 8
        });
        if let Some((id, _)) = controller {
            send(*id, Signal::KILL);
            killed.push(*id);
        }
        killed.len() == 5
    });
    let summary = supervisor.ended().json();
    assert_eq!(crate::common::hash(&summary), expected);
    assert_eq!(summary["replacements"].as_array().unwrap().len(), 5);
    test_run.assert_clean();
}

/// iceoryx2 waits without end for a file in shared memory that has no length, and whoever comes looks at all that the dead
/// have left.
#[test]
fn who_was_killed_while_it_created_a_file_keeps_nobody_waiting() {
    let test_run = TestRun::new("unfinished");
    let (supervisor, parts) = begin(&test_run, &[], 3);
    crate::common::hold(supervisor.id());
    let controller = part(&parts, "ctrl");
    send(controller, Signal::KILL);
    wait_until("the controller to be dead", || !crate::common::is_alive(controller));
    // One more of each connection there is: from a sender that is in it to nobody, and from nobody to a receiver.
    let connections =
        test_run.files().into_iter().filter(|file| file.extension() == Some("connection".as_ref()));
    let mut unfinished = Vec::new();
    for file in connections {
        let (from, to) = file.file_stem().unwrap().to_str().unwrap().rsplit_once('_').unwrap();
        let (rest, from) = from.rsplit_once('_').unwrap();
        for name in [format!("{rest}_{from}_{}", other(to)), format!("{rest}_{}_{to}", other(from))] {
            let path = file.with_file_name(name).with_extension("connection");
            std::fs::File::create(&path).unwrap();
            unfinished.push(path);
        }
    }
    assert!(unfinished.len() >= 4, "{unfinished:?}");
    supervisor.signal(Signal::CONT);
    let ended = supervisor.ended();
    assert!(!ended.err.contains("took longer than"), "{ended:?}");
    let summary = ended.json();
    assert_eq!(crate::common::hash(&summary), undisturbed());
    assert_eq!(summary["replacements"].as_array().unwrap().len(), 1);
    test_run.assert_clean();
}

/// A number of as many digits.
fn other(number: &str) -> String {
    let (rest, last) = number.split_at(number.len() - 1);
    format!("{rest}{}", (last.parse::<u32>().unwrap() + 1) % 10)
}

#[test]
fn parts_started_by_hand_leave_and_rejoin() {
    let expected = undisturbed();
    let test_run = TestRun::new("rejoin");
    let world = test_run.start("cz-world", &[&LONG_RUN[..], &["--json", "-"]].concat());
    let coordinator = test_run.start("cz-coord", &[]);
    let controller = test_run.start("cz-ctrl", &[]);
    wait_until_stepping(world.id());
    controller.signal(Signal::INT);
    controller.ended().expect(130, &["interrupted at step"]);
    coordinator.signal(Signal::KILL);
    let successors = [test_run.start("cz-coord", &[]), test_run.start("cz-ctrl", &[])];
    let summary = world.ended().json();
    assert_eq!(crate::common::hash(&summary), expected);
    assert_eq!(summary["replacements"].as_array().unwrap().len(), 2);
    successors.into_iter().for_each(|part| part.ended().expect(0, &[]));
    assert!(coordinator.ended().was_killed_by(Signal::KILL));
    test_run.assert_clean();
}

#[test]
fn nobody_joins_a_run_in_which_nobody_is_missing() {
    let test_run = TestRun::new("late");
    let (supervisor, _) = begin(&test_run, &[], 3);
    let late = test_run.start("cz-ctrl", &[]).ended();
    late.expect(1, &["refused", "under way", "nobody is missing"]);
    assert_eq!(supervisor.ended().hash(), undisturbed());
    test_run.assert_clean();
}

#[test]
fn a_world_nobody_comes_back_to_gives_up_and_says_for_whom_it_waited() {
    let test_run = TestRun::new("lost");
    let world = test_run.start("cz-world", &[&LONG_RUN[..], &["--peer-timeout", "1"]].concat());
    let coordinator = test_run.start("cz-coord", &[]);
    let controller = test_run.start("cz-ctrl", &[]);
    wait_until_stepping(world.id());
    let dead = format!("controller 0 (process {}) is gone", controller.id());
    controller.signal(Signal::KILL);
    world.ended().expect(1, &[&dead, "nobody took its place within 1 s", "commands of step"]);
    coordinator.ended().expect(1, &["the world", "gone"]);
    drop(controller);
    test_run.assert_clean();
}
