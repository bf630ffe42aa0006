//! The conformance kit names the fault of every broken world, and none of a good one.

mod broken;
use std::process::Command;

/// How this program is told to play a world instead, and with which arguments, one a line.
const MODE: &str = "CZ_TEST_WORLD";
const ARGUMENTS: &str = "CZ_TEST_WORLD_ARGUMENTS";

/// No test: where the others start this program again, it is the world that they check.
#[test]
fn plays_a_world() {
    if let (Ok(mode), Ok(arguments)) = (std::env::var(MODE), std::env::var(ARGUMENTS)) {
        broken::play(&mode, &arguments.lines().map(str::to_owned).collect::<Vec<_>>());
    }
}

/// Exit code and the report.
fn check(mode: &str, more: &[&str]) -> (i32, serde_json::Value) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cz"));
    // Where it hangs, the rest of the run is not worth a long wait.
    let patience = if ["hangs", "never-ends"].contains(&mode) { "4" } else { "30" };
    command.args(["world", "check", "--json", "--patience", patience]).args(more).env(MODE, mode);
    let play = format!(
        "{ARGUMENTS}=$(printf '%s\\n' \"$@\") exec \"$0\" world_check::plays_a_world --exact --nocapture"
    );
    command.args(["--", "sh", "-c", &play]).arg(std::env::current_exe().unwrap());
    let output = command.output().unwrap();
    let code = output.status.code().unwrap();
    (code, serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{mode}: {e}: {output:?}")))
}

#[test]
fn a_good_world_passes() {
    for scenario in ["two-merges", "intersection"] {
        let (code, report) = check("none", &[scenario]);
        assert_eq!((&report["breaches"], code), (&serde_json::json!([]), 0), "{scenario}");
        assert_eq!(report["untried"], serde_json::json!([]), "{scenario}");
        assert!(report["vehicles"].as_u64().unwrap() > 10, "{report:#}");
    }
}

/// Mode, rules it breaks, the step of the first breach (a vehicle may come later than the fault sets in), and words of the diagnosis.
const BROKEN: [(&str, &[&str], Option<u64>, &str); 16] = [
    ("disobeys", &["obedience"], None, "m/s^2, and held"),
    ("euler", &["motion"], None, "expected"),
    ("stops-late", &["motion"], None, "to 0.000 m/s, expected"),
    ("jumps", &["motion"], Some(151), "vehicle 0 came"),
    ("loses", &["kept"], Some(151), "was taken out of"),
    ("creeps", &["standing"], None, "to hold -4.000 m/s^2"),
    ("reverses", &["sound"], Some(151), "has come -1 m"),
    ("no-number", &["sound"], Some(151), "to NaN m/s"),
    ("fails", &["sound"], Some(151), "broken: the road is closed"),
    ("random", &["repeats"], None, "the second time"),
    ("brings-two", &["apart"], Some(151), "came into merge-1 at"),
    ("brings-nobody", &["traffic"], None, "0 vehicles came"),
    ("always-0", &["abandoned", "told"], None, "it ended with code 0"),
    ("ends-badly", &["end"], None, "exit status: 3"),
    ("crashes", &["attach"], Some(0), "SIGABRT"),
    ("never-ends", &["end"], None, "still there 4 s after it"),
];

#[test]
fn broken_worlds_are_diagnosed() {
    let judge = |(mode, rules, step, words): (&str, &[&str], Option<u64>, &str)| {
        let (code, report) = check(mode, &[]);
        let breaches = report["breaches"].as_array().unwrap();
        let find = |rule: &str| breaches.iter().find(|breach| breach["rule"] == rule);
        let first = find(rules[0]).unwrap_or(&serde_json::Value::Null);
        let fits = step.is_none_or(|s| first["step"] == s)
            && first["what"].as_str().is_some_and(|what| what.contains(words));
        let wrong = code != 1 || !fits || !rules.iter().all(|rule| find(rule).is_some());
        wrong.then(|| format!("{mode}: expected {rules:?} at {step:?} with {words:?}, got {report:#}"))
    };
    // What takes long is waiting.
    let wrong: Vec<String> = std::thread::scope(|scope| {
        let checks: Vec<_> = BROKEN.into_iter().map(|one| scope.spawn(move || judge(one))).collect();
        checks.into_iter().filter_map(|check| check.join().unwrap()).collect()
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn a_world_that_hangs_is_diagnosed_and_a_breach_can_be_allowed() {
    let (code, report) = check("hangs", &[]);
    let first = &report["breaches"][0];
    assert_eq!(
        (first["rule"].as_str(), first["step"].as_u64(), code),
        (Some("steps"), Some(151), 1),
        "{report:#}"
    );
    assert!(first["what"].as_str().unwrap().contains("no state of this step within 4 s"), "{report:#}");
    let (code, report) = check("loses", &["--allow", "kept"]);
    assert_eq!((report["breaches"][0]["rule"].as_str(), code), (Some("kept"), 0), "{report:#}");
}
