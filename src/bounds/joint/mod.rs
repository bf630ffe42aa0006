//! The centralised optimum for a given passing order: everybody's way at once, by somebody who knows all arrivals.
//!
//! Unknowns are the speeds at equally spaced places of each way; between them acceleration is constant, so a way is
//! driven exactly, and instants follow from speeds. Cost is the sum of the zones' mean costs. Toward the vehicle
//! ahead on the same path, at each place, and toward the one that passes a merge before it, at its own passing, a
//! vehicle keeps `phi v + delta`, as instants: it is nowhere before the other was that far ahead. A vehicle that comes
//! in closer than that may stay closer for a while, by as much as decays at a rate, the least of some rates at which it is
//! not more exposed than what it is compared with.
//!
//! Cost is nearly convex in the speeds, instants are not: a sequence of quadratic programs (`program`), each
//! within a trust region, with an exact penalty. What it ends in is a **local** optimum, with speeds that anybody
//! could drive: an upper bound of the true optimum, to compare with, not a bound.

mod program;

use super::traffic::{Entrant, Traffic, is_merge};
use crate::scenario::{Scenario, VehicleParams};
use program::{Step, step};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Rates at which missing distance must be made up: how many, the slowest, 1/s, and how far they are apart, 1/s.
const RECOVERIES: usize = 32;
const SLOWEST_RECOVERY_PER_S: f64 = 0.6;
const RECOVERY_STEP_PER_S: f64 = 0.05;
/// Exposure is integrated by trapezoids, so many to a stretch.
const PARTS: usize = 8;
/// Length of the stretches of constant acceleration, about, m.
const STRETCH_M: f64 = 12.5;
/// Programs at most.
const MOST_STEPS: usize = 60;
/// The search ends when a program promises less than this share of the cost.
const PROMISE: f64 = 2e-6;
/// Radius of the trust region at first and at most, and when it is given up, m/s.
const RADII_MPS: (f64, f64, f64) = (1.0, 3.0, 1e-3);
/// Penalty of a missing second, as a multiple of the price of a second of driving.
const PENALTY: f64 = 20.0;

/// When a vehicle passed a zone, where the search begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Course {
    /// Instant of entry, s.
    pub entry_s: f64,
    /// Instant of leaving, s.
    pub exit_s: f64,
    /// Speed at leaving, m/s.
    pub exit_mps: f64,
}

/// What the search ended in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Found {
    /// Sum of the zones' mean costs, m^2/s^3.
    pub total: f64,
    /// The integral of the missing rear-end margin over time, per vehicle and zone, m s.
    pub exposure_ms: Vec<f64>,
    /// By how much a duty is missed at most, s.
    pub missed_s: f64,
    /// Greatest acceleration and braking, m/s^2.
    pub hardest_mps2: (f64, f64),
    /// Programs solved.
    pub steps: usize,
    /// Whether it ended because nothing was left to gain.
    pub converged: bool,
}

/// A vehicle's way, cut up.
#[derive(Clone, Debug)]
pub(super) struct Drive {
    /// Weight of each stretch's cost.
    weights: Vec<f64>,
    /// Length of each stretch, m.
    lengths_m: Vec<f64>,
    /// Places along the way, one more than stretches, m.
    places_m: Vec<f64>,
    /// Place at which each zone ends.
    ends: Vec<usize>,
    zones: Vec<u32>,
    arrival_s: f64,
    /// Speeds at the places, m/s; the first is given.
    speeds_mps: Vec<f64>,
    /// Instants at the places, s.
    instants_s: Vec<f64>,
}

/// What a vehicle owes another at one of its places.
#[derive(Clone, Copy, Debug)]
pub(super) struct Owes {
    drive: usize,
    place: usize,
    to: usize,
    /// From the one's coordinate to the other's, m.
    shift_m: f64,
    /// Place at which the missing distance is made up from.
    since: Option<usize>,
    /// Whether it is a rear-end duty, and in which zone.
    rear_end: Option<u32>,
}

