//! What happened in a run that somebody may ask about, with the reason in words.

use crate::walk::Moment;
use control_zones::conflict::{Conflicts, DutyKind};
use control_zones::record::words::zone_name;
use control_zones::record::{Condition, Owed, RunEvent, RunEventKind};
use control_zones::scenario::{Scenario, ShieldMode, VehicleParams};
use control_zones::vehicle::{Inequality, satisfiable_at};
use ipc_schemas::{STATE_ENTERED, VERDICT_FE, VERDICT_INFEASIBLE, VehicleCommand};
use std::collections::{BTreeSet, HashMap};

/// Accelerations that differ by less are the same, m/s^2: rounding of a step's mean.
const SAME_MPS2: f64 = 1e-6;

/// What kind of thing happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum EventKind {
    /// A vehicle entered the network.
    Arrived,
    /// A vehicle left it.
    Departed,
    /// A vehicle braked in feasibility-enforcement mode.
    FeasibilityEnforcement,
    /// No acceleration satisfied all of a vehicle's rows.
    Infeasible,
    /// A vehicle did something else than it was commanded.
    Overruled,
    /// A process did not answer in time.
    Late,
    /// A process was replaced.
    Replaced,
    /// Frames were refused.
    Refused,
    /// Somebody steered the run.
    Steered,
    /// A controller's process ended, and the run goes on.
    Exited,
}

impl EventKind {
    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            EventKind::Arrived => "arrived",
            EventKind::Departed => "departed",
            EventKind::FeasibilityEnforcement => "feasibility enforcement",
            EventKind::Infeasible => "infeasible",
            EventKind::Overruled => "overruled",
            EventKind::Late => "late",
            EventKind::Replaced => "replaced",
            EventKind::Refused => "refused",
            EventKind::Steered => "steered",
            EventKind::Exited => "exited",
        }
    }
}

/// Something that happened, in one step or several on end.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// What.
    pub kind: EventKind,
    /// First step.
    pub first_step: u64,
    /// Last step.
    pub last_step: u64,
    /// Instant of the first step, or of what happened within it, s.
    pub time_s: f64,
    /// To which vehicle, if to one.
    pub vehicle: Option<u32>,
    /// In which zone, if in one.
    pub zone: Option<u32>,
    /// On account of which other vehicle, if of one.
    pub partner: Option<u32>,
    /// By which controller process, if by one.
    pub controller: Option<u32>,
    /// Why, in words.
    pub reason: String,
}

/// The events of a recording, as its steps come.
#[derive(Debug)]
pub struct Events<'a> {
    scenario: &'a Scenario,
    conflicts: Vec<Conflicts>,
    all: Vec<Event>,
    /// The last event of a kind of a vehicle or a controller.
    open: HashMap<(EventKind, u32), usize>,
    commands: HashMap<u32, VehicleCommand>,
    generations: Vec<u32>,
    known: BTreeSet<u32>,
}

