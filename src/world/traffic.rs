//! Worlds that others play: who brings vehicles in and moves them, where that is not the world itself.
//!
//! The world keeps the ledger: who is where on which path, duties, gateway, shield, metrics, frames. A [`Traffic`] is
//! told once a step what every vehicle is to hold, and says what every vehicle did. Its word is checked, and turned
//! into the motion under a held acceleration that ends where it says: that is what all the rest of the world
//! looks at, between samples as well.

use super::car::{Beyond, Car};
use super::integrate::Entry;
use super::role::World;
use super::way::{NONE, Way, Ways};
use crate::scenario::{Scenario, ZoneId};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// What a vehicle is to do over a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Task {
    /// Acceleration to hold, m/s^2, where it is to hold one; it stops rather than reverse.
    pub u_mps2: f64,
    /// The vehicle.
    pub vehicle: u32,
    /// 1 where it is to hold the acceleration; 0 where it drives at its own discretion: on a link, outside the network, or
    /// because nobody commands it.
    pub is_held: u32,
}

/// What a vehicle did over a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Done {
    /// How far it has come along its way, m; NaN when it is there no more.
    pub advanced_m: f64,
    /// Speed at the end of the step, m/s.
    pub v_mps: f64,
}

impl Done {
    /// It is there no more.
    pub const GONE: Done = Done { advanced_m: f64::NAN, v_mps: 0.0 };
}

/// A vehicle that a traffic has brought in during the step. Vehicles are numbered in the order in which they come, from
/// 0 over the run.
///
/// One that is put behind the end of its path, by an exit that leads out of the network, never was in the zone, and counts as
/// having left it: those who leave by that exit keep behind it.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C)]
pub struct Newcomer {
    /// Position on its path at the end of the step, m; from the path's length on, behind the exit.
    pub x_m: f64,
    /// Speed at the end of the step, m/s.
    pub v_mps: f64,
    /// Zone: index in [`crate::scenario::Network::zones`].
    pub zone: u32,
    /// Path: index in [`crate::scenario::Zone::paths`].
    pub path: u32,
    /// Index of the road whose route it takes, [`Newcomer::NONE`] when its paths behind this one are drawn.
    pub road: u32,
    /// Index of that route among the road's, [`Newcomer::NONE`] as well.
    pub route: u32,
    /// Kind: index in the scenario's fleet.
    pub kind: u32,
    /// 1 if it does what it is commanded, 0 if somebody else drives it.
    pub is_commanded: u32,
}

impl Newcomer {
    /// No road, or no route.
    pub const NONE: u32 = NONE;
}

impl Default for Newcomer {
    /// At the origin of the first path of the first zone, at a standstill, commanded, on no road's route.
    fn default() -> Newcomer {
        let (road, route) = (NONE, NONE);
        Newcomer { x_m: 0.0, v_mps: 0.0, zone: 0, path: 0, road, route, kind: 0, is_commanded: 1 }
    }
}

/// A vehicle that the world's own gates have let in, to be put where it is at the end of the step.
#[derive(Clone, Debug, PartialEq)]
pub struct Admitted {
    /// The vehicle.
    pub vehicle: u32,
    /// Kind: index in the scenario's fleet.
    pub kind: u32,
    /// Road by which it comes.
    pub road: u32,
    /// Position on the first of its paths, m.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// Zones and paths on its way out of the network.
    pub way: Vec<(u32, u32)>,
    /// Whether it does what it is commanded, which it does unless the traffic says otherwise here.
    pub is_commanded: bool,
}

/// Whether a traffic has more to bring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coming {
    /// It may bring more.
    More,
    /// Nobody comes any more: the run ends when all have left.
    Nobody,
}

/// Why a traffic cannot go on: what it was about, and what happened, in a line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct TrafficError(pub String);

/// Whoever brings vehicles in and moves them.
pub trait Traffic: std::fmt::Debug {
    /// What it is called in reports.
    fn name(&self) -> String;

    /// Told once, before anything else, what is played.
    fn begin(&mut self, _scenario: &Scenario) {}

    /// Whether it brings its vehicles itself, as it does unless it says otherwise; otherwise the world's roads do, and it is
    /// told by [`admit`](Self::admit).
    fn brings(&self) -> bool {
        true
    }

    /// Makes one step. There is a `done` for each of the `tasks`, which are in order of vehicle; those who came during the
    /// step go to `newcomers`.
    ///
    /// # Errors
    /// When it cannot; the run fails.
    fn step(
        &mut self,
        step: u64,
        tasks: &[Task],
        done: &mut [Done],
        newcomers: &mut Vec<Newcomer>,
    ) -> Result<Coming, TrafficError>;

