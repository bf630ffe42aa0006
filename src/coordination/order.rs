//! Passing orders: who of a zone's vehicles passes before whom.
//!
//! Whatever the policy, an order is one list of the zone's vehicles, first to last, and at every conflict point those
//! that meet there pass in the order of the list. So nobody can wait in a circle within a zone: the first of the
//! list waits for nobody in it.

use super::assign::{Assigner, row};
use super::schedule::{Scene, Scheduler};
use crate::conflict::{Conflicts, Duties, Row, can_yield, has_gone_first, is_in_the_way, stands_on};
use crate::scenario::{HumanParams, PassingOrder, Scenario, VehicleKind, VehicleParams};
use crate::shield::{Shield, VIABLE_FROM_M, yielding_slack_m};
use ipc_schemas::{STATE_ENTERED, STATE_HUMAN, STATE_WAITS, VehicleState};

/// A vehicle that lets a newcomer pass first keeps at least this much slack, m: it is not to brake hard for it.
const YIELDING_SLACK_M: f64 = 0.5;
/// A newcomer is put ahead of no more than this many others that it meets.
const MOST_FORWARD: u32 = 3;
/// Nobody is passed more often in a zone than this.
const MOST_PASSED: u16 = 2;
/// A vehicle is not passed when it is nearer than this to where it meets the newcomer, m.
const LEAST_BEFORE_POINT_M: f64 = 60.0;
/// By how much an order must be cheaper to be preferred to that of entry.
const LEAST_GAIN: f64 = 0.02;

/// A zone's passing order as decided last.
#[derive(Debug, Default)]
pub(super) struct Order {
    /// The zone's vehicles, first to last.
    pub(super) vehicles: Vec<u32>,
    /// How often vehicles were passed by newcomers, of those that were.
    pub(super) passed: Vec<(u32, u16)>,
}

impl Order {
    fn times_passed(&self, vehicle: u32) -> u16 {
        self.passed.iter().find(|(other, _)| *other == vehicle).map_or(0, |(_, times)| *times)
    }

    fn is_passed(&mut self, vehicle: u32) {
        match self.passed.iter_mut().find(|(other, _)| *other == vehicle) {
            Some((_, times)) => *times += 1,
            None => self.passed.push((vehicle, 1)),
        }
    }
}

/// What deciding by cost takes.
pub(super) struct Means<'a> {
    pub(super) assigner: &'a mut Assigner,
    pub(super) scheduler: &'a mut Scheduler,
}

/// Decides orders; kept from use to use for its allocations.
#[derive(Debug)]
pub(super) struct Orders {
    /// By kind of vehicle.
    shields: Vec<Shield>,
    fleet: Vec<VehicleKind>,
    has_humans: bool,
    longest_m: f64,
    duties: Duties,
    /// An order that is tried.
    tried: Vec<u32>,
    /// Who stays ahead of a human.
    stay: Vec<u32>,
    /// Places a newcomer may be put at.
    places: Vec<usize>,
}

impl Orders {
    pub(super) fn new(scenario: &Scenario) -> Orders {
        let shields = scenario.fleet.iter().map(|kind| Shield::new(&kind.vehicle, scenario.dt_s()));
        Orders {
            shields: shields.collect(),
            fleet: scenario.fleet.clone(),
            has_humans: scenario.has_humans(),
            longest_m: scenario.fleet.iter().map(|kind| kind.vehicle.length_m).fold(0.0, f64::max),
            duties: Duties::default(),
            tried: Vec::new(),
            stay: Vec::new(),
            places: Vec::new(),
        }
    }

    /// Brings a zone's order up to date: `order` is the one decided last, and afterwards that of the zone's members.
    pub(super) fn update(
        &mut self,
        policy: PassingOrder,
        scene: &Scene<'_>,
        order: &mut Order,
        means: &mut Means<'_>,
    ) {
        let Scene { scenario, conflicts, slice, .. } = *scene;
        let members = &slice[slice.iter().take_while(|state| state.has_left()).count()..];
        self.has_humans |= slice.iter().any(is_human);
        if policy == PassingOrder::Fifo && !self.has_humans {
            order.vehicles.clear();
            order.vehicles.extend(members.iter().map(|state| state.vehicle));
            return;
        }
        // One that has come back within a step, by a way from the zone to itself, is a newcomer too.
        let stays = |state: &VehicleState| state.flags & STATE_ENTERED == 0;
        let is_member = |vehicle: u32| members.iter().any(|s| s.vehicle == vehicle && stays(s));
        order.vehicles.retain(|vehicle| is_member(*vehicle));
        order.passed.retain(|(vehicle, _)| is_member(*vehicle));
        for (at, state) in members.iter().enumerate() {
            if order.vehicles.contains(&state.vehicle) {
                continue;
            }
            match policy {
                PassingOrder::Fifo => {
                    let place = self.place_of_entry(scene, members, &order.vehicles, at);
                    order.vehicles.insert(place, state.vehicle);
                }
                PassingOrder::PerPoint => {
                    let place = self.place(scenario, conflicts, members, &order.vehicles, state);
                    order.vehicles.insert(place, state.vehicle);
                }
                PassingOrder::Resequenced => self.insert_where_cheapest(scene, members, order, state, means),
            }
        }
        if self.has_humans {
            self.let_humans_first(scene, members, order);
            self.let_others_pass(scene, members, order);
        }
    }

