//! One step of the world: exact motion, exact crossing instants, cost and margin accounting.

use super::car::{Beyond, Car};
use super::gate::{Newcomer, Queue, Waiting, admits, may_enter};
use super::link::{Link, LinkCar};
use super::metrics::CompletedVisit;
use super::owed::{Owed, Standing};
use super::role::{Scratch, World};
use super::traffic::{Admitted, AdvanceError};
use super::way::Ways;
use crate::conflict::DutyKind;
use crate::lists::AHEAD;
use crate::scenario::{Downstream, EntryRule, Road, Scenario, ZoneId};
use crate::vehicle::Held;
use ipc_schemas::{VERDICT_FE, VERDICT_INFEASIBLE};

/// A vehicle about to enter a zone at the end of the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    pub zone: ZoneId,
    pub car: Car,
}

/// The vehicle a newcomer on a road has ahead of it, if there is one, as it moves over the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Leader {
    road: u32,
    /// With its kind.
    motion: Option<(Held, u16)>,
}

/// What a look at a zone finds of the coming step.
#[derive(Clone, Copy, Debug)]
struct Looked {
    /// Somebody leaves it.
    crosses: bool,
    /// A human who does not follow the passing order passes a conflict point.
    passes: bool,
}

impl World {
    /// Integrates from the present step to the next with the commands in force.
    pub(super) fn integrate(&mut self) -> Result<(), AdvanceError> {
        let scenario = self.scenario.clone();
        let dt_s = scenario.dt_s();
        let now_s = scenario.time_s(self.step);
        self.derive_duties(&scenario);
        self.drive_humans();
        // Where vehicles in zones depend on nobody's command but their own, each zone settles what they hold
        // as its turn comes: what is downstream of it has not moved yet.
        let alone =
            self.links.cars == 0 && self.gateway.is_off() && self.faults.is_none() && !self.closes_a_circle;
        let alone = alone && self.played.is_none();
        if !alone {
            self.hold_all(&scenario, dt_s);
        }
        self.follow_traffic(dt_s)?;
        self.scratch.entries.clear();
        self.scratch.leaders.clear();
        self.events.clear();
        let is_brought = self.played.as_ref().is_some_and(|played| played.brings());
        if !is_brought {
            self.gates.advance(&scenario.network.roads, scenario.time_s(self.step + 1));
        }
        for link in 0..if self.links.cars > 0 { self.links.all.len() } else { 0 } {
            self.observe_link_overlaps(&scenario, link, dt_s);
        }
        let mut queue = 0;
        // All that concerns a zone at one go, while its vehicles are in the cache. Motions start from the
        // step's beginning, so it does not matter which zone has moved on already.
        for zone in 0..self.zones.len() {
            self.cars.fetch(zone + AHEAD);
            if alone {
                self.hold_left(&scenario, zone, false);
            }
            let Looked { crosses, passes } = self.look(&scenario, zone, dt_s);
            self.observe_overlaps(&scenario, zone, dt_s);
            self.zones[zone].left_now = crosses;
            if crosses {
                self.cross(&scenario, zone, now_s, dt_s);
            }
            let waits = self.observe_waiting(&scenario, zone, dt_s);
            if crosses || passes || waits {
                self.events.push(zone as ZoneId);
            }
            while let Some(Queue { road, segment, .. }) =
                self.gates.queues.get(queue).filter(|q| q.zone as usize == zone)
            {
                // The last to enter here, be it one that has left in this very step: what matters is the road
                // right behind it.
                let paths = &scenario.network.zones[zone].paths;
                let at = self.cars[zone].iter().rposition(|c| paths[c.path as usize].segments[0] == *segment);
                let motion = at.map(|at| (self.scratch.motions[at], self.cars[zone][at].kind));
                self.scratch.leaders.push(Leader { road: *road, motion });
                queue += 1;
            }
            self.settle(zone, dt_s);
        }
        if self.links.cars > 0 {
            for link in 0..self.links.all.len() {
                self.leave_link(link, now_s, dt_s);
                self.links.all[link].cars.iter_mut().for_each(|c| c.car.move_on(&c.held, dt_s));
            }
        }
        match is_brought {
            true => self.let_in(&scenario, now_s, dt_s)?,
            false => self.admit(&scenario, now_s, dt_s),
        }
        self.enter(&scenario);
        self.close_step()
    }

