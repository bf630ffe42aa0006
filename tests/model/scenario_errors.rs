//! Every bad input gives one message that names place, key path, value found and what was expected.

use control_zones::scenario::{Demand, Override, Scenario, ScenarioError, load, load_embedded, load_file};
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
    (
        "dt_s = 0.1",
        "\"dt\\ns\" = 0.1",
        "s.toml:3: dt\\ns = 0.1: unknown key; expected one of name, seed, dt_s, end, vehicle, objective, control, coordination, gate, shield, fleet, roads, zones, controllers, faults; did you mean dt_s?",
    ),
    (
        "[control]",
        "[[faults.sensors]]\nkind = \"frozen\"\nposition_m = 2\n[control]",
        "s.toml:12: faults.sensors.0.position_m = 2: unknown key; expected one of kind, zones, paths, fraction, from_s, until_s",
    ),
    (
        "[control]",
        "[faults]\nnoise = { position_sd_m = 0.5, speed_sd_mps = \"low\" }\n[control]",
        "s.toml:11: faults.noise.speed_sd_mps = \"low\": expected a standard deviation from 0 to 1e6 m/s",
    ),
    (
        "[control]",
        "[[faults.stalls]]\npaths = [\"second.c\"]\n[control]",
        "s.toml:11: faults.stalls.0.paths.0 = \"second.c\": expected one of a, b",
    ),
    (
        "dt_s = 0.1",
        "dt_s = 0.1 0",
        "s.toml:3: not valid TOML: string values must be quoted, expected literal string",
    ),
    ("dt_s = 0.1", "dt_s = 0.1\ndt_s = 0.2", "s.toml:4: not valid TOML: duplicate key"),
    (
        "dt_s = 0.1",
        "dts = 0.1",
        "s.toml:3: dts = 0.1: unknown key; expected one of name, seed, dt_s, end, vehicle, objective, control, coordination, gate, shield, fleet, roads, zones, controllers, faults; did you mean dt_s?",
    ),
    (
        "dt_s = 0.1",
        "dt_s = \"fast\"",
        "s.toml:3: dt_s = \"fast\": expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = 0",
        "s.toml:3: dt_s = 0: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = -0.1",
        "s.toml:3: dt_s = -0.1: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = nan",
        "s.toml:3: dt_s = nan: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = inf",
        "s.toml:3: dt_s = inf: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = 1e999",
        "s.toml:3: dt_s = 1e999: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = 0.3333333333333333",
        "s.toml:3: dt_s = 0.3333333333333333: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "dt_s = 0.1",
        "dt_s = 1979-05-27",
        "s.toml:3: dt_s = 1979-05-27: expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "name = \"base\"\n",
        "",
        "s.toml:1: name: missing key; expected a name of 1 to 64 letters, digits, '_' or '-'",
    ),
    (
        "name = \"base\"",
        "name = \"a b\"",
        "s.toml:1: name = \"a b\": expected a name of 1 to 64 letters, digits, '_' or '-'",
    ),
    ("seed = 1", "seed = -1", "s.toml:2: seed = -1: expected an integer from 0 to 2^64 - 1"),
    ("seed = 1", "seed = 1.5", "s.toml:2: seed = 1.5: expected an integer from 0 to 2^64 - 1"),
    ("vehicles = 10", "vehicles = 0", "s.toml:5: end.vehicles = 0: expected an integer from 1 to 4294967295"),
    (
        "vehicles = 10",
        "vehicles = 5000000000",
        "s.toml:5: end.vehicles = 5000000000: expected an integer from 1 to 4294967295",
    ),
    (
        "vehicles = 10",
        "time_s = 0.01",
        "s.toml:5: end.time_s = 0.01: expected a time from dt_s = 0.1 to 1e8 s",
    ),
    (
        "v_max_mps = 30",
        "v_max_mps = 0",
        "s.toml:7: vehicle.v_max_mps = 0: expected a speed from 0.1 to 1000 m/s, > v_min_mps = 0",
    ),
    (
        "v_max_mps = 30",
        "v_min_mps = -1",
        "s.toml:7: vehicle.v_min_mps = -1: expected a speed from 0 to 1000 m/s",
    ),
    (
        "v_max_mps = 30",
        "v_min_mps = 30",
        "s.toml:6: vehicle.v_max_mps: missing key; expected a speed from 0.1 to 1000 m/s, > v_min_mps = 30 (the default 30 is not)",
    ),
    (
        "v_max_mps = 30",
        "u_min_mps2 = 0",
        "s.toml:7: vehicle.u_min_mps2 = 0: expected an acceleration from -100 to -0.01 m/s^2",
    ),
    (
        "v_max_mps = 30",
        "u_max_mps2 = -4",
        "s.toml:7: vehicle.u_max_mps2 = -4: expected an acceleration from 0.01 to 100 m/s^2",
    ),
    (
        "v_max_mps = 30",
        "v_max = 30",
        "s.toml:7: vehicle.v_max = 30: unknown key; expected one of u_min_mps2, u_max_mps2, v_min_mps, v_max_mps, length_m, reaction_time_s, standstill_gap_m; did you mean v_max_mps?",
    ),
    (
        "beta = 0.5\n",
        "",
        "s.toml:8: objective.beta: missing key; expected a weight from 1e-6 to 1e6 m^2/s^4, or alpha instead",
    ),
    ("beta = 0.5", "beta = 0", "s.toml:9: objective.beta = 0: expected a weight from 1e-6 to 1e6 m^2/s^4"),
    (
        "beta = 0.5",
        "alpha = 0.5\nbeta = 0.5",
        "s.toml:10: objective.beta = 0.5: alpha is given as well; expected either alpha or beta",
    ),
    ("beta = 0.5", "alpha = 1", "s.toml:9: objective.alpha = 1: expected a weight with 0 < alpha < 1"),
    (
        "k_merge_per_s = 1",
        "k_merge_per_s = 0",
        "s.toml:11: control.k_merge_per_s = 0: expected a gain from 1e-6 to 1e6 1/s",
    ),
    (
        "k_merge_per_s = 1",
        "slack_weight = -1",
        "s.toml:11: control.slack_weight = -1: expected 0, or a weight from 1e-6 to 1e6 m^2/s^4",
    ),
    (
        "k_merge_per_s = 1",
        "reference = \"printed\"",
        "s.toml:11: control.reference = \"printed\": expected \"corrected\" or \"as_printed\"",
    ),
    ("k_merge_per_s = 1", "clf = 1", "s.toml:11: control.clf = 1: expected true or false"),
    (
        "k_merge_per_s = 1",
        "fe_fraction = 1.5",
        "s.toml:11: control.fe_fraction = 1.5: expected a fraction with 0 < fe_fraction <= 1",
    ),
    (
        "name = \"north\"",
        "name = \"west\"",
        "s.toml:16: roads.west.name = \"west\": used twice; expected a name no other road has",
    ),
    (
        "name = \"north\"",
        "name = 7",
        "s.toml:16: roads.1.name = 7: expected a name of 1 to 64 letters, digits, '_' or '-'",
    ),
    (
        "demand = { trace = \"arrivals.csv\" }\n",
        "",
        "s.toml:12: roads.west.demand: missing key; expected a table with trace = \"FILE.csv\", or with rates and the other keys of random arrivals",
    ),
    (
        "demand = { trace = \"arrivals.csv\" }",
        "demand = {}",
        "s.toml:14: roads.west.demand.trace: missing key; expected trace = \"FILE.csv\", or rates = [...]",
    ),
    (
        "demand = { trace = \"arrivals.csv\" }",
        "demand = \"arrivals.csv\"",
        "s.toml:14: roads.west.demand = \"arrivals.csv\": expected a table with trace = \"FILE.csv\", or with rates and the other keys of random arrivals",
    ),
    (
        "{ trace = \"arrivals.csv\" }",
        "{ trace = \"missing.csv\" }",
        "s.toml:14: roads.west.demand.trace = \"missing.csv\": cannot read missing.csv: No such file or directory (os error 2); expected an arrival trace",
    ),
    (
        "{ trace = \"arrivals.csv\" }",
        "{ trace = \"arrivals_{seed}.csv\" }",
        "s.toml:14: roads.west.demand.trace = \"arrivals_{seed}.csv\": cannot read arrivals_1.csv: No such file or directory (os error 2); expected an arrival trace for seed 1",
    ),
    (
        "{ trace = \"arrivals.csv\" }",
        "{ trace = \"arrivals.csv\", speed_sd_mps = 1 }",
        "s.toml:14: roads.west.demand.speed_sd_mps = 1: unknown key; expected only trace",
    ),
    (
        "min_headway_s = 1.2",
        "min_headway_s = 1.2\ntrace = \"arrivals.csv\"",
        "s.toml:18: roads.north.demand.rates = [{...}]: trace is given as well; expected either trace or rates",
    ),
    (
        "min_headway_s = 1.2",
        "min_headway_s = 20",
        "s.toml:18: roads.north.demand.rates.1.vehicles_per_hour = 200: the mean headway would be 18.000 s, within min_headway_s = 20; expected a rate < 180.0 veh/h",
    ),
    (
        "until_s = 20",
        "until_s = 10",
        "s.toml:18: roads.north.demand.rates.1.until_s = 10: expected an instant > 10 s, the end of the period before, and <= 1e9 s",
    ),
    (
        "vehicles_per_hour = 200",
        "vehicles_per_hour = -200",
        "s.toml:18: roads.north.demand.rates.1.vehicles_per_hour = -200: expected a rate with 0 <= rate <= 36000 veh/h",
    ),
    (
        "rates = [{ until_s = 10, vehicles_per_hour = 100 }, { until_s = 20, vehicles_per_hour = 200 }]",
        "rates = []",
        "s.toml:18: roads.north.demand.rates = []: expected a list of {until_s = TIME, vehicles_per_hour = RATE}",
    ),
    (
        "speed_mean_mps = 16",
        "speed_mean_mps = 9",
        "s.toml:20: roads.north.demand.speed_mean_mps = 9: expected a speed from speed_min_mps = 10 to speed_max_mps = 20 m/s",
    ),
    (
        "speed_sd_mps = 1",
        "speed_sd_mps = 11",
        "s.toml:21: roads.north.demand.speed_sd_mps = 11: expected a speed from 0 to speed_max_mps - speed_min_mps = 10 m/s",
    ),
    (
        "speed_max_mps = 20",
        "speed_max_mps = 31",
        "s.toml:23: roads.north.demand.speed_max_mps = 31: expected a speed from speed_min_mps = 10 to v_max_mps = 30 m/s",
    ),
    (
        "policy = \"feedback\"",
        "policy = \"feedbak\"",
        "s.toml:26: zones.first.flow.policy = \"feedbak\": expected \"none\" or \"fixed\" or \"feedback\" or \"mean_speed\" or \"predicted\"",
    ),
    (
        "policy = \"feedback\"",
        "plicy = \"feedback\"",
        "s.toml:26: zones.first.flow.plicy = \"feedback\": unknown key; expected one of policy, terminal_mps, baseline_mps, baseline_entry_speeds_mps, gain_mps, segment_m, min_mps, offset_mps; did you mean policy?",
    ),
    (
        "baseline_mps = 18",
        "baseline_mps = \"best\"",
        "s.toml:26: zones.first.flow.baseline_mps = \"best\": expected a speed from 0.01 to 1000 m/s and <= v_max_mps = 30, or \"optimal\"",
    ),
    (
        "baseline_mps = 18",
        "baseline_mps = \"optimal\", baseline_entry_speeds_mps = [15, 0]",
        "s.toml:26: zones.first.flow.baseline_entry_speeds_mps.1 = 0: expected a speed from 0.01 to 1000 m/s and <= v_max_mps = 30",
    ),
    (
        "baseline_mps = 18",
        "baseline_mps = 18, baseline_entry_speeds_mps = [15]",
        "s.toml:26: zones.first.flow.baseline_entry_speeds_mps = [15]: baseline_mps is 18; expected it only with \"optimal\"",
    ),
    (
        "gain_mps = 0.5",
        "gain_mps = -0.5",
        "s.toml:26: zones.first.flow.gain_mps = -0.5: expected a gain from 0 to 1000 m/s per vehicle",
    ),
    (
        "segment_m = 50",
        "segment_m = 151",
        "s.toml:26: zones.first.flow.segment_m = 151: expected a length with 0 < l <= 150 m, the longest path of the zone downstream, second",
    ),
    (
        "policy = \"fixed\", terminal_mps = 15",
        "policy = \"feedback\", baseline_mps = 18, gain_mps = 1",
        "s.toml:33: zones.second.flow.policy = \"feedback\": the zone's exit leads out of the network, there is nothing to observe; expected \"none\" or \"fixed\"",
    ),
    (
        "policy = \"fixed\", terminal_mps = 15",
        "policy = \"fixed\"",
        "s.toml:33: zones.second.flow.terminal_mps: missing key; expected a speed from 0.01 to 1000 m/s and <= v_max_mps = 30",
    ),
    (
        "policy = \"fixed\", terminal_mps = 15",
        "policy = \"fixed\", terminal_mps = 15, gain_mps = 1",
        "s.toml:33: zones.second.flow.gain_mps = 1: unknown key; expected one of policy, terminal_mps",
    ),
    (
        "terminal_mps = 15",
        "terminal_mps = 31",
        "s.toml:33: zones.second.flow.terminal_mps = 31: expected a speed from 0.01 to 1000 m/s and <= v_max_mps = 30",
    ),
    (
        "length_m = 200",
        "length_m = -200",
        "s.toml:29: zones.first.approaches.a.length_m = -200: expected a length from 1 to 1e6 m, >= 3 m = v_max_mps * dt_s, so that a vehicle passes at most one boundary per step",
    ),
    (
        "length_m = 200",
        "length_m = 2.9",
        "s.toml:29: zones.first.approaches.a.length_m = 2.9: expected a length from 1 to 1e6 m, >= 3 m = v_max_mps * dt_s, so that a vehicle passes at most one boundary per step",
    ),
    (
        "length_m = 200",
        "length_m = \"200 m\"",
        "s.toml:29: zones.first.approaches.a.length_m = \"200 m\": expected a length from 1 to 1e6 m, >= 3 m = v_max_mps * dt_s, so that a vehicle passes at most one boundary per step",
    ),
    (
        "length_m = 200",
        "lenght_m = 200",
        "s.toml:29: zones.first.approaches.a.lenght_m = 200: unknown key; expected one of name, length_m, road, zone, exit, link_m, link_speed_mps; did you mean length_m?",
    ),
    (
        "link_m = 40",
        "link_m = 1",
        "s.toml:38: zones.second.approaches.a.link_m = 1: expected 0, or a length from 1 to 1e6 m, >= 3 m = v_max_mps * dt_s, so that a vehicle passes at most one boundary per step",
    ),
    (
        "road = \"north\"",
        "road = \"nort\"",
        "s.toml:42: zones.second.approaches.b.road = \"nort\": unknown road; expected the name of a road: west, north; did you mean north?",
    ),
    (
        "road = \"north\"",
        "road = \"west\"",
        "s.toml:42: zones.second.approaches.b.road = \"west\": zones.first.approaches.a.road uses this road already; expected a road that nothing else uses",
    ),
    (
        "road = \"north\"",
        "zone = \"first\"",
        "s.toml:42: zones.second.approaches.b.zone = \"first\": zones.second.approaches.a.zone claims the exit of this zone already; expected a zone whose exit leads nowhere else",
    ),
    (
        "road = \"north\"",
        "zone = \"third\"",
        "s.toml:42: zones.second.approaches.b.zone = \"third\": unknown zone; expected the name of a zone: first, second",
    ),
    (
        "road = \"north\"",
        "zone = \"second\"",
        "s.toml:42: zones.second.approaches.b.zone = \"second\": cycle in the network: second -> second; expected zones without a cycle",
    ),
    (
        "road = \"north\"\n",
        "",
        "s.toml:39: zones.second.approaches.b.road: missing key; expected a source: road = \"NAME\", or zone = \"NAME\" upstream",
    ),
    (
        "road = \"north\"",
        "road = \"north\"\nzone = \"first\"",
        "s.toml:43: zones.second.approaches.b.zone = \"first\": road is given as well; expected one source, either road or zone",
    ),
    (
        "road = \"north\"",
        "road = \"north\"\nlink_m = 10",
        "s.toml:43: zones.second.approaches.b.link_m = 10: the source is a road; expected link_m only with zone",
    ),
    (
        "[[zones.approaches]]\nname = \"b\"\nlength_m = 100\nroad = \"north\"\n",
        "",
        "s.toml:16: roads.north.name = \"north\": no zone uses this road; expected a zone with this road as a source",
    ),
    (
        "road = \"west\"",
        "zone = \"second\"",
        "s.toml:37: zones.second.approaches.a.zone = \"first\": cycle in the network: first -> second -> first; expected zones without a cycle",
    ),
    (
        "name = \"b\"",
        "name = \"a\"",
        "s.toml:40: zones.second.approaches.a.name = \"a\": used twice; expected a name no other approach of the zone has",
    ),
    (
        "name = \"second\"",
        "name = \"first\"",
        "s.toml:32: zones.first.name = \"first\": used twice; expected a name no other zone has",
    ),
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
    // Whatever characters there are, a message has one line.
    (
        "control.replan=from\nstate",
        "--set control.replan=from\\nstate: control.replan = \"from\\nstate\": expected \"from_entry\" or \"from_state\"",
    ),
    (
        "end.ti\nme_s=1",
        "--set end.ti\\nme_s=1: end.ti\\nme_s = 1: unknown key; expected one of vehicles, time_s; did you mean time_s?",
    ),
    (
        "zones.fi\r\nrst.flow=1",
        "--set zones.fi\\r\\nrst.flow=1: zones has no element fi\\r\\nrst; expected first, second, or an index from 0 to 1; did you mean first?",
    ),
    ("a\u{1b}[2J", "--set a\\u{1b}[2J: no '='; expected key=value"),
    (
        "faults.nose={}",
        "--set faults.nose={}: faults.nose = {...}: unknown key; expected one of noise, sensors, commands, stalls; did you mean noise?",
    ),
    ("faults=all", "--set faults=all: faults = \"all\": expected a table"),
    (
        "faults.noise=1",
        "--set faults.noise=1: faults.noise = 1: expected a table such as {position_sd_m = 0.5}",
    ),
    (
        "faults.noise={}",
        "--set faults.noise={}: faults.noise.position_sd_m: missing key; expected a standard deviation in m, or speed_sd_mps instead",
    ),
    (
        "faults.noise.speed_sd_mps=-0.1",
        "--set faults.noise.speed_sd_mps=-0.1: faults.noise.speed_sd_mps = -0.1: expected a standard deviation from 0 to 1e6 m/s",
    ),
    (
        "faults.noise.position_sd_m=nan",
        "--set faults.noise.position_sd_m=nan: faults.noise.position_sd_m = nan: expected a standard deviation from 0 to 1e6 m",
    ),
    (
        "faults.commands={}",
        "--set faults.commands={}: faults.commands.loss: missing key; expected a probability from 0 to 1, or delay_steps instead",
    ),
    (
        "faults.commands.loss=1.5",
        "--set faults.commands.loss=1.5: faults.commands.loss = 1.5: expected a probability from 0 to 1",
    ),
    (
        "faults.commands.delay_probability=0.5",
        "--set faults.commands.delay_probability=0.5: faults.commands.delay_steps: missing key; expected an integer from 1 to 1000",
    ),
    (
        "faults.commands.delay_steps=0",
        "--set faults.commands.delay_steps=0: faults.commands.delay_steps = 0: expected an integer from 1 to 1000",
    ),
    (
        "faults.commands.delay_steps=1001",
        "--set faults.commands.delay_steps=1001: faults.commands.delay_steps = 1001: expected an integer from 1 to 1000",
    ),
    (
        "faults.sensors=[]",
        "--set faults.sensors=[]: faults.sensors = []: expected a list of tables such as {kind = \"frozen\"}",
    ),
    (
        "faults.sensors=[{}]",
        "--set faults.sensors=[{}]: faults.sensors.0.kind: missing key; expected \"bias\" or \"frozen\"",
    ),
    (
        "faults.sensors=[{kind=\"stuck\"}]",
        "--set faults.sensors=[{kind=\"stuck\"}]: faults.sensors.0.kind = \"stuck\": expected \"bias\" or \"frozen\"",
    ),
    (
        "faults.sensors=[{kind=\"bias\"}]",
        "--set faults.sensors=[{kind=\"bias\"}]: faults.sensors.0.position_m: missing key; expected what is added to the position in m, or speed_mps instead",
    ),
    (
        "faults.stalls=[{fraction=0}]",
        "--set faults.stalls=[{fraction=0}]: faults.stalls.0.fraction = 0: expected a fraction with 0 < fraction <= 1",
    ),
    (
        "faults.stalls=[{from_s=5,until_s=5}]",
        "--set faults.stalls=[{from_s=5,until_s=5}]: faults.stalls.0.until_s = 5: expected a time > from_s = 5 and at most 1e9 s",
    ),
    (
        "faults.stalls=[{from_s=-1}]",
        "--set faults.stalls=[{from_s=-1}]: faults.stalls.0.from_s = -1: expected a time from 0 to below 1e9 s",
    ),
    (
        "faults.stalls=[{zones=[\"frist\"]}]",
        "--set faults.stalls=[{zones=[\"frist\"]}]: faults.stalls.0.zones.0 = \"frist\": expected one of first, second; did you mean first?",
    ),
    (
        "faults.stalls=[{zones=[\"second\"],paths=[\"second.b\"]}]",
        "--set faults.stalls=[{zones=[\"second\"],paths=[\"second.b\"]}]: faults.stalls.0.paths = [\"second.b\"]: a path is named twice; expected each once",
    ),
    ("dt_s", "--set dt_s: no '='; expected key=value"),
    ("=1", "--set =1: empty key; expected a dotted key such as end.vehicles"),
    ("end..vehicles=1", "--set end..vehicles=1: empty key; expected a dotted key such as end.vehicles"),
    (
        "objective={beta=1",
        "--set objective={beta=1: not valid TOML: unclosed inline table, expected `}`; expected a TOML value",
    ),
    ("dt_s=0", "--set dt_s=0: dt_s = 0: expected a step from 1e-4 to 10 s, a whole number of nanoseconds"),
    (
        "dt_s=0.1s",
        "--set dt_s=0.1s: dt_s = \"0.1s\": expected a step from 1e-4 to 10 s, a whole number of nanoseconds",
    ),
    (
        "gate.entry=closed",
        "--set gate.entry=closed: gate.entry = \"closed\": expected \"free\" or \"viable\" or \"room_to_stop\"",
    ),
    ("control.law=best", "--set control.law=best: control.law = \"best\": expected \"ocbf\" or \"viable\""),
    (
        "control.viable.buffer_m=-1",
        "--set control.viable.buffer_m=-1: control.viable.buffer_m = -1: expected a gap from 0 to 1000 m",
    ),
    (
        "dt=0.1",
        "--set dt=0.1: dt = 0.1: unknown key; expected one of name, seed, dt_s, end, vehicle, objective, control, coordination, gate, shield, fleet, roads, zones, controllers, faults; did you mean dt_s?",
    ),
    (
        "network.size=3",
        "--set network.size=3: network = {...}: unknown key; expected one of name, seed, dt_s, end, vehicle, objective, control, coordination, gate, shield, fleet, roads, zones, controllers, faults",
    ),
    (
        "control.replan=from_stat",
        "--set control.replan=from_stat: control.replan = \"from_stat\": expected \"from_entry\" or \"from_state\"",
    ),
    (
        "zones.frist.flow.policy=none",
        "--set zones.frist.flow.policy=none: zones has no element frist; expected first, second, or an index from 0 to 1; did you mean first?",
    ),
    (
        "zones.2.flow.policy=none",
        "--set zones.2.flow.policy=none: zones has no element 2; expected first, second, or an index from 0 to 1",
    ),
    (
        "zones.first.flow.terminal_mps=15",
        "--set zones.first.flow.terminal_mps=15: zones.first.flow.terminal_mps = 15: unknown key; expected one of policy, baseline_mps, baseline_entry_speeds_mps, gain_mps, segment_m, min_mps; did you mean min_mps?",
    ),
    (
        "zones.first.flow.policy=fixed",
        "--set zones.first.flow.policy=fixed: zones.first.flow.terminal_mps: missing key; expected a speed from 0.01 to 1000 m/s and <= v_max_mps = 30",
    ),
    (
        "zones.first.flow={policy=\"fixed\",terminal_mps=-15}",
        "--set zones.first.flow={policy=\"fixed\",terminal_mps=-15}: zones.first.flow.terminal_mps = -15: expected a speed from 0.01 to 1000 m/s and <= v_max_mps = 30",
    ),
    (
        "zones.second.flow={policy=\"mean_speed\",offset_mps=1,gain_mps=1,segment_m=50}",
        "--set zones.second.flow={policy=\"mean_speed\",offset_mps=1,gain_mps=1,segment_m=50}: zones.second.flow.policy = \"mean_speed\": the zone's exit leads out of the network, there is nothing to observe; expected \"none\" or \"fixed\"",
    ),
    (
        "zones.second.approaches.b.length_m=1",
        "--set zones.second.approaches.b.length_m=1: zones.second.approaches.b.length_m = 1: expected a length from 1 to 1e6 m, >= 3 m = v_max_mps * dt_s, so that a vehicle passes at most one boundary per step",
    ),
    ("dt_s.x=1", "--set dt_s.x=1: dt_s = 0.1: has no keys; expected a table"),
    (
        "roads.west.demand.trace=none.csv",
        "--set roads.west.demand.trace=none.csv: roads.west.demand.trace = \"none.csv\": cannot read none.csv: No such file or directory (os error 2); expected an arrival trace",
    ),
    (
        "objective.alpha=2",
        "--set objective.alpha=2: objective.alpha = 2: expected a weight with 0 < alpha < 1",
    ),
    ("zones=[]", "--set zones=[]: zones = []: expected a list of zones, at least one"),
    (
        "roads.west.demand.rates=[{until_s=1,vehicles_per_hour=1}]",
        "--set roads.west.demand.rates=[{until_s=1,vehicles_per_hour=1}]: roads.west.demand.min_headway_s: missing key; expected a time from 0 to 1e6 s",
    ),
    (
        "zones.first.approaches.a.zone=second",
        "--set zones.first.approaches.a.zone=second: zones.first.approaches.a.zone = \"second\": cycle in the network: first -> second -> first; expected zones without a cycle",
    ),
    (
        "zones.second.approaches.b.zone=second",
        "--set zones.second.approaches.b.zone=second: zones.second.approaches.b.zone = \"second\": cycle in the network: second -> second; expected zones without a cycle",
    ),
    (
        "a.a.a.a.a.a.a.a.a.a.a.a.a.a.a.a.a=1",
        "--set a.a.a.a.a.a.a.a.a.a.a.a.a.a.a.a.a=1: expected a key of at most 16 parts",
    ),
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
    ("", "arrivals.csv:1: an empty file: expected the header time_s,road,speed_mps"),
    ("time,road,speed\n", "arrivals.csv:1: \"time,road,speed\": expected the header time_s,road,speed_mps"),
    (
        "time_s,road,speed_mps\n0,west,15\n1,west\n",
        "arrivals.csv:3: \"1,west\": expected three columns, time_s,road,speed_mps",
    ),
    (
        "time_s,road,speed_mps\n0,west,15\n\n1,west,15,4\n",
        "arrivals.csv:4: \"1,west,15,4\": expected three columns, time_s,road,speed_mps",
    ),
    (
        "time_s,road,speed_mps\n0,west,15\n1,west,fast\n",
        "arrivals.csv:3: speed_mps = \"fast\": expected a speed within the vehicles' 0 to 30 m/s",
    ),
    (
        "time_s,road,speed_mps\n0,west,15\n1;5,west,15\n",
        "arrivals.csv:3: time_s = \"1;5\": expected an instant from 0 to 1e9 s",
    ),
    (
        "time_s,road,speed_mps\nnan,west,15\n",
        "arrivals.csv:2: time_s = \"nan\": expected an instant from 0 to 1e9 s",
    ),
    (
        "time_s,road,speed_mps\n-1,west,15\n",
        "arrivals.csv:2: time_s = \"-1\": expected an instant from 0 to 1e9 s",
    ),
    (
        "time_s,road,speed_mps\n2,west,15\n1.5,north,15\n",
        "arrivals.csv:3: time_s = \"1.5\": out of order; expected an instant >= 2 s, that of the row before",
    ),
    (
        "time_s,road,speed_mps\n0,wset,15\n",
        "arrivals.csv:2: road = \"wset\": unknown road; expected one of west, north; did you mean west?",
    ),
    (
        "time_s,road,speed_mps\n0,west,31\n",
        "arrivals.csv:2: speed_mps = \"31\": expected a speed within the vehicles' 0 to 30 m/s",
    ),
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
        "two-merge: no such scenario; expected one of two-merges, paper, varying-demand, corridor-8, tree, \
         faulty-sensors, intersection, roundabout, lane-drop, grid-3x3, mixed-merges, or the path of a TOML file; did you mean two-merges?"
    );
    for path in ["nowhere/two-merges", "nowhere.toml"] {
        let message = error(load(Some(path), &[], None));
        assert!(message.starts_with(&format!("{path}: cannot read the scenario file: ")), "{message}");
    }
    let set = "roads.main1.demand.trace=arrivals-{seed}.csv".parse().unwrap();
    let message = error(load(None, &[set], Some(7)));
    assert!(message.contains("roads.main1.demand.trace = \"arrivals-{seed}.csv\""), "{message}");
    assert!(
        message.contains(
            "expected an arrival trace for seed 7: a file, or one of the embedded sumo-400-1 to -23, "
        ),
        "{message}"
    );
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("s.toml"), b"\xff").unwrap();
    assert!(error(load_file(&dir.path().join("s.toml"), &[], None)).contains("cannot read"));
}

