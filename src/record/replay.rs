//! Runs the roles again from what they were given, and compares what they do with what was recorded.
//!
//! Each role gets its recorded inputs, not what another role has just computed: so it is the role that differs
//! that is found, and not all that depend on it.

use super::compare::{Difference, Rules, first_difference};
use super::reader::{Damage, Reader, Source};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::scenario::share::zones_of;
use crate::scenario::{Drivers, Scenario};
use crate::step::Step;
use crate::world::World;
use ipc_schemas::{
    Assignment, FLAG_END_OF_RUN, FLAG_MISSED, NO_ZONE, STATE_LEFT, VehicleCommand, VehicleState, ZoneSummary,
};
use std::collections::BTreeMap;
use std::ops::Range;

/// Why a world cannot be brought to a step.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The file is damaged before that step.
    #[error("the recording is damaged at {0}")]
    Damaged(#[from] Damage),
    /// A step before it is not in the file.
    #[error("step {0} is not in the recording")]
    Missing(u64),
    /// The run did not get that far.
    #[error("the recording ends at step {last}, before step {step}")]
    TooFar {
        /// Step asked for.
        step: u64,
        /// Last step there is.
        last: u64,
    },
    /// Only whoever moved the vehicles knows how.
    #[error(
        "the vehicles were moved by {0}, not by the world: what it did is recorded, and cannot be done again"
    )]
    Played(String),
    /// The world came out elsewhere.
    #[error("the replayed world differs from the recorded one: {0}")]
    Differs(Box<Difference>),
    /// The world does not take the recorded commands.
    #[error("step {step}: the world does not take the recorded commands: {reason}")]
    Commands {
        /// Step.
        step: u64,
        /// What it said.
        reason: String,
    },
}

/// The world as it was before it published step `until`, brought there by the recorded commands. Every state
/// on the way has been compared with the recorded one.
pub fn replay_world<S: Source>(reader: &Reader<S>, until: u64) -> Result<World, ReplayError> {
    let mut role = WorldReplay::new(reader);
    for step in reader.steps() {
        if role.world.step() == until {
            return Ok(role.world);
        }
        let step = step?;
        if step.header.step != role.world.step() {
            return Err(ReplayError::Missing(role.world.step()));
        }
        role.take(&step)?;
        if role.finished {
            break;
        }
    }
    let last = role.world.step();
    if last == until && !role.finished {
        Ok(role.world)
    } else {
        Err(ReplayError::TooFar {
            step: until,
            last: if role.finished { last } else { last.saturating_sub(1) },
        })
    }
}

/// What came of one role.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RoleReport {
    /// Role and index.
    pub role: String,
    /// Steps in which what it did was compared.
    pub steps: u64,
    /// Steps in which it was given its inputs and not compared, and why.
    pub inputs_only: Option<(u64, &'static str)>,
    /// The first step in which it did something else than was recorded, in words.
    pub difference: Option<String>,
}

/// What came of a replay.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Replay {
    /// World, coordinators, controllers.
    pub roles: Vec<RoleReport>,
    /// Steps read.
    pub steps: u64,
    /// The world's state hash after the last step it got right.
    pub state_hash: u64,
    /// Why the replay ended before the end of the recording, if it did.
    pub stopped: Option<Stop>,
}

impl Replay {
    /// Whether no role differed.
    pub fn same(&self) -> bool {
        self.roles.iter().all(|role| role.difference.is_none())
    }
}

/// Why a replay ended early.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Stop {
    /// Steps are missing: the first of them. Roles remember, so none can go on behind a gap.
    Gap(u64),
    /// The file is damaged.
    Damage(Damage),
}

