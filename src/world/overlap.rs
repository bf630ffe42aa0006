//! Bodies that overlap: an observer of its own, on which nobody's motion depends.
//!
//! A vehicle's position is that of its front; its body reaches back from there by its length, along the way it
//! has come. Two bodies overlap where they are on one way: on one approach or link, in one and the next place
//! of it, or, of different approaches, from the instant on at which both fronts are past the conflict point.
//! Each instant counts, between samples as well as at them. Outside the network nobody is looked at but
//! vehicles that have just left, for the sake of those behind them.

use super::car::Car;
use super::role::World;
use crate::lanes::Lanes;
use crate::scenario::{Exit, Scenario, ZoneId};
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
    /// Vehicles whose bodies still reach back into a zone that others have left after them: like index 0,
    /// in the zone's coordinate.
    tails: Lanes<Tail>,
    /// Least position of those seen so far on each approach of a zone, m.
    least_m: Vec<f64>,
}

#[derive(Clone, Copy, Debug)]
struct Tail {
    car: Car,
    /// The last zone it is known to have left.
    left_from: ZoneId,
}

/// A step as overlaps are looked for in it.
#[derive(Clone, Copy)]
struct Look<'a> {
    scenario: &'a Scenario,
    zone: usize,
    step: u64,
    dt_s: f64,
}

impl Overlaps {
    pub(super) fn new(zones: usize) -> Overlaps {
        Overlaps {
            summary: OverlapSummary::default(),
            pairs: BTreeSet::new(),
            tails: Lanes::new(zones),
            least_m: Vec::new(),
        }
    }

    pub(super) fn summary(&self) -> OverlapSummary {
        self.summary.clone()
    }

    /// Keeps a vehicle that has left a zone after another, or is passed over by one, while its body still
    /// reaches back.
    pub(super) fn keep_tail(
        &mut self,
        zone: usize,
        car: Car,
        left_from: ZoneId,
        conflict_m: f64,
        body_m: f64,
    ) {
        if car.x_m - body_m < conflict_m {
            self.tails.push(zone, Tail { car, left_from });
        }
    }

    /// Compares two vehicles from an instant of the step on.
    fn compare(&mut self, look: Look<'_>, a: (u32, &Held), b: (u32, &Held), shift_m: f64, from_s: f64) {
        let body_m = look.scenario.vehicle.length_m - TOLERANCE_M;
        let (a_to_m, b_to_m) = (a.1.position_m(look.dt_s), b.1.position_m(look.dt_s) + shift_m);
        if b.1.x0_m + shift_m - body_m >= a_to_m || a.1.x0_m - body_m >= b_to_m {
            return;
        }
        let (time_s, least_m) = a.1.time_within(b.1, shift_m, body_m, (from_s, look.dt_s));
        if least_m >= body_m {
            return;
        }
        let pair = [a.0.min(b.0), a.0.max(b.0)];
        let seen = &mut self.summary;
        seen.time_s += time_s;
        seen.deepest_m = seen.deepest_m.max(look.scenario.vehicle.length_m - least_m);
        let apart_m = b.1.x0_m + shift_m - a.1.x0_m;
        seen.samples += u64::from(from_s == 0.0 && apart_m.abs() < body_m);
        if self.pairs.insert(pair) {
            seen.pairs += 1;
            seen.first.get_or_insert_with(|| FirstOverlap {
                step: look.step,
                zone: look.scenario.network.zones[look.zone].name.clone(),
                vehicles: pair,
            });
        }
    }
}

