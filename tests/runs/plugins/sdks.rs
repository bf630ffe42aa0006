//! What the packages promise their users, in every language.

use super::{compiled, cz, installed, python, root, rust};
use crate::common::{Ended, TestRun, hash};
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::load;
use ipc_schemas::STATE_LEFT;
use serde_json::Value;
use std::collections::HashMap;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

/// The same controller in all languages there are: name and command line.
fn in_every_language(folder: &Path) -> Vec<(&'static str, String)> {
    let fixtures = root().join("tests/fixtures");
    let mut all = vec![("Rust", rust("pauses")), ("C", compiled(&fixtures.join("pauses.c"), folder))];
    all.extend(
        python().map(|python| ("Python", format!("{python} {}", fixtures.join("pauses.py").display()))),
    );
    all
}

/// Runs zone 2 with that controller; the run's summary and what was said on stderr.
fn driven(test_run: &TestRun, command: &str, arguments: &[&str]) -> (Value, Ended) {
    let controller = format!("merge-2={command}");
    let all = [&["--json", "-", "--controller", &controller], arguments].concat();
    let ended = test_run.start("cz", &all).ended_within(Duration::from_secs(240));
    (ended.json(), ended)
}

/// What the controller says at its end: steps answered, skipped, and wrong.
fn counts(ended: &Ended) -> [u64; 3] {
    let said = ended.err.lines().find_map(|line| line.split_once("merge-2] answered ")).map(|(_, said)| said);
    let said = said.unwrap_or_else(|| panic!("{ended:?}"));
    let numbers = said.split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse().ok());
    numbers.collect::<Vec<u64>>().try_into().unwrap()
}

#[test]
fn a_controller_that_pauses_catches_up_in_every_language() {
    let folder = tempfile::tempdir().unwrap();
    for (language, command) in in_every_language(folder.path()) {
        for policy in ["hold", "shield-fallback"] {
            pauses_and_catches_up(language, &format!("CZ_PAUSES=0.1,1 exec {command}"), policy, &[]);
        }
    }
}

/// The same with a minute's pause: `cargo test --test runs -- --ignored a_minute`.
#[test]
#[ignore = "takes several minutes"]
fn a_controller_that_pauses_for_a_minute_catches_up_in_every_language() {
    let folder = tempfile::tempdir().unwrap();
    for (language, command) in in_every_language(folder.path()) {
        let command = format!("CZ_PAUSES=60 exec {command}");
        pauses_and_catches_up(language, &command, "hold", &["--peer-timeout", "100"]);
    }
}

#[test]
fn what_became_of_an_answer_is_told_in_the_same_words_in_every_language() {
    let folder = tempfile::tempdir().unwrap();
    let fixtures = root().join("tests/fixtures");
    let mut all = vec![("Rust", rust("told"))];
    all.extend([("C", "told.c"), ("C++", "told.cpp")].map(|(language, file)| {
        let into = folder.path().join(language);
        std::fs::create_dir(&into).unwrap();
        (language, compiled(&fixtures.join(file), &into))
    }));
    all.extend(python().map(|python| ("Python", format!("{python} {}", fixtures.join("told.py").display()))));
    let told = |ended: &Ended| {
        let lines = ended.err.lines().filter_map(|line| line.split_once("merge-2] told "));
        lines.map(|(_, words)| words.to_owned()).collect::<Vec<_>>()
    };
    let file = folder.path().join("run.czlog");
    let mut first = None;
    for (language, command) in all {
        // The shield says what it would do; the frame that errs is refused, and the run goes on.
        let own = ["--shield", "observe", "--deadline", "0.9", "--on-miss", "hold", "--set", "end.time_s=60"];
        let kept = ["--record", file.to_str().unwrap()];
        let test_run = TestRun::new("told");
        let (_, ended) =
            driven(&test_run, &format!("CZ_ERRS_AT=200 exec {command}"), &[&own[..], &kept].concat());
        test_run.assert_clean();
        ended.expect(0, &["merge-2] refused 1"]);
        let told = told(&ended);
        let is = |line: &&String, words: &str| line.starts_with("step 200: ") && line.contains(words);
        let refusals: Vec<_> = told.iter().filter(|line| is(line, "u_mps2 of")).collect();
        assert!(
            matches!(&refusals[..], [one] if one.ends_with(" is 9, at most 4 allowed")),
            "{language}: {refusals:?}"
        );
        assert!(told.iter().any(|line| line.contains(" by merge toward ")), "{language}: {told:?}");
        match &first {
            None => first = Some(told),
            Some(first) => assert_eq!(&told, first, "{language}"),
        }
    }
    // What it was told is in the recording, and shown again.
    let again = format!("CZ_ERRS_AT=200 exec {}", rust("told"));
    let replay =
        ["plugin", "replay", file.to_str().unwrap(), "--controller", "merge-2", "--", "sh", "-c", &again];
    let output = cz().args(replay).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    let again: Vec<_> = said.lines().filter_map(|line| line.split_once("told ")).map(|(_, l)| l).collect();
    assert_eq!(again, first.unwrap(), "{said}");
}

