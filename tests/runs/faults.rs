//! Whatever ends a run early: it ends within seconds, says why, and leaves nothing behind.

use crate::common::{
    ENDLESS, Process, TestRun, children, is_alive, send, ticks, wait_until, wait_until_stepping, wait_within,
};
use rustix::process::Signal;
use std::time::Duration;

/// "Within seconds".
const SOON: Duration = Duration::from_secs(5);
/// For what the processes do by themselves once a peer is gone; the machine may be busy with other tests.
const BY_THEMSELVES: Duration = Duration::from_secs(10);

/// A `cz run` in the middle of things.
struct Supervised {
    supervisor: Process,
    /// Subcommand and process id of each child.
    parts: Vec<(String, u32)>,
}

impl Supervised {
    fn start(test_run: &TestRun, arguments: &[&str], processes: usize) -> Supervised {
        let (supervisor, parts) = crate::common::begin(test_run, &[&ENDLESS, arguments].concat(), processes);
        let run = Supervised { supervisor, parts };
        wait_until_stepping(run.part("world"));
        run
    }

    fn part(&self, name: &str) -> u32 {
        crate::common::part(&self.parts, name)
    }

    fn wait_until_parts_have_ended(&self, limit: Duration) {
        for (part, id) in &self.parts {
            wait_within(limit, &format!("the {part} process to end"), || !is_alive(*id));
        }
    }
}

#[test]
fn an_interrupted_supervisor_ends_the_run() {
    for (signal, name) in [(Signal::INT, "SIGINT"), (Signal::TERM, "SIGTERM")] {
        let test_run = TestRun::new("int");
        let run = Supervised::start(&test_run, &[], 3);
        let parts = run.parts.clone();
        run.supervisor.signal(signal);
        run.supervisor.ended_within(SOON).expect(130, &["cz: interrupted by ", name]);
        // It has waited for all of them.
        assert!(parts.iter().all(|(_, id)| !is_alive(*id)));
        test_run.assert_clean();
    }
}

#[test]
fn a_killed_part_ends_a_supervised_run() {
    for (part, name) in [("world", "world"), ("coord", "coordinator 0"), ("ctrl", "controller 0")] {
        let test_run = TestRun::new("kill");
        let run = Supervised::start(&test_run, &[], 3);
        let victim = run.part(part);
        send(victim, Signal::KILL);
        let parts = run.parts.clone();
        let ended = run.supervisor.ended_within(SOON);
        ended.expect(1, &["cz: ", &format!("{name} (process {victim}) was killed by signal 9 (SIGKILL)")]);
        assert!(parts.iter().all(|(_, id)| !is_alive(*id)));
        test_run.assert_clean();
    }
}