    /// Puts vehicles where the world's gates have let them in, at the end of the step just made, and says which of them
    /// are not commanded. Nobody is let in where it brings its vehicles itself.
    ///
    /// # Errors
    /// When it cannot; the run fails.
    fn admit(&mut self, _vehicles: &mut [Admitted]) -> Result<(), TrafficError> {
        Ok(())
    }
}

/// Why the world cannot go on to the next step.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AdvanceError {
    /// Not everybody has a command.
    #[error("{0} vehicles were commanded by nobody")]
    Uncommanded(usize),
    /// Whoever moves the vehicles cannot, or says what cannot be.
    #[error("{name}: {error}")]
    Traffic {
        /// Who it is.
        name: String,
        /// Why.
        error: TrafficError,
    },
}

/// What came of a traffic that is not the world's own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrafficSummary {
    /// What it is called.
    pub name: String,
    /// Vehicles that were taken out within a zone.
    pub gone: u32,
    /// Vehicles in zones that nobody commanded.
    pub uncommanded: u32,
    /// Vehicles that came behind a zone's exit, in the way of those that leave by it.
    pub behind_exits: u32,
    /// Greatest distance by which a vehicle came elsewhere over a step than with its mean acceleration, m: how much what is
    /// said of instants between samples may be wrong.
    pub greatest_deviation_m: f64,
    /// Greatest difference between an acceleration that was to be held and the mean one, m/s^2.
    pub greatest_disobedience_mps2: f64,
}

/// A traffic, and what passes between it and the world.
#[derive(Debug)]
pub(super) struct Played {
    traffic: Box<dyn Traffic>,
    tasks: Vec<Task>,
    done: Vec<Done>,
    newcomers: Vec<Newcomer>,
    /// Those whom the world's gates have let in during the step.
    pub admitted: Vec<Admitted>,
    coming: Coming,
    /// Members that are there no more: zone and vehicle.
    gone: Vec<(ZoneId, u32)>,
    summary: TrafficSummary,
}

/// One that is there no more counts as having left its zone so far ahead of all others, m.
const OUT_OF_SIGHT_M: f64 = 1e6;
/// Newcomers further behind an exit than this concern nobody in its zone, m.
const MOST_BEHIND_M: f64 = 1e3;
/// A vehicle that comes back so little, m, has not: rounding.
const BACK_M: f64 = 1e-6;
/// One that begins a step so slowly backwards, m/s, starts from a standstill: rounding.
const ROUNDING_MPS: f64 = 1e-6;

impl Played {
    fn failed(&self, problem: String) -> AdvanceError {
        AdvanceError::Traffic { name: self.traffic.name(), error: TrafficError(problem) }
    }

    fn explain(&self, error: TrafficError) -> AdvanceError {
        AdvanceError::Traffic { name: self.traffic.name(), error }
    }

    pub(super) fn brings(&self) -> bool {
        self.traffic.brings()
    }

    pub(super) fn is_over(&self) -> bool {
        self.coming == Coming::Nobody
    }

    pub(super) fn summary(&self) -> TrafficSummary {
        self.summary.clone()
    }

    /// What it says of a vehicle.
    fn done(&self, vehicle: u32) -> Option<Done> {
        self.tasks.binary_search_by_key(&vehicle, |task| task.vehicle).ok().map(|at| self.done[at])
    }

    /// Has a car move as it is said to have moved over the step; returns whether it is there no more.
    fn move_car(&self, car: &mut Car, dt_s: f64) -> bool {
        let Some(done) = self.done(car.vehicle).filter(|_| !car.is_gone) else { return false };
        if done.advanced_m.is_nan() {
            return true;
        }
        let mean_mps = done.advanced_m / dt_s;
        let began_mps = 2.0 * mean_mps - done.v_mps;
        (car.v_mps, car.command_mps2) = match began_mps >= -ROUNDING_MPS {
            true => (began_mps.max(0.0), (done.v_mps - began_mps.max(0.0)) / dt_s),
            // Stops and starts within a step: what counts is where it ends.
            false => (mean_mps, 0.0),
        };
        false
    }
}

