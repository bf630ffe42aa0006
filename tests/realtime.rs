//! `--rt`: what is granted or refused is said, and nobody drives differently.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod common;

use common::{TestRun, hash};
use rustix::process::{Resource, Rlimit, geteuid, setrlimit};
use serde_json::Value;
use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::process::Command;

/// The placement of each process, by its name.
fn placement<'a>(summary: &'a Value, process: &str) -> &'a Value {
    let all = summary["placement"].as_array().unwrap();
    assert_eq!(all.len(), 3, "{summary}");
    all.iter().find(|p| p["process"] == process).unwrap_or_else(|| panic!("no {process}: {summary}"))
}

const PROCESSES: [&str; 3] = ["world", "coordinator 0", "controller 0"];

#[test]
fn states_are_the_same_and_every_process_says_what_it_got() {
    let test_run = TestRun::new("rt");
    let in_process = test_run.summary(&["two-merges", "--in-process"]);
    for (way, asked) in [
        (&["--rt"][..], true),
        (&["--rt", "--pin", "auto"], true),
        (&["--rt", "--wait", "block"], true),
        (&["--pin", "auto"], false),
        (&["--pin", "none"], false),
    ] {
        let summary = test_run.summary(&[&["two-merges"], way].concat());
        assert_eq!(hash(&summary), hash(&in_process), "{way:?}");
        for process in PROCESSES {
            let got = placement(&summary, process);
            let cores = got["cores"].as_array().unwrap();
            assert!(!cores.is_empty() && (!way.contains(&"auto") || cores.len() == 1), "{got}");
            let scheduling = got["scheduling"].as_str().unwrap();
            if asked {
                let fifo = if process == "coordinator 0" { "SCHED_FIFO 21" } else { "SCHED_FIFO 20" };
                // Either it has it, or it says why not.
                assert!(scheduling == fifo || scheduling.contains("(SCHED_FIFO "), "{got}");
                assert!(got["memory_locked"] == true || got["memory_note"].is_string(), "{got}");
            } else {
                let with_controllers = process == "coordinator 0" && way.contains(&"auto");
                let ordinary = if with_controllers { "SCHED_BATCH" } else { "SCHED_OTHER" };
                assert_eq!(scheduling, ordinary, "{got}");
                assert_eq!(got["memory_locked"], false, "{got}");
            }
        }
    }
    assert_eq!(in_process["placement"], Value::Array(vec![]));
    test_run.assert_clean();
}

/// `cz run --rt` without any right to what it asks for.
#[test]
fn a_refusal_is_said_and_ends_nothing() {
    // These go with the children; nothing else in this file needs more.
    let nothing = Rlimit { current: Some(0), maximum: Some(0) };
    setrlimit(Resource::Rtprio, nothing).unwrap();
    let little = Rlimit { current: Some(1 << 16), maximum: Some(1 << 16) };
    setrlimit(Resource::Memlock, little).unwrap();
    let directory = tempfile::Builder::new().prefix("cz").tempdir().unwrap();
    let program = directory.path().join("cz");
    std::fs::copy(env!("CARGO_BIN_EXE_cz"), &program).unwrap();
    let runtime = directory.path().join("runtime");
    std::fs::create_dir(&runtime).unwrap();
    let mut command = Command::new(&program);
    if geteuid().is_root() {
        // No limit binds root.
        const NOBODY: u32 = 65534;
        chown(&runtime, Some(NOBODY), Some(NOBODY)).unwrap();
        std::fs::set_permissions(directory.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
        command.uid(NOBODY).gid(NOBODY);
    }
    let run = common::unique_name("refused");
    command.env("XDG_RUNTIME_DIR", &runtime).current_dir("/");
    let output = command.args(["run", "two-merges", "--rt", "--json", "-", "--run", &run]).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    for process in PROCESSES {
        let got = placement(&summary, process);
        assert_eq!(got["scheduling"], "SCHED_OTHER (SCHED_FIFO refused: EPERM)");
        assert_eq!(got["memory_locked"], false, "{got}");
        assert_eq!(got["memory_note"], "ENOMEM; limit 64 KiB", "{got}");
    }
    assert_eq!(hash(&summary), hash(&TestRun::new("e").summary(&["two-merges", "--in-process"])));
}

#[test]
fn the_parts_of_a_run_by_hand_say_it_themselves() {
    let test_run = TestRun::new("rthand");
    let world = test_run.start("cz-world", &["two-merges", "--rt"]);
    let parts = [("coordinator 0", "cz-coord"), ("controller 0", "cz-ctrl")]
        .map(|(name, program)| (name, test_run.start(program, &["--rt"])));
    for (name, part) in [("world", world)].into_iter().chain(parts) {
        part.ended().expect(0, &[&format!("{name}: core "), "SCHED_", "memory "]);
    }
    test_run.assert_clean();
}
