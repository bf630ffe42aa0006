//! One step of the world: exact motion, exact crossing instants, cost and margin accounting.

use super::car::{Car, Visit};
use super::gate::{Queue, may_enter};
use super::link::{Link, LinkCar};
use super::metrics::CompletedVisit;
use super::role::World;
use crate::lanes::AHEAD;
use crate::scenario::{Exit, Scenario, ZoneId};
use crate::vehicle::{Held, Merge, Pair, RearEnd, satisfiable_at};
use ipc_schemas::{VERDICT_FE, VERDICT_INFEASIBLE};

/// A vehicle about to enter a zone at the end of the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    zone: ZoneId,
    car: Car,
}

/// The vehicle a newcomer on a road has ahead of it, if there is one, as it moves over the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Leader {
    road: u32,
    motion: Option<Held>,
}

impl World {
    /// Integrates from the present step to the next with the commands in force.
    pub(super) fn integrate(&mut self) {
        let scenario = self.scenario.clone();
        let dt_s = scenario.dt_s();
        let now_s = scenario.time_s(self.step);
        // Where vehicles in zones depend on nobody's command but their own, each zone settles what they hold
        // as its turn comes: what is downstream of it has not moved yet.
        let alone = self.on_links == 0 && self.gateway.is_off() && self.faults.is_none();
        if !alone {
            self.hold_all(&scenario, dt_s);
        }
        self.scratch.entries.clear();
        self.scratch.leaders.clear();
        self.events.clear();
        self.gates.advance(&scenario.network.roads, scenario.time_s(self.step + 1));
        if self.on_links > 0 {
            (0..self.links.len()).for_each(|zone| self.observe_link_overlaps(&scenario, zone, dt_s));
        }
        let mut queue = 0;
        // All that concerns a zone at one go, while its vehicles are in the cache. Motions start from the
        // step's beginning, so it does not matter which zone has moved on already.
        for zone in 0..self.sites.len() {
            self.cars.fetch(zone + AHEAD);
            if alone && self.sites[zone].has_left {
                self.hold_left(&scenario, zone);
            }
            let crosses = self.look(&scenario, zone, dt_s);
            self.observe_overlaps(&scenario, zone, dt_s, crosses);
            self.sites[zone].left_now = crosses;
            if crosses {
                self.cross(&scenario, zone, now_s, dt_s);
                self.events.push(zone as ZoneId);
            }
            while let Some(Queue { road, path, .. }) =
                self.gates.queues.get(queue).filter(|q| q.zone as usize == zone)
            {
                // The last of the path, be it one that has left in this very step: what matters is the road
                // right behind it.
                let at = self.cars[zone].iter().rposition(|c| c.path == *path);
                let motion = at.map(|at| self.scratch.motions[at]);
                self.scratch.leaders.push(Leader { road: *road, motion });
                queue += 1;
            }
            self.settle(zone, dt_s);
        }
        if self.on_links > 0 {
            for zone in 0..self.links.len() {
                self.leave_link(zone, now_s, dt_s);
                self.links[zone].cars.iter_mut().for_each(|c| c.car.move_on(&c.held, dt_s));
            }
        }
        self.admit(&scenario, now_s, dt_s);
        self.enter();
    }

    /// Works out the motions of a zone's cars, updates the least rear-end margins over the step, and notes,
    /// for vehicles seen for the first time, whether their entry conditions hold. Returns whether a vehicle
    /// passes the conflict point.
    fn look(&mut self, scenario: &Scenario, zone: usize, dt_s: f64) -> bool {
        let (phi, gap) = (scenario.vehicle.reaction_time_s, scenario.vehicle.standstill_gap_m);
        let lengths_m = &self.lengths_m[zone];
        let motions = &mut self.scratch.motions;
        let cars = &mut self.cars[zone];
        let mut crosses = false;
        motions.clear();
        motions.extend(cars.iter().map(Car::held));
        for i in self.sites[zone].first()..cars.len() {
            let (before, rest) = cars.split_at_mut(i);
            let (car, held) = (&mut rest[0], &motions[i]);
            match car.visit.verdict {
                VERDICT_FE => car.visit.fe_s += dt_s,
                VERDICT_INFEASIBLE => car.visit.infeasible = true,
                _ => {}
            }
            let ahead_at = before.iter().rposition(|c| c.path == car.path);
            if car.visit.entered {
                let previous = before.last().filter(|c| c.path != car.path);
                note_entry_conditions(scenario, lengths_m, car, ahead_at.map(|at| &before[at]), previous);
            }
            let after_s = held.passes_m(lengths_m[car.path as usize], dt_s);
            crosses |= after_s.is_some();
            let Some(at) = ahead_at else { continue };
            let margin = held.least_margin_m(&motions[at], 0.0, phi, gap, after_s.unwrap_or(dt_s));
            car.visit.least_rear_end_m = car.visit.least_rear_end_m.min(margin);
            if before[at].x_m < car.x_m {
                self.metrics[zone].overtakes += 1;
            }
        }
        crosses
    }