    /// Puts humans who stand and wait behind everybody who can go before them, and with them those that have to stay behind
    /// them: whom they wait for may be who was to wait for them.
    fn let_others_pass(&mut self, scene: &Scene<'_>, members: &[VehicleState], order: &mut Order) {
        if !members.iter().any(waits) {
            return;
        }
        let mut stay = std::mem::take(&mut self.stay);
        stay.clear();
        let state_of = |vehicle: u32| members.iter().find(|s| s.vehicle == vehicle);
        for state in order.vehicles.iter().copied().filter_map(state_of) {
            let mut behind = stay.iter().copied().filter_map(state_of);
            if waits(state) || !behind.all(|second| self.may_let_pass(scene, state, second)) {
                stay.push(state.vehicle);
            }
        }
        order.vehicles.sort_by_key(|vehicle| stay.contains(vehicle));
        self.stay = stay;
    }

    /// Whether one may pass before another that waits, or has to stay behind one that does.
    fn may_let_pass(&mut self, scene: &Scene<'_>, first: &VehicleState, second: &VehicleState) -> bool {
        if !waits(second) {
            return self.may_fall_behind(scene, first, second);
        }
        let Scene { scenario, conflicts, .. } = *scene;
        let (a, b) = (row(scenario, first, 0), row(scenario, second, 1));
        match meeting(conflicts, &a, &b) {
            Meeting::Nowhere => true,
            Meeting::OnALane => false,
            Meeting::AtPoints => !stands_on(conflicts, &b, &a),
        }
    }

    /// Puts humans who cannot be made to wait ahead of those that can: humans who do not follow the order, and newcomers
    /// who would learn too late that they are to wait.
    fn let_humans_first(&mut self, scene: &Scene<'_>, members: &[VehicleState], order: &mut Order) {
        let Scene { scenario, conflicts, .. } = *scene;
        for state in members {
            let obeys = self.obedient(state).is_some();
            let is_newcomer = state.flags & STATE_ENTERED != 0;
            if !is_human(state) || waits(state) || obeys && !is_newcomer {
                continue;
            }
            let vehicle = state.vehicle;
            let own_place =
                order.vehicles.iter().position(|v| *v == vehicle).expect("members are in the order");
            let own = row(scenario, state, 1);
            let before = &order.vehicles[..own_place];
            let before = || before.iter().rev().filter_map(|v| members.iter().find(|s| s.vehicle == *v));
            let waits = |other: &VehicleState| {
                let first = row(scenario, other, 0);
                let meets = meeting(conflicts, &first, &own) == Meeting::AtPoints;
                !meets || self.can_yield(conflicts, state, &first, &own)
            };
            if obeys && before().all(waits) {
                continue;
            }
            let is_moved = |orders: &mut Orders, other: &u32| {
                let second = members.iter().find(|s| s.vehicle == *other);
                second.is_some_and(|second| orders.is_to_fall_behind(scene, state, second))
            };
            if !order.vehicles[..own_place].iter().any(|other| is_moved(self, other)) {
                continue;
            }
            // Of those before it stay whoever has to, for its sake or for one that stays.
            let mut stay = std::mem::take(&mut self.stay);
            stay.clear();
            let state_of = |vehicle: u32| members.iter().find(|s| s.vehicle == vehicle);
            for at in (0..own_place).rev() {
                let Some(second) = state_of(order.vehicles[at]) else { continue };
                let mut ahead = std::iter::once(state).chain(stay.iter().copied().filter_map(state_of));
                if !ahead.all(|first| self.may_fall_behind(scene, first, second)) {
                    stay.push(second.vehicle);
                }
            }
            let is_ahead = |v: &u32| *v == vehicle || stay.contains(v);
            order.vehicles[..=own_place].sort_by_key(|v| !is_ahead(v));
            self.stay = stay;
        }
    }

    /// Whether one that was to pass before a human is to pass after it, if it may.
    fn is_to_fall_behind(&mut self, scene: &Scene<'_>, first: &VehicleState, second: &VehicleState) -> bool {
        let Scene { scenario, conflicts, .. } = *scene;
        let (a, b) = (row(scenario, first, 0), row(scenario, second, 1));
        let is_asked = match b.is_free {
            true => is_in_the_way(conflicts, &a, &b),
            false => meeting(conflicts, &a, &b) == Meeting::AtPoints,
        };
        is_asked && self.may_fall_behind(scene, first, second)
    }

