//! A run that goes on: looked at from its first step, steered, and none the worse for it.

#![allow(clippy::unwrap_used)]

mod common;

use common::Page;
use control_zones::process::{StopFlag, run_in_process};
use control_zones::scenario::{Override, load_embedded};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

const SETTINGS: &str = "end.vehicles=10";

/// The state hash the run has when nobody looks.
fn expected_hash() -> String {
    let overrides: Vec<Override> = vec![SETTINGS.parse().unwrap()];
    let scenario = Arc::new(load_embedded("two-merges", &overrides, None).unwrap());
    let outcome = run_in_process(&scenario, 1, 1, &StopFlag::none(), |_| {}).unwrap();
    format!("{:016x}", outcome.world.state_hash)
}

#[test]
fn a_run_that_is_paused_and_made_to_step_comes_to_the_same_result() {
    let program = Path::new(env!("CARGO_BIN_EXE_cz-view"));
    let cz = program.with_file_name("cz");
    if !cz.is_file() {
        eprintln!("{} is not built: no run can be started (cargo test --workspace builds it)", cz.display());
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let (summary, name) =
        (directory.path().join("summary.json"), format!("view-test-{}", std::process::id()));
    let mut command = Command::new(program);
    command.arg("--").args(["--set", SETTINGS, "--run", &name, "--json"]).arg(&summary).arg("two-merges");
    let page = Page::begin(command);

    // It waits for somebody to look.
    let is_paused = |status: &Value| status[0]["live"]["is_paused"] == json!(true);
    page.get_until("status", is_paused);
    assert_eq!(page.get("status")[0]["last"], Value::Null, "a step before anybody had looked");
    let (code, body) = page.post("steer?run=0", &json!({ "step": 3 }));
    assert_eq!(code, 200, "{body}");
    page.get_until("status", |status| status[0]["last"] == json!(2));
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert_eq!(page.get("status")[0]["last"], json!(2), "a step that nobody asked for");

    // Who else looks sees the same.
    let top = Command::new(env!("CARGO_BIN_EXE_cz-top")).args([&name, "--once", "1"]).output().unwrap();
    let board = String::from_utf8(top.stdout).unwrap();
    assert!(
        board.starts_with(&name) && board.contains("paused"),
        "{board}{}",
        String::from_utf8_lossy(&top.stderr)
    );
    for process in ["world", "coordinator 0", "controller 0"] {
        assert!(board.lines().any(|line| line.starts_with(process)), "{process}\n{board}");
    }

    // What is no pace is refused, or has no effect.
    assert_eq!(page.post("steer?run=0", &json!({ "pace": "fast" })).0, 422);
    assert_eq!(page.post("steer?run=0", &json!({ "pace": -1.0 })).0, 200);
    assert_eq!(page.post("steer?run=0", &json!({ "pace": 200.0 })).0, 200);
    assert_eq!(page.post("steer?run=0", &json!("resume")).0, 200);
    page.get_until("status", |status| {
        status[0]["live"]["pace"].as_f64().is_some_and(|pace| (pace - 200.0).abs() < 1.0)
    });
    page.get_until("status", |status| status[0]["live"]["is_over"] == json!(true));
    let events = page.get("events");
    let steered =
        events["events"].as_array().unwrap().iter().filter(|event| event["kind"] == "steered").count();
    assert_eq!(steered, 4, "{events}");
    assert_eq!(page.post("steer?run=0", &json!("pause")).0, 409, "it is over");

    for _ in 0..600 {
        if summary.is_file() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let summary: Value = serde_json::from_slice(&std::fs::read(&summary).unwrap()).unwrap();
    assert_eq!(summary["state_hash"].as_str().unwrap(), expected_hash());
}
