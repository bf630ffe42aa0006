//! What the members of a zone owe to whom, worked out from its order at its events.

use super::car::Car;
use super::role::World;
use crate::conflict::{Conflicts, Duties, Duty, DutyKind, Row, can_yield, has_gone_first, stands_on};
use crate::scenario::{PassingOrder, Scenario, VehicleParams, Zone, ZoneId};
use crate::shield::{Partner, Shield, VIABLE_FROM_M, yielding_slack_m};
use crate::vehicle::Held;
use ipc_schemas::Assignment;

/// A duty of a member, its partner being the index of a car.
#[derive(Clone, Copy, Debug)]
pub(super) struct Owed {
    pub duty: Duty,
    /// Who the partner is; its index changes from event to event.
    pub partner: u32,
    pub standing: Standing,
}

/// Whether the vehicle was viable toward its partner when it came to owe it something: only then can the
/// shield hold it to its duty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Standing {
    /// Nobody has looked yet.
    Unknown,
    Safe,
    Unsafe,
}

impl Owed {
    /// Notes whether the vehicle is viable toward its partner as it comes to owe it something, unless nothing is in
    /// force yet. Returns whether it has found that it is not.
    pub(super) fn judge(&mut self, shield: &Shield, car: &Car, other: &Car, kinds: &[VehicleParams]) -> bool {
        let Some(partner) = self.partner(car, other, kinds) else { return false };
        let is_safe = shield.is_viable(car.x_m, car.v_mps, &partner);
        self.standing = if is_safe { Standing::Safe } else { Standing::Unsafe };
        !is_safe
    }

    /// The partner as the shield sees it, while something is owed to it. Nobody knows what a human will do in the step: it
    /// may brake fully.
    pub(super) fn partner(&self, car: &Car, other: &Car, kinds: &[VehicleParams]) -> Option<Partner> {
        let duty = &self.duty;
        let kind = duty.in_force(car.x_m, other.x_m)?;
        let u_min_mps2 = kinds[usize::from(other.kind)].u_min_mps2;
        let u_mps2 = if other.is_commanded { other.command_mps2 } else { u_min_mps2 };
        Some(Partner {
            kind,
            at_m: duty.own_m,
            gap_m: duty.gap_m,
            braking_mps2: -u_min_mps2,
            motion: Held::new(other.x_m + duty.shift_m(), other.v_mps, u_mps2),
        })
    }
}

/// The passing order of a zone that is not served in order of entry: vehicles, first to last.
#[derive(Debug, Default)]
pub(super) struct Order {
    known: Vec<u32>,
    /// What the coordinator has said last, and for which step: it counts in no other one.
    proposed: Option<(u64, Vec<u32>)>,
    refused: u32,
}

/// What deriving duties takes; kept for its allocations.
#[derive(Debug, Default)]
pub(super) struct Deriving {
    duties: Duties,
    rows: Vec<Row>,
    before: Vec<(u32, Owed)>,
    owed: Vec<Owed>,
    order: Vec<u32>,
}

impl World {
    /// Takes what a coordinator has decided for the present step: the passing orders of its zones. The duties are
    /// worked out from these, whatever else the assignments say.
    ///
    /// Zones whose order is that of entry need nobody to say so.
    pub fn coordinate(&mut self, assignments: &[Assignment]) {
        for group in assignments.chunk_by(|a, b| a.zone == b.zone) {
            let zone = group[0].zone;
            let shape = self.scenario.network.zones.get(zone as usize);
            if shape.is_none_or(|shape| self.is_in_order_of_entry(shape)) {
                continue;
            }
            let mut ranks: Vec<(u32, u32)> = group.iter().map(|a| (a.rank, a.vehicle)).collect();
            ranks.sort_unstable();
            ranks.dedup();
            let proposed = ranks.into_iter().map(|(_, vehicle)| vehicle).collect();
            self.orders.entry(zone).or_default().proposed = Some((self.step, proposed));
        }
    }

