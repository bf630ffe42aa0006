//! The services of a run, as its world creates them, and whose bells are rung with them.

use super::WaitMode;
use crate::lockstep::{Feedbacks, Identity, WorldDriver, WorldPorts};
use crate::scenario::Scenario;
use crate::scenario::share::neighbour_coordinators;
use crate::transport::iox::{
    BellRope, Bells, IoxInbox, IoxOutbox, RunSpace, Service, ServiceLimits, SpaceError,
};
use crate::transport::{Backlog, Loan, Outbox, Slots, TransportError};
use ipc_schemas::{
    self as frames, Assignment, Feedback, FrameHeader, Member, Role, VehicleCommand, VehicleState,
    ZoneSummary,
};
use std::ops::Range;

/// The world's ends of the services.
pub(super) type Ports = WorldPorts<
    IoxOutbox<VehicleState>,
    IoxOutbox<VehicleState>,
    IoxInbox<VehicleCommand>,
    IoxInbox<Assignment>,
>;
/// The world in a run of several processes.
pub(super) type Driver = WorldDriver<
    IoxOutbox<VehicleState>,
    IoxOutbox<VehicleState>,
    IoxInbox<VehicleCommand>,
    IoxInbox<Assignment>,
>;

/// Room for sending ends that belong to nobody in the run: what they send is counted and refused.
const STRANGERS: usize = 2;

/// Summaries of one sender that may wait: of the step before and of this one, of the next from a neighbour that is
/// quicker, and one more that is sent again by whoever takes its place.
const SUMMARIES: Backlog = Backlog::Bounded(4);

/// All frame services of a run, created by its world and kept open by it.
#[derive(Debug)]
pub(super) struct Services {
    state: Service<VehicleState>,
    coordinator_states: Vec<Service<VehicleState>>,
    command: Service<VehicleCommand>,
    coordination: Service<Assignment>,
    /// Whether the world listens to coordination too.
    keeps: bool,
    members: Service<Member>,
    /// Of the controllers written elsewhere, which come last.
    feedback: Vec<Service<Feedback>>,
    _summaries: Vec<Service<ZoneSummary>>,
    controllers: u32,
}

/// The world's word on who has which place.
#[derive(Debug)]
pub(super) struct MembersOutbox {
    outbox: IoxOutbox<Member>,
    run_id: u64,
}

impl MembersOutbox {
    /// Opens it.
    pub(super) fn open(service: &Service<Member>, run_id: u64) -> Result<MembersOutbox, SpaceError> {
        Ok(MembersOutbox { outbox: service.outbox(8)?, run_id })
    }

    /// How many may listen to it, and what they get: only the last word counts.
    pub(super) fn limits(subscribers: usize, nodes: usize) -> ServiceLimits {
        ServiceLimits { publishers: 1, subscribers, nodes, backlog: Backlog::Last }
    }

    /// Tells everybody, before a step.
    pub(super) fn tell(
        &mut self,
        step: u64,
        members: impl Iterator<Item = Member>,
    ) -> Result<(), TransportError> {
        let world = Identity { run_id: self.run_id, role: Role::World, index: 0, generation: 0 };
        let members: Vec<Member> = members.collect();
        let fill = |slots: &mut Slots<'_, Member>| members.iter().for_each(|m| slots.push(*m));
        self.outbox.loan(world.header(step, 0), members.len(), fill)?.send()?;
        Ok(())
    }
}

/// What controllers written elsewhere are told of their answers: one service each.
#[derive(Debug)]
pub(super) struct FeedbackOutboxes {
    /// Index of the first of them: behind the pool.
    first: u32,
    outboxes: Vec<IoxOutbox<Feedback>>,
}

/// Feedback of one controller that may wait: of a refusal and of the step after it, twice.
const FEEDBACK: Backlog = Backlog::Bounded(4);

/// The service of one controller's feedback.
pub(super) fn create_feedback(space: &RunSpace, index: u32) -> Result<Service<Feedback>, SpaceError> {
    let name = format!("{}{index}", frames::SERVICE_FEEDBACK_PREFIX);
    // One that is started again may come before its predecessor's place has been cleared.
    let limits = ServiceLimits { publishers: 1, subscribers: 3, nodes: 2 + STRANGERS, backlog: FEEDBACK };
    space.create(&name, limits)
}

impl Feedbacks for FeedbackOutboxes {
    fn tell(
        &mut self,
        controller: u16,
        header: FrameHeader,
        records: &[Feedback],
    ) -> Result<(), TransportError> {
        let at = u32::from(controller).checked_sub(self.first);
        if let Some(outbox) = at.and_then(|at| self.outboxes.get_mut(at as usize)) {
            outbox
                .loan(header, records.len(), |slots| records.iter().for_each(|r| slots.push(*r)))?
                .send()?;
        }
        Ok(())
    }
}

