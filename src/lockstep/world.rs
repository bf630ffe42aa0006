//! The world's side of a step: publish the state, collect the commands, integrate.

use super::{Awaited, Identity, LockstepError, Progress, mask_of, sender};
use crate::transport::{Frame, Inbox, Loan, Outbox};
use crate::world::World;
use ipc_schemas::{ExpectedHeader, FLAG_END_OF_RUN, FrameHeader, Role, VehicleCommand, VehicleState};

/// The world's ends of the services.
#[derive(Debug)]
pub struct WorldPorts<S, C, M> {
    /// State frames to controllers, every step.
    pub state: S,
    /// State frames to each coordinator process, only of the steps it acts in.
    pub coordinator_states: Vec<C>,
    /// Commands from controllers.
    pub command: M,
}

/// Drives a [`World`] through the lockstep.
#[derive(Debug)]
pub struct WorldDriver<S, C, M> {
    world: World,
    ports: WorldPorts<S, C, M>,
    identity: Identity,
    controllers: u32,
    /// Generation of each controller process.
    controller_generations: Vec<u32>,
    phase: Phase,
    was_event: bool,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    Publish,
    Collect { missing: u64 },
    Finished,
}

impl<S, C, M> WorldDriver<S, C, M>
where
    S: Outbox<VehicleState>,
    C: Outbox<VehicleState>,
    M: Inbox<VehicleCommand>,
{
    /// A driver at the world's present step.
    pub fn new(
        mut world: World,
        ports: WorldPorts<S, C, M>,
        run_id: u64,
        controllers: u32,
    ) -> WorldDriver<S, C, M> {
        world.share_out(controllers);
        WorldDriver {
            world,
            ports,
            identity: Identity { run_id, role: Role::World, index: 0, generation: 0 },
            controllers,
            controller_generations: vec![0; controllers as usize],
            phase: Phase::Publish,
            was_event: false,
        }
    }

    /// The world as it stands.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Makes the world keep completed visits (see [`World::record_visits`]).
    pub fn record_visits(&mut self) {
        self.world.record_visits();
    }

    /// Whether a coordinator acted in the step published last.
    pub fn was_event(&self) -> bool {
        self.was_event
    }

    /// Does what can be done now.
    pub fn advance(&mut self) -> Result<Progress, LockstepError> {
        match self.phase {
            Phase::Publish => {
                self.publish()?;
                Ok(Progress::Advanced)
            }
            Phase::Collect { missing } => self.collect(missing),
            Phase::Finished => Ok(Progress::Finished),
        }
    }

    fn publish(&mut self) -> Result<(), LockstepError> {
        let finished = self.world.is_finished();
        let masks = self.world.coordinator_masks();
        self.was_event = masks.acting != 0;
        let step = self.world.step();
        let header = FrameHeader {
            coordinators_acting: masks.acting,
            coordinators_summarised: masks.summarised,
            flags: if finished { FLAG_END_OF_RUN } else { 0 },
            ..self.identity.header(step, self.world.time_ns())
        };
        // Coordinators first: theirs is the longer way.
        for (index, outbox) in self.ports.coordinator_states.iter_mut().enumerate() {
            if finished || masks.acting >> index & 1 == 1 {
                let (world, index) = (&self.world, index as u32);
                let loan = outbox.loan(header, world.coordinator_record_count(index), |slots| {
                    world.coordinator_records(index).for_each(|r| slots.push(r));
                })?;
                check_reached("a coordinator's state frame", step, loan.send()?, 1, finished)?;
            }
        }
        let world = &mut self.world;
        let loan = self.ports.state.loan(header, world.record_count(), |slots| {
            world.publish(|records| slots.extend_from_slice(records));
        })?;
        check_reached("the state frame", step, loan.send()?, self.controllers, finished)?;
        self.phase =
            if finished { Phase::Finished } else { Phase::Collect { missing: mask_of(self.controllers) } };
        Ok(())
    }

    fn collect(&mut self, mut missing: u64) -> Result<Progress, LockstepError> {
        let step = self.world.step();
        let Some(frame) = self.ports.command.receive()? else {
            return Ok(Progress::Waiting(Awaited {
                role: Role::Controller,
                missing,
                what: "commands",
                step,
            }));
        };
        let header = frame.header();
        let index = header.sender_index;
        let generation = self.controller_generations.get(usize::from(index)).copied().unwrap_or(0);
        ExpectedHeader { run_id: self.identity.run_id, role: Role::Controller, index, generation, step }
            .check(header, frame.records().len())
            .map_err(|fault| LockstepError::Header { sender: sender(header), fault })?;
        if u32::from(index) >= self.controllers || missing >> index & 1 == 0 {
            return Err(LockstepError::Unexpected { sender: sender(header), step });
        }
        self.world.command(u32::from(index), frame.records()).map_err(|fault| LockstepError::Command {
            step,
            sender: sender(header),
            fault,
        })?;
        missing &= !(1 << index);
        if missing == 0 {
            self.world.advance().map_err(|vehicles| LockstepError::Uncommanded { step, vehicles })?;
            self.phase = Phase::Publish;
        } else {
            self.phase = Phase::Collect { missing };
        }
        Ok(Progress::Advanced)
    }
}

/// A frame must reach every participant; at the end of the run one may have gone already.
fn check_reached(
    what: &'static str,
    step: u64,
    reached: usize,
    expected: u32,
    finished: bool,
) -> Result<(), LockstepError> {
    let expected = expected as usize;
    if reached == expected || finished {
        Ok(())
    } else {
        Err(LockstepError::LostReceiver { what, step, reached, expected })
    }
}

/// Checks a state frame as its receivers do.
pub(super) fn check_state(
    run_id: u64,
    step: Option<u64>,
    header: &FrameHeader,
    records: usize,
) -> Result<(), LockstepError> {
    let step = step.unwrap_or(header.step);
    ExpectedHeader { run_id, role: Role::World, index: 0, generation: 0, step }
        .check(header, records)
        .map_err(|fault| LockstepError::Header { sender: sender(header), fault })
}
