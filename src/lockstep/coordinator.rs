//! A coordinator process's side of a step: take the state, wait for neighbours' summaries of the step
//! before, tell neighbours and controllers.

use super::members::check_sender;
use super::refusals::Refusals;
use super::{Awaited, Handover, Identity, InHand, LockstepError, Members, Progress, Refusal, RefusedFrames};
use crate::coordination::Coordinator;
use crate::scenario::ControllerNames;
use crate::scenario::ZoneId;
use crate::transport::{Frame, Inbox, Loan, Outbox};
use ipc_schemas::{Assignment, ExpectedHeader, FLAG_END_OF_RUN, Member, Role, VehicleState, ZoneSummary};
use std::ops::Range;

/// A coordinator's ends of the services.
#[derive(Debug)]
pub struct CoordinatorPorts<S, N, O, A, M> {
    /// State frames from the world, only of the steps to act in.
    pub state: S,
    /// Summaries from neighbouring coordinator processes.
    pub summaries: N,
    /// Summaries to each neighbouring process: its index, its zones, the way to it.
    pub neighbours: Vec<(u16, Range<ZoneId>, O)>,
    /// Coordination to controllers.
    pub coordination: A,
    /// Whom to believe.
    pub members: Members<M>,
}

/// Drives a [`Coordinator`] through the lockstep.
#[derive(Debug)]
pub struct CoordinatorDriver<S, N, O, A, M>
where
    S: Inbox<VehicleState>,
    N: Inbox<ZoneSummary>,
{
    coordinator: Coordinator,
    ports: CoordinatorPorts<S, N, O, A, M>,
    identity: Identity,
    neighbour_mask: u64,
    last_step: Option<u64>,
    /// The first step after a handover; what neighbours sent in the step before came with it.
    handed_over: Option<u64>,
    pending: Option<(InHand<S::Frame>, u64)>,
    /// Summaries of the pending step from neighbours who were quicker, for the next one: process, records.
    early: Vec<(u16, Vec<ZoneSummary>)>,
    /// The step before a handover and what was sent to neighbours in it, to be sent again: what they had not
    /// taken may have gone with its sender.
    owed: Option<(u64, Vec<ZoneSummary>)>,
    refusals: Refusals,
    /// Refused frames, held for a while so that their senders are passed over in favour of others.
    detained: Vec<N::Frame>,
    finished: bool,
}

