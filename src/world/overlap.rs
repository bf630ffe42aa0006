//! Bodies that overlap: an observer of its own, on which nobody's motion depends.
//!
//! A vehicle's position is that of its front; its body reaches back from there by its length, along the way it
//! has come. Two bodies overlap where they are on one way: on a stretch that their paths share, from the instant on at
//! which both fronts are on it, or on one link. Where paths cross, two bodies overlap that are in the conflict
//! area at once. Each instant counts, between samples as well as at them. Outside the network nobody is looked at but
//! vehicles that have just left, for the sake of those behind them.

use super::car::Car;
use super::role::World;
use crate::conflict::{Conflicts, PointKind, Run, Use};
use crate::lists::Lists;
use crate::scenario::{Scenario, VehicleParams};
use crate::vehicle::Held;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// Bodies closer than this to their length do not overlap, m: rounding.
const TOLERANCE_M: f64 = 1e-9;

/// Vehicles whose bodies overlapped.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OverlapSummary {
    /// Pairs of vehicles that overlapped at any instant.
    pub pairs: u64,
    /// Those of them of which neither was commanded.
    pub pairs_uncommanded: u64,
    /// Samples at which a pair did, over all pairs.
    pub samples: u64,
    /// Time for which pairs did, over all pairs, s.
    pub time_s: f64,
    /// By how much a pair did at most, m; a vehicle's length when one passed through the other.
    pub deepest_m: f64,
    /// The first of them, if there is one.
    pub first: Option<FirstOverlap>,
}

/// Where and when bodies overlapped first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FirstOverlap {
    /// Step in which it began.
    pub step: u64,
    /// Zone in which, or behind the conflict point of which.
    pub zone: String,
    /// The two vehicles, in order of their numbers.
    pub vehicles: [u32; 2],
}

/// What has been seen so far.
#[derive(Debug)]
pub(super) struct Overlaps {
    summary: OverlapSummary,
    pairs: BTreeSet<[u32; 2]>,
    /// Vehicles whose bodies still reach back into a zone in which others count as the last that left: in the
    /// zone's coordinate.
    tails: Lists<Car>,
    /// Least position of those seen so far from each entrance of a zone, m.
    least_m: Vec<f64>,
    /// Stretches that two vehicles share; kept for its allocation.
    runs: Vec<Run>,
}

/// A step as overlaps are looked for in it.
#[derive(Clone, Copy)]
struct Look<'a> {
    scenario: &'a Scenario,
    kinds: &'a [VehicleParams],
    zone: usize,
    step: u64,
    dt_s: f64,
}

/// A vehicle and its motion over the step.
#[derive(Clone, Copy)]
struct Body<'a> {
    vehicle: u32,
    is_commanded: bool,
    length_m: f64,
    motion: &'a Held,
}

impl Overlaps {
    pub(super) fn new(zones: usize) -> Overlaps {
        Overlaps {
            summary: OverlapSummary::default(),
            pairs: BTreeSet::new(),
            tails: Lists::new(zones),
            least_m: Vec::new(),
            runs: Vec::new(),
        }
    }

    pub(super) fn summary(&self) -> OverlapSummary {
        self.summary.clone()
    }

    pub(super) fn tails(&self, zone: usize) -> &[Car] {
        &self.tails[zone]
    }

    pub(super) fn tails_mut(&mut self, zone: usize) -> &mut [Car] {
        &mut self.tails[zone]
    }

    /// Keeps a vehicle that no longer counts in a zone while its body still reaches back to it.
    pub(super) fn keep_tail(&mut self, zone: usize, car: Car, clear_from_m: f64) {
        if car.x_m < clear_from_m {
            self.tails.push(zone, car);
        }
    }

    /// Compares two vehicles while they are on one way, s from the step's beginning; `shift_m` expresses the second's
    /// position in the first's coordinate.
    fn compare(
        &mut self,
        look: Look<'_>,
        a: Body<'_>,
        b: Body<'_>,
        shift_m: f64,
        (from_s, to_s): (f64, f64),
    ) {
        // What counts is the body of the one ahead.
        let b_leads = b.motion.position_m(from_s) + shift_m >= a.motion.position_m(from_s);
        let whole_m = if b_leads { b.length_m } else { a.length_m };
        let body_m = whole_m - TOLERANCE_M;
        let (a_to_m, b_to_m) = (a.motion.position_m(to_s), b.motion.position_m(to_s) + shift_m);
        if b.motion.x0_m + shift_m - body_m >= a_to_m || a.motion.x0_m - body_m >= b_to_m {
            return;
        }
        let (time_s, least_m) = a.motion.time_within(b.motion, shift_m, body_m, (from_s, to_s));
        if least_m >= body_m {
            return;
        }
        let apart_m = b.motion.x0_m + shift_m - a.motion.x0_m;
        let at_sample = from_s == 0.0 && apart_m.abs() < body_m;
        self.note(look, [a, b], time_s, whole_m - least_m, at_sample);
    }