#[test]
fn a_killed_part_of_many_is_named() {
    let test_run = TestRun::new("many");
    let run = Supervised::start(&test_run, &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
    let parts = children(run.supervisor.id());
    let second =
        |(_, line): &&(u32, Vec<String>)| line[1] == "ctrl" && line.windows(2).any(|w| w == ["--index", "1"]);
    let victim = parts.iter().find(second).expect("there is a second controller").0;
    send(victim, Signal::KILL);
    let ended = run.supervisor.ended_within(SOON);
    ended.expect(1, &[&format!("controller 1 (process {victim}) was killed by signal 9 (SIGKILL)")]);
    test_run.assert_clean();
}

#[test]
fn a_terminated_part_ends_a_supervised_run() {
    let test_run = TestRun::new("term");
    let run = Supervised::start(&test_run, &[], 3);
    let victim = run.part("ctrl");
    send(victim, Signal::TERM);
    let ended = run.supervisor.ended_within(SOON);
    ended.expect(1, &[&format!("controller 0 (process {victim}) ended with code 130: interrupted")]);
    test_run.assert_clean();
}

#[test]
fn a_killed_supervisor_takes_its_children_with_it() {
    let test_run = TestRun::new("orphan");
    let run = Supervised::start(&test_run, &[], 3);
    run.supervisor.signal(Signal::KILL);
    run.wait_until_parts_have_ended(SOON);
    assert!(run.supervisor.ended().was_killed_by(Signal::KILL));
    test_run.assert_clean();
}

#[test]
fn the_next_start_clears_up_after_a_massacre() {
    let test_run = TestRun::new("all");
    let run = Supervised::start(&test_run, &[], 3);
    // Stopped first, so that none of them notices the death of another.
    run.supervisor.signal(Signal::STOP);
    run.parts.iter().for_each(|(_, id)| send(*id, Signal::STOP));
    run.parts.iter().for_each(|(_, id)| send(*id, Signal::KILL));
    run.supervisor.signal(Signal::KILL);
    run.wait_until_parts_have_ended(SOON);
    assert!(run.supervisor.ended().was_killed_by(Signal::KILL));
    assert_ne!(test_run.files(), Vec::<std::path::PathBuf>::new(), "killed processes leave files");
    let again = ["two-merges", "--run", test_run.name()];
    let elsewhere = TestRun::new("e").summary(&["--in-process"]);
    let mut command = test_run.command("cz");
    let output = command.args(["run", "--json", "-"]).args(again).output().unwrap();
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(summary["state_hash"], elsewhere["state_hash"]);
    test_run.assert_clean();
}

#[test]
fn a_world_that_waits_can_be_interrupted() {
    for (signal, program) in [(Signal::INT, "cz-world"), (Signal::TERM, "cz-ctrl"), (Signal::INT, "cz-coord")]
    {
        let test_run = TestRun::new("wait");
        let part = test_run.start(program, &[]);
        test_run.wait_until_settled();
        part.signal(signal);
        part.ended_within(SOON).expect(130, &[&format!("{program}: interrupted")]);
        test_run.assert_clean();
    }
}

/// The parts of a run started by hand, in the middle of things.
fn by_hand(test_run: &TestRun) -> [Process; 3] {
    let world = test_run.start("cz-world", &ENDLESS);
    let parts = [test_run.start("cz-coord", &[]), test_run.start("cz-ctrl", &[])];
    wait_until_stepping(world.id());
    let [coordinator, controller] = parts;
    [world, coordinator, controller]
}

#[test]
fn a_killed_part_ends_a_run_started_by_hand() {
    let names = ["the world", "coordinator 0", "controller 0"];
    for victim in 0..3 {
        let test_run = TestRun::new("hand");
        let parts = by_hand(&test_run);
        let id = parts[victim].id();
        let dead = format!("{} (process {id})", names[victim]);
        let world = format!("the world (process {})", parts[0].id());
        parts[victim].signal(Signal::KILL);
        for (i, part) in parts.into_iter().enumerate() {
            let ended = part.ended_within(BY_THEMSELVES);
            if i == victim {
                assert!(ended.was_killed_by(Signal::KILL), "{ended:?}");
            } else if i == 0 {
                // The world knows everybody.
                ended.expect(1, &["cz-world: ", &dead, "gone"]);
            } else {
                // The others know only the world, which has gone after saying why.
                ended.expect(1, &[&world, "gone"]);
            }
        }
        test_run.assert_clean();
    }
}

#[test]
fn an_interrupted_part_ends_a_run_started_by_hand() {
    let test_run = TestRun::new("handint");
    let [world, coordinator, controller] = by_hand(&test_run);
    world.signal(Signal::INT);
    world.ended_within(BY_THEMSELVES).expect(130, &["cz-world: interrupted at step "]);
    coordinator.ended_within(BY_THEMSELVES).expect(1, &["the world", "gone"]);
    controller.ended_within(BY_THEMSELVES).expect(1, &["the world", "gone"]);
    test_run.assert_clean();
}

#[test]
fn a_part_that_stops_answering_is_given_up() {
    let test_run = TestRun::new("stuck");
    let mut arguments = ENDLESS;
    arguments[10] = "1"; // --peer-timeout
    let world = test_run.start("cz-world", &arguments);
    let (coordinator, controller) = (test_run.start("cz-coord", &[]), test_run.start("cz-ctrl", &[]));
    wait_until_stepping(world.id());
    controller.signal(Signal::STOP);
    world.ended_within(BY_THEMSELVES).expect(1, &["waited 1 s for commands of step ", "controller 0"]);
    coordinator.ended_within(BY_THEMSELVES).expect(1, &["the world", "gone"]);
    controller.signal(Signal::CONT);
    controller.ended_within(BY_THEMSELVES).expect(1, &["the world", "gone"]);
    test_run.assert_clean();
}

#[test]
fn a_run_that_was_stopped_as_a_whole_goes_on() {
    let test_run = TestRun::new("slept");
    // Stopped for three times as long as anybody waits for a frame.
    let mut arguments = ENDLESS;
    arguments[10] = "1"; // --peer-timeout
    let (supervisor, parts) = crate::common::begin(&test_run, &arguments, 3);
    let world = crate::common::part(&parts, "world");
    wait_until_stepping(world);
    for _ in 0..3 {
        let all = || parts.iter().map(|(_, id)| *id).chain([supervisor.id()]);
        all().for_each(|id| send(id, Signal::STOP));
        std::thread::sleep(Duration::from_secs(3));
        all().for_each(|id| send(id, Signal::CONT));
        let before = ticks(world);
        wait_until("the world to step again", || ticks(world) >= before + 5);
    }
    supervisor.signal(Signal::INT);
    supervisor.ended().expect(130, &["interrupted by SIGINT"]);
    test_run.assert_clean();
}

#[test]
fn nobody_is_started_again_and_again_for_a_world_that_is_stopped() {
    let test_run = TestRun::new("stopped");
    let mut arguments = ENDLESS;
    arguments[10] = "1"; // --peer-timeout
    arguments[12] = "on-failure"; // --restart
    let (supervisor, parts) = crate::common::begin(&test_run, &arguments, 3);
    let world = crate::common::part(&parts, "world");
    wait_until_stepping(world);
    send(world, Signal::STOP);
    let ended = supervisor.ended();
    ended.expect(
        1,
        &[&format!("the world (process {world}) is stopped and has made no step for "), "controller 0"],
    );
    assert!(!ended.err.contains("started again"), "{ended:?}");
    assert!(!is_alive(world));
    test_run.assert_clean();
}

#[test]
fn files_cut_short_in_the_middle_of_a_run_hang_nobody() {
    let test_run = TestRun::new("cut");
    let mut arguments = ENDLESS;
    arguments[10] = "2"; // --peer-timeout
    arguments[12] = "on-failure"; // --restart
    let (supervisor, parts) = crate::common::begin(&test_run, &arguments, 3);
    wait_until_stepping(crate::common::part(&parts, "world"));
    // Whatever there is, the marker of the run included.
    for file in test_run.files().into_iter().filter(|path| path.is_file()) {
        let _ = std::fs::OpenOptions::new().write(true).open(file).and_then(|file| file.set_len(0));
    }
    let ended = supervisor.ended();
    ended.expect(1, &["world (process "]);
    assert!(parts.iter().all(|(_, id)| !is_alive(*id)));
    test_run.assert_clean();
}

#[test]
fn a_failed_run_says_how_it_goes_on_from_its_recording() {
    let test_run = TestRun::new("hint");
    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("r.czlog").display().to_string();
    let (supervisor, parts) =
        crate::common::begin(&test_run, &[&ENDLESS[..], &["--record", &recording]].concat(), 3);
    let has_steps = || std::fs::metadata(&recording).is_ok_and(|file| file.len() > 100_000);
    wait_until("steps to be recorded", has_steps);
    send(crate::common::part(&parts, "world"), Signal::KILL);
    supervisor.ended().expect(1, &["was killed by signal 9", &format!("`cz resume {recording}` goes on")]);
    test_run.assert_clean();
}

#[test]
fn what_a_process_may_not_have_is_said() {
    let limited = |limit: &str| {
        let test_run = TestRun::new("limit");
        let command =
            format!("ulimit {limit}; exec {} run --run {}", env!("CARGO_BIN_EXE_cz"), test_run.name());
        let output = test_run.command("sh").args(["-c", &command]).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!said.contains("panicked") && output.status.code() == Some(1), "{limit}: {output:?}");
        test_run.assert_clean();
        said
    };
    let said = limited("-n 24");
    assert!(said.contains("only 24 files may be open, see `ulimit -n`"), "{said}");
    let said = limited("-v 30000");
    assert!(said.contains("30000 kB of memory only, see `ulimit -v`"), "{said}");
    let folder = tempfile::tempdir().unwrap();
    let deep = folder.path().join("d".repeat(130));
    std::fs::create_dir(&deep).unwrap();
    let output =
        TestRun::new("deep").command("cz").arg("run").env("XDG_RUNTIME_DIR", &deep).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.code() == Some(1) && said.contains("set XDG_RUNTIME_DIR to a shorter one"),
        "{said}"
    );
    assert!(!said.contains("panicked"), "{said}");
}
