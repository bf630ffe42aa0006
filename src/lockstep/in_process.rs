//! A whole run in one thread: every driver in turn, over the memory transport.

use super::{
    ControllerDriver, ControllerPorts, CoordinatorDriver, CoordinatorPorts, Handover, Identity, Ledger,
    LockstepError, Members, Progress, WorldDriver, WorldPorts,
};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::scenario::Scenario;
use crate::scenario::share::{neighbour_coordinators, zones_of};
use crate::step::{CommandPart, POLICY_NONE, StepFrames};
use crate::transport::memory::{MemoryFrame, MemoryInbox, MemoryOutbox, MemoryService};
use crate::transport::{Frame, Inbox};
use crate::world::{Traffic, World};
use ipc_schemas::{Assignment, Member, Role, VehicleCommand, VehicleState, ZoneSummary};
use std::sync::Arc;

/// The world's driver over the memory transport.
pub type WorldSide = WorldDriver<
    MemoryOutbox<VehicleState>,
    MemoryOutbox<VehicleState>,
    MemoryInbox<VehicleCommand>,
    MemoryInbox<Assignment>,
>;
/// A coordinator's driver over the memory transport.
pub type CoordinatorSide = CoordinatorDriver<
    MemoryInbox<VehicleState>,
    MemoryInbox<ZoneSummary>,
    MemoryOutbox<ZoneSummary>,
    MemoryOutbox<Assignment>,
    MemoryInbox<Member>,
>;
/// A controller process's driver over the memory transport.
pub type ControllerSide = ControllerDriver<
    MemoryInbox<VehicleState>,
    MemoryInbox<Assignment>,
    MemoryOutbox<VehicleCommand>,
    MemoryInbox<Member>,
>;

/// World, coordinators and controllers of a run, in one thread.
#[derive(Debug)]
pub struct InProcess {
    world: WorldSide,
    coordinators: Vec<CoordinatorSide>,
    controllers: Vec<ControllerSide>,
    /// Present when somebody looks on.
    observer: Option<Observer>,
}

/// Sees every frame of a run.
#[derive(Debug)]
struct Observer {
    state: MemoryInbox<VehicleState>,
    summaries: Vec<MemoryInbox<ZoneSummary>>,
    coordination: MemoryInbox<Assignment>,
    command: MemoryInbox<VehicleCommand>,
}

impl InProcess {
    /// The run id of all frames.
    pub const RUN_ID: u64 = 1;

    /// A run of the scenario with that many coordinator and controller roles. The built-in law stands in
    /// for every plug-in.
    pub fn new(scenario: &Arc<Scenario>, coordinators: u32, controllers: u32) -> InProcess {
        InProcess::build(World::new(InProcess::own(scenario), coordinators), coordinators, controllers, false)
    }

    /// A run that goes on with the world as it stands, from what the ledger has of the steps before.
    pub fn going_on(world: World, ledger: &Ledger, coordinators: u32, controllers: u32) -> InProcess {
        let step = world.step();
        let mut run = InProcess::build(world, coordinators, controllers, false);
        for (index, coordinator) in run.coordinators.iter_mut().enumerate() {
            coordinator.take_over(Handover { step, ..ledger.handover(Role::Coordinator, index) });
        }
        for (index, controller) in run.controllers.iter_mut().enumerate() {
            controller.take_over(Handover { step, ..ledger.handover(Role::Controller, index) });
        }
        run
    }

    /// The scenario without plug-ins.
    fn own(scenario: &Arc<Scenario>) -> Arc<Scenario> {
        Arc::new(scenario.without_plugins())
    }

    /// The same, and [`frames`](Self::frames) must be asked for after each step.
    pub fn observed(scenario: &Arc<Scenario>, coordinators: u32, controllers: u32) -> InProcess {
        InProcess::build(World::new(InProcess::own(scenario), coordinators), coordinators, controllers, true)
    }

    /// The same of a world whose vehicles a traffic moves; `observed` as above.
    pub fn played(
        scenario: &Arc<Scenario>,
        coordinators: u32,
        controllers: u32,
        traffic: Box<dyn Traffic>,
        observed: bool,
    ) -> InProcess {
        let world = World::played(InProcess::own(scenario), coordinators, traffic);
        InProcess::build(world, coordinators, controllers, observed)
    }

