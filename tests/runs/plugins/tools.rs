//! What authors of controllers work with: `cz plugin replay`, `cz plugin new`, what a controller is shown beside states.

use super::{beside, cz, installed, python, root, rust};
use crate::common::{TestRun, hash};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

/// Records a minute of a run in which a command drives merge-2.
fn recorded(command: &str, file: &Path) {
    let test_run = TestRun::new("tools");
    let controller = format!("merge-2={command}");
    let more = ["--set", "end.time_s=60", "--shield", "on", "--record", file.to_str().unwrap()];
    test_run
        .start("cz", &[&["--controller", controller.as_str()], &more[..]].concat())
        .ended()
        .expect(0, &[]);
    test_run.assert_clean();
}

fn replayed(file: &Path, arguments: &[&str], command: &[&str]) -> (Output, Value) {
    let mut replay = cz();
    let output =
        replay.args(["plugin", "replay", "--json"]).args(arguments).arg(file).arg("--").args(command);
    let output = output.output().unwrap();
    let report = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
    (output, report)
}

#[test]
fn a_controller_replayed_offline_commands_what_was_recorded_and_another_is_shown_to_differ() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.czlog");
    let cruise = rust("cruise");
    recorded(&cruise, &file);
    let (output, report) = replayed(&file, &[], &[&cruise]);
    assert!(output.status.success(), "{output:?}");
    let count = |report: &Value, key: &str| report[key].as_u64().unwrap_or_else(|| panic!("{key}: {report}"));
    assert_eq!((count(&report, "steps"), count(&report, "differing")), (600, 0), "{report}");
    assert!(count(&report, "commands") > 1000, "{report}");
    // From the middle on it is handed what was in force.
    let (output, late) = replayed(&file, &["--from", "300"], &[&cruise]);
    assert!(output.status.success() && count(&late, "steps") == 300, "{output:?}");
    // Another: the first difference is named with step, vehicle and both values.
    let (output, other) = replayed(&file, &[], &[&rust("broken"), "out-of-range"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let (first, greatest) = (&other["differences"][0], &other["greatest"]);
    assert!(first["u_mps2"] != first["recorded_mps2"] && count(first, "step") > 0, "{other}");
    assert!(first["zone"].as_str().unwrap().starts_with("merge-2."), "{other}");
    let apart = |d: &Value| (d["u_mps2"].as_f64().unwrap() - d["recorded_mps2"].as_f64().unwrap()).abs();
    assert!(other["differences"].as_array().unwrap().iter().all(|d| apart(d) <= apart(greatest)), "{other}");
    let told =
        cz().args(["plugin", "replay"]).arg(&file).args(["--", &rust("broken"), "out-of-range"]).output();
    let told = String::from_utf8(told.unwrap().stdout).unwrap();
    assert!(told.contains(" m/s², recorded ") && told.contains("greatest: step "), "{told}");
    // In the place of the built-in law.
    let (output, law) = replayed(&file, &["--controller", "merge-1"], &[&cruise]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(count(&law, "steps") == 600 && count(&law, "differing") > 100, "{law}");
    for (arguments, words) in [
        (&["--controller", "merge-3"][..], "expected a controller, zones or paths of the recording: merge-2"),
        (&["--from", "9999"], "step 9999 is not in the recording"),
        (&["--tolerance=-1"], "--tolerance -1"),
    ] {
        let (output, _) = replayed(&file, arguments, &[&cruise]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && said.contains(words), "{arguments:?}: {said}");
    }
    let (output, _) = replayed(&file, &[], &["false"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("the controller ended"), "{said}");
}

/// What a command says; it must succeed.
fn said(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{command:?}: {out}{err}");
    format!("{out}{err}")
}

/// A new project, in which `check` says what to run.
fn made(language: &str, folder: &Path, more: &[&str]) -> std::path::PathBuf {
    let directory = folder.join(format!("mine-{language}"));
    let mut new = Command::new(env!("CARGO_BIN_EXE_cz"));
    let told = said(new.args(["plugin", "new", language]).args(more).arg(&directory));
    assert!(told.contains("README.md") && told.contains("cz plugin check -- "), "{told}");
    // What is there is not written over.
    let again = cz().args(["plugin", "new", language]).arg(&directory).assert().code(2).get_output().clone();
    assert!(String::from_utf8_lossy(&again.stderr).contains("is there and not empty"), "{again:?}");
    directory
}

fn keeps_the_contract(directory: &Path, command: &[&str]) {
    let mut check = Command::new(env!("CARGO_BIN_EXE_cz"));
    check.current_dir(directory).args(["plugin", "check", "--deadline-ms", "4000", "--"]).args(command);
    let told = said(&mut check);
    assert!(!told.contains("FAIL") && told.contains("steps answered"), "{told}");
}

#[test]
fn a_new_project_builds_and_keeps_the_contract() {
    installed(); // builds the library
    let folder = tempfile::tempdir().unwrap();
    for language in ["c", "cpp"] {
        let directory = made(language, folder.path(), &[]);
        let flags = if language == "c" { "CFLAGS" } else { "CXXFLAGS" };
        let mut make = Command::new("make");
        make.current_dir(&directory).arg(format!("CZ={}", env!("CARGO_BIN_EXE_cz")));
        said(make.arg(format!("{flags}=-Wall -Wextra -Werror")));
        keeps_the_contract(&directory, &["./controller"]);
    }
    if let Some(python) = python() {
        let directory = made("python", folder.path(), &[]);
        keeps_the_contract(&directory, &[&python, "controller.py"]);
    }
    cz().args(["plugin", "new", "python", "/tmp/1st"]).assert().code(2);
    cz().args(["plugin", "new", "rust", "--sdk", "/nowhere"]).arg(folder.path().join("x")).assert().code(2);
}

/// `cargo test --test runs -- --ignored new_project_in_rust`: it is built against the package of this clone.
#[test]
#[ignore = "builds the package anew"]
fn a_new_project_in_rust_builds_and_keeps_the_contract() {
    let folder = tempfile::tempdir().unwrap();
    let directory = made("rust", folder.path(), &["--sdk", root().to_str().unwrap()]);
    // The same versions as here, without a registry.
    std::fs::copy(root().join("Cargo.lock"), directory.join("Cargo.lock")).unwrap();
    let mut build = Command::new(env!("CARGO"));
    build
        .current_dir(&directory)
        .args(["build", "--offline"])
        .env("CARGO_TARGET_DIR", beside().parent().unwrap());
    said(&mut build);
    let program = beside().join("mine-rust");
    keeps_the_contract(&directory, &[program.to_str().unwrap()]);
}

/// Runs a law in Python for a minute as the controller of merge-2; what it and the run said.
fn driven(python: &str, law: &Path, arguments: &[&str]) -> crate::common::Ended {
    let test_run = TestRun::new("views");
    let controller = format!("merge-2={python} {}", law.display());
    let own = ["--controller", controller.as_str(), "--set", "end.time_s=60"];
    let ended = test_run.start("cz", &[&own[..], arguments].concat()).ended();
    test_run.assert_clean();
    ended
}

#[test]
fn a_controller_is_shown_partners_flags_and_what_became_of_its_last_commands() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("law.py");
    let law = r#"
import control_zones
from control_zones import schemas

seen = dict(partners=0, intents=0, entered=0, bounded=0, frames=0)

class Law:
    def __call__(self, views):
        out = []
        for zone in views:
            assert not zone.missed and zone.skipped == 0
            assert zone.own.sum() == len(zone) and (zone.states["vehicle"][zone.own] == zone.vehicle).all()
            assert len(zone.frame) >= len(zone.states)
            seen["frames"] += len(set(zone.frame["zone"])) > 1
            seen["entered"] += int(zone.entered.sum())
            for partners in zone.partners:
                for p in partners:
                    record = zone.states[p.place]
                    assert record["vehicle"] == p.vehicle and record["planned_exit_time_s"] == p.exit_time
                    seen["partners"] += 1
                    seen["intents"] += p.exit_time > 0
            known = zone.commanded == zone.commanded
            new = zone.entered & known
            assert not new.any(), "nobody is commanded before it comes"
            changed = known & (abs(zone.u - zone.commanded) > 1e-9)
            seen["bounded"] += int(changed.sum())
            for at, told in enumerate(zone.bounded):
                assert (told is not None) == bool(changed[at]), (zone.step, told, zone.u, zone.commanded)
                if told is not None:
                    assert told.greatest == zone.u[at] and told.value == zone.commanded[at] and told.row
            assert zone.refusals == []
            out.append((30.0 - zone.v).clip(-4, 4))
        return out

    def on_end(self, summary):
        print(summary, flush=True)
        print(" ".join(f"{name}={count}" for name, count in seen.items()), flush=True)

control_zones.run(Law(), joint=True)
"#;
    std::fs::write(&path, law).unwrap();
    let ended = driven(&python, &path, &["--shield", "on"]);
    ended.expect(
        0,
        &["merge-2] Summary(step=600, time=60.0", "answered=600, skipped=0, missed=0, refused=0)"],
    );
    let counts =
        ended.err.lines().find(|line| line.contains("partners=")).unwrap_or_else(|| panic!("{ended:?}"));
    // Whoever goes for 30 m/s is bounded now and then.
    for name in ["partners", "entered", "bounded", "frames"] {
        assert!(!counts.contains(&format!("{name}=0")), "{counts}");
    }
    let wrong = "import control_zones\ncontrol_zones.run(lambda views: [1, 2, 3], joint=True)\n";
    std::fs::write(&path, wrong).unwrap();
    let ended = driven(&python, &path, &[]);
    ended.expect(1, &["returned 3 lists; expected "]);
}

#[test]
fn a_program_that_changes_is_started_again_and_the_run_replays() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (path, file) = (folder.path().join("law.py"), folder.path().join("run.czlog"));
    let law = |speed: &str| {
        let body = format!("def law(zone):\n    return ({speed} - zone.v).clip(-4, 4)\n");
        std::fs::write(&path, format!("import control_zones\n{body}control_zones.run(law)\n")).unwrap();
    };
    law("15.0");
    let test_run = TestRun::new("reload");
    let controller = format!("merge-2={python} {}", path.display());
    let own = ["--controller", controller.as_str(), "--reload", "--pace", "realtime", "--set", "dt_s=0.01"];
    let rest = ["--set", "end.time_s=8", "--json", "-", "--record", file.to_str().unwrap()];
    let run = test_run.start("cz", &[&own[..], &rest].concat());
    let says = |words: &str| {
        crate::common::wait_until(words, || run.said_so_far().1.contains(words));
    };
    let steps = || control_zones::record::Reader::open(&file).map_or(0, |r| r.steps().count());
    crate::common::wait_until("the run to be stepping", || steps() > 20);
    std::fs::write(&path, "def law(zone:\n").unwrap();
    says("law.py has changed: controller merge-2 (process ");
    says("it is started again when its program changes");
    law("12.5");
    says("law.py has changed: controller merge-2 is started again");
    let ended = run.ended();
    ended.expect(0, &["SyntaxError"]);
    test_run.assert_clean();
    let summary = ended.json();
    let row = &summary["controllers"][0];
    assert!(row["driven_by"] == "plugin" && row["on_exit"] == "restart" && row["exits"] == 1, "{row}");
    let events = summary["events"].as_array().unwrap();
    let kinds = events.iter().map(|event| event["kind"].as_str().unwrap());
    // On a busy machine some steps are late too.
    assert_eq!(
        kinds.filter(|kind| *kind != "missed").collect::<Vec<_>>(),
        ["exited", "replaced"],
        "{summary}"
    );
    let replayed = cz().arg("replay").arg(&file).arg("--json").output().unwrap();
    let said = String::from_utf8(replayed.stdout).unwrap();
    assert!(replayed.status.success() && said.contains(&hash(&summary)), "{said} {summary}");
    for (command, words) in [("true", "command of controller merge-2, true"), ("./nowhere", "--reload")] {
        let controller = format!("merge-2={command}");
        let run =
            cz().args(["run", "--reload", "--controller", &controller]).assert().code(2).get_output().clone();
        assert!(String::from_utf8_lossy(&run.stderr).contains(words), "{run:?}");
    }
    cz().args(["run", "--reload"]).assert().code(2);
}