impl World {
    /// A world at step 0 whose vehicles a traffic moves.
    pub fn played(scenario: Arc<Scenario>, coordinators: u32, mut traffic: Box<dyn Traffic>) -> World {
        traffic.begin(&scenario);
        let mut world = World::new(scenario, coordinators);
        // Its humans are its own.
        world.humans = None;
        let summary = TrafficSummary { name: traffic.name(), ..TrafficSummary::default() };
        world.played = Some(Box::new(Played {
            traffic,
            tasks: Vec::new(),
            done: Vec::new(),
            newcomers: Vec::new(),
            admitted: Vec::new(),
            coming: Coming::More,
            gone: Vec::new(),
            summary,
        }));
        world
    }

    /// Whether everybody has come who is to come.
    pub(super) fn everybody_has_come(&self) -> bool {
        match self.played.as_deref().filter(|played| played.brings()) {
            Some(played) => played.is_over(),
            None => self.gates.exhausted(),
        }
    }

    /// Has the traffic make the step with what everybody is to hold, and everybody move as it says.
    pub(super) fn follow_traffic(&mut self, dt_s: f64) -> Result<(), AdvanceError> {
        let Some(mut played) = self.played.take() else { return Ok(()) };
        let result = self.make_step(&mut played, dt_s);
        self.played = Some(played);
        result
    }

    fn make_step(&mut self, played: &mut Played, dt_s: f64) -> Result<(), AdvanceError> {
        self.set_tasks(played);
        let Played { traffic, tasks, done, newcomers, .. } = played;
        done.clear();
        done.resize(tasks.len(), Done::GONE);
        newcomers.clear();
        let coming = traffic.step(self.step, tasks, done, newcomers);
        played.coming = coming.map_err(|error| played.explain(error))?;
        played.check_done()?;
        self.measure(played, dt_s);
        played.gone.clear();
        for zone in 0..self.zones.len() {
            let first = self.zones[zone].first();
            for at in 0..self.cars[zone].len() {
                let car = &mut self.cars[zone][at];
                if !played.move_car(car, dt_s) {
                    continue;
                }
                if at < first {
                    car.is_gone = true;
                    continue;
                }
                // To the end of the step it goes on, within its zone.
                let left_m = self.lengths_m[zone][car.path as usize] - car.x_m;
                car.v_mps = car.v_mps.min(0.5 * left_m / dt_s).max(0.0);
                car.command_mps2 = 0.0;
                played.gone.push((zone as ZoneId, car.vehicle));
            }
            for car in self.overlaps.tails_mut(zone) {
                car.is_gone |= played.move_car(car, dt_s);
            }
        }
        let mut left_links = 0;
        for link in &mut self.links.all {
            let before = link.cars.len();
            link.cars.retain_mut(|on_link| {
                let is_gone = played.move_car(&mut on_link.car, dt_s);
                on_link.held = on_link.car.held();
                !is_gone
            });
            left_links += before - link.cars.len();
        }
        self.links.cars -= left_links;
        played.summary.gone += left_links as u32;
        Ok(())
    }

    /// What everybody is to do whom the traffic knows.
    fn set_tasks(&self, played: &mut Played) {
        let tasks = &mut played.tasks;
        tasks.clear();
        for zone in 0..self.zones.len() {
            tasks.extend(self.members(zone).iter().map(|car| Task {
                u_mps2: car.command_mps2,
                vehicle: car.vehicle,
                is_held: u32::from(car.is_commanded),
            }));
        }
        let at_own = |car: &Car| Task { u_mps2: 0.0, vehicle: car.vehicle, is_held: 0 };
        tasks.extend(self.links.all.iter().flat_map(|link| &link.cars).map(|on_link| at_own(&on_link.car)));
        // Whoever has left a zone may be in the next one: then the task it has there comes first.
        for zone in 0..self.zones.len() {
            let left = &self.cars[zone][..self.zones[zone].first()];
            tasks.extend(left.iter().filter(|car| !car.is_gone).map(at_own));
            tasks.extend(self.overlaps.tails(zone).iter().filter(|car| !car.is_gone).map(at_own));
        }
        tasks.sort_by_key(|task| task.vehicle);
        tasks.dedup_by_key(|task| task.vehicle);
    }

