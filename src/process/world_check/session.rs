//! One run with the world under test: coordinator and controller in this process.

use super::foreign::Foreign;
use super::judge::Judge;
use super::{JOIN, Kit, PEER_TIMEOUT, Play, WorldRule};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::own_time::Bound;
use crate::process::services::{expected_vehicles, rope_of};
use crate::process::{Attachment, Joining, ProcessError, WaitMode};
use crate::scenario::{Scenario, scenario_hash};
use crate::transport::iox::{IoxInbox, IoxOutbox, RunName, RunSpace};
use crate::transport::{Frame, Inbox, Loan, Outbox};
use ipc_schemas::{
    self as frames, Assignment, ExpectedHeader, FLAG_END_OF_RUN, FrameHeader, HeaderFault, Role,
    VehicleCommand, VehicleState,
};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use xxhash_rust::xxh3::xxh3_64_with_seed;

/// What became of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Went {
    /// A state came, and is to be answered.
    On,
    /// The run is over.
    Over,
    /// There is no point in going on.
    Wrong,
}

/// How a vehicle's command is changed: step, vehicle, what is commanded, its speed.
type Script = fn(u64, u32, f64, f64, &Scenario) -> f64;

pub(super) struct Session {
    // Dropped in this order: ends of services, the world, the space.
    state: IoxInbox<VehicleState>,
    coordinator_state: IoxInbox<VehicleState>,
    coordination: IoxOutbox<Assignment>,
    commands: IoxOutbox<VehicleCommand>,
    attachments: [Attachment; 2],
    pub world: Foreign,
    space: RunSpace,
    scenario: Arc<Scenario>,
    coordinator: Coordinator,
    pool: ControllerPool,
    pub judge: Judge,
    /// Over all frames so far.
    pub hash: u64,
    /// The state at hand: its header, and a copy of its records.
    header: FrameHeader,
    states: Vec<VehicleState>,
    run_id: u64,
    next: u64,
    summary: PathBuf,
}

impl Session {
    /// Starts the world and joins its run; `None` when that cannot be done, which is a breach.
    pub fn open(kit: &mut Kit<'_>, play: Play) -> Result<Option<Session>, ProcessError> {
        let options = kit.options;
        let run: RunName =
            format!("check-{}-{}", std::process::id(), kit.runs).parse().expect("letters, dashes and digits");
        let file = |name: &str| kit.folder.0.join(format!("{name}-{}", kit.runs));
        let (summary, words) = (file("summary.json"), file("stderr"));
        let space = RunSpace::enter(&run)?;
        let peer_timeout = if play == Play::Abandoned { PEER_TIMEOUT } else { options.patience };
        let mut arguments: Vec<String> = ["world", "--run", &run.to_string()].map(str::to_owned).into();
        for (flag, duration) in
            [("--attach-timeout", JOIN.max(options.patience)), ("--peer-timeout", peer_timeout)]
        {
            arguments.extend([flag.to_owned(), duration.as_secs_f64().to_string()]);
        }
        arguments.extend(["--json".to_owned(), summary.display().to_string()]);
        arguments.extend(options.scenario.iter().cloned());
        kit.tried.insert(WorldRule::Attach);
        let mut world = match Foreign::start(kit.command, &arguments, &words) {
            Ok(world) => world,
            Err(error) => {
                kit.breach(WorldRule::Attach, format!("cannot be started: {error}"));
                return Ok(None);
            }
        };
        let joined = Role::Coordinator;
        let joined = join(&space, &run, joined, kit, &world)
            .and_then(|coordinator| Ok([coordinator, join(&space, &run, Role::Controller, kit, &world)?]));
        let attachments = match joined {
            Ok(attachments) => attachments,
            Err(error) => {
                let rule = match &error {
                    ProcessError::Refused { reason, .. } if reason.contains("schema") => WorldRule::Schema,
                    _ => WorldRule::Attach,
                };
                let what = match error {
                    ProcessError::Interrupted { .. } => world.end(),
                    error => error.to_string(),
                };
                kit.breach(rule, what);
                return Ok(None);
            }
        };
        let reply = attachments[0].reply;
        let wait = WaitMode::from_code(reply.waiting);
        let rope = || rope_of(&attachments[1].bells, wait, Role::World, 0);
        let expected = expected_vehicles(kit.scenario);
        let zones = 0..kit.scenario.network.zones.len() as u32;
        let coordinator_state = format!("{}0", frames::SERVICE_COORDINATOR_STATE_PREFIX);
        let session = Session {
            state: space.open(frames::SERVICE_STATE)?.inbox()?,
            coordinator_state: space.open(&coordinator_state)?.inbox()?,
            coordination: space.open(frames::SERVICE_COORDINATION)?.outbox(2 * expected)?,
            commands: space.open(frames::SERVICE_COMMAND)?.outbox(expected)?.ringing(rope()),
            scenario: kit.scenario.clone(),
            coordinator: Coordinator::new(kit.scenario.clone(), zones.clone()),
            pool: ControllerPool::new(kit.scenario.clone(), zones),
            judge: Judge::new(kit.scenario.clone(), options.tolerances),
            hash: 0,
            header: FrameHeader::default(),
            states: Vec::new(),
            run_id: reply.run_id,
            next: 0,
            summary,
            world,
            space,
            attachments,
        };
        for attachment in &session.attachments {
            if let Err(error) = attachment.ready(&session.world.has_ended) {
                kit.breach(WorldRule::Attach, error.to_string());
                return Ok(None);
            }
        }
        kit.tried.insert(WorldRule::Schema);
        Ok(Some(session))
    }

