//! The world as a state machine: state frame out, command frames in, one step on.

use super::car::{Car, LeftCar};
use super::gate::Gates;
use super::gateway::Gateway;
use super::link::Link;
use super::metrics::{CompletedVisit, WorldSummary, ZoneMetrics};
use crate::scenario::share::{neighbour_coordinators, zones_of};
use crate::scenario::{Exit, Scenario};
use ipc_schemas::{self as frames, VehicleState};
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64_with_seed;

/// The world.
#[derive(Debug)]
pub struct World {
    pub(super) scenario: Arc<Scenario>,
    pub(super) step: u64,
    pub(super) zones: Vec<Traffic>,
    /// The link behind each zone's exit; never used when the length is 0.
    pub(super) links: Vec<Link>,
    pub(super) gates: Gates,
    /// Acceleration every vehicle so far holds over the step being integrated, by vehicle id; 0 once it
    /// has left the network. Lets a zone's index 0 move with the vehicle it stands for.
    pub(super) held_u_mps2: Vec<f64>,
    pub(super) departed: u32,
    pub(super) metrics: Vec<ZoneMetrics>,
    pub(super) entries: Vec<super::integrate::Entry>,
    /// Completed visits in the order in which they ended, when they are recorded.
    pub(super) visits: Option<Vec<CompletedVisit>>,
    state_hash: u64,
    /// Zones of each coordinator process, their neighbour processes, and who had an event.
    coordinators: Vec<CoordinatorShare>,
    /// Per zone: an event in the step just ended, an event one step earlier, acts in the present step.
    marks: Vec<ZoneMarks>,
    summarised: u64,
    pub(super) commanded: u32,
    pub(super) gateway: Gateway,
}

#[derive(Clone, Copy, Debug, Default)]
struct ZoneMarks {
    event: bool,
    event_before: bool,
    acts: bool,
}

/// The vehicles of one zone.
#[derive(Clone, Debug, Default)]
pub(super) struct Traffic {
    /// Index 0 of the paper's S(t).
    pub left: Option<LeftCar>,
    /// Members in order of entry.
    pub cars: Vec<Car>,
}

impl Traffic {
    fn record_count(&self) -> usize {
        self.cars.len() + usize::from(self.left.is_some())
    }

    /// Whether a vehicle entered or left in the step just ended.
    fn has_event(&self) -> bool {
        // Newcomers are appended, so the last member is one if any is.
        self.left.is_some_and(|l| l.left_now) || self.cars.last().is_some_and(|c| c.entered)
    }
}

#[derive(Debug)]
struct CoordinatorShare {
    zones: std::ops::Range<u32>,
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
        let links = network
            .zones
            .iter()
            .map(|z| match z.exit {
                Exit::Zone { link_m, .. } => Link { length_m: link_m, cars: Vec::new() },
                Exit::Out => Link::default(),
            })
            .collect();
        World {
            step: 0,
            zones: vec![Traffic::default(); zones],
            links,
            gates: Gates::new(&scenario),
            held_u_mps2: Vec::new(),
            departed: 0,
            metrics: vec![ZoneMetrics::default(); zones],
            entries: Vec::new(),
            visits: None,
            state_hash: 0,
            coordinators: shares,
            marks: vec![ZoneMarks::default(); zones],
            summarised: 0,
            commanded: 0,
            gateway: Gateway::new(&scenario, scenario.controllers(1)),
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
            || (self.gates.exhausted()
                && self.zones.iter().all(|z| z.cars.is_empty())
                && self.links.iter().all(|l| l.cars.is_empty()))
    }

    /// Keeps every visit completed from now on; nobody's motion or hash depends on it.
    pub fn record_visits(&mut self) {
        self.visits.get_or_insert_default();
    }

    /// The visits completed since [`record_visits`](Self::record_visits), zone by zone within a step.
    pub fn visits(&self) -> &[CompletedVisit] {
        self.visits.as_deref().unwrap_or_default()
    }

    /// Vehicles that have entered the network so far.
    pub fn arrived(&self) -> u32 {
        self.held_u_mps2.len() as u32
    }

    /// Vehicles that have left the network so far.
    pub fn departed(&self) -> u32 {
        self.departed
    }

