//! One step of the world: exact motion, exact crossing instants, cost and margin accounting.

use super::car::{Car, LeftCar, Visit};
use super::gate::may_enter;
use super::link::Link;
use super::metrics::{CompletedVisit, ZoneMetrics};
use super::role::{Traffic, World};
use crate::scenario::{Exit, Scenario, Zone};
use crate::vehicle::{Held, Merge, Pair, RearEnd, satisfiable_at};

/// A vehicle about to enter a zone at the end of the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    zone: u32,
    car: Car,
}

impl World {
    /// Integrates from the present step to the next with the commands in force.
    pub(super) fn integrate(&mut self) {
        let scenario = self.scenario.clone();
        let dt_s = scenario.dt_s();
        let now_s = scenario.time_s(self.step);
        self.hold_all(&scenario, dt_s);
        self.entries.clear();
        // All that concerns a zone at one go, while its vehicles are in the cache. Motions start from the
        // step's beginning, so it does not matter which zone has moved on already.
        for zone in 0..self.zones.len() {
            account_margins(&scenario, zone, &mut self.zones[zone], &mut self.metrics[zone], dt_s);
            self.leave_zone(&scenario, zone, now_s, dt_s);
            self.settle(zone, dt_s);
        }
        for zone in 0..self.links.len() {
            self.leave_link(&scenario, zone, now_s, dt_s);
            self.links[zone].cars.iter_mut().for_each(|car| move_on(car, dt_s));
        }
        self.admit(&scenario, now_s, dt_s);
        self.enter();
    }

    /// Takes out the vehicles that pass the conflict point during the step and sends them on.
    fn leave_zone(&mut self, scenario: &Scenario, index: usize, now_s: f64, dt_s: f64) {
        let zone = &scenario.network.zones[index];
        let traffic = &mut self.zones[index];
        if let Some(left) = &mut traffic.left {
            left.left_now = false;
        }
        let mut last: Option<(f64, Car)> = None;
        let mut kept = 0;
        for i in 0..traffic.cars.len() {
            let car = traffic.cars[i];
            let length_m = zone.approaches[car.path as usize].length_m;
            let Some(after_s) = car.held.passes_m(length_m, dt_s) else {
                traffic.cars[kept] = car;
                kept += 1;
                continue;
            };
            let first = last.as_ref().is_none_or(|(instant, _)| *instant <= after_s);
            let metrics = &mut self.metrics[index];
            // A member kept so far entered earlier and is still inside.
            metrics.order_violations += u32::from(kept > 0 || !first);
            let mut visit = car.visit;
            visit.energy += car.held.energy(after_s);
            let previous =
                if i > 0 { Some(&traffic.cars[i - 1]) } else { traffic.left.as_ref().map(|l| &l.car) };
            // `cars[i - 1]` may have been overwritten by compaction only with itself or an earlier
            // member, which is the case of an order violation.
            let merge_margin_m = previous.filter(|p| p.path != car.path).map(|p| {
                let shift = length_m - zone.approaches[p.path as usize].length_m;
                p.held.position_m(after_s) + shift
                    - length_m
                    - scenario.vehicle.reaction_time_s * car.held.speed_mps(after_s)
                    - scenario.vehicle.standstill_gap_m
            });
            let instant_s = now_s + after_s;
            metrics.leave(&visit, instant_s - car.entry_time_s, merge_margin_m);
            if let Some(visits) = &mut self.visits {
                visits.push(CompletedVisit {
                    vehicle: car.vehicle,
                    zone: index as u32,
                    entry_time_s: car.entry_time_s,
                    exit_time_s: instant_s,
                    exit_speed_mps: car.held.speed_mps(after_s),
                    energy: visit.energy,
                    fe_s: visit.fe_s,
                });
            }
            if first {
                last = Some((after_s, car));
            }
            let mut next = Car::entering(car.vehicle, 0, instant_s, car.held.speed_mps(after_s));
            next.x_m = car.held.position_m(dt_s) - length_m;
            next.v_mps = car.held.speed_mps(dt_s);
            next.u_mps2 = car.held.observed_mps2(dt_s);
            // The rest of the step is driven under the old command and paid for in the new zone.
            next.visit.energy = car.held.energy(dt_s) - car.held.energy(after_s);
            next.planned_exit_time_s = 0.0;
            match zone.exit {
                Exit::Out => {
                    self.departed += 1;
                    self.held_u_mps2[car.vehicle as usize] = 0.0;
                }
                Exit::Zone { zone, path, link_m } => {
                    next.path = path;
                    if link_m > 0.0 {
                        // Settled with the others on the link: its motion starts at the link's origin.
                        next.held = Held::new(car.held.x0_m - length_m, car.held.v0_mps, car.held.u_mps2);
                        self.links[index].cars.push(next);
                    } else {
                        self.entries.push(Entry { zone, car: next });
                    }
                }
            }
        }
        traffic.cars.truncate(kept);
        if let Some((_, car)) = last {
            traffic.left = Some(LeftCar { car, left_now: true });
        }
    }

