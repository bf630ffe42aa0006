//! A controller process's side of a step: take the state, wait for coordination if there is any, answer.

use super::world::check_state;
use super::{Awaited, Identity, LockstepError, Progress, sender};
use crate::control::ControllerPool;
use crate::transport::{Frame, Inbox, Loan, Outbox};
use ipc_schemas::{Assignment, ExpectedHeader, FLAG_END_OF_RUN, Role, VehicleCommand, VehicleState};

/// A controller's ends of the services.
#[derive(Debug)]
pub struct ControllerPorts<S, A, C> {
    /// State frames from the world.
    pub state: S,
    /// Coordination frames from coordinators.
    pub coordination: A,
    /// Commands to the world.
    pub command: C,
}

/// Drives a [`ControllerPool`] through the lockstep.
#[derive(Debug)]
pub struct ControllerDriver<S, A, C>
where
    S: Inbox<VehicleState>,
{
    pool: ControllerPool,
    ports: ControllerPorts<S, A, C>,
    identity: Identity,
    next_step: u64,
    /// The state frame being answered, and the coordinators whose frames it still needs.
    pending: Option<(S::Frame, u64)>,
    finished: bool,
}

impl<S, A, C> ControllerDriver<S, A, C>
where
    S: Inbox<VehicleState>,
    A: Inbox<Assignment>,
    C: Outbox<VehicleCommand>,
{
    /// A driver that answers from `first_step` on.
    pub fn new(
        pool: ControllerPool,
        ports: ControllerPorts<S, A, C>,
        identity: Identity,
        first_step: u64,
    ) -> ControllerDriver<S, A, C> {
        ControllerDriver { pool, ports, identity, next_step: first_step, pending: None, finished: false }
    }

    /// Does what can be done now.
    pub fn advance(&mut self) -> Result<Progress, LockstepError> {
        if self.finished {
            return Ok(Progress::Finished);
        }
        match self.pending.take() {
            None => self.take_state(),
            Some((state, 0)) => self.answer(&state),
            Some((state, missing)) => self.take_coordination(state, missing),
        }
    }

    fn take_state(&mut self) -> Result<Progress, LockstepError> {
        let step = self.next_step;
        let Some(state) = self.ports.state.receive()? else {
            return Ok(Progress::Waiting(Awaited { role: Role::World, missing: 1, what: "state", step }));
        };
        check_state(self.identity.run_id, Some(step), state.header(), state.records().len())?;
        if state.header().flags & FLAG_END_OF_RUN != 0 {
            self.finished = true;
            return Ok(Progress::Finished);
        }
        let missing = state.header().coordinators_acting;
        self.pending = Some((state, missing));
        Ok(Progress::Advanced)
    }

    fn take_coordination(&mut self, state: S::Frame, mut missing: u64) -> Result<Progress, LockstepError> {
        let step = self.next_step;
        let Some(frame) = self.ports.coordination.receive()? else {
            self.pending = Some((state, missing));
            let what = "coordination";
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
        self.pool
            .coordinate(state.records(), frame.records())
            .map_err(|fault| LockstepError::Pool { step, fault })?;
        missing &= !(1 << index);
        self.pending = Some((state, missing));
        Ok(Progress::Advanced)
    }

    fn answer(&mut self, state: &S::Frame) -> Result<Progress, LockstepError> {
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
        let reached = loan.send()?;
        if reached != 1 {
            let what = "the command frame";
            return Err(LockstepError::LostReceiver { what, step, reached, expected: 1 });
        }
        self.next_step += 1;
        Ok(Progress::Advanced)
    }
}