    /// Whether a coordinator has said another order for the present step than the one in force.
    fn is_reordered(&self, order: &Order) -> bool {
        order.proposed.as_ref().is_some_and(|(step, proposed)| *step == self.step && *proposed != order.known)
    }

    /// Brings the order of a zone that is not served in order of entry up to date: as proposed, if that is an order of
    /// its members that puts nobody in danger; otherwise as it was, with those that have entered since at the end.
    fn adopt_order(&mut self, scenario: &Scenario, zone: usize) {
        let first = self.zones[zone].first();
        let members = &self.cars[zone][first..];
        let Order { known, proposed, refused } = self.orders.entry(zone as u32).or_default();
        // One that has come back within a step, by a way from the zone to itself, is a newcomer too.
        known.retain(|vehicle| members.iter().any(|car| car.vehicle == *vehicle && !car.visit.entered));
        let paths = &scenario.network.zones[zone].paths;
        let entrance = |car: &Car| paths[car.path as usize].segments[0];
        for (at, car) in members.iter().enumerate() {
            if !known.contains(&car.vehicle) {
                // One that was brought in ahead of others on its lane passes before them.
                let behind = |v: &u32| {
                    members[at + 1..].iter().any(|c| c.vehicle == *v && entrance(c) == entrance(car))
                };
                known.insert(known.iter().position(behind).unwrap_or(known.len()), car.vehicle);
            }
        }
        let Some((step, proposed)) = proposed.take() else { return };
        // A zone that is told of its neighbours, and has no event itself, may have been spoken of before; since then
        // its last vehicle may have left, and of an empty zone nothing is said.
        if step != self.step || proposed == *known {
            return;
        }
        let car = |vehicle: u32| members.iter().find(|car| car.vehicle == vehicle);
        let is_whole =
            proposed.len() == known.len() && proposed.iter().all(|vehicle| known.contains(vehicle));
        let place = |vehicle: u32| known.iter().position(|known| *known == vehicle);
        let conflicts = &self.conflicts[zone];
        let duties = &mut self.scratch.duties.duties;
        // Whoever is to let somebody pass that it was to pass before must be able to.
        let is_safe = is_whole
            && proposed.iter().enumerate().all(|(at, &second)| {
                let before = proposed[..at].iter().filter(|&&other| place(other) > place(second));
                let mut before = before.filter_map(|&other| car(other));
                before.all(|first| {
                    let second = car(second).expect("the order is one of members");
                    let row = |car: &Car| row(car, &self.kinds, scenario, 0, false);
                    let (a, b) = (row(first), row(second));
                    match (first.is_commanded, second.is_commanded) {
                        // Humans among themselves are not held to anything.
                        (false, false) => return true,
                        (true, false) => {
                            let own = &self.kinds[usize::from(second.kind)];
                            let human = scenario.human(second.kind).filter(|human| human.obeys());
                            let can = |human| can_yield((human, own), conflicts, &a, &b, self.longest_m);
                            let waits = second.visit.waits && !stands_on(conflicts, &b, &a);
                            return !has_points_in_common(conflicts, &a, &b)
                                || waits
                                || human.is_some_and(can);
                        }
                        (false, true) if has_gone_first(conflicts, &a, &b) => return true,
                        (_, true) => {}
                    }
                    let shield = Shield::new(&self.kinds[usize::from(second.kind)], scenario.dt_s());
                    yielding_slack_m(&shield, conflicts, duties, &row(first), &row(second)) >= VIABLE_FROM_M
                })
            });
        if is_safe {
            *known = proposed;
        } else {
            *refused += 1;
        }
    }

    /// How often an order was proposed that the world did not adopt.
    pub(super) fn refused_orders(&self, zone: usize) -> u32 {
        self.orders.get(&(zone as u32)).map_or(0, |order| order.refused)
    }

