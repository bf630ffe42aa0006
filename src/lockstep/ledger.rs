//! What the world keeps of everybody's frames, so that a process may be replaced.
//!
//! A participant's memory is in frames: a controller's in its last commands, a coordinator's in the
//! assignments in force and in what zones last told each other. The ledger has all of these as they were
//! *before* the present step, and the frames of the present step beside them. A step is over only when
//! every coordinator that acts in it and every controller has answered. So whoever takes a place starts
//! with the present step and does all of it, whatever its predecessor had done of it; what was already
//! there arrives twice and is the same.

use crate::control::Words;
use crate::coordination::{Audience, is_event};
use crate::scenario::Scenario;
use crate::step::Step;
use ipc_schemas::{Assignment, FrameHeader, Role, VehicleCommand, VehicleState, ZoneSummary};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// What a participant needs in order to go on from the present step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Handover {
    /// Step it begins with.
    pub step: u64,
    /// Header of the state frame of that step, when it has been sent already.
    pub header: Option<FrameHeader>,
    /// The records of that frame.
    pub states: Vec<VehicleState>,
    /// Coordination of that step that has been sent already, by coordinator process.
    pub coordination: Vec<(u16, Vec<Assignment>)>,
    /// To a controller: its commands of the step before.
    pub commands: Vec<VehicleCommand>,
    /// Assignments in force before that step, by zone.
    pub in_force: Vec<Assignment>,
    /// To a coordinator: the last summaries of each neighbour its zones acted on.
    pub heard: Vec<ZoneSummary>,
    /// To a coordinator: the summaries sent in the step before.
    pub due: Vec<ZoneSummary>,
    /// To a coordinator: the summaries of that step, for the next one.
    pub fresh: Vec<ZoneSummary>,
    /// To a coordinator: bit per coordinator process that has an event in that step, and so sends summaries.
    pub events: u64,
    /// To a coordinator: bit per coordinator process that had an event in the step before, and so sent summaries
    /// then, which may have gone with it.
    pub summarised: u64,
}

impl Handover {
    /// What a controller that keeps its own memory needs: the assignments in force, by zone, and the first step
    /// whose coordination is not among them. A state that has been sent is handed over together with its
    /// coordination, so that is the next one then.
    pub fn assignments(&self) -> (u64, Vec<Assignment>) {
        let sent = || self.coordination.iter().flat_map(|(_, assignments)| assignments);
        let acted: BTreeSet<u32> = sent().map(|a| a.zone).collect();
        let kept = self.in_force.iter().filter(|a| !acted.contains(&a.zone));
        let mut all: Vec<Assignment> = kept.chain(sent()).copied().collect();
        // Stable: within a zone the order is the coordinator's.
        all.sort_by_key(|a| a.zone);
        (self.step + u64::from(self.header.is_some()), all)
    }
}

/// The frames of the present step, and what was in force before it.
#[derive(Debug)]
pub struct Ledger {
    audiences: Vec<Audience>,
    in_force: Vec<Vec<Assignment>>,
    /// Whether what is in force in a zone is news to whoever is shown a step now and then.
    is_news: Vec<bool>,
    /// Per zone, the last summaries of each neighbour it acted on.
    heard: Vec<Vec<(u32, Vec<ZoneSummary>)>>,
    due: Vec<ZoneSummary>,
    fresh: Vec<ZoneSummary>,
    coordination: Vec<(u16, Vec<Assignment>)>,
    /// Buffers of `coordination` to be used again.
    spare: Vec<Vec<Assignment>>,
    /// Each controller's commands of the step before, and of this one; empty before they have come.
    before: Vec<Vec<VehicleCommand>>,
    now: Vec<Vec<VehicleCommand>>,
    /// Controllers, one bit each, whose commands of the step before, and of this one, hold the memory of one written
    /// elsewhere: nobody of ours can go by it.
    foreign_before: u64,
    foreign_now: u64,
    /// Number of controllers of the built-in pool.
    pool: usize,
    /// Whether the present step has begun.
    has_begun: bool,
}

impl Ledger {
    /// The ledger of a run that has not begun.
    pub fn new(scenario: &Scenario, controllers: u32) -> Ledger {
        let network = &scenario.network;
        let zones = network.zones.len();
        let none = || vec![Vec::new(); controllers as usize];
        let pool = (controllers as usize).saturating_sub(scenario.plugins.len());
        Ledger {
            audiences: (0..zones as u32).map(|zone| Audience::of(scenario, zone)).collect(),
            in_force: vec![Vec::new(); zones],
            is_news: vec![false; zones],
            heard: (0..zones as u32)
                .map(|zone| network.neighbours(zone).map(|next| (next, Vec::new())).collect())
                .collect(),
            due: Vec::new(),
            fresh: Vec::new(),
            coordination: Vec::new(),
            spare: Vec::new(),
            before: none(),
            now: none(),
            foreign_before: 0,
            foreign_now: 0,
            pool,
            has_begun: false,
        }
    }

    /// A step begins with this state.
    pub fn begin(&mut self, states: &[VehicleState], is_event_step: bool) {
        self.has_begun = true;
        for group in self.due.chunk_by(is_of_one) {
            let known = self.heard[group[0].to_zone as usize].iter_mut();
            for (_, last) in known.filter(|(zone, _)| *zone == group[0].from_zone) {
                last.clear();
                last.extend_from_slice(group);
            }
        }
        self.due.clear();
        std::mem::swap(&mut self.due, &mut self.fresh);
        if is_event_step {
            for slice in states.chunk_by(|a, b| a.zone == b.zone) {
                let zone = slice[0].zone;
                if let Some(audience) = self.audiences.get(zone as usize).filter(|_| is_event(slice)) {
                    self.fresh.extend(audience.summaries(zone, slice));
                }
            }
        }
    }