/// Replays every role from its recorded inputs.
pub fn replay<S: Source>(reader: &Reader<S>, mut progress: impl FnMut(u64)) -> Replay {
    let mut world = WorldReplay::new(reader);
    let mut world_report = Tally::new("world".to_owned());
    let is_played = reader.metadata().played_by.is_some();
    world_report.why = "somebody else moved its vehicles";
    let mut coordinators = coordinators(reader);
    let mut controllers = controllers(reader);
    let mut before: Vec<ZoneSummary> = Vec::new();
    let (mut steps, mut stopped) = (0_u64, None);
    let dt_ns = reader.metadata().dt_ns;
    for step in reader.steps() {
        let step = match step {
            Ok(step) if step.header.step == steps => step,
            Ok(_) => {
                stopped = Some(Stop::Gap(steps));
                break;
            }
            Err(damage) => {
                stopped = Some(Stop::Damage(damage));
                break;
            }
        };
        if world_report.difference.is_none() {
            let taken = if is_played { world.read(&step) } else { world.take(&step) };
            match taken {
                Ok(()) if is_played => world_report.skipped += 1,
                Ok(()) => world_report.steps += 1,
                Err(error) => world_report.difference = Some(error.to_string()),
            }
        }
        // The others index by what a state frame says; one that no world sends ends them as well.
        let flaw = if step.header.time_ns == steps.saturating_mul(dt_ns) {
            flaw_of_states(reader.scenario(), &step.state)
        } else {
            Some(format!("step {steps} is recorded for another instant"))
        };
        let is_last = step.header.flags & FLAG_END_OF_RUN != 0;
        for (role, tally) in &mut coordinators {
            tally.step(flaw.as_deref(), |_| if is_last { Ok(false) } else { role.take(&step, &before) });
        }
        for (role, tally) in &mut controllers {
            tally
                .step(flaw.as_deref(), |skipped| if is_last { Ok(false) } else { role.take(&step, skipped) });
        }
        before = step.summaries;
        steps += 1;
        progress(steps);
    }
    // The last steps of the run may be missing as well.
    if stopped.is_none() {
        stopped = reader.gaps().first().map(|(first, _)| Stop::Gap(*first));
    }
    let tallies = coordinators.into_iter().map(|(_, t)| t).chain(controllers.into_iter().map(|(_, t)| t));
    Replay {
        roles: std::iter::once(world_report).chain(tallies).map(Tally::report).collect(),
        steps,
        state_hash: world.state_hash,
        stopped,
    }
}

struct Tally {
    role: String,
    steps: u64,
    skipped: u64,
    why: &'static str,
    difference: Option<String>,
}

impl Tally {
    fn new(role: String) -> Tally {
        Tally { role, steps: 0, skipped: 0, why: "", difference: None }
    }

    /// Lets a role take a step unless it has gone astray; `Ok(true)` from it counts as compared.
    fn step(&mut self, flaw: Option<&str>, take: impl FnOnce(&mut u64) -> Result<bool, String>) {
        if self.difference.is_some() {
            return;
        }
        let taken = match flaw {
            None => take(&mut self.skipped),
            Some(flaw) => Err(flaw.to_owned()),
        };
        match taken {
            Ok(compared) => self.steps += u64::from(compared),
            Err(difference) => self.difference = Some(difference),
        }
    }

    fn report(self) -> RoleReport {
        let inputs_only = (self.skipped > 0).then_some((self.skipped, self.why));
        RoleReport { role: self.role, steps: self.steps, inputs_only, difference: self.difference }
    }
}

/// The world of a recording, brought on step by step by the recorded commands.
#[derive(Debug)]
pub struct WorldReplay {
    world: World,
    /// With all frames that came out right in it.
    state_hash: u64,
    finished: bool,
    /// Whether commands were put in in the step before.
    missed: bool,
    /// Who moved the vehicles, if not the world.
    played_by: Option<String>,
}

impl WorldReplay {
    /// The world before its first step.
    pub fn new<S: Source>(reader: &Reader<S>) -> WorldReplay {
        let metadata = reader.metadata();
        let mut world = World::new(reader.scenario().clone(), metadata.coordinators);
        world.share_out(metadata.controllers);
        let played_by = metadata.played_by.clone();
        WorldReplay { world, state_hash: 0, finished: false, missed: false, played_by }
    }

    /// The world: where the next step finds it, or where the last step of the run left it.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Has the world keep every visit from now on.
    pub fn record_visits(&mut self) {
        self.world.record_visits();
    }

    /// Only hashes the recorded state, and compares the hash.
    fn read(&mut self, step: &Step) -> Result<(), ReplayError> {
        self.world.seal(&step.state);
        let own = Step { state_hash: self.world.state_hash(), ..step.clone() };
        if let Some(difference) = first_difference(&own, step, Rules { same_processes: true }) {
            return Err(ReplayError::Differs(Box::new(difference)));
        }
        self.state_hash = own.state_hash;
        Ok(())
    }

