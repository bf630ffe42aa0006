//! A controller process's side of a step: take the state, wait for coordination if there is any, answer.

use super::members::check_sender;
use super::refusals::Refusals;
use super::{Awaited, Handover, Identity, InHand, LockstepError, Members, Progress, Refusal, RefusedFrames};
use crate::control::ControllerPool;
use crate::scenario::ControllerNames;
use crate::transport::{Frame, Inbox, Loan, Outbox};
use ipc_schemas::{
    Assignment, ExpectedHeader, FLAG_END_OF_RUN, FLAG_MISSED, Member, Role, VehicleCommand, VehicleState,
};

/// A controller's ends of the services.
#[derive(Debug)]
pub struct ControllerPorts<S, A, C, M> {
    /// State frames from the world.
    pub state: S,
    /// Coordination frames from coordinators.
    pub coordination: A,
    /// Commands to the world.
    pub command: C,
    /// Whom to believe.
    pub members: Members<M>,
}

/// Drives a [`ControllerPool`] through the lockstep.
#[derive(Debug)]
pub struct ControllerDriver<S, A, C, M>
where
    S: Inbox<VehicleState>,
    A: Inbox<Assignment>,
{
    pool: ControllerPool,
    ports: ControllerPorts<S, A, C, M>,
    identity: Identity,
    next_step: u64,
    /// The state being answered, and the coordinators whose frames it still needs.
    pending: Option<(InHand<S::Frame>, u64)>,
    /// What is to be taken over with the next state.
    inherited: Option<Handover>,
    refusals: Refusals,
    /// Refused frames, held for a while so that their senders are passed over in favour of others.
    detained: Vec<A::Frame>,
    finished: bool,
}