    /// Works out the motions of a zone's cars, updates the least margins over the step, and judges, when a vehicle
    /// comes to owe somebody something, whether it is viable toward it.
    fn look(&mut self, scenario: &Scenario, zone: usize, dt_s: f64) -> Looked {
        let lengths_m = &self.lengths_m[zone];
        let owed = &mut self.owed[zone];
        let metrics = &mut self.metrics[zone];
        let motions = &mut self.scratch.motions;
        let cars = &mut self.cars[zone];
        let mut looked = Looked { crosses: false, passes: false };
        motions.clear();
        motions.extend(cars.iter().map(Car::held));
        for i in self.zones[zone].first()..cars.len() {
            let (car, held) = (cars[i], &motions[i]);
            let owed = &mut owed[car.owed.0 as usize..car.owed.1 as usize];
            let own = &self.kinds[usize::from(car.kind)];
            let mut visit = car.visit;
            match visit.verdict {
                VERDICT_FE => visit.fe_s += dt_s,
                VERDICT_INFEASIBLE => visit.infeasible = true,
                _ => {}
            }
            let after_s = held.passes_m(lengths_m[car.path as usize], dt_s);
            looked.crosses |= after_s.is_some();
            let mut lacks_m = 0.0_f64;
            if car.is_free(scenario) {
                let mut uses = self.conflicts[zone].uses(car.path).iter();
                visit.passes = uses.any(|u| u.at_m > car.x_m && held.passes_m(u.at_m, dt_s).is_some());
                looked.passes |= visit.passes;
            }
            // What humans keep is theirs to judge.
            for owed in if car.is_commanded { owed } else { &mut [][..] } {
                let other = &cars[owed.duty.partner as usize];
                if owed.standing == Standing::Unknown {
                    owed.judge(&self.gateway.shields[usize::from(car.kind)], &car, other, &self.kinds);
                }
                let Owed { duty, standing, .. } = &*owed;
                let Some(kind) = duty.in_force(car.x_m, other.x_m) else { continue };
                let is_clean = match kind {
                    DutyKind::RearEnd => &mut visit.clean_rear_end,
                    DutyKind::Merge | DutyKind::Cross => &mut visit.clean_merge,
                };
                *is_clean &= *standing != Standing::Unsafe;
                let motion = &motions[duty.partner as usize];
                if kind == DutyKind::RearEnd {
                    let end_s = after_s.unwrap_or(dt_s);
                    let (phi, shift_m) = (own.reaction_time_s, duty.shift_m());
                    let margin = held.least_margin_m(motion, shift_m, phi, duty.gap_m, end_s);
                    visit.least_rear_end_m = visit.least_rear_end_m.min(margin);
                    let now_m = other.x_m + shift_m - car.x_m - phi * car.v_mps - duty.gap_m;
                    lacks_m = lacks_m.max(-now_m);
                    metrics.overtakes += u32::from(other.x_m + shift_m < car.x_m);
                    continue;
                }
                let Some(passes_s) = held.passes_m(duty.own_m, dt_s) else { continue };
                let there_m = motion.position_m(passes_s);
                metrics.order_violations += u32::from(there_m < duty.partner_m);
                let margin = there_m + duty.shift_m()
                    - duty.own_m
                    - own.reaction_time_s * held.speed_mps(passes_s)
                    - duty.gap_m;
                let least =
                    if kind == DutyKind::Merge { &mut visit.least_merge_m } else { &mut visit.least_cross_m };
                *least = least.min(margin);
            }
            // By trapezoids: the first sample counts for half a step.
            let counts_s = if visit.entered { 0.5 * dt_s } else { after_s.unwrap_or(dt_s) };
            visit.exposure_m_s += lacks_m * counts_s;
            cars[i].visit = visit;
        }
        looked
    }