/// The search's state.
pub(super) struct Problem {
    drives: Vec<Drive>,
    owes: Vec<Owes>,
    vehicle: VehicleParams,
    beta: f64,
    penalty: f64,
    /// Rate at which missing distance must be made up, 1/s.
    recovery_per_s: f64,
}

/// Seeks the optimum for the order in which the courses pass; `None` where the network has anything but merges
/// without links, or several kinds of vehicles.
///
/// Who may stay too close for longer has less to do: the optimum is that of the least recovery at which its exposure, per
/// vehicle and over all zones, is at most `most_exposure_ms`, m s, or else that of the greatest.
pub fn seek(traffic: &Traffic<'_>, courses: &[Vec<Course>], most_exposure_ms: f64) -> Option<Found> {
    let recovery_per_s = |rate: usize| SLOWEST_RECOVERY_PER_S + RECOVERY_STEP_PER_S * rate as f64;
    let at = |rate: usize| seek_at(traffic, courses, recovery_per_s(rate));
    // The faster it is made up for, the less exposed.
    let (mut slow, mut fast) = (0, RECOVERIES - 1);
    let mut found = None;
    while slow < fast {
        let middle = (slow + fast) / 2;
        let tried = at(middle)?;
        if tried.exposure_ms.iter().sum::<f64>() <= most_exposure_ms {
            (fast, found) = (middle, Some(tried));
        } else {
            slow = middle + 1;
        }
    }
    found.or_else(|| at(fast))
}

fn seek_at(traffic: &Traffic<'_>, courses: &[Vec<Course>], recovery_per_s: f64) -> Option<Found> {
    let scenario = traffic.scenario;
    if !scenario.network.zones.iter().all(is_merge) || scenario.fleet.len() != 1 {
        return None;
    }
    let mut problem = Problem::new(traffic, courses, recovery_per_s);
    let (mut merit, mut radius_mps, mut steps, mut converged) = (problem.merit(), RADII_MPS.0, 0, false);
    let mut prices: Vec<Vec<f64>> = problem.drives.iter().map(|d| d.price(problem.beta)).collect();
    while steps < MOST_STEPS && radius_mps > RADII_MPS.2 {
        steps += 1;
        let Some(Step { speeds_mps, promised, prices: found }) = step(&problem, &prices, radius_mps) else {
            radius_mps *= 0.4;
            continue;
        };
        prices = found;
        if promised < PROMISE * merit {
            converged = true;
            break;
        }
        let before: Vec<Vec<f64>> = problem.drives.iter().map(|d| d.speeds_mps.clone()).collect();
        problem.set(&speeds_mps);
        let gained = merit - problem.merit();
        if gained > 1e-4 * promised {
            merit -= gained;
            if gained > 0.75 * promised {
                radius_mps = (2.0 * radius_mps).min(RADII_MPS.1);
            }
        } else {
            problem.set(&before);
            radius_mps *= 0.4;
        }
    }
    Some(problem.found(scenario, steps, converged))
}

