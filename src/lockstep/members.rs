//! Who has which place, and whether a frame comes from there.
//!
//! A header says what its sender wrote into it. Which process a frame comes from the transport knows, and which
//! process has a place the world knows, which tells everybody. A frame is taken only where the two agree.

use super::refusals::{Claim, Refusals};
use super::{LockstepError, Refusal, sender};
use crate::transport::{Frame, Inbox, TransportError};
use ipc_schemas::{ExpectedHeader, FrameHeader, HeaderFault, Member, Record, Role, VehicleState};

/// A place among the processes of a role.
#[derive(Clone, Copy, Debug, Default)]
pub struct Seat {
    /// How often it has been taken anew.
    pub generation: u32,
    /// Who has it, where that is known; frames from others are refused then.
    pub process_id: Option<u32>,
    /// Whether it is a controller of ours in the place of one written elsewhere, and so remembers as ours do.
    pub stands_in: bool,
    /// The sending end that has proved to be that process's.
    origin: Option<u128>,
}

impl Seat {
    /// A place taken for the `generation`th time.
    pub fn new(generation: u32, process_id: u32) -> Seat {
        Seat { generation, process_id: Some(process_id), stands_in: false, origin: None }
    }

    /// The same, taken by a controller of ours in the place of one written elsewhere, or not.
    pub fn standing_in(self, stands_in: bool) -> Seat {
        Seat { stands_in, ..self }
    }

    /// Checks that a sending end belongs to whoever has the place. One that has been closed since belongs to
    /// nobody: an error without a refusal, for whoever comes next sends the same again.
    fn admit<R: Record>(
        &mut self,
        header: &FrameHeader,
        origin: u128,
        inbox: &impl Inbox<R>,
    ) -> Result<(), Option<Refusal>> {
        let Some(expected) = self.process_id.filter(|_| self.origin != Some(origin)) else { return Ok(()) };
        match inbox.process_of(origin) {
            Some(found) if found != expected => {
                Err(Some(Refusal::Stranger { claimed: Claim::of(header), expected }))
            }
            None => Err(None),
            Some(_) => {
                self.origin = Some(origin);
                Ok(())
            }
        }
    }
}

/// Checks the header of an answer, that its sender has the place it claims, and that it is still asked for.
/// An answer that is merely late or comes twice is an error without a refusal.
pub(super) fn check_sender<R: Record>(
    expected: &ExpectedHeader,
    (header, records, origin): (&FrameHeader, usize, u128),
    seat: Option<&mut Seat>,
    missing: u64,
    inbox: &impl Inbox<R>,
) -> Result<(), Option<Refusal>> {
    let checked = expected.check(header, records);
    let late = match &checked {
        Ok(()) => header.sender_index < 64 && missing >> header.sender_index & 1 == 0,
        Err(HeaderFault::OldGeneration { .. }) => true,
        Err(HeaderFault::OtherStep { expected, found }) => found < expected,
        Err(_) => false,
    };
    if let (Err(fault), false) = (checked, late) {
        return Err(Some(fault.into()));
    }
    let Some(seat) = seat else { return Err(Some(Refusal::Unexpected { step: header.step })) };
    seat.admit(header, origin, inbox)?;
    if late { Err(None) } else { Ok(()) }
}

/// Whom a participant believes.
#[derive(Debug)]
pub struct Members<M> {
    /// Where the world says who they are; without it, headers are believed.
    inbox: Option<M>,
    /// The world as sender of states, and of this.
    world: [Seat; 2],
    coordinators: Vec<Seat>,
}

impl<M: Inbox<Member>> Members<M> {
    /// As the world with that process id says.
    pub fn told_by(world_process_id: u32, inbox: M) -> Members<M> {
        let world = Seat::new(0, world_process_id);
        Members { inbox: Some(inbox), world: [world; 2], coordinators: Vec::new() }
    }

    /// Whoever a header names: where no other process can send anything.
    pub fn as_claimed() -> Members<M> {
        Members { inbox: None, world: [Seat::default(); 2], coordinators: Vec::new() }
    }