    /// Compares the world with the recorded state, then gives it the recorded commands.
    pub fn take(&mut self, step: &Step) -> Result<(), ReplayError> {
        if let Some(name) = &self.played_by {
            return Err(ReplayError::Played(name.clone()));
        }
        let world = &mut self.world;
        let masks = world.coordinator_masks();
        let finished = world.is_finished();
        let mut own = Step { state: world.records().collect(), ..step.clone() };
        own.header.step = world.step();
        own.header.time_ns = world.time_ns();
        own.header.coordinators_acting = masks.acting;
        own.header.coordinators_summarised = masks.summarised;
        own.header.flags = if finished { FLAG_END_OF_RUN } else { 0 };
        own.header.flags |= if self.missed { FLAG_MISSED } else { 0 };
        world.seal(&own.state);
        own.state_hash = world.state_hash();
        if let Some(difference) = first_difference(&own, step, Rules { same_processes: true }) {
            return Err(ReplayError::Differs(Box::new(difference)));
        }
        self.state_hash = own.state_hash;
        self.finished = finished;
        self.missed = step.misses != 0;
        if finished {
            return Ok(());
        }
        let refused = |reason: String| ReplayError::Commands { step: step.header.step, reason };
        let senders = world.drivers().count() as usize;
        if step.commands.len() != senders {
            return Err(refused(format!("they are of {} controllers, not {senders}", step.commands.len())));
        }
        world.coordinate(&step.coordination);
        for (index, part) in (0..).zip(&step.commands) {
            // For whom nobody waits any more the world puts in commands, and nobody has missed anything.
            let is_put_in = part.records.iter().any(|c| c.verdict > ipc_schemas::VERDICT_INFEASIBLE);
            let taken = match is_put_in || step.missed(index as usize) {
                true => world.put_in(index, &part.records),
                false => world.command(index, &part.records),
            };
            taken.map_err(|fault| refused(format!("controller {index}: {fault}")))?;
        }
        world.advance().map_err(|error| refused(error.to_string()))
    }
}

struct CoordinatorReplay {
    role: Coordinator,
    index: u32,
    zones: Range<u32>,
    all_zones: u32,
}

fn coordinators<S: Source>(reader: &Reader<S>) -> Vec<(CoordinatorReplay, Tally)> {
    let all_zones = reader.scenario().network.zones.len() as u32;
    let count = reader.metadata().coordinators;
    let role = |index| {
        let zones = zones_of(all_zones, index, count);
        let role = Coordinator::new(reader.scenario().clone(), zones.clone());
        let role = CoordinatorReplay { role, index, zones, all_zones };
        (role, Tally::new(format!("coordinator {index}")))
    };
    (0..count).map(role).collect()
}

impl CoordinatorReplay {
    /// Whether there was something to compare, or what differs.
    fn take(&mut self, step: &Step, before: &[ZoneSummary]) -> Result<bool, String> {
        let zones = self.zones.clone();
        let assigned: Vec<Assignment> =
            step.coordination.iter().filter(|a| zones.contains(&a.zone)).copied().collect();
        let said: Vec<ZoneSummary> =
            step.summaries.iter().filter(|s| zones.contains(&s.from_zone)).copied().collect();
        let acts = step.header.coordinators_acting >> self.index & 1 == 1;
        let (mut own_assigned, mut own_said) = (Vec::new(), Vec::new());
        if acts {
            // Those between zones of one process never leave it and are not recorded.
            self.role.receive(before);
            self.role.act(step.header.step, &step.state);
            own_assigned.extend_from_slice(self.role.assignments());
            own_said.extend(self.role.summaries(0..self.all_zones));
        }
        let recorded = Step { coordination: assigned, summaries: said, ..step.clone() };
        let own = Step { coordination: own_assigned, summaries: own_said, ..step.clone() };
        difference(&own, &recorded).map_or(Ok(acts), Err)
    }
}