impl<'a> Events<'a> {
    /// None yet.
    pub fn of(scenario: &'a Scenario) -> Events<'a> {
        Events {
            scenario,
            conflicts: Conflicts::of_all(&scenario.network),
            all: Vec::new(),
            open: HashMap::new(),
            commands: HashMap::new(),
            generations: Vec::new(),
            known: BTreeSet::new(),
        }
    }

    /// Takes a step; steps come in order.
    pub fn step(&mut self, moment: &Moment<'_>) {
        let step = moment.step;
        let (number, time_s) = (step.header.step, step.header.time_ns as f64 * 1e-9);
        let mut owed: Option<Vec<Owed>> = None;
        let mut owed_by = |vehicle: u32| -> Vec<Owed> {
            let all = owed.get_or_insert_with(|| {
                let mut all = Vec::new();
                moment.in_force.owed(self.scenario, step, |owed| all.push(owed));
                all
            });
            all.iter().filter(|owed| owed.vehicle == vehicle).copied().collect()
        };
        for state in step.state.iter().filter(|state| state.is_commanded()) {
            let blank = Event {
                kind: EventKind::Arrived,
                first_step: number,
                last_step: number,
                time_s,
                vehicle: Some(state.vehicle),
                zone: Some(state.zone),
                partner: None,
                controller: None,
                reason: String::new(),
            };
            if self.known.insert(state.vehicle) {
                let reason = format!("at {:.2} m/s", state.entry_speed_mps);
                self.all.push(Event { time_s: state.entry_time_s, reason, ..blank.clone() });
            }
            let Some(command) = self.commands.get(&state.vehicle) else { continue };
            let differs = (state.u_mps2 - command.u_mps2).abs() > SAME_MPS2;
            if command.zone == state.zone && state.flags & STATE_ENTERED == 0 && differs && state.v_mps > 0.0
            {
                // The command was that of the step before.
                let event = Event {
                    kind: EventKind::Overruled,
                    first_step: number - 1,
                    last_step: number - 1,
                    ..blank
                };
                if !extend(&mut self.all, &self.open, &event, state.vehicle) {
                    let reason = overruled(self.scenario, command.u_mps2, state.u_mps2);
                    self.open.insert((event.kind, state.vehicle), self.all.len());
                    self.all.push(Event { time_s: time_s - self.scenario.dt_s(), reason, ..event });
                }
            }
        }
        self.commands.clear();
        for command in step.commands.iter().flat_map(|part| &part.records) {
            self.commands.insert(command.vehicle, *command);
            let kind = match command.verdict {
                VERDICT_FE => EventKind::FeasibilityEnforcement,
                VERDICT_INFEASIBLE => EventKind::Infeasible,
                _ => continue,
            };
            let event = Event {
                kind,
                first_step: number,
                last_step: number,
                time_s,
                vehicle: Some(command.vehicle),
                zone: Some(command.zone),
                partner: None,
                controller: None,
                reason: String::new(),
            };
            if extend(&mut self.all, &self.open, &event, command.vehicle) {
                continue;
            }
            let own = step.state.iter().find(|s| s.is_commanded() && s.vehicle == command.vehicle);
            let kinds = &self.scenario.fleet;
            let params = own
                .and_then(|own| kinds.get(usize::from(own.kind)))
                .map_or(self.scenario.vehicle, |k| k.vehicle);
            let owed = owed_by(command.vehicle);
            let (partner, reason) = match kind {
                EventKind::FeasibilityEnforcement => why_fe(&self.conflicts, &params, &owed),
                _ => why_infeasible(self.scenario, &self.conflicts, &params, &owed),
            };
            self.open.insert((kind, command.vehicle), self.all.len());
            self.all.push(Event { partner, reason, ..event });
        }
        self.of_controllers(moment, time_s);
        self.departures(moment);
    }

    fn of_controllers(&mut self, moment: &Moment<'_>, time_s: f64) {
        let step = moment.step;
        self.generations.resize(step.commands.len().max(self.generations.len()), 0);
        for (controller, part) in (0..).zip(&step.commands) {
            let known = std::mem::replace(&mut self.generations[controller as usize], part.generation);
            let event = |kind, reason| Event {
                kind,
                first_step: step.header.step,
                last_step: step.header.step,
                time_s,
                vehicle: None,
                zone: None,
                partner: None,
                controller: Some(controller),
                reason,
            };
            if part.generation > known {
                self.all.push(event(
                    EventKind::Replaced,
                    format!("generation {} took its place", part.generation),
                ));
            }
            if step.missed(controller as usize) {
                let late =
                    event(EventKind::Late, "no answer in time; the world chose in its place".to_owned());
                if !extend(&mut self.all, &self.open, &late, controller) {
                    self.open.insert((late.kind, controller), self.all.len());
                    self.all.push(late);
                }
            }
        }
    }

    fn departures(&mut self, moment: &Moment<'_>) {
        for visit in moment.visits {
            let is_own = |s: &&ipc_schemas::VehicleState| s.vehicle == visit.vehicle && s.zone == visit.zone;
            let Some(state) = moment.step.state.iter().filter(|s| s.is_commanded()).find(is_own) else {
                continue;
            };
            if self.scenario.network.zones[visit.zone as usize].exit_of(state.path).to.is_some() {
                continue;
            }
            self.all.push(Event {
                kind: EventKind::Departed,
                first_step: moment.step.header.step,
                last_step: moment.step.header.step,
                time_s: visit.exit_time_s,
                vehicle: Some(visit.vehicle),
                zone: Some(visit.zone),
                partner: None,
                controller: None,
                reason: format!("at {:.2} m/s", visit.exit_speed_mps),
            });
        }
    }

    /// All of them, by first step; with what the recording's end says, but for what is known by the steps.
    pub fn finish(mut self, happened: &[RunEvent]) -> Vec<Event> {
        for RunEvent { step, kind, text, controllers } in happened {
            let kind = match kind {
                RunEventKind::Missed => EventKind::Late,
                RunEventKind::Refused => EventKind::Refused,
                RunEventKind::Replaced => EventKind::Replaced,
                RunEventKind::Steered => EventKind::Steered,
                RunEventKind::Exited => EventKind::Exited,
            };
            let is_known = |known: &Event| {
                known.kind == kind
                    && (known.first_step..=known.last_step).contains(step)
                    && known.controller.is_some_and(|controller| controllers >> controller & 1 == 1)
            };
            if !self.all.iter().any(is_known) {
                self.all.push(Event {
                    kind,
                    first_step: *step,
                    last_step: *step,
                    time_s: self.scenario.time_s(*step),
                    vehicle: None,
                    zone: None,
                    partner: None,
                    controller: None,
                    reason: text.clone(),
                });
            }
        }
        self.all.sort_by_key(|event| (event.first_step, event.kind));
        self.all
    }
}

/// Lets the last event of the kind go on, if it lasted until the step before.
fn extend(all: &mut [Event], open: &HashMap<(EventKind, u32), usize>, event: &Event, whose: u32) -> bool {
    let Some(last) = open.get(&(event.kind, whose)).map(|at| &mut all[*at]) else { return false };
    let goes_on = last.last_step + 1 == event.first_step && last.zone == event.zone;
    if goes_on {
        last.last_step = event.last_step;
    }
    goes_on
}

/// A partner in words.
pub fn partner(conflicts: &[Conflicts], owed: &Owed) -> String {
    let points = conflicts.get(owed.zone as usize).map_or(&[][..], Conflicts::points);
    let point = points.get(owed.point as usize).map_or("", |point| point.name.as_str());
    match owed.kind {
        DutyKind::RearEnd => format!("vehicle {} ahead", owed.partner),
        DutyKind::Merge => format!("vehicle {} at the merge {point}", owed.partner),
        DutyKind::Cross => format!("vehicle {} at the crossing {point}", owed.partner),
    }
}

fn overruled(scenario: &Scenario, commanded_mps2: f64, applied_mps2: f64) -> String {
    let who = match (scenario.shield, scenario.faults.is_some()) {
        (ShieldMode::On, false) => "by the shield",
        (ShieldMode::On, true) => "by the shield or a fault",
        (_, true) => "by a fault, or the vehicle's limits",
        _ => "by the vehicle's limits",
    };
    format!("{who}: {applied_mps2:.2} m/s² in place of {commanded_mps2:.2}")
}

fn least<'o>(owed: impl Iterator<Item = &'o Owed>) -> Option<&'o Owed> {
    owed.min_by(|a, b| a.margin_m().total_cmp(&b.margin_m()))
}