#[test]
fn an_answer_that_ends_the_run_is_named_to_its_controller() {
    let mut all = vec![rust("told")];
    let fixture = root().join("tests/fixtures/told.py");
    all.extend(python().map(|python| format!("{python} {}", fixture.display())));
    for command in all {
        let test_run = TestRun::new("told-last");
        let controller = format!("merge-2=CZ_ERRS_AT=300 exec {command}");
        let ended = test_run.start("cz", &["--controller", &controller]).ended();
        ended.expect(
            1,
            &["it had refused an answer: step 300: u_mps2 of vehicle ", " is 9, at most 4 allowed"],
        );
        test_run.assert_clean();
    }
}

fn pauses_and_catches_up(language: &str, command: &str, policy: &str, arguments: &[&str]) {
    let test_run = TestRun::new("pause");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.czlog");
    let record = file.to_str().unwrap();
    let conduct = ["--deadline", "0.02", "--on-miss", policy, "--shield", "on", "--record", record];
    // What should fit together is worked out for the order of entry.
    let arguments = [&["--set", "coordination.order=fifo"], arguments].concat();
    let (summary, ended) = driven(&test_run, command, &[&conduct[..], &arguments].concat());
    let [answered, skipped, wrong] = counts(&ended);
    let steps = summary["steps"].as_u64().unwrap();
    let missed = summary["punctuality"]["missed_steps"].as_u64().unwrap();
    println!(
        "{language}, {policy}: {answered} of {steps} steps answered, {skipped} skipped, {missed} missed"
    );
    // The pauses are longer than a deadline, and the controller is heard again after each.
    assert!(skipped > 0 && missed > skipped, "{language}, {policy}: {ended:?}");
    assert!(answered > 2 * 300, "{language}, {policy}: {ended:?}");
    assert!(steps - answered <= missed, "{language}, {policy}: {ended:?}");
    assert_eq!(wrong, 0, "{language}, {policy}: it was shown what does not fit together");
    let replay = cz().args(["replay", record, "--json"]).output().unwrap();
    assert!(replay.status.success(), "{language}, {policy}: {replay:?}");
    test_run.assert_clean();
}

#[test]
fn python_ocbf_drives_as_the_built_in_law() {
    drives_as_the_built_in_law(&["paper"], "merge-2", 1);
}

/// Twelve conflict points, and as many duties per vehicle as it has partners at them.
#[test]
fn python_ocbf_drives_the_intersection_as_the_built_in_law() {
    drives_as_the_built_in_law(&["intersection"], "centre", 0);
}