/// The default scenario used to refuse every seed above 3: it has three traces.
#[test]
fn every_seed_runs_and_those_with_a_trace_have_it() {
    let demand = |name: &str, seed: u64, sets: &[&str]| {
        let sets: Vec<_> = sets.iter().map(|s| s.parse().unwrap()).collect();
        load(Some(name), &sets, Some(seed)).unwrap().network.roads.remove(0).demand
    };
    for name in ["two-merges", "faulty-sensors"] {
        for seed in 1..=3 {
            let path = format!("roads.main1.demand={{trace=\"sumo-400-{seed}\"}}");
            let demand = (demand(name, seed, &[]), demand(name, 9, &[&path]));
            assert!(matches!(&demand.0, Demand::Trace(arrivals) if arrivals.len() > 30));
            assert_eq!(demand.0, demand.1);
        }
        for seed in [0, 4, 77, u64::MAX] {
            assert!(matches!(demand(name, seed, &[]), Demand::Poisson(_)), "{name} {seed}");
        }
    }
    // A trace by name whatever the seed, and random arrivals where a trace would have been.
    let named = demand("two-merges", 77, &["roads.main1.demand.trace=sumo-400-2"]);
    assert_eq!(named, demand("two-merges", 2, &[]));
    let random = demand("two-merges", 1, &["roads.main1.demand.speed_mean_mps=15"]);
    assert!(matches!(random, Demand::Poisson(p) if p.speed.mean_mps == 15.0));
    let error = |set: &str| load(None, &[set.parse().unwrap()], None).unwrap_err().to_string();
    let message = error("roads.main1.demand.trace_seeds=[1,-2]");
    assert!(message.contains("trace_seeds.1 = -2: expected a list of seeds, integers from 0"), "{message}");
    let message = error("roads.main1.demand={trace=\"sumo-400-1\",trace_seeds=[1]}");
    assert!(message.contains("roads.main1.demand.rates: missing key; expected trace and rates"), "{message}");
}

