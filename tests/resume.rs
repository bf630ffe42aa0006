//! Runs that were cut short go on from their recordings; runs with late controllers replay as they were.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod common;

use common::{LONG_RUN, Process, Site, is_alive, part, send, ticks, wait_until};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::Signal;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::time::Duration;

fn in_process(site: &Site, arguments: &[&str]) -> String {
    common::hash(&site.summary(&[arguments, &["--in-process"]].concat()))
}

fn begin(site: &Site, arguments: &[&str], file: &Path, processes: usize) -> (Process, Vec<(String, u32)>) {
    common::begin(site, &[arguments, &["--record", file.to_str().unwrap()]].concat(), processes)
}

fn cz(site: &Site, arguments: &[&str]) -> Output {
    site.command("cz").args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Resumes a recording and returns the hash the run ends with.
fn resumed(site: &Site, file: &Path) -> String {
    let output = cz(site, &["resume", file.to_str().unwrap(), "--json", "-"]);
    assert!(output.status.success(), "{output:?}");
    common::hash(&serde_json::from_slice(&output.stdout).unwrap())
}

/// A file in a directory of its own.
fn file(directory: &tempfile::TempDir) -> PathBuf {
    directory.path().join("run.czlog")
}

/// Kills the world, or the supervisor, that many times at random instants of a run each, and resumes.
fn cut_short(times: usize, victim: &str, shares: &[&str], processes: usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let reference = Site::new("u");
    let expected = in_process(&reference, &LONG_RUN);
    let directory = tempfile::tempdir().unwrap();
    let mut steps = Vec::new();
    while steps.len() < times {
        let (site, file) = (Site::new("cut"), file(&directory));
        let (supervisor, parts) = begin(&site, &[&LONG_RUN[..], shares].concat(), &file, processes);
        let world = part(&parts, "world");
        wait_until("the world to be stepping", || ticks(world) >= 3 || !is_alive(world));
        std::thread::sleep(Duration::from_millis(rng.random_range(0..150)));
        let id = if victim == "supervisor" { supervisor.id() } else { world };
        if is_alive(id) {
            send(id, Signal::KILL);
        }
        let ended = supervisor.ended();
        if ended.status.success() {
            continue; // it was over before
        }
        wait_until("the others to end", || parts.iter().all(|(_, id)| !is_alive(*id)));
        let shown = cz(&site, &["show", file.to_str().unwrap()]);
        assert!(shown.status.success(), "{shown:?}");
        assert_eq!(resumed(&site, &file), expected, "{ended:?}");
        let said = text(&cz(&site, &["show", file.to_str().unwrap(), "--json"]).stdout);
        steps.push(serde_json::from_str::<serde_json::Value>(&said).unwrap()["steps"].as_u64().unwrap());
        assert!(cz(&site, &["clean"]).status.success());
        site.assert_clean();
    }
    println!("{victim} {shares:?}: killed after {steps:?} steps; resumed to the same hash each time");
}

#[test]
fn a_run_whose_world_is_killed_is_resumed_to_the_same_hash() {
    cut_short(2, "world", &[], 3);
    cut_short(1, "world", &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
}

#[test]
fn a_run_whose_supervisor_is_killed_is_resumed_to_the_same_hash() {
    cut_short(2, "supervisor", &[], 3);
    cut_short(1, "supervisor", &["--ctrl-procs", "2", "--coord-procs", "2"], 5);
}

#[test]
#[ignore = "takes minutes: world and supervisor killed at 20 random steps each"]
fn cut_short_twenty_times_each() {
    cut_short(20, "world", &[], 3);
    cut_short(20, "supervisor", &[], 3);
}

#[test]
fn a_run_that_is_complete_cannot_be_resumed() {
    let (site, directory) = (Site::new("c"), tempfile::tempdir().unwrap());
    let file = file(&directory);
    let summary = site.summary(&["--record", file.to_str().unwrap()]);
    let output = cz(&site, &["resume", file.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(text(&output.stderr).contains("the run is complete"), "{output:?}");
    // It replays to the hash it ended with.
    let output = cz(&site, &["replay", file.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    assert!(text(&output.stdout).contains(&common::hash(&summary)), "{output:?}");
}

#[test]
fn processes_and_one_process_record_the_same() {
    let (site, directory) = (Site::new("s"), tempfile::tempdir().unwrap());
    let one = directory.path().join("one.czlog");
    site.summary(&["tree", "--in-process", "--record", one.to_str().unwrap()]);
    for (i, shares) in [&[][..], &["--ctrl-procs", "2", "--coord-procs", "2"]].into_iter().enumerate() {
        let many = directory.path().join(format!("{i}.czlog"));
        site.summary(&[&["tree", "--record", many.to_str().unwrap()], shares].concat());
        let output = cz(&site, &["verify", one.to_str().unwrap(), many.to_str().unwrap()]);
        assert!(output.status.success(), "{output:?}");
        let output = cz(&site, &["replay", many.to_str().unwrap()]);
        assert!(output.status.success(), "{output:?}");
    }
}

#[test]
fn a_branch_shares_the_past_and_not_the_future() {
    let (site, directory) = (Site::new("b"), tempfile::tempdir().unwrap());
    let file = file(&directory);
    let whole = common::hash(&site.summary(&["--record", file.to_str().unwrap()]));
    let branch = |at: &str, set: &str| {
        let path = file.to_str().unwrap();
        cz(&site, &["branch", path, "--at", at, "--set", set, "--json"])
    };
    let output = branch("1500", "zones.merge-1.flow.gain_mps=0.6");
    assert!(output.status.success(), "{output:?}");
    let both: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let hash = |name: &str| format!("{:016x}", both[name]["state_hash"].as_u64().unwrap());
    assert_eq!(hash("as_recorded"), whole);
    assert_ne!(hash("branched"), whole);
    // Nothing changed, nothing different; changed at the very end, too late to matter.
    let same = branch("700", "control.k_merge_per_s=1.0");
    let both: serde_json::Value = serde_json::from_slice(&same.stdout).unwrap();
    assert_eq!(both["as_recorded"], both["branched"]);
    // What cannot be changed is said.
    for (set, word) in [("dt_s=0.2", "dt_s"), ("seed=3", "seed")] {
        let output = branch("700", set);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        assert!(text(&output.stderr).contains(word), "{output:?}");
    }
    assert_eq!(branch("700000", "beta=1.0").status.code(), Some(2));
}

/// A paced run with traffic from the start.
const PACED: [&str; 11] = [
    "varying-demand",
    "--set",
    "end.time_s=4",
    "--set",
    "dt_s=0.01",
    "--set",
    "roads.main1.demand.rates=[{until_s=100.0,vehicles_per_hour=1700.0}]",
    "--pace",
    "realtime",
    "--json",
    "-",
];

#[test]
fn a_stopped_controller_is_dealt_with_as_the_policy_says_and_replayed_alike() {
    for policy in ["wait", "hold", "shield-fallback", "abort"] {
        let (site, directory) = (Site::new("miss"), tempfile::tempdir().unwrap());
        let file = file(&directory);
        let (supervisor, parts) = begin(&site, &[&PACED[..], &["--on-miss", policy]].concat(), &file, 3);
        let controller = part(&parts, "ctrl");
        std::thread::sleep(Duration::from_millis(2500));
        send(controller, Signal::STOP);
        std::thread::sleep(Duration::from_millis(500));
        send(controller, Signal::CONT);
        let ended = supervisor.ended();
        if policy == "abort" {
            ended.expect(1, &["the deadline of step", "controller 0"]);
        } else {
            let summary = ended.json();
            let by = &summary["punctuality"]["missed_by"];
            assert_eq!(by[0]["participant"], "controller 0", "{summary}");
            assert!(by[0]["steps"].as_u64().unwrap() >= 1, "{summary}");
            if policy != "wait" {
                assert!(by[0]["steps"].as_u64().unwrap() >= 10, "{summary}");
            }
            let replay = cz(&site, &["replay", file.to_str().unwrap()]);
            assert!(replay.status.success(), "{policy}: {replay:?}");
            assert!(text(&replay.stdout).contains(&common::hash(&summary)), "{policy}: {replay:?}");
            assert_eq!(text(&replay.stdout).contains("did not answer in time"), policy != "wait");
        }
        site.assert_clean();
    }
}

#[test]
fn a_paced_run_has_the_hash_of_a_free_one() {
    let site = Site::new("pace");
    let free: Vec<&str> = PACED.iter().copied().filter(|a| !["--pace", "realtime"].contains(a)).collect();
    let expected = common::hash(&site.start("cz", &free).ended().json());
    let summary = site.start("cz", &[&PACED[..], &["--deadline", "10"]].concat()).ended().json();
    assert_eq!(common::hash(&summary), expected);
    assert_eq!(summary["punctuality"]["lateness_ns"]["count"], 401);
    assert!(summary["wall_s"].as_f64().unwrap() >= 4.0, "{summary}");
}

#[test]
fn a_policy_without_a_deadline_is_refused() {
    let site = Site::new("pol");
    let output = cz(&site, &["run", "--on-miss", "hold"]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert!(text(&output.stderr).contains("--deadline"), "{output:?}");
}
