//! Entry roads: who arrives when, and who has to wait outside.

use crate::scenario::arrivals::ArrivalStream;
use crate::scenario::{Arrival, Circles, EntryRule, Road, Scenario, VehicleParams, ZoneId};
use crate::shield::{RESERVE_M, Seen, Shield};
use crate::vehicle::Held;
use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

/// Room in a road's queue from the beginning.
const QUEUE: usize = 16;

/// All entry roads.
#[derive(Debug)]
pub(super) struct Gates {
    pub streams: Vec<ArrivalStream>,
    /// The next arrival of each road.
    pub pending: Vec<Option<Arrival>>,
    /// Roads by their next arrival: instant (as ordered bits), then road order.
    pub next: BinaryHeap<Reverse<(u64, usize)>>,
    pub waiting: Vec<VecDeque<Waiting>>,
    /// Where somebody waits, by zone.
    pub queues: Vec<Queue>,
    pub left_to_generate: u32,
    pub held: u32,
    /// Circles of the network, and how many vehicles are inside that may come into each.
    pub circles: Circles,
    pub in_circles: Vec<u32>,
}

/// A road on which somebody waits to enter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Queue {
    pub zone: u32,
    pub road: u32,
    /// The road's entrance.
    pub segment: u32,
}

/// An arrival that has not entered yet.
#[derive(Clone, Copy, Debug)]
pub(super) struct Waiting {
    pub arrival: Arrival,
    /// It could not enter when it came.
    pub held: bool,
}

impl Gates {
    pub(super) fn new(scenario: &Scenario) -> Gates {
        let roads = &scenario.network.roads;
        let mut gates = Gates {
            streams: roads
                .iter()
                .zip(0..)
                .map(|(road, i)| ArrivalStream::new(road, i, scenario.seed))
                .collect(),
            pending: vec![None; roads.len()],
            next: BinaryHeap::with_capacity(roads.len()),
            waiting: roads.iter().map(|_| VecDeque::with_capacity(QUEUE)).collect(),
            queues: Vec::new(),
            left_to_generate: scenario.max_vehicles.unwrap_or(u32::MAX),
            held: 0,
            in_circles: Vec::new(),
            circles: Circles::of(scenario),
        };
        gates.in_circles = vec![0; gates.circles.capacity.len()];
        for road in 0..roads.len() {
            gates.draw(road);
        }
        gates
    }

    fn draw(&mut self, road: usize) {
        self.pending[road] = self.streams[road].next();
        if let Some(arrival) = self.pending[road] {
            // Instants are >= 0, so their bits are in the order of their values.
            self.next.push(Reverse((arrival.time_s.to_bits(), road)));
        }
    }

    /// Moves all arrivals up to `until_s` to their road's queue, in order of instant, then road.
    pub(super) fn advance(&mut self, roads: &[Road], until_s: f64) {
        let before = self.queues.len();
        self.collect(roads, until_s);
        if self.queues.len() > before {
            self.queues.sort_unstable();
        }
    }

    fn collect(&mut self, roads: &[Road], until_s: f64) {
        while self.left_to_generate > 0 {
            let Some(&Reverse((bits, road))) = self.next.peek() else { return };
            if f64::from_bits(bits) > until_s {
                return;
            }
            self.next.pop();
            let arrival = self.pending[road].take().expect("a queued road has a pending arrival");
            if self.waiting[road].is_empty() {
                let Road { zone, segment, .. } = roads[road];
                self.queues.push(Queue { zone, road: road as u32, segment });
            }
            self.waiting[road].push_back(Waiting { arrival, held: false });
            self.left_to_generate -= 1;
            self.draw(road);
        }
    }

    /// Whether the circles that a vehicle on a path may come into have room for it.
    pub(super) fn have_room(&self, zone: ZoneId, path: u32) -> bool {
        let Gates { circles, in_circles, .. } = self;
        circles.ahead_of(zone, path).iter().all(|&c| in_circles[c as usize] < circles.capacity[c as usize])
    }

    /// Counts a vehicle that passes from one path to another; before the first and behind the last there is none.
    pub(super) fn pass(&mut self, from: Option<(ZoneId, u32)>, to: Option<(ZoneId, u32)>) {
        let Gates { circles, in_circles, .. } = self;
        if in_circles.is_empty() {
            return;
        }
        let ahead =
            |at: Option<(ZoneId, u32)>| at.map_or(&[][..], |(zone, path)| circles.ahead_of(zone, path));
        ahead(to).iter().for_each(|&circle| in_circles[circle as usize] += 1);
        ahead(from).iter().for_each(|&circle| in_circles[circle as usize] -= 1);
    }

    /// Whether nobody will come any more and nobody waits.
    pub(super) fn exhausted(&self) -> bool {
        (self.left_to_generate == 0 || self.next.is_empty()) && self.queues.is_empty()
    }
}

/// A newcomer at the first sample after it would enter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Newcomer<'a> {
    pub own: &'a VehicleParams,
    pub x_m: f64,
    pub v_mps: f64,
}

/// Whether a road's gate lets a newcomer in behind `leader`, whose parameters are `other`; `reference` are those for which
/// standstill gaps are stated, `clearance_m` what is kept between bodies that stop.
pub(super) fn admits(
    rule: EntryRule,
    newcomer: Newcomer<'_>,
    (leader, other): (&Held, &VehicleParams),
    reference: &VehicleParams,
    clearance_m: f64,
    dt_s: f64,
) -> bool {
    let Newcomer { own, x_m, v_mps } = newcomer;
    let (shield, gap_m) = match rule {
        EntryRule::Free => return true,
        EntryRule::Viable => {
            let extra_m = (other.length_m - reference.length_m).max(0.0);
            (Shield::new(own, dt_s), own.standstill_gap_m + extra_m)
        }
        EntryRule::RoomToStop => (Shield::of_bodies(own, dt_s), other.length_m + clearance_m),
    };
    let seen = Seen {
        x_m: leader.position_m(dt_s),
        v_mps: leader.speed_mps(dt_s),
        gap_m,
        braking_mps2: -other.u_min_mps2,
    };
    shield.slack_m(x_m, v_mps, seen) >= RESERVE_M
}

/// Whether a vehicle may enter at speed `v_mps` behind `leader`, `after_s` into the step, without
/// overlapping it: now, or, should the leader keep its speed, in spite of braking fully from the next
/// sample on. It is not asked to keep the reaction distance; enforcing that is the controllers' business.
pub(super) fn may_enter(
    leader: &Held,
    after_s: f64,
    v_mps: f64,
    gap_m: f64,
    u_min_mps2: f64,
    dt_s: f64,
) -> bool {
    let closing_mps = (v_mps - leader.speed_mps(after_s)).max(0.0);
    let needed_m = closing_mps * dt_s + closing_mps * closing_mps / (2.0 * -u_min_mps2);
    leader.position_m(after_s) >= gap_m + needed_m
}