impl<S, N, O, A, M> CoordinatorDriver<S, N, O, A, M>
where
    S: Inbox<VehicleState>,
    N: Inbox<ZoneSummary>,
    O: Outbox<ZoneSummary>,
    A: Outbox<Assignment>,
    M: Inbox<Member>,
{
    /// A driver for a coordinator that has not acted yet.
    pub fn new(
        coordinator: Coordinator,
        ports: CoordinatorPorts<S, N, O, A, M>,
        identity: Identity,
    ) -> CoordinatorDriver<S, N, O, A, M> {
        let neighbour_mask = ports.neighbours.iter().fold(0, |mask, (index, ..)| mask | 1 << index);
        CoordinatorDriver {
            coordinator,
            ports,
            identity,
            neighbour_mask,
            last_step: None,
            handed_over: None,
            pending: None,
            early: Vec::new(),
            owed: None,
            refusals: Refusals::default(),
            detained: Vec::new(),
            finished: false,
        }
    }

    /// Goes on from what another has left.
    pub fn take_over(&mut self, handover: Handover) {
        self.coordinator.restore(&handover.heard, &handover.due, &handover.in_force);
        self.handed_over = Some(handover.step);
        let zones = self.coordinator.zones();
        let owes = handover.summarised >> self.identity.index & 1 == 1;
        self.owed = handover.step.checked_sub(1).filter(|_| owes).map(|step| {
            (step, handover.due.iter().filter(|s| zones.contains(&s.from_zone)).copied().collect())
        });
        // Summaries of this step may have been sent before anybody was there to take them.
        self.early = self
            .ports
            .neighbours
            .iter()
            .filter(|(index, ..)| handover.events >> index & 1 == 1)
            .map(|(index, zones, _)| {
                let of_neighbour = handover.fresh.iter().filter(|s| zones.contains(&s.from_zone));
                (*index, of_neighbour.copied().collect())
            })
            .collect();
        self.pending = handover.header.map(|header| (InHand::Handed(header, handover.states), 0));
        self.last_step = match self.pending {
            Some(_) => Some(handover.step),
            None => handover.step.checked_sub(1),
        };
    }

    /// What was refused, by sender.
    pub fn refused(&self) -> Vec<RefusedFrames> {
        self.refusals.report(&self.identity, &ControllerNames::default())
    }

    /// Does what can be done now.
    pub fn advance(&mut self) -> Result<Progress, LockstepError> {
        if self.finished {
            return Ok(Progress::Finished);
        }
        if let Some((step, summaries)) = self.owed.take() {
            self.send_again(step, &summaries)?;
        }
        match self.pending.take() {
            None => self.take_state(),
            Some((state, missing)) => self.take_summaries(state, missing),
        }
    }

    fn take_state(&mut self) -> Result<Progress, LockstepError> {
        let Some(state) = self.receive_state()? else {
            let step = self.last_step.map_or(0, |s| s + 1);
            let what = "state of an event";
            return Ok(Progress::Waiting(Awaited { role: Role::World, missing: 1, what, step }));
        };
        let header = state.header();
        if header.flags & FLAG_END_OF_RUN != 0 {
            self.finished = true;
            return Ok(Progress::Finished);
        }
        if self.last_step.is_some_and(|last| header.step <= last) {
            // It was handed over.
            return Ok(Progress::Advanced);
        }
        self.last_step = Some(header.step);
        if header.coordinators_acting >> self.identity.index & 1 == 1 {
            let mut missing = match self.handed_over {
                Some(step) if step == header.step => 0,
                _ => header.coordinators_summarised & self.neighbour_mask,
            };
            for (index, summaries) in self.early.drain(..) {
                // A neighbour's event makes this process act in the next step, so this is that step.
                self.coordinator.receive(&summaries);
                missing &= !(1 << index);
            }
            self.pending = Some((InHand::Frame(state), missing));
        }
        Ok(Progress::Advanced)
    }

    /// The next state of the world's; a frame of anybody else is as good as none.
    fn receive_state(&mut self) -> Result<Option<S::Frame>, LockstepError> {
        let CoordinatorPorts { state, members, .. } = &mut self.ports;
        let Some(frame) = state.receive()? else { return Ok(None) };
        let is_taken = members.check_state(self.identity.run_id, &frame, state, &mut self.refusals)?;
        Ok(is_taken.then_some(frame))
    }

    /// Takes one summary, or acts when none is missing and none is left. What came twice is taken too: left
    /// alone, it would soon fill the inbox, and the next summary find no room.
    fn take_summaries(
        &mut self,
        state: InHand<S::Frame>,
        mut missing: u64,
    ) -> Result<Progress, LockstepError> {
        // Summaries are of the step before: that is what makes the result independent of timing. All of them
        // were sent before the state was, but a quicker neighbour's next one may come in between: there is
        // no order between senders.
        let now = state.header().step;
        let (what, step) = ("summary", now.wrapping_sub(1));
        let awaited = Awaited { role: Role::Coordinator, missing, what, step };
        let Some(frame) = self.ports.summaries.receive()? else {
            self.detained.clear();
            if missing == 0 {
                return self.act(&state);
            }
            self.pending = Some((state, missing));
            return Ok(Progress::Waiting(awaited));
        };
        let judged = self.judge(&frame, now, missing)?;
        let mut progress = Progress::Advanced;
        match judged {
            Ok((index, true)) => self.early.push((index, frame.records().to_vec())),
            Ok((index, false)) => {
                self.coordinator.receive(frame.records());
                missing &= !(1 << index);
            }
            Err(None) => self.refusals.late += 1,
            Err(Some(refusal)) => {
                let inbox = &self.ports.summaries;
                let origin = frame.origin();
                self.refusals.enter(frame.header(), origin, refusal, || inbox.process_of(origin));
                self.detained.push(frame);
                // However many of these come, waiting for the right one goes on.
                if missing != 0 {
                    progress = Progress::Waiting(awaited);
                }
            }
        }
        self.pending = Some((state, missing));
        Ok(progress)
    }

    /// Whose summaries these are and whether they are for the next step; otherwise why they are not taken,
    /// or nothing for those that come twice: from a neighbour that has been replaced.
    fn judge(
        &mut self,
        frame: &N::Frame,
        now: u64,
        missing: u64,
    ) -> Result<Result<(u16, bool), Option<Refusal>>, LockstepError> {
        let header = &{ *frame.header() };
        let sent = (header, frame.records().len(), frame.origin());
        let (run_id, index) = (self.identity.run_id, header.sender_index);
        let is_early = header.step == now;
        // Before the first step nothing is due.
        let step = if is_early { now } else { now.wrapping_sub(1) };
        let missing = match is_early {
            true => self.early.iter().fold(self.neighbour_mask, |mask, (index, _)| mask & !(1 << index)),
            false => missing,
        };
        let is_neighbour = index < 64 && self.neighbour_mask >> index & 1 == 1;
        let CoordinatorPorts { summaries, members, .. } = &mut self.ports;
        let seat = members.coordinator(run_id, header, frame.origin(), &mut self.refusals)?;
        let generation = seat.as_ref().map_or(header.generation, |seat| seat.generation);
        let expected = ExpectedHeader { run_id, role: Role::Coordinator, index, generation, step };
        let checked = check_sender(&expected, sent, seat.filter(|_| is_neighbour), missing, summaries);
        Ok(checked.map(|()| (index, is_early)))
    }

    /// Sends neighbours what one before has sent them in that step.
    fn send_again(&mut self, step: u64, summaries: &[ZoneSummary]) -> Result<(), LockstepError> {
        let header = self.identity.header(step, self.coordinator.time_ns(step));
        for (_, zones, outbox) in &mut self.ports.neighbours {
            let to_it = || summaries.iter().filter(|s| zones.contains(&s.to_zone));
            let loan = outbox.loan(header, to_it().count(), |slots| to_it().for_each(|s| slots.push(*s)))?;
            loan.send()?;
        }
        Ok(())
    }

    fn act(&mut self, state: &InHand<S::Frame>) -> Result<Progress, LockstepError> {
        let (step, time_ns) = (state.header().step, state.header().time_ns);
        let header = self.identity.header(step, time_ns);
        let had_event = self.coordinator.act(step, state.records());
        if had_event {
            for (_, zones, outbox) in &mut self.ports.neighbours {
                let summaries = || self.coordinator.summaries(zones.clone());
                let loan = outbox.loan(header, summaries().count(), |slots| {
                    summaries().for_each(|s| slots.push(s));
                })?;
                loan.send()?;
            }
        }
        let assignments = self.coordinator.assignments();
        let loan = self
            .ports
            .coordination
            .loan(header, assignments.len(), |slots| assignments.iter().for_each(|a| slots.push(*a)))?;
        loan.send()?;
        Ok(Progress::Advanced)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::load_embedded;
    use crate::transport::Backlog;
    use crate::transport::memory::{MemoryInbox, MemoryOutbox, MemoryService};
    use ipc_schemas::FrameHeader;
    use std::sync::Arc;

    /// A coordinator of the tree with neighbours 2 and 4, in a run of one process per zone.
    const OWN: u16 = 3;

    fn header(role: Role, index: u16, step: u64) -> FrameHeader {
        Identity { run_id: 7, role, index, generation: 0 }.header(step, 0)
    }

    fn send<R: ipc_schemas::Record>(outbox: &mut impl Outbox<R>, header: FrameHeader, records: &[R]) {
        let fill = |slots: &mut crate::transport::Slots<'_, R>| records.iter().for_each(|r| slots.push(*r));
        outbox.loan(header, records.len(), fill).unwrap().send().unwrap();
    }

    type TestDriver = CoordinatorDriver<
        MemoryInbox<VehicleState>,
        MemoryInbox<ZoneSummary>,
        MemoryOutbox<ZoneSummary>,
        MemoryOutbox<Assignment>,
        MemoryInbox<Member>,
    >;

    /// A coordinator with these neighbours, and the services by which the others reach it and hear of it.
    struct Scene {
        driver: TestDriver,
        states: MemoryService<VehicleState>,
        summaries: MemoryService<ZoneSummary>,
        coordination: MemoryInbox<Assignment>,
    }

    impl Scene {
        fn new(neighbours: &[u16], generation: u32) -> Scene {
            let scenario = Arc::new(load_embedded("tree", &[], None).unwrap());
            let states = MemoryService::new();
            let summaries = MemoryService::holding(Backlog::Bounded(4));
            let coordination = MemoryService::new();
            let inbox = coordination.inbox();
            let neighbour = |&i: &u16| (i, u32::from(i)..u32::from(i) + 1, MemoryService::new().outbox());
            let ports = CoordinatorPorts {
                state: states.inbox(),
                summaries: summaries.inbox(),
                neighbours: neighbours.iter().map(neighbour).collect(),
                coordination: coordination.outbox(),
                members: Members::as_claimed(),
            };
            let role = Coordinator::new(scenario, u32::from(OWN)..u32::from(OWN) + 1);
            let identity = Identity { run_id: 7, role: Role::Coordinator, index: OWN, generation };
            let driver = CoordinatorDriver::new(role, ports, identity);
            Scene { driver, states, summaries, coordination: inbox }
        }

        /// Whether the coordinator now acts in the step.
        fn acts(&mut self, step: u64) -> bool {
            while self.driver.advance().unwrap() == Progress::Advanced {}
            self.coordination.receive().unwrap().map(|f| f.header().step) == Some(step)
        }
    }

    fn state(step: u64, summarised: u64) -> FrameHeader {
        FrameHeader {
            coordinators_acting: 1 << OWN,
            coordinators_summarised: summarised,
            ..header(Role::World, 0, step)
        }
    }

    #[test]
    fn summaries_that_came_by_both_ways_leave_room_for_the_next() {
        let mut scene = Scene::new(&[2], 1);
        let (mut world, mut second) = (scene.states.outbox(), scene.summaries.outbox());
        // The neighbour has an event in every step; the handover in step 5 brings what it said in 4 and 5.
        send(&mut second, header(Role::Coordinator, 2, 4), &[]);
        send(&mut second, header(Role::Coordinator, 2, 5), &[]);
        let header_5 = Some(state(5, 1 << 2));
        let handover = Handover { step: 5, header: header_5, events: 1 << 2, ..Handover::default() };
        scene.driver.take_over(handover);
        assert!(scene.acts(5));
        for step in 6..9 {
            send(&mut second, header(Role::Coordinator, 2, step), &[]);
            send(&mut world, state(step, 1 << 2), &[]);
            assert!(scene.acts(step), "step {step}");
        }
    }

    #[test]
    fn a_quick_neighbours_next_summary_waits_for_its_step() {
        let mut scene = Scene::new(&[2, 4], 0);
        let (mut world, mut second) = (scene.states.outbox(), scene.summaries.outbox());
        let mut fourth = scene.summaries.outbox();

        send(&mut second, header(Role::Coordinator, 2, 0), &[]);
        send(&mut world, state(1, 1 << 2 | 1 << 4), &[]);
        // The second one has taken state 1 too, acted, and sent the next summary.
        send(&mut second, header(Role::Coordinator, 2, 1), &[]);
        assert!(!scene.acts(1), "the fourth one's summary is missing");
        send(&mut fourth, header(Role::Coordinator, 4, 0), &[]);
        assert!(scene.acts(1));
        send(&mut world, state(2, 1 << 2), &[]);
        assert!(scene.acts(2), "the early summary counts now");
        send(&mut world, state(3, 1 << 4), &[]);
        assert!(!scene.acts(3));
        // Two steps early is nobody's right.
        send(&mut fourth, header(Role::Coordinator, 4, 4), &[]);
        assert!(!scene.acts(3), "it waits for the right one");
        assert_eq!(scene.driver.refused().len(), 1);
        let told = scene.driver.refused()[0].to_string();
        let expected = "coordinator 3 refused 1 frames of coordinator 4; the last: ";
        assert!(told.starts_with(expected) && told.contains("step"), "{told}");
    }
}
