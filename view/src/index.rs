//! What is known of a run besides its steps: gathered in one pass over a recording, or step by step while it goes on.

use control_zones::conflict::DutyKind;
use control_zones::record::{InForce, RunEvent, RunEventKind};
use control_zones::scenario::Scenario;
use control_zones::step::Step;
use ipc_schemas::{NO_ZONE, VERDICT_INFEASIBLE};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// One step in a line.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    /// The step.
    pub step: u64,
    /// Vehicles in the network.
    pub vehicles: u32,
    /// Vehicles by verdict.
    pub verdicts: [u32; 6],
    /// Least margins toward leaders, at merges and at crossings, m, and whose; infinite where nothing is owed.
    pub least: [(f32, u32); 3],
    /// Controllers that did not answer in time, one bit each.
    pub misses: u64,
    /// The world's state hash, in which all states before are.
    pub state_hash: u64,
}

/// What an event on the time line is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// A vehicle for which no acceleration satisfies all rows.
    Infeasible,
    /// A controller begins not to answer in time.
    Missed,
    /// A process takes another's place.
    Replaced,
    /// Frames were refused.
    Refused,
    /// Steps are missing here.
    Skipped,
    /// Somebody steered the run.
    Steered,
    /// A controller's process ended, and the run goes on.
    Exited,
}

/// An event on the time line.
#[derive(Clone, Debug, Serialize)]
pub struct Event {
    /// Its step.
    pub step: u64,
    /// What it is.
    pub kind: EventKind,
    /// In words.
    pub text: String,
    /// The vehicle it is about.
    pub vehicle: Option<u32>,
}

/// Where a vehicle was, for diagrams.
#[derive(Clone, Copy, Debug)]
pub struct Trace {
    /// The step.
    pub step: u32,
    /// The vehicle.
    pub vehicle: u32,
    /// Its zone.
    pub zone: u32,
    /// Its path there.
    pub path: u32,
    /// Position, m.
    pub x_m: f32,
    /// Speed, m/s.
    pub v_mps: f32,
}

/// Most traces kept; beyond, every other step of them is left out.
const MOST_TRACES: usize = 4_000_000;
/// Steps in which none is missing that end a stretch in which some are.
const STRETCH: u64 = 100;
/// Most events kept.
const MOST_EVENTS: usize = 5_000;

/// What is known of a run.
#[derive(Debug)]
pub struct Index {
    /// The steps seen, ascending.
    pub lines: Vec<Line>,
    /// First and last step of each vehicle.
    pub vehicles: BTreeMap<u32, (u64, u64)>,
    /// Per zone, the steps in which its coordinator acted.
    pub acted: Vec<Vec<u64>>,
    /// What happened.
    pub events: Vec<Event>,
    /// Events that are not kept, for there are too many.
    pub more_events: u64,
    /// Where vehicles were, by step.
    pub traces: Vec<Trace>,
    /// Traces are of steps that are multiples of this.
    pub stride: u64,
    /// Whether all there is has been seen.
    pub is_complete: bool,
    /// Steps that came too fast to be taken.
    pub skipped: u64,
    /// The event of the present stretch of missing steps (its step), the step after it, and how many are missing.
    skipping: Option<(u64, u64, u64)>,
    in_force: InForce,
    infeasible: BTreeSet<u32>,
    missed: u64,
    generations: Vec<u32>,
}

impl Index {
    /// Of a run nothing is known of.
    pub fn new(scenario: &Scenario) -> Index {
        let zones = scenario.network.zones.len();
        Index {
            lines: Vec::new(),
            vehicles: BTreeMap::new(),
            acted: vec![Vec::new(); zones],
            events: Vec::new(),
            more_events: 0,
            traces: Vec::new(),
            stride: 1,
            is_complete: false,
            skipped: 0,
            skipping: None,
            in_force: InForce::default(),
            infeasible: BTreeSet::new(),
            missed: 0,
            generations: Vec::new(),
        }
    }

    /// Takes a step; steps come in ascending order.
    pub fn take(&mut self, scenario: &Scenario, step: &Step) {
        let number = step.header.step;
        match self.lines.last() {
            Some(last) if last.step >= number => return,
            Some(last) if last.step + 1 < number => {
                let missing = number - last.step - 1;
                self.skip(last.step, number, missing);
            }
            _ => {}
        }
        self.take_coordination(step);
        let mut line = Line {
            step: number,
            vehicles: 0,
            verdicts: [0; 6],
            least: [(f32::INFINITY, u32::MAX); 3],
            misses: step.misses,
            state_hash: step.state_hash,
        };
        for state in step.state.iter().filter(|s| !s.has_left()) {
            line.vehicles += 1;
            self.vehicles.entry(state.vehicle).or_insert((number, number)).1 = number;
            if number.is_multiple_of(self.stride) && state.zone != NO_ZONE {
                self.traces.push(Trace {
                    step: number as u32,
                    vehicle: state.vehicle,
                    zone: state.zone,
                    path: state.path,
                    x_m: state.x_m as f32,
                    v_mps: state.v_mps as f32,
                });
            }
        }
        self.thin();
        self.take_commands(number, step, &mut line);
        self.take_margins(scenario, step, &mut line);
        self.take_processes(number, step);
        self.lines.push(line);
    }

    fn take_coordination(&mut self, step: &Step) {
        self.in_force.take(step);
        for list in step.coordination.chunk_by(|a, b| a.zone == b.zone) {
            if let Some(acted) = self.acted.get_mut(list[0].zone as usize) {
                acted.push(step.header.step);
            }
        }
    }