impl<S, A, C, M> ControllerDriver<S, A, C, M>
where
    S: Inbox<VehicleState>,
    A: Inbox<Assignment>,
    C: Outbox<VehicleCommand>,
    M: Inbox<Member>,
{
    /// A driver that answers from `first_step` on.
    pub fn new(
        pool: ControllerPool,
        ports: ControllerPorts<S, A, C, M>,
        identity: Identity,
        first_step: u64,
    ) -> ControllerDriver<S, A, C, M> {
        ControllerDriver {
            pool,
            ports,
            identity,
            next_step: first_step,
            pending: None,
            inherited: None,
            refusals: Refusals::default(),
            detained: Vec::new(),
            finished: false,
        }
    }

    /// Goes on from what another has left, or from where the run is now.
    pub fn take_over(&mut self, mut handover: Handover) {
        self.next_step = handover.step;
        self.pending = None;
        if let Some(header) = handover.header.take() {
            let states = std::mem::take(&mut handover.states);
            self.pending = Some((InHand::Handed(header, states), header.coordinators_acting));
        }
        self.inherited = Some(handover);
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
        match self.pending.take() {
            None => self.take_state(),
            Some((state, missing)) if self.inherited.is_some() => self.inherit(state, missing),
            Some((state, 0)) => self.answer(&state),
            Some((state, missing)) => self.take_coordination(state, missing),
        }
    }

    fn take_state(&mut self) -> Result<Progress, LockstepError> {
        let step = self.next_step;
        let Some(state) = self.receive_state()? else {
            return Ok(Progress::Waiting(Awaited { role: Role::World, missing: 1, what: "state", step }));
        };
        let header = state.header();
        if header.flags & FLAG_END_OF_RUN != 0 {
            self.finished = true;
            return Ok(Progress::Finished);
        }
        if header.step < step {
            // It was handed over with the rest, or the run went on without this one.
            return Ok(Progress::Advanced);
        }
        if header.step > step || header.flags & FLAG_MISSED != 0 {
            return Ok(Progress::Behind);
        }
        let missing = header.coordinators_acting;
        self.pending = Some((InHand::Frame(state), missing));
        Ok(Progress::Advanced)
    }

    /// The next state of the world's; a frame of anybody else is as good as none.
    fn receive_state(&mut self) -> Result<Option<S::Frame>, LockstepError> {
        let ControllerPorts { state, members, .. } = &mut self.ports;
        let Some(frame) = state.receive()? else { return Ok(None) };
        let is_taken = members.check_state(self.identity.run_id, &frame, state, &mut self.refusals)?;
        Ok(is_taken.then_some(frame))
    }

    /// Takes over with the first state at hand.
    fn inherit(&mut self, state: InHand<S::Frame>, mut missing: u64) -> Result<Progress, LockstepError> {
        let step = self.next_step;
        if let Some(handover) = self.inherited.take() {
            let states = state.records();
            self.pool
                .restore(states, &handover.commands, &handover.in_force)
                .map_err(|fault| LockstepError::Pool { step, fault })?;
            for (coordinator, assignments) in &handover.coordination {
                self.pool
                    .coordinate(states, assignments)
                    .map_err(|fault| LockstepError::Pool { step, fault })?;
                missing &= !(1 << coordinator);
            }
        }
        self.pending = Some((state, missing));
        Ok(Progress::Advanced)
    }

    fn take_coordination(
        &mut self,
        state: InHand<S::Frame>,
        mut missing: u64,
    ) -> Result<Progress, LockstepError> {
        let step = self.next_step;
        let what = "coordination";
        let awaited = Awaited { role: Role::Coordinator, missing, what, step };
        let Some(frame) = self.ports.coordination.receive()? else {
            self.detained.clear();
            // If the run has gone on, what is missing here will never come.
            if let Some(next) = self.receive_state()? {
                if next.header().flags & FLAG_END_OF_RUN != 0 {
                    self.finished = true;
                    return Ok(Progress::Finished);
                }
                if next.header().step > step {
                    return Ok(Progress::Behind);
                }
            }
            self.pending = Some((state, missing));
            return Ok(Progress::Waiting(awaited));
        };
        let judged = self.judge(&frame, &state, missing)?;
        let mut progress = Progress::Advanced;
        match judged {
            Ok(index) => missing &= !(1 << index),
            Err(None) => self.refusals.late += 1,
            Err(Some(refusal)) => {
                let inbox = &self.ports.coordination;
                let origin = frame.origin();
                self.refusals.enter(frame.header(), origin, refusal, || inbox.process_of(origin));
                self.detained.push(frame);
                // However many of these come, waiting for the right one goes on.
                progress = Progress::Waiting(awaited);
            }
        }
        self.pending = Some((state, missing));
        Ok(progress)
    }

    /// Takes the frame; returns its sender, or why it is not taken, or nothing for one that is merely late.
    fn judge(
        &mut self,
        frame: &A::Frame,
        state: &InHand<S::Frame>,
        missing: u64,
    ) -> Result<Result<u16, Option<Refusal>>, LockstepError> {
        let header = &{ *frame.header() };
        let sent = (header, frame.records().len(), frame.origin());
        let (run_id, step, index) = (self.identity.run_id, self.next_step, header.sender_index);
        let ControllerPorts { coordination, members, .. } = &mut self.ports;
        let seat = members.coordinator(run_id, header, frame.origin(), &mut self.refusals)?;
        let generation = seat.as_ref().map_or(header.generation, |seat| seat.generation);
        let expected = ExpectedHeader { run_id, role: Role::Coordinator, index, generation, step };
        if let Err(reason) = check_sender(&expected, sent, seat, missing, coordination) {
            return Ok(Err(reason));
        }
        let taken = self.pool.coordinate(state.records(), frame.records());
        Ok(taken.map(|()| index).map_err(|fault| Some(Refusal::Coordination { step, fault })))
    }

    fn answer(&mut self, state: &InHand<S::Frame>) -> Result<Progress, LockstepError> {
        let step = self.next_step;
        let time_ns = state.header().time_ns;
        let header = self.identity.header(step, time_ns);
        let count = self.pool.command_count(state.records());
        let pool = &mut self.pool;
        let mut outcome = Ok(());
        let loan = self.ports.command.loan(header, count, |slots| {
            let mut written = 0;
            outcome = pool.command(time_ns as f64 * 1e-9, state.records(), |command| {
                slots.push(command);
                written += 1;
            });
            // The frame is dropped on an error, but it must be whole to be dropped.
            (written..count).for_each(|_| slots.push(VehicleCommand::default()));
        })?;
        outcome.map_err(|fault| LockstepError::Pool { step, fault })?;
        loan.send()?;
        self.next_step += 1;
        Ok(Progress::Advanced)
    }
}
