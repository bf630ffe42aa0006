//! The same scenario and seed give the same states, however the work is spread over processes.

use crate::common::{TestRun, begin, hash, is_alive, part, send, wait_until};
use control_zones::record::{Reader, Writer};
use rustix::process::Signal;
use serde_json::Value;
use std::path::Path;
use std::sync::Mutex;

/// State hashes of in-process runs, by scenario, for the seeds 1 to 3.
///
/// When they differ from what a run gives, something that decides where vehicles drive has changed: the
/// law, the coordinators, the world, the arrivals, the layout of the state record, or an embedded scenario.
const GOLDEN: [(&str, [&str; 3]); 10] = [
    ("two-merges", ["6062d4276bac3bb5", "8537653cd0596222", "060e0376e9ea30a3"]),
    ("paper", ["b56ea7e351b4a6a2", "204eba1f547116eb", "58b2783c8587e258"]),
    ("varying-demand", ["67d94661f45bbf64", "58778c46844a111e", "640ffabf3c9e3402"]),
    ("corridor-8", ["f0c18c1290689264", "991904c97437a28f", "5901e5f90c42bf9d"]),
    ("tree", ["b5580754fa221eb4", "c89773ff58da6ea9", "ee493af4c5cc09b6"]),
    ("intersection", ["4709c787e0bd4a2d", "b5b69ad2ee3a2846", "21678e1dce4c481c"]),
    ("roundabout", ["7c559057265e8f02", "f5a3348062abef64", "35591a6ddc9f9f95"]),
    ("lane-drop", ["b89e99c310d7b39e", "8ea8d167aff4ca13", "5c231e5a351141b5"]),
    ("mixed-merges", ["e03fa2340ce9bcab", "830869906d59f8ad", "2b20bbe7de43f577"]),
    ("grid-3x3", ["ec4453ac054ac217", "1db962770d04438f", "d3d0594cbbad19dd"]),
];

/// Runs of several processes keep two cores busy: one at a time is faster than two.
static PROCESSES: Mutex<()> = Mutex::new(());

fn run(scenario: &str, seed: u64, arguments: &[&str]) -> Value {
    let seed = seed.to_string();
    let mut all = vec![scenario, "--seed", &seed];
    all.extend(arguments);
    let _alone = PROCESSES.lock();
    let test_run = TestRun::new("h");
    let summary = test_run.summary(&all);
    test_run.assert_clean();
    summary
}

fn check(scenario: &str) {
    let golden = GOLDEN.iter().find(|(name, _)| *name == scenario).unwrap().1;
    for (seed, golden) in (1..=3).zip(golden) {
        let in_process = run(scenario, seed, &["--in-process"]);
        check_keys(&in_process, scenario, seed);
        let expected = hash(&in_process);
        // Every way of sharing out once per scenario; what costs seconds only for the first seed.
        let mut ways: Vec<&[&str]> =
            vec![&["--in-process"], &["--in-process", "--ctrl-procs", "2", "--coord-procs", "2"], &[]];
        if seed == 1 || scenario == "two-merges" {
            ways.extend([
                &["--ctrl-procs", "2"][..],
                &["--coord-procs", "2"],
                &["--ctrl-procs", "2", "--coord-procs", "2"],
                &[],
            ]);
        }
        // No more processes of a role than zones.
        let is_possible = |way: &&[&str]| scenario != "intersection" || !way.contains(&"2");
        for way in ways.into_iter().filter(is_possible) {
            let summary = run(scenario, seed, way);
            check_keys(&summary, scenario, seed);
            assert_eq!(hash(&summary), expected, "{scenario}, seed {seed}, {way:?}");
            // Equal states, equal results.
            for key in ["steps", "zones", "total_objective", "arrived", "departed"] {
                assert_eq!(summary[key], in_process[key], "{scenario}, seed {seed}, {way:?}");
            }
        }
        assert_eq!(
            expected, golden,
            "{scenario}, seed {seed}: vehicles drive differently than before. If that is meant (say why in \
             CHANGELOG), write the new hash into GOLDEN; if nothing of the kind was to change, it is a bug"
        );
    }
}