fn drives_as_the_built_in_law(arguments: &[&str], target: &str, zone: u32) {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let trace = folder.path().join("trace.csv");
    let controller = format!("{target}={python} examples/python/ocbf.py");
    let output = cz()
        .arg("run")
        .args(arguments)
        .args(["--json", "-", "--controller", &controller])
        .env("CZ_TRACE", &trace)
        .assert()
        .success()
        .get_output()
        .clone();
    let written = std::fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(written, 1, "the variable is the example's, and nobody else writes where it says");
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    let mut seen: HashMap<(u64, u32), (f64, f64)> = HashMap::new();
    for line in std::fs::read_to_string(&trace).unwrap().lines() {
        let cells: Vec<&str> = line.split(',').collect();
        let number = |i: usize| cells[i].parse::<f64>().unwrap();
        seen.insert((number(0) as u64, number(1) as u32), (number(2), number(3)));
    }
    let scenario = Arc::new(load(arguments.first().copied(), &[], None).unwrap());
    let mut run = InProcess::new(&scenario, 1, 1);
    let (mut compared, mut worst) = (0, 0.0_f64);
    loop {
        let step = run.world().step();
        for s in run.world().records().filter(|s| s.zone == zone && s.flags & STATE_LEFT == 0) {
            // The last state frame ends the run and is not answered, so it is not in the trace.
            let Some((x, v)) = seen.get(&(step, s.vehicle)) else {
                panic!("step {step}: vehicle {} is not in {target} of the other run", s.vehicle);
            };
            worst = worst.max((x - s.x_m).abs()).max((v - s.v_mps).abs());
            compared += 1;
        }
        if !run.step().unwrap() {
            break;
        }
    }
    let ours = &run.world().summary().zones[zone as usize];
    let theirs = summary["zones"][zone as usize]["mean_objective"].as_f64().unwrap();
    println!(
        "{target}: {compared} vehicle-steps, greatest difference {worst:.2e}; objective {theirs} and {}",
        ours.mean_objective
    );
    assert_eq!(compared, seen.len());
    assert!(worst < 1e-6, "{worst}");
    assert!((theirs - ours.mean_objective).abs() < 1e-6, "{theirs} and {}", ours.mean_objective);
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
fn sdk_install_installs_all_it_says_and_otherwise_says_what_to_build() {
    let prefix = installed();
    let output = cz().args(["sdk", "install", "--prefix"]).arg(prefix).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(said.lines().count(), 10, "{said}");
    for file in said.lines() {
        assert!(std::fs::metadata(file).unwrap().len() > 0, "{file} is empty");
    }
    // Beside a program that was copied elsewhere there is no library.
    let elsewhere = tempfile::tempdir().unwrap();
    let program = elsewhere.path().join("cz");
    std::fs::copy(env!("CARGO_BIN_EXE_cz"), &program).unwrap();
    let mut command = Command::new(&program);
    let output =
        command.args(["sdk", "install", "--prefix"]).arg(elsewhere.path().join("to")).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("libcontrol_zones_c.so: "), "{said}");
    assert!(said.contains("cargo build --release -p control-zones-c"), "{said}");
    // A wheel has the shared one in another folder, and not the static one.
    let installed_as = elsewhere.path().join("bin");
    for folder in ["bin", "lib"] {
        std::fs::create_dir(elsewhere.path().join(folder)).unwrap();
    }
    std::fs::rename(&program, installed_as.join("cz")).unwrap();
    let shared = "libcontrol_zones_c.so";
    std::fs::copy(prefix.join("lib").join(shared), elsewhere.path().join("lib").join(shared)).unwrap();
    let mut command = Command::new(installed_as.join("cz"));
    let said = output_of(command.args(["sdk", "install", "--prefix"]).arg(elsewhere.path().join("to")));
    assert_eq!(said.lines().count(), 9, "{said}");
}