    /// Works out who owes what in the zones whose vehicles, or whose passing order, have changed.
    pub(super) fn derive_duties(&mut self, scenario: &Scenario) {
        for at in 0..self.events.len() {
            self.derive_in(scenario, self.events[at] as usize);
        }
        if self.orders.is_empty() {
            return;
        }
        let reordered = self.orders.iter().filter(|(_, order)| self.is_reordered(order));
        let reordered: Vec<ZoneId> = reordered.map(|(zone, _)| *zone).collect();
        for zone in reordered {
            self.derive_in(scenario, zone as usize);
        }
    }

    /// Whether a zone's vehicles pass in the order in which they came, and nobody needs to say so.
    fn is_in_order_of_entry(&self, zone: &Zone) -> bool {
        zone.order == PassingOrder::Fifo && !self.has_humans
    }

    fn derive_in(&mut self, scenario: &Scenario, zone: usize) {
        let is_fifo = self.is_in_order_of_entry(&scenario.network.zones[zone]);
        if !is_fifo {
            self.adopt_order(scenario, zone);
        }
        let Deriving { duties, rows, before, owed, order } = &mut self.scratch.duties;
        let first = self.zones[zone].first();
        let cars = &mut self.cars[zone];
        order.clear();
        // Members are in order of entry.
        order.extend(first as u32..cars.len() as u32);
        if let (false, Some(Order { known, .. })) = (is_fifo, self.orders.get(&(zone as u32))) {
            let place = |at: u32| known.iter().position(|vehicle| *vehicle == cars[at as usize].vehicle);
            order.sort_by_key(|at| place(*at));
        }
        before.clear();
        for car in &cars[first..] {
            let own = &self.owed[zone][car.owed.0 as usize..car.owed.1 as usize];
            before.extend(own.iter().map(|owed| (car.vehicle, *owed)));
        }
        rows.clear();
        let kinds = &self.kinds;
        rows.extend((0..first as u32).chain(order.iter().copied()).map(|at| {
            let car = &cars[at as usize];
            row(car, kinds, scenario, at, (at as usize) < first)
        }));
        duties.derive(&self.conflicts[zone], rows);
        owed.clear();
        for (place, &at) in order.iter().enumerate() {
            let from = owed.len() as u32;
            for duty in duties.of(first + place) {
                let partner = cars[duty.partner as usize].vehicle;
                let vehicle = cars[at as usize].vehicle;
                let known = before
                    .iter()
                    .find(|(of, old)| *of == vehicle && is_same(&old.duty, old.partner, duty, partner));
                let standing = known.map_or(Standing::Unknown, |(_, old)| old.standing);
                owed.push(Owed { duty: *duty, partner, standing });
            }
            cars[at as usize].owed = (from, owed.len() as u32);
        }
        self.owed.set(zone, owed);
        self.order.set(zone, order);
    }
}

/// Whether two vehicles have a conflict point ahead of the second in common.
fn has_points_in_common(conflicts: &Conflicts, first: &Row, second: &Row) -> bool {
    let shared = |point: u32| conflicts.uses(first.path).iter().any(|u| u.point == point);
    conflicts.uses(second.path).iter().any(|own| own.at_m > second.x_m && shared(own.point))
}

/// Whether two duties of one vehicle are the same, seen at two events: a partner at a merge has become the leader.
fn is_same(old: &Duty, old_partner: u32, new: &Duty, new_partner: u32) -> bool {
    let crosses = |duty: &Duty| (duty.kind == DutyKind::Cross).then_some(duty.point);
    old_partner == new_partner && crosses(old) == crosses(new)
}

fn row(car: &Car, kinds: &[VehicleParams], scenario: &Scenario, id: u32, has_left: bool) -> Row {
    let Car { path, next_path, x_m, v_mps, kind, .. } = *car;
    let is_free = car.is_free(scenario);
    Row {
        path,
        next_path,
        x_m,
        v_mps,
        has_left,
        is_free,
        ..Row::new(&kinds[usize::from(kind)], &scenario.vehicle, id)
    }
}