impl Problem {
    fn new(traffic: &Traffic<'_>, courses: &[Vec<Course>], recovery_per_s: f64) -> Problem {
        let scenario = traffic.scenario;
        // Weights near one, whatever the number of vehicles.
        let many = traffic.entrants.len() as f64;
        let shares: Vec<f64> = traffic.shares().into_iter().map(|share| share * many).collect();
        let drives: Vec<Drive> = traffic
            .entrants
            .iter()
            .zip(courses)
            .map(|(entrant, courses)| {
                let legs = entrant.way.iter().map(|&(zone, path)| {
                    let shape = &scenario.network.zones[zone as usize];
                    (zone, shape.paths[path as usize].length_m, shares[zone as usize])
                });
                Drive::new(entrant, legs.collect(), courses, scenario.vehicle.v_max_mps)
            })
            .collect();
        let mut owes = Vec::new();
        for zone in 0..scenario.network.zones.len() as u32 {
            // Who passes the zone, by which leg of its way and on which path, in passing order.
            let mut order: Vec<(usize, usize, u32)> = Vec::new();
            for (at, entrant) in traffic.entrants.iter().enumerate() {
                let leg = entrant.way.iter().position(|(z, _)| *z == zone);
                order.extend(leg.map(|leg| (at, leg, entrant.way[leg].1)));
            }
            order.sort_by(|a, b| courses[a.0][a.1].exit_s.total_cmp(&courses[b.0][b.1].exit_s));
            let mut last_on: BTreeMap<u32, (usize, usize)> = BTreeMap::new();
            let mut last: Option<(usize, usize)> = None;
            for &(own, leg, path) in &order {
                let (from, to) = drives[own].leg(leg);
                let shift = |(other, other_leg): (usize, usize)| {
                    drives[other].places_m[drives[other].leg(other_leg).1] - drives[own].places_m[to]
                };
                let leader = last_on.insert(path, (own, leg));
                if let Some(leader) = leader {
                    let first = if leg == 0 { 1 } else { from };
                    let duty = |place| Owes {
                        drive: own,
                        place,
                        to: leader.0,
                        shift_m: shift(leader),
                        since: (leg == 0).then_some(0),
                        rear_end: Some(zone),
                    };
                    owes.extend((first..=to).map(duty));
                }
                if let Some(other) = last.filter(|other| Some(*other) != leader) {
                    let shift_m = shift(other);
                    owes.push(Owes {
                        drive: own,
                        place: to,
                        to: other.0,
                        shift_m,
                        since: None,
                        rear_end: None,
                    });
                }
                last = Some((own, leg));
            }
        }
        let beta = scenario.beta;
        let greatest = shares.iter().fold(0.0, |a: f64, b| a.max(*b));
        let penalty = PENALTY * beta * greatest;
        Problem { drives, owes, vehicle: scenario.vehicle, beta, penalty, recovery_per_s }
    }

    fn set(&mut self, speeds_mps: &[Vec<f64>]) {
        for (drive, speeds) in self.drives.iter_mut().zip(speeds_mps) {
            drive.speeds_mps.clone_from(speeds);
            drive.time();
        }
    }

    /// Where the other must have been by then, in its own coordinate, m.
    fn target_m(&self, owes: &Owes) -> f64 {
        let own = &self.drives[owes.drive];
        let distance_m = |place: usize| {
            self.vehicle.reaction_time_s * own.speeds_mps[place] + self.vehicle.standstill_gap_m
        };
        let target_m = own.places_m[owes.place] + owes.shift_m + distance_m(owes.place);
        let Some(since) = owes.since else { return target_m };
        let other = &self.drives[owes.to];
        let there_m = other.position_m(own.instants_s[since]) - owes.shift_m - own.places_m[since];
        let missing_m = (distance_m(since) - there_m).max(0.0);
        target_m
            - missing_m * (-self.recovery_per_s * (own.instants_s[owes.place] - own.instants_s[since])).exp()
    }

    /// Time to spare, s.
    fn slack_s(&self, owes: &Owes) -> f64 {
        let passing = self.drives[owes.to].passing(self.target_m(owes));
        self.drives[owes.drive].instants_s[owes.place] - passing.instant_s
    }

    fn cost(&self) -> f64 {
        self.drives.iter().map(|drive| drive.cost(self.beta)).sum()
    }

    fn merit(&self) -> f64 {
        let missed: f64 = self.owes.iter().map(|owes| (-self.slack_s(owes)).max(0.0)).sum();
        self.cost() + self.penalty * missed
    }