    fn take_commands(&mut self, number: u64, step: &Step, line: &mut Line) {
        let mut news = Vec::new();
        for command in step.commands.iter().flat_map(|part| &part.records) {
            if let Some(count) = line.verdicts.get_mut(usize::from(command.verdict)) {
                *count += 1;
            }
            let is_news = if command.verdict == VERDICT_INFEASIBLE {
                self.infeasible.insert(command.vehicle)
            } else {
                self.infeasible.remove(&command.vehicle);
                false
            };
            news.extend(is_news.then_some(command.vehicle));
        }
        for vehicle in news {
            let text = format!("vehicle {vehicle}: no acceleration satisfies all rows; it brakes fully");
            self.say(number, EventKind::Infeasible, text, Some(vehicle));
        }
    }

    fn take_margins(&mut self, scenario: &Scenario, step: &Step, line: &mut Line) {
        self.in_force.owed(scenario, step, |owed| {
            if !owed.counts {
                return;
            }
            let least = match owed.kind {
                DutyKind::RearEnd => &mut line.least[0],
                DutyKind::Merge => &mut line.least[1],
                DutyKind::Cross => &mut line.least[2],
            };
            let margin_m = owed.margin_m() as f32;
            if margin_m < least.0 {
                *least = (margin_m, owed.vehicle);
            }
        });
    }

    fn take_processes(&mut self, number: u64, step: &Step) {
        let begun = step.misses & !self.missed;
        self.missed = step.misses;
        for controller in (0..64).filter(|i| begun >> i & 1 == 1) {
            let text = format!("controller {controller} did not answer in time");
            self.say(number, EventKind::Missed, text, None);
        }
        // The last step has no commands.
        let before = self.generations.clone();
        if !step.commands.is_empty() {
            self.generations = step.commands.iter().map(|part| part.generation).collect();
        }
        let now = self.generations.clone();
        for (controller, (_, now)) in before.iter().zip(&now).enumerate().filter(|(_, (b, n))| b != n) {
            let text = format!("controller {controller} was replaced: generation {now}");
            self.say(number, EventKind::Replaced, text, None);
        }
    }

    /// Notes that steps are missing: one event for a stretch of steps of which only some came.
    fn skip(&mut self, before: u64, number: u64, missing: u64) {
        self.skipped += missing;
        let words = |first: u64, missing: u64| match missing {
            1 => format!("step {first} is missing"),
            _ => format!("{missing} of the steps {first} to {} are missing", number - 1),
        };
        let stretch = self.skipping.filter(|(_, end, _)| number - end <= STRETCH + missing);
        let (first, missing) =
            stretch.map_or((before + 1, missing), |(first, _, missed)| (first, missed + missing));
        self.skipping = Some((first, number, missing));
        let text = words(first, missing);
        let known = |event: &&mut Event| (event.step, event.kind) == (first, EventKind::Skipped);
        match self.events.iter_mut().rev().find(known) {
            Some(event) => event.text = text,
            None => self.say(first, EventKind::Skipped, text, None),
        }
    }

    /// Notes what the world, or the end of a recording, says has happened; what has been seen in a step is known.
    pub fn take_events(&mut self, events: &[RunEvent]) {
        for RunEvent { step, kind, text, .. } in events {
            let kind = match kind {
                RunEventKind::Missed => EventKind::Missed,
                RunEventKind::Refused => EventKind::Refused,
                RunEventKind::Replaced => EventKind::Replaced,
                RunEventKind::Steered => EventKind::Steered,
                RunEventKind::Exited => EventKind::Exited,
            };
            let is_known = |other: &Event| {
                (other.step, other.kind) == (*step, kind)
                    && (other.text == *text || kind == EventKind::Missed)
            };
            let at = self.events.partition_point(|other| other.step <= *step);
            let first = self.events.partition_point(|other| other.step < *step);
            if !self.events[first..at].iter().any(is_known) {
                self.put(at, Event { step: *step, kind, text: text.clone(), vehicle: None });
            }
        }
    }

    /// Notes an event.
    fn say(&mut self, step: u64, kind: EventKind, text: String, vehicle: Option<u32>) {
        let at = self.events.partition_point(|other| other.step <= step);
        self.put(at, Event { step, kind, text, vehicle });
    }

    fn put(&mut self, at: usize, event: Event) {
        if self.events.len() < MOST_EVENTS {
            self.events.insert(at, event);
        } else {
            self.more_events += 1;
        }
    }

    /// Leaves out every other step of the traces when there are too many.
    fn thin(&mut self) {
        if self.traces.len() > MOST_TRACES {
            self.stride *= 2;
            let stride = self.stride;
            self.traces.retain(|trace| u64::from(trace.step).is_multiple_of(stride));
        }
    }

    /// The first step in which the state is not that of another run; `None` where it is as far as both are known.
    pub fn differs_from(&self, other: &Index) -> Option<u64> {
        let shared = self.lines.len().min(other.lines.len());
        let (own, theirs) = (&self.lines[..shared], &other.lines[..shared]);
        let is_same =
            |at: usize| (own[at].step, own[at].state_hash) == (theirs[at].step, theirs[at].state_hash);
        // A hash holds all that was before: once they differ they stay so.
        let (mut same, mut different) = (0, shared);
        while same < different {
            let middle = usize::midpoint(same, different);
            if is_same(middle) { same = middle + 1 } else { different = middle }
        }
        own.get(same).map(|line| line.step)
    }

    /// The last step up to this one in which a zone's coordinator acted.
    pub fn acted_before(&self, zone: u32, step: u64) -> Option<u64> {
        let acted = self.acted.get(zone as usize)?;
        acted[..acted.partition_point(|at| *at <= step)].last().copied()
    }
}