    /// Takes vehicles off the end of a link into the next zone.
    fn leave_link(&mut self, scenario: &Scenario, index: usize, now_s: f64, dt_s: f64) {
        let Exit::Zone { zone, path, .. } = scenario.network.zones[index].exit else { return };
        let Link { length_m, cars } = &mut self.links[index];
        while let Some(car) = cars.first() {
            let Some(after_s) = car.held.passes_m(*length_m, dt_s) else { return };
            let mut next = Car::entering(car.vehicle, path, now_s + after_s, car.held.speed_mps(after_s));
            next.x_m = car.held.position_m(dt_s) - *length_m;
            next.v_mps = car.held.speed_mps(dt_s);
            next.u_mps2 = car.held.observed_mps2(dt_s);
            next.visit.energy = car.held.energy(dt_s) - car.held.energy(after_s);
            self.entries.push(Entry { zone, car: next });
            cars.remove(0);
        }
    }

    /// Lets arrivals of this step in, as far as the road ahead of them allows.
    fn admit(&mut self, scenario: &Scenario, now_s: f64, dt_s: f64) {
        self.gates.advance(scenario.time_s(self.step + 1));
        let vehicle = &scenario.vehicle;
        let gap_m = vehicle.length_m + vehicle.standstill_gap_m;
        for (index, road) in scenario.network.roads.iter().enumerate() {
            if self.gates.waiting[index].is_empty() {
                continue;
            }
            let traffic = &self.zones[road.zone as usize];
            let mut leader =
                traffic.cars.iter().rev().find(|c| c.path == road.path).map(|c| c.held).or_else(|| {
                    // It may have left in this very step; what matters is the road right behind it.
                    traffic.left.as_ref().filter(|l| l.car.path == road.path).map(|l| l.car.held)
                });
            while let Some(waiting) = self.gates.waiting[index].front_mut() {
                let mut speed_mps = waiting.arrival.speed_mps;
                // An arrival at the very end of the step may come out a rounding later.
                let mut after_s = (waiting.arrival.time_s - now_s).min(dt_s);
                if waiting.held {
                    after_s = dt_s;
                    speed_mps = leader.map_or(speed_mps, |l| speed_mps.min(l.speed_mps(dt_s)));
                }
                let free =
                    leader.is_none_or(|l| may_enter(&l, after_s, speed_mps, gap_m, vehicle.u_min_mps2, dt_s));
                if !free {
                    if !waiting.held {
                        waiting.held = true;
                        self.gates.held += 1;
                        continue;
                    }
                    break;
                }
                self.gates.waiting[index].pop_front();
                let id = self.held_u_mps2.len() as u32;
                self.held_u_mps2.push(0.0);
                let mut car = Car::entering(id, road.path, now_s + after_s, speed_mps);
                let held = Held::new(-speed_mps * after_s, speed_mps, 0.0);
                car.x_m = held.position_m(dt_s);
                self.entries.push(Entry { zone: road.zone, car });
                leader = Some(held);
            }
        }
    }

    /// Moves everyone who stays in a zone to the end of the step.
    fn settle(&mut self, zone: usize, dt_s: f64) {
        let traffic = &mut self.zones[zone];
        if let Some(left) = &mut traffic.left {
            move_on(&mut left.car, dt_s);
        }
        for car in &mut traffic.cars {
            car.visit.energy += car.held.energy(dt_s);
            car.entered = false;
            move_on(car, dt_s);
        }
    }

