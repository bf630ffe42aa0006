//! `cz bench wait`: the ways of waiting beside each other, on a quiet machine and on a busy one.

use super::BenchError;
use super::machine::Machine;
use crate::process::{Outcome, WaitMode};
use serde::Serialize;
use std::process::Child;

/// What to measure, and how.
pub struct WaitingOptions<'a> {
    /// Runs, by name.
    pub scenes: Vec<&'static str>,
    /// Ways of waiting beside each other, the one to be judged first.
    pub sides: Vec<Side>,
    /// Numbers of busy processes.
    pub loads: Vec<usize>,
    /// Runs of each.
    pub repetitions: usize,
    /// Runs of the first command.
    pub first_runs: usize,
    /// Runs a scene with a side.
    pub run: &'a dyn Fn(&str, &Side) -> Result<Timed, BenchError>,
    /// Starts a process that keeps a core busy for as long as this one lives.
    pub start_busy: &'a dyn Fn() -> std::io::Result<Child>,
    /// What `cz run` does without arguments.
    pub run_first: &'a dyn Fn() -> Result<Timed, BenchError>,
}

/// A way of waiting.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Side {
    /// Of this version.
    Mode(WaitMode),
    /// World and coordinator in one process, the controller in another, each on a core of its own and never
    /// asleep: as near to spinning as comes where there is no core for each of three processes.
    TwoSpin,
    /// What another build does by default.
    Beside,
}

/// What a run took.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timed {
    /// Wall time of the stepping, s.
    pub wall_s: f64,
    /// Median of all steps, us.
    pub p50_us: f64,
    /// 99th percentile of all steps, us.
    pub p99_us: f64,
    /// Median of the steps without coordination, after a warm-up, us, where it is known.
    pub steady_p50_us: Option<f64>,
    /// Median of the steps with it, us, where it is known.
    pub event_p50_us: Option<f64>,
    /// State hash at the end.
    pub state_hash: u64,
}

impl From<&Outcome> for Timed {
    fn from(outcome: &Outcome) -> Timed {
        Timed {
            wall_s: outcome.wall_s,
            p50_us: outcome.step_latency_us.p50,
            p99_us: outcome.step_latency_us.p99,
            steady_p50_us: Some(outcome.steady_ns.p50 as f64 / 1e3),
            event_p50_us: Some(outcome.event_ns.p50 as f64 / 1e3),
            state_hash: outcome.world.state_hash,
        }
    }
}

/// One way of waiting in one scene under one load: medians over the repetitions.
#[derive(Clone, Debug, Serialize)]
pub struct WaitingPoint {
    /// Scene.
    pub scene: &'static str,
    /// Busy processes beside it.
    pub busy: usize,
    /// Way of waiting.
    pub side: String,
    /// Wall time of each run, s.
    pub walls_s: Vec<f64>,
    /// The medians.
    #[serde(flatten)]
    pub median: Timed,
    /// `wall_s` by the least of all sides.
    pub wall_ratio: f64,
    /// `steady_p50_us` by the least of all sides.
    pub steady_ratio: Option<f64>,
    /// `event_p50_us` by the least of all sides.
    pub event_ratio: Option<f64>,
}

/// The results; the JSON keys are a contract.
#[derive(Clone, Debug, Serialize)]
pub struct WaitingReport {
    /// Where it was measured.
    pub machine: Machine,
    /// All measurements.
    pub points: Vec<WaitingPoint>,
    /// The greatest `wall_ratio` of the first side with busy processes beside it.
    pub worst_busy_ratio: f64,
    /// The greatest `steady_ratio` and `event_ratio` of the first side without any.
    pub worst_quiet_ratio: f64,
    /// p99 by p50 of each run of the first command.
    pub first_ratios: Vec<f64>,
    /// p50 of each, us.
    pub first_p50_us: Vec<f64>,
    /// Median of `first_ratios`.
    pub first_ratio: f64,
}

/// A side that takes longer than this is not run again under the same load, s: it is out of the question.
const TOO_LONG_S: f64 = 10.0;

/// How often a run is tried.
const TRIES: usize = 3;

/// Keeps cores busy until dropped.
struct Busy(Vec<Child>);

