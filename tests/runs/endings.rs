//! How the processes of a run end, and what they say, has no say in its results: these come first.

use crate::common::{
    ENDLESS, Process, TestRun, children, example, is_alive, send, wait_until, wait_until_stepping,
};
use rustix::process::Signal;
use std::process::Stdio;
use std::time::Duration;

/// A run of 300 steps with a controller of another's, which is started so.
fn arguments(command: &str) -> Vec<String> {
    let mut arguments: Vec<_> =
        ["two-merges", "--set", "end.time_s=30", "--json", "-"].map(str::to_owned).into();
    arguments.extend(["--controller".to_owned(), format!("merge-2={command}")]);
    arguments
}

fn start(test_run: &TestRun, command: &str, more: &[&str]) -> Process {
    let arguments = arguments(command);
    test_run.start("cz", &[&arguments.iter().map(String::as_str).collect::<Vec<_>>(), more].concat())
}

/// Every process below a supervisor.
fn descendants(of: u32) -> Vec<u32> {
    children(of).into_iter().flat_map(|(id, _)| [vec![id], descendants(id)].concat()).collect()
}

#[test]
fn results_are_printed_before_whoever_lingers_is_ended() {
    let cruise = example("cruise");
    for (tag, command) in [
        ("stays", format!("{cruise}; sleep 1000")),
        ("helper", format!("sleep 1000 & {cruise}")),
        ("deaf", format!("trap '' TERM; setsid sleep 1000 & {cruise}; sleep 1000")),
    ] {
        let test_run = TestRun::new(tag);
        // Longer than any test: only the signal below ends whoever lingers.
        let run = start(&test_run, &command, &["--peer-timeout", "600"]);
        wait_until("the results", || run.said_so_far().0.contains("state_hash"));
        let left = descendants(run.id());
        assert!(!left.is_empty() && is_alive(run.id()), "{command}: nobody lingers");
        run.signal(Signal::TERM);
        let ended = run.ended();
        ended.json();
        ended.expect(0, &["controller merge-2 (process ", "was still there when the run was over; it was "]);
        assert!(left.iter().all(|id| !is_alive(*id)), "{command}: {left:?}");
        test_run.assert_clean();
    }
}

#[test]
fn whoever_lingers_is_ended_by_itself() {
    let test_run = TestRun::new("lingers");
    let ended =
        start(&test_run, &format!("{}; sleep 1000", example("cruise")), &["--peer-timeout", "1"]).ended();
    ended.json();
    ended.expect(0, &["was still there when the run was over; it was ended after 1."]);
    test_run.assert_clean();
}

#[test]
fn a_plug_in_that_fails_after_the_run_takes_nothing_with_it() {
    let test_run = TestRun::new("seven");
    let ended = start(&test_run, &format!("{}; exit 7", example("cruise")), &[]).ended();
    ended.json();
    ended.expect(0, &["controller merge-2 (process ", ") ended with code 7; the run was complete"]);
    test_run.assert_clean();
}

#[test]
fn a_plug_in_that_leaves_in_the_middle_is_called_that() {
    let test_run = TestRun::new("leaves");
    let command = format!("{} & sleep 0.3; kill $!; exit 0", example("cruise"));
    let ended = start(&test_run, &command, &["--pace", "realtime"]).ended();
    ended.expect(1, &["controller merge-2 (process ", ") left with code 0 in the middle of the run"]);
    test_run.assert_clean();
}

#[test]
fn whatever_a_plug_in_says_the_run_goes_on() {
    let cruise = example("cruise");
    for (tag, says) in [
        ("bytes", "printf 'a\\377b\\n' >&2; printf 'c\\300\\n'"),
        ("long", "head -c 20000000 /dev/zero | tr '\\0' x >&2; head -c 20000000 /dev/zero"),
        ("flood", "(yes flood | head -c 1000000) >&2"),
    ] {
        let test_run = TestRun::new(tag);
        let ended = start(&test_run, &format!("{says}; {cruise}"), &[]).ended();
        ended.json();
        assert!(ended.err.lines().all(|line| line.len() < 10_000));
        match tag {
            "bytes" => ended.expect(0, &["] a\u{fffd}b\n", "] c\u{fffd}\n"]),
            "long" => ended.expect(0, &["xxx … (19991808 bytes more)"]),
            _ => ended.expect(0, &["] flood"]),
        }
        test_run.assert_clean();
    }
}