    fn note(&mut self, look: Look<'_>, [a, b]: [Body<'_>; 2], time_s: f64, depth_m: f64, at_sample: bool) {
        let pair = [a.vehicle.min(b.vehicle), a.vehicle.max(b.vehicle)];
        let seen = &mut self.summary;
        seen.time_s += time_s;
        seen.deepest_m = seen.deepest_m.max(depth_m);
        seen.samples += u64::from(at_sample);
        if self.pairs.insert(pair) {
            seen.pairs += 1;
            seen.pairs_uncommanded += u64::from(!a.is_commanded && !b.is_commanded);
            seen.first.get_or_insert_with(|| FirstOverlap {
                step: look.step,
                zone: look.scenario.network.zones[look.zone].name.clone(),
                vehicles: pair,
            });
        }
    }
}

/// When a body is between two places within the step, s; `from > to` when it is not.
fn time_between(motion: &Held, from_m: f64, to_m: f64, dt_s: f64) -> (f64, f64) {
    let from_s = motion.passes_m(from_m, dt_s).unwrap_or(f64::INFINITY);
    // Whoever stands at the end is out.
    let to_s = if motion.x0_m >= to_m { 0.0 } else { motion.passes_m(to_m, dt_s).unwrap_or(dt_s) };
    (from_s, to_s)
}

impl World {
    /// Looks at a zone's vehicles over the step, before those that leave are taken out; everybody's motion is
    /// settled.
    pub(super) fn observe_overlaps(&mut self, scenario: &Scenario, zone: usize, dt_s: f64) {
        let has_tails = self.overlaps.tails.total() > 0 && !self.overlaps.tails[zone].is_empty();
        if has_tails {
            self.follow_tails(scenario, zone);
        }
        let look = Look { scenario, kinds: &self.kinds, zone, step: self.step, dt_s };
        let paths = &scenario.network.zones[zone].paths;
        let entrance = |car: &Car| paths[car.path as usize].segments[0];
        let longest_m = self.longest_m;
        let least_m = &mut self.overlaps.least_m;
        least_m.clear();
        least_m.resize(scenario.network.zones[zone].segments.len(), f64::INFINITY);
        for car in if has_tails { &self.overlaps.tails[zone] } else { &[] } {
            let least_m = &mut least_m[entrance(car) as usize];
            *least_m = least_m.min(car.x_m);
        }
        let first = self.zones[zone].first();
        let (cars, motions, conflicts) = (&self.cars[zone], &self.scratch.motions, &self.conflicts[zone]);
        for (i, (car, motion)) in cars.iter().zip(motions).enumerate() {
            let least_m = &mut self.overlaps.least_m[entrance(car) as usize];
            let to_m = motion.position_m(dt_s);
            let is_near = *least_m - longest_m < to_m;
            *least_m = least_m.min(car.x_m);
            let meets = to_m >= conflicts.meets_from_m(car.path);
            if i < first || !(is_near || meets) {
                continue;
            }
            // On its own lane it is compared with those near it, elsewhere with those that are where paths meet.
            let concerns = |other: &Car, at: &Held| match entrance(other) == entrance(car) {
                true => is_near,
                false => meets && at.position_m(dt_s) >= conflicts.meets_from_m(other.path),
            };
            for (other, at) in cars[..i].iter().zip(motions) {
                if concerns(other, at) {
                    compare_in_zone(&mut self.overlaps, look, conflicts, (car, motion), (other, at));
                }
            }
            for at in 0..if has_tails { self.overlaps.tails[zone].len() } else { 0 } {
                let other = self.overlaps.tails[zone][at];
                let held = other.held();
                if concerns(&other, &held) {
                    compare_in_zone(&mut self.overlaps, look, conflicts, (car, motion), (&other, &held));
                }
            }
        }
        if has_tails {
            self.move_tails(zone, dt_s);
        }
    }