/// The summary's keys are a contract.
fn check_keys(summary: &Value, scenario: &str, seed: u64) {
    assert_eq!(summary["scenario"], scenario);
    assert_eq!(summary["seed"], seed);
    assert!(matches!(summary["transport"].as_str(), Some("in-process" | "iceoryx2")), "{summary}");
    assert!(summary["processes"].as_u64().is_some_and(|n| n >= 1), "{summary}");
    assert!(summary["steps"].as_u64().is_some_and(|n| n > 100), "{summary}");
    let hash = summary["state_hash"].as_str().unwrap();
    assert!(hash.len() == 16 && u64::from_str_radix(hash, 16).is_ok(), "{summary}");
    for key in ["dt_s", "beta", "wall_s", "total_objective"] {
        assert!(summary[key].as_f64().is_some_and(|x| x > 0.0), "{key}: {summary}");
    }
    let mut before = 0.0;
    for key in ["p50", "p99", "p999", "max"] {
        let latency = summary["step_latency_us"][key].as_f64().unwrap_or_else(|| panic!("{key}: {summary}"));
        assert!(latency >= before && latency > 0.0, "{key}: {summary}");
        before = latency;
    }
    let zones = summary["zones"].as_array().unwrap();
    assert!(!zones.is_empty());
    let mut total = 0.0;
    for zone in zones {
        assert!(zone["zone"].as_str().is_some_and(|name| !name.is_empty()), "{zone}");
        for key in ["vehicles", "fe_vehicles", "infeasible_vehicles"] {
            assert!(zone[key].is_u64(), "{key}: {zone}");
        }
        for key in [
            "mean_time_s",
            "mean_energy",
            "mean_objective",
            "fe_mean_s",
            // `null` where no vehicle had a partner, which happens in none of these scenarios.
            "min_rear_end_margin_m",
            "min_merge_margin_m",
        ] {
            assert!(zone[key].is_f64(), "{key}: {zone}");
        }
        // Waiting outside is time, too.
        let wait_s = zone["mean_wait_s"].as_f64().unwrap();
        total += zone["mean_objective"].as_f64().unwrap() + summary["beta"].as_f64().unwrap() * wait_s;
    }
    assert!((summary["total_objective"].as_f64().unwrap() - total).abs() < 1e-9, "{summary}");
}

/// The scenario of the paper, whatever becomes of the default one.
#[test]
fn paper() {
    check("paper");
}

#[test]
fn two_merges() {
    check("two-merges");
}

#[test]
fn varying_demand() {
    check("varying-demand");
}

#[test]
fn corridor_8() {
    check("corridor-8");
}

/// Human drivers among automated vehicles.
#[test]
fn mixed_merges() {
    check("mixed-merges");
}

#[test]
fn tree() {
    check("tree");
}

#[test]
fn a_process_for_every_zone() {
    // Short, because so many processes on few cores are slow.
    let short = ["--set", "end.time_s=60"];
    let expected = hash(&run("tree", 1, &[&short[..], &["--in-process"]].concat()));
    let every = ["--ctrl-procs", "5", "--coord-procs", "5"];
    for way in [&["--in-process"][..], &[]] {
        assert_eq!(hash(&run("tree", 1, &[&short[..], &every, way].concat())), expected, "{way:?}");
    }
    let every = ["--in-process", "--ctrl-procs", "8", "--coord-procs", "8"];
    let golden = GOLDEN.iter().find(|(name, _)| *name == "corridor-8").unwrap().1;
    assert_eq!(hash(&run("corridor-8", 1, &every)), golden[0]);
}

#[test]
fn the_summary_says_how_the_frames_travelled() {
    let summary = run("two-merges", 1, &["--in-process", "--ctrl-procs", "2"]);
    assert_eq!((&summary["transport"], &summary["processes"]), (&"in-process".into(), &1.into()));
    let summary = run("two-merges", 1, &["--ctrl-procs", "2", "--coord-procs", "2"]);
    assert_eq!((&summary["transport"], &summary["processes"]), (&"iceoryx2".into(), &5.into()));
}
#[test]
fn intersection() {
    check("intersection");
}

#[test]
fn roundabout() {
    check("roundabout");
}

#[test]
fn lane_drop() {
    check("lane-drop");
}

#[test]
fn grid() {
    check("grid-3x3");
}

/// A run long enough to be disturbed in the middle of: the scenario's demand for half an hour.
fn long(scenario: &str) -> Vec<String> {
    let text = std::fs::read_to_string(format!("{}/scenarios/{scenario}.toml", env!("CARGO_MANIFEST_DIR")));
    let table: toml::Table = text.unwrap().parse().unwrap();
    let mut arguments = vec![scenario.to_owned(), "--set".to_owned(), "end.time_s=1800".to_owned()];
    for road in table["roads"].as_array().unwrap() {
        let (name, rates) = (road["name"].as_str().unwrap(), &road["demand"]["rates"]);
        let rate = rates[0]["vehicles_per_hour"].as_float().unwrap();
        let set = format!(
            "roads.{name}.demand.rates=[{{until_s=1800.0,vehicles_per_hour={:?}}}]",
            // The grid is slow enough as it is.
            if scenario == "grid-3x3" { rate / 2.0 } else { rate }
        );
        arguments.extend(["--set".to_owned(), set]);
    }
    arguments
}

