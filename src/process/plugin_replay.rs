//! A controller written elsewhere, driven by a recording instead of a run: it is shown the recorded states and
//! coordination, and what it commands is compared with what was recorded.
//!
//! What it commands moves nobody: each state is the recorded one, so each difference is the controller's own.

use super::attach::{Readiness, Reception};
use super::plugin_child::PluginChild;
use super::services::{MembersOutbox, create_feedback};
use super::{LatencyUs, ProcessError, WaitMode, new_histogram};
use crate::lockstep::Handover;
use crate::record::{Damage, FileSource, Reader};
use crate::scenario::share::zones_of;
use crate::scenario::{Drivers, OnExit, Plugin, Scenario};
use crate::step::Step;
use crate::transport::iox::{IoxInbox, IoxOutbox, RunName, RunSpace, ServiceLimits};
use crate::transport::{Backlog, Frame, Inbox, Loan, Outbox};
use hdrhistogram::Histogram;
use ipc_schemas::{
    self as frames, Assignment, ExpectedHeader, FLAG_END_OF_RUN, Feedback, FrameHeader, Member, Role,
    VERDICT_INFEASIBLE, VehicleCommand, VehicleState,
};
use serde::Serialize;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Differences that are listed.
const LISTED: usize = 20;

/// How a controller is replayed.
#[derive(Clone, Debug)]
pub struct PluginReplayOptions {
    /// The controller's name in the recording, or zones and paths it is to drive (`merge-1,merge-2.main`).
    pub target: String,
    /// First step it is shown.
    pub from: u64,
    /// Accelerations that differ by no more than this are the same, m/s^2.
    pub tolerance_mps2: f64,
    /// How long it may take to join, to answer, and to end; without bound when it is debugged.
    pub patience: Option<Duration>,
    /// Whether it has the terminal.
    pub has_terminal: bool,
}

/// Why a controller cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum PluginReplayError {
    /// The target is none of the recording.
    #[error("{target}: expected {expected}")]
    Target {
        /// What was asked for.
        target: String,
        /// What there is.
        expected: String,
    },
    /// The recording is damaged.
    #[error("the recording is damaged at {0}")]
    Damaged(#[from] Damage),
    /// The steps asked for are not there.
    #[error("step {0} is not in the recording")]
    Missing(u64),
    /// The controller could not be started.
    #[error("cannot start {command}: {reason}")]
    Start {
        /// Its command line.
        command: String,
        /// Why not.
        reason: String,
    },
    /// It did not do what it should in time, or ended.
    #[error("step {step}: {what}")]
    Broke {
        /// The step at hand.
        step: u64,
        /// What happened.
        what: String,
    },
    /// The transport failed.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

impl From<crate::transport::TransportError> for PluginReplayError {
    fn from(error: crate::transport::TransportError) -> PluginReplayError {
        PluginReplayError::Process(error.into())
    }
}

impl From<crate::transport::iox::SpaceError> for PluginReplayError {
    fn from(error: crate::transport::iox::SpaceError) -> PluginReplayError {
        PluginReplayError::Process(error.into())
    }
}

/// A command that is not the recorded one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CommandDifference {
    /// Step.
    pub step: u64,
    /// Vehicle.
    pub vehicle: u32,
    /// Its zone.
    pub zone: String,
    /// Where it was on its path, m.
    pub x_m: f64,
    /// How fast, m/s.
    pub v_mps: f64,
    /// What the controller commands now, m/s^2.
    pub u_mps2: f64,
    /// What was recorded, m/s^2.
    pub recorded_mps2: f64,
}

/// What came of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PluginReplay {
    /// Name under which the controller attached.
    pub controller: String,
    /// Steps it answered.
    pub steps: u64,
    /// Commands compared.
    pub commands: u64,
    /// Recorded commands that the world put in, and so are not compared.
    pub put_in: u64,
    /// Commands that differ.
    pub differing: u64,
    /// The first of them.
    pub differences: Vec<CommandDifference>,
    /// The one that differs most.
    pub greatest: Option<CommandDifference>,
    /// How long it took to answer, us.
    pub answer_time_us: Option<LatencyUs>,
    /// The first step that is missing, if the replay ended there.
    pub stopped_before: Option<u64>,
}

