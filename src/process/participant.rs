//! The coordinator and controller processes.

use super::services::{controller_ropes, coordinator_ropes, expected_vehicles, rope_of, ropes_of_others};
use super::wait::Participant;
use super::{Attachment, Held, Joining, Patience, ProcessError, Settling, StopFlag, WaitMode, Waiter};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::lockstep::{
    ControllerDriver, ControllerPorts, CoordinatorDriver, CoordinatorPorts, Handover, Identity,
    LockstepError, Members, Progress, RefusedFrames,
};
use crate::scenario::share::{neighbour_coordinators, zones_of};
use crate::transport::iox::{Bell, IoxInbox, RunName, RunSpace};
use crate::transport::{Inbox, Outbox};
use ipc_schemas::{
    self as frames, Assignment, AttachReply, Member, Role, VehicleCommand, VehicleState, ZoneSummary,
};
use std::time::Duration;

/// How long a coordinator waits for the next event. Events may be far apart in a paced run; a world that
/// dies is noticed at once, and this bounds the wait for one that hangs.
const BETWEEN_EVENTS: Duration = Duration::from_secs(3600);

/// How a coordinator or controller process is to conduct itself.
#[derive(Clone, Copy)]
pub struct Conduct<'a> {
    /// How it joins.
    pub joining: Joining,
    /// How long it waits for a frame.
    pub peer_timeout: Duration,
    /// Cores and scheduling.
    pub settling: &'a Settling<'a>,
    /// Told at the end, also of a failure, whose frames it has refused.
    pub refused: &'a dyn Fn(RefusedFrames),
    /// Set when it is to stop.
    pub stop: &'a StopFlag,
}

/// Runs a coordinator process to the end of the run.
pub fn run_coordinator(run: &RunName, conduct: Conduct<'_>) -> Result<(), ProcessError> {
    let joined = Joined::to(run, Role::Coordinator, conduct)?;
    let AttachReply { index, coordinators, controllers, .. } = joined.attachment.reply;
    let Joined { space, attachment, wait, .. } = &joined;
    let scenario = &attachment.scenario;
    let zones = scenario.network.zones.len() as u32;
    let mask = neighbour_coordinators(&scenario.network, coordinators)[index as usize];
    let own = |prefix: &str| format!("{prefix}{index}");
    let bells = &attachment.bells;
    let neighbours = (0..coordinators)
        .filter(|n| mask >> n & 1 == 1)
        .map(|n| {
            let service = space.open(&format!("{}{n}", frames::SERVICE_SUMMARY_PREFIX))?;
            let owned = zones_of(zones, n, coordinators);
            let expected = owned.len();
            let rope = rope_of(bells, *wait, Role::Coordinator, n);
            Ok((n as u16, owned, service.outbox(expected)?.ringing(rope)))
        })
        .collect::<Result<_, ProcessError>>()?;
    let ports = CoordinatorPorts {
        state: space.open(&own(frames::SERVICE_COORDINATOR_STATE_PREFIX))?.inbox()?,
        summaries: space.open(&own(frames::SERVICE_SUMMARY_PREFIX))?.inbox()?,
        neighbours,
        // Two constraints per vehicle at most while zones only merge.
        coordination: space
            .open(frames::SERVICE_COORDINATION)?
            .outbox(2 * expected_vehicles(scenario))?
            .ringing(controller_ropes(bells, *wait, controllers)),
        members: joined.members()?,
    };
    let role = Coordinator::new(scenario.clone(), zones_of(zones, index, coordinators));
    let driver = CoordinatorDriver::new(role, ports, joined.identity());
    joined.drive(driver, BETWEEN_EVENTS.max(conduct.peer_timeout), CoordinatorDriver::refused)
}

/// Runs a controller process with the built-in law to the end of the run.
pub fn run_controller(run: &RunName, conduct: Conduct<'_>) -> Result<(), ProcessError> {
    let joined = Joined::to(run, Role::Controller, conduct)?;
    let AttachReply { index, controllers, first_step, .. } = joined.attachment.reply;
    let Joined { space, attachment, wait, .. } = &joined;
    let scenario = &attachment.scenario;
    // Plug-ins come behind the processes of the pool.
    let pool = controllers - scenario.plugins.len() as u32;
    let zones = scenario.network.zones.len() as u32;
    let ports =
        ControllerPorts {
            state: space.open(frames::SERVICE_STATE)?.inbox()?,
            coordination: space.open(frames::SERVICE_COORDINATION)?.inbox()?,
            command: space
                .open(frames::SERVICE_COMMAND)?
                .outbox(expected_vehicles(scenario))?
                .ringing(rope_of(&attachment.bells, *wait, Role::World, 0)),
            members: joined.members()?,
        };
    let role = match index.checked_sub(pool) {
        None => ControllerPool::new(scenario.clone(), zones_of(zones, index, pool)),
        Some(plugin) => ControllerPool::in_place_of(scenario.clone(), plugin as usize),
    };
    let driver = ControllerDriver::new(role, ports, joined.identity(), first_step);
    joined.drive(driver, conduct.peer_timeout, ControllerDriver::refused)
}

