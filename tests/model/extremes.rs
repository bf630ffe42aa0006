//! Every number of a scenario at the ends of its range and far beyond: it is refused in one line, or the run
//! goes on.

use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{Override, Scenario, load};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;

/// What docs/scenario.md says of a key, and a setting of it with `{}` for the value.
struct Number {
    key: &'static str,
    range: Option<(&'static str, &'static str)>,
    set: &'static str,
}

const fn number(key: &'static str, least: &'static str, greatest: &'static str, set: &'static str) -> Number {
    Number { key, range: Some((least, greatest)), set }
}

/// One whose range depends on other keys.
const fn relative(key: &'static str, set: &'static str) -> Number {
    Number { key, range: None, set }
}

const NUMBERS: [Number; 43] = [
    number("dt_s", "1e-4", "10", "dt_s={}"),
    number("end.vehicles", "1", "4294967295", "end.vehicles={}"),
    relative("end.time_s", "end.time_s={}"),
    relative("seed", "seed={}"),
    number("u_min_mps2", "-100", "-0.01", "vehicle.u_min_mps2={}"),
    number("u_max_mps2", "0.01", "100", "vehicle.u_max_mps2={}"),
    number("v_min_mps", "0", "1000", "vehicle.v_min_mps={}"),
    number("v_max_mps", "0.1", "1000", "vehicle.v_max_mps={}"),
    number("length_m", "0.01", "1000", "vehicle.length_m={}"),
    number("reaction_time_s", "0.001", "100", "vehicle.reaction_time_s={}"),
    number("standstill_gap_m", "0", "1000", "vehicle.standstill_gap_m={}"),
    number("beta", "1e-6", "1e6", "objective.beta={}"),
    relative("alpha", "objective.alpha={}"),
    number("k_rear_end_per_s", "1e-6", "1e6", "control.k_rear_end_per_s={}"),
    number("k_merge_per_s", "1e-6", "1e6", "control.k_merge_per_s={}"),
    number("k_speed_per_s", "1e-6", "1e6", "control.k_speed_per_s={}"),
    number("clf_rate_per_s", "1e-6", "1e6", "control.clf_rate_per_s={}"),
    number("slack_weight", "1e-6", "1e6", "control.slack_weight={}"),
    relative("fe_fraction", "control.fe_fraction={}"),
    number("length_m", "1", "1e6", "zones.merge-1.approaches.main.length_m={}"),
    number("length_m", "1", "1e6", "zones.merge-2.approaches.merge.length_m={}"),
    number("link_m", "1", "1e6", "zones.merge-2.approaches.main.link_m={}"),
    relative("terminal_mps", "zones.merge-2.flow={policy=\"fixed\",terminal_mps={}}"),
    relative("baseline_mps", "zones.merge-1.flow={policy=\"feedback\",baseline_mps={},gain_mps=0.3}"),
    relative(
        "baseline_entry_speeds_mps",
        "zones.merge-1.flow={policy=\"feedback\",baseline_mps=\"optimal\",\
         baseline_entry_speeds_mps=[{}],gain_mps=0.3}",
    ),
    number("gain_mps", "0", "1000", "zones.merge-1.flow={policy=\"feedback\",baseline_mps=18,gain_mps={}}"),
    relative("min_mps", "zones.merge-1.flow.min_mps={}"),
    relative("segment_m", "zones.merge-1.flow.segment_m={}"),
    number(
        "offset_mps",
        "-1000",
        "1000",
        "zones.merge-1.flow={policy=\"mean_speed\",offset_mps={},gain_mps=0.3,segment_m=100}",
    ),
    number("min_headway_s", "0", "1e6", "roads.main1.demand.min_headway_s={}"),
    relative("speed_mean_mps", "roads.main1.demand.speed_mean_mps={}"),
    relative("speed_sd_mps", "roads.main1.demand.speed_sd_mps={}"),
    relative("speed_min_mps", "roads.main1.demand.speed_min_mps={}"),
    relative("speed_max_mps", "roads.main1.demand.speed_max_mps={}"),
    number(
        "vehicles_per_hour",
        "0",
        "36000",
        "roads.main1.demand.rates=[{until_s=100,vehicles_per_hour={}}]",
    ),
    relative("until_s", "roads.main1.demand.rates=[{until_s={},vehicles_per_hour=900}]"),
    relative("position_sd_m", "faults.noise.position_sd_m={}"),
    relative("speed_sd_mps", "faults.noise.speed_sd_mps={}"),
    relative("position_m", "faults.sensors=[{kind=\"bias\",position_m={},speed_mps={}}]"),
    relative("loss", "faults.commands.loss={}"),
    relative("delay_steps", "faults.commands.delay_steps={}"),
    relative("from_s", "faults.stalls=[{from_s={}}]"),
    relative("fraction", "faults.stalls=[{fraction={}}]"),
];