fn steps_in(file: &Path) -> u64 {
    Reader::open(file).map_or(0, |reader| reader.steps().map_while(Result::ok).count() as u64)
}

fn cz(test_run: &TestRun, arguments: &[&str]) -> String {
    let output = test_run.command("cz").args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Recorded and replayed, cut off and resumed, branched without a change, and with the controller, the coordinator and
/// the world killed in the middle.
fn check_disturbed(scenario: &str) {
    let _alone = PROCESSES.lock();
    let (test_run, folder) = (TestRun::new("w"), tempfile::tempdir().unwrap());
    let path = |name: &str| folder.path().join(name);
    let arguments = long(scenario);
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let (whole, cut, killed) = (path("whole.czlog"), path("cut.czlog"), path("killed.czlog"));
    let [whole_path, cut_path, killed_path] = [&whole, &cut, &killed].map(|p| p.to_str().unwrap());
    let expected = hash(&test_run.summary(&[&arguments[..], &["--in-process"]].concat()));

    // Processes that are killed are replaced, and it is recorded as if nothing had been.
    let json = ["--json", "-", "--record", whole_path];
    let (supervisor, parts) = begin(&test_run, &[&arguments[..], &json].concat(), 3);
    for (victim, after) in [("ctrl", 500), ("coord", 1500)] {
        wait_until("the run to be under way", || steps_in(&whole) > after);
        let id = part(&parts, victim);
        assert!(is_alive(id), "{scenario}: over before {victim} was killed");
        send(id, Signal::KILL);
    }
    let summary = supervisor.ended().json();
    assert_eq!(hash(&summary), expected, "{scenario}: controller and coordinator killed");
    assert_eq!(summary["replacements"].as_array().unwrap().len(), 2, "{scenario}: {summary}");
    assert!(cz(&test_run, &["replay", whole_path]).contains(&expected), "{scenario}: replay");

    // Cut off in the middle of the file.
    let reader = Reader::open(&whole).unwrap();
    let steps: Vec<_> = reader.steps().map(Result::unwrap).collect();
    let mut writer = Writer::new(std::fs::File::create(&cut).unwrap(), reader.metadata()).unwrap();
    steps[..steps.len() / 3].iter().for_each(|step| writer.append(&step.encode()).unwrap());
    drop(writer);
    let resumed: Value = serde_json::from_str(&cz(&test_run, &["resume", cut_path, "--json", "-"])).unwrap();
    assert_eq!(hash(&resumed), expected, "{scenario}: resumed");

    // Branched with a change that is none.
    let at = (steps.len() / 2).to_string();
    let same = ["branch", whole_path, "--at", &at, "--set", "control.k_merge_per_s=1.0", "--json"];
    let both: Value = serde_json::from_str(&cz(&test_run, &same)).unwrap();
    for side in ["as_recorded", "branched"] {
        let found = format!("{:016x}", both[side]["state_hash"].as_u64().unwrap());
        assert_eq!(found, expected, "{scenario}: {side}");
    }

    // The world killed, and the run resumed.
    let (supervisor, parts) = begin(&test_run, &[&arguments[..], &["--record", killed_path]].concat(), 3);
    wait_until("the run to be under way", || steps_in(&killed) > 800);
    send(part(&parts, "world"), Signal::KILL);
    assert!(!supervisor.ended().status.success(), "{scenario}: over before the world was killed");
    wait_until("the others to end", || parts.iter().all(|(_, id)| !is_alive(*id)));
    let resumed: Value =
        serde_json::from_str(&cz(&test_run, &["resume", killed_path, "--json", "-"])).unwrap();
    assert_eq!(hash(&resumed), expected, "{scenario}: resumed after the world was killed");
    cz(&test_run, &["clean"]);
    test_run.assert_clean();
}

#[test]
fn a_disturbed_intersection() {
    check_disturbed("intersection");
}

#[test]
fn a_disturbed_roundabout() {
    check_disturbed("roundabout");
}

#[test]
fn a_disturbed_lane_drop() {
    check_disturbed("lane-drop");
}

#[test]
fn a_disturbed_grid() {
    check_disturbed("grid-3x3");
}
