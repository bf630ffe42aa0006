//! Who has which place in the run, and what whoever takes one needs.

use super::{Phase, WorldDriver};
use crate::lockstep::{Handover, Refusal, Seat};
use crate::transport::{Inbox, Outbox};
use ipc_schemas::{Assignment, Member, Role, VehicleCommand, VehicleState};

impl<S, C, M, A> WorldDriver<S, C, M, A>
where
    S: Outbox<VehicleState>,
    C: Outbox<VehicleState>,
    M: Inbox<VehicleCommand>,
    A: Inbox<Assignment>,
{
    /// Gives a place to a process; frames its predecessor has left are refused from now on. Returns whether it
    /// had not had it.
    pub fn seat(&mut self, role: Role, index: u32, seat: Seat) -> bool {
        if role == Role::Controller {
            // Whoever comes back is waited for again.
            self.abandoned &= !(1 << index);
        }
        let seats = if role == Role::Coordinator { &mut self.coordinators } else { &mut self.controllers };
        let who = |seat: &Seat| (seat.generation, seat.process_id);
        let place = seats.get_mut(index as usize).filter(|place| who(place) != who(&seat));
        place.map(|place| *place = seat).is_some()
    }

    /// Who has which place, as everybody is to know.
    pub fn members(&self) -> impl Iterator<Item = Member> {
        let roles = [(Role::Coordinator, &self.coordinators), (Role::Controller, &self.controllers)];
        roles.into_iter().flat_map(|(role, seats)| {
            seats.iter().zip(0..).filter_map(move |(seat, index)| {
                let (role, generation) = (role as u16, seat.generation);
                Some(Member { process_id: seat.process_id?, generation, role, index })
            })
        })
    }

    /// Who is still there to receive states: role, index and process. After the end of the run the world must
    /// not leave before them, for the last state would go with it.
    pub fn receivers(&self) -> Vec<(Role, u32, u32)> {
        let mut receivers = Vec::new();
        let mut add = |role, seats: &[Seat], first: u32, process_id: Option<u32>| {
            let is_there = |seat: &Seat| seat.process_id.is_some() && seat.process_id == process_id;
            if let Some((_, index)) = seats.iter().zip(first..).find(|(seat, _)| is_there(seat)) {
                receivers.extend(process_id.map(|id| (role, index, id)));
            }
        };
        for (index, outbox) in (0..).zip(&self.ports.coordinator_states) {
            let seats = &self.coordinators[index as usize..][..1];
            outbox.receivers(&mut |process_id| add(Role::Coordinator, seats, index, process_id));
        }
        let seats = &self.controllers[..];
        self.ports.state.receivers(&mut |process_id| add(Role::Controller, seats, 0, process_id));
        receivers
    }

    /// Who is waited for and has sent something it should not have in this step: its name and the fault.
    pub fn suspect(&self) -> Option<(String, &Refusal)> {
        let (role, index, refusal) = self.suspect.as_ref()?;
        let Phase::Collect(missing) = self.phase else { return None };
        let mask = if *role == Role::Coordinator { missing.coordination } else { missing.commands };
        let name = || match role {
            Role::Controller => self.names().of(u32::from(*index)),
            role => format!("{role} {index}"),
        };
        (mask >> index & 1 == 1).then(|| (name(), refusal))
    }

    /// What a process needs that takes a place now. `None` when that is not known yet (a controller must
    /// wait for the coordination of the step), nothing is kept, or the run is over.
    pub fn handover(&self, role: Role, index: u32) -> Option<Handover> {
        let ledger = self.ledger.as_ref()?;
        let mut handover = ledger.handover(role, index as usize);
        handover.step = self.world.step();
        match (self.phase, role) {
            (Phase::Finished, _) => return None,
            (Phase::Collect(missing), Role::Controller) if missing.coordination != 0 => return None,
            (Phase::Collect(_), Role::Controller) => {
                handover.header = Some(self.header);
                handover.states = self.world.records().collect();
            }
            (Phase::Collect(_), Role::Coordinator) if self.header.coordinators_acting >> index & 1 == 1 => {
                handover.header = Some(self.header);
                handover.states = self.world.coordinator_records(index).collect();
            }
            _ => {}
        }
        match self.phase {
            Phase::Collect(_) => {
                handover.events = self.world.coordinators_with_events();
                handover.summarised = self.header.coordinators_summarised;
            }
            // Those with an event in the step that has just ended.
            _ => handover.summarised = self.world.coordinators_with_events(),
        }
        Some(handover)
    }
}