    /// Waits for the next state, and judges it.
    pub fn take_state(&mut self, kit: &mut Kit<'_>) -> Result<Went, ProcessError> {
        kit.step = self.next;
        let mut bound = Bound::of(kit.options.patience);
        let mut spins = 0;
        loop {
            // Looked at before the frame: what it has sent comes before its end.
            let has_ended = self.world.has_ended.is_set();
            if self.receive()? {
                break;
            }
            if has_ended {
                let how = self.world.end();
                kit.breach(WorldRule::Sound, how);
                return Ok(Went::Wrong);
            }
            if bound.is_over() {
                kit.breach(WorldRule::Steps, format!("no state of this step within {} s", bound.seconds()));
                return Ok(Went::Wrong);
            }
            spins += 1;
            if spins < 2000 {
                std::thread::yield_now()
            } else {
                std::thread::sleep(Duration::from_micros(100))
            }
        }
        kit.report.steps += 1;
        kit.tried.extend([WorldRule::Header, WorldRule::Steps, WorldRule::Sound, WorldRule::Numbers]);
        kit.tried.extend([WorldRule::Numbered, WorldRule::Unique, WorldRule::Kept, WorldRule::Apart]);
        let expected = ExpectedHeader {
            run_id: self.run_id,
            role: Role::World,
            index: 0,
            generation: 0,
            step: self.next,
        };
        if let Err(fault) = expected.check(&self.header, self.states.len()) {
            let rule = match fault {
                HeaderFault::OtherSchema { .. } => WorldRule::Schema,
                HeaderFault::OtherStep { .. } => WorldRule::Steps,
                _ => WorldRule::Header,
            };
            kit.breach(rule, fault.to_string());
            return Ok(Went::Wrong);
        }
        let time_ns = self.next * self.scenario.dt_ns;
        if self.header.time_ns != time_ns {
            kit.breach(WorldRule::Header, format!("time_ns is {}, expected {time_ns}", self.header.time_ns));
        }
        self.hash = xxh3_64_with_seed(frames::bytes_of(&self.states), self.hash);
        self.judge.judge(&self.states, &mut |rule, what| kit.breach(rule, what));
        if self.header.flags & FLAG_END_OF_RUN != 0 {
            return Ok(Went::Over);
        }
        self.next += 1;
        Ok(Went::On)
    }

    /// Takes what has come; the copy is what is judged and answered, whatever becomes of the frame.
    fn receive(&mut self) -> Result<bool, ProcessError> {
        while self.coordinator_state.receive()?.is_some() {}
        let Some(frame) = self.state.receive()? else { return Ok(false) };
        self.header = *frame.header();
        self.states.clear();
        self.states.extend_from_slice(frame.records());
        Ok(true)
    }

    /// Whether it has sent another state before the one at hand was answered.
    pub fn has_more(&mut self) -> Result<bool, ProcessError> {
        Ok(self.state.receive()?.is_some())
    }

    /// Answers the state at hand, for the coordinator and the controller.
    pub fn answer(&mut self, step: u64, script: Script) -> Result<(), ProcessError> {
        let header = |role: Role| FrameHeader {
            run_id: self.run_id,
            schema_hash: frames::schema_hash(),
            step,
            time_ns: self.header.time_ns,
            sender_role: role as u16,
            ..FrameHeader::default()
        };
        if self.header.coordinators_acting & 1 != 0 {
            self.coordinator.act(step, &self.states);
            let assignments = self.coordinator.assignments();
            let fill = assignments.iter().copied();
            let count = assignments.len();
            self.coordination
                .loan(header(Role::Coordinator), count, |s| fill.for_each(|r| s.push(r)))?
                .send()?;
            // What cannot be coordinated is not the kit's to answer for: such a vehicle gets no new duties.
            let _ = self.pool.coordinate(&self.states, assignments);
        }
        let mut commands = Vec::new();
        let time_s = self.header.time_ns as f64 * 1e-9;
        if self.pool.command(time_s, &self.states, |command| commands.push(command)).is_err() {
            // Neither is what contradicts itself: everybody is to go on as it is.
            commands.clear();
            let own = self.states.iter().filter(|s| s.is_commanded());
            commands.extend(own.map(|s| VehicleCommand {
                vehicle: s.vehicle,
                zone: s.zone,
                ..VehicleCommand::default()
            }));
        }
        let members = self.states.iter().filter(|s| s.is_commanded());
        for (command, state) in commands.iter_mut().zip(members) {
            command.u_mps2 = script(step, command.vehicle, command.u_mps2, state.v_mps, &self.scenario);
        }
        self.judge.command(&commands);
        let fill = commands.iter().copied();
        self.commands
            .loan(header(Role::Controller), commands.len(), |s| fill.for_each(|r| s.push(r)))?
            .send()?;
        Ok(())
    }

    /// Where the world was to write its summary.
    pub fn summary(&self) -> PathBuf {
        self.summary.clone()
    }

    /// Leaves the run, for which the world waits before it ends.
    pub fn leave(self) -> Foreign {
        let Session { state, coordinator_state, coordination, commands, attachments, world, space, .. } =
            self;
        drop((state, coordinator_state, coordination, commands, attachments));
        drop(space);
        world
    }
}

fn join(
    space: &RunSpace,
    run: &RunName,
    role: Role,
    kit: &Kit<'_>,
    world: &Foreign,
) -> Result<Attachment, ProcessError> {
    let scenario_hash = Some(scenario_hash(kit.scenario));
    let joining = Joining { role, index: Some(0), scenario_hash, timeout: JOIN.max(kit.options.patience) };
    Attachment::join(space, run, joining, &world.has_ended)
}