#[test]
fn a_supervisor_whose_stderr_nobody_reads_neither_waits_nor_grows() {
    let test_run = TestRun::new("mute");
    let command = format!("(yes flood | head -c 5000000) >&2; {}", example("cruise"));
    let mut run = test_run.command("cz");
    run.args(["run", "--run", test_run.name()]).args(arguments(&command));
    let mut run = run.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let (id, mut peak_kib) = (run.id(), 0);
    let kept_open = run.stderr.take();
    wait_until("the run to end", || {
        let status = std::fs::read_to_string(format!("/proc/{id}/status")).unwrap_or_default();
        let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix("kB"));
        peak_kib = peak_kib.max(peak.and_then(|peak| peak.trim().parse::<u64>().ok()).unwrap_or(0));
        run.try_wait().unwrap().is_some()
    });
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    assert!(serde_json::from_slice::<serde_json::Value>(&output.stdout).is_ok(), "{output:?}");
    assert!((1..100_000).contains(&peak_kib), "{peak_kib} KiB");
    drop(kept_open);
    test_run.assert_clean();
}

#[test]
fn stderr_on_a_full_device_is_no_reason_to_panic() {
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let test_run = TestRun::new("full");
    let command = format!("echo something >&2; {}; exit 7", example("cruise"));
    let mut run = test_run.command("cz");
    let recording = test_run.runs().with_extension("czlog");
    run.args(["run", "--run", test_run.name(), "--record"]).arg(&recording).args(arguments(&command));
    let output = run.stderr(full()).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap();
    std::fs::remove_file(recording).unwrap();
    let refused = test_run.command("cz").args(["run", "--seed", "none"]).stderr(full()).status().unwrap();
    assert_eq!(refused.code(), Some(2));
    test_run.assert_clean();
}

#[test]
fn a_killed_supervisor_takes_plug_ins_with_it_and_what_these_have_started() {
    let test_run = TestRun::new("orphans");
    let command = format!("sleep 1000 & setsid sleep 1000 & trap '' TERM; {}; sleep 1000", example("cruise"));
    let arguments = ["--controller", &format!("merge-2={command}")];
    let supervisor = test_run.start("cz", &[&ENDLESS[..], &arguments].concat());
    let mut all = Vec::new();
    wait_until("the plug-in and its helpers", || {
        all = descendants(supervisor.id());
        // World, coordinator, controller, keeper, shell, plug-in and two helpers.
        all.len() == 8
    });
    send(supervisor.id(), Signal::KILL);
    wait_until("everybody to have ended", || all.iter().all(|id| !is_alive(*id)));
    assert!(supervisor.ended().was_killed_by(Signal::KILL));
    test_run.assert_clean();
}

#[test]
fn a_closed_terminal_ends_a_run_in_order() {
    let test_run = TestRun::new("hup");
    let (supervisor, parts) = crate::common::begin(&test_run, &ENDLESS, 3);
    supervisor.signal(Signal::HUP);
    supervisor.ended().expect(130, &["cz: interrupted by SIGHUP"]);
    assert!(parts.iter().all(|(_, id)| !is_alive(*id)));
    test_run.assert_clean();
    // Unless it was to be survived, as under nohup.
    let mut nohup = test_run.command("sh");
    let cz = env!("CARGO_BIN_EXE_cz");
    nohup.args([
        "-c",
        &format!("trap '' HUP; exec {cz} run --run {} --set end.time_s=1000 --json -", test_run.name()),
    ]);
    let run = nohup.stdout(Stdio::piped()).spawn().unwrap();
    wait_until("the parts", || children(run.id()).len() == 3);
    send(run.id(), Signal::HUP);
    children(run.id()).iter().for_each(|(id, _)| {
        let id = rustix::process::Pid::from_raw(*id as i32).unwrap();
        let _ = rustix::process::kill_process(id, Signal::HUP);
    });
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    test_run.assert_clean();
}

#[test]
fn a_run_waits_for_those_a_killed_supervisor_of_its_name_has_left() {
    let test_run = TestRun::new("heir");
    let (supervisor, parts) = crate::common::begin(&test_run, &ENDLESS, 3);
    let world = crate::common::part(&parts, "world");
    // Before, it may not be in the run yet, and be in the way of nobody.
    wait_until_stepping(world);
    // One that is slow to leave, as on a busy machine.
    crate::common::hold(world);
    supervisor.signal(Signal::KILL);
    let heir = test_run.start("cz", &["--set", "end.time_s=10", "--json", "-"]);
    std::thread::sleep(Duration::from_secs(2));
    send(world, Signal::CONT);
    heir.ended().json();
    test_run.assert_clean();
}
