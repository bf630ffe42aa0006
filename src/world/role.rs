//! The world as a state machine: state frame out, command frames in, one step on.

use super::car::Car;
use super::faults::Faults;
use super::gate::Gates;
use super::gateway::Gateway;
use super::human::Humans;
use super::integrate::{Entry, Leader};
use super::link::Links;
use super::metrics::{CompletedVisit, WorldSummary, ZoneMetrics, ZoneSummaryRow};
use super::overlap::Overlaps;
use super::owed::{Order, Owed};
use super::standstill::Standstills;
use super::traffic::{AdvanceError, Played};
use crate::conflict::Conflicts;
use crate::lists::{AHEAD, Lists};
use crate::scenario::share::{neighbour_coordinators, zones_of};
use crate::scenario::{Scenario, VehicleParams, ZoneId};
use crate::vehicle::Held;
use either::Either;
use ipc_schemas::{self as frames, VehicleState};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use xxhash_rust::xxh3::{Xxh3, xxh3_64_with_seed};

/// The world.
///
/// What a step touches in every zone is kept in arrays by zone, as narrow as can be: in a large network the
/// time of a step is the time it takes to fetch them.
#[derive(Debug)]
pub struct World {
    pub(super) scenario: Arc<Scenario>,
    pub(super) step: u64,
    /// The paper's S(t) of each zone: those that left last (see [`ZoneState`]), and the members in order of
    /// entry.
    pub(super) cars: Lists<Car>,
    pub(super) zones: Vec<ZoneState>,
    /// Those that left last, of all zones.
    pub(super) left: usize,
    pub(super) conflicts: Vec<Conflicts>,
    /// Lengths of each zone's paths, m.
    pub(super) lengths_m: Lists<f64>,
    /// The duties of each zone's members, car by car, and the order in which members pass: indices of cars.
    pub(super) owed: Lists<Owed>,
    pub(super) order: Lists<u32>,
    /// Of zones that are not served in order of entry.
    pub(super) orders: BTreeMap<ZoneId, Order>,
    pub(super) links: Links,
    /// Parameters by kind of vehicle.
    pub(super) kinds: Vec<VehicleParams>,
    /// The greatest distance `phi v` any of them keeps, m.
    pub(super) reach_m: f64,
    /// The greatest length of any of them, m.
    pub(super) longest_m: f64,
    /// Whether some exit leads to a zone that does not come later.
    pub(super) closes_a_circle: bool,
    pub(super) gates: Gates,
    pub(super) arrived: u32,
    pub(super) departed: u32,
    pub(super) metrics: Vec<ZoneMetrics>,
    pub(super) overlaps: Overlaps,
    pub(super) standstills: Standstills,
    /// Completed visits in the order in which they ended, when they are recorded.
    pub(super) visits: Option<Vec<CompletedVisit>>,
    /// Zones that had an event in the step just ended, ascending.
    pub(super) events: Vec<ZoneId>,
    pub(super) scratch: Scratch,
    state_hash: u64,
    /// Zones of each coordinator process, their neighbour processes, and who had an event.
    coordinators: Vec<CoordinatorShare>,
    neighbours: Lists<ZoneId>,
    /// Zones to which their neighbours' events of the step before are new.
    told: Vec<ZoneId>,
    /// Zones that act in the present step, ascending.
    acting: Vec<ZoneId>,
    summarised: u64,
    pub(super) commanded: u32,
    pub(super) gateway: Gateway,
    pub(super) faults: Option<Box<Faults>>,
    /// Who moves the vehicles, where it is not the world itself.
    pub(super) played: Option<Box<Played>>,
    pub(super) humans: Option<Box<Humans>>,
    /// Whether there are, or may be, vehicles that somebody else drives; and how many of them are in zones.
    pub(super) has_humans: bool,
    pub(super) uncommanded: usize,
}

/// What there is to know of a zone beside its vehicles.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ZoneState {
    /// How many of the zone's cars have left it: index 0 of the paper's S(t), by each exit and toward each path
    /// behind it the one that left last, and whoever is not yet clear of a crossing.
    pub left: u32,
    /// Somebody left during the step just ended.
    pub left_now: bool,
}

impl ZoneState {
    /// Place of the first member among the zone's cars.
    pub(super) fn first(&self) -> usize {
        self.left as usize
    }
}

/// Records hashed at a time, and what the zone at the end has more: few enough for the innermost cache.
const BATCH: usize = 128;