/// Crossings, and what is to be kept clear: a line of the junction, its replacement, and the message.
const CROSSING_CASES: &[(&str, &str, &str)] = &[
    (
        "at = { across = 10, on = [12, 15.5] }",
        "at = { across = 10, on = [12, 12.05] }",
        "s.toml:25: zones.junction.crossings.c.at.on.1 = 12.05: expected the area's end: a length from 0.1 to 1000 m behind its beginning",
    ),
    (
        "at = { across = 10, on = [12, 15.5] }",
        "at = { across = 10, on = [31, 35] }",
        "s.toml:25: zones.junction.crossings.c.at.on.0 = 31: expected a distance from 0 to 30 m, the segment's length",
    ),
    (
        "at = { across = 10, on = [12, 15.5] }",
        "at = { across = 10, on = [1, 2, 3] }",
        "s.toml:25: zones.junction.crossings.c.at.on = [1, 2, 3]: expected a distance from 0 to 30 m, the segment's length, or two \
         between which the area is",
    ),
    (
        "length_m = 4, at",
        "at",
        "s.toml:25: zones.junction.crossings.c.length_m: missing key; expected a length from 0.1 to 1000 m",
    ),
    (
        "road = \"west\" }",
        "road = \"west\", keep_clear = true }",
        "s.toml:15: zones.junction.segments.west.keep_clear = true: expected a segment that is no entrance: vehicles wait before it",
    ),
    (
        "keep_clear = true },",
        "keep_clear = 1 },",
        "s.toml:17: zones.junction.segments.on.keep_clear = 1: expected true or false",
    ),
];

