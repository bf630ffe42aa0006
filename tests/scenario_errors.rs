//! Every bad input gives one message that names place, key path, value found and what was expected.

use control_zones::scenario::{Override, Scenario, ScenarioError, load, load_embedded, load_file};
use std::fs;
use std::path::{Path, PathBuf};

/// A small valid scenario; the cases break one line each.
const BASE: &str = r#"name = "base"
seed = 1
dt_s = 0.1
[end]
vehicles = 10
[vehicle]
v_max_mps = 30
[objective]
beta = 0.5
[control]
k_merge_per_s = 1
[[roads]]
name = "west"
demand = { trace = "arrivals.csv" }
[[roads]]
name = "north"
[roads.demand]
rates = [{ until_s = 10, vehicles_per_hour = 100 }, { until_s = 20, vehicles_per_hour = 200 }]
min_headway_s = 1.2
speed_mean_mps = 16
speed_sd_mps = 1
speed_min_mps = 10
speed_max_mps = 20
[[zones]]
name = "first"
flow = { policy = "feedback", baseline_mps = 18, gain_mps = 0.5, segment_m = 50 }
[[zones.approaches]]
name = "a"
length_m = 200
road = "west"
[[zones]]
name = "second"
flow = { policy = "fixed", terminal_mps = 15 }
[[zones.approaches]]
name = "a"
length_m = 150
zone = "first"
link_m = 40
[[zones.approaches]]
name = "b"
length_m = 100
road = "north"
"#;

const TRACE: &str = "time_s,road,speed_mps\n0.0,west,15\n2.5,north,14\n2.5,west,16\n";

struct Dir(tempfile::TempDir);

impl Dir {
    fn new(scenario: &str, trace: &str) -> Self {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("s.toml"), scenario).unwrap();
        fs::write(dir.path().join("arrivals.csv"), trace).unwrap();
        Self(dir)
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("s.toml")
    }

    /// Loads and gives the message without the directory.
    fn message(&self, sets: &[&str], seed: Option<u64>) -> String {
        let result = sets
            .iter()
            .map(|s| s.parse())
            .collect::<Result<Vec<Override>, ScenarioError>>()
            .and_then(|sets| load_file(&self.path(), &sets, seed));
        match result {
            Ok(_) => "no error".to_owned(),
            Err(e) => e.to_string().replace(&format!("{}/", self.0.path().display()), ""),
        }
    }
}

fn set(text: &str) -> Override {
    text.parse().unwrap()
}

fn with(sets: &[&str]) -> Scenario {
    let sets: Vec<Override> = sets.iter().map(|s| set(s)).collect();
    load_file(&Dir::new(BASE, TRACE).path(), &sets, None).unwrap()
}

