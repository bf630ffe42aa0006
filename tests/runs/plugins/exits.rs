//! What becomes of a run whose controller is killed: each `--on-exit`.

use super::{cz, rust};
use crate::common::{Process, TestRun, hash, wait_until};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::Signal;
use serde_json::Value;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

const CHOICES: [&str; 4] = ["end", "restart", "builtin", "shield-fallback"];

/// A run whose controller drives merge-2, and is recorded.
fn begin(test_run: &TestRun, command: &str, choice: &str, file: &Path, more: &[&str]) -> Process {
    let controller = format!("merge-2=exec {command}");
    let on_exit = format!("merge-2={choice}");
    let own = ["--controller", &controller, "--on-exit", &on_exit, "--shield", "on", "--json", "-"];
    let record = ["--record", file.to_str().unwrap()];
    test_run.start("cz", &[&own[..], &record, more].concat())
}

/// The controller of a run, once there is one that is none of these.
fn controller(supervisor: &Process, command: &str, known: &[u32]) -> Option<u32> {
    let mut found = None;
    wait_until("the controller", || {
        // The supervisor's child is the keeper, and the controller is the keeper's.
        let keepers = crate::common::children(supervisor.id());
        let mut kept = keepers.iter().flat_map(|(keeper, _)| crate::common::children(*keeper));
        found = kept.find(|(id, line)| line[0] == command && !known.contains(id)).map(|(id, _)| id);
        found.is_some() || !crate::common::is_alive(supervisor.id())
    });
    found
}

fn kill(process: u32) {
    if let Some(pid) = rustix::process::Pid::from_raw(process as i32) {
        let _ = rustix::process::kill_process(pid, Signal::KILL);
    }
}

/// Kills the controller of one run, a few times where it comes back, at instants that follow from `seed`; what came of
/// it, in words.
fn killed(choice: &str, seed: u64) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (test_run, folder) = (TestRun::new("exit"), tempfile::tempdir().unwrap());
    let file = folder.path().join("run.czlog");
    let command = rust("cruise");
    // Some forty thousand steps, so that it is not over before anybody is killed.
    let supervisor = begin(&test_run, &command, choice, &file, &["--set", "dt_s=0.01"]);
    let mut victims = Vec::new();
    for _ in 0..if choice == "restart" { rng.random_range(1..=3) } else { 1 } {
        let Some(victim) = controller(&supervisor, &command, &victims) else { break };
        if !seed.is_multiple_of(4) {
            // Otherwise many are killed before the run has begun, on a busy machine most.
            wait_until("the run to be stepping", || {
                let is_stepping =
                    control_zones::record::Reader::open(&file).is_ok_and(|r| r.steps().next().is_some());
                is_stepping || !crate::common::is_alive(supervisor.id())
            });
        }
        std::thread::sleep(Duration::from_millis(rng.random_range(0..250)));
        kill(victim);
        victims.push(victim);
    }
    // On a busy machine forty thousand steps take their time.
    let ended = supervisor.ended_within(Duration::from_secs(300));
    assert!(!ended.err.contains("panicked"), "{choice}, {seed}: {ended:?}");
    test_run.assert_clean();
    if !ended.status.success() {
        let is_told = ended.err.contains("controller merge-2 (process ") && ended.err.contains("SIGKILL");
        // Before anybody drives there is nothing the shield could hold to.
        let is_early = choice == "shield-fallback" && ended.err.contains("recorded nothing");
        assert!(is_told && (choice == "end" || is_early), "{choice}, {seed}: {ended:?}");
        let when = if is_early { "before it began, " } else { "" };
        return format!("{when}ended with it, and said so");
    }
    let summary = ended.json();
    let replayed = cz().arg("replay").arg(&file).arg("--json").output().unwrap();
    let said = String::from_utf8(replayed.stdout).unwrap();
    assert!(
        replayed.status.success() && said.contains(&hash(&summary)),
        "{choice}, {seed}: {said} {summary}"
    );
    let row = &summary["controllers"][0];
    let events = summary["events"].as_array().unwrap();
    let of = |kind: &str| events.iter().filter(|e| e["kind"] == kind && e["controllers"] == 2).count() as u64;
    let exits = row["exits"].as_u64().unwrap();
    assert_eq!((row["controller"].as_str(), row["on_exit"].as_str()), (Some("merge-2"), Some(choice)));
    assert!(of("exited") == exits && exits <= victims.len() as u64, "{choice}, {seed}: {summary}");
    let (generation, replaced) = (row["generation"].as_u64().unwrap(), of("replaced"));
    assert!(generation >= replaced, "{choice}, {seed}: {summary}");
    let driven_by = row["driven_by"].as_str().unwrap();
    let is_as_chosen = match (choice, exits) {
        // It was killed before the run began, or when that was over.
        (_, 0) => replaced == 0,
        // One that died before it could begin has had a generation, and replaced nobody.
        ("restart", _) => driven_by == "plugin" && generation == exits && (1..=exits).contains(&replaced),
        ("builtin", _) => driven_by == "builtin" && replaced == exits,
        ("shield-fallback", _) => driven_by == "shield-fallback" && replaced == 0,
        _ => false,
    };
    assert!(is_as_chosen, "{choice}, {seed}, {victims:?}: {row}");
    match exits {
        0 => "not killed while it ran, replays to its hash".to_owned(),
        n => format!("{n} exits, driven by {driven_by}, replays to its hash"),
    }
}