struct ControllerReplay {
    role: ControllerPool,
    index: usize,
    /// What a controller takes over after a step in which commands were put in: those of that step, and the
    /// assignments in force by zone.
    before: Vec<VehicleCommand>,
    in_force: BTreeMap<u32, Vec<Assignment>>,
}

fn controllers<S: Source>(reader: &Reader<S>) -> Vec<(ControllerReplay, Tally)> {
    let scenario = reader.scenario();
    let all_zones = scenario.network.zones.len() as u32;
    let pool = Drivers::new(scenario, reader.metadata().controllers).pool();
    let role = |index| {
        let role = ControllerPool::new(scenario.clone(), zones_of(all_zones, index, pool));
        let mut tally = Tally::new(format!("controller {index}"));
        tally.why = "it did not answer in time";
        let role =
            ControllerReplay { role, index: index as usize, before: Vec::new(), in_force: BTreeMap::new() };
        (role, tally)
    };
    (0..pool).map(role).collect()
}

impl ControllerReplay {
    fn take(&mut self, step: &Step, skipped: &mut u64) -> Result<bool, String> {
        let number = step.header.step;
        if step.header.flags & FLAG_MISSED != 0 {
            let in_force: Vec<Assignment> = self.in_force.values().flatten().copied().collect();
            self.role
                .restore(&step.state, &self.before, &in_force)
                .map_err(|fault| format!("step {number}: {fault}"))?;
        }
        for group in step.coordination.chunk_by(|a, b| a.zone == b.zone) {
            self.in_force.insert(group[0].zone, group.to_vec());
        }
        self.before.clear();
        self.before.extend(step.commands.iter().flat_map(|part| &part.records));
        self.role
            .coordinate(&step.state, &step.coordination)
            .map_err(|fault| format!("step {number}: {fault}"))?;
        let mut own: Vec<VehicleCommand> = Vec::new();
        self.role
            .command(step.header.time_ns as f64 * 1e-9, &step.state, |command| own.push(command))
            .map_err(|fault| format!("step {number}: {fault}"))?;
        if step.missed(self.index) {
            *skipped += 1;
            return Ok(false);
        }
        let mut recorded = step.clone();
        for (index, part) in recorded.commands.iter_mut().enumerate() {
            if index != self.index {
                part.records.clear();
            }
        }
        let mut replayed = recorded.clone();
        match replayed.commands.get_mut(self.index) {
            Some(part) => part.records = own,
            None => return Err(format!("step {number}: the recording has no commands of it")),
        }
        difference(&replayed, &recorded).map_or(Ok(true), Err)
    }
}

/// What a role did differently, in words.
fn difference(own: &Step, recorded: &Step) -> Option<String> {
    let difference = first_difference(own, recorded, Rules { same_processes: true })?;
    Some(format!("{difference} (replayed / recorded)"))
}

/// Beyond these no vehicle gets in a scenario that a recording may have.
const MAX_M: f64 = 1e7;
const MAX_MPS: f64 = 1e4;
const MAX_S: f64 = 1e9;

/// Why a recorded state frame is none that roles can be given: zones out of order, a path that does not exist,
/// numbers that no vehicle can have.
fn flaw_of_states(scenario: &Scenario, states: &[VehicleState]) -> Option<String> {
    let mut last = 0;
    for (i, state) in states.iter().enumerate() {
        let is_first = i == 0 || states[i - 1].zone != state.zone;
        let within = |value: f64, least: f64, most: f64| value >= least && value <= most;
        let numbers = within(state.x_m, -MAX_M, MAX_M)
            && within(state.v_mps, 0.0, MAX_MPS)
            && within(state.u_mps2, -MAX_MPS, MAX_MPS)
            && within(state.entry_time_s, 0.0, MAX_S)
            && within(state.entry_speed_mps, 0.0, MAX_MPS);
        let place = scenario.network.zones.get(state.zone as usize);
        let on_path = place.is_some_and(|zone| (state.path as usize) < zone.paths.len());
        let sound = state.zone >= last
            && (on_path || state.zone == NO_ZONE)
            && (is_first || state.flags & STATE_LEFT == 0 || states[i - 1].flags & STATE_LEFT != 0)
            && numbers;
        if !sound {
            return Some(format!("the recorded state of vehicle {} is none a world sends", state.vehicle));
        }
        last = state.zone;
    }
    None
}
