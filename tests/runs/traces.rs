//! `cz run --trace`: what each process did when, as other people's viewers read it.

use crate::common::{LONG_RUN, TestRun, part, send, wait_until_stepping};
use rustix::process::Signal;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// What one process did.
#[derive(Debug, Default)]
struct Lane {
    name: String,
    /// Name, begin and end in us, and step.
    spans: Vec<(String, f64, f64, u64)>,
    notes: Vec<String>,
}

fn lanes(path: &Path) -> Vec<Lane> {
    let all: Value = serde_json::from_reader(std::fs::File::open(path).unwrap()).unwrap();
    let mut lanes: BTreeMap<u64, Lane> = BTreeMap::new();
    for event in all["traceEvents"].as_array().unwrap() {
        let lane = lanes.entry(event["pid"].as_u64().unwrap()).or_default();
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        let at_us = event["ts"].as_f64().unwrap();
        match event["ph"].as_str().unwrap() {
            "M" if event["name"] == "process_name" => lane.name = text(&event["args"]["name"]),
            "M" => {}
            "X" => {
                let (end_us, step) =
                    (at_us + event["dur"].as_f64().unwrap(), event["args"]["step"].as_u64().unwrap());
                lane.spans.push((text(&event["name"]), at_us, end_us, step));
            }
            "i" => lane.notes.push(text(&event["name"])),
            other => panic!("{other}"),
        }
    }
    lanes.into_values().collect()
}

#[test]
fn every_step_of_every_process_is_in_a_trace() {
    let test_run = TestRun::new("trace");
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.json");
    let arguments = ["two-merges", "--set", "end.vehicles=10", "--trace", path.to_str().unwrap()];
    let steps = test_run.summary(&arguments)["steps"].as_u64().unwrap();
    let lanes = lanes(&path);
    let names: Vec<&str> = lanes.iter().map(|lane| lane.name.as_str()).collect();
    for name in ["world", "coordinator 0", "controller 0"] {
        assert!(names.contains(&name), "{names:?}");
    }
    assert_eq!(std::fs::read_dir(&directory).unwrap().count(), 1, "parts are removed");
    for lane in &lanes {
        // One behind the other, without holes.
        for pair in lane.spans.windows(2) {
            assert!(pair[0].2 <= pair[1].1 && pair[1].1 - pair[0].2 < 0.01, "{}: {pair:?}", lane.name);
        }
        let count = |name: &str| lane.spans.iter().filter(|span| span.0 == name).count() as u64;
        assert!(count("wait") > 0 && count("compute") > 0, "{}", lane.name);
        match lane.name.as_str() {
            // A state for each step and the last one, a copy for the coordinator where it acts.
            "world" => assert!(count("publish") > steps, "{} in {steps}", count("publish")),
            "controller 0" => assert_eq!(count("publish"), steps),
            _ => assert!((1..steps).contains(&count("publish")), "{} in {steps}", count("publish")),
        }
        if lane.name != "coordinator 0" {
            let seen: std::collections::BTreeSet<u64> = lane.spans.iter().map(|span| span.3).collect();
            assert!((0..steps).all(|step| seen.contains(&step)), "{}", lane.name);
        }
    }
}

#[test]
fn who_is_replaced_is_in_the_trace_of_the_world() {
    let test_run = TestRun::new("trace");
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.json");
    let arguments = [&LONG_RUN[..], &["--json", "-", "--trace", path.to_str().unwrap()]].concat();
    let (supervisor, parts) = crate::common::begin(&test_run, &arguments, 3);
    let world = part(&parts, "world");
    wait_until_stepping(world);
    send(part(&parts, "ctrl"), Signal::KILL);
    let replacements = supervisor.ended().json()["replacements"].as_array().unwrap().len();
    assert_eq!(replacements, 1);
    let lanes = lanes(&path);
    let notes: Vec<&String> =
        lanes.iter().filter(|lane| lane.name == "world").flat_map(|lane| &lane.notes).collect();
    assert!(
        notes.iter().any(|note| note.starts_with("controller 0") && note.contains("generation 1")),
        "{notes:?}"
    );
    // Who was killed has left nothing, and its successor has its own lane.
    assert_eq!(lanes.iter().filter(|lane| lane.name == "controller 0").count(), 1);
}
