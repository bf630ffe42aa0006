//! What the world does with a frame that has come: judges a copy of it, takes it or refuses it, and tells its sender.

use super::{Missing, WorldDriver};
use crate::lockstep::members::check_sender;
use crate::lockstep::{LockstepError, Refusal};
use crate::scenario::share::zones_of;
use crate::transport::{Frame, Inbox, Outbox};
use ipc_schemas::{Assignment, ExpectedHeader, FrameHeader, Role, VehicleCommand, VehicleState};

/// Refused frames looked at in one go; after that whoever waits looks at its clock.
const REFUSED_AT_ONCE: usize = 16;

impl<S, C, M, A> WorldDriver<S, C, M, A>
where
    S: Outbox<VehicleState>,
    C: Outbox<VehicleState>,
    M: Inbox<VehicleCommand>,
    A: Inbox<Assignment>,
{
    /// Takes a command frame; returns whether one was taken.
    pub(super) fn take_command(&mut self, missing: &mut Missing) -> Result<bool, LockstepError> {
        for _ in 0..REFUSED_AT_ONCE {
            let Some(frame) = self.ports.command.receive()? else { break };
            let header = *frame.header();
            match self.judge_command(&header, &frame, missing.commands) {
                Ok(()) => {
                    missing.commands &= !(1 << header.sender_index);
                    if let Some(ledger) = &mut self.ledger {
                        let index = usize::from(header.sender_index);
                        ledger.command(index, &mut self.judged, self.controllers[index].stands_in);
                    }
                    return Ok(true);
                }
                Err(None) => self.refusals.late += 1,
                Err(Some(refusal)) => {
                    self.refuse(Role::Controller, &header, frame.origin(), refusal)?;
                    self.detained.0.push(frame);
                }
            }
        }
        self.detained.0.clear();
        Ok(false)
    }

    /// Judges a frame, of which the header has been copied already, and leaves its records in `judged`: they
    /// stay in the memory of their sender, who may change them at any time. Otherwise why it is not taken, or
    /// nothing for one that is merely late.
    fn judge_command(
        &mut self,
        header: &FrameHeader,
        frame: &M::Frame,
        missing: u64,
    ) -> Result<(), Option<Refusal>> {
        let step = self.world.step();
        let index = header.sender_index;
        let seat = self.controllers.get_mut(usize::from(index));
        let generation = seat.as_ref().map_or(0, |seat| seat.generation);
        let expected =
            ExpectedHeader { run_id: self.identity.run_id, role: Role::Controller, index, generation, step };
        let records = frame.records();
        let sent = (header, records.len(), frame.origin());
        check_sender(&expected, sent, seat, missing, &self.ports.command)?;
        copy_out(&mut self.judged, records);
        let taken = self.world.command(u32::from(index), &self.judged);
        taken.map_err(|fault| Some(Refusal::Command { step, fault }))
    }

    /// Takes a coordination frame; returns whether one was taken.
    pub(super) fn take_coordination(&mut self, missing: &mut Missing) -> Result<bool, LockstepError> {
        for _ in 0..REFUSED_AT_ONCE {
            let received = match &mut self.ports.coordination {
                Some(inbox) => inbox.receive()?,
                None => None,
            };
            let Some(frame) = received else { break };
            let header = *frame.header();
            match self.judge_coordination(&header, &frame, missing.coordination) {
                Ok(()) => {
                    missing.coordination &= !(1 << header.sender_index);
                    if let Some(ledger) = &mut self.ledger {
                        ledger.coordinate(header.sender_index, &self.judged_coordination);
                        self.world.coordinate(&self.judged_coordination);
                    }
                    return Ok(true);
                }
                Err(None) => self.refusals.late += 1,
                Err(Some(refusal)) => {
                    self.refuse(Role::Coordinator, &header, frame.origin(), refusal)?;
                    self.detained.1.push(frame);
                }
            }
        }
        self.detained.1.clear();
        Ok(false)
    }

    /// The same for coordination.
    fn judge_coordination(
        &mut self,
        header: &FrameHeader,
        frame: &A::Frame,
        missing: u64,
    ) -> Result<(), Option<Refusal>> {
        let step = self.world.step();
        let index = header.sender_index;
        let count = self.coordinators.len() as u32;
        let seat = self.coordinators.get_mut(usize::from(index));
        let generation = seat.as_ref().map_or(0, |seat| seat.generation);
        let expected =
            ExpectedHeader { run_id: self.identity.run_id, role: Role::Coordinator, index, generation, step };
        let inbox = self.ports.coordination.as_ref().expect("the frame came from this inbox");
        let records = frame.records();
        check_sender(&expected, (header, records.len(), frame.origin()), seat, missing, inbox)?;
        copy_out(&mut self.judged_coordination, records);
        let own = zones_of(self.world.scenario().network.zones.len() as u32, u32::from(index), count);
        match self.judged_coordination.iter().position(|a| !own.contains(&a.zone)) {
            None => Ok(()),
            Some(record) => {
                let zone = self.judged_coordination[record].zone;
                Err(Some(Refusal::ForeignZone { step, record, zone }))
            }
        }
    }

    fn refuse(
        &mut self,
        role: Role,
        header: &FrameHeader,
        origin: u128,
        refusal: Refusal,
    ) -> Result<(), LockstepError> {
        let ports = &self.ports;
        let process_id = self.refusals.enter(header, origin, refusal.clone(), || match role {
            Role::Coordinator => ports.coordination.as_ref().and_then(|inbox| inbox.process_of(origin)),
            _ => ports.command.process_of(origin),
        });
        // Whoever errs in its own name; strangers may claim what they like.
        let seats = if role == Role::Coordinator { &self.coordinators } else { &self.controllers };
        let own = seats.iter().zip(0..).find(|(seat, _)| seat.process_id == process_id);
        if let Some((_, index)) = own {
            self.tell_refusal(role, index, &refusal)?;
            self.suspect = Some((role, index, refusal));
        }
        Ok(())
    }

    /// Tells a controller that its answer was not taken, once in a step: it may answer anew.
    fn tell_refusal(&mut self, role: Role, index: u16, refusal: &Refusal) -> Result<(), LockstepError> {
        let Some(feedbacks) = self.feedbacks.as_mut().filter(|_| role == Role::Controller) else {
            return Ok(());
        };
        let step = self.world.step();
        let known = self.refused_now.iter().any(|told| told.controller == index);
        if let Some(told) = refusal.feedback(step, index).filter(|_| !known) {
            self.refused_now.push(told);
            let header = self.identity.header(step, self.world.time_ns());
            feedbacks.tell(index, header, std::slice::from_ref(&told))?;
        }
        Ok(())
    }
}

/// Copies records out of a frame, reading each once. The copy grows by powers of two, so that it stops growing
/// early on.
fn copy_out<R: Copy>(copy: &mut Vec<R>, records: &[R]) {
    copy.clear();
    if copy.capacity() < records.len() {
        copy.reserve(records.len().next_power_of_two());
    }
    copy.extend_from_slice(records);
}