/// Lists that live for a part of a step; kept for their allocations.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// Motion of each car of a zone over the step.
    pub motions: Vec<Held>,
    /// Vehicles about to enter a zone.
    pub entries: Vec<Entry>,
    /// What newcomers on a road find ahead of them.
    pub leaders: Vec<Leader>,
    /// A zone's cars and their motions while they are put together anew.
    pub cars: Vec<Car>,
    pub moved: Vec<Held>,
    /// Those that leave a zone, with the instant within the step, s, and their motion.
    pub leaving: Vec<(f64, Car, Held)>,
    /// Lanes on which somebody waits.
    pub held_up: Vec<u32>,
    /// Those that have left a zone and whose motion is assumed until it is known: zone and place.
    pub assumed: Vec<(ZoneId, usize)>,
    pub duties: super::owed::Deriving,
}

/// Where the records of a state frame are written, in order.
pub trait Sheet {
    /// Writes the next.
    fn push(&mut self, record: VehicleState);
    /// What has been written.
    fn written(&self) -> &[VehicleState];
}

#[derive(Debug)]
struct CoordinatorShare {
    zones: Range<u32>,
    neighbours: u64,
}

impl World {
    /// A world at step 0, before the first arrival, for a run with that many coordinator processes.
    pub fn new(scenario: Arc<Scenario>, coordinators: u32) -> World {
        let network = &scenario.network;
        let zones = network.zones.len();
        let shares = neighbour_coordinators(network, coordinators)
            .into_iter()
            .enumerate()
            .map(|(i, neighbours)| CoordinatorShare {
                zones: zones_of(zones as u32, i as u32, coordinators),
                neighbours,
            })
            .collect();
        let (mut lengths_m, mut neighbours) = (Lists::new(zones), Lists::new(zones));
        for (i, zone) in network.zones.iter().enumerate() {
            zone.paths.iter().for_each(|path| lengths_m.push(i, path.length_m));
            network.neighbours(i as ZoneId).for_each(|n| neighbours.push(i, n));
        }
        let kinds: Vec<VehicleParams> = scenario.fleet.iter().map(|kind| kind.vehicle).collect();
        World {
            step: 0,
            cars: Lists::new(zones),
            zones: vec![ZoneState::default(); zones],
            left: 0,
            conflicts: Conflicts::of_all(network),
            lengths_m,
            owed: Lists::new(zones),
            order: Lists::new(zones),
            orders: BTreeMap::new(),
            links: Links::of(network),
            reach_m: kinds.iter().map(|k| k.reaction_time_s * k.v_max_mps).fold(0.0, f64::max),
            longest_m: kinds.iter().map(|k| k.length_m).fold(0.0, f64::max),
            kinds,
            closes_a_circle: (0..)
                .zip(&network.zones)
                .any(|(zone, shape)| shape.exits.iter().filter_map(|exit| exit.to).any(|to| to.zone <= zone)),
            gates: Gates::new(&scenario),
            arrived: 0,
            departed: 0,
            metrics: vec![ZoneMetrics::default(); zones],
            overlaps: Overlaps::new(zones),
            standstills: Standstills::new(zones),
            visits: None,
            events: Vec::new(),
            scratch: Scratch::default(),
            state_hash: 0,
            coordinators: shares,
            neighbours,
            told: Vec::new(),
            acting: Vec::new(),
            summarised: 0,
            commanded: 0,
            gateway: Gateway::new(&scenario, scenario.controllers(1)),
            faults: Faults::of(&scenario),
            played: None,
            humans: Humans::of(&scenario),
            has_humans: scenario.has_humans(),
            uncommanded: 0,
            scenario,
        }
    }

    /// The scenario.
    pub fn scenario(&self) -> &Arc<Scenario> {
        &self.scenario
    }

    /// The present step.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// Simulated time of the present step, ns.
    pub fn time_ns(&self) -> u64 {
        self.step * self.scenario.dt_ns
    }

    /// Whether the run is over: all demand served, or out of time.
    pub fn is_finished(&self) -> bool {
        self.scenario.time_s(self.step) >= self.scenario.max_time_s
            || (self.everybody_has_come() && self.links.cars == 0 && self.member_count() == 0)
    }

    /// Vehicles in zones.
    fn member_count(&self) -> usize {
        self.cars.total() - self.left
    }

    /// The members of a zone in order of entry.
    pub(super) fn members(&self, zone: usize) -> &[Car] {
        &self.cars[zone][self.zones[zone].first()..]
    }

    /// Keeps every visit completed from now on; nobody's motion or hash depends on it.
    pub fn record_visits(&mut self) {
        self.visits.get_or_insert_default();
    }

    /// The visits completed since [`record_visits`](Self::record_visits), zone by zone within a step.
    pub fn visits(&self) -> &[CompletedVisit] {
        self.visits.as_deref().unwrap_or_default()
    }

