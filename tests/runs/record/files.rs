//! The file of a recording: when it comes to be, what it replaces, and what is said when it cannot be written.

use super::*;
use crate::common::{LONG_RUN, TestRun, begin, is_alive, part, wait_until};
use control_zones::encoding::MAX_KEPT_BYTES;
use control_zones::record::{RecordError, Recorder};
use rustix::process::Signal;
use std::path::{Path, PathBuf};
use std::process::Output;

fn cz(test_run: &TestRun, arguments: &[&str]) -> Output {
    test_run.command("cz").args(arguments).output().unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn place() -> (tempfile::TempDir, PathBuf, String) {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.czlog");
    let name = file.to_str().unwrap().to_owned();
    (directory, file, name)
}

fn entries(directory: &Path) -> usize {
    std::fs::read_dir(directory).unwrap().count()
}

/// Steps of a recording that is being written; none while it is not there.
fn steps_in(file: &Path) -> usize {
    Reader::open(file).map_or(0, |reader| reader.steps().map_while(Result::ok).count())
}

const SHORT: [&str; 3] = ["run", "--set", "end.time_s=20"];

#[test]
fn a_run_that_does_not_begin_leaves_an_older_recording_as_it_was() {
    let (test_run, (directory, file, name)) = (TestRun::new("old"), place());
    let output = cz(&test_run, &[&SHORT[..], &["--in-process", "--record", &name]].concat());
    assert!(output.status.success(), "{output:?}");
    let before = std::fs::read(&file).unwrap();
    let mistyped = ["--controller", "merge-2=no-such-program", "--record", &name, "--attach-timeout", "10"];
    let output = cz(&test_run, &[&SHORT[..], &mistyped].concat());
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(said(&output).contains("recorded nothing"), "{output:?}");
    // A name that is taken.
    let world = test_run.start("cz-world", &[]);
    test_run.wait_until_settled();
    let output = cz(&test_run, &[&SHORT[..], &["--run", test_run.name(), "--record", &name]].concat());
    assert!(said(&output).contains("is active already"), "{output:?}");
    world.signal(Signal::TERM);
    world.ended();
    assert!(std::fs::read(&file).unwrap() == before, "the old recording has been replaced");
    assert_eq!(entries(directory.path()), 1);
    test_run.assert_clean();
}

#[test]
fn a_recording_that_grows_is_neither_recorded_into_nor_resumed() {
    let (test_run, (directory, file, name)) = (TestRun::new("two"), place());
    let (supervisor, _) = begin(&test_run, &[&LONG_RUN[..], &["--record", &name]].concat(), 3);
    wait_until("the recording to grow", || steps_in(&file) > 100);
    for arguments in [&["run", "--in-process", "--record", &name][..], &["run", "--record", &name]] {
        let output = cz(&test_run, arguments);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        assert!(said(&output).contains("another run is recording into"), "{output:?}");
    }
    let output = cz(&test_run, &["resume", &name]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(said(&output).contains("still recording into it"), "{output:?}");
    supervisor.signal(Signal::INT);
    supervisor.ended();
    assert_eq!(entries(directory.path()), 1);
}

#[test]
fn a_recording_that_is_taken_away_is_an_error_that_does_not_cost_the_results() {
    let (test_run, (directory, file, name)) = (TestRun::new("gone"), place());
    let (supervisor, _) = begin(&test_run, &[&LONG_RUN[..], &["--json", "-", "--record", &name]].concat(), 3);
    wait_until("the recording to grow", || steps_in(&file) > 100);
    std::fs::remove_dir_all(directory.path()).unwrap();
    let ended = supervisor.ended();
    ended.expect(1, &["has been removed; the run goes on without being recorded"]);
    let summary: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
    assert_eq!(summary["steps"], 100_000);
}

#[test]
fn a_recorder_that_falls_behind_holds_a_run_without_deadline_back() {
    let (test_run, (_directory, file, name)) = (TestRun::new("lag"), place());
    let expected = crate::common::hash(&test_run.summary(&[&LONG_RUN[..], &["--in-process"]].concat()));
    let arguments = [&LONG_RUN[..], &["--json", "-", "--peer-timeout", "50", "--record", &name]].concat();
    let (supervisor, parts) = begin(&test_run, &arguments, 3);
    wait_until("the recording to grow", || steps_in(&file) > 100);
    supervisor.signal(Signal::STOP);
    // Long enough for more steps than may wait.
    std::thread::sleep(std::time::Duration::from_secs(3));
    assert!(is_alive(part(&parts, "world")), "the run has not waited for its recorder");
    supervisor.signal(Signal::CONT);
    assert_eq!(supervisor.ended().hash(), expected);
    let reader = Reader::open(&file).unwrap();
    assert_eq!(reader.gaps(), []);
    assert_eq!(reader.step_numbers().len(), 100_001);
}

#[test]
fn a_run_with_a_deadline_leaves_out_what_cannot_be_recorded_in_time() {
    let (test_run, (_directory, file, name)) = (TestRun::new("drop"), place());
    let arguments = [&LONG_RUN[..], &["--deadline", "10", "--record", &name]].concat();
    let (supervisor, parts) = begin(&test_run, &arguments, 3);
    wait_until("the recording to grow", || steps_in(&file) > 100);
    supervisor.signal(Signal::STOP);
    wait_until("the run to be over", || !is_alive(part(&parts, "world")));
    supervisor.signal(Signal::CONT);
    supervisor.ended().expect(0, &["not in it, because it came faster than it could be written"]);
    let reader = Reader::open(&file).unwrap();
    assert!(!reader.gaps().is_empty());
}

#[test]
fn a_recorder_that_takes_nothing_for_too_long_is_named() {
    let (test_run, (_directory, file, name)) = (TestRun::new("held"), place());
    let arguments = [&LONG_RUN[..], &["--peer-timeout", "2", "--record", &name]].concat();
    let (supervisor, parts) = begin(&test_run, &arguments, 3);
    wait_until("the recording to grow", || steps_in(&file) > 100);
    supervisor.signal(Signal::STOP);
    wait_until("the world to give up", || !is_alive(part(&parts, "world")));
    supervisor.signal(Signal::CONT);
    supervisor
        .ended()
        .expect(1, &["whoever records the run has taken no step for 1.8 s", "--record-lag drop"]);
    // What was taken can be gone on from.
    assert_eq!(Reader::open(&file).unwrap().gaps(), []);
    assert!(cz(&test_run, &["resume", &name]).status.success());
}

/// Runs `cz` under a limit of so many blocks per file.
fn limited(test_run: &TestRun, blocks: u32, arguments: &str) -> Output {
    let cz = test_run.command("cz").get_program().to_str().unwrap().to_owned();
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec '{cz}' {arguments}");
    std::process::Command::new("sh").args(["-c", &script]).output().unwrap()
}

#[test]
fn a_full_disk_is_known_at_the_start_or_at_once_and_costs_no_results() {
    let (test_run, (directory, file, name)) = (TestRun::new("full"), place());
    let run = format!("run --in-process --record {name}");
    let output = limited(&test_run, 0, &run);
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{output:?}");
    assert!(said(&output).contains("--record: cannot create"), "{output:?}");
    assert_eq!(entries(directory.path()), 0);
    let output = limited(&test_run, 400, &run);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(said(&output).contains("; the run goes on without being recorded\n"), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("total"), "{output:?}");
    // What could be written can be read.
    assert!(steps_in(&file) > 0);
}

#[test]
fn a_file_for_the_summary_that_cannot_be_written_costs_no_results() {
    let (test_run, (directory, file, name)) = (TestRun::new("json"), place());
    let missing = directory.path().join("no").join("such.json");
    let output =
        cz(&test_run, &[&SHORT[..], &["--in-process", "--json", missing.to_str().unwrap()]].concat());
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{output:?}");
    let output = cz(&test_run, &[&SHORT[..], &["--in-process", "--json", "/dev/full"]].concat());
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("total"), "{output:?}");
    assert!(said(&output).contains("cannot write /dev/full"), "{output:?}");
    // A run that is refused leaves no empty file.
    let output = cz(&test_run, &["run", "--in-process", "--record", "/dev/null", "--json", &name]);
    assert!(output.status.code() == Some(2) && !file.exists(), "{output:?}");
}

#[test]
fn a_scenario_too_large_to_be_read_again_is_not_recorded() {
    let (_directory, file, _) = place();
    let mut large = Scenario::clone(&scenario("two-merges", &[]));
    large.name = "x".repeat(MAX_KEPT_BYTES);
    let error = Recorder::create(&file, &metadata(&large, 1, 1)).err();
    assert!(matches!(error, Some(RecordError::TooLarge { .. })), "{error:?}");
}