impl Services {
    pub(super) fn create(
        space: &RunSpace,
        scenario: &Scenario,
        (coordinators, controllers): (u32, u32),
        keeps: bool,
    ) -> Result<Services, SpaceError> {
        let (m, n) = (coordinators as usize, controllers as usize);
        // Strangers may try; they shall not keep anybody out who belongs here.
        let nodes = 1 + m + n + STRANGERS;
        let limits = |publishers, subscribers| {
            let backlog = Backlog::STEPS;
            ServiceLimits { publishers, subscribers, nodes, backlog }
        };
        let masks = neighbour_coordinators(&scenario.network, coordinators);
        Ok(Services {
            controllers,
            state: space.create(frames::SERVICE_STATE, limits(1, n))?,
            coordinator_states: (0..m)
                .map(|i| {
                    let name = format!("{}{i}", frames::SERVICE_COORDINATOR_STATE_PREFIX);
                    space.create(&name, limits(1, 1))
                })
                .collect::<Result<_, _>>()?,
            command: space.create(frames::SERVICE_COMMAND, limits(n + STRANGERS, 1))?,
            coordination: space
                .create(frames::SERVICE_COORDINATION, limits(m + STRANGERS, n + usize::from(keeps)))?,
            keeps,
            members: space.create(frames::SERVICE_MEMBERS, MembersOutbox::limits(m + n, nodes))?,
            feedback: (controllers - scenario.plugins.len() as u32..controllers)
                .map(|index| create_feedback(space, index))
                .collect::<Result<_, _>>()?,
            _summaries: (0..m)
                .map(|i| {
                    let name = format!("{}{i}", frames::SERVICE_SUMMARY_PREFIX);
                    let neighbours = masks[i].count_ones() as usize;
                    let limits = limits(neighbours + STRANGERS, 1);
                    space.create(&name, ServiceLimits { backlog: SUMMARIES, ..limits })
                })
                .collect::<Result<_, _>>()?,
        })
    }

    /// The world's ends. Opened before anybody can join, they are there to be connected to, and nobody else
    /// takes the one place for a sender of states.
    pub(super) fn world_ports(
        &self,
        bells: &Bells,
        scenario: &Scenario,
        wait: WaitMode,
    ) -> Result<Ports, SpaceError> {
        let expected = expected_vehicles(scenario);
        Ok(WorldPorts {
            state: self.state.outbox(expected)?.ringing(controller_ropes(bells, wait, self.controllers)),
            coordinator_states: self
                .coordinator_states
                .iter()
                .zip(0..)
                .map(|(s, i)| {
                    let outbox = s.outbox(expected)?.ringing(rope_of(bells, wait, Role::Coordinator, i));
                    let deputies = controllers_that_wake(scenario, wait, self.controllers);
                    Ok(outbox.leaving_it_to(deputies.map(|i| bells.rope(Role::Controller, i))))
                })
                .collect::<Result<_, SpaceError>>()?,
            command: self.command.inbox()?,
            coordination: if self.keeps { Some(self.coordination.inbox()?) } else { None },
        })
    }

    /// What controllers written elsewhere are told; nothing where there are none.
    pub(super) fn feedbacks(&self) -> Result<Option<FeedbackOutboxes>, SpaceError> {
        let outboxes: Vec<_> = self.feedback.iter().map(|s| s.outbox(16)).collect::<Result<_, _>>()?;
        let first = self.controllers - outboxes.len() as u32;
        Ok((!outboxes.is_empty()).then_some(FeedbackOutboxes { first, outboxes }))
    }

    /// The world's word on who has which place.
    pub(super) fn members_outbox(&self, run_id: u64) -> Result<MembersOutbox, SpaceError> {
        MembersOutbox::open(&self.members, run_id)
    }
}

/// The ropes of all controllers' bells, when they sleep under this mode.
pub(super) fn controller_ropes(bells: &Bells, wait: WaitMode, controllers: u32) -> Vec<BellRope> {
    let count = if wait.has_bell(Role::Controller) { controllers } else { 0 };
    (0..count).map(|i| bells.rope(Role::Controller, i)).collect()
}

/// The controllers that wake the coordinators they wait for, when awake: on the core that such a controller is about to
/// give away a waking costs a fraction of what it costs across cores. All of them, or with plug-ins, which ring no
/// bells, none; none where everybody sleeps, for then it is better woken before them.
fn controllers_that_wake(scenario: &Scenario, wait: WaitMode, controllers: u32) -> Range<u32> {
    let do_they = matches!(wait, WaitMode::Adaptive | WaitMode::Hybrid) && scenario.plugins.is_empty();
    0..if do_they { controllers } else { 0 }
}

/// The ropes of all coordinators' bells, when they sleep under this mode.
pub(super) fn coordinator_ropes(bells: &Bells, wait: WaitMode, coordinators: u32) -> Vec<BellRope> {
    let count = if wait.has_bell(Role::Coordinator) { coordinators } else { 0 };
    (0..count).map(|i| bells.rope(Role::Coordinator, i)).collect()
}

/// The ropes of all bells of a run but this process's own.
pub(super) fn ropes_of_others(
    bells: &Bells,
    coordinators: u32,
    controllers: u32,
    own: (Role, u32),
) -> Vec<BellRope> {
    let counts = [(Role::World, 1), (Role::Coordinator, coordinators), (Role::Controller, controllers)];
    let all = counts.into_iter().flat_map(|(role, count)| (0..count).map(move |index| (role, index)));
    all.filter(|other| *other != own).map(|(role, index)| bells.rope(role, index)).collect()
}

/// The rope of one process's bell, when those of its role sleep under this mode.
pub(super) fn rope_of(bells: &Bells, wait: WaitMode, role: Role, index: u32) -> Option<BellRope> {
    wait.has_bell(role).then(|| bells.rope(role, index))
}

/// About as many vehicles as the network holds in dense but moving traffic. Frames may be longer; this
/// only decides how much memory is laid out at first.
pub fn expected_vehicles(scenario: &Scenario) -> usize {
    const DENSE_SPACING_M: f64 = 12.0;
    let lengths = scenario.network.zones.iter().flat_map(|z| z.paths.iter().map(|path| path.length_m));
    lengths.map(|l| (l / DENSE_SPACING_M).ceil() as usize + 2).sum()
}