    /// Takes out the vehicles that leave the zone during the step and sends them on.
    fn cross(&mut self, scenario: &Scenario, zone: usize, now_s: f64, dt_s: f64) {
        let shape = &scenario.network.zones[zone];
        let ways = Ways::of(scenario);
        let lengths_m = &self.lengths_m[zone];
        let Scratch { motions, cars: kept, moved, entries, leaving, .. } = &mut self.scratch;
        leaving.clear();
        kept.clear();
        moved.clear();
        let first = self.zones[zone].first();
        let cars = &self.cars[zone];
        kept.extend_from_slice(&cars[..first]);
        moved.extend_from_slice(&motions[..first]);
        // Those that leave at one instant leave in passing order: one may stand at the end that another comes through.
        for &at in &self.order[zone] {
            let (car, held) = (&cars[at as usize], &motions[at as usize]);
            let Some(after_s) = held.passes_m(lengths_m[car.path as usize], dt_s) else { continue };
            let exit = shape.paths[car.path as usize].exit;
            let beyond = Beyond { zone: zone as ZoneId, exit, next_exit: 0 };
            leaving.push((after_s, Car { beyond, ..*car }, *held));
        }
        leaving.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (after_s, car, held) in &*leaving {
            let (after_s, length_m) = (*after_s, lengths_m[car.path as usize]);
            let exit = car.beyond.exit;
            self.uncommanded -= usize::from(!car.is_commanded);
            let mut visit = car.visit;
            visit.energy += held.energy(after_s);
            let instant_s = now_s + after_s;
            self.metrics[zone].leave(&visit, instant_s - car.entry_time_s);
            if let Some(visits) = &mut self.visits {
                visits.push(CompletedVisit {
                    vehicle: car.vehicle,
                    zone: zone as u32,
                    entry_time_s: car.entry_time_s,
                    exit_time_s: instant_s,
                    exit_speed_mps: held.speed_mps(after_s),
                    energy: visit.energy,
                    fe_s: visit.fe_s,
                    wait_s: visit.wait_s,
                    exposure_m_s: visit.exposure_m_s,
                });
            }
            let to = shape.exits[exit as usize].to;
            let onward = to.map(|to| (to.zone, car.next_path));
            self.gates.pass(Some((zone as ZoneId, car.path)), onward);
            if let Some(humans) = &mut self.humans {
                match to {
                    Some(_) => humans.pass(car.vehicle, length_m, false),
                    None => humans.forget(car.vehicle),
                }
            }
            let Some(Downstream { zone: down, link_m, .. }) = to else {
                self.departed += 1;
                continue;
            };
            let mut next = car.passing(instant_s, held.speed_mps(after_s));
            next.move_on(held, dt_s);
            next.x_m -= length_m;
            // The rest of the step is driven under the old command and paid for in the new zone.
            next.visit.energy = held.energy(dt_s) - held.energy(after_s);
            next.turn(ways.onward(next.way(), next.vehicle, down));
            if link_m > 0.0 {
                // Its motion starts at the link's origin.
                let held = Held::new(held.x0_m - length_m, held.v0_mps, held.u_mps2);
                let link = self.links.behind(zone as ZoneId, exit).expect("an exit with a link has one");
                self.links.all[link].cars.push(LinkCar { car: next, held });
                self.links.cars += 1;
            } else {
                entries.push(Entry { zone: down, car: next });
            }
        }
        kept.extend(leaving.iter().map(|(_, car, _)| *car));
        moved.extend(leaving.iter().map(|(.., held)| *held));
        // Of those that have left the last toward each way stays, and whoever may still stand in a conflict area.
        let (conflicts, kinds) = (&self.conflicts[zone], &self.kinds);
        let way = |car: &Car| (conflicts.exit(car.path), car.next_path);
        let mut left = 0;
        for at in 0..kept.len() {
            let car = kept[at];
            let is_last = !kept[at + 1..].iter().any(|later| way(later) == way(&car));
            let own = &kinds[usize::from(car.kind)];
            let reach_m = self.reach_m;
            let clears_m = conflicts.clears_behind_m(car.path, own.length_m, reach_m);
            if is_last || car.x_m - lengths_m[car.path as usize] < clears_m {
                (kept[left], moved[left]) = (car, moved[at]);
                left += 1;
            } else {
                let mut car = car;
                car.move_on(&moved[at], dt_s);
                self.overlaps.keep_tail(zone, car, lengths_m[car.path as usize] + own.length_m);
            }
        }
        kept.truncate(left);
        moved.truncate(left);
        for (car, held) in cars[first..].iter().zip(&motions[first..]) {
            if held.passes_m(lengths_m[car.path as usize], dt_s).is_none() {
                kept.push(*car);
                moved.push(*held);
            }
        }
        self.left = self.left + left - first;
        self.zones[zone].left = left as u32;
        self.cars.set(zone, kept);
        std::mem::swap(motions, moved);
    }

    /// Takes vehicles off the end of a link into the next zone.
    fn leave_link(&mut self, link: usize, now_s: f64, dt_s: f64) {
        let Link { to, cars, .. } = &mut self.links.all[link];
        let mut at = 0;
        // All of them: where one has passed another, the first in the list is not the foremost.
        while let Some(LinkCar { car, held }) = cars.get(at) {
            let Some(after_s) = held.passes_m(to.link_m, dt_s) else {
                at += 1;
                continue;
            };
            let mut next = car.passing(now_s + after_s, held.speed_mps(after_s));
            next.move_on(held, dt_s);
            next.x_m -= to.link_m;
            next.visit.energy = held.energy(dt_s) - held.energy(after_s);
            if let Some(humans) = &mut self.humans {
                humans.pass(next.vehicle, to.link_m, true);
            }
            self.scratch.entries.push(Entry { zone: to.zone, car: next });
            cars.remove(at);
            self.links.cars -= 1;
        }
    }

