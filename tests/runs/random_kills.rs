//! Runs whose processes are killed at random: each ends with the result of the undisturbed run, or, where its world or
//! its supervisor died, is resumed to it; and nothing is left behind.

use crate::common::{Ended, LONG_RUN, Process, TestRun, children, is_alive};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Runs of the long test unless `CZ_RANDOM_KILLS` says how many; their seeds are `CZ_RANDOM_KILLS_FROM` (0) and on.
const MANY: u64 = 1000;

/// Longer than a run takes on a machine with much else to do.
const VERY_LONG: Duration = Duration::from_secs(600);

/// Scenarios, and the most processes per role each can use. The long one is mostly middle, the others mostly start-up.
const SCENARIOS: [(&str, &[&str], u32); 4] = [
    ("two-merges", &[], 2),
    (LONG_RUN[0], LONG_RUN.split_at(1).1, 2),
    ("tree", &["--set", "end.time_s=400"], 3),
    ("corridor-8", &["--set", "end.time_s=300"], 4),
];

/// What is done to a run.
#[derive(Clone, Debug)]
struct Disturbance {
    scenario: usize,
    arguments: Vec<String>,
    is_recorded: bool,
    /// Who is killed, as which in the list of those of its kind, and how long after the one before.
    kills: Vec<(&'static str, usize, Duration)>,
}

impl Disturbance {
    fn draw(seed: u64, length: &[Duration]) -> Disturbance {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let scenario = random.random_range(0..SCENARIOS.len());
        let most = SCENARIOS[scenario].2;
        let mut arguments = vec!["--wait".to_owned()];
        arguments.push(["adaptive", "hybrid", "block"].choose(&mut random).unwrap().to_string());
        for role in ["--coord-procs", "--ctrl-procs"] {
            arguments.extend([role.to_owned(), random.random_range(1..=most).to_string()]);
        }
        let is_recorded = random.random_bool(0.5);
        // Somewhere from before the start until after the end.
        let end = length[scenario] * 11 / 10;
        let kills = random.random_range(1..=4);
        let mut instants: Vec<_> = (0..kills).map(|_| end.mul_f64(random.random())).collect();
        if random.random_bool(0.3) {
            // All within the start-up.
            instants
                .iter_mut()
                .for_each(|instant| *instant = Duration::from_millis(random.random_range(0..150)));
        }
        instants.sort();
        let victims = ["coord", "ctrl", "coord", "ctrl", "coord", "ctrl", "world", "cz"];
        let mut last = Duration::ZERO;
        let kills = instants.into_iter().map(|instant| {
            let pause = instant - std::mem::replace(&mut last, instant);
            (*victims.choose(&mut random).unwrap(), random.random_range(0..4), pause)
        });
        Disturbance { scenario, arguments, is_recorded, kills: kills.collect() }
    }
}

/// Whom a run has lost, and how it ended.
struct Course {
    killed: Vec<&'static str>,
    ended: Ended,
}

fn kill(supervisor: &Process, victim: &'static str, which: usize) -> bool {
    let id = if victim == "cz" {
        supervisor.id()
    } else {
        let parts = children(supervisor.id());
        let of_kind: Vec<_> =
            parts.iter().filter(|(_, line)| line.get(1).is_some_and(|part| part == victim)).collect();
        let Some((id, _)) = of_kind.get(which % of_kind.len().max(1)) else { return false };
        *id
    };
    // Whoever has ended has left its id to nobody yet, or is no child of the supervisor's.
    is_alive(id) && Pid::from_raw(id as i32).is_some_and(|id| kill_process(id, Signal::KILL).is_ok())
}

fn live(test_run: &TestRun, disturbance: &Disturbance, recording: &str) -> Course {
    let (scenario, settings, _) = SCENARIOS[disturbance.scenario];
    let mut arguments = vec![scenario, "--json", "-"];
    arguments.extend(settings);
    arguments.extend(disturbance.arguments.iter().map(String::as_str));
    if disturbance.is_recorded {
        arguments.extend(["--record", recording]);
    }
    let supervisor = test_run.start("cz", &arguments);
    let mut killed = Vec::new();
    for (victim, which, pause) in &disturbance.kills {
        std::thread::sleep(*pause);
        if kill(&supervisor, victim, *which) {
            killed.push(*victim);
        }
    }
    Course { killed, ended: supervisor.ended_within(VERY_LONG) }
}

/// What was wrong with a run, if anything was.
fn check(seed: u64, length: &[Duration], expected: &HashMap<usize, String>) -> Result<&'static str, String> {
    let disturbance = Disturbance::draw(seed, length);
    let test_run = TestRun::new("rk");
    let recordings = tempfile::tempdir().unwrap();
    let recording = recordings.path().join("r.czlog").display().to_string();
    let Course { killed, ended } = live(&test_run, &disturbance, &recording);
    let scene = || format!("seed {seed}: {disturbance:?}, killed {killed:?}: {ended:?}");
    let expected = &expected[&disturbance.scenario];
    let was_fatal = killed.iter().any(|victim| ["world", "cz"].contains(victim));
    let verdict = if ended.status.success() {
        if ended.hash() != *expected {
            return Err(format!("another hash: {}", scene()));
        }
        "ended as if undisturbed"
    } else if !was_fatal {
        return Err(format!("failed: {}", scene()));
    } else {
        // The children of a killed supervisor are on their way out; the next of its name waits for them.
        let began = std::fs::metadata(&recording).is_ok_and(|file| file.len() > 0);
        let again = if began {
            let mut command = test_run.command("cz");
            command.args(["resume", &recording, "--run", test_run.name(), "--json", "-"]);
            command.output().unwrap()
        } else {
            // Nothing to be resumed, for it was not recorded or had not begun: from the beginning.
            let (scenario, settings, _) = SCENARIOS[disturbance.scenario];
            let mut command = test_run.command("cz");
            command.args(["run", scenario, "--run", test_run.name(), "--json", "-"]).args(settings);
            command.output().unwrap()
        };
        let said = String::from_utf8_lossy(&again.stderr).into_owned();
        // It was killed when all was over and only the results were to be printed.
        if said.contains("the run is complete") {
            "died with a complete recording"
        } else if !again.status.success() {
            return Err(format!("not resumed: {said}: {}", scene()));
        } else {
            let summary = serde_json::from_slice(&again.stdout).map_err(|e| format!("{e}: {}", scene()))?;
            if crate::common::hash(&summary) != *expected {
                return Err(format!("resumed to another hash: {}", scene()));
            }
            "was resumed"
        }
    };
    let patience = Instant::now() + Duration::from_secs(20);
    while !test_run.files().is_empty() && Instant::now() < patience {
        std::thread::sleep(Duration::from_millis(20));
    }
    if !test_run.files().is_empty() {
        return Err(format!("left behind {:?}: {}", test_run.files(), scene()));
    }
    Ok(verdict)
}