    /// Takes out the vehicles that pass the conflict point during the step and sends them on.
    fn cross(&mut self, scenario: &Scenario, zone: usize, now_s: f64, dt_s: f64) {
        let lengths_m = &self.lengths_m[zone];
        let site = &mut self.sites[zone];
        let metrics = &mut self.metrics[zone];
        let motions = &mut self.scratch.motions;
        let overlaps = &mut self.overlaps;
        let body_m = scenario.vehicle.length_m;
        let mut pass_over = |car: &Car, held: &Held, left_from: ZoneId| {
            let mut car = *car;
            car.move_on(held, dt_s);
            overlaps.keep_tail(zone, car, left_from, lengths_m[car.path as usize], body_m);
        };
        let first_member = site.first();
        let mut last: Option<(f64, Car, Held)> = None;
        let mut kept = first_member;
        let cars = &mut self.cars[zone];
        for i in first_member..cars.len() {
            let (car, held) = (cars[i], motions[i]);
            let length_m = lengths_m[car.path as usize];
            let Some(after_s) = held.passes_m(length_m, dt_s) else {
                (cars[kept], motions[kept]) = (car, held);
                kept += 1;
                continue;
            };
            let first = last.as_ref().is_none_or(|(instant, ..)| *instant <= after_s);
            // A member kept so far entered earlier and is still inside.
            metrics.order_violations += u32::from(kept > first_member || !first);
            let mut visit = car.visit;
            visit.energy += held.energy(after_s);
            // What has been kept has moved up, but never as far as the place before this one.
            let previous = i.checked_sub(1).map(|at| (&cars[at], &motions[at]));
            let merge_margin_m = previous.filter(|(p, _)| p.path != car.path).map(|(p, motion)| {
                let shift = length_m - lengths_m[p.path as usize];
                motion.position_m(after_s) + shift
                    - length_m
                    - scenario.vehicle.reaction_time_s * held.speed_mps(after_s)
                    - scenario.vehicle.standstill_gap_m
            });
            let instant_s = now_s + after_s;
            metrics.leave(&visit, instant_s - car.entry_time_s, merge_margin_m);
            if let Some(visits) = &mut self.visits {
                visits.push(CompletedVisit {
                    vehicle: car.vehicle,
                    zone: zone as u32,
                    entry_time_s: car.entry_time_s,
                    exit_time_s: instant_s,
                    exit_speed_mps: held.speed_mps(after_s),
                    energy: visit.energy,
                    fe_s: visit.fe_s,
                });
            }
            if first {
                if let Some((_, car, held)) = last.replace((after_s, car, held)) {
                    pass_over(&car, &held, zone as ZoneId);
                }
            } else {
                pass_over(&car, &held, zone as ZoneId);
            }
            let Exit::Zone { zone: down, path, link_m, .. } = site.exit else {
                self.departed += 1;
                continue;
            };
            let mut next = Car::entering(car.vehicle, path, instant_s, held.speed_mps(after_s));
            next.move_on(&held, dt_s);
            next.x_m -= length_m;
            // The rest of the step is driven under the old command and paid for in the new zone.
            next.visit.energy = held.energy(dt_s) - held.energy(after_s);
            if link_m > 0.0 {
                // Its motion starts at the link's origin.
                let held = Held::new(held.x0_m - length_m, held.v0_mps, held.u_mps2);
                self.links[zone].cars.push(LinkCar { car: next, held });
                self.on_links += 1;
            } else {
                self.scratch.entries.push(Entry { zone: down, car: next });
            }
        }
        let (_, car, held) = last.expect("somebody crosses");
        if site.has_left {
            pass_over(&cars[0], &motions[0], site.left_from);
        } else {
            // The first to leave makes room for itself.
            cars.copy_within(..kept, 1);
            motions.copy_within(..kept, 1);
            kept += 1;
            site.has_left = true;
            self.with_left += 1;
        }
        (cars[0], motions[0]) = (car, held);
        site.left_from = zone as ZoneId;
        self.cars.truncate(zone, kept);
    }