/// Runs a table of cases and reports all that differ.
fn check(cases: impl IntoIterator<Item = (String, String, String)>) {
    let wrong: Vec<String> = cases
        .into_iter()
        .filter(|(_, got, expected)| got != expected)
        .map(|(case, got, expected)| format!("{case}\n  got      {got}\n  expected {expected}"))
        .collect();
    assert!(wrong.is_empty(), "{} cases:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn the_base_is_valid() {
    assert_eq!(Dir::new(BASE, TRACE).message(&[], None), "no error");
}

/// Text of the base, its replacement, and the message.
const FILE_CASES: &[(&str, &str, &str)] = &[
    //FILE
    ("dt_s = 0.1", "dt_s = 0.1 0", ""),
    ("dt_s = 0.1", "dt_s = 0.1\ndt_s = 0.2", ""),
    ("dt_s = 0.1", "dts = 0.1", ""),
    ("dt_s = 0.1", "dt_s = \"fast\"", ""),
    ("dt_s = 0.1", "dt_s = 0", ""),
    ("dt_s = 0.1", "dt_s = -0.1", ""),
    ("dt_s = 0.1", "dt_s = nan", ""),
    ("dt_s = 0.1", "dt_s = inf", ""),
    ("dt_s = 0.1", "dt_s = 1e999", ""),
    ("dt_s = 0.1", "dt_s = 0.3333333333333333", ""),
    ("dt_s = 0.1", "dt_s = 1979-05-27", ""),
    ("name = \"base\"\n", "", ""),
    ("name = \"base\"", "name = \"a b\"", ""),
    ("seed = 1", "seed = -1", ""),
    ("seed = 1", "seed = 1.5", ""),
    ("vehicles = 10", "vehicles = 0", ""),
    ("vehicles = 10", "vehicles = 5000000000", ""),
    ("vehicles = 10", "time_s = 0.01", ""),
    ("v_max_mps = 30", "v_max_mps = 0", ""),
    ("v_max_mps = 30", "v_min_mps = -1", ""),
    ("v_max_mps = 30", "v_min_mps = 30", ""),
    ("v_max_mps = 30", "u_min_mps2 = 0", ""),
    ("v_max_mps = 30", "u_max_mps2 = -4", ""),
    ("v_max_mps = 30", "v_max = 30", ""),
    ("beta = 0.5\n", "", ""),
    ("beta = 0.5", "beta = 0", ""),
    ("beta = 0.5", "alpha = 0.5\nbeta = 0.5", ""),
    ("beta = 0.5", "alpha = 1", ""),
    ("k_merge_per_s = 1", "k_merge_per_s = 0", ""),
    ("k_merge_per_s = 1", "slack_weight = -1", ""),
    ("k_merge_per_s = 1", "reference = \"printed\"", ""),
    ("k_merge_per_s = 1", "clf = 1", ""),
    ("k_merge_per_s = 1", "fe_fraction = 1.5", ""),
    ("name = \"north\"", "name = \"west\"", ""),
    ("name = \"north\"", "name = 7", ""),
    ("demand = { trace = \"arrivals.csv\" }\n", "", ""),
    ("demand = { trace = \"arrivals.csv\" }", "demand = {}", ""),
    ("demand = { trace = \"arrivals.csv\" }", "demand = \"arrivals.csv\"", ""),
    ("{ trace = \"arrivals.csv\" }", "{ trace = \"missing.csv\" }", ""),
    ("{ trace = \"arrivals.csv\" }", "{ trace = \"arrivals_{seed}.csv\" }", ""),
    ("{ trace = \"arrivals.csv\" }", "{ trace = \"arrivals.csv\", speed_sd_mps = 1 }", ""),
    ("min_headway_s = 1.2", "min_headway_s = 1.2\ntrace = \"arrivals.csv\"", ""),
    ("min_headway_s = 1.2", "min_headway_s = 20", ""),
    ("until_s = 20", "until_s = 10", ""),
    ("vehicles_per_hour = 200", "vehicles_per_hour = -200", ""),
    (
        "rates = [{ until_s = 10, vehicles_per_hour = 100 }, { until_s = 20, vehicles_per_hour = 200 }]",
        "rates = []",
        "",
    ),
    ("speed_mean_mps = 16", "speed_mean_mps = 9", ""),
    ("speed_sd_mps = 1", "speed_sd_mps = 11", ""),
    ("speed_max_mps = 20", "speed_max_mps = 31", ""),
    ("policy = \"feedback\"", "policy = \"feedbak\"", ""),
    ("policy = \"feedback\"", "plicy = \"feedback\"", ""),
    ("baseline_mps = 18", "baseline_mps = \"best\"", ""),
    ("baseline_mps = 18", "baseline_mps = \"optimal\", baseline_entry_speeds_mps = [15, 0]", ""),
    ("baseline_mps = 18", "baseline_mps = 18, baseline_entry_speeds_mps = [15]", ""),
    ("gain_mps = 0.5", "gain_mps = -0.5", ""),
    ("segment_m = 50", "segment_m = 151", ""),
    ("policy = \"fixed\", terminal_mps = 15", "policy = \"feedback\", baseline_mps = 18, gain_mps = 1", ""),
    ("policy = \"fixed\", terminal_mps = 15", "policy = \"fixed\"", ""),
    ("policy = \"fixed\", terminal_mps = 15", "policy = \"fixed\", terminal_mps = 15, gain_mps = 1", ""),
    ("terminal_mps = 15", "terminal_mps = 31", ""),
    ("length_m = 200", "length_m = -200", ""),
    ("length_m = 200", "length_m = 2.9", ""),
    ("length_m = 200", "length_m = \"200 m\"", ""),
    ("length_m = 200", "lenght_m = 200", ""),
    ("link_m = 40", "link_m = 1", ""),
    ("road = \"north\"", "road = \"nort\"", ""),
    ("road = \"north\"", "road = \"west\"", ""),
    ("road = \"north\"", "zone = \"first\"", ""),
    ("road = \"north\"", "zone = \"third\"", ""),
    ("road = \"north\"", "zone = \"second\"", ""),
    ("road = \"north\"\n", "", ""),
    ("road = \"north\"", "road = \"north\"\nzone = \"first\"", ""),
    ("road = \"north\"", "road = \"north\"\nlink_m = 10", ""),
    ("[[zones.approaches]]\nname = \"b\"\nlength_m = 100\nroad = \"north\"\n", "", ""),
    ("road = \"west\"", "zone = \"second\"", ""),
    ("name = \"b\"", "name = \"a\"", ""),
    ("name = \"second\"", "name = \"first\"", ""),
    //END
];

#[test]
fn bad_files() {
    check(FILE_CASES.iter().map(|(from, to, expected)| {
        assert!(BASE.contains(from), "{from}");
        let message = Dir::new(&BASE.replacen(from, to, 1), TRACE).message(&[], None);
        (format!("{from} -> {to}"), message, (*expected).to_owned())
    }));
}

/// What follows `--set`, and the message.
const SET_CASES: &[(&str, &str)] = &[
    //SET
    ("dt_s", ""),
    ("=1", ""),
    ("end..vehicles=1", ""),
    ("objective={beta=1", ""),
    ("dt_s=0", ""),
    ("dt_s=0.1s", ""),
    ("dt=0.1", ""),
    ("network.size=3", ""),
    ("control.replan=from_stat", ""),
    ("zones.frist.flow.policy=none", ""),
    ("zones.2.flow.policy=none", ""),
    ("zones.first.flow.terminal_mps=15", ""),
    ("zones.first.flow.policy=fixed", ""),
    ("zones.first.flow={policy=\"fixed\",terminal_mps=-15}", ""),
    ("zones.second.flow={policy=\"mean_speed\",offset_mps=1,gain_mps=1,segment_m=50}", ""),
    ("zones.second.approaches.b.length_m=1", ""),
    ("dt_s.x=1", ""),
    ("roads.west.demand.trace=none.csv", ""),
    ("objective.alpha=2", ""),
    ("zones=[]", ""),
    ("roads.west.demand.rates=[{until_s=1,vehicles_per_hour=1}]", ""),
    ("zones.first.approaches.a.zone=second", ""),
    ("zones.second.approaches.b.zone=second", ""),
    ("a.a.a.a.a.a.a.a.a.a.a.a.a.a.a.a.a=1", ""),
    //END
];

#[test]
fn bad_sets() {
    let dir = Dir::new(BASE, TRACE);
    check(
        SET_CASES
            .iter()
            .map(|(set, expected)| ((*set).to_owned(), dir.message(&[set], None), (*expected).to_owned())),
    );
}

/// A trace, and the message.
const TRACE_CASES: &[(&str, &str)] = &[
    //TRACE
    ("", ""),
    ("time,road,speed\n", ""),
    ("time_s,road,speed_mps\n0,west,15\n1,west\n", ""),
    ("time_s,road,speed_mps\n0,west,15\n\n1,west,15,4\n", ""),
    ("time_s,road,speed_mps\n0,west,15\n1,west,fast\n", ""),
    ("time_s,road,speed_mps\n0,west,15\n1;5,west,15\n", ""),
    ("time_s,road,speed_mps\nnan,west,15\n", ""),
    ("time_s,road,speed_mps\n-1,west,15\n", ""),
    ("time_s,road,speed_mps\n2,west,15\n1.5,north,15\n", ""),
    ("time_s,road,speed_mps\n0,wset,15\n", ""),
    ("time_s,road,speed_mps\n0,west,31\n", ""),
    //END
];

#[test]
fn bad_traces() {
    check(TRACE_CASES.iter().map(|(trace, expected)| {
        ((*trace).to_owned(), Dir::new(BASE, trace).message(&[], None), (*expected).to_owned())
    }));
    let dir = Dir::new(BASE, "");
    fs::write(dir.0.path().join("arrivals.csv"), b"time_s,road,speed_mps\n0,\xff,1\n").unwrap();
    let message = dir.message(&[], None);
    assert!(message.starts_with("arrivals.csv:2: ") && message.contains("UTF-8"), "{message}");
}

#[test]
fn missing_scenarios_and_seeds() {
    let error = |r: Result<Scenario, ScenarioError>| r.unwrap_err().to_string();
    assert_eq!(
        error(load(Some("two-merge"), &[], None)),
        "two-merge: no such scenario; expected one of two-merges, varying-demand, corridor-8, tree, or the path \
         of a TOML file; did you mean two-merges?"
    );
    for path in ["nowhere/two-merges", "nowhere.toml"] {
        let message = error(load(Some(path), &[], None));
        assert!(message.starts_with(&format!("{path}: cannot read the scenario file: ")), "{message}");
    }
    let message = error(load(None, &[], Some(7)));
    assert!(message.starts_with("<embedded>/two-merges.toml:"), "{message}");
    assert!(message.contains("roads.main1.demand.trace = \"data/arrivals_400_seed{seed}.csv\""), "{message}");
    assert!(message.contains("expected an arrival trace for seed 7"), "{message}");
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("s.toml"), b"\xff").unwrap();
    assert!(error(load_file(&dir.path().join("s.toml"), &[], None)).contains("cannot read"));
}