/// Far from what any key is about, or just no number.
const BEYOND: [&str; 20] = [
    "1e300",
    "-1e300",
    "1e-300",
    "-1e-300",
    "5e-324",
    "1e18",
    "-1e18",
    "1e12",
    "1e9",
    "4294967296",
    "9223372036854775807",
    "-9223372036854775808",
    "0",
    "-0.0",
    "-1",
    "1",
    "1e999",
    "inf",
    "-inf",
    "nan",
];

fn with(sets: &[String]) -> Result<Scenario, String> {
    let overrides: Result<Vec<Override>, _> = sets.iter().map(|set| set.parse()).collect();
    let scenario = overrides.and_then(|sets| load(Some("varying-demand"), &sets, None));
    scenario.map_err(|error| error.to_string())
}

fn set(number: &Number, value: &str) -> String {
    number.set.replace("{}", value)
}

/// Refuses in one line that says what was expected, or runs that many steps with numbers as they should be;
/// returns how many vehicle-steps these were.
fn refuse_or_run(sets: &[String], steps: u32) -> Option<u64> {
    let scenario = match with(sets) {
        Ok(scenario) => scenario,
        Err(error) => {
            assert!(error.contains("expected") && !error.contains('\n'), "{sets:?}: {error}");
            return None;
        }
    };
    scenario.check().unwrap_or_else(|fault| panic!("{sets:?}: loaded, but {fault}"));
    let mut run = InProcess::new(&Arc::new(scenario), 1, 1);
    let mut vehicle_steps = 0;
    for step in 0..steps {
        match run.step() {
            Ok(true) => {}
            Ok(false) => break,
            Err(error) => panic!("{sets:?}: step {step}: {error}"),
        }
        for state in run.world().records() {
            let exit = [state.planned_exit_time_s, state.planned_exit_speed_mps];
            let numbers = [&[state.x_m, state.v_mps, state.u_mps2], &exit[..]].concat();
            let is_sound = numbers.iter().all(|x| x.is_finite()) && state.v_mps >= 0.0;
            assert!(is_sound, "{sets:?}: step {step}: {state:?}");
            vehicle_steps += 1;
        }
    }
    Some(vehicle_steps)
}

/// Traffic from the start, for twenty seconds.
fn base() -> Vec<String> {
    let rates = |road| format!("roads.{road}.demand.rates=[{{until_s=100.0,vehicles_per_hour=1200.0}}]");
    let mut sets: Vec<String> = ["main1", "merge1", "merge2"].map(rates).into();
    sets.push("end.time_s=20".to_owned());
    sets
}

#[test]
fn every_number_far_beyond_its_range_is_refused_or_can_be_run() {
    let (mut refused, mut run) = (0, 0);
    for number in &NUMBERS {
        for value in BEYOND {
            let mut sets = base();
            sets.push(set(number, value));
            match refuse_or_run(&sets, 300) {
                Some(_) => run += 1,
                None => refused += 1,
            }
        }
    }
    println!("{refused} refused, {run} run");
    assert!(refused > run && run > 50, "{refused} refused, {run} run");
}

#[test]
fn the_ends_of_every_range_can_be_run_and_what_is_beyond_them_is_refused() {
    let document = include_str!("../../docs/scenario.md");
    for number in &NUMBERS {
        let Some((least, greatest)) = number.range else { continue };
        let words = format!("{least} to {greatest}");
        let documented = document.lines().any(|line| {
            let key = number.key.rsplit('.').next().unwrap();
            line.starts_with('|') && line.contains(&format!("{key}`")) && line.contains(&words)
        });
        assert!(documented, "docs/scenario.md does not say that {} is {words}", number.key);
        let values = [least, greatest].map(|text| text.parse::<f64>().unwrap());
        for (value, beyond) in values.into_iter().zip([-1.0, 1.0]) {
            // Just outside, relative to the size; 0 has only one side that matters.
            let step = if value == 0.0 { 1e-9 } else { value.abs() * 1e-3 };
            let outside = value + beyond * step;
            let sets = [base(), vec![set(number, &format!("{outside:e}"))]].concat();
            assert!(with(&sets).is_err(), "{} = {outside} is beyond {words} and passes", number.key);
        }
        for text in [least, greatest] {
            let sets = [base(), vec![set(number, text)]].concat();
            refuse_or_run(&sets, 400);
        }
    }
}

#[test]
fn numbers_at_the_ends_of_their_ranges_can_be_combined() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let (mut run, mut tried, mut vehicle_steps) = (0, 0, 0);
    while run < 400 {
        tried += 1;
        assert!(tried < 20_000, "only {run} combinations were valid");
        let mut sets = base();
        for number in &NUMBERS {
            let Some((least, greatest)) = number.range else { continue };
            if rng.random_range(0..6) == 0 && number.key != "end.vehicles" {
                sets.push(set(number, [least, greatest].choose(&mut rng).unwrap()));
            }
        }
        let done = refuse_or_run(&sets, 1000);
        run += u32::from(done.is_some());
        vehicle_steps += done.unwrap_or(0);
    }
    println!("{run} of {tried} combinations run, {vehicle_steps} vehicle-steps");
    assert!(vehicle_steps > 50_000, "only {vehicle_steps} vehicle-steps");
}