    /// Whether one that was to pass before another may be told to let it, or does so anyway.
    fn may_fall_behind(&mut self, scene: &Scene<'_>, first: &VehicleState, second: &VehicleState) -> bool {
        let Scene { scenario, conflicts, .. } = *scene;
        let (a, b) = (row(scenario, first, 0), row(scenario, second, 1));
        match meeting(conflicts, &a, &b) {
            Meeting::Nowhere => return true,
            Meeting::OnALane => return false,
            Meeting::AtPoints => {}
        }
        // In the midst of a box it would wait for one that is to wait for it.
        if is_in_the_way(conflicts, &b, &a) && !is_in_the_way(conflicts, &a, &b) {
            return false;
        }
        if b.is_free {
            return is_human(first);
        }
        self.slack_m(conflicts, second, &a, &b) >= VIABLE_FROM_M
            || is_human(first) && has_gone_first(conflicts, &a, &b)
    }

    /// The driver of a vehicle, if it is a human who does as the order says.
    fn obedient(&self, state: &VehicleState) -> Option<(&HumanParams, &VehicleParams)> {
        let kind = &self.fleet[usize::from(state.kind).min(self.fleet.len() - 1)];
        let human = kind.human.as_ref().filter(|human| is_human(state) && human.obeys())?;
        Some((human, &kind.vehicle))
    }

    /// Whether a human can still let another pass first, if it does as it is told.
    fn can_yield(&self, conflicts: &Conflicts, state: &VehicleState, first: &Row, second: &Row) -> bool {
        self.obedient(state).is_some_and(|own| can_yield(own, conflicts, first, second, self.longest_m))
    }

    /// Puts a newcomer where the schedule of all costs least: at the end of the order, or ahead of up to three others that
    /// it meets, each of which is far enough from where they meet, was not passed twice in this zone before, and can let
    /// it pass; and the newcomer can let those ahead of it.
    ///
    /// Whom it does not meet, it goes ahead of without their being passed: nothing changes for them.
    fn insert_where_cheapest(
        &mut self,
        scene: &Scene<'_>,
        members: &[VehicleState],
        order: &mut Order,
        newcomer: &VehicleState,
        Means { assigner, scheduler }: &mut Means<'_>,
    ) {
        self.find_places(scene, members, order, newcomer);
        let end = order.vehicles.len();
        let Orders { tried, places, .. } = self;
        let (mut best, mut least) = (end, f64::INFINITY);
        for &place in places.iter().filter(|_| places.len() > 1) {
            tried.clear();
            tried.extend_from_slice(&order.vehicles);
            tried.insert(place, newcomer.vehicle);
            assigner.derive(scene, tried);
            let cost = scheduler.cost(scene, &assigner.queue());
            // The end of the order comes first, and must be undercut by something.
            let handicap = if place == end { 0.0 } else { LEAST_GAIN };
            if cost + handicap < least {
                (best, least) = (place, cost + handicap);
            }
        }
        let first = row(scene.scenario, newcomer, 0);
        for at in best..end {
            let vehicle = order.vehicles[at];
            let Some(state) = members.iter().find(|state| state.vehicle == vehicle) else { continue };
            if meeting(scene.conflicts, &first, &row(scene.scenario, state, 1)) != Meeting::Nowhere {
                order.is_passed(vehicle);
            }
        }
        order.vehicles.insert(best, newcomer.vehicle);
    }

    /// The places at which a newcomer may be put, the end of the order first.
    fn find_places(
        &mut self,
        scene: &Scene<'_>,
        members: &[VehicleState],
        order: &Order,
        newcomer: &VehicleState,
    ) {
        let Scene { scenario, conflicts, .. } = *scene;
        let first = row(scenario, newcomer, 0);
        let state_of = |vehicle: u32| members.iter().find(|state| state.vehicle == vehicle);
        self.places.clear();
        self.places.push(order.vehicles.len());
        let mut forward = 0;
        for (at, &vehicle) in order.vehicles.iter().enumerate().rev() {
            let Some(state) = state_of(vehicle) else { continue };
            let second = row(scenario, state, 1);
            match meeting(conflicts, &first, &second) {
                Meeting::Nowhere => continue,
                Meeting::OnALane => break,
                Meeting::AtPoints => {}
            }
            let uses = conflicts.uses(second.path).iter();
            let mut shared = uses.filter(|u| conflicts.uses(first.path).iter().any(|o| o.point == u.point));
            let is_far = shared.all(|u| u.at_m - second.x_m >= LEAST_BEFORE_POINT_M);
            if !is_far || order.times_passed(vehicle) >= MOST_PASSED || forward == MOST_FORWARD {
                break;
            }
            if self.slack_m(conflicts, state, &first, &second) < YIELDING_SLACK_M {
                break;
            }
            forward += 1;
            // Behind whom it is then, of those it meets.
            let before = order.vehicles[..at].iter().rev().filter_map(|&vehicle| state_of(vehicle));
            let mut before = before.map(|state| row(scenario, state, 0));
            let ahead = before.find(|ahead| meeting(conflicts, &first, ahead) != Meeting::Nowhere);
            let own = Row { id: 1, ..first };
            let can_follow =
                ahead.is_none_or(|ahead| self.slack_m(conflicts, newcomer, &ahead, &own) >= YIELDING_SLACK_M);
            if can_follow {
                self.places.push(at);
            }
        }
    }

