//! A run that goes on: looked at from its first step, steered, and none the worse for it.

#![allow(clippy::unwrap_used)]

mod common;

use common::Page;
use control_zones::process::{StopFlag, run_in_process};
use control_zones::record::{Reader, RunEventKind};
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

/// `cz` as somebody starts it who has no cargo, if it is there.
fn cz() -> Option<Command> {
    let program = Path::new(env!("CARGO_BIN_EXE_cz-view")).with_file_name("cz");
    if !program.is_file() {
        eprintln!(
            "{} is not built: no run can be started (cargo test --workspace builds it)",
            program.display()
        );
        return None;
    }
    let mut command = Command::new(program);
    command.env_remove("CARGO").env_remove("CARGO_MANIFEST_DIR");
    Some(command)
}

/// The summary, once it has been written.
fn summary_in(path: &Path) -> Value {
    for _ in 0..1200 {
        if let Some(summary) = std::fs::read(path).ok().and_then(|text| serde_json::from_slice(&text).ok()) {
            return summary;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    panic!("no summary in {}", path.display());
}

/// `cz view … ` and `cz run --view …` come to the same: a run that begins when the page is opened.
#[test]
fn a_view_is_started_through_cz_and_the_run_begins_when_the_page_is_opened() {
    for words in [&["view", "two-merges", "--"][..], &["run", "--view"]] {
        let Some(mut command) = cz() else { return };
        let directory = tempfile::tempdir().unwrap();
        let summary = directory.path().join("summary.json");
        command.args(words).args(["--set", SETTINGS, "--json"]).arg(&summary);
        command.args((words[0] == "run").then_some("two-merges"));
        let page = Page::begin(command);
        page.get_until("status", |status| status[0]["live"]["is_paused"] == json!(true));
        assert_eq!(page.get("status")[0]["last"], Value::Null, "{words:?}: a step before anybody had looked");
        assert_eq!(page.post("steer?run=0", &json!({ "pace": 0.0 })).0, 200);
        page.get("begin");
        page.get_until("status", |status| status[0]["live"]["is_over"] == json!(true));
        assert_eq!(summary_in(&summary)["state_hash"].as_str().unwrap(), expected_hash(), "{words:?}");
    }
}

#[test]
fn a_run_that_is_paused_and_made_to_step_comes_to_the_same_result() {
    let Some(_) = cz() else { return };
    let program = Path::new(env!("CARGO_BIN_EXE_cz-view"));
    let directory = tempfile::tempdir().unwrap();
    let (summary, name) =
        (directory.path().join("summary.json"), format!("view-test-{}", std::process::id()));
    let recording = directory.path().join("a.czlog");
    let mut command = Command::new(program);
    command.arg("--").args(["--set", SETTINGS, "--run", &name, "--json"]).arg(&summary);
    command.arg("--record").arg(&recording).arg("two-merges");
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
    assert_eq!(steered, 3, "{events}");
    assert_eq!(page.post("steer?run=0", &json!("pause")).0, 409, "it is over");

    let summary = summary_in(&summary);
    assert_eq!(summary["state_hash"].as_str().unwrap(), expected_hash());

    // What was steered is in the recording, in order, and the recording replays as any other.
    let mut replay = cz().unwrap();
    let replayed = loop {
        let reader = Reader::open(&recording).unwrap();
        if reader.footer().is_some() {
            let steered = reader.events().iter().filter(|event| event.kind == RunEventKind::Steered);
            let texts: Vec<&str> = steered.map(|event| event.text.as_str()).collect();
            let expected = ["3 steps", "200 times real time", "go on"];
            assert_eq!(texts, expected.map(|text| format!("steered: {text}")));
            break replay.arg("replay").arg(&recording).output().unwrap();
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    };
    assert!(replayed.status.success(), "{replayed:?}");
}

#[test]
fn a_paused_run_whose_view_was_killed_goes_on() {
    let Some(mut command) = cz() else { return };
    let directory = tempfile::tempdir().unwrap();
    let summary = directory.path().join("summary.json");
    command.args(["view", "two-merges", "--", "--set", SETTINGS, "--json"]).arg(&summary);
    let page = Page::begin(command);
    page.get_until("status", |status| status[0]["live"]["is_paused"] == json!(true));
    assert_eq!(page.post("steer?run=0", &json!({ "pace": 0.0 })).0, 200);
    assert_eq!(page.post("steer?run=0", &json!({ "step": 3 })).0, 200);
    page.get_until("status", |status| status[0]["last"] == json!(2));
    // SIGKILL: it says goodbye to nobody.
    drop(page);
    assert_eq!(summary_in(&summary)["state_hash"].as_str().unwrap(), expected_hash());
}
