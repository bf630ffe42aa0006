//! Controllers written elsewhere, driven end to end.

#![allow(clippy::unwrap_used)] // a test

use assert_cmd::Command;
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::load;
use ipc_schemas::STATE_LEFT;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

/// A Python with `control_zones`, numpy and quadprog, named by `CZ_PYTHON`; on CI it must be there.
fn python() -> Option<String> {
    let python = std::env::var("CZ_PYTHON").ok();
    assert!(python.is_some() || std::env::var_os("CI").is_none(), "CZ_PYTHON is not set");
    if python.is_none() {
        eprintln!("skipped: CZ_PYTHON is not set");
    }
    python
}

fn cz() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cz"));
    command.current_dir(env!("CARGO_MANIFEST_DIR")).timeout(Duration::from_secs(120));
    command
}

#[test]
fn python_ocbf_drives_as_the_built_in_law() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let trace = folder.path().join("trace.csv");
    cz().args(["run", "--controller", &format!("merge-2={python} examples/python/ocbf.py")])
        .env("CZ_TRACE", &trace)
        .assert()
        .success();
    let mut seen: HashMap<(u64, u32), (f64, f64)> = HashMap::new();
    for line in std::fs::read_to_string(&trace).unwrap().lines() {
        let cells: Vec<&str> = line.split(',').collect();
        let number = |i: usize| cells[i].parse::<f64>().unwrap();
        seen.insert((number(0) as u64, number(1) as u32), (number(2), number(3)));
    }
    let mut run = InProcess::new(&Arc::new(load(None, &[], None).unwrap()), 1, 1);
    let (mut compared, mut worst) = (0, 0.0_f64);
    loop {
        let step = run.world().step();
        for s in run.world().records().filter(|s| s.zone == 1 && s.flags & STATE_LEFT == 0) {
            // The last state frame ends the run and is not answered, so it is not in the trace.
            let Some((x, v)) = seen.get(&(step, s.vehicle)) else {
                panic!("step {step}: vehicle {} is not in zone 2 of the other run", s.vehicle);
            };
            worst = worst.max((x - s.x_m).abs()).max((v - s.v_mps).abs());
            compared += 1;
        }
        if !run.step().unwrap() {
            break;
        }
    }
    println!("{compared} vehicle-steps, greatest difference {worst:.2e}");
    assert_eq!(compared, seen.len());
    assert!(worst < 1e-6, "{worst}");
}

#[test]
fn unknown_targets_and_broken_programs_are_reported() {
    let fails = |target: &str, code: i32, words: &str| {
        let output = cz().args(["run", "--controller", target]).assert().code(code).get_output().clone();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(text.contains(words), "{target}: {text}");
    };
    fails("merge-3=true", 2, "did you mean merge-");
    fails("merge-2", 2, "expected TARGET=COMMAND");
    fails("merge-2=echo no such luck >&2; exit 7", 1, "ended with code 7: no such luck");
    cz().args(["run", "--in-process", "--controller", "merge-2=true"]).assert().code(2);
}

#[test]
fn sdk_install_reports_what_it_installed_or_what_to_build() {
    let folder = tempfile::tempdir().unwrap();
    let output = cz().args(["sdk", "install", "--prefix"]).arg(folder.path()).output().unwrap();
    if output.status.success() {
        assert!(folder.path().join("lib/pkgconfig/control-zones.pc").is_file());
    } else {
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(text.contains("cargo build --release -p control-zones-c"), "{text}");
    }
}

#[test]
fn golden_vectors_are_those_checked_in() {
    let output = cz().args(["plugin", "golden"]).assert().success().get_output().stdout.clone();
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/golden-vectors.json");
    let checked_in = std::fs::read(path).unwrap();
    assert!(output == checked_in, "docs/golden-vectors.json is stale: `cz plugin golden > {path}`");
}
