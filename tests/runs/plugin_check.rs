//! The conformance kit names the fault of every broken controller, and none of a good one.

use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

/// The controllers of `tests/fixtures/broken.rs`.
fn broken() -> &'static PathBuf {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let root = env!("CARGO_MANIFEST_DIR");
        let cz = PathBuf::from(env!("CARGO_BIN_EXE_cz"));
        let mut build = Command::new(env!("CARGO"));
        build.current_dir(root).args(["build", "-q", "-p", "control-zones-plugin", "--example", "broken"]);
        assert!(build.status().unwrap().success());
        cz.parent().unwrap().join("examples/broken")
    })
}

/// Exit code and the report.
fn check(mode: &str) -> (i32, serde_json::Value) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cz"));
    // Generous: what is tested here is the kit, on whatever machine runs the tests.
    let deadline = if mode == "too-slow" { "100" } else { "4000" };
    command.args(["plugin", "check", "--json", "--deadline-ms", deadline, "--"]).arg(broken()).arg(mode);
    let output = command.output().unwrap();
    let code = output.status.code().unwrap();
    (code, serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{mode}: {e}: {output:?}")))
}

#[test]
fn a_good_controller_passes() {
    let (code, report) = check("none");
    assert_eq!(report["breaches"], serde_json::json!([]));
    assert_eq!(report["untried"], serde_json::json!([]));
    assert_eq!(code, 0);
}

/// Mode, rule, step (a vehicle may come later than the fault sets in), and words of the diagnosis.
const BROKEN: [(&str, &str, Option<u64>, &str); 25] = [
    ("nan", "finite", Some(120), "field u_mps2"),
    ("bad-intent", "finite", Some(120), "planned_exit_time_s"),
    ("out-of-range", "limits", Some(120), "is commanded 4.5 m/s^2, which is not within [-4, 4]"),
    ("worlds-verdict", "verdict", Some(120), "has verdict 5, expected 0 to 3"),
    ("stale-step", "step", Some(120), "step 119, expected step 120"),
    ("wrong-run", "run", Some(120), "belongs to run"),
    ("wrong-schema", "schema", Some(120), "schema"),
    ("wrong-sender", "sender", Some(120), "controller 2, expected controller 1"),
    ("wrong-generation", "generation", Some(120), "claims generation 1"),
    ("wrong-count", "count", Some(120), "announces"),
    ("foreign-vehicle", "own-vehicles", None, "is driven by controller 0"),
    ("unknown-vehicle", "own-vehicles", None, "vehicle 4000000 is in no zone"),
    ("extra-vehicle", "own-vehicles", Some(120), "vehicle 4000000 is in no zone"),
    ("duplicate", "no-duplicates", None, "is commanded twice"),
    ("missing-vehicle", "all-vehicles", Some(120), "has no command there"),
    ("out-of-order", "all-vehicles", None, "has no command there"),
    ("wrong-zone", "zone", Some(120), "field zone"),
    ("garbage", "own-vehicles", Some(120), "vehicle 3735928559"),
    ("too-slow", "deadline", None, "allowed are 100.0"),
    ("crash-at-start", "attach", Some(0), "SIGABRT"),
    ("crash-mid-run", "alive", Some(120), "SIGABRT"),
    ("leaves-mid-run", "alive", Some(120), "exit status: 0"),
    ("takes-offence", "feedback", Some(501), "SIGABRT"),
    ("loses-track", "catch-up", None, "exit status: 1"),
    ("old-schema", "schema", Some(0), "build both from the same version"),
];

#[test]
fn broken_controllers_are_diagnosed() {
    let mut wrong = String::new();
    for (mode, rule, step, words) in BROKEN {
        let (code, report) = check(mode);
        let breaches = report["breaches"].as_array().unwrap();
        let found = breaches.iter().find(|b| b["rule"] == rule);
        let fits = found.is_some_and(|b| {
            step.is_none_or(|s| b["step"] == s) && b["what"].as_str().unwrap().contains(words)
        });
        if code != 1 || !fits {
            wrong.push_str(&format!("{mode}: expected {rule} at {step:?} with {words:?}, got {report:#}\n"));
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn controllers_that_hang_or_end_badly_are_diagnosed() {
    for (mode, rule, words) in [
        ("silent", "alive", "no answer within 5 s"),
        ("empty-zone", "empty-zone", "no answer within 5 s"),
        ("never-ends", "end", "still there"),
        ("ends-badly", "end", "exit status: 3"),
        ("stays-behind", "catch-up", "answered no step at hand"),
    ] {
        let (_, report) = check(mode);
        let breach = &report["breaches"][0];
        assert_eq!(breach["rule"], rule, "{mode}: {report:#}");
        assert!(breach["what"].as_str().unwrap().contains(words), "{mode}: {report:#}");
    }
}

/// The world put in commands from the frame it held, and panicked over what had become of it.
#[test]
fn a_frame_rewritten_after_it_was_sent_does_not_end_the_world() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cz"));
    let controller = format!("merge-1={} turncoat", broken().display());
    command.args(["run", "--on-miss", "hold", "--deadline", "0.3", "--controller", &controller]);
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    // What ends the run is the controller's own end.
    assert!(said.contains("ended with code 9"), "{said}");
    for panic in ["panicked", "internal error"] {
        assert!(!said.contains(panic), "{said}");
    }
    // Where the world notices it before the supervisor does, it says so too.
    let of_the_world = |line: &&str| line.trim_start().starts_with("world (process");
    for line in said.lines().filter(of_the_world) {
        assert!(line.contains("controller merge-1 (process ") && line.contains(" is gone"), "{said}");
    }
}