impl World {
    /// Looks at a zone's vehicles over the step, before those that cross are taken out; everybody's motion is
    /// settled, and nobody downstream has moved.
    pub(super) fn observe_overlaps(&mut self, scenario: &Scenario, zone: usize, dt_s: f64, crosses: bool) {
        let look = Look { scenario, zone, step: self.step, dt_s };
        let has_tails = self.overlaps.tails.total() > 0 && !self.overlaps.tails[zone].is_empty();
        if has_tails {
            self.follow_tails(scenario, zone);
        }
        let body_m = scenario.vehicle.length_m;
        let Overlaps { least_m, tails, .. } = &mut self.overlaps;
        least_m.clear();
        least_m.resize(self.lengths_m[zone].len(), f64::INFINITY);
        for Tail { car, .. } in if has_tails { &tails[zone] } else { &[] } {
            let least_m = &mut least_m[car.path as usize];
            *least_m = least_m.min(car.x_m);
        }
        let first = self.sites[zone].first();
        let cars = &self.cars[zone];
        for (i, (car, motion)) in cars.iter().zip(&self.scratch.motions).enumerate() {
            let least_m = &mut self.overlaps.least_m[car.path as usize];
            let is_near = i >= first && *least_m - body_m < motion.position_m(dt_s);
            *least_m = least_m.min(car.x_m);
            if !is_near {
                continue;
            }
            let own = (car.vehicle, motion);
            for (other, at) in cars[..i].iter().zip(&self.scratch.motions).filter(|(o, _)| o.path == car.path)
            {
                self.overlaps.compare(look, own, (other.vehicle, at), 0.0, 0.0);
            }
            for at in 0..if has_tails { self.overlaps.tails[zone].len() } else { 0 } {
                let tail = self.overlaps.tails[zone][at].car;
                if tail.path == car.path {
                    self.overlaps.compare(look, own, (tail.vehicle, &tail.held()), 0.0, 0.0);
                }
            }
        }
        if crosses {
            self.observe_crossing(look);
        }
        if has_tails {
            self.move_tails(look);
        }
    }

    /// Looks at those that pass the conflict point, from then on: at each other, and at who is ahead there.
    fn observe_crossing(&mut self, look: Look<'_>) {
        let Look { scenario, zone, dt_s, .. } = look;
        let exit = self.sites[zone].exit;
        if let Exit::Zone { zone: down, .. } = exit {
            // Its own turn has not come yet.
            if self.sites[down as usize].has_left {
                self.hold_left(scenario, down as usize);
            }
            self.follow_tails(scenario, down as usize);
        }
        let first = self.sites[zone].first();
        for i in first..self.cars[zone].len() {
            let (car, motion) = (self.cars[zone][i], self.scratch.motions[i]);
            let conflict_m = self.lengths_m[zone][car.path as usize];
            let Some(after_s) = motion.passes_m(conflict_m, dt_s) else { continue };
            let own = (car.vehicle, &motion);
            // Vehicles of its own approach it has been compared with already.
            for j in first..i {
                let (other, at) = (self.cars[zone][j], self.scratch.motions[j]);
                let other_m = self.lengths_m[zone][other.path as usize];
                if other.path != car.path
                    && let Some(other_after_s) = at.passes_m(other_m, dt_s)
                {
                    let from_s = after_s.max(other_after_s);
                    self.overlaps.compare(look, own, (other.vehicle, &at), conflict_m - other_m, from_s);
                }
            }
            match exit {
                Exit::Out => {
                    for at in 0..first + self.overlaps.tails[zone].len() {
                        let other = self.left_at(zone, at);
                        if other.path == car.path {
                            continue;
                        }
                        let shift_m = conflict_m - self.lengths_m[zone][other.path as usize];
                        self.overlaps.compare(look, own, (other.vehicle, &other.held()), shift_m, after_s);
                    }
                }
                Exit::Zone { zone: down, path, link_m, .. } => {
                    for link_car in &self.links[zone].cars {
                        if !self.has_left_on(zone, car.path, link_car.car.vehicle) {
                            let other = (link_car.car.vehicle, &link_car.held);
                            self.overlaps.compare(look, own, other, conflict_m, after_s);
                        }
                    }
                    for at in 0..self.ahead_count(down as usize) {
                        let other = self.ahead_at(down as usize, at);
                        if other.path == path && !self.has_left_on(zone, car.path, other.vehicle) {
                            let other = (other.vehicle, &other.held());
                            self.overlaps.compare(look, own, other, conflict_m + link_m, after_s);
                        }
                    }
                }
            }
        }
    }