    /// Whether a state frame is the world's; one that is not is entered among the refusals.
    ///
    /// # Errors
    /// When it is, and its header is not what the protocol asks for. The step is the caller's business.
    pub(super) fn check_state<F: Frame<VehicleState>>(
        &mut self,
        run_id: u64,
        frame: &F,
        inbox: &impl Inbox<VehicleState>,
        refusals: &mut Refusals,
    ) -> Result<bool, LockstepError> {
        let (header, origin) = (frame.header(), frame.origin());
        match self.world[0].admit(header, origin, inbox) {
            Ok(()) => {}
            Err(refusal) => {
                if let Some(refusal) = refusal {
                    refusals.enter(header, origin, refusal, || inbox.process_of(origin));
                }
                return Ok(false);
            }
        }
        from_world(run_id, header)
            .check(header, frame.records().len())
            .map_err(|fault| LockstepError::Header { sender: sender(header), fault })?;
        Ok(true)
    }

    /// The place of the coordinator a frame says it comes from, if there is one.
    pub(super) fn coordinator(
        &mut self,
        run_id: u64,
        header: &FrameHeader,
        origin: u128,
        refusals: &mut Refusals,
    ) -> Result<Option<&mut Seat>, TransportError> {
        let index = usize::from(header.sender_index);
        if self.inbox.is_none() && index < 64 {
            self.coordinators.resize(self.coordinators.len().max(index + 1), Seat::default());
            self.coordinators[index].generation = header.generation;
        } else if self.coordinators.get(index).is_none_or(|seat| seat.origin != Some(origin)) {
            self.listen(run_id, refusals)?;
        }
        Ok(self.coordinators.get_mut(index))
    }

    /// Takes what the world has said since. It says so before whoever takes a place can send anything.
    fn listen(&mut self, run_id: u64, refusals: &mut Refusals) -> Result<(), TransportError> {
        let Some(inbox) = &mut self.inbox else { return Ok(()) };
        while let Some(frame) = inbox.receive()? {
            let (header, origin) = (&{ *frame.header() }, frame.origin());
            let sent = (header, frame.records().len(), origin);
            let expected = from_world(run_id, header);
            if let Err(refusal) = check_sender(&expected, sent, Some(&mut self.world[1]), u64::MAX, inbox) {
                if let Some(refusal) = refusal {
                    refusals.enter(header, origin, refusal, || inbox.process_of(origin));
                }
                continue;
            }
            for member in frame.records().iter().copied() {
                let index = usize::from(member.index);
                if member.role != Role::Coordinator as u16 || index >= 64 {
                    continue;
                }
                self.coordinators.resize(self.coordinators.len().max(index + 1), Seat::default());
                let seat = &mut self.coordinators[index];
                if (seat.generation, seat.process_id) != (member.generation, Some(member.process_id)) {
                    *seat = Seat::new(member.generation, member.process_id);
                }
            }
        }
        Ok(())
    }
}