    fn found(&self, scenario: &Scenario, steps: usize, converged: bool) -> Found {
        let zones = scenario.network.zones.len();
        let mut passing = vec![0.0_f64; zones];
        self.drives.iter().flat_map(|d| &d.zones).for_each(|zone| passing[*zone as usize] += 1.0);
        let mut exposure_ms = vec![0.0; zones];
        for owes in &self.owes {
            let (Some(zone), own) = (owes.rear_end, &self.drives[owes.drive]) else { continue };
            let leg = own.ends.partition_point(|end| *end < owes.place);
            if own.zones[leg] != zone || owes.place == 0 {
                continue;
            }
            let (from_s, to_s) = (own.instants_s[owes.place - 1], own.instants_s[owes.place]);
            let missing_m = |part: usize| {
                let instant_s = from_s + (to_s - from_s) * part as f64 / PARTS as f64;
                let ((x_m, v_mps), (ahead_m, _)) =
                    (own.motion(instant_s), self.drives[owes.to].motion(instant_s));
                let needed_m = self.vehicle.reaction_time_s * v_mps + self.vehicle.standstill_gap_m;
                (needed_m - (ahead_m - owes.shift_m - x_m)).max(0.0)
            };
            let sum_m: f64 = (0..PARTS).map(|part| 0.5 * (missing_m(part) + missing_m(part + 1))).sum();
            exposure_ms[zone as usize] +=
                sum_m * (to_s - from_s) / PARTS as f64 / passing[zone as usize].max(1.0);
        }
        let rises = self.drives.iter().flat_map(|d| {
            let squares = d.speeds_mps.windows(2).map(|v| v[1] * v[1] - v[0] * v[0]);
            squares.zip(&d.lengths_m).map(|(square, length_m)| 0.5 * square / length_m)
        });
        let hardest_mps2 = rises.fold((0.0, 0.0), |(up, down): (f64, f64), u| (up.max(u), down.min(u)));
        Found {
            total: self.cost() / self.drives.len().max(1) as f64,
            exposure_ms,
            missed_s: self.owes.iter().map(|owes| -self.slack_s(owes)).fold(0.0, f64::max),
            hardest_mps2,
            steps,
            converged,
        }
    }
}

/// When a place is passed, and how that depends on the drive.
#[derive(Clone, Copy, Debug)]
pub(super) struct Passing {
    instant_s: f64,
    /// Speed there, m/s.
    speed_mps: f64,
    /// The place at the beginning of the stretch; its instant counts in full.
    place: usize,
    /// Derivatives by the speeds at its beginning and end, s^2/m.
    by_speeds: (f64, f64),
}

impl Drive {
    fn new(entrant: &Entrant, legs: Vec<(u32, f64, f64)>, courses: &[Course], v_max_mps: f64) -> Drive {
        let mut drive = Drive {
            weights: Vec::new(),
            lengths_m: Vec::new(),
            places_m: vec![0.0],
            ends: Vec::new(),
            zones: Vec::new(),
            arrival_s: entrant.arrival_s,
            speeds_mps: vec![entrant.speed_mps],
            instants_s: Vec::new(),
        };
        let mut entry_mps = entrant.speed_mps;
        for ((zone, length_m, weight), course) in legs.into_iter().zip(courses) {
            let stretches = (length_m / STRETCH_M).ceil().max(1.0) as usize;
            let begin_m = drive.places_m[drive.places_m.len() - 1];
            let profile = Hermite::new(length_m, course, entry_mps);
            for stretch in 1..=stretches {
                let at_m = length_m * stretch as f64 / stretches as f64;
                drive.places_m.push(begin_m + at_m);
                drive.lengths_m.push(length_m / stretches as f64);
                drive.weights.push(weight);
                drive.speeds_mps.push(profile.speed_mps(at_m).clamp(1.0, v_max_mps));
            }
            drive.ends.push(drive.places_m.len() - 1);
            drive.zones.push(zone);
            entry_mps = course.exit_mps;
        }
        drive.instants_s = vec![0.0; drive.places_m.len()];
        drive.time();
        drive
    }

    /// Places at which a leg of the way begins and ends.
    fn leg(&self, leg: usize) -> (usize, usize) {
        (if leg == 0 { 0 } else { self.ends[leg - 1] }, self.ends[leg])
    }

    /// Works out the instants.
    fn time(&mut self) {
        self.instants_s[0] = self.arrival_s;
        for at in 0..self.lengths_m.len() {
            let sum = self.speeds_mps[at] + self.speeds_mps[at + 1];
            self.instants_s[at + 1] = self.instants_s[at] + 2.0 * self.lengths_m[at] / sum;
        }
    }

    fn cost(&self, beta: f64) -> f64 {
        let parts = self.speeds_mps.windows(2).zip(self.lengths_m.iter().zip(&self.weights));
        let cost = |(v, (length_m, weight)): (&[f64], (&f64, &f64))| {
            let (sum, rise) = (v[0] + v[1], v[1] - v[0]);
            weight * (beta * 2.0 * length_m / sum + rise * rise * sum / (4.0 * length_m))
        };
        parts.map(cost).sum()
    }

