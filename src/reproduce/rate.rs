//! Objectives of single vehicles over time (`fig:rate`).
//!
//! The paper shows "the total objective of each CAV". Vehicles from the second zone's own side road pass
//! one zone only, so their total is about half of the others'; the figure and the claims about it take
//! the vehicles that pass both zones.

use super::runs::Outcome;
use serde::Serialize;

/// Ends of the rate periods, s, and their rates, veh/h and road.
pub const PERIODS: [(f64, f64); 5] =
    [(400.0, 300.0), (800.0, 200.0), (1200.0, 400.0), (1600.0, 100.0), (2000.0, 400.0)];

/// Periods of high traffic.
pub const HIGH: [usize; 2] = [2, 4];
/// Periods of low traffic.
pub const LOW: [usize; 2] = [1, 3];

/// Time constant of the exponential smoothing, s.
pub const SMOOTHING_S: f64 = 60.0;

/// Objective of each vehicle that passed both zones: (instant of entry into the first, objective).
pub fn vehicle_objectives(outcome: &Outcome) -> Vec<(f64, f64)> {
    let mut firsts: Vec<_> = outcome.visits.iter().filter(|v| v.zone == 0).collect();
    firsts.sort_by_key(|v| v.vehicle);
    let objective = |v: &crate::world::CompletedVisit| outcome.beta * v.time_s() + v.energy;
    let mut points: Vec<(f64, f64)> = outcome
        .visits
        .iter()
        .filter(|v| v.zone == 1)
        .filter_map(|second| {
            let at = firsts.binary_search_by_key(&second.vehicle, |v| v.vehicle).ok()?;
            Some((firsts[at].entry_time_s, objective(firsts[at]) + objective(second)))
        })
        .collect();
    points.sort_by(|a, b| a.partial_cmp(b).expect("instants and objectives are finite"));
    points
}

/// Index of the rate period of an instant.
pub fn period(time_s: f64) -> usize {
    PERIODS.iter().position(|(until, _)| time_s < *until).unwrap_or(PERIODS.len() - 1)
}

/// Mean objective over the vehicles that entered in the given periods; NaN when there is none.
pub fn mean_objective(outcome: &Outcome, periods: &[usize]) -> f64 {
    let (mut sum, mut count) = (0.0, 0u32);
    for (time_s, objective) in vehicle_objectives(outcome) {
        if periods.contains(&period(time_s)) {
            sum += objective;
            count += 1;
        }
    }
    sum / f64::from(count)
}

/// A smoothed curve.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Curve {
    /// Policy.
    pub policy: &'static str,
    /// (instant of entry, s; smoothed objective).
    pub points: Vec<(f64, f64)>,
}

/// Exponential smoothing in time: a value's weight decays by 1/e within `constant_s`, whatever the number
/// of vehicles, so that one run and many pooled runs are smoothed alike. Points closer than 2 s are
/// thinned out.
pub fn smooth(mut points: Vec<(f64, f64)>, constant_s: f64) -> Vec<(f64, f64)> {
    points.sort_by(|a, b| a.partial_cmp(b).expect("instants and objectives are finite"));
    let (mut weights, mut sums, mut before) = (0.0, 0.0, 0.0);
    let mut curve: Vec<(f64, f64)> = Vec::new();
    for (time_s, value) in points {
        let keep = (-(time_s - before) / constant_s).exp();
        weights = weights * keep + 1.0;
        sums = sums * keep + value;
        before = time_s;
        if curve.last().is_none_or(|(last, _)| time_s - last >= 2.0) {
            curve.push((time_s, sums / weights));
        }
    }
    curve
}