#[test]
fn a_cycle_is_named() {
    let zone = |name: &str, from: &str| {
        format!(
            "[[zones]]\nname = \"{name}\"\n[[zones.approaches]]\nname = \"x\"\nlength_m = 50\nzone = \"{from}\"\n"
        )
    };
    let cycle = zone("p", "r") + &zone("q", "p") + &zone("r", "q");
    let message = Dir::new(&(BASE.to_owned() + &cycle), TRACE).message(&[], None);
    assert_eq!(
        message,
        "s.toml:54: zones.q.approaches.x.zone = \"p\": cycle in the network: p -> q -> r -> p; expected zones \
         without a cycle"
    );
}

#[test]
fn counts_fit_16_bits() {
    let roads: String =
        (0..65_536).map(|i| format!("[[roads]]\nname = \"r{i}\"\ndemand = {{ trace = \"x\" }}\n")).collect();
    let text = BASE.replacen("[[roads]]", &(roads + "[[roads]]"), 1);
    assert_eq!(
        Dir::new(&text, TRACE).message(&[], None),
        "s.toml:196618: roads.r65535.name = \"r65535\": too many; expected at most 65535 road entries"
    );
}

#[test]
fn sets_reach_what_they_name() {
    use control_zones::scenario::{Baseline, Demand, FlowPolicy, Replan, Segment};
    assert_eq!(with(&["control.replan=from_state"]).control.replan, Replan::FromState);
    assert_eq!(with(&["control.replan=\"from_state\""]).control.replan, Replan::FromState);
    assert_eq!(with(&["end={vehicles=3}"]).max_vehicles, Some(3));
    // The last one of a key counts, and a new table may be built from parts.
    assert_eq!(with(&["seed=3", "seed=4"]).seed, 4);
    let fixed = FlowPolicy::Fixed { terminal_mps: 12.0 };
    for sets in [
        &["zones.first.flow.policy=fixed", "zones.first.flow.terminal_mps=12"][..],
        &["zones.first.flow.terminal_mps=12", "zones.0.flow.policy=fixed"],
        &["zones.first.flow={policy=\"fixed\",terminal_mps=12}"],
    ] {
        assert_eq!(with(sets).network.zones[0].flow, fixed, "{sets:?}");
    }
    let feedback = with(&["zones.first.flow.baseline_mps=optimal"]).network.zones[0].flow.clone();
    let FlowPolicy::Feedback { baseline: Baseline::Optimal(speeds), segment, min_mps, .. } = feedback else {
        panic!("{feedback:?}")
    };
    assert_eq!((speeds.len(), speeds[0], speeds[10]), (11, 10.0, 20.0));
    assert_eq!((segment, min_mps), (Segment::First(50.0), 5.0));
    // alpha in place of the file's beta; a trace in place of the file's rates.
    assert_eq!(with(&["objective.alpha=0.0625"]).beta, 8.0 / 15.0);
    let Demand::Trace(rows) = &with(&["roads.north.demand.trace=arrivals.csv"]).network.roads[1].demand
    else {
        panic!("not a trace")
    };
    assert_eq!(rows.len(), 1);
    // --seed goes before both.
    let sets = [set("seed=3")];
    assert_eq!(load_embedded("tree", &sets, Some(9)).unwrap().seed, 9);
    assert_eq!(load_embedded("tree", &sets, None).unwrap().seed, 3);
    assert_eq!(load_embedded("tree", &[], Some(u64::MAX)).unwrap().seed, u64::MAX);
}

#[test]
fn files_and_embedded_scenarios_agree() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios");
    for name in control_zones::scenario::embedded_names() {
        for seed in 1..=3 {
            let embedded = load_embedded(name, &[], Some(seed)).unwrap();
            let file = load_file(&root.join(format!("{name}.toml")), &[], Some(seed)).unwrap();
            assert_eq!(embedded, file);
        }
    }
    assert_eq!(load(None, &[], None).unwrap(), load(Some("two-merges"), &[], None).unwrap());
}