    /// A coordinator's frame of this step.
    pub fn coordinate(&mut self, coordinator: u16, assignments: &[Assignment]) {
        let mut copy = self.spare.pop().unwrap_or_default();
        copy.clear();
        copy.extend_from_slice(assignments);
        let at = self.coordination.partition_point(|(other, _)| *other < coordinator);
        self.coordination.insert(at, (coordinator, copy));
    }

    /// A controller's commands of this step, as they have been judged; the vector comes back with others to be
    /// written over. `stands_in` when it is one of ours in the place of one written elsewhere.
    pub fn command(&mut self, controller: usize, commands: &mut Vec<VehicleCommand>, stands_in: bool) {
        std::mem::swap(&mut self.now[controller], commands);
        // The three that take turns grow together, in the step that brings more vehicles than any before.
        let room = self.now[controller].capacity();
        for other in [commands, &mut self.before[controller]] {
            if other.capacity() < room {
                other.reserve_exact(room - other.len());
            }
        }
        self.foreign_now |= u64::from(controller >= self.pool && !stands_in) << controller;
    }

    /// Commands put in for a controller in this step, with the memory of those of the step before.
    pub fn put_in(&mut self, controller: usize, commands: Vec<VehicleCommand>) {
        self.now[controller] = commands;
        self.foreign_now |= self.foreign_before & 1 << controller;
    }

    /// The step is over: what was sent in it is in force.
    pub fn end(&mut self) {
        self.has_begun = false;
        for (_, assignments) in &self.coordination {
            for group in assignments.chunk_by(|a, b| a.zone == b.zone) {
                let Some(zone) = self.in_force.get_mut(group[0].zone as usize) else { continue };
                zone.clear();
                zone.extend_from_slice(group);
                self.is_news[group[0].zone as usize] = true;
            }
        }
        self.spare.extend(self.coordination.drain(..).map(|(_, assignments)| assignments));
        for (before, now) in self.before.iter_mut().zip(&mut self.now) {
            std::mem::swap(before, now);
            now.clear();
        }
        self.foreign_before = std::mem::take(&mut self.foreign_now);
    }

    /// What is in force in zones where it is news, zones ascending; it is none after this.
    pub fn news(&mut self) -> Vec<&[Assignment]> {
        let zones = self.in_force.iter().zip(&mut self.is_news);
        zones.filter_map(|(zone, is_news)| std::mem::take(is_news).then_some(&zone[..])).collect()
    }

    /// What is in force is news everywhere.
    pub fn untell(&mut self) {
        self.is_news.fill(true);
    }

    /// Enters a whole step, of a run that goes on from a recording.
    pub fn relive(&mut self, step: &Step) {
        self.begin(&step.state, step.header.coordinators_acting != 0);
        // Which process sent it does not matter once it is in force.
        self.coordinate(0, &step.coordination);
        let controllers = self.now.len();
        for (index, part) in step.commands.iter().take(controllers).enumerate() {
            self.now[index].clone_from(&part.records);
        }
        // Whoever it was: a run that goes on begins with those that it began with.
        self.foreign_now = u64::MAX.checked_shl(self.pool as u32).unwrap_or(0);
        self.end();
    }

    /// What a participant needs for the present step, besides its state.
    pub fn handover(&self, role: Role, index: usize) -> Handover {
        match role {
            Role::Coordinator => self.to_coordinator(),
            _ => self.to_controller(index),
        }
    }

    /// A controller's commands of the present step.
    pub fn commands(&self, controller: usize) -> &[VehicleCommand] {
        &self.now[controller]
    }

    /// A controller's commands of the step before.
    pub fn commands_before(&self, controller: usize) -> &[VehicleCommand] {
        &self.before[controller]
    }

    /// The coordination of the present step so far, by coordinator process.
    pub fn coordination(&self) -> &[(u16, Vec<Assignment>)] {
        &self.coordination
    }

    /// The summaries of the present step: what every zone with an event tells each neighbour.
    pub fn summaries(&self) -> &[ZoneSummary] {
        &self.fresh
    }

    fn to_controller(&self, controller: usize) -> Handover {
        Handover {
            coordination: self.coordination.clone(),
            commands: self.memory_of(controller),
            in_force: self.in_force.concat(),
            ..Handover::default()
        }
    }

    /// A controller's commands of the step before, without what somebody else than ours remembered in them.
    fn memory_of(&self, controller: usize) -> Vec<VehicleCommand> {
        let mut commands = self.commands_before(controller).to_vec();
        if self.foreign_before >> controller & 1 == 1 {
            let Words { mode, words } = Words::ENTERED;
            commands.iter_mut().for_each(|c| *c = VehicleCommand { mode, ..*c }.remembering(words));
        }
        commands
    }

    fn to_coordinator(&self) -> Handover {
        let heard = self.heard.iter().flatten().flat_map(|(_, last)| last.iter().copied());
        let in_force = self.in_force.concat();
        if self.has_begun {
            let (due, fresh) = (self.due.clone(), self.fresh.clone());
            return Handover { heard: heard.collect(), due, fresh, in_force, ..Handover::default() };
        }
        // What was due in the last step has been acted on, and what was fresh is due.
        let is_older = |told: &ZoneSummary| !self.due.iter().any(|newer| is_of_one(told, newer));
        let heard = heard.filter(is_older).chain(self.due.iter().copied()).collect();
        Handover { heard, due: self.fresh.clone(), in_force, ..Handover::default() }
    }
}

/// Whether two summaries tell one zone about one other.
fn is_of_one(a: &ZoneSummary, b: &ZoneSummary) -> bool {
    (a.from_zone, a.to_zone) == (b.from_zone, b.to_zone)
}
