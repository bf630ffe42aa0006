//! Controllers that break the contract, are slow, or are killed.

use super::{cz, rust};
use crate::common::{TestRun, hash, wait_until};
use rustix::process::{Pid, Signal, kill_process};
use std::time::Duration;

/// A way to break the contract (`tests/fixtures/broken.rs`), what is said of it with the shield off, and whether the
/// run goes on with it on.
const HOSTILE: [(&str, &str, bool); 21] = [
    ("nan", "field u_mps2: vehicle", true),
    ("out-of-range", "is commanded 4.5 m/s^2, which is not within [-4, 4]", true),
    ("bad-intent", "planned_exit_time_s", false),
    ("worlds-verdict", "has verdict 5, expected 0 to 3", false),
    ("stale-step", "waited 3 s for commands of step 120 from controller merge-2", false),
    (
        "wrong-run",
        "controller merge-2 sent a frame that cannot be taken, and no good one since: frame belongs to run",
        false,
    ),
    ("wrong-schema", "the sender was built from another version", false),
    ("wrong-sender", "controller merge-2 sent a frame that cannot be taken", false),
    ("wrong-generation", "claims generation 1", false),
    ("wrong-count", "header announces", false),
    ("foreign-vehicle", "is driven by controller 0", false),
    ("unknown-vehicle", "vehicle 4000000 is in no zone", false),
    ("extra-vehicle", "vehicle 4000000 is in no zone", false),
    ("duplicate", "is commanded twice", false),
    ("missing-vehicle", "has no command there", false),
    ("out-of-order", "has no command there", false),
    ("wrong-zone", "field zone", false),
    ("garbage", "vehicle 3735928559", false),
    ("crash-mid-run", "SIGABRT", false),
    ("leaves-mid-run", "controller merge-2 (process ", false),
    ("old-schema", "build both from the same version", false),
];

#[test]
fn controllers_that_break_the_contract_are_named_and_leave_nothing_behind() {
    let command = rust("broken");
    let mut wrong = String::new();
    for (mode, words, goes_on) in HOSTILE {
        for shield in ["off", "on"] {
            let test_run = TestRun::new("hostile");
            let controller = format!("merge-2=exec {command} {mode}");
            // Whoever brakes for ever must not drive for ever.
            let more = ["--shield", shield, "--peer-timeout", "3", "--set", "end.time_s=60"];
            let ended = test_run.start("cz", &[&["--controller", &controller], &more[..]].concat()).ended();
            let is_done = ended.status.code() == Some(0);
            let is_named = is_done || ended.err.contains(words);
            // What others are called must not be what the user's own is called.
            let is_clear = !ended.err.contains("controller 1") && !ended.err.contains("panicked");
            if is_done != (goes_on && shield == "on") || !is_named || !is_clear {
                wrong.push_str(&format!("{mode}, shield {shield}: {ended:?}\n"));
            }
            test_run.assert_clean();
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

/// Disturbs one run, in a way that follows from `seed`: its controller is stopped a few times for a while, and
/// sometimes killed. What came of it, in words.
fn disturbed(policy: &str, seed: u64) -> String {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x2545_f491_4f6c_dd1d;
    let mut below = |limit: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state % limit
    };
    let test_run = TestRun::new("random");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.czlog");
    let command = rust("pauses");
    let controller = format!("merge-2=exec {command}");
    let conduct = ["--deadline", "0.02", "--on-miss", policy, "--shield", "on", "--json", "-"];
    let length = ["--set", "end.time_s=250", "--record", file.to_str().unwrap()];
    let all = [&["--controller", controller.as_str()], &conduct[..], &length].concat();
    let supervisor = test_run.start("cz", &all);
    let mut id = None;
    wait_until("the controller", || {
        // The supervisor's child is the keeper, and the controller is the keeper's.
        let keepers = crate::common::children(supervisor.id());
        let mut kept = keepers.iter().flat_map(|(keeper, _)| crate::common::children(*keeper));
        id = kept.find(|(_, line)| line[0] == command).map(|(id, _)| id);
        id.is_some() || !crate::common::is_alive(supervisor.id())
    });
    let mut killed = false;
    let pause = |ms| std::thread::sleep(Duration::from_millis(ms));
    if let Some(id) = id {
        pause(below(400));
        for _ in 0..1 + below(3) {
            let _ = kill_process(Pid::from_raw(id as i32).unwrap(), Signal::STOP);
            pause(1 + below(300));
            let _ = kill_process(Pid::from_raw(id as i32).unwrap(), Signal::CONT);
            pause(below(200));
        }
        if below(3) == 0 && crate::common::is_alive(id) {
            killed = kill_process(Pid::from_raw(id as i32).unwrap(), Signal::KILL).is_ok();
        }
    }
    let ended = supervisor.ended();
    assert!(!ended.err.contains("panicked"), "{policy}, {seed}: {ended:?}");
    test_run.assert_clean();
    let replay = cz().arg("replay").arg(&file).arg("--json").output().unwrap();
    let replayed = String::from_utf8(replay.stdout).unwrap();
    let came_to = if ended.status.success() {
        let summary = ended.json();
        assert!(replay.status.success(), "{policy}, {seed}: {replayed}");
        assert!(replayed.contains(&hash(&summary)), "{policy}, {seed}: {replayed} {summary}");
        match summary["punctuality"]["missed_steps"].as_u64() {
            Some(0) | None => "done, replays to its hash",
            Some(_) => "done after misses, replays to its hash",
        }
    } else {
        if killed && ended.err.contains("SIGKILL") {
            assert!(ended.err.contains("merge-2"), "{policy}, {seed}: {ended:?}");
            "killed, and said so"
        } else if ended.err.contains("the deadline of step ") {
            "ended at a missed deadline, and said so"
        } else {
            panic!("{policy}, {seed}, killed {killed}: {ended:?}")
        }
    };
    if replay.status.success() || ended.status.success() {
        came_to.to_owned()
    } else {
        format!("{came_to}; replay: {}", String::from_utf8_lossy(&replay.stderr).trim())
    }
}

/// `cargo test --test runs -- --ignored --nocapture at_random`; `CZ_SEEDS` takes other seeds than 1-100, and
/// `CZ_POLICY` one policy alone.
#[test]
#[ignore = "four hundred runs"]
fn controllers_killed_and_slowed_at_random_are_told_of_and_recordings_replay() {
    let seeds = super::seeds();
    let only = std::env::var("CZ_POLICY").ok();
    let policies = ["wait", "hold", "shield-fallback", "abort"];
    for policy in policies.into_iter().filter(|policy| only.as_deref().is_none_or(|only| only == *policy)) {
        let mut tally = std::collections::BTreeMap::<String, u64>::new();
        for seed in seeds.clone() {
            *tally.entry(disturbed(policy, seed)).or_default() += 1;
            if seed.is_multiple_of(10) || seed == *seeds.end() {
                println!("--on-miss {policy}, seeds {} to {seed}: {tally:?}", seeds.start());
            }
        }
    }
}