    /// What a second more on each stretch costs when nobody else is there.
    fn price(&self, beta: f64) -> Vec<f64> {
        self.weights.iter().map(|weight| weight * beta).collect()
    }

    /// When a place is passed; before the way and behind it speed stays what it is.
    fn passing(&self, at_m: f64) -> Passing {
        let last = self.places_m.len() - 1;
        if at_m >= self.places_m[last] {
            let (speed_mps, beyond_m) = (self.speeds_mps[last], at_m - self.places_m[last]);
            return Passing {
                instant_s: self.instants_s[last] + beyond_m / speed_mps,
                speed_mps,
                place: last,
                by_speeds: (-beyond_m / (speed_mps * speed_mps), 0.0),
            };
        }
        let place = self.places_m.partition_point(|m| *m <= at_m).max(1) - 1;
        let (a, b, length_m) = (self.speeds_mps[place], self.speeds_mps[place + 1], self.lengths_m[place]);
        let part = (at_m - self.places_m[place]) / length_m;
        if part < 0.0 {
            let instant_s = self.instants_s[0] + part * length_m / a;
            return Passing { instant_s, speed_mps: a, place, by_speeds: (0.0, 0.0) };
        }
        let speed_mps = ((1.0 - part) * a * a + part * b * b).sqrt();
        let sum = a + speed_mps;
        let by = -2.0 * part * length_m / (sum * sum);
        Passing {
            instant_s: self.instants_s[place] + 2.0 * part * length_m / sum,
            speed_mps,
            place,
            by_speeds: (by * (1.0 + (1.0 - part) * a / speed_mps), by * part * b / speed_mps),
        }
    }

    /// Where it is, m.
    fn position_m(&self, instant_s: f64) -> f64 {
        self.motion(instant_s).0
    }

    /// Where it is, m, and how fast, m/s.
    fn motion(&self, instant_s: f64) -> (f64, f64) {
        let last = self.places_m.len() - 1;
        if instant_s >= self.instants_s[last] {
            let beyond_m = self.speeds_mps[last] * (instant_s - self.instants_s[last]);
            return (self.places_m[last] + beyond_m, self.speeds_mps[last]);
        }
        let place = self.instants_s.partition_point(|t| *t <= instant_s).max(1) - 1;
        let (a, b, length_m) = (self.speeds_mps[place], self.speeds_mps[place + 1], self.lengths_m[place]);
        let (after_s, u) = (instant_s - self.instants_s[place], 0.5 * (b * b - a * a) / length_m);
        (self.places_m[place] + (a + 0.5 * u * after_s) * after_s, a + u * after_s)
    }
}

/// The cubic over time that enters and leaves as a course does.
struct Hermite {
    duration_s: f64,
    length_m: f64,
    entry_mps: f64,
    exit_mps: f64,
}

impl Hermite {
    fn new(length_m: f64, course: &Course, entry_mps: f64) -> Hermite {
        let duration_s = course.exit_s - course.entry_s;
        Hermite { duration_s, length_m, entry_mps, exit_mps: course.exit_mps }
    }

    fn at(&self, part: f64) -> (f64, f64) {
        let (p, t) = (part, self.duration_s);
        let (h10, h01, h11) = (p * (1.0 - p) * (1.0 - p), p * p * (3.0 - 2.0 * p), p * p * (p - 1.0));
        let position_m = h10 * t * self.entry_mps + h01 * self.length_m + h11 * t * self.exit_mps;
        let (d10, d01, d11) = (1.0 - 4.0 * p + 3.0 * p * p, 6.0 * p * (1.0 - p), 3.0 * p * p - 2.0 * p);
        (position_m, d10 * self.entry_mps + d01 * self.length_m / t + d11 * self.exit_mps)
    }

    fn speed_mps(&self, at_m: f64) -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            *(if self.at(middle).0 < at_m { &mut low } else { &mut high }) = middle;
        }
        self.at(high).1
    }
}