    /// The number of records of the present state frame.
    pub fn record_count(&self) -> usize {
        let in_zones: usize = self.zones.iter().map(Traffic::record_count).sum();
        in_zones + self.links.iter().map(|l| l.cars.len()).sum::<usize>()
    }

    /// The number of records of the frame for a coordinator process.
    pub fn coordinator_record_count(&self, coordinator: u32) -> usize {
        self.acting_zones(coordinator).map(|z| self.zones[z].record_count()).sum()
    }

    /// The records of the frame for a coordinator process: those of its zones that act in this step.
    pub fn coordinator_records(&self, coordinator: u32) -> impl Iterator<Item = VehicleState> + '_ {
        self.acting_zones(coordinator).flat_map(|z| self.zone_records(z))
    }

    fn acting_zones(&self, coordinator: u32) -> impl Iterator<Item = usize> + '_ {
        let zones = self.coordinators[coordinator as usize].zones.clone();
        (zones.start as usize..zones.end as usize).filter(|&z| self.marks[z].acts)
    }

    /// The records of the present state frame (see [`VehicleState`] for their order).
    pub fn records(&self) -> impl Iterator<Item = VehicleState> + '_ {
        let in_zones = (0..self.zones.len()).flat_map(|z| self.zone_records(z));
        let on_links =
            self.links.iter().flat_map(|link| link.cars.iter().map(|c| self.record(c, frames::NO_ZONE, 0)));
        in_zones.chain(on_links)
    }

    /// A zone's S(t).
    fn zone_records(&self, zone: usize) -> impl Iterator<Item = VehicleState> + '_ {
        let traffic = &self.zones[zone];
        let left = traffic.left.iter().map(move |l| {
            let now = if l.left_now { frames::STATE_LEFT_NOW } else { 0 };
            self.record(&l.car, zone as u32, frames::STATE_LEFT | now)
        });
        let members = traffic
            .cars
            .iter()
            .map(move |c| self.record(c, zone as u32, if c.entered { frames::STATE_ENTERED } else { 0 }));
        left.chain(members)
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
            length_m: self.scenario.vehicle.length_m,
            vehicle: car.vehicle,
            zone,
            path: car.path,
            kind: frames::KIND_CAV,
            flags,
        }
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
        for (marks, traffic) in self.marks.iter_mut().zip(&self.zones) {
            marks.event_before = marks.event;
            marks.event = traffic.has_event();
        }
        for zone in 0..self.marks.len() {
            let told =
                self.scenario.network.neighbours(zone as u32).any(|n| self.marks[n as usize].event_before);
            self.marks[zone].acts = self.marks[zone].event || told;
        }
        let mut events = 0u64;
        for (i, share) in self.coordinators.iter().enumerate() {
            let own = &self.marks[share.zones.start as usize..share.zones.end as usize];
            if own.iter().any(|marks| marks.event) {
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
    /// The number of vehicles without a command, when there are any.
    pub fn advance(&mut self) -> Result<(), usize> {
        let vehicles: usize = self.zones.iter().map(|z| z.cars.len()).sum();
        let commanded = std::mem::take(&mut self.commanded) as usize;
        if commanded != vehicles {
            return Err(vehicles.abs_diff(commanded));
        }
        self.integrate();
        self.step += 1;
        Ok(())
    }

    /// The results so far.
    pub fn summary(&self) -> WorldSummary {
        let zones = self.scenario.network.zones.iter().zip(&self.metrics).zip(&self.zones);
        WorldSummary {
            steps: self.step,
            state_hash: self.state_hash,
            arrived: self.arrived(),
            departed: self.departed,
            held_arrivals: self.gates.held,
            waiting: self.gates.waiting.iter().map(|w| w.len() as u32).sum(),
            shield: self.gateway.summary(),
            zones: zones
                .map(|((zone, metrics), traffic)| {
                    let mut metrics = metrics.clone();
                    traffic.cars.iter().for_each(|car| metrics.observe(&car.visit));
                    metrics.row(&zone.name, self.scenario.beta)
                })
                .collect(),
        }
    }
}

/// Bit `i` stands for coordinator process `i`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoordinatorMasks {
    /// Processes that act in the present step.
    pub acting: u64,
    /// Processes that had an event, and sent summaries, in the previous step.
    pub summarised: u64,
}