    /// Takes vehicles off the end of a link into the next zone.
    fn leave_link(&mut self, zone: usize, now_s: f64, dt_s: f64) {
        let Exit::Zone { zone: down, path, .. } = self.sites[zone].exit else { return };
        let Link { length_m, cars, .. } = &mut self.links[zone];
        let mut at = 0;
        // All of them: where one has passed another, the first in the list is not the foremost.
        while let Some(LinkCar { car, held }) = cars.get(at) {
            let Some(after_s) = held.passes_m(*length_m, dt_s) else {
                at += 1;
                continue;
            };
            let mut next = Car::entering(car.vehicle, path, now_s + after_s, held.speed_mps(after_s));
            next.move_on(held, dt_s);
            next.x_m -= *length_m;
            next.visit.energy = held.energy(dt_s) - held.energy(after_s);
            self.scratch.entries.push(Entry { zone: down, car: next });
            cars.remove(at);
            self.on_links -= 1;
        }
    }

    /// Lets arrivals of this step in, as far as the road ahead of them allows.
    fn admit(&mut self, scenario: &Scenario, now_s: f64, dt_s: f64) {
        let vehicle = &scenario.vehicle;
        let gap_m = vehicle.length_m + vehicle.standstill_gap_m;
        // Vehicles are numbered in order of road.
        self.scratch.leaders.sort_unstable_by_key(|leader| leader.road);
        for &Leader { road, motion: mut leader } in &self.scratch.leaders {
            let waiting_here = &mut self.gates.waiting[road as usize];
            let crate::scenario::Road { zone, path, .. } = scenario.network.roads[road as usize];
            while let Some(waiting) = waiting_here.front_mut() {
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
                waiting_here.pop_front();
                let id = self.arrived;
                self.arrived += 1;
                let mut car = Car::entering(id, path, now_s + after_s, speed_mps);
                let held = Held::new(-speed_mps * after_s, speed_mps, 0.0);
                car.x_m = held.position_m(dt_s);
                self.scratch.entries.push(Entry { zone, car });
                leader = Some(held);
            }
        }
        let waiting = &self.gates.waiting;
        self.gates.queues.retain(|queue| !waiting[queue.road as usize].is_empty());
    }

    /// Moves everyone who stays in a zone to the end of the step.
    fn settle(&mut self, zone: usize, dt_s: f64) {
        let (left, members) = self.cars[zone].split_at_mut(self.sites[zone].first());
        let (left_motions, motions) = self.scratch.motions.split_at(left.len());
        for (car, held) in left.iter_mut().zip(left_motions) {
            car.move_on(held, dt_s);
        }
        let mut fastest_mps = -1.0_f64;
        for (car, held) in members.iter_mut().zip(motions) {
            car.visit.energy += held.energy(dt_s);
            car.visit.entered = false;
            car.move_on(held, dt_s);
            fastest_mps = fastest_mps.max(car.v_mps);
        }
        self.standstills.observe(zone, self.step + 1, fastest_mps);
    }

    /// Appends the newcomers to their zones, by instant of entry, then path.
    fn enter(&mut self) {
        let entries = &mut self.scratch.entries;
        if entries.is_empty() {
            return;
        }
        entries.sort_by(|a, b| {
            let key = |e: &Entry| (e.zone, e.car.entry_time_s, e.car.path);
            key(a).partial_cmp(&key(b)).expect("instants of entry are finite")
        });
        for entry in entries {
            self.cars.push(entry.zone as usize, entry.car);
            self.events.push(entry.zone);
        }
        self.events.sort_unstable();
        self.events.dedup();
    }
}

fn note_entry_conditions(
    scenario: &Scenario,
    lengths_m: &[f64],
    car: &mut Car,
    ahead: Option<&Car>,
    previous: Option<&Car>,
) {
    let (vehicle, control) = (&scenario.vehicle, &scenario.control);
    let length = |path: u32| lengths_m[path as usize];
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