    /// One of the vehicles that have left a zone and are still looked at there.
    fn left_at(&self, zone: usize, at: usize) -> Car {
        let first = self.sites[zone].first();
        if at < first { self.cars[zone][at] } else { self.overlaps.tails[zone][at - first].car }
    }

    /// Vehicles of a zone, and those that have left it and are still looked at there.
    fn ahead_count(&self, zone: usize) -> usize {
        self.cars[zone].len() + self.overlaps.tails[zone].len()
    }

    fn ahead_at(&self, zone: usize, at: usize) -> Car {
        let cars = &self.cars[zone];
        if at < cars.len() { cars[at] } else { self.overlaps.tails[zone][at - cars.len()].car }
    }

    /// Whether a vehicle has left a zone on this path and is still looked at there.
    fn has_left_on(&self, zone: usize, path: u32, vehicle: u32) -> bool {
        (0..self.sites[zone].first() + self.overlaps.tails[zone].len())
            .map(|at| self.left_at(zone, at))
            .any(|left| left.vehicle == vehicle && left.path == path)
    }

    /// Looks at the vehicles on the link behind a zone, and at those that have just left it.
    pub(super) fn observe_link_overlaps(&mut self, scenario: &Scenario, zone: usize, dt_s: f64) {
        let Exit::Zone { zone: down, path, link_m, .. } = self.sites[zone].exit else { return };
        let look = Look { scenario, zone, step: self.step, dt_s };
        let body_m = scenario.vehicle.length_m;
        if self.links[zone].cars.is_empty() {
            return;
        }
        self.follow_tails(scenario, down as usize);
        let cars = &self.links[zone].cars;
        let mut least_m = f64::INFINITY;
        for (i, link_car) in cars.iter().enumerate() {
            let own = (link_car.car.vehicle, &link_car.held);
            let to_m = link_car.held.position_m(dt_s);
            if least_m - body_m < to_m {
                for other in &cars[..i] {
                    self.overlaps.compare(look, own, (other.car.vehicle, &other.held), 0.0, 0.0);
                }
            }
            least_m = least_m.min(link_car.car.x_m);
            if to_m > link_m - body_m {
                for at in 0..self.ahead_count(down as usize) {
                    let other = self.ahead_at(down as usize, at);
                    if other.path == path {
                        self.overlaps.compare(look, own, (other.vehicle, &other.held()), link_m, 0.0);
                    }
                }
            }
        }
    }

    /// Settles what the tails of a zone hold over the step: what their vehicles do elsewhere.
    fn follow_tails(&mut self, scenario: &Scenario, zone: usize) {
        for at in 0..self.overlaps.tails[zone].len() {
            let Tail { car, mut left_from } = self.overlaps.tails[zone][at];
            let u = self.left_mps2(scenario, zone, &mut left_from, &car);
            let tail = &mut self.overlaps.tails[zone][at];
            tail.left_from = left_from;
            tail.car.command_mps2 = u;
        }
    }

    /// Moves the tails of a zone to the end of the step; those that have left it altogether are forgotten.
    fn move_tails(&mut self, look: Look<'_>) {
        let lengths_m = &self.lengths_m[look.zone];
        let tails = &mut self.overlaps.tails[look.zone];
        let mut kept = 0;
        for at in 0..tails.len() {
            let mut tail = tails[at];
            let held = tail.car.held();
            tail.car.move_on(&held, look.dt_s);
            if tail.car.x_m - look.scenario.vehicle.length_m < lengths_m[tail.car.path as usize] {
                tails[kept] = tail;
                kept += 1;
            }
        }
        self.overlaps.tails.truncate(look.zone, kept);
    }
}