fn from_world(run_id: u64, header: &FrameHeader) -> ExpectedHeader {
    ExpectedHeader { run_id, role: Role::World, index: 0, generation: 0, step: header.step }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::Identity;
    use super::*;
    use crate::scenario::ControllerNames;
    use crate::transport::memory::{MemoryInbox, MemoryOutbox, MemoryService};
    use crate::transport::{Backlog, Loan, Outbox, Slots};

    const RUN_ID: u64 = 7;
    const WORLD: u32 = 1;

    fn send<R: Record>(outbox: &mut MemoryOutbox<R>, header: FrameHeader, records: &[R]) {
        let fill = |slots: &mut Slots<'_, R>| records.iter().for_each(|r| slots.push(*r));
        outbox.loan(header, records.len(), fill).unwrap().send().unwrap();
    }

    fn header(role: Role, index: u16, generation: u32) -> FrameHeader {
        Identity { run_id: RUN_ID, role, index, generation }.header(0, 0)
    }

    fn coordinator(process_id: u32, generation: u32) -> Member {
        Member { process_id, generation, role: Role::Coordinator as u16, index: 0 }
    }

    /// Whether a frame of coordinator 0 is taken, late (`None`) or refused, and why.
    fn judge(
        members: &mut Members<MemoryInbox<Member>>,
        inbox: &mut MemoryInbox<ipc_schemas::Assignment>,
        refusals: &mut Refusals,
    ) -> Result<(), Option<Refusal>> {
        let frame = inbox.receive().unwrap().unwrap();
        let header = frame.header();
        let seat = members.coordinator(RUN_ID, header, frame.origin(), refusals).unwrap();
        let generation = seat.as_ref().map_or(0, |seat| seat.generation);
        let expected =
            ExpectedHeader { run_id: RUN_ID, role: Role::Coordinator, index: 0, generation, step: 0 };
        check_sender(&expected, (header, frame.records().len(), frame.origin()), seat, 1, inbox)
    }

    #[test]
    fn a_coordinator_is_who_the_world_says_it_is() {
        let (service, told) = (MemoryService::new(), MemoryService::holding(Backlog::Last));
        let mut world = told.outbox_of(WORLD);
        let mut members = Members::told_by(WORLD, told.inbox());
        let (mut first, mut second) = (service.outbox_of(10), service.outbox_of(20));
        let (mut stranger, mut inbox) = (service.outbox_of(30), service.inbox());
        let mut refusals = Refusals::default();
        let stranger_is = |expected| {
            let claimed = Claim::of(&header(Role::Coordinator, 0, 0));
            Err(Some(Refusal::Stranger { claimed, expected }))
        };

        // Before the world has said anything there are no coordinators.
        send(&mut first, header(Role::Coordinator, 0, 0), &[]);
        let unexpected = Err(Some(Refusal::Unexpected { step: 0 }));
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), unexpected);
        send(&mut world, header(Role::World, 0, 0), &[coordinator(10, 0)]);
        send(&mut first, header(Role::Coordinator, 0, 0), &[]);
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), Ok(()));
        send(&mut stranger, header(Role::Coordinator, 0, 0), &[]);
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), stranger_is(10));
        send(&mut second, header(Role::Coordinator, 0, 0), &[]);
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), stranger_is(10));

        // The place is taken anew; what the one before has left is late.
        send(&mut first, header(Role::Coordinator, 0, 0), &[]);
        send(&mut world, header(Role::World, 0, 0), &[coordinator(20, 1)]);
        send(&mut second, header(Role::Coordinator, 0, 1), &[]);
        drop(first);
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), Ok(()), "it may have come before");
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), Ok(()));
        send(&mut stranger, header(Role::Coordinator, 0, 1), &[]);
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), stranger_is(20));
    }

    #[test]
    fn nobody_but_the_world_says_who_is_a_member() {
        let (service, told) = (MemoryService::new(), MemoryService::holding(Backlog::Last));
        let (mut world, mut forger) = (told.outbox_of(WORLD), told.outbox_of(30));
        let mut members = Members::told_by(WORLD, told.inbox());
        let (mut first, mut stranger) = (service.outbox_of(10), service.outbox_of(30));
        let (mut inbox, mut refusals) = (service.inbox(), Refusals::default());
        send(&mut world, header(Role::World, 0, 0), &[coordinator(10, 0)]);
        send(&mut forger, header(Role::World, 0, 0), &[coordinator(30, 0)]);
        send(&mut stranger, header(Role::Coordinator, 0, 0), &[]);
        let judged = judge(&mut members, &mut inbox, &mut refusals);
        assert!(matches!(judged, Err(Some(Refusal::Stranger { expected: 10, .. }))), "{judged:?}");
        send(&mut first, header(Role::Coordinator, 0, 0), &[]);
        assert_eq!(judge(&mut members, &mut inbox, &mut refusals), Ok(()));
        let own = Identity { run_id: RUN_ID, role: Role::Controller, index: 0, generation: 0 };
        let report = refusals.report(&own, &ControllerNames::default());
        assert_eq!((report.len(), report[0].frames), (1, 1), "{report:?}");
        assert!(report[0].sender.contains("process 30"), "{report:?}");
    }

    #[test]
    fn a_state_of_another_process_is_refused_and_a_bad_one_of_the_worlds_is_an_error() {
        let (service, told) = (MemoryService::new(), MemoryService::holding(Backlog::Last));
        let mut members = Members::<MemoryInbox<Member>>::told_by(WORLD, told.inbox());
        let (mut world, mut stranger) = (service.outbox_of(WORLD), service.outbox_of(30));
        let (mut inbox, mut refusals) = (service.inbox(), Refusals::default());
        let good = header(Role::World, 0, 0);
        send(&mut stranger, good, &[]);
        send(&mut world, good, &[]);
        send(&mut world, FrameHeader { run_id: 8, ..good }, &[]);
        let mut taken = || {
            let frame = inbox.receive().unwrap().unwrap();
            members.check_state(RUN_ID, &frame, &inbox, &mut refusals)
        };
        assert_eq!(taken(), Ok(false));
        assert_eq!(taken(), Ok(true));
        let fault = HeaderFault::OtherRun { expected: RUN_ID, found: 8 };
        assert_eq!(taken(), Err(LockstepError::Header { sender: "the world".to_owned(), fault }));
        let own = Identity { run_id: RUN_ID, role: Role::Controller, index: 0, generation: 0 };
        assert_eq!(refusals.report(&own, &ControllerNames::default())[0].frames, 1);
    }
}