fn random_kills(seeds: std::ops::Range<u64>) {
    let mut expected = HashMap::new();
    let mut length = Vec::new();
    for (i, (scenario, settings, _)) in SCENARIOS.iter().enumerate() {
        expected.insert(
            i,
            crate::common::hash(
                &TestRun::new("u").summary(&[&[*scenario, "--in-process"], *settings].concat()),
            ),
        );
        let start = Instant::now();
        let test_run = TestRun::new("u");
        let run = test_run.start("cz", &[&[*scenario, "--wait", "block"], *settings].concat());
        run.ended_within(VERY_LONG).expect(0, &[]);
        length.push(start.elapsed());
    }
    let (mut verdicts, mut wrong) = (HashMap::<_, u32>::new(), Vec::new());
    for seed in seeds {
        match check(seed, &length, &expected) {
            Ok(verdict) => *verdicts.entry(verdict).or_default() += 1,
            Err(problem) => {
                println!("{problem}");
                wrong.push(problem);
            }
        }
    }
    println!("{verdicts:?}, {} wrong", wrong.len());
    assert!(wrong.is_empty(), "{} wrong: {}", wrong.len(), wrong.join("\n"));
}

#[test]
fn a_few_runs_with_random_kills() {
    random_kills(0..8);
}

#[test]
#[ignore = "takes half an hour: a thousand runs with random kills"]
fn a_thousand_runs_with_random_kills() {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse().ok());
    let from = number("CZ_RANDOM_KILLS_FROM").unwrap_or(0);
    random_kills(from..from + number("CZ_RANDOM_KILLS").unwrap_or(MANY));
}