impl Drop for Busy {
    fn drop(&mut self) {
        for child in &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Measures everything: the sides take turns, so that what else the machine does meets all alike.
pub fn waiting(
    options: &WaitingOptions<'_>,
    mut progress: impl FnMut(&WaitingPoint),
) -> Result<WaitingReport, BenchError> {
    let machine = Machine::here();
    // First of all, while the machine is as it was found.
    let mut first = Vec::new();
    for _ in 0..options.first_runs {
        first.push((options.run_first)()?);
    }
    let mut points = Vec::new();
    for &busy in &options.loads {
        for &scene in &options.scenes {
            let mut load = Busy(Vec::new());
            for _ in 0..busy {
                let child = (options.start_busy)();
                load.0.push(child.map_err(super::io("start a busy process"))?);
            }
            let of_scene = scene_under_load(options, scene, busy)?;
            of_scene.iter().for_each(&mut progress);
            points.extend(of_scene);
        }
    }
    let name = options.sides.first().map(Side::to_string).unwrap_or_default();
    let judged = |quiet: bool| {
        let name = name.clone();
        points.iter().filter(move |p: &&WaitingPoint| p.side == name && (p.busy == 0) == quiet)
    };
    let quiet = judged(true).flat_map(|p| [p.steady_ratio, p.event_ratio]).flatten();
    let first_ratios: Vec<f64> = first.iter().map(|run| run.p99_us / run.p50_us).collect();
    Ok(WaitingReport {
        machine,
        worst_quiet_ratio: quiet.fold(0.0, f64::max),
        worst_busy_ratio: judged(false).map(|p| p.wall_ratio).fold(0.0, f64::max),
        first_ratio: median(&mut first_ratios.clone()),
        first_p50_us: first.iter().map(|run| run.p50_us).collect(),
        first_ratios,
        points,
    })
}

fn scene_under_load(
    options: &WaitingOptions<'_>,
    scene: &'static str,
    busy: usize,
) -> Result<Vec<WaitingPoint>, BenchError> {
    let mut runs: Vec<Vec<Timed>> = vec![Vec::new(); options.sides.len()];
    for _ in 0..options.repetitions {
        for (side, runs) in options.sides.iter().zip(&mut runs) {
            if !is_possible(scene, side) || runs.iter().any(|run| run.wall_s > TOO_LONG_S) {
                continue;
            }
            // A busy machine may break the start of a run, which is then said and tried again.
            let mut run = (options.run)(scene, side);
            for _ in 1..TRIES {
                let Err(error) = &run else { break };
                eprintln!("{scene}, {busy} busy, {side}: {error}");
                run = (options.run)(scene, side);
            }
            runs.push(run?);
        }
    }
    let mut hashes = runs.iter().flatten().map(|run| run.state_hash);
    if let Some(hash) = hashes.next()
        && let Some(other) = hashes.find(|other| *other != hash)
    {
        let problem = format!("{scene}: state hashes {hash:016x} and {other:016x}");
        return Err(BenchError::Disagreement(problem));
    }
    let medians: Vec<_> = options
        .sides
        .iter()
        .zip(&runs)
        .filter(|(_, runs)| !runs.is_empty())
        .map(|(s, r)| (s, r, medians(r)))
        .collect();
    let least = |of: fn(&Timed) -> Option<f64>| {
        medians.iter().filter_map(|(.., m)| of(m)).fold(f64::INFINITY, f64::min)
    };
    let (wall, steady, event) =
        (least(|m| Some(m.wall_s)), least(|m| m.steady_p50_us), least(|m| m.event_p50_us));
    let point = |(side, runs, median): &(&Side, &Vec<Timed>, Timed)| WaitingPoint {
        scene,
        busy,
        side: side.to_string(),
        walls_s: runs.iter().map(|run| run.wall_s).collect(),
        median: *median,
        wall_ratio: median.wall_s / wall,
        steady_ratio: median.steady_p50_us.map(|us| us / steady),
        event_ratio: median.event_p50_us.map(|us| us / event),
    };
    Ok(medians.iter().map(point).collect())
}

/// Spinning is for the scene with one controller: elsewhere there is no core for each.
fn is_possible(scene: &str, side: &Side) -> bool {
    scene == THREE || !matches!(side, Side::TwoSpin | Side::Mode(WaitMode::Spin))
}

/// The scene of three processes.
pub const THREE: &str = super::MEASURED;
/// The scene of nine.
pub const NINE: &str = "corridor-8, four of each";

fn medians(runs: &[Timed]) -> Timed {
    let of = |value: fn(&Timed) -> f64| median(&mut runs.iter().map(value).collect::<Vec<_>>());
    let known = |value: fn(&Timed) -> Option<f64>| {
        let mut values: Vec<f64> = runs.iter().filter_map(value).collect();
        (!values.is_empty()).then(|| median(&mut values))
    };
    Timed {
        wall_s: of(|run| run.wall_s),
        p50_us: of(|run| run.p50_us),
        p99_us: of(|run| run.p99_us),
        steady_p50_us: known(|run| run.steady_p50_us),
        event_p50_us: known(|run| run.event_p50_us),
        state_hash: runs[0].state_hash,
    }
}

pub(crate) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => values[n / 2],
        n => (values[n / 2 - 1] + values[n / 2]) / 2.0,
    }
}

