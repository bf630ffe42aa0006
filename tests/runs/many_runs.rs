//! Many runs at a time, some of them killed: whoever survives drives as ever, and nothing is left behind.

use crate::common::{Ended, Process, TestRun, children, files, unique_name, wait_until};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

/// What becomes of a run.
#[derive(Clone, Debug)]
struct Fate {
    run: String,
    seed: u64,
    /// Who is killed, and how long after the start.
    victim: Option<(&'static str, Duration)>,
}

/// State hashes of `paper`, by seed from 1; see `run_hashes.rs`.
const GOLDEN: [&str; 3] = ["b56ea7e351b4a6a2", "204eba1f547116eb", "58b2783c8587e258"];

/// A third of the runs lose their supervisor, world or controller, at a moment drawn.
fn fates(count: u32, seed: u64) -> Vec<Fate> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..count)
        .map(|i| {
            let delay = Duration::from_millis(random.random_range(0..400));
            let victim = ["supervisor", "world", "ctrl"][random.random_range(0..3)];
            // The first dies as soon as it is born, so that certainly somebody does.
            let victim = match i {
                0 => Some(("supervisor", Duration::ZERO)),
                i => i.is_multiple_of(3).then_some((victim, delay)),
            };
            Fate { run: unique_name("many"), seed: u64::from(i) % 3 + 1, victim }
        })
        .collect()
}

/// Kills one process of a run; it may have ended before, or not be there yet.
fn kill(supervisor: &Process, victim: &str) {
    let id = if victim == "supervisor" {
        Some(supervisor.id())
    } else {
        let mut parts = children(supervisor.id()).into_iter();
        parts.find(|(_, line)| line.get(1).is_some_and(|part| part == victim)).map(|(id, _)| id)
    };
    // A part that is no more has left its id to nobody yet: its parent lives.
    if let Some(id) = id.and_then(|id| Pid::from_raw(id as i32)) {
        let _ = kill_process(id, Signal::KILL);
    }
}

fn live(test_run: &TestRun, fate: &Fate) -> Ended {
    let seed = fate.seed.to_string();
    let arguments =
        ["paper", "--seed", &seed, "--json", "-", "--peer-timeout", "60", "--attach-timeout", "60"];
    let supervisor = test_run.start_in("cz", &fate.run, &arguments);
    if let Some((victim, delay)) = fate.victim {
        std::thread::sleep(delay);
        kill(&supervisor, victim);
    }
    supervisor.ended()
}

fn many_runs(count: u32, at_a_time: usize, seed: u64) {
    let test_run = TestRun::new("many");
    let fates = fates(count, seed);
    let queue = Mutex::new(fates.iter());
    let next = || queue.lock().unwrap().next();
    let ends = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..at_a_time {
            scope.spawn(|| {
                while let Some(fate) = next() {
                    let ended = live(&test_run, fate);
                    ends.lock().unwrap().push((fate, ended));
                }
            });
        }
    });
    let mut killed = 0;
    for (fate, ended) in ends.into_inner().unwrap() {
        if fate.victim.is_none() || ended.status.success() {
            assert_eq!(ended.hash(), GOLDEN[fate.seed as usize - 1], "{fate:?}");
        } else {
            killed += 1;
        }
    }
    assert!(killed >= 1, "nobody was killed");

    let left = || -> Vec<PathBuf> {
        fates.iter().flat_map(|fate| files(Some(test_run.runs().parent().unwrap()), &fate.run)).collect()
    };
    let mut said = String::new();
    wait_until("cz clean to have removed what the killed have left", || {
        let output = test_run.command("cz").arg("clean").output().unwrap();
        assert!(output.status.success());
        said.push_str(&String::from_utf8_lossy(&output.stdout));
        left().is_empty()
    });
    assert!(!said.contains("could not"), "{said}");
    test_run.assert_clean();
}

#[test]
fn twenty_runs_four_at_a_time() {
    many_runs(20, 4, 1);
}

#[test]
#[ignore = "takes a minute"]
fn a_hundred_runs_ten_at_a_time() {
    many_runs(100, 10, 2);
}