#[test]
fn bad_crossings() {
    let junction = "[[zones]]\nname = \"junction\"\nsegments = [\n{ name = \"west\", length_m = 150, road = \"west\" },\n\
                    { name = \"north\", length_m = 150, road = \"north\" },\n\
                    { name = \"on\", length_m = 30, keep_clear = true },\n{ name = \"across\", length_m = 30 },\n]\npaths = [\n\
                    { name = \"w\", segments = [\"west\", \"across\"], exit = \"e\" },\n\
                    { name = \"n\", segments = [\"north\", \"on\"], exit = \"s\" },\n]\n\
                    crossings = [\n{ name = \"c\", length_m = 4, at = { across = 10, on = [12, 15.5] } },\n]\n";
    let (head, rest) = BASE.split_once("[[roads]]").unwrap();
    let roads = format!("[[roads]]{}", rest.split_once("[[zones]]").unwrap().0);
    let text = format!("{head}{junction}{roads}");
    assert_eq!(Dir::new(&text, TRACE).message(&[], None), "no error");
    check(CROSSING_CASES.iter().map(|(from, to, expected)| {
        assert!(text.contains(from), "{from}");
        let message = Dir::new(&text.replacen(from, to, 1), TRACE).message(&[], None);
        (format!("{from} -> {to}"), message, (*expected).to_owned())
    }));
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
    use control_zones::scenario::{Baseline, Demand, FlowPolicy, Observed, Replan};
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
        assert_eq!(with(sets).network.zones[0].exits[0].flow, fixed, "{sets:?}");
    }
    let feedback = with(&["zones.first.flow.baseline_mps=optimal"]).network.zones[0].exits[0].flow.clone();
    let FlowPolicy::Feedback { baseline: Baseline::Optimal(speeds), segment, min_mps, .. } = feedback else {
        panic!("{feedback:?}")
    };
    assert_eq!((speeds.len(), speeds[0], speeds[10]), (11, 10.0, 20.0));
    assert_eq!((segment, min_mps), (Observed::First(50.0), 5.0));
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
fn faults_are_read_with_their_defaults() {
    use control_zones::scenario::{
        CommandFaults, Faults, Noise, Scope, SensorFault, SensorKind, Span, Stall,
    };
    assert_eq!(with(&[]).faults, None);
    assert_eq!(with(&["faults={}"]).faults, None);
    let whole = Span { from_s: 0.0, until_s: 1e9 };
    let everybody = Scope { paths: None, fraction: 1.0 };
    let faults = with(&[
        "faults.noise.speed_sd_mps=0.2",
        "faults.commands.delay_steps=2",
        "faults.sensors=[{kind=\"frozen\"},{kind=\"bias\",speed_mps=-1,fraction=0.5,zones=[\"second\"]}]",
        "faults.stalls=[{from_s=1,until_s=2.5,paths=[\"second.b\",\"first.a\"]}]",
    ]);
    let expected = Faults {
        noise: Some(Noise { position_sd_m: 0.0, speed_sd_mps: 0.2, span: whole }),
        sensors: vec![
            SensorFault { kind: SensorKind::Frozen, scope: everybody, span: whole },
            SensorFault {
                kind: SensorKind::Bias { position_m: 0.0, speed_mps: -1.0 },
                scope: Scope { paths: Some(vec![(1, 0), (1, 1)]), fraction: 0.5 },
                span: whole,
            },
        ],
        commands: Some(CommandFaults { loss: 0.0, delay_steps: 2, delay_probability: 1.0, span: whole }),
        stalls: vec![Stall {
            scope: Scope { paths: Some(vec![(0, 0), (1, 1)]), fraction: 1.0 },
            span: Span { from_s: 1.0, until_s: 2.5 },
        }],
    };
    assert_eq!(faults.faults, Some(expected));
    assert_eq!(faults.check(), Ok(()));
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
