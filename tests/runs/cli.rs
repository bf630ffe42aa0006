//! The command line: what it prints, what it refuses, and with which exit code.

use crate::common::TestRun;
use assert_cmd::Command;
use serde_json::Value;

fn cz(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cz"));
    command.args(arguments);
    command
}

/// Stdout of a command that succeeds and says nothing on stderr.
fn stdout(arguments: &[&str]) -> String {
    let output = cz(arguments).assert().success().get_output().clone();
    assert_eq!(String::from_utf8_lossy(&output.stderr), "", "{arguments:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Stderr of a command that is refused: exit code 2, nothing on stdout, and nothing was started.
fn refusal(arguments: &[&str]) -> String {
    let output = cz(arguments).assert().code(2).get_output().clone();
    assert_eq!(String::from_utf8_lossy(&output.stdout), "", "{arguments:?}");
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn version() {
    let version = env!("CARGO_PKG_VERSION");
    assert_eq!(stdout(&["--version"]), format!("cz {version}\n"));
    for program in ["cz-world", "cz-coord", "cz-ctrl"] {
        let output = TestRun::new("v").command(program).arg("--version").output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && said.ends_with(&format!(" {version}\n")), "{program}: {said}");
    }
}

#[test]
fn a_refusal_is_one_line_whatever_was_given() {
    for arguments in [
        &["run", "--set", "dt_s=1\n2"][..],
        &["run", "--set", "no\nkey=1"],
        &["run", "no\nsuch"],
        &["run", "no/such\r\nfile.toml"],
        &["run", "--controller", "merge\n-1=true"],
        &["world", "--run", "r", "--set", "seed=\u{1b}[2J\n"],
        &["show", "no\nsuch.czlog"],
        &["branch", "no\nsuch.czlog", "--at", "1", "--set", "a\n=1"],
    ] {
        let said = refusal(arguments);
        assert!(said.ends_with('\n') && said.lines().count() == 1, "{arguments:?}: {said}");
        assert!(said.trim_end().chars().all(|c| !c.is_control()), "{arguments:?}: {said:?}");
    }
}

#[test]
fn help_shows_the_way() {
    let help = stdout(&["--help"]);
    for word in ["run", "world", "coord", "ctrl", "plan", "Usage: cz"] {
        assert!(help.contains(word), "no {word:?} in {help}");
    }
    let help = stdout(&["run", "--help"]);
    for word in [
        "--seed",
        "--set",
        "--in-process",
        "--ctrl-procs",
        "--coord-procs",
        "--json",
        "--run",
        "two-merges",
        "varying-demand",
        "corridor-8",
        "tree",
    ] {
        assert!(help.contains(word), "no {word:?} in {help}");
    }
    // Without a command: how to go on, and exit code 2.
    assert!(refusal(&[]).contains("Usage: cz"));
}

#[test]
fn plan_prints_the_trajectory() {
    let given = ["plan", "--v0", "16", "--length", "200", "--beta", "0.6666666666666666", "--vm", "18.5"];
    let text = stdout(&given);
    let json: Value = serde_json::from_str(&stdout(&[&given[..], &["--json"]].concat())).unwrap();
    let value = |key: &str| json[key].as_f64().unwrap_or_else(|| panic!("{key}: {json}"));
    for key in ["T", "a", "b", "c", "cost"] {
        let line = text.lines().find(|l| l.split_whitespace().next() == Some(key));
        let shown: f64 = line
            .unwrap_or_else(|| panic!("{key}: {text}"))
            .split_whitespace()
            .nth(1)
            .unwrap()
            .parse()
            .unwrap();
        assert!((shown - value(key)).abs() <= 1e-9, "{key}: {text} {json}");
    }
    // The trajectory covers the length, ends at v_m, and satisfies beta - b^2/2 + a c = 0.
    let (t, a, b, c) = (value("T"), value("a"), value("b"), value("c"));
    assert_eq!(c, 16.0);
    assert!((c * t + b * t * t / 2.0 + a * t * t * t / 6.0 - 200.0).abs() < 1e-9);
    assert!((c + b * t + a * t * t / 2.0 - 18.5).abs() < 1e-9);
    assert!((2.0 / 3.0 - b * b / 2.0 + a * c).abs() < 1e-9);
    let energy = (a * a * t * t * t / 3.0 + a * b * t * t + b * b * t) / 2.0;
    assert!((value("cost") - (2.0 / 3.0 * t + energy)).abs() < 1e-9);
}

#[test]
fn plan_with_a_free_end_and_as_printed() {
    let json = |arguments: &[&str]| -> Value {
        let common = ["plan", "--v0", "12", "--length", "150", "--beta", "1", "--json"];
        serde_json::from_str(&stdout(&[&common[..], arguments].concat())).unwrap()
    };
    let free = json(&["--free"]);
    let (t, a, b) = (free["T"].as_f64().unwrap(), free["a"].as_f64().unwrap(), free["b"].as_f64().unwrap());
    assert!((a * t + b).abs() < 1e-9, "u(T) = 0 where the terminal speed is free: {free}");
    // The printed condition is another one, so its optimum costs more.
    let (corrected, printed) = (json(&["--vm", "15"]), json(&["--vm", "15", "--as-printed"]));
    assert!(printed["cost"].as_f64().unwrap() > corrected["cost"].as_f64().unwrap(), "{printed} {corrected}");
    let (t, v0, w, l) = (printed["T"].as_f64().unwrap(), 12.0, 15.0, 150.0);
    let cubic =
        t * t * t + (2.0 * v0 + w) * t * t + (6.0 * v0 * w + 6.0 * v0 * v0 - 3.0 * l) * t - 12.0 * l * v0;
    assert!(cubic.abs() < 1e-6 * 12.0 * l * v0, "the printed cubic's root: {printed}");
}

#[test]
fn bad_arguments_are_named() {
    let plan = ["plan", "--v0", "16", "--length", "200", "--beta", "0.7"];
    let with = |more: &[&'static str]| [&plan[..], more].concat();
    let cases: [(Vec<&str>, &[&str]); 17] = [
        (vec!["rum"], &["rum", "run"]),
        (vec!["run", "--sed", "1"], &["--sed", "--seed"]),
        (vec!["run", "--seed", "-1"], &["-1"]),
        (vec!["run", "--seed", "one"], &["--seed", "one"]),
        (vec!["run", "--ctrl-procs", "0"], &["--ctrl-procs", "0"]),
        (vec!["run", "--ctrl-procs", "3"], &["--ctrl-procs 3", "at most 2", "two-merges"]),
        (
            vec!["run", "--in-process", "--coord-procs", "9", "tree"],
            &["--coord-procs 9", "at most 5", "tree"],
        ),
        (vec!["run", "--run", "a/b"], &["--run", "a/b", "letters"]),
        (vec!["run", "--attach-timeout", "0"], &["--attach-timeout", "> 0"]),
        (vec!["run", "--set", "end.vehicles"], &["end.vehicles", "key=value"]),
        (vec!["run", "--set", "end.vehicle=3"], &["end.vehicle", "vehicles"]),
        (vec!["world"], &["--run"]),
        (vec!["ctrl", "--run", "a", "--index", "70000"], &["--index", "70000"]),
        (with(&[]), &["--vm", "--free"]),
        (with(&["--vm", "15", "--free"]), &["--vm", "--free"]),
        (with(&["--vm", "NaN"]), &["--vm NaN", "expected"]),
        (with(&["--vm", "1001"]), &["--vm 1001", "1000 m/s"]),
    ];
    for (arguments, words) in cases {
        let message = refusal(&arguments);
        for word in words {
            assert!(message.contains(word), "{arguments:?}: no {word:?} in {message}");
        }
    }
}

#[test]
fn an_unknown_scenario_is_refused_before_anything_starts() {
    for way in [&["run", "no-such"][..], &["run", "no-such", "--in-process"]] {
        let test_run = TestRun::new("nosuch");
        let output = test_run.command("cz").args(way).output().unwrap();
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains("no-such") && message.contains("two-merges"), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
        test_run.assert_clean();
    }
}

#[test]
fn json_to_a_file_goes_with_the_table_and_json_to_stdout_alone() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("summary.json");
    let short = ["run", "--in-process", "--set", "end.vehicles=5"];
    let table = stdout(&[&short[..], &["--json", path.to_str().unwrap()]].concat());
    let json: Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    let hash = json["state_hash"].as_str().unwrap();
    for word in ["two-merges", "merge-1", "merge-2", "objective", "step latency", hash] {
        assert!(table.contains(word), "no {word:?} in {table}");
    }
    assert_eq!(
        crate::common::hash(
            &serde_json::from_str(&stdout(&[&short[..], &["--json", "-"]].concat())).unwrap()
        ),
        hash
    );
    assert!(stdout(&short).contains(hash));

    let nowhere = directory.path().join("none").join("summary.json");
    let output = cz(&short).arg("--json").arg(&nowhere).assert().code(2).get_output().clone();
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(message.contains("cannot write") && message.contains("summary.json"), "{message}");
}

#[test]
fn the_seed_and_the_settings_reach_every_process() {
    let test_run = TestRun::new("set");
    let arguments = ["tree", "--seed", "9", "--set", "end.time_s=200", "--set=control.replan=from_state"];
    let in_process = test_run.summary(&[&arguments[..], &["--in-process"]].concat());
    let processes = test_run.summary(&arguments);
    assert_eq!(in_process["seed"], 9);
    assert_eq!(in_process["steps"], 2000);
    assert_eq!(crate::common::hash(&in_process), crate::common::hash(&processes));
    let other = test_run.summary(&["tree", "--seed", "9", "--set", "end.time_s=200", "--in-process"]);
    assert_ne!(
        crate::common::hash(&in_process),
        crate::common::hash(&other),
        "from_state drives differently"
    );
    test_run.assert_clean();
}

#[test]
fn a_scenario_file_may_be_anywhere() {
    let test_run = TestRun::new("file");
    let directory = tempfile::tempdir().unwrap();
    let text = include_str!("../../scenarios/tree.toml").replace("until_s = 600.0", "until_s = 60.0");
    let path = directory.path().join("my tree.toml");
    std::fs::write(&path, text).unwrap();
    let path = path.to_str().unwrap();
    let (processes, in_process) = (test_run.summary(&[path]), test_run.summary(&[path, "--in-process"]));
    assert_eq!(crate::common::hash(&processes), crate::common::hash(&in_process));
    test_run.assert_clean();
}

#[test]
fn bench_says_what_to_install_where_sumo_is_missing() {
    for python in ["/bin/false", "/no/such/python"] {
        let output = cz(&["bench", "scale", "--quick", "--with-sumo"])
            .env("CZ_PYTHON", python)
            .assert()
            .code(2)
            .get_output()
            .clone();
        let message = String::from_utf8(output.stderr).unwrap();
        for word in [python, "eclipse-sumo", "pip install", "CZ_PYTHON"] {
            assert!(message.contains(word), "no {word:?} in {message}");
        }
    }
}
