//! `cz bench view`: a step while somebody looks at the run, beside one while nobody does.

use super::BenchError;
use super::machine::Machine;
use super::waiting::{Timed, median};
use crate::process::{Steering, Watched};
use crate::step::Step;
use crate::transport::iox::RunName;
use serde::Serialize;
use std::time::{Duration, Instant};

/// A run of a scene while somebody looks, to its end or only until it has begun.
pub type RunSeen<'a> = dyn Fn(&str, bool) -> Result<(Timed, Seen), BenchError> + 'a;

/// What to measure, and how.
pub struct ViewedOptions<'a> {
    /// Runs, by name.
    pub scenes: Vec<String>,
    /// Runs of each side, by turns.
    pub repetitions: usize,
    /// Runs a scene while a process looks at it, to its end or only until it has begun.
    pub run: &'a RunSeen<'a>,
}

/// What whoever looked has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Seen {
    /// Steps it was shown.
    pub shown_steps: u64,
    /// Steps the run has left out.
    pub left_out_steps: u64,
    /// The number of the last step it was shown.
    pub last_step: u64,
}

/// One scene: medians over the repetitions.
#[derive(Clone, Debug, Serialize)]
pub struct ViewedPoint {
    /// Scene.
    pub scene: String,
    /// Median step of each run while nobody looked, us.
    pub unseen_p50_us: Vec<f64>,
    /// The same while somebody did.
    pub seen_p50_us: Vec<f64>,
    /// Median of the second by that of the first.
    pub p50_ratio: f64,
    /// The same of the 99th percentiles.
    pub p99_ratio: f64,
    /// The same of the wall times.
    pub wall_ratio: f64,
    /// What was seen in the last run.
    pub seen: Seen,
}

/// The results; the JSON keys are a contract.
#[derive(Clone, Debug, Serialize)]
pub struct ViewedReport {
    /// Where it was measured.
    pub machine: Machine,
    /// All measurements.
    pub points: Vec<ViewedPoint>,
    /// The greatest `p50_ratio`.
    pub worst_p50_ratio: f64,
}

/// Measures all scenes.
///
/// # Errors
/// When a run fails, or comes to another result because somebody looked.
pub fn viewed(
    options: &ViewedOptions<'_>,
    mut done: impl FnMut(&ViewedPoint),
) -> Result<ViewedReport, BenchError> {
    let machine = Machine::here();
    let mut points = Vec::new();
    for scene in &options.scenes {
        let mut sides: [Vec<Timed>; 2] = Default::default();
        let mut seen = Seen::default();
        for turn in 0..options.repetitions {
            // Who goes first takes turns too.
            for stays in [turn % 2 == 1, turn % 2 == 0] {
                let (timed, looked) = (options.run)(scene, stays)?;
                if let Some(other) = sides.iter().flatten().find(|t| t.state_hash != timed.state_hash) {
                    let hashes = (timed.state_hash, other.state_hash);
                    return Err(BenchError::Disagreement(format!(
                        "{scene}: state hash {:016x} and {:016x}, with and without a view",
                        hashes.0, hashes.1
                    )));
                }
                sides[usize::from(stays)].push(timed);
                if stays {
                    seen = looked;
                }
            }
        }
        let of =
            |side: usize, value: fn(&Timed) -> f64| -> Vec<f64> { sides[side].iter().map(value).collect() };
        let ratio = |value: fn(&Timed) -> f64| median(&mut of(1, value)) / median(&mut of(0, value));
        let point = ViewedPoint {
            scene: scene.clone(),
            unseen_p50_us: of(0, |t| t.p50_us),
            seen_p50_us: of(1, |t| t.p50_us),
            p50_ratio: ratio(|t| t.p50_us),
            p99_ratio: ratio(|t| t.p99_us),
            wall_ratio: ratio(|t| t.wall_s),
            seen,
        };
        done(&point);
        points.push(point);
    }
    let worst_p50_ratio = points.iter().map(|p| p.p50_ratio).fold(0.0, f64::max);
    Ok(ViewedReport { machine, points, worst_p50_ratio })
}

/// How long a run may take to be there.
const COMING: Duration = Duration::from_secs(60);

/// Lets a run begin that waits for somebody to look, and looks at it: takes and decodes every step as views do, to
/// its end, or goes away at once.
///
/// # Errors
/// When there is no such run in time, or it cannot be looked at.
pub fn look(run: &RunName, stays: bool) -> Result<Seen, BenchError> {
    let since = Instant::now();
    let (watched, ..) = loop {
        if let Some(found) = Watched::find(run)? {
            break found;
        }
        if since.elapsed() > COMING {
            return Err(BenchError::Peer);
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    watched.steer(&Steering::Resume)?;
    let mut seen = Seen::default();
    if !stays {
        // As soon as it has begun.
        while watched.step()?.is_none() && watched.goes_on() {
            std::thread::sleep(Watched::LOOK);
        }
        return Ok(seen);
    }
    let _ = rustix::process::nice(Watched::NICENESS);
    let mut goes_on = true;
    while goes_on {
        goes_on = watched.goes_on();
        while let Some((number, block)) = watched.step()? {
            if let Ok(step) = Step::decode(block.bytes()) {
                seen.shown_steps += 1;
                seen.last_step = number;
                goes_on &= step.header.flags & ipc_schemas::FLAG_END_OF_RUN == 0;
            }
        }
        while let Some(notice) = watched.notice()? {
            seen.left_out_steps = notice.left_out_steps;
        }
        std::thread::sleep(Watched::LOOK);
    }
    Ok(seen)
}