/// Why a vehicle is in feasibility-enforcement mode: the condition that fails by most.
fn why_fe(conflicts: &[Conflicts], params: &VehicleParams, owed: &[Owed]) -> (Option<u32>, String) {
    let Some(worst) = least(owed.iter().filter(|owed| !owed.may_be_tracked())) else {
        return (None, "the entry conditions did not hold".to_owned());
    };
    let whom = partner(conflicts, worst);
    let (margin_m, row) = (worst.margin_m(), worst.row());
    let reason = if margin_m < 0.0 {
        format!("{:.2} m too close to {whom} for {:.1} m/s", -margin_m, worst.pair.v_mps)
    } else if !satisfiable_at(&row, params.u_min_mps2) {
        let needed = row.bound / row.coefficient;
        format!(
            "toward {whom} it would have to brake at {:.2} m/s², and can at {:.2}",
            -needed, -params.u_min_mps2
        )
    } else {
        let closing_mps = worst.pair.v_mps - worst.pair.partner_v_mps;
        format!("closes on {whom} at {closing_mps:.2} m/s, too fast for it to stay able to keep its distance")
    };
    (Some(worst.partner), reason)
}

/// Why no acceleration satisfied all rows: the one that asks for the hardest braking.
fn why_infeasible(
    scenario: &Scenario,
    conflicts: &[Conflicts],
    params: &VehicleParams,
    owed: &[Owed],
) -> (Option<u32>, String) {
    let bound = |row: Inequality| match row.coefficient > 0.0 {
        true => row.bound / row.coefficient,
        false if row.bound >= 0.0 => f64::INFINITY,
        false => f64::NEG_INFINITY,
    };
    let hardest = |owed: &Owed| {
        let feasibility = match &owed.condition {
            Condition::RearEnd(condition) => condition.feasibility_row(&owed.pair),
            Condition::Merge(condition) => condition.feasibility_row(&owed.pair),
        };
        let own = bound(owed.row());
        if scenario.control.feasibility_rows { own.min(bound(feasibility)) } else { own }
    };
    let worst = owed.iter().min_by(|a, b| hardest(a).total_cmp(&hardest(b)));
    match worst.filter(|worst| hardest(worst) < params.u_min_mps2) {
        Some(worst) if hardest(worst) == f64::NEG_INFINITY => {
            let whom = partner(conflicts, worst);
            (Some(worst.partner), format!("no braking keeps its distance to {whom}: it brakes fully"))
        }
        Some(worst) => {
            let whom = partner(conflicts, worst);
            let (needed, can) = (-hardest(worst), -params.u_min_mps2);
            let reason = format!(
                "to keep its distance to {whom} it would have to brake at {needed:.2} m/s², and can at {can:.2}"
            );
            (Some(worst.partner), reason)
        }
        None => (None, "no acceleration satisfied all rows: it brakes fully".to_owned()),
    }
}

impl Event {
    /// The event in a line.
    pub fn words(&self, scenario: &Scenario) -> String {
        let who = match (self.vehicle, self.controller) {
            (Some(vehicle), _) => format!("vehicle {vehicle}"),
            (None, Some(controller)) => format!("controller {controller}"),
            (None, None) => "the run".to_owned(),
        };
        let place = self.zone.map(|zone| format!(" in {}", zone_name(scenario, zone))).unwrap_or_default();
        format!("{who}{place}: {}: {}", self.kind.name(), self.reason)
    }
}