    /// Lets arrivals of this step in, as far as the road ahead of them allows.
    fn admit(&mut self, scenario: &Scenario, now_s: f64, dt_s: f64) {
        let ways = Ways::of(scenario);
        // Vehicles are numbered in order of road.
        self.scratch.leaders.sort_unstable_by_key(|leader| leader.road);
        for &Leader { road, motion: mut leader } in &self.scratch.leaders {
            let Road { zone, entry, .. } = scenario.network.roads[road as usize];
            let (reference, clearance_m) = (&scenario.vehicle, scenario.control.viable.clearance_m);
            while let Some(&Waiting { arrival, held }) = self.gates.waiting[road as usize].front() {
                let id = self.arrived;
                let way = ways.at_road(road, id, arrival.route);
                let kind = scenario.kind_of(id, road);
                let own = &self.kinds[usize::from(kind)];
                let mut speed_mps = arrival.speed_mps;
                // An arrival at the very end of the step may come out a rounding later.
                let mut after_s = (arrival.time_s - now_s).min(dt_s);
                if held {
                    after_s = dt_s;
                    // Where a gate waits for distance, nobody has to enter as slowly as the one ahead.
                    if entry == EntryRule::Free {
                        speed_mps = leader.map_or(speed_mps, |(l, _)| speed_mps.min(l.speed_mps(dt_s)));
                    }
                }
                let newcomer = Newcomer { own, x_m: speed_mps * (dt_s - after_s), v_mps: speed_mps };
                let free = leader.is_none_or(|(motion, kind): (Held, u16)| {
                    let other = &self.kinds[usize::from(kind)];
                    let gap_m = other.length_m + own.standstill_gap_m;
                    may_enter(&motion, after_s, speed_mps, gap_m, own.u_min_mps2, dt_s)
                        && admits(entry, newcomer, (&motion, other), reference, clearance_m, dt_s)
                });
                let has_room = self.gates.have_room(zone, way.path);
                let waiting_here = &mut self.gates.waiting[road as usize];
                if !free || !has_room {
                    if !held {
                        waiting_here.front_mut().expect("somebody waits").held = true;
                        self.gates.held += 1;
                        continue;
                    }
                    break;
                }
                waiting_here.pop_front();
                self.gates.pass(None, Some((zone, way.path)));
                self.arrived += 1;
                let mut car = Car::arriving(id, way, kind, now_s + after_s, speed_mps);
                car.visit.wait_s = now_s + after_s - arrival.time_s;
                let held = Held::new(-speed_mps * after_s, speed_mps, 0.0);
                car.x_m = held.position_m(dt_s);
                car.is_commanded = !self.humans.as_ref().is_some_and(|humans| humans.drive(kind));
                if let Some(played) = &mut self.played {
                    let (kind, way) = (u32::from(kind), ways.whole(way, id, zone));
                    let Car { x_m, v_mps, .. } = car;
                    let is_commanded = true;
                    let admitted = Admitted { vehicle: id, kind, road, x_m, v_mps, way, is_commanded };
                    played.admitted.push(admitted);
                }
                self.scratch.entries.push(Entry { zone, car });
                leader = Some((held, kind));
            }
        }
        let waiting = &self.gates.waiting;
        self.gates.queues.retain(|queue| !waiting[queue.road as usize].is_empty());
    }

    /// Moves everyone who stays in a zone to the end of the step.
    fn settle(&mut self, zone: usize, dt_s: f64) {
        let (left, members) = self.cars[zone].split_at_mut(self.zones[zone].first());
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
    fn enter(&mut self, scenario: &Scenario) {
        let entries = &mut self.scratch.entries;
        if entries.is_empty() {
            return;
        }
        // Those that enter at one instant are in the order in which they left the zone or the link before.
        entries.sort_by(|a, b| a.zone.cmp(&b.zone).then(a.car.entry_time_s.total_cmp(&b.car.entry_time_s)));
        for entry in entries {
            let zone = entry.zone as usize;
            // Only whoever is brought in may be ahead of others on its lane: they pass behind it.
            let place = self.played.as_ref().and_then(|_| {
                let paths = &scenario.network.zones[zone].paths;
                let entrance = |car: &Car| paths[car.path as usize].segments[0];
                let (car, first) = (&entry.car, self.zones[zone].first());
                let is_behind = |other: &Car| entrance(other) == entrance(car) && other.x_m < car.x_m;
                self.cars[zone][first..].iter().position(is_behind).map(|place| first + place)
            });
            self.cars.push(zone, entry.car);
            self.uncommanded += usize::from(!entry.car.is_commanded);
            if let Some(place) = place {
                self.cars[zone][place..].rotate_right(1);
            }
            self.events.push(entry.zone);
        }
        self.events.sort_unstable();
        self.events.dedup();
    }
}