    /// Appends the newcomers to their zones, by instant of entry, then path.
    fn enter(&mut self) {
        self.entries.sort_by(|a, b| {
            let key = |e: &Entry| (e.zone, e.car.entry_time_s, e.car.path);
            key(a).partial_cmp(&key(b)).expect("instants of entry are finite")
        });
        for entry in &self.entries {
            self.zones[entry.zone as usize].cars.push(entry.car);
        }
    }
}

/// Moves a vehicle to the end of the step.
fn move_on(car: &mut Car, dt_s: f64) {
    car.x_m = car.held.position_m(dt_s);
    car.v_mps = car.held.speed_mps(dt_s);
    car.u_mps2 = car.held.observed_mps2(dt_s);
}

/// Updates the least rear-end margins over the step and notes, for vehicles seen for the first time,
/// whether their entry conditions hold.
fn account_margins(
    scenario: &Scenario,
    index: usize,
    traffic: &mut Traffic,
    metrics: &mut ZoneMetrics,
    dt_s: f64,
) {
    let zone = &scenario.network.zones[index];
    let (phi, gap) = (scenario.vehicle.reaction_time_s, scenario.vehicle.standstill_gap_m);
    for i in 0..traffic.cars.len() {
        let (before, rest) = traffic.cars.split_at_mut(i);
        let car = &mut rest[0];
        let left = traffic.left.as_ref().map(|l| &l.car);
        let ahead = before.iter().rev().find(|c| c.path == car.path).or(left.filter(|c| c.path == car.path));
        if car.entered {
            let previous = before.last().or(left).filter(|c| c.path != car.path);
            note_entry_conditions(scenario, zone, car, ahead, previous);
        }
        let Some(ahead) = ahead else { continue };
        let length_m = zone.approaches[car.path as usize].length_m;
        let within_s = car.held.passes_m(length_m, dt_s).unwrap_or(dt_s);
        let margin = car.held.least_margin_m(&ahead.held, 0.0, phi, gap, within_s);
        car.visit.least_rear_end_m = car.visit.least_rear_end_m.min(margin);
        metrics.overtakes += u32::from(ahead.x_m < car.x_m);
    }
}

fn note_entry_conditions(
    scenario: &Scenario,
    zone: &Zone,
    car: &mut Car,
    ahead: Option<&Car>,
    previous: Option<&Car>,
) {
    let (vehicle, control) = (&scenario.vehicle, &scenario.control);
    let length = |path: u32| zone.approaches[path as usize].length_m;
    let own_length_m = length(car.path);
    let pair = |x_m: f64, v_mps: f64, partner: &Car| Pair {
        x_m,
        v_mps,
        partner_x_m: partner.x_m + own_length_m - length(partner.path),
        partner_v_mps: partner.v_mps,
        partner_u_mps2: partner.u_mps2,
    };
    let Visit { clean_rear_end, clean_merge, .. } = &mut car.visit;
    if let Some(ahead) = ahead {
        let rear_end = RearEnd {
            reaction_s: vehicle.reaction_time_s,
            gap_m: vehicle.standstill_gap_m,
            k_per_s: control.k_rear_end_per_s,
            u_min_mps2: vehicle.u_min_mps2,
        };
        let pair = pair(car.x_m, car.v_mps, ahead);
        *clean_rear_end = rear_end.margin_m(&pair) >= 0.0
            && satisfiable_at(&rear_end.row(&pair), vehicle.u_min_mps2)
            && rear_end.reserve_mps(&pair) >= 0.0;
    }
    if let Some(previous) = previous {
        let merge = Merge {
            reaction_per_length: vehicle.reaction_time_s / own_length_m,
            gap_m: vehicle.standstill_gap_m,
            k_per_s: control.k_merge_per_s,
            u_min_mps2: vehicle.u_min_mps2,
        };
        let pair = pair(car.x_m, car.v_mps, previous);
        *clean_merge = merge.margin_m(&pair) >= 0.0
            && satisfiable_at(&merge.row(&pair), vehicle.u_min_mps2)
            && merge.reserve_mps(&pair) >= 0.0;
    }
}