/// Drives a controller through a recording.
///
/// # Errors
/// When the recording cannot be read or has no such controller, or this one cannot be started, breaks the contract,
/// or does not answer.
pub fn replay_plugin(
    reader: &Reader<FileSource>,
    options: &PluginReplayOptions,
    command: &[String],
) -> Result<PluginReplay, PluginReplayError> {
    let plugin = plugin_of(reader.scenario(), &options.target)?;
    let name = plugin.name.clone();
    let scenario = Arc::new(Scenario { plugins: vec![plugin], ..(**reader.scenario()).clone() });
    let run: RunName = format!("replay-{}", std::process::id()).parse().expect("letters, a dash and digits");
    let space = RunSpace::enter(&run)?;
    let mut stage = Stage::set(&space, &scenario, reader, options)?;
    let known = reader.scenario().plugins.iter().position(|plugin| plugin.name == name);
    stage.recorded_as =
        known.map(|at| reader.metadata().controllers as usize - reader.scenario().plugins.len() + at);
    let mut steps = reader.steps();
    let mut at_hand = None;
    for step in steps.by_ref() {
        let step = step?;
        if step.header.step >= options.from {
            at_hand = Some(step);
            break;
        }
        stage.coordinate(&step.coordination);
    }
    let first = at_hand.filter(|step| step.header.step == options.from);
    let first = first.ok_or(PluginReplayError::Missing(options.from))?;
    let start = |reason: std::io::Error| PluginReplayError::Start {
        command: command.join(" "),
        reason: reason.to_string(),
    };
    let mut child = PluginChild::start(command, &run, &name, options.has_terminal).map_err(start)?;
    stage.admit(&mut child, options.from)?;
    let mut expected = options.from;
    for step in std::iter::once(Ok(first)).chain(steps) {
        let step = step?;
        if step.header.step != expected {
            stage.came_to.stopped_before = Some(expected);
            break;
        }
        expected += 1;
        if step.header.flags & FLAG_END_OF_RUN != 0 {
            break;
        }
        stage.play(&mut child, &step)?;
    }
    stage.finish(&mut child, expected)?;
    let Stage { mut came_to, answer_ns, .. } = stage;
    let us = |quantile| answer_ns.value_at_quantile(quantile) as f64 / 1e3;
    let max = answer_ns.max() as f64 / 1e3;
    came_to.answer_time_us =
        (!answer_ns.is_empty()).then(|| LatencyUs { p50: us(0.5), p99: us(0.99), p999: us(0.999), max });
    came_to.controller = name;
    Ok(came_to)
}

/// The controller of that name, or one that drives what is named.
fn plugin_of(scenario: &Scenario, target: &str) -> Result<Plugin, PluginReplayError> {
    if let Some(known) = scenario.plugins.iter().find(|plugin| plugin.name == target) {
        return Ok(known.clone());
    }
    let zones = &scenario.network.zones;
    let mut paths = Vec::new();
    for item in target.split(',') {
        let (zone, path) = item.split_once('.').map_or((item, None), |(zone, path)| (zone, Some(path)));
        let place = zones.iter().position(|z| z.name == zone);
        let found: Vec<_> = (0..)
            .zip(place.map_or(&[][..], |place| &zones[place].paths))
            .filter(|(_, shape)| path.is_none_or(|path| shape.name == path))
            .map(|(path, _)| (place.unwrap_or(0) as u32, path))
            .collect();
        if found.is_empty() {
            let controllers = scenario.plugins.iter().map(|plugin| plugin.name.as_str());
            let all: Vec<_> = controllers.chain(zones.iter().map(|zone| zone.name.as_str())).collect();
            let expected = format!("a controller, zones or paths of the recording: {}", all.join(", "));
            return Err(PluginReplayError::Target { target: item.to_owned(), expected });
        }
        paths.extend(found);
    }
    paths.sort_unstable();
    paths.dedup();
    let name = target.replace('.', "-").replace(',', "_");
    Ok(Plugin { name, paths, command: None, on_exit: OnExit::End })
}