fn at_random(choice: &str, seeds: RangeInclusive<u64>) -> BTreeMap<String, u64> {
    let mut tally = BTreeMap::new();
    for seed in seeds.clone() {
        *tally.entry(killed(choice, seed)).or_default() += 1;
        if seed.is_multiple_of(10) || seed == *seeds.end() {
            println!("--on-exit {choice}, seeds {} to {seed}: {tally:?}", seeds.start());
        }
    }
    tally
}

#[test]
fn a_run_goes_on_as_chosen_when_its_controller_is_killed_and_replays() {
    for choice in CHOICES {
        let tally = at_random(choice, 1..=3);
        let disturbed: u64 =
            tally.iter().filter(|(what, _)| !what.contains("not killed")).map(|(_, n)| n).sum();
        assert!(disturbed > 0, "{choice}: nobody was killed while a run ran: {tally:?}");
    }
}

/// `cargo test --test runs -- --ignored --nocapture a_hundred_times`; `CZ_SEEDS` takes other seeds than 1-100, and
/// `CZ_ON_EXIT` one choice alone.
#[test]
#[ignore = "four hundred runs"]
fn each_on_exit_a_hundred_times() {
    let only = std::env::var("CZ_ON_EXIT").ok();
    for choice in CHOICES.into_iter().filter(|choice| only.as_ref().is_none_or(|only| only == choice)) {
        at_random(choice, super::seeds());
    }
}

#[test]
fn a_run_that_was_interrupted_after_its_controller_was_replaced_resumes() {
    let command = rust("cruise");
    for choice in ["restart", "builtin", "shield-fallback"] {
        let (test_run, folder) = (TestRun::new("exit-resume"), tempfile::tempdir().unwrap());
        let (first, second) = (folder.path().join("first.czlog"), folder.path().join("second.czlog"));
        let paced = ["--pace", "realtime", "--set", "dt_s=0.01", "--set", "end.time_s=60"];
        let supervisor = begin(&test_run, &command, choice, &first, &paced);
        let victim = controller(&supervisor, &command, &[]).unwrap();
        wait_until("the run to be stepping", || {
            control_zones::record::Reader::open(&first).is_ok_and(|r| r.steps().nth(100).is_some())
        });
        kill(victim);
        let steps = || control_zones::record::Reader::open(&first).map_or(0, |r| r.steps().count());
        let before = steps();
        wait_until("the run to go on", || steps() > before + 100);
        supervisor.signal(Signal::INT);
        supervisor.ended().expect(130, &["interrupted"]);
        test_run.assert_clean();
        // It begins again with its controller.
        let mut resume = test_run.command("cz");
        resume
            .arg("resume")
            .arg(&first)
            .args(["--run", test_run.name(), "--json", "-", "--record"])
            .arg(&second);
        let output = resume.output().unwrap();
        assert!(output.status.success(), "{choice}: {output:?}");
        let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(summary["controllers"][0]["driven_by"], "plugin");
        assert!(summary["controllers"][0]["answered"].as_u64() > Some(0), "{summary}");
        let replayed = cz().arg("replay").arg(&second).arg("--json").output().unwrap();
        let said = String::from_utf8(replayed.stdout).unwrap();
        assert!(replayed.status.success() && said.contains(&hash(&summary)), "{choice}: {said} {summary}");
        test_run.assert_clean();
    }
}

#[test]
fn a_controller_that_does_not_answer_is_ended_and_the_run_goes_on_as_chosen() {
    let command = rust("cruise");
    for (choice, driven_by) in
        [("restart", "plugin"), ("builtin", "builtin"), ("shield-fallback", "shield-fallback")]
    {
        let (test_run, folder) = (TestRun::new("silent"), tempfile::tempdir().unwrap());
        let file = folder.path().join("run.czlog");
        let more =
            ["--peer-timeout", "2", "--pace", "realtime", "--set", "dt_s=0.01", "--set", "end.time_s=3"];
        let supervisor = begin(&test_run, &command, choice, &file, &more);
        let victim = controller(&supervisor, &command, &[]).unwrap();
        wait_until("the run to be stepping", || {
            control_zones::record::Reader::open(&file).is_ok_and(|r| r.steps().nth(20).is_some())
        });
        crate::common::send(victim, Signal::STOP);
        let ended = supervisor.ended();
        assert!(ended.err.contains("does not answer and is ended"), "{choice}: {ended:?}");
        let summary = ended.json();
        let row = &summary["controllers"][0];
        assert!(row["exits"] == 1 && row["driven_by"] == driven_by, "{choice}: {row}");
        test_run.assert_clean();
    }
}

#[test]
fn what_there_is_not_to_choose_is_refused_in_a_line() {
    let fails = |arguments: &[&str], words: &str| {
        let output = cz().arg("run").args(arguments).assert().code(2).get_output().clone();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(text.contains(words), "{arguments:?}: {text}");
    };
    let controller = ["--controller", "merge-2=true"];
    fails(
        &[&controller[..], &["--on-exit", "merge-2=begin"]].concat(),
        "one of end, restart, builtin, shield-fallback",
    );
    fails(
        &[&controller[..], &["--on-exit", "merge-1=end"]].concat(),
        "expected a controller of the run: merge-2",
    );
    fails(&["--on-exit", "merge-2=end"], "add --controller");
    let set = "controllers=[{name=\"a\", zones=[\"merge-2\"], on_exit=\"begin\"}]";
    fails(&["--set", set], "on_exit");
}