    /// What the vehicles of a zone have cost so far, m^2/s^3: beta times the time they were in it, and their energy;
    /// those that have left it and those that are in it.
    pub fn zone_cost(&self, zone: ZoneId) -> f64 {
        let metrics = &self.metrics[zone as usize];
        let now_s = self.scenario.time_s(self.step);
        let cost = |time_s: f64, energy: f64| self.scenario.beta * time_s + energy;
        let inside =
            self.members(zone as usize).iter().map(|car| cost(now_s - car.entry_time_s, car.visit.energy));
        cost(metrics.time_s, metrics.energy) + inside.sum::<f64>()
    }

    /// Vehicles that have entered the network so far.
    pub fn arrived(&self) -> u32 {
        self.arrived
    }

    /// Vehicles that have left the network so far.
    pub fn departed(&self) -> u32 {
        self.departed
    }

    /// The number of records of the present state frame.
    pub fn record_count(&self) -> usize {
        self.cars.total() + self.links.cars
    }

    /// The number of records of the frame for a coordinator process.
    pub fn coordinator_record_count(&self, coordinator: u32) -> usize {
        self.acting_zones(coordinator).iter().map(|&z| self.cars[z as usize].len()).sum()
    }

    /// The records of the frame for a coordinator process: those of its zones that act in this step.
    pub fn coordinator_records(&self, coordinator: u32) -> impl Iterator<Item = VehicleState> + '_ {
        let zones = self.acting_zones(coordinator).iter();
        match self.sensor_faults() {
            None => Either::Left(zones.flat_map(|&z| self.zone_records(z))),
            Some(faults) => {
                Either::Right(zones.flat_map(move |&z| faults.measured_in(z, self.zone_records(z))))
            }
        }
    }

    fn acting_zones(&self, coordinator: u32) -> &[ZoneId] {
        within(&self.acting, &self.coordinators[coordinator as usize].zones)
    }

    /// The records of the present state frame (see [`VehicleState`] for their order).
    pub fn records(&self) -> impl Iterator<Item = VehicleState> + '_ {
        match self.sensor_faults() {
            None => Either::Left(self.true_records()),
            Some(faults) => Either::Right(faults.measured(self.true_records())),
        }
    }

    /// The faults, if they concern what is published.
    fn sensor_faults(&self) -> Option<&Faults> {
        self.faults.as_deref().filter(|faults| faults.has_sensors())
    }

    fn true_records(&self) -> impl Iterator<Item = VehicleState> + '_ {
        (0..self.zones.len() as ZoneId).flat_map(|z| self.zone_records(z)).chain(self.link_records())
    }

    fn link_records(&self) -> impl Iterator<Item = VehicleState> + '_ {
        // Most networks have no links: an empty range spares the walk over them.
        let links = if self.links.cars == 0 { &[][..] } else { &self.links.all[..] };
        links.iter().zip(0..).flat_map(move |(link, index)| {
            link.cars.iter().map(move |c| VehicleState {
                next_zone: link.to.zone,
                next_path: c.car.path,
                then_path: c.car.next_path,
                link: index,
                ..self.record(&c.car, frames::NO_ZONE, 0)
            })
        })
    }

    /// A zone's S(t).
    fn zone_records(&self, zone: ZoneId) -> impl Iterator<Item = VehicleState> + '_ {
        self.cars.fetch(zone as usize + AHEAD);
        let state = &self.zones[zone as usize];
        let left_flags = frames::STATE_LEFT | if state.left_now { frames::STATE_LEFT_NOW } else { 0 };
        let (left, members) = self.cars[zone as usize].split_at(state.first());
        let members = members.iter().map(move |c| {
            let entered = if c.visit.entered { frames::STATE_ENTERED } else { 0 };
            let passed = if c.visit.passes { frames::STATE_PASSED } else { 0 };
            let waits = if c.visit.waits { frames::STATE_WAITS } else { 0 };
            self.record(c, zone, entered | passed | waits)
        });
        left.iter().map(move |c| self.record(c, zone, left_flags)).chain(members)
    }

    fn record(&self, car: &Car, zone: u32, flags: u16) -> VehicleState {
        VehicleState {
            x_m: car.x_m,
            v_mps: car.v_mps,
            u_mps2: car.u_mps2,
            entry_time_s: car.entry_time_s,
            entry_speed_mps: car.entry_speed_mps,
            planned_exit_time_s: car.planned_exit_time_s,
            planned_exit_speed_mps: car.planned_exit_speed_mps,
            length_m: self.kinds[usize::from(car.kind)].length_m,
            vehicle: car.vehicle,
            zone,
            path: car.path,
            next_zone: car.next_zone,
            next_path: car.next_path,
            then_path: car.then_path,
            link: frames::NO_LINK,
            kind: car.kind,
            flags: if car.is_commanded { flags } else { flags | frames::STATE_HUMAN },
        }
    }

    /// Writes the records of the present state frame and chains them into the state hash:
    /// [`records`](Self::records) and [`seal`](Self::seal) in one, while what is written is near.
    pub fn publish(&mut self, sheet: &mut impl Sheet) {
        if self.record_count() <= BATCH || self.sensor_faults().is_some() {
            self.records().for_each(|record| sheet.push(record));
            self.seal(sheet.written());
            return;
        }
        let mut hash = Xxh3::with_seed(self.state_hash);
        let mut hashed = 0;
        for zone in 0..self.zones.len() {
            self.zone_records(zone as ZoneId).for_each(|record| sheet.push(record));
            let new = &sheet.written()[hashed..];
            if new.len() >= BATCH {
                hash.update(frames::bytes_of(new));
                hashed += new.len();
            }
        }
        self.link_records().for_each(|record| sheet.push(record));
        hash.update(frames::bytes_of(&sheet.written()[hashed..]));
        self.state_hash = hash.digest();
    }

    /// Chains a published state frame into the state hash.
    pub fn seal(&mut self, records: &[VehicleState]) {
        self.state_hash = xxh3_64_with_seed(frames::bytes_of(records), self.state_hash);
    }

    /// The state hash so far: XXH3 over each state frame, seeded with the hash before it.
    pub fn state_hash(&self) -> u64 {
        self.state_hash
    }

    /// Which coordinator processes act in the present step, and which sent summaries in the last one.
    ///
    /// A process acts when one of its zones has an event, when one had an event in the previous step
    /// (its other zones hear of it now), or when a neighbouring process had one then.
    pub fn coordinator_masks(&mut self) -> CoordinatorMasks {
        self.acting.clear();
        self.acting.append(&mut self.told);
        self.acting.extend_from_slice(&self.events);
        self.acting.sort_unstable();
        self.acting.dedup();
        let neighbours = self.events.iter().flat_map(|&zone| &self.neighbours[zone as usize]);
        self.told.extend(neighbours);
        let mut events = 0u64;
        for (i, share) in self.coordinators.iter().enumerate() {
            if !within(&self.events, &share.zones).is_empty() {
                events |= 1 << i;
            }
        }
        let summarised = std::mem::replace(&mut self.summarised, events);
        let mut acting = events | summarised;
        for (i, share) in self.coordinators.iter().enumerate() {
            if share.neighbours & summarised != 0 {
                acting |= 1 << i;
            }
        }
        CoordinatorMasks { acting, summarised }
    }

    /// Coordinator processes that have an event in the present step, one bit each.
    pub fn coordinators_with_events(&self) -> u64 {
        self.summarised
    }

    /// Integrates one step with the commands taken.
    ///
    /// # Errors
    /// When there are vehicles without a command, or whoever moves them cannot.
    pub fn advance(&mut self) -> Result<(), AdvanceError> {
        let vehicles = self.member_count() - self.uncommanded;
        let commanded = std::mem::take(&mut self.commanded) as usize;
        if commanded != vehicles {
            return Err(AdvanceError::Uncommanded(vehicles.abs_diff(commanded)));
        }
        self.integrate()?;
        self.step += 1;
        if let Some(mut faults) = self.faults.take_if(|faults| faults.has_sensors()) {
            faults.sense(self.step, self.scenario.time_s(self.step), self.true_records());
            self.faults = Some(faults);
        }
        Ok(())
    }

    /// The results so far.
    pub fn summary(&self) -> WorldSummary {
        let zones = self.scenario.network.zones.iter().zip(&self.metrics).enumerate();
        WorldSummary {
            steps: self.step,
            state_hash: self.state_hash,
            arrived: self.arrived(),
            departed: self.departed,
            held_arrivals: self.gates.held,
            waiting: self.gates.waiting.iter().map(|w| w.len() as u32).sum(),
            overlaps: self.overlaps.summary(),
            stalled: self.stalls(),
            shield: self.gateway.summary(),
            faults: self.faults.as_ref().map(|faults| faults.counts()),
            traffic: self.played.as_ref().map(|played| played.summary()),
            zones: zones
                .map(|(i, (zone, metrics))| {
                    let mut metrics = metrics.clone();
                    self.members(i).iter().for_each(|car| metrics.observe(&car.visit));
                    let row = metrics.row(&zone.name, self.scenario.beta);
                    ZoneSummaryRow { orders_refused: self.refused_orders(i), ..row }
                })
                .collect(),
        }
    }
}

/// Those of the zones, which ascend, that are in the range.
fn within<'a>(zones: &'a [ZoneId], range: &Range<ZoneId>) -> &'a [ZoneId] {
    let from = zones.partition_point(|&zone| zone < range.start);
    let to = zones.partition_point(|&zone| zone < range.end);
    &zones[from..to]
}

/// Bit `i` stands for coordinator process `i`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoordinatorMasks {
    /// Processes that act in the present step.
    pub acting: u64,
    /// Processes that had an event, and sent summaries, in the previous step.
    pub summarised: u64,
}