/// A process that has been let in and settled, and has no ports yet.
struct Joined<'a> {
    space: RunSpace,
    attachment: Attachment,
    role: Role,
    wait: WaitMode,
    bell: Option<Bell>,
    held: Held,
    conduct: Conduct<'a>,
}

impl<'a> Joined<'a> {
    fn to(run: &RunName, role: Role, conduct: Conduct<'a>) -> Result<Joined<'a>, ProcessError> {
        let space = RunSpace::enter(run)?;
        let attachment = Attachment::join(&space, run, conduct.joining, conduct.stop)?;
        let AttachReply { index, coordinators, controllers, waiting, .. } = attachment.reply;
        let wait = WaitMode::from_code(waiting);
        let bell = wait.has_bell(role).then(|| attachment.bells.bell(role, index));
        let held = conduct.settling.settle(role, index, wait, wait.hot_processes(coordinators, controllers));
        Ok(Joined { space, attachment, role, wait, bell, held, conduct })
    }

    fn identity(&self) -> Identity {
        let AttachReply { run_id, index, generation, .. } = self.attachment.reply;
        Identity { run_id, role: self.role, index: index as u16, generation }
    }

    /// Whom to believe, as the world says.
    fn members(&self) -> Result<Members<IoxInbox<Member>>, ProcessError> {
        let inbox = self.space.open(frames::SERVICE_MEMBERS)?.inbox()?;
        Ok(Members::told_by(self.attachment.reply.world_process_id, inbox))
    }

    /// Says that it is ready, goes on from what it is handed over, and drives to the end of the run.
    fn drive<D: Participant, R: IntoIterator<Item = RefusedFrames>>(
        self,
        mut driver: D,
        timeout: Duration,
        refused: impl Fn(&D) -> R,
    ) -> Result<(), ProcessError> {
        let Conduct { joining, peer_timeout, stop, .. } = self.conduct;
        let attachment = &self.attachment;
        if let Some(handover) = attachment.ready(stop)? {
            driver.take_over(handover);
        }
        // Let go before the ports are.
        let _held = self.held;
        // World and controllers are hot beside it.
        let hot_processes = 1 + attachment.reply.controllers as usize;
        let patience = Patience::of(self.wait, self.role, hot_processes, timeout);
        let waiter = Waiter::new(patience, self.bell, stop.clone(), attachment.world());
        let waiter = match self.role {
            Role::Controller => {
                let coordinators = attachment.reply.coordinators;
                let (reply, own) = (&attachment.reply, (self.role, attachment.reply.index));
                let waiter = waiter.apart(own.0, own.1).among(ropes_of_others(
                    &attachment.bells,
                    reply.coordinators,
                    reply.controllers,
                    own,
                ));
                waiter.waking(coordinator_ropes(&attachment.bells, self.wait, coordinators))
            }
            _ => waiter,
        };
        // The others may come as late as the world waits for them; whoever stops waiting first is not to be this one.
        let mut waiter = waiter.begin_within(joining.timeout + peer_timeout);
        let end = waiter.drive(&mut driver, || attachment.catch_up(stop));
        refused(&driver).into_iter().for_each(self.conduct.refused);
        end
    }
}

impl<S, N, O, A, M> Participant for CoordinatorDriver<S, N, O, A, M>
where
    S: Inbox<VehicleState>,
    N: Inbox<ZoneSummary>,
    O: Outbox<ZoneSummary>,
    A: Outbox<Assignment>,
    M: Inbox<Member>,
{
    fn advance(&mut self) -> Result<Progress, LockstepError> {
        self.advance()
    }

    fn take_over(&mut self, handover: Handover) {
        self.take_over(handover);
    }
}

impl<S, A, C, M> Participant for ControllerDriver<S, A, C, M>
where
    S: Inbox<VehicleState>,
    A: Inbox<Assignment>,
    C: Outbox<VehicleCommand>,
    M: Inbox<Member>,
{
    fn advance(&mut self) -> Result<Progress, LockstepError> {
        self.advance()
    }

    fn take_over(&mut self, handover: Handover) {
        self.take_over(handover);
    }
}