/// What a command prints; it must succeed.
fn output_of(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_c_package_may_be_moved_and_programs_ask_for_its_interface_by_version() {
    if Command::new("pkg-config").arg("--version").output().is_err() {
        assert!(std::env::var_os("CI").is_none(), "pkg-config is not installed");
        eprintln!("skipped: pkg-config is not installed");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (before, prefix) = (folder.path().join("before"), folder.path().join("after"));
    installed(); // builds the library
    cz().args(["sdk", "install", "--prefix"]).arg(&before).assert().success();
    std::fs::rename(&before, &prefix).unwrap();
    let flags = |arguments: &[&str]| {
        let mut command = Command::new("pkg-config");
        command.env("PKG_CONFIG_PATH", prefix.join("lib/pkgconfig")).args(arguments).arg("control-zones");
        output_of(&mut command).split_whitespace().map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(flags(&["--modversion"]), [env!("CARGO_PKG_VERSION")]);
    let program = folder.path().join("headway");
    let mut compiler = Command::new("cc");
    compiler.arg(root().join("examples/c/headway.c")).args(flags(&["--cflags", "--libs"]));
    output_of(compiler.args(["-lm", "-o"]).arg(&program));
    // It finds the library where it is now, and says itself that it was not started by a run.
    let ended = Command::new(&program).env_remove("CZ_RUN").env_remove("CZ_CONTROLLER").output().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(1) && said.contains("CZ_RUN"), "{ended:?}");
    let needed = output_of(Command::new("readelf").arg("--dynamic").arg(&program));
    let version = env!("CARGO_PKG_VERSION").rsplit_once('.').unwrap().0;
    let name = format!("libcontrol_zones_c.so.{version}]");
    assert!(needed.lines().any(|line| line.contains("NEEDED") && line.contains(&name)), "{needed}");
    let cmake = prefix.join("lib/cmake/control-zones");
    for file in ["control-zones-config.cmake", "control-zones-config-version.cmake"] {
        let text = std::fs::read_to_string(cmake.join(file)).unwrap();
        assert!(text.contains(env!("CARGO_PKG_VERSION")) && !text.contains("@V"), "{file}: {text}");
    }
}

#[test]
fn golden_vectors_are_those_checked_in() {
    let output = cz().args(["plugin", "golden"]).assert().success().get_output().stdout.clone();
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/golden-vectors.json");
    let checked_in = std::fs::read(path).unwrap();
    assert!(output == checked_in, "docs/golden-vectors.json is stale: `cz plugin golden > {path}`");
}

/// The program a document prints: the lines from one that contains `first` on, as far as they begin with
/// `margin`, without it. A line of the margin's own without its last blanks is an empty one.
fn printed(file: &str, margin: &str, first: &str) -> String {
    let text = std::fs::read_to_string(root().join(file)).unwrap();
    let lines = text.lines().skip_while(|line| !(line.starts_with(margin) && line.contains(first)));
    let inside = lines.map_while(|line| match line.strip_prefix(margin) {
        Some(code) => Some(code),
        None => margin.starts_with(line).then_some(""),
    });
    let code: String =
        inside.take_while(|line| !["PY", "```"].contains(line)).map(|l| format!("{l}\n")).collect();
    assert!(code.lines().count() > 4, "{file} prints no program with {first:?} in its first line: {code}");
    code
}

#[test]
fn documented_controllers_run_as_printed_within_limits_and_without_a_shield() {
    let folder = tempfile::tempdir().unwrap();
    let written = |name: &str, code: String| {
        let path = folder.path().join(name);
        std::fs::write(&path, code).unwrap();
        path
    };
    // The documentation of the Rust package prints this example.
    let mut all = vec![("sdk/rust/src/lib.rs", rust("cruise"))];
    for (name, file, margin) in [
        ("printed_c.c", "sdk/include/control_zones/plugin.h", " *     "),
        ("printed_cpp.cpp", "sdk/include/control_zones/plugin.hpp", "//     "),
    ] {
        all.push((file, compiled(&written(name, printed(file, margin, "#include")), folder.path())));
    }
    if let Some(python) = python() {
        for (name, file, margin) in [
            ("docstring.py", "sdk/python/control_zones/__init__.py", "    "),
            ("contract.py", "docs/plugin-contract.md", "    "),
            ("readme.py", "README.md", ""),
        ] {
            let path = written(name, printed(file, margin, "import control_zones"));
            all.push((file, format!("{python} {}", path.display())));
        }
        let example = root().join("examples/python/cruise.py");
        all.push(("examples/python/cruise.py", format!("{python} {}", example.display())));
    }
    let mut hashes = Vec::new();
    for (file, command) in all {
        let test_run = TestRun::new("printed");
        let (summary, _) = driven(&test_run, &command, &["--shield", "off"]);
        hashes.push((file, hash(&summary)));
        test_run.assert_clean();
    }
    // All of them hold 15 m/s.
    assert!(hashes.iter().all(|(_, hash)| *hash == hashes[0].1), "{hashes:?}");
}

#[test]
fn python_arrays_are_read_only_may_be_kept_and_mistakes_are_explained() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let run = |law: &str| {
        let path = folder.path().join("law.py");
        let code = format!("import control_zones\nkept = []\n{law}\ncontrol_zones.run(law)\n");
        std::fs::write(&path, code).unwrap();
        let test_run = TestRun::new("arrays");
        let controller = format!("merge-2={python} {}", path.display());
        let ended = test_run
            .start("cz", &["--controller", &controller, "--set", "end.time_s=60", "--shield", "on"])
            .ended();
        test_run.assert_clean();
        ended
    };
    // Each of these ended the controller with a signal, or changed what it saw, or the next would have seen.
    for (law, step) in [
        ("def law(zone):\n    err = zone.v\n    err -= 15\n    return -err", "zone merge-2"),
        ("def law(zone):\n    zone.ahead_x[:] = 0\n    return zone.u * 0", "zone merge-2"),
        ("def law(zone):\n    gap = zone.ahead_x\n    gap -= zone.x\n    return zone.u * 0", "zone merge-2"),
        ("def law(zone):\n    zone.states['v_mps'] = 3\n    return zone.u * 0", "zone merge-2"),
        ("def law(zone):\n    zone.terminal[:] = 3\n    return zone.u * 0", "zone merge-2"),
    ] {
        let words = "the arrays of a zone are read-only; make one of your own, such as `err = zone.v - 15`";
        run(law).expect(1, &[words, step]);
    }
    let keeps = "def law(zone):\n    kept.append((zone, zone.v, zone.states, zone.commands, zone.v.sum()))\n    \
                 assert all(v.sum() == total and states['v_mps'].size for _, v, states, _, total in kept[-50:])\n    \
                 return (15.0 - zone.v).clip(-4, 4)";
    run(keeps).expect(0, &[]);
    for (law, words) in [
        ("def law(zone):\n    return None", "returned None; expected 1 accelerations, one per vehicle"),
        ("def law(zone):\n    return 1.0", "returned a float; expected 1 accelerations, one per vehicle"),
        ("def law(zone):\n    return [0.0] * 9", "returned 9 accelerations; expected 1 accelerations"),
    ] {
        run(law).expect(1, &[words]);
    }
}