    /// By how much the second can let the first pass, m; of a human, without bound or not at all.
    fn slack_m(&mut self, conflicts: &Conflicts, state: &VehicleState, first: &Row, second: &Row) -> f64 {
        if is_human(state) {
            let can = self.can_yield(conflicts, state, first, second);
            return if can { f64::INFINITY } else { f64::NEG_INFINITY };
        }
        let shield = &self.shields[usize::from(state.kind).min(self.shields.len() - 1)];
        yielding_slack_m(shield, conflicts, &mut self.duties, first, second)
    }

    /// Where the member at a place goes in order of entry: at the end, or before those behind it on its lane.
    fn place_of_entry(&self, scene: &Scene<'_>, members: &[VehicleState], order: &[u32], at: usize) -> usize {
        let paths = &scene.scenario.network.zones[members[at].zone as usize].paths;
        let entrance = |state: &VehicleState| paths[state.path as usize].segments[0];
        let (own, behind) = (entrance(&members[at]), &members[at + 1..]);
        let is_behind = |v: &u32| behind.iter().any(|s| s.vehicle == *v && entrance(s) == own);
        order.iter().position(is_behind).unwrap_or(order.len())
    }

    /// Where a newcomer goes: before everybody at the end of the order whom it does not meet, or who would reach
    /// each point at which they meet later than it (both as fast as they entered), and can let it pass.
    fn place(
        &mut self,
        scenario: &Scenario,
        conflicts: &Conflicts,
        members: &[VehicleState],
        order: &[u32],
        newcomer: &VehicleState,
    ) -> usize {
        let first = row(scenario, newcomer, 0);
        let mut place = order.len();
        for (at, vehicle) in order.iter().enumerate().rev() {
            let Some(state) = members.iter().find(|state| state.vehicle == *vehicle) else { continue };
            let second = row(scenario, state, 1);
            match meeting(conflicts, &first, &second) {
                Meeting::Nowhere => continue,
                Meeting::OnALane => break,
                Meeting::AtPoints => {}
            }
            let comes_first = conflicts.uses(first.path).iter().all(|own| {
                let theirs = conflicts.uses(second.path).iter().find(|u| u.point == own.point);
                theirs.is_none_or(|theirs| expected_s(newcomer, own.at_m) < expected_s(state, theirs.at_m))
            });
            if !comes_first || self.slack_m(conflicts, state, &first, &second) < YIELDING_SLACK_M {
                break;
            }
            place = at;
        }
        place
    }
}

/// Whether somebody drives a vehicle whom nobody commands.
fn is_human(state: &VehicleState) -> bool {
    state.flags & STATE_HUMAN != 0
}

/// Whether a human who does not follow the order stands and waits, or is behind one on its lane.
fn waits(state: &VehicleState) -> bool {
    state.flags & STATE_WAITS != 0
}

/// Where two vehicles meet.
fn meeting(conflicts: &Conflicts, first: &Row, second: &Row) -> Meeting {
    let mut on_a_lane = false;
    conflicts.runs((second.path, second.next_path), (first.path, first.next_path), |run| {
        on_a_lane |= run.from_m == 0.0 && run.other_from_m == 0.0;
    });
    let shares =
        |own: &crate::conflict::Use| conflicts.uses(second.path).iter().any(|u| u.point == own.point);
    match (on_a_lane, conflicts.uses(first.path).iter().any(shares)) {
        (true, _) => Meeting::OnALane,
        (false, true) => Meeting::AtPoints,
        (false, false) => Meeting::Nowhere,
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Meeting {
    Nowhere,
    /// They entered on one lane, on which nobody overtakes.
    OnALane,
    AtPoints,
}

/// When a vehicle would reach a place on its path if it drove on as it entered, s.
fn expected_s(state: &VehicleState, at_m: f64) -> f64 {
    state.entry_time_s + at_m / state.entry_speed_mps.max(0.1)
}
