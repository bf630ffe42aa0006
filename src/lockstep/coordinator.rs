//! A coordinator process's side of a step: take the state, wait for neighbours' summaries of the step
//! before, tell neighbours and controllers.

use super::world::check_state;
use super::{Awaited, Identity, LockstepError, Progress, sender};
use crate::coordination::Coordinator;
use crate::scenario::ZoneId;
use crate::transport::{Frame, Inbox, Loan, Outbox};
use ipc_schemas::{Assignment, ExpectedHeader, FLAG_END_OF_RUN, Role, VehicleState, ZoneSummary};
use std::ops::Range;

/// A coordinator's ends of the services.
#[derive(Debug)]
pub struct CoordinatorPorts<S, N, O, A> {
    /// State frames from the world, only of the steps to act in.
    pub state: S,
    /// Summaries from neighbouring coordinator processes.
    pub summaries: N,
    /// Summaries to each neighbouring process: its index, its zones, the way to it.
    pub neighbours: Vec<(u16, Range<ZoneId>, O)>,
    /// Coordination to controllers.
    pub coordination: A,
}

/// Drives a [`Coordinator`] through the lockstep.
#[derive(Debug)]
pub struct CoordinatorDriver<S, N, O, A>
where
    S: Inbox<VehicleState>,
{
    coordinator: Coordinator,
    ports: CoordinatorPorts<S, N, O, A>,
    identity: Identity,
    controllers: u32,
    neighbour_mask: u64,
    last_step: Option<u64>,
    pending: Option<(S::Frame, u64)>,
    finished: bool,
}

impl<S, N, O, A> CoordinatorDriver<S, N, O, A>
where
    S: Inbox<VehicleState>,
    N: Inbox<ZoneSummary>,
    O: Outbox<ZoneSummary>,
    A: Outbox<Assignment>,
{
    /// A driver for a coordinator that has not acted yet, in a run with that many controllers.
    pub fn new(
        coordinator: Coordinator,
        ports: CoordinatorPorts<S, N, O, A>,
        identity: Identity,
        controllers: u32,
    ) -> CoordinatorDriver<S, N, O, A> {
        let neighbour_mask = ports.neighbours.iter().fold(0, |mask, (index, ..)| mask | 1 << index);
        CoordinatorDriver {
            coordinator,
            ports,
            identity,
            controllers,
            neighbour_mask,
            last_step: None,
            pending: None,
            finished: false,
        }
    }

    /// Does what can be done now.
    pub fn advance(&mut self) -> Result<Progress, LockstepError> {
        if self.finished {
            return Ok(Progress::Finished);
        }
        match self.pending.take() {
            None => self.take_state(),
            Some((state, 0)) => self.act(&state),
            Some((state, missing)) => self.take_summaries(state, missing),
        }
    }

    fn take_state(&mut self) -> Result<Progress, LockstepError> {
        let Some(state) = self.ports.state.receive()? else {
            let step = self.last_step.map_or(0, |s| s + 1);
            let what = "state of an event";
            return Ok(Progress::Waiting(Awaited { role: Role::World, missing: 1, what, step }));
        };
        let header = state.header();
        check_state(self.identity.run_id, None, header, state.records().len())?;
        if self.last_step.is_some_and(|last| header.step <= last) {
            return Err(LockstepError::Unexpected { sender: sender(header), step: header.step });
        }
        self.last_step = Some(header.step);
        if header.flags & FLAG_END_OF_RUN != 0 {
            self.finished = true;
            return Ok(Progress::Finished);
        }
        if header.coordinators_acting >> self.identity.index & 1 == 1 {
            let missing = header.coordinators_summarised & self.neighbour_mask;
            self.pending = Some((state, missing));
        }
        Ok(Progress::Advanced)
    }

    fn take_summaries(&mut self, state: S::Frame, mut missing: u64) -> Result<Progress, LockstepError> {
        // Summaries are of the step before: that is what makes the result independent of timing.
        let step = state.header().step - 1;
        let Some(frame) = self.ports.summaries.receive()? else {
            self.pending = Some((state, missing));
            let what = "summary";
            return Ok(Progress::Waiting(Awaited { role: Role::Coordinator, missing, what, step }));
        };
        let header = frame.header();
        let index = header.sender_index;
        ExpectedHeader {
            run_id: self.identity.run_id,
            role: Role::Coordinator,
            index,
            generation: header.generation,
            step,
        }
        .check(header, frame.records().len())
        .map_err(|fault| LockstepError::Header { sender: sender(header), fault })?;
        if index >= 64 || missing >> index & 1 == 0 {
            return Err(LockstepError::Unexpected { sender: sender(header), step });
        }
        self.coordinator.receive(frame.records());
        missing &= !(1 << index);
        self.pending = Some((state, missing));
        Ok(Progress::Advanced)
    }

    fn act(&mut self, state: &S::Frame) -> Result<Progress, LockstepError> {
        let (step, time_ns) = (state.header().step, state.header().time_ns);
        let header = self.identity.header(step, time_ns);
        let had_event = self.coordinator.act(step, state.records());
        if had_event {
            for (_, zones, outbox) in &mut self.ports.neighbours {
                let summaries = || self.coordinator.summaries(zones.clone());
                let loan = outbox.loan(header, summaries().count(), |slots| {
                    summaries().for_each(|s| slots.push(s));
                })?;
                let reached = loan.send()?;
                if reached != 1 {
                    let what = "a summary";
                    return Err(LockstepError::LostReceiver { what, step, reached, expected: 1 });
                }
            }
        }
        let assignments = self.coordinator.assignments();
        let loan = self
            .ports
            .coordination
            .loan(header, assignments.len(), |slots| assignments.iter().for_each(|a| slots.push(*a)))?;
        let (reached, expected) = (loan.send()?, self.controllers as usize);
        if reached != expected {
            let what = "the coordination frame";
            return Err(LockstepError::LostReceiver { what, step, reached, expected });
        }
        Ok(Progress::Advanced)
    }
}
