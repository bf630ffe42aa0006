//! The coordinator and controller processes.

use super::services::{controller_ropes, expected_vehicles, rope_of};
use super::wait::Participant;
use super::{Attachment, Joining, Patience, ProcessError, Settling, StopFlag, WaitMode, Waiter};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::lockstep::{
    ControllerDriver, ControllerPorts, CoordinatorDriver, CoordinatorPorts, Handover, Identity,
    LockstepError, Members, Progress, RefusedFrames,
};
use crate::scenario::share::{neighbour_coordinators, zones_of};
use crate::transport::iox::{IoxInbox, RunName, RunSpace};
use crate::transport::{Inbox, Outbox};
use ipc_schemas::{
    self as frames, Assignment, AttachReply, Member, Role, VehicleCommand, VehicleState, ZoneSummary,
};
use std::time::Duration;

/// How long a coordinator waits for the next event. Events may be far apart in a paced run; a world that
/// dies is noticed at once, and this bounds the wait for one that hangs.
const BETWEEN_EVENTS: Duration = Duration::from_secs(3600);

/// Runs a coordinator process to the end of the run; then `refused` is told whose frames it has refused, also
/// when it fails.
pub fn run_coordinator(
    run: &RunName,
    joining: Joining,
    peer_timeout: Duration,
    settling: &Settling<'_>,
    refused: &dyn Fn(RefusedFrames),
    stop: &StopFlag,
) -> Result<(), ProcessError> {
    // The others may come as late as the world waits for them; whoever stops waiting first is not to be this one.
    let until_begun = joining.timeout + peer_timeout;
    let space = RunSpace::enter(run)?;
    let attachment = Attachment::join(&space, run, joining, stop)?;
    let AttachReply { index, coordinators, controllers, .. } = attachment.reply;
    let scenario = &attachment.scenario;
    let zones = scenario.network.zones.len() as u32;
    let mask = neighbour_coordinators(&scenario.network, coordinators)[index as usize];
    let own = |prefix: &str| format!("{prefix}{index}");
    let wait = WaitMode::from_code(attachment.reply.waiting);
    let bells = &attachment.bells;
    let bell = wait.has_bell(Role::Coordinator).then(|| bells.bell(Role::Coordinator, index));
    let held = settling.settle(Role::Coordinator, index, wait, wait.hot_processes(coordinators, controllers));
    let neighbours = (0..coordinators)
        .filter(|n| mask >> n & 1 == 1)
        .map(|n| {
            let service = space.open(&format!("{}{n}", frames::SERVICE_SUMMARY_PREFIX))?;
            let owned = zones_of(zones, n, coordinators);
            let expected = owned.len();
            let rope = rope_of(bells, wait, Role::Coordinator, n);
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
            .ringing(controller_ropes(bells, wait, controllers)),
        members: members(&space, &attachment.reply)?,
    };
    let role = Coordinator::new(scenario.clone(), zones_of(zones, index, coordinators));
    let identity = identity(&attachment.reply, Role::Coordinator);
    let mut driver = CoordinatorDriver::new(role, ports, identity);
    if let Some(handover) = attachment.ready(stop)? {
        driver.take_over(handover);
    }
    let hot_processes = 1 + controllers as usize;
    // Declared last, so let go first.
    let _held = held;
    let patience = Patience::of(wait, Role::Coordinator, hot_processes, BETWEEN_EVENTS.max(peer_timeout));
    let mut waiter = Waiter::new(patience, bell, stop.clone(), attachment.world()).begin_within(until_begun);
    let end = waiter.drive(&mut driver, || attachment.catch_up(stop));
    driver.refused().into_iter().for_each(refused);
    end
}

/// Runs a controller process with the built-in law to the end of the run; then `refused` is told whose frames it
/// has refused, also when it fails.
pub fn run_controller(
    run: &RunName,
    joining: Joining,
    peer_timeout: Duration,
    settling: &Settling<'_>,
    refused: &dyn Fn(RefusedFrames),
    stop: &StopFlag,
) -> Result<(), ProcessError> {
    // The others may come as late as the world waits for them; whoever stops waiting first is not to be this one.
    let until_begun = joining.timeout + peer_timeout;
    let space = RunSpace::enter(run)?;
    let attachment = Attachment::join(&space, run, joining, stop)?;
    let AttachReply { index, coordinators, controllers, first_step, .. } = attachment.reply;
    let wait = WaitMode::from_code(attachment.reply.waiting);
    let bells = &attachment.bells;
    let bell = wait.has_bell(Role::Controller).then(|| bells.bell(Role::Controller, index));
    let held = settling.settle(Role::Controller, index, wait, wait.hot_processes(coordinators, controllers));
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
                .ringing(rope_of(bells, wait, Role::World, 0)),
            members: members(&space, &attachment.reply)?,
        };
    let role = ControllerPool::new(scenario.clone(), zones_of(zones, index, pool));
    let identity = identity(&attachment.reply, Role::Controller);
    let mut driver = ControllerDriver::new(role, ports, identity, first_step);
    if let Some(handover) = attachment.ready(stop)? {
        driver.take_over(handover);
    }
    // Declared last, so let go first.
    let _held = held;
    let patience = Patience::of(wait, Role::Controller, 1 + controllers as usize, peer_timeout);
    let mut waiter = Waiter::new(patience, bell, stop.clone(), attachment.world()).begin_within(until_begun);
    let end = waiter.drive(&mut driver, || attachment.catch_up(stop));
    driver.refused().into_iter().for_each(refused);
    end
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

fn identity(reply: &AttachReply, role: Role) -> Identity {
    Identity { run_id: reply.run_id, role, index: reply.index as u16, generation: reply.generation }
}

/// Whom to believe, as the world says.
fn members(space: &RunSpace, reply: &AttachReply) -> Result<Members<IoxInbox<Member>>, ProcessError> {
    let inbox = space.open(frames::SERVICE_MEMBERS)?.inbox()?;
    Ok(Members::told_by(reply.world_process_id, inbox))
}