    /// How far what was done is from what was asked for.
    fn measure(&self, played: &mut Played, dt_s: f64) {
        let (mut deviation_m, mut disobedience_mps2) = (0.0_f64, 0.0_f64);
        for zone in 0..self.zones.len() {
            for car in self.members(zone) {
                let Some(done) = played.done(car.vehicle).filter(|done| !done.advanced_m.is_nan()) else {
                    continue;
                };
                let mean_mps2 = (done.v_mps - car.v_mps) / dt_s;
                let stops = done.v_mps == 0.0 && car.v_mps + car.command_mps2 * dt_s <= 0.0;
                let there_m = match stops && car.is_commanded && car.command_mps2 < 0.0 {
                    true => car.v_mps * car.v_mps / (-2.0 * car.command_mps2),
                    false => 0.5 * (car.v_mps + done.v_mps) * dt_s,
                };
                deviation_m = deviation_m.max((done.advanced_m - there_m).abs());
                if car.is_commanded && !stops {
                    disobedience_mps2 = disobedience_mps2.max((mean_mps2 - car.command_mps2).abs());
                }
            }
        }
        let summary = &mut played.summary;
        summary.greatest_deviation_m = summary.greatest_deviation_m.max(deviation_m);
        summary.greatest_disobedience_mps2 = summary.greatest_disobedience_mps2.max(disobedience_mps2);
    }

    /// Lets in whom the traffic has brought.
    pub(super) fn let_in(&mut self, scenario: &Scenario, now_s: f64, dt_s: f64) -> Result<(), AdvanceError> {
        let Some(mut played) = self.played.take() else { return Ok(()) };
        let ways = Ways::of(scenario);
        let result = played.newcomers.iter().try_for_each(|newcomer| {
            let id = self.arrived + played.summary.behind_exits;
            let way = way_of(newcomer, scenario, &ways, id)?;
            let Newcomer { x_m, v_mps, zone, path, .. } = *newcomer;
            if x_m >= self.lengths_m[zone as usize][path as usize] {
                played.summary.behind_exits += 1;
                let mut car = Car::arriving(id, way, newcomer.kind as u16, now_s + dt_s, v_mps);
                (car.x_m, car.is_commanded) = (x_m, newcomer.is_commanded != 0);
                self.has_humans |= !car.is_commanded;
                self.put_behind_exit(zone, car);
                return Ok(());
            }
            self.arrived += 1;
            played.summary.uncommanded += u32::from(newcomer.is_commanded == 0);
            // One that was outside before the step has passed the origin in it.
            let inside_s =
                if x_m <= v_mps * dt_s { if v_mps > 0.0 { x_m / v_mps } else { 0.0 } } else { 0.0 };
            let mut car = Car::arriving(id, way, newcomer.kind as u16, now_s + dt_s - inside_s, v_mps);
            car.x_m = x_m;
            car.is_commanded = newcomer.is_commanded != 0;
            self.has_humans |= !car.is_commanded;
            self.gates.pass(None, Some((zone, path)));
            self.scratch.entries.push(Entry { zone, car });
            Ok(())
        });
        let result = result.map_err(|problem: String| played.failed(problem));
        self.played = Some(played);
        result
    }

    /// Puts one among those that have left the zone, behind whoever has come further by its exit.
    fn put_behind_exit(&mut self, zone: ZoneId, mut car: Car) {
        let at = zone as usize;
        let exit = self.conflicts[at].exit(car.path);
        car.beyond = Beyond { zone, exit, next_exit: 0 };
        let behind_m = |car: &Car| car.x_m - self.lengths_m[at][car.path as usize];
        let first = self.zones[at].first();
        let is_nearer =
            |other: &Car| self.conflicts[at].exit(other.path) == exit && behind_m(other) < behind_m(&car);
        let place = self.cars[at][..first].iter().position(is_nearer).unwrap_or(first);
        self.cars.push(at, car);
        self.cars[at][place..].rotate_right(1);
        self.left += 1;
        self.zones[at].left += 1;
        self.zones[at].left_now = true;
        self.note_event(zone);
    }

    /// Has a zone an event in the step just ended.
    fn note_event(&mut self, zone: ZoneId) {
        if let Err(place) = self.events.binary_search(&zone) {
            self.events.insert(place, zone);
        }
    }

    /// Takes out of their zones who is there no more, and tells the traffic whom the gates have let in.
    pub(super) fn close_step(&mut self) -> Result<(), AdvanceError> {
        let Some(mut played) = self.played.take() else { return Ok(()) };
        for &(zone, vehicle) in &played.gone {
            self.take_out(zone, vehicle);
            played.summary.gone += 1;
        }
        let result = match played.admitted.is_empty() {
            true => Ok(()),
            false => played.traffic.admit(&mut played.admitted).map_err(|error| played.explain(error)),
        };
        for admitted in played.admitted.iter().filter(|admitted| !admitted.is_commanded) {
            played.summary.uncommanded += 1;
            let zone = admitted.way[0].0 as usize;
            let first = self.zones[zone].first();
            let members = &mut self.cars[zone][first..];
            if let Some(car) = members.iter_mut().find(|car| car.vehicle == admitted.vehicle) {
                car.is_commanded = false;
                self.uncommanded += 1;
            }
            self.has_humans = true;
        }
        played.admitted.clear();
        self.played = Some(played);
        result
    }

