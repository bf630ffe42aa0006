//! Every vehicle's way through the network, put together from its states and visits.

use crate::fcd::is_present;
use crate::walk::Moment;
use control_zones::scenario::arrivals::ArrivalStream;
use control_zones::scenario::layout::{Layout, OnLane};
use control_zones::scenario::{Scenario, Source};
use control_zones::world::CompletedVisit;
use ipc_schemas::{NO_ZONE, VehicleState};
use std::collections::{BTreeMap, HashMap};

/// Below this speed a vehicle waits, m/s; SUMO's value.
const WAITING_MPS: f64 = 0.1;

/// One vehicle's way.
#[derive(Clone, Debug, PartialEq)]
pub struct Trip {
    /// The vehicle.
    pub vehicle: u32,
    /// Its kind: index in the scenario's fleet.
    pub kind: u16,
    /// Entry road, where its first zone has one there.
    pub road: Option<u32>,
    /// Instant at which it entered the network, s.
    pub depart_s: f64,
    /// Speed at which it did, m/s.
    pub depart_mps: f64,
    /// How long it had waited outside, s.
    pub depart_delay_s: f64,
    /// Where it was at its first step.
    pub first: OnLane,
    /// Where it was seen last.
    pub last: OnLane,
    /// Speed at which it left the network, or at its last step, m/s.
    pub last_mps: f64,
    /// Instant at which it left the network, s; `None` when it was still inside at the end.
    pub arrival_s: Option<f64>,
    /// Instant of its last step, or of its leaving, s.
    pub until_s: f64,
    /// Distance travelled, m.
    pub distance_m: f64,
    /// Time at less than 0.1 m/s, s.
    pub waiting_s: f64,
    /// How often it began to wait.
    pub waits: u32,
    /// Energy over completed visits, the integral of u^2/2, m^2/s^3.
    pub energy: f64,
    /// Time in FE mode over completed visits, s.
    pub fe_s: f64,
    /// Number of completed visits.
    pub visits: u32,
    /// Lengths of the paths and links behind it, m.
    behind_m: f64,
    place: (u32, u32, u32),
    waits_now: bool,
}

/// A completed visit with the path it was on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Passage {
    /// The visit.
    pub visit: CompletedVisit,
    /// Index of the path in the zone.
    pub path: u32,
}

/// All vehicles' ways so far.
#[derive(Debug)]
pub struct Trips<'a> {
    scenario: &'a Scenario,
    layout: Layout,
    trips: BTreeMap<u32, Trip>,
    /// Arrivals of each road still to come.
    arrivals: Vec<ArrivalStream>,
    passages: Vec<Passage>,
    keeps_passages: bool,
    link_m: Vec<f64>,
    seen: HashMap<u32, usize>,
}

impl<'a> Trips<'a> {
    /// Nobody yet.
    pub fn of(scenario: &'a Scenario) -> Trips<'a> {
        let roads = scenario.network.roads.iter().zip(0..);
        let exits = scenario.network.zones.iter().flat_map(|zone| &zone.exits);
        Trips {
            scenario,
            layout: Layout::of(&scenario.network),
            trips: BTreeMap::new(),
            arrivals: roads.map(|(road, i)| ArrivalStream::new(road, i, scenario.seed)).collect(),
            passages: Vec::new(),
            keeps_passages: false,
            link_m: exits.filter_map(|exit| Some(exit.to?.link_m)).filter(|m| *m > 0.0).collect(),
            seen: HashMap::new(),
        }
    }

    /// The same, keeping every visit.
    pub fn with_passages(self) -> Trips<'a> {
        Trips { keeps_passages: true, ..self }
    }

    /// Takes a step; steps come in order.
    pub fn step(&mut self, moment: &Moment<'_>) {
        let time_s = moment.step.header.time_ns as f64 * 1e-9;
        self.seen.clear();
        for (at, state) in moment.step.state.iter().enumerate().filter(|(_, state)| is_present(state)) {
            self.seen.insert(state.vehicle, at);
            self.see(state, time_s);
        }
        for visit in moment.visits {
            let state = self.seen.get(&visit.vehicle).map(|at| moment.step.state[*at]);
            self.visit(visit, state.filter(|state| state.zone == visit.zone));
        }
    }