    /// Looks at the vehicles on a link, and at those that have just left it.
    pub(super) fn observe_link_overlaps(&mut self, scenario: &Scenario, link: usize, dt_s: f64) {
        if self.links.all[link].cars.is_empty() {
            return;
        }
        let (from, to) = (self.links.all[link].from.0 as usize, self.links.all[link].to);
        let down = to.zone as usize;
        self.follow_tails(scenario, down);
        let look = Look { scenario, kinds: &self.kinds, zone: from, step: self.step, dt_s };
        let paths = &scenario.network.zones[down].paths;
        let cars = &self.links.all[link].cars;
        let mut least_m = f64::INFINITY;
        for (i, link_car) in cars.iter().enumerate() {
            let own = look.body(&link_car.car, &link_car.held);
            let to_m = link_car.held.position_m(dt_s);
            if least_m - self.longest_m < to_m {
                for other in &cars[..i] {
                    self.overlaps.compare(look, own, look.body(&other.car, &other.held), 0.0, (0.0, dt_s));
                }
            }
            least_m = least_m.min(link_car.car.x_m);
            if to_m <= to.link_m - self.longest_m {
                continue;
            }
            let count = self.cars[down].len();
            for at in 0..count + self.overlaps.tails[down].len() {
                let other =
                    if at < count { self.cars[down][at] } else { self.overlaps.tails[down][at - count] };
                if paths[other.path as usize].segments[0] == to.segment {
                    let held = other.held();
                    self.overlaps.compare(look, own, look.body(&other, &held), to.link_m, (0.0, dt_s));
                }
            }
        }
    }

    /// Settles what the tails of a zone hold over the step: what their vehicles do elsewhere.
    fn follow_tails(&mut self, scenario: &Scenario, zone: usize) {
        if self.played.is_some() {
            return; // They have been told already.
        }
        for at in 0..self.overlaps.tails[zone].len() {
            let mut car = self.overlaps.tails[zone][at];
            car.command_mps2 = self.follow(scenario, zone, &mut car).u_mps2;
            self.overlaps.tails[zone][at] = car;
        }
    }

    /// Moves the tails of a zone to the end of the step; those that have left it altogether are forgotten.
    fn move_tails(&mut self, zone: usize, dt_s: f64) {
        let lengths_m = &self.lengths_m[zone];
        let tails = &mut self.overlaps.tails[zone];
        let mut kept = 0;
        for at in 0..tails.len() {
            let mut car = tails[at];
            let held = car.held();
            car.move_on(&held, dt_s);
            let length_m = self.kinds[usize::from(car.kind)].length_m;
            if car.x_m - length_m < lengths_m[car.path as usize] {
                tails[kept] = car;
                kept += 1;
            }
        }
        self.overlaps.tails.truncate(zone, kept);
    }
}

impl Look<'_> {
    fn body<'a>(&self, car: &Car, motion: &'a Held) -> Body<'a> {
        let Car { vehicle, is_commanded, kind, .. } = *car;
        Body { vehicle, is_commanded, length_m: self.kinds[usize::from(kind)].length_m, motion }
    }
}

/// Compares two vehicles of a zone wherever their paths meet.
fn compare_in_zone(
    overlaps: &mut Overlaps,
    look: Look<'_>,
    conflicts: &Conflicts,
    (car, motion): (&Car, &Held),
    (other, at): (&Car, &Held),
) {
    let (own, theirs) = (look.body(car, motion), look.body(other, at));
    let mut runs = std::mem::take(&mut overlaps.runs);
    runs.clear();
    conflicts.runs((car.path, car.next_path), (other.path, other.next_path), |run| runs.push(run));
    for run in &runs {
        // From the entrance on, and before it, for a rounding.
        let enters_s = |held: &Held, from_m: f64| match run.from_m == 0.0 {
            true => Some(0.0),
            false => held.passes_m(from_m, look.dt_s),
        };
        let entered = enters_s(motion, run.from_m).zip(enters_s(at, run.other_from_m));
        let shift_m = run.from_m - run.other_from_m;
        // They have parted when both are past the end.
        let parts_s = |held: &Held, to_m: f64| held.passes_m(to_m, look.dt_s).unwrap_or(look.dt_s);
        if let Some((own_s, other_s)) = entered.filter(|_| car.x_m.min(other.x_m + shift_m) < run.to_m) {
            let to_s = parts_s(motion, run.to_m).max(parts_s(at, run.to_m - shift_m));
            overlaps.compare(look, own, theirs, shift_m, (own_s.max(other_s), to_s));
        }
    }
    overlaps.runs = runs;
    for here in conflicts.uses(car.path) {
        let point = &conflicts.points()[here.point as usize];
        let there = conflicts.uses(other.path).iter().find(|u| u.point == here.point && !u.on_lane_of(here));
        let (PointKind::Crossing, Some(there)) = (point.kind, there) else { continue };
        let inside = |body: &Body<'_>, at: &Use| {
            time_between(body.motion, at.at_m, at.at_m + at.area_m + body.length_m, look.dt_s)
        };
        let (own_in, other_in) = (inside(&own, here), inside(&theirs, there));
        let (from_s, to_s) = (own_in.0.max(other_in.0), own_in.1.min(other_in.1));
        if to_s - from_s > TOLERANCE_M {
            let depth_m = own.length_m.min(theirs.length_m);
            overlaps.note(look, [own, theirs], to_s - from_s, depth_m, from_s == 0.0);
        }
    }
}
