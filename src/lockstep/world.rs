//! The world's side of a step: publish the state, collect the commands, integrate.

mod judging;
mod places;

use super::kept::KeptStep;
use super::refusals::Refusals;
use super::{
    Awaited, Feedbacks, Identity, Ledger, LockstepError, Observer, Progress, Refusal, RefusedFrames, Seat,
    mask_of,
};
use crate::scenario::ControllerNames;
use crate::scenario::share::zones_of;
use crate::step::{CommandPart, POLICY_NONE, StepFrames};
use crate::transport::{Inbox, Loan, Outbox, Slots, TransportError};
use crate::world::{PutIn, Sheet, World};
use ipc_schemas::{
    Assignment, FLAG_END_OF_RUN, FLAG_MISSED, Feedback, FrameHeader, Role, VehicleCommand, VehicleState,
    ZoneSummary,
};

/// The world's ends of the services.
#[derive(Debug)]
pub struct WorldPorts<S, C, M, A> {
    /// State frames to controllers, every step.
    pub state: S,
    /// State frames to each coordinator process, only of the steps it acts in.
    pub coordinator_states: Vec<C>,
    /// Commands from controllers.
    pub command: M,
    /// Coordination, as controllers get it. With it the world keeps a [`Ledger`]; without, nobody can be
    /// replaced.
    pub coordination: Option<A>,
}

/// Drives a [`World`] through the lockstep.
#[derive(Debug)]
pub struct WorldDriver<S, C, M, A>
where
    M: Inbox<VehicleCommand>,
    A: Inbox<Assignment>,
{
    world: World,
    ports: WorldPorts<S, C, M, A>,
    identity: Identity,
    controllers: Vec<Seat>,
    coordinators: Vec<Seat>,
    ledger: Option<Ledger>,
    /// A command frame being judged, copied out of its sender's reach first; so too the coordination.
    judged: Vec<VehicleCommand>,
    judged_coordination: Vec<Assignment>,
    refusals: Refusals,
    /// Refused frames, held for a while so that their senders are passed over in favour of others.
    detained: (Vec<M::Frame>, Vec<A::Frame>),
    /// Whoever has sent something it should not have in this step, in its own name.
    suspect: Option<(Role, u16, Refusal)>,
    header: FrameHeader,
    /// Controllers for which the world put in commands in the present step, or the last one.
    put_in: u64,
    /// The verdict of what was put in.
    put_in_verdict: u16,
    /// Controllers nobody waits for any more: the world puts in what they do, as the shield allows.
    abandoned: u64,
    observer: Option<Box<dyn Observer>>,
    /// Where controllers written elsewhere are told what became of their answers.
    feedbacks: Option<Box<dyn Feedbacks>>,
    /// What they have been told: of refusals since the last state, and all that the last state came with.
    refused_now: Vec<Feedback>,
    told: Vec<Feedback>,
    /// The records of the state published last, for the observer.
    published: Vec<VehicleState>,
    /// A step that is shown once it is over.
    kept: KeptStep,
    phase: Phase,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    Publish,
    Collect(Missing),
    Finished,
}

/// Bit per process whose frame of this step has not come.
#[derive(Clone, Copy, Debug)]
struct Missing {
    commands: u64,
    coordination: u64,
}