impl std::fmt::Display for Side {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Side::Mode(WaitMode::Adaptive) => "adaptive",
            Side::Mode(WaitMode::Hybrid) => "hybrid",
            Side::Mode(WaitMode::Spin) => "spin",
            Side::Mode(WaitMode::Block) => "block",
            Side::TwoSpin => "spin, two processes",
            Side::Beside => "the other build",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    fn timed(wall_s: f64, steady: f64) -> Timed {
        Timed {
            wall_s,
            p50_us: 2.0,
            p99_us: 5.0 * wall_s,
            steady_p50_us: Some(steady),
            event_p50_us: None,
            state_hash: 7,
        }
    }

    fn report(run: &dyn Fn(&str, &Side) -> Result<Timed, BenchError>) -> Result<WaitingReport, BenchError> {
        let options = WaitingOptions {
            scenes: vec![THREE],
            sides: vec![Side::Mode(WaitMode::Adaptive), Side::Mode(WaitMode::Hybrid)],
            loads: vec![0, 1],
            repetitions: 3,
            first_runs: 2,
            run,
            start_busy: &|| std::process::Command::new("sleep").arg("60").spawn(),
            run_first: &|| Ok(timed(4.0, 1.0)),
        };
        waiting(&options, |_| {})
    }

    #[test]
    fn sides_take_turns_and_are_compared_by_their_medians() {
        let order = RefCell::new(Vec::new());
        let report = report(&|_, side| {
            let mut order = order.borrow_mut();
            order.push(side.clone());
            let walls = [1.2, 1.0, 1.1, 20.0, 9.0, 1.3, 1.0, 1.3, 1.0, 1.3, 1.0];
            Ok(timed(walls[order.len() - 1], if *side == Side::Mode(WaitMode::Hybrid) { 2.0 } else { 3.0 }))
        })
        .expect("all hashes agree");
        let sides: Vec<_> = order.borrow().iter().map(Side::to_string).collect();
        // Quiet: by turns, and the one that took 20 s once is not asked again.
        assert_eq!(sides[..5], ["adaptive", "hybrid", "adaptive", "hybrid", "adaptive"]);
        let of = |i: usize| (report.points[i].busy, report.points[i].side.as_str());
        assert_eq!([of(0), of(1), of(2)], [(0, "adaptive"), (0, "hybrid"), (1, "adaptive")]);
        assert_eq!(report.points[0].walls_s, [1.2, 1.1, 9.0]);
        assert!((report.points[0].wall_ratio - 1.0).abs() < 1e-9);
        assert!((report.worst_quiet_ratio - 1.5).abs() < 1e-9);
        assert!((report.worst_busy_ratio - 1.3).abs() < 1e-9);
        assert!((report.first_ratio - 10.0).abs() < 1e-9);
    }

    #[test]
    fn runs_that_end_differently_are_no_comparison() {
        let count = RefCell::new(0);
        let error = report(&|_, _| {
            *count.borrow_mut() += 1;
            Ok(Timed { state_hash: *count.borrow(), ..timed(1.0, 1.0) })
        })
        .expect_err("two hashes");
        assert!(error.to_string().contains("0000000000000003"), "{error}");
    }
}