/// World and coordinators of a recording.
struct Stage<'a> {
    scenario: &'a Scenario,
    options: &'a PluginReplayOptions,
    drivers: Drivers,
    reception: Reception,
    state: IoxOutbox<VehicleState>,
    /// One for each coordinator process.
    coordination: Vec<IoxOutbox<Assignment>>,
    commands: IoxInbox<VehicleCommand>,
    members: MembersOutbox,
    feedback: IoxOutbox<Feedback>,
    /// Index of the controller in the recording, if it was in it.
    recorded_as: Option<usize>,
    run_id: u64,
    /// By zone.
    in_force: Vec<Vec<Assignment>>,
    answer_ns: Histogram<u64>,
    came_to: PluginReplay,
}

/// Index of the controller: behind one process of the pool, which nobody plays.
const INDEX: u32 = 1;
/// Time between two looks for whoever joins or ends.
const LOOK: Duration = Duration::from_millis(1);

impl<'a> Stage<'a> {
    fn set(
        space: &RunSpace,
        scenario: &'a Scenario,
        reader: &Reader<FileSource>,
        options: &'a PluginReplayOptions,
    ) -> Result<Stage<'a>, PluginReplayError> {
        let coordinators = reader.metadata().coordinators;
        let (count, run_id) = (coordinators as usize, reader.metadata().run_id);
        let nodes = count + 5;
        let limits = |publishers, subscribers| {
            let backlog = Backlog::STEPS;
            ServiceLimits { publishers, subscribers, nodes, backlog }
        };
        let state = space.create(frames::SERVICE_STATE, limits(1, 3))?;
        let coordination = space.create(frames::SERVICE_COORDINATION, limits(count, 3))?;
        let commands = space.create(frames::SERVICE_COMMAND, limits(3, 1))?;
        let members = space.create(frames::SERVICE_MEMBERS, MembersOutbox::limits(3, nodes))?;
        let feedback = create_feedback(space, INDEX)?;
        Ok(Stage {
            scenario,
            options,
            drivers: Drivers::new(scenario, INDEX + 1),
            state: state.outbox(256)?,
            coordination: (0..count).map(|_| coordination.outbox(512)).collect::<Result<_, _>>()?,
            commands: commands.inbox()?,
            members: MembersOutbox::open(&members, run_id)?,
            feedback: feedback.outbox(16)?,
            recorded_as: None,
            reception: Reception::open(space, scenario, run_id, (coordinators, INDEX + 1), WaitMode::Hybrid)?,
            run_id,
            in_force: vec![Vec::new(); scenario.network.zones.len()],
            answer_ns: new_histogram(),
            came_to: PluginReplay {
                controller: String::new(),
                steps: 0,
                commands: 0,
                put_in: 0,
                differing: 0,
                differences: Vec::new(),
                greatest: None,
                answer_time_us: None,
                stopped_before: None,
            },
        })
    }

    /// These assignments are in force from now on.
    fn coordinate(&mut self, assignments: &[Assignment]) {
        for group in assignments.chunk_by(|a, b| a.zone == b.zone) {
            if let Some(zone) = self.in_force.get_mut(group[0].zone as usize) {
                *zone = group.to_vec();
            }
        }
    }

    /// Waits for something that the controller is to do.
    fn wait_for<T>(
        &mut self,
        child: &mut PluginChild,
        step: u64,
        what: &str,
        mut happened: impl FnMut(&mut Self) -> Result<Option<T>, PluginReplayError>,
    ) -> Result<T, PluginReplayError> {
        let start = Instant::now();
        loop {
            if let Some(found) = happened(self)? {
                return Ok(found);
            }
            let waited = start.elapsed();
            let broke = |what| Err(PluginReplayError::Broke { step, what });
            if let Some(status) = (waited >= LOOK).then(|| child.ended()).flatten() {
                return broke(format!("the controller ended ({status}); it was to {what}"));
            }
            if let Some(patience) = self.options.patience.filter(|patience| waited >= *patience) {
                return broke(format!("the controller did not {what} within {} s", patience.as_secs_f64()));
            }
            if waited < LOOK { std::thread::yield_now() } else { std::thread::sleep(LOOK / 10) }
        }
    }

    /// Waits for the controller to join and say that it is ready.
    fn admit(&mut self, child: &mut PluginChild, step: u64) -> Result<(), PluginReplayError> {
        self.reception.first_step = step;
        self.wait_for(child, step, "join", |stage| {
            let Stage { reception, in_force, .. } = stage;
            reception.serve(&mut |_, _, _| {
                let handover = Handover { step, in_force: in_force.concat(), ..Handover::default() };
                Readiness::Now(Box::new(handover))
            })?;
            if let Some(reason) = reception.last_refusal.take() {
                let what = format!("attach request refused: {reason}");
                return Err(PluginReplayError::Broke { step, what });
            }
            Ok(reception.is_ready(INDEX as usize).then_some(()))
        })?;
        // The coordinators are in this process, and so are their sending ends.
        let count = self.coordination.len() as u16;
        let own = (0..count).map(|index| Member {
            process_id: std::process::id(),
            role: frames::ROLE_COORDINATOR,
            index,
            ..Member::default()
        });
        self.members.tell(step, own)?;
        Ok(())
    }

    /// Shows the controller a step and takes its answer.
    fn play(&mut self, child: &mut PluginChild, step: &Step) -> Result<(), PluginReplayError> {
        let number = step.header.step;
        let header = FrameHeader {
            run_id: self.run_id,
            schema_hash: frames::schema_hash(),
            sender_role: Role::World as u16,
            sender_index: 0,
            generation: 0,
            ..step.header
        };
        let is_own = |f: &&Feedback| self.recorded_as == Some(usize::from(f.controller));
        let told: Vec<Feedback> = step.feedback.iter().filter(is_own).copied().collect();
        if !told.is_empty() {
            self.feedback.loan(header, told.len(), |s| told.iter().for_each(|r| s.push(*r)))?.send()?;
        }
        let sent = Instant::now();
        let states = step.state.iter().copied();
        self.state.loan(header, step.state.len(), |s| states.for_each(|r| s.push(r)))?.send()?;
        let (zones, count) = (self.scenario.network.zones.len() as u32, self.coordination.len() as u32);
        for index in (0..count).filter(|index| step.header.coordinators_acting >> index & 1 == 1) {
            let own = zones_of(zones, index, count);
            let part: Vec<Assignment> =
                step.coordination.iter().filter(|a| own.contains(&a.zone)).copied().collect();
            let header = FrameHeader {
                sender_role: Role::Coordinator as u16,
                sender_index: index as u16,
                flags: 0,
                ..header
            };
            let outbox = &mut self.coordination[index as usize];
            outbox.loan(header, part.len(), |s| part.iter().for_each(|r| s.push(*r)))?.send()?;
        }
        self.coordinate(&step.coordination);
        let expected = ExpectedHeader {
            run_id: self.run_id,
            role: Role::Controller,
            index: INDEX as u16,
            generation: self.reception.generation(INDEX as usize),
            step: number,
        };
        let (now, answered) = (header, number + 1);
        let records = self.wait_for(child, number, "answer", |stage| {
            // Whoever was stopped for a while asks what it has missed; nothing has been.
            let Stage { reception, in_force, .. } = stage;
            reception.go_on_from(number);
            reception.serve(&mut |_, _, _| {
                let (header, in_force) = (Some(now), in_force.concat());
                Readiness::Now(Box::new(Handover {
                    step: answered - 1,
                    header,
                    in_force,
                    ..Handover::default()
                }))
            })?;
            let Some(frame) = stage.commands.receive()? else { return Ok(None) };
            // The sender may still write to what it has sent: it is judged and compared as it was here.
            let (header, records) = (*frame.header(), frame.records());
            let broke = |what| PluginReplayError::Broke { step: number, what };
            expected.check(&header, records.len()).map_err(|fault| broke(format!("its answer: {fault}")))?;
            if records.len() > step.state.len() {
                let (many, vehicles) = (records.len(), step.state.len());
                return Err(broke(format!("its answer has {many} commands for {vehicles} vehicles")));
            }
            Ok(Some(records.to_vec()))
        })?;
        let _ = self.answer_ns.record(sent.elapsed().as_nanos() as u64);
        self.came_to.steps += 1;
        self.compare(step, &records)
    }

    /// Compares its commands with those recorded for the same vehicles, whoever gave them.
    fn compare(&mut self, step: &Step, own: &[VehicleCommand]) -> Result<(), PluginReplayError> {
        let number = step.header.step;
        let is_own = |s: &&VehicleState| s.is_commanded() && self.drivers.of(s.zone, s.path) == INDEX;
        let asked: Vec<&VehicleState> = step.state.iter().filter(is_own).collect();
        let of = |c: &VehicleCommand| (c.zone, c.vehicle);
        if !asked.iter().map(|s| (s.zone, s.vehicle)).eq(own.iter().map(of)) {
            let what = format!(
                "its answer has {} commands, which are not one for each of its {} vehicles in the order of the state frame",
                own.len(),
                asked.len()
            );
            return Err(PluginReplayError::Broke { step: number, what });
        }
        let recorded: HashMap<(u32, u32), &VehicleCommand> =
            step.commands.iter().flat_map(|part| &part.records).map(|c| (of(c), c)).collect();
        let PluginReplayOptions { tolerance_mps2, .. } = *self.options;
        for (state, command) in asked.into_iter().zip(own) {
            let Some(known) = recorded.get(&of(command)) else { continue };
            if known.verdict > VERDICT_INFEASIBLE {
                self.came_to.put_in += 1;
                continue;
            }
            self.came_to.commands += 1;
            let apart = |a: f64, b: f64| if a.to_bits() == b.to_bits() { 0.0 } else { (a - b).abs() };
            let by = apart(command.u_mps2, known.u_mps2);
            // Written so that what is no number differs.
            if by <= tolerance_mps2 {
                continue;
            }
            let zone = &self.scenario.network.zones[state.zone as usize];
            let difference = CommandDifference {
                step: number,
                vehicle: state.vehicle,
                zone: format!("{}.{}", zone.name, zone.paths[state.path as usize].name),
                x_m: state.x_m,
                v_mps: state.v_mps,
                u_mps2: command.u_mps2,
                recorded_mps2: known.u_mps2,
            };
            self.came_to.differing += 1;
            let greatest = self.came_to.greatest.as_ref().map(|g| apart(g.u_mps2, g.recorded_mps2));
            if greatest.is_none_or(|greatest| by.is_nan() || by > greatest) {
                self.came_to.greatest = Some(difference.clone());
            }
            if self.came_to.differences.len() < LISTED {
                self.came_to.differences.push(difference);
            }
        }
        Ok(())
    }

    /// Says that the run is over, and waits for the controller to end.
    fn finish(&mut self, child: &mut PluginChild, step: u64) -> Result<(), PluginReplayError> {
        let header = FrameHeader {
            run_id: self.run_id,
            schema_hash: frames::schema_hash(),
            step,
            sender_role: Role::World as u16,
            flags: FLAG_END_OF_RUN,
            ..FrameHeader::default()
        };
        self.state.loan(header, 0, |_| {})?.send()?;
        let start = Instant::now();
        loop {
            let broke = |what| Err(PluginReplayError::Broke { step, what });
            match child.ended() {
                Some(status) if status.success() => return Ok(()),
                Some(status) => return broke(format!("the controller ended with {status} at the end")),
                None if self.options.patience.is_some_and(|patience| start.elapsed() >= patience) => {
                    return broke("the controller was still there after the end".to_owned());
                }
                None => std::thread::sleep(LOOK),
            }
        }
    }
}