impl<S, C, M, A> WorldDriver<S, C, M, A>
where
    S: Outbox<VehicleState>,
    C: Outbox<VehicleState>,
    M: Inbox<VehicleCommand>,
    A: Inbox<Assignment>,
{
    /// A driver at the world's present step.
    pub fn new(
        mut world: World,
        ports: WorldPorts<S, C, M, A>,
        run_id: u64,
        controllers: u32,
    ) -> WorldDriver<S, C, M, A> {
        world.share_out(controllers);
        let ledger = ports.coordination.is_some().then(|| Ledger::new(world.scenario(), controllers));
        WorldDriver {
            world,
            controllers: vec![Seat::default(); controllers as usize],
            coordinators: vec![Seat::default(); ports.coordinator_states.len()],
            ports,
            identity: Identity { run_id, role: Role::World, index: 0, generation: 0 },
            ledger,
            judged: Vec::new(),
            judged_coordination: Vec::new(),
            refusals: Refusals::default(),
            detained: (Vec::new(), Vec::new()),
            suspect: None,
            header: FrameHeader::default(),
            put_in: 0,
            put_in_verdict: 0,
            abandoned: 0,
            observer: None,
            feedbacks: None,
            refused_now: Vec::new(),
            told: Vec::new(),
            published: Vec::new(),
            kept: KeptStep::default(),
            phase: Phase::Publish,
        }
    }

    /// Shows every step to an observer from now on; needs the ledger.
    pub fn observe(&mut self, observer: Box<dyn Observer>) {
        self.observer = Some(observer);
    }

    /// Tells controllers written elsewhere from now on what becomes of their answers.
    pub fn tell(&mut self, feedbacks: Box<dyn Feedbacks>) {
        self.feedbacks = Some(feedbacks);
    }

    /// Keeps the step whose state has been published last, to be shown when it is over; called while others work on
    /// it. Needs the ledger.
    pub fn keep_step(&mut self) {
        let is_over = matches!(self.phase, Phase::Finished);
        self.kept.keep(self.header, self.world.records(), self.world.state_hash(), is_over);
    }

    /// Shows the step that was kept, if there is one and it is over, whose coordination is then all that is in force in
    /// the zones that acted since the last one that was shown; returns whether it did. To be called before the step
    /// after it is over.
    ///
    /// # Errors
    /// The observer's.
    pub fn show_kept(&mut self, observer: &mut dyn Observer) -> Result<bool, TransportError> {
        match &mut self.ledger {
            Some(ledger) if self.kept.is_over() => self.kept.show(ledger, observer).map(|()| true),
            _ => Ok(false),
        }
    }

    /// Makes the step shown next say what is in force in every zone.
    pub fn show_all_in_force(&mut self) {
        self.ledger.iter_mut().for_each(Ledger::untell);
    }

    /// Keeps a ledger that has been begun already, in place of its own.
    pub fn keep(&mut self, ledger: Option<Ledger>) {
        self.ledger = ledger;
    }

    /// Goes on from a recording in whose last step commands were put in: the next state says so, as it would
    /// have without the interruption.
    pub fn go_on_after_miss(&mut self) {
        self.put_in = mask_of(self.controllers.len() as u32);
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
        self.coordinators_acting() != 0
    }

    /// The coordinators that act in the step published last.
    pub fn coordinators_acting(&self) -> u64 {
        self.header.coordinators_acting
    }

    /// Whether the next thing to do is to publish a step's state.
    pub fn is_between_steps(&self) -> bool {
        matches!(self.phase, Phase::Publish)
    }

    /// Whether controllers have to take over anew in this step before they can answer.
    pub fn expects_requests(&self) -> bool {
        self.header.flags & FLAG_MISSED != 0
    }

    /// Goes on without the controllers that have not answered: their vehicles hold what they had, on the
    /// terms of `verdict` (`VERDICT_HELD` or `VERDICT_FALLBACK`). Returns whether that was possible; while a
    /// coordinator is waited for, nobody knows what the controllers would be up against.
    ///
    /// # Errors
    /// When the step cannot be ended.
    pub fn put_in(&mut self, verdict: u16) -> Result<bool, LockstepError> {
        let Phase::Collect(missing) = self.phase else { return Ok(false) };
        if missing.coordination != 0 || self.ledger.is_none() {
            return Ok(false);
        }
        self.put_in_for(missing.commands, PutIn::Held(verdict));
        self.put_in = missing.commands;
        self.put_in_verdict = verdict;
        self.finish_step()?;
        Ok(true)
    }

    /// Puts in commands for these controllers.
    fn put_in_for(&mut self, controllers: u64, put_in: PutIn) {
        let Some(ledger) = &mut self.ledger else { return };
        for index in (0..self.controllers.len()).filter(|i| controllers >> i & 1 == 1) {
            let commands = self.world.substitute(index as u32, ledger.commands_before(index), put_in);
            self.world.put_in(index as u32, &commands).expect(
                "what the world puts in has each of the controller's vehicles once, within its limits",
            );
            ledger.put_in(index, commands);
        }
    }

    /// Goes on without a controller from this step on: its vehicles make for their speed limits, as far as the shield
    /// allows. Nobody was late, so the others have nothing to take over anew. Needs the ledger.
    pub fn abandon(&mut self, controller: u32) {
        self.abandoned |= 1 << controller;
    }

    /// Sends the state of the step at hand once more, for whoever has just taken a place and was not there when it was
    /// sent; to the others it is nothing new.
    ///
    /// # Errors
    /// The transport's.
    pub fn send_state_again(&mut self) -> Result<(), LockstepError> {
        if let Phase::Collect(_) = self.phase {
            let world = &self.world;
            let loan = self.ports.state.loan(self.header, world.record_count(), |slots| {
                world.records().for_each(|record| slots.push(record));
            })?;
            loan.send()?;
        }
        Ok(())
    }

    /// The controllers whose commands of the step at hand have not come, one bit each.
    #[inline]
    pub fn missing_commands(&self) -> u64 {
        if let Phase::Collect(missing) = self.phase { missing.commands } else { 0 }
    }

    /// What the controllers of the run are called.
    pub fn names(&self) -> ControllerNames {
        ControllerNames::new(self.world.scenario(), self.controllers.len() as u32)
    }

    /// What was refused, by sender.
    pub fn refused(&self) -> Vec<RefusedFrames> {
        self.refusals.report(&self.identity, &self.names())
    }

    /// Of how many senders something was refused.
    pub fn refused_senders(&self) -> usize {
        self.refusals.senders()
    }

    /// The number of answers that came too late or twice.
    pub fn late_frames(&self) -> u64 {
        self.refusals.late
    }

    /// Does what can be done now.
    pub fn advance(&mut self) -> Result<Progress, LockstepError> {
        match self.phase {
            Phase::Publish => {
                self.publish()?;
                Ok(Progress::Advanced)
            }
            Phase::Collect(missing) => self.collect(missing),
            Phase::Finished => Ok(Progress::Finished),
        }
    }

    fn publish(&mut self) -> Result<(), LockstepError> {
        let finished = self.world.is_finished();
        let masks = self.world.coordinator_masks();
        let step = self.world.step();
        let put_in = std::mem::take(&mut self.put_in);
        let header = FrameHeader {
            coordinators_acting: masks.acting,
            coordinators_summarised: masks.summarised,
            flags: if finished { FLAG_END_OF_RUN } else { 0 } | if put_in != 0 { FLAG_MISSED } else { 0 },
            ..self.identity.header(step, self.world.time_ns())
        };
        self.tell_feedback(header)?;
        // Coordinators first: theirs is the longer way.
        for (index, outbox) in self.ports.coordinator_states.iter_mut().enumerate() {
            if finished || masks.acting >> index & 1 == 1 {
                let (world, index) = (&self.world, index as u32);
                let loan = outbox.loan(header, world.coordinator_record_count(index), |slots| {
                    world.coordinator_records(index).for_each(|r| slots.push(r));
                })?;
                loan.send()?;
            }
        }
        let world = &mut self.world;
        let count = world.record_count();
        let loan = self.ports.state.loan(header, count, |slots| world.publish(slots))?;
        if self.observer.is_some() {
            self.published.clear();
            self.published.extend_from_slice(loan.records());
        }
        if let Some(ledger) = &mut self.ledger {
            ledger.begin(loan.records(), masks.acting != 0);
        }
        // Whoever does not get it has died, and is missed when its answer is.
        loan.send()?;
        self.header = FrameHeader { record_count: count as u32, ..header };
        self.suspect = None;
        if finished {
            self.show(0)?;
        }
        self.phase = if finished {
            Phase::Finished
        } else {
            let coordination = if self.ledger.is_some() { masks.acting } else { 0 };
            Phase::Collect(Missing { commands: mask_of(self.controllers.len() as u32), coordination })
        };
        Ok(())
    }

    /// Tells controllers written elsewhere what the shield found of their last commands. Before the state, so that whoever has
    /// that has this.
    fn tell_feedback(&mut self, header: FrameHeader) -> Result<(), LockstepError> {
        let Some(feedbacks) = &mut self.feedbacks else { return Ok(()) };
        self.told.clear();
        self.told.extend_from_slice(self.world.feedback());
        self.told.sort_unstable_by_key(|f| (f.controller, f.zone, f.vehicle));
        for part in self.told.chunk_by(|a, b| a.controller == b.controller) {
            feedbacks.tell(part[0].controller, header, part)?;
        }
        self.told.append(&mut self.refused_now);
        Ok(())
    }

    fn collect(&mut self, mut missing: Missing) -> Result<Progress, LockstepError> {
        let mut progress = missing.coordination != 0 && self.take_coordination(&mut missing)?;
        if missing.commands & self.abandoned != 0 && missing.coordination == 0 {
            self.put_in_for(missing.commands & self.abandoned, PutIn::ToLimit);
            missing.commands &= !self.abandoned;
            progress = true;
        }
        if missing.commands != 0 {
            progress |= self.take_command(&mut missing)?;
        }
        self.phase = Phase::Collect(missing);
        if missing.commands == 0 && missing.coordination == 0 {
            self.finish_step()?;
            return Ok(Progress::Advanced);
        }
        Ok(if progress { Progress::Advanced } else { Progress::Waiting(self.awaited(missing)) })
    }

    /// Whom the world waits for: a coordinator before the controllers that wait for it themselves.
    fn awaited(&self, missing: Missing) -> Awaited {
        let step = self.world.step();
        match missing.coordination {
            0 => Awaited { role: Role::Controller, missing: missing.commands, what: "commands", step },
            mask => Awaited { role: Role::Coordinator, missing: mask, what: "coordination", step },
        }
    }

    /// Shows the step to the observer, with the commands of so many controllers.
    fn show(&mut self, controllers: usize) -> Result<(), LockstepError> {
        let (Some(observer), Some(ledger)) = (&mut self.observer, &self.ledger) else { return Ok(()) };
        let zones = self.world.scenario().network.zones.len() as u32;
        let count = self.coordinators.len() as u32;
        let process_of = |zone| (0..count).find(|&i| zones_of(zones, i, count).contains(&zone));
        let between = |s: &&ZoneSummary| process_of(s.from_zone) != process_of(s.to_zone);
        let summaries: Vec<ZoneSummary> = ledger.summaries().iter().filter(between).copied().collect();
        let coordination: Vec<&[Assignment]> = ledger.coordination().iter().map(|(_, a)| &a[..]).collect();
        let commands: Vec<CommandPart<'_>> = self.controllers[..controllers]
            .iter()
            .enumerate()
            .map(|(index, seat)| CommandPart { generation: seat.generation, records: ledger.commands(index) })
            .collect();
        observer.observe(&StepFrames {
            header: self.header,
            state: &self.published,
            summaries: &[&summaries],
            coordination: &coordination,
            commands: &commands,
            feedback: &self.told,
            misses: if controllers == 0 { 0 } else { self.put_in },
            policy: if self.put_in == 0 { POLICY_NONE } else { u32::from(self.put_in_verdict) },
            state_hash: self.world.state_hash(),
        })?;
        Ok(())
    }

    fn finish_step(&mut self) -> Result<(), LockstepError> {
        let step = self.world.step();
        self.show(self.controllers.len())?;
        self.kept.end(&self.controllers, self.put_in, self.put_in_verdict);
        self.world.advance().map_err(|error| LockstepError::World { step, error })?;
        if let Some(ledger) = &mut self.ledger {
            ledger.end();
        }
        self.detained.0.clear();
        self.detained.1.clear();
        self.phase = Phase::Publish;
        Ok(())
    }
}

impl Sheet for Slots<'_, VehicleState> {
    fn push(&mut self, record: VehicleState) {
        self.push(record);
    }

    fn written(&self) -> &[VehicleState] {
        self.written()
    }
}