    fn build(world: World, coordinators: u32, controllers: u32, observed: bool) -> InProcess {
        let scenario = &world.scenario().clone();
        let zones = scenario.network.zones.len() as u32;
        let run_id = InProcess::RUN_ID;
        let state = MemoryService::new();
        let coordination = MemoryService::new();
        let command = MemoryService::new();
        let coordinator_states: Vec<MemoryService<VehicleState>> =
            (0..coordinators).map(|_| MemoryService::new()).collect();
        let summaries: Vec<MemoryService<ZoneSummary>> =
            (0..coordinators).map(|_| MemoryService::new()).collect();
        let controller_inboxes: Vec<_> =
            (0..controllers).map(|_| (state.inbox(), coordination.inbox())).collect();
        let coordinator_inboxes: Vec<_> =
            coordinator_states.iter().zip(&summaries).map(|(c, s)| (c.inbox(), s.inbox())).collect();
        let command_inbox = command.inbox();
        let coordination_inbox = coordination.inbox();
        let observer = observed.then(|| Observer {
            state: state.tap(),
            summaries: summaries.iter().map(MemoryService::tap).collect(),
            coordination: coordination.tap(),
            command: command.tap(),
        });
        let masks = neighbour_coordinators(&scenario.network, coordinators);
        let identity = |role, index| Identity { run_id, role, index: index as u16, generation: 0 };
        let coordinators_side = coordinator_inboxes
            .into_iter()
            .zip(0..)
            .map(|((state, inbox), index)| {
                let neighbours = (0..coordinators)
                    .filter(|n| masks[index as usize] >> n & 1 == 1)
                    .map(|n| (n as u16, zones_of(zones, n, coordinators), summaries[n as usize].outbox()))
                    .collect();
                let ports = CoordinatorPorts {
                    state,
                    summaries: inbox,
                    neighbours,
                    coordination: coordination.outbox(),
                    members: Members::as_claimed(),
                };
                let role = Coordinator::new(scenario.clone(), zones_of(zones, index, coordinators));
                CoordinatorDriver::new(role, ports, identity(Role::Coordinator, index))
            })
            .collect();
        let controllers_side = controller_inboxes
            .into_iter()
            .zip(0..)
            .map(|((state, coordination), index)| {
                let (command, members) = (command.outbox(), Members::as_claimed());
                let ports = ControllerPorts { state, coordination, command, members };
                let role = ControllerPool::new(scenario.clone(), zones_of(zones, index, controllers));
                ControllerDriver::new(role, ports, identity(Role::Controller, index), 0)
            })
            .collect();
        let ports = WorldPorts {
            state: state.outbox(),
            coordinator_states: coordinator_states.iter().map(MemoryService::outbox).collect(),
            command: command_inbox,
            coordination: Some(coordination_inbox),
        };
        InProcess {
            world: WorldDriver::new(world, ports, run_id, controllers),
            coordinators: coordinators_side,
            controllers: controllers_side,
            observer,
        }
    }

    /// The world as it stands.
    pub fn world(&self) -> &World {
        self.world.world()
    }

    /// Makes the world keep completed visits (see [`World::record_visits`]).
    pub fn record_visits(&mut self) {
        self.world.record_visits();
    }

    /// Whether a coordinator acted in the last step.
    pub fn was_event(&self) -> bool {
        self.world.was_event()
    }

    /// Runs one step; `false` once the run is over.
    ///
    /// # Panics
    /// When all roles wait for each other, which the protocol rules out.
    pub fn step(&mut self) -> Result<bool, LockstepError> {
        let step = self.world().step();
        loop {
            let mut progress = false;
            match self.world.advance()? {
                Progress::Finished => return Ok(false),
                Progress::Advanced => progress = true,
                Progress::Waiting(_) | Progress::Behind => {}
            }
            if self.world().step() != step {
                return Ok(true);
            }
            for coordinator in &mut self.coordinators {
                while coordinator.advance()? == Progress::Advanced {
                    progress = true;
                }
            }
            for controller in &mut self.controllers {
                while controller.advance()? == Progress::Advanced {
                    progress = true;
                }
            }
            if !progress {
                let mut all = vec![self.world.advance()?];
                for coordinator in &mut self.coordinators {
                    all.push(coordinator.advance()?);
                }
                for controller in &mut self.controllers {
                    all.push(controller.advance()?);
                }
                panic!(
                    "lockstep: every role waits for another in step {step}: {all:?}; refused: {:?}",
                    self.world.refused()
                );
            }
        }
    }

    /// Shows the frames of the step that [`step`](Self::step) has just run, also of the last one, for which
    /// it returned `false`. Does nothing unless the run is [`observed`](Self::observed).
    pub fn frames(&mut self, show: impl FnOnce(&StepFrames<'_>)) -> Result<(), LockstepError> {
        let Some(observer) = &mut self.observer else { return Ok(()) };
        let Some(state) = observer.state.receive()? else { return Ok(()) };
        let mut summaries = Vec::new();
        for inbox in &mut observer.summaries {
            take_all(inbox, &mut summaries)?;
        }
        let (mut coordination, mut commands) = (Vec::new(), Vec::new());
        take_all(&mut observer.coordination, &mut coordination)?;
        take_all(&mut observer.command, &mut commands)?;
        // By sender, as whoever sends first is a matter of chance elsewhere.
        coordination.sort_by_key(|frame| frame.header().sender_index);
        commands.sort_by_key(|frame| frame.header().sender_index);
        show(&StepFrames {
            header: *state.header(),
            state: state.records(),
            summaries: &summaries.iter().map(Frame::records).collect::<Vec<_>>(),
            coordination: &coordination.iter().map(Frame::records).collect::<Vec<_>>(),
            feedback: &[],
            commands: &commands
                .iter()
                .map(|frame| CommandPart { generation: frame.header().generation, records: frame.records() })
                .collect::<Vec<_>>(),
            misses: 0,
            policy: POLICY_NONE,
            state_hash: self.world.world().state_hash(),
        });
        Ok(())
    }

    /// Runs to the end.
    pub fn run(&mut self) -> Result<(), LockstepError> {
        while self.step()? {}
        Ok(())
    }
}

/// Takes all frames that have come.
fn take_all<R: ipc_schemas::Record>(
    inbox: &mut MemoryInbox<R>,
    frames: &mut Vec<MemoryFrame<R>>,
) -> Result<(), LockstepError> {
    while let Some(frame) = inbox.receive()? {
        frames.push(frame);
    }
    Ok(())
}