    /// One that is there no more counts as having left the zone, far ahead of everybody: before all who have left.
    fn take_out(&mut self, zone: ZoneId, vehicle: u32) {
        let at = zone as usize;
        let Some(place) = self.members(at).iter().position(|car| car.vehicle == vehicle) else { return };
        let first = self.zones[at].first();
        let mut cars = self.cars[at].to_vec();
        let mut car = cars.remove(first + place);
        self.uncommanded -= usize::from(!car.is_commanded);
        self.metrics[at].observe(&car.visit);
        self.gates.pass(Some((zone, car.path)), None);
        car.x_m = self.lengths_m[at][car.path as usize] + OUT_OF_SIGHT_M;
        car.is_gone = true;
        (car.command_mps2, car.u_mps2) = (0.0, 0.0);
        car.beyond = Beyond {
            zone,
            exit: self.scenario.network.zones[at].paths[car.path as usize].exit,
            next_exit: 0,
        };
        cars.insert(0, car);
        self.cars.set(at, &cars);
        self.left += 1;
        self.zones[at].left += 1;
        self.zones[at].left_now = true;
        self.note_event(zone);
    }
}

impl Played {
    /// Checks what the traffic says.
    fn check_done(&mut self) -> Result<(), AdvanceError> {
        for at in 0..self.tasks.len() {
            let (task, done) = (self.tasks[at], &mut self.done[at]);
            if done.advanced_m.is_nan() {
                continue;
            }
            let is_sound = done.advanced_m >= -BACK_M && done.advanced_m.is_finite();
            if !(is_sound && done.v_mps >= 0.0 && done.v_mps.is_finite()) {
                let Done { advanced_m, v_mps } = *done;
                let problem = format!(
                    "vehicle {} has come {advanced_m} m, to {v_mps} m/s; expected numbers >= 0, or NaN m when it is gone",
                    task.vehicle
                );
                return Err(self.failed(problem));
            }
            done.advanced_m = done.advanced_m.max(0.0);
        }
        Ok(())
    }
}

/// Where a newcomer goes, or what is wrong with it.
fn way_of(newcomer: &Newcomer, scenario: &Scenario, ways: &Ways<'_>, vehicle: u32) -> Result<Way, String> {
    let Newcomer { x_m, v_mps, zone, path, road, route, kind, .. } = *newcomer;
    let network = &scenario.network;
    let wrong = |key: &str, value: &dyn std::fmt::Display, expected: String| {
        Err(format!("newcomer {vehicle}: {key} is {value}, expected {expected}"))
    };
    let Some(shape) = network.zones.get(zone as usize) else {
        return wrong("zone", &zone, format!("less than {}", network.zones.len()));
    };
    let Some(length_m) = shape.paths.get(path as usize).map(|path| path.length_m) else {
        return wrong("path", &path, format!("less than {} in {}", shape.paths.len(), shape.name));
    };
    let (behind_m, why) = match shape.exit_of(path).to {
        None => (MOST_BEHIND_M, "the length of its path, and what is behind its exit"),
        Some(_) => (0.0, "the length of its path, whose exit leads to another zone"),
    };
    if !(0.0..length_m + behind_m).contains(&x_m) {
        return wrong("x_m", &x_m, format!("from 0 to less than {}, {why}", length_m + behind_m));
    }
    if !(v_mps >= 0.0 && v_mps.is_finite()) {
        return wrong("v_mps", &v_mps, "a number >= 0".to_owned());
    }
    if kind as usize >= scenario.fleet.len() {
        return wrong("kind", &kind, format!("less than {}", scenario.fleet.len()));
    }
    let way = Way { path, next_zone: NONE, next_path: NONE, then_path: NONE, route, road, hop: 0 };
    if route != NONE {
        let known = network.roads.get(road as usize).and_then(|road| {
            road.routes.get(route as usize).filter(|route| road.zone == zone && route.paths[0] == path)
        });
        if known.is_none() {
            return wrong("route", &route, format!("one of road {road} that begins with its path"));
        }
    }
    Ok(ways.begun(way, vehicle, zone))
}