    fn see(&mut self, state: &VehicleState, time_s: f64) {
        let Some(on) = self.layout.lane_of(state) else { return };
        let place = (state.zone, state.path, state.link);
        let is_new = !self.trips.contains_key(&state.vehicle);
        if is_new {
            let trip = self.begin(state, on, place);
            self.trips.insert(state.vehicle, trip);
        }
        let dt_s = self.scenario.dt_s();
        let trip = self.trips.get_mut(&state.vehicle).expect("it has just been put there");
        if trip.place != place {
            trip.behind_m += length_m(&self.scenario.network.zones, &self.link_m, trip.place);
            trip.place = place;
        }
        trip.distance_m = trip.behind_m + state.x_m.max(0.0);
        (trip.last, trip.last_mps, trip.until_s) = (on, state.v_mps, time_s);
        let waits = state.v_mps < WAITING_MPS;
        if waits && !is_new {
            trip.waiting_s += dt_s;
        }
        trip.waits += u32::from(waits && !trip.waits_now);
        trip.waits_now = waits;
    }

    fn begin(&mut self, state: &VehicleState, on: OnLane, place: (u32, u32, u32)) -> Trip {
        let zone = self.scenario.network.zones.get(state.zone as usize);
        let road = zone.and_then(|zone| match zone.entrance(state.path).source {
            Some(Source::Road(road)) => Some(road),
            _ => None,
        });
        // Vehicles enter by a road in the order in which they come to it.
        let arrival = road.and_then(|road| self.arrivals.get_mut(road as usize)?.next());
        Trip {
            vehicle: state.vehicle,
            kind: state.kind,
            road,
            depart_s: state.entry_time_s,
            depart_mps: state.entry_speed_mps,
            depart_delay_s: arrival.map_or(0.0, |arrival| (state.entry_time_s - arrival.time_s).max(0.0)),
            first: on,
            last: on,
            last_mps: state.v_mps,
            arrival_s: None,
            until_s: state.entry_time_s,
            distance_m: 0.0,
            waiting_s: 0.0,
            waits: 0,
            energy: 0.0,
            fe_s: 0.0,
            visits: 0,
            behind_m: 0.0,
            place,
            waits_now: false,
        }
    }

    fn visit(&mut self, visit: &CompletedVisit, state: Option<VehicleState>) {
        let (Some(trip), Some(state)) = (self.trips.get_mut(&visit.vehicle), state) else { return };
        trip.energy += visit.energy;
        trip.fe_s += visit.fe_s;
        trip.visits += 1;
        let zone = &self.scenario.network.zones[visit.zone as usize];
        if zone.exit_of(state.path).to.is_none() {
            let path_m = zone.paths[state.path as usize].length_m;
            trip.arrival_s = Some(visit.exit_time_s);
            trip.until_s = visit.exit_time_s;
            trip.last_mps = visit.exit_speed_mps;
            trip.distance_m = trip.behind_m + path_m;
            if let Some(end) = self.layout.on_path(visit.zone, state.path, path_m) {
                trip.last = end;
            }
        }
        if self.keeps_passages {
            self.passages.push(Passage { visit: *visit, path: state.path });
        }
    }

    /// Every vehicle seen, in order of number.
    pub fn all(&self) -> impl Iterator<Item = &Trip> {
        self.trips.values()
    }

    /// Every completed visit, in the order in which they ended, if they are kept.
    pub fn passages(&self) -> &[Passage] {
        &self.passages
    }
}

/// Length of what a place names, m: a path, or a link.
fn length_m(
    zones: &[control_zones::scenario::Zone],
    link_m: &[f64],
    (zone, path, link): (u32, u32, u32),
) -> f64 {
    let length_m = match zone {
        NO_ZONE => link_m.get(link as usize).copied(),
        _ => zones.get(zone as usize).and_then(|zone| Some(zone.paths.get(path as usize)?.length_m)),
    };
    length_m.unwrap_or(0.0)
}

impl Trip {
    /// Time in the network, s.
    pub fn duration_s(&self) -> f64 {
        self.until_s - self.depart_s
    }
}
