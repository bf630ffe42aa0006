//! One attachment to a run, step by step.

use crate::attach::{self, name};
use crate::inbox::{Frame, Inbox, Refusal, Refusals, Refused};
use crate::space::{Space, failed};
use crate::view::{Board, Run, Step, Summary};
use crate::{Error, Options};
use iceoryx2::port::BackpressureAction;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::AllocationStrategy;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::ipc;
use ipc_schemas::{
    self as frames, Assignment, AttachReply, ExpectedHeader, FLAG_END_OF_RUN, FLAG_MISSED, Feedback,
    FrameHeader, HeaderFault, Member, Role, VehicleCommand, VehicleState,
};
use std::time::{Duration, Instant};

/// Why [`Session::wait`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wake {
    /// A step is to be answered.
    Step,
    /// Nothing came in time; wait again.
    Timeout,
    /// The run is over.
    End,
}

/// Time spent polling before sleeping between polls.
const BUSY: Duration = Duration::from_millis(2);
const NAP: Duration = Duration::from_micros(100);
const LIFE_CHECK: Duration = Duration::from_millis(50);

/// Time after which an unanswered request is repeated.
const REPEAT: Duration = Duration::from_millis(100);
/// Frames looked at in one go; after that whoever waits looks at its clock.
const AT_ONCE: usize = 16;

/// An attachment to a run.
pub struct Session {
    // Ports before the space, so that they are dropped before it.
    pending: Option<Pending>,
    states: Inbox<VehicleState>,
    coordination: Inbox<Assignment>,
    members: Inbox<Member>,
    feedback: Inbox<Feedback>,
    commands: Publisher<ipc::Service, [VehicleCommand], FrameHeader>,
    line: attach::Line,
    _space: Space,
    run: Run,
    reply: AttachReply,
    /// The sending ends that have proved to be the world's: of states, of who has which place, and of feedback.
    world_origins: [Option<u128>; 3],
    coordinators: Vec<Seat>,
    /// The first step whose coordination is not in force yet.
    next_step: u64,
    /// Behind the last step that has been answered: a state may come again, for somebody who has just joined.
    open_from: u64,
    /// When to ask again for what was missed, while that has not come.
    ask_again_at: Option<Instant>,
    is_complete: bool,
    board: Board,
    refusals: Refusals,
    /// Accelerations of the last answer, by vehicle, ascending.
    commanded: Vec<(u32, f64)>,
    /// What the shield found of commands, by vehicle, ascending.
    bounded: Vec<Feedback>,
    /// Answers that were refused since the last one.
    told_refusals: Vec<Feedback>,
    summary: Summary,
}

/// A coordinator, as the world says.
#[derive(Clone, Copy, Default)]
struct Seat {
    process_id: u32,
    generation: u32,
    /// The sending end that has proved to be that process's.
    origin: Option<u128>,
}

/// A state to be answered.
struct Pending {
    frame: Frame<VehicleState>,
    /// As it was when it was judged.
    header: FrameHeader,
    /// Coordinators whose frame of this step is still to come.
    missing: u64,
}

/// A command frame being written in shared memory; vehicles and zones are filled in.
pub struct Commands(SampleMut<ipc::Service, [VehicleCommand], FrameHeader>);

impl Commands {
    /// The records, in the order of [`Step::vehicles`].
    pub fn records_mut(&mut self) -> &mut [VehicleCommand] {
        self.0.payload_mut()
    }

    /// The header, filled in.
    pub fn header_mut(&mut self) -> &mut FrameHeader {
        self.0.user_header_mut()
    }
}

impl Session {
    /// Joins a run. Once this returns, the world counts on an answer to every step.
    pub fn attach(options: &Options) -> Result<Session, Error> {
        let (space, line, reply, run) = attach::join(options)?;
        let node = space.node();
        let states = Inbox::open(node, frames::SERVICE_STATE)?;
        let coordination = Inbox::open(node, frames::SERVICE_COORDINATION)?;
        let members = Inbox::open(node, frames::SERVICE_MEMBERS)?;
        let feedback = Inbox::open(node, &format!("{}{}", frames::SERVICE_FEEDBACK_PREFIX, reply.index))?;
        let commands = node
            .service_builder(&name(frames::SERVICE_COMMAND)?)
            .publish_subscribe::<[VehicleCommand]>()
            .user_header::<FrameHeader>()
            .open()
            .map_err(|e| failed("open the command service", &e))?
            .publisher_builder()
            .max_loaned_samples(1)
            .initial_max_slice_len(64)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            // A world that has gone on may have no room for late answers, and does not want them.
            .set_backpressure_handler(|_| BackpressureAction::DiscardData)
            .create()
            .map_err(|e| failed("create a publisher of commands", &e))?;
        let (next_step, in_force) = line.ready(reply.index)?;
        let mut board = Board::new(run.spec.zones);
        board.restore(&in_force);
        Ok(Session {
            pending: None,
            states,
            coordination,
            members,
            feedback,
            commands,
            line,
            _space: space,
            next_step,
            open_from: 0,
            ask_again_at: None,
            is_complete: false,
            board,
            refusals: Refusals::default(),
            commanded: Vec::new(),
            bounded: Vec::new(),
            told_refusals: Vec::new(),
            summary: Summary::default(),
            run,
            reply,
            world_origins: [None; 3],
            coordinators: Vec::new(),
        })
    }

    /// The run's numbers.
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// Waits for the next step, or for the end of the run.
    pub fn wait(&mut self, timeout: Duration) -> Result<Wake, Error> {
        if self.is_complete {
            return Ok(Wake::Step);
        }
        let start = Instant::now();
        let mut checked = Duration::ZERO;
        loop {
            // The clock costs as much as a poll.
            for _ in 0..32 {
                if let Some(wake) = self.poll()? {
                    return Ok(wake);
                }
                std::thread::yield_now();
            }
            let waited = start.elapsed();
            if waited >= timeout {
                return Ok(Wake::Timeout);
            }
            if waited >= checked + LIFE_CHECK {
                checked = waited;
                // Of a world that has ended nothing more can be had.
                self.take_feedback()?;
                if !is_alive(self.reply.world_process_id) {
                    // Its last frame may have come in the meantime.
                    return self.poll()?.ok_or_else(|| self.world_gone());
                }
            }
            if waited >= BUSY {
                std::thread::sleep(NAP);
            }
        }
    }

    /// Does what can be done now.
    fn poll(&mut self) -> Result<Option<Wake>, Error> {
        if self.ask_again_at.is_some() {
            self.take_reply()?;
        }
        if self.take_states()? {
            return Ok(Some(Wake::End));
        }
        let Some(step) = self.pending.as_ref().map(|state| state.header.step) else { return Ok(None) };
        if step > self.next_step {
            // Steps have passed without this controller, and with them perhaps coordination.
            self.catch_up()?;
            return Ok(None);
        }
        if step == self.next_step {
            self.take_coordination()?;
        }
        let Some(state) = self.pending.as_ref() else { return Ok(None) };
        if step == self.next_step && state.missing != 0 {
            return Ok(None);
        }
        // Otherwise its coordination is in force already.
        self.next_step = self.next_step.max(step.saturating_add(1));
        let header = state.header;
        if self.summary.answered > 0 {
            self.summary.skipped += header.step.saturating_sub(self.open_from);
        }
        self.saw(&header);
        self.take_feedback()?;
        self.bounded.retain(|f| f.step.saturating_add(1) >= header.step);
        let Some(state) = self.pending.as_ref() else { return Ok(None) };
        self.board.muster(&self.run, state.frame.payload());
        self.is_complete = true;
        Ok(Some(Wake::Step))
    }

    /// Takes the newest state; an older one would be answered too late. Returns whether the run is over.
    fn take_states(&mut self) -> Result<bool, Error> {
        for _ in 0..AT_ONCE {
            let Some(frame) = self.states.receive()? else { break };
            // What is judged here is what is used: whoever wrote it could change it still.
            let header = *frame.user_header();
            let origin = frame.origin().value();
            if let Err(refusal) = self.judge_state(&header, origin, frame.payload().len()) {
                let states = &self.states;
                self.refusals.enter(&header, origin, refusal, || states.process_of(origin));
                continue;
            }
            if header.flags & FLAG_END_OF_RUN != 0 {
                self.saw(&header);
                return Ok(true);
            }
            // The same may come again, when of its coordination some has been taken.
            let is_newer = self.pending.as_ref().is_none_or(|state| header.step > state.header.step);
            // Of the step before the next one, the coordination is known: it may still be answered.
            if is_newer && header.step >= self.open_from && header.step.saturating_add(1) >= self.next_step {
                self.pending = Some(Pending { frame, header, missing: header.coordinators_acting });
            }
        }
        let is_of_the_past = |state: &Pending| state.header.step.saturating_add(1) < self.next_step;
        if self.pending.as_ref().is_some_and(is_of_the_past) {
            self.pending = None;
        }
        Ok(false)
    }

    /// Notes a state for the summary.
    fn saw(&mut self, header: &FrameHeader) {
        self.summary.step = header.step;
        self.summary.time_s = header.time_ns as f64 * 1e-9;
        self.summary.missed += u64::from(header.flags & FLAG_MISSED != 0);
    }

    fn judge_state(&mut self, header: &FrameHeader, origin: u128, records: usize) -> Result<(), Refusal> {
        let AttachReply { run_id, world_process_id: expected, .. } = self.reply;
        ExpectedHeader { run_id, role: Role::World, index: 0, generation: 0, step: header.step }
            .check(header, records)?;
        let [known, ..] = &mut self.world_origins;
        prove(known, origin, expected, || self.states.process_of(origin))
    }

    /// Takes what the world has said of who has which place. It says so before whoever takes a place can send.
    fn listen(&mut self) -> Result<(), Error> {
        for _ in 0..AT_ONCE {
            let Some(frame) = self.members.receive()? else { break };
            let header = *frame.user_header();
            let told = frame.payload().to_vec();
            let origin = frame.origin().value();
            drop(frame);
            if let Err(refusal) = self.judge_members(&header, origin, told.len()) {
                let members = &self.members;
                self.refusals.enter(&header, origin, refusal, || members.process_of(origin));
                continue;
            }
            for Member { process_id, generation, role, index } in told {
                if role != frames::ROLE_COORDINATOR || index >= 64 {
                    continue;
                }
                let index = usize::from(index);
                self.coordinators.resize(self.coordinators.len().max(index + 1), Seat::default());
                let seat = &mut self.coordinators[index];
                if (seat.process_id, seat.generation) != (process_id, generation) {
                    *seat = Seat { process_id, generation, origin: None };
                }
            }
        }
        Ok(())
    }

    fn judge_members(&mut self, header: &FrameHeader, origin: u128, records: usize) -> Result<(), Refusal> {
        let AttachReply { run_id, world_process_id: expected, .. } = self.reply;
        ExpectedHeader { run_id, role: Role::World, index: 0, generation: 0, step: header.step }
            .check(header, records)?;
        let [_, known, _] = &mut self.world_origins;
        prove(known, origin, expected, || self.members.process_of(origin))
    }

    /// Takes what the world has said of the answers; what it said of the last one came before the state that followed.
    fn take_feedback(&mut self) -> Result<(), Error> {
        for _ in 0..AT_ONCE {
            let Some(frame) = self.feedback.receive()? else { break };
            let header = *frame.user_header();
            let told = frame.payload().to_vec();
            let origin = frame.origin().value();
            drop(frame);
            if let Err(refusal) = self.judge_feedback(&header, origin, told.len()) {
                let feedback = &self.feedback;
                self.refusals.enter(&header, origin, refusal, || feedback.process_of(origin));
                continue;
            }
            for told in told {
                if told.rule == frames::RULE_NONE {
                    self.bounded.push(told);
                } else {
                    self.summary.refused += 1;
                    self.told_refusals.push(told);
                }
            }
        }
        self.bounded.sort_unstable_by_key(|f| (f.step, f.vehicle));
        Ok(())
    }

    fn judge_feedback(&mut self, header: &FrameHeader, origin: u128, records: usize) -> Result<(), Refusal> {
        let AttachReply { run_id, world_process_id: expected, .. } = self.reply;
        ExpectedHeader { run_id, role: Role::World, index: 0, generation: 0, step: header.step }
            .check(header, records)?;
        let [.., known] = &mut self.world_origins;
        prove(known, origin, expected, || self.feedback.process_of(origin))
    }

    /// Why a run is over that has had no end.
    fn world_gone(&self) -> Error {
        let process_id = self.reply.world_process_id;
        match self.told_refusals.last() {
            Some(refusal) => Error::AnswerRefused { process_id, refusal: *refusal },
            None => Error::WorldGone(process_id),
        }
    }

    /// Takes coordination of the step at hand, as far as it has come.
    fn take_coordination(&mut self) -> Result<(), Error> {
        for _ in 0..AT_ONCE {
            if self.pending.as_ref().is_none_or(|state| state.missing == 0) {
                break;
            }
            let Some(frame) = self.coordination.receive()? else { break };
            let header = *frame.user_header();
            // Copied before it is judged.
            let assignments = frame.payload().to_vec();
            let origin = frame.origin().value();
            drop(frame);
            let index = usize::from(header.sender_index);
            if self.coordinators.get(index).is_none_or(|seat| seat.origin != Some(origin)) {
                self.listen()?;
            }
            match self.judge_coordination(&header, origin, &assignments) {
                Ok(true) => {
                    self.board.coordinate(&assignments);
                    if let Some(state) = &mut self.pending {
                        state.missing &= !(1 << header.sender_index);
                    }
                }
                Ok(false) => {}
                Err(refusal) => {
                    let coordination = &self.coordination;
                    self.refusals.enter(&header, origin, refusal, || coordination.process_of(origin));
                }
            }
        }
        Ok(())
    }

    /// Whether a coordination frame is to be taken, and not merely late or of a step to come.
    fn judge_coordination(
        &mut self,
        header: &FrameHeader,
        origin: u128,
        assignments: &[Assignment],
    ) -> Result<bool, Refusal> {
        let AttachReply { run_id, coordinators, .. } = self.reply;
        let index = header.sender_index;
        let seat = self.coordinators.get_mut(usize::from(index));
        let generation = seat.as_ref().map_or(0, |seat| seat.generation);
        match (ExpectedHeader { run_id, role: Role::Coordinator, index, generation, step: header.step })
            .check(header, assignments.len())
        {
            // What a coordinator that has died left; its successor sends the same again.
            Err(HeaderFault::OldGeneration { .. }) => return Ok(false),
            checked => checked?,
        }
        let Some(seat) = seat else { return Err(Refusal::NoSuchCoordinator { coordinators }) };
        if seat.origin != Some(origin) {
            match self.coordination.process_of(origin) {
                None => return Ok(false),
                process => prove(&mut seat.origin, origin, seat.process_id, || process)?,
            }
        }
        if let Some(record) = assignments.iter().position(|a| a.zone >= self.run.spec.zones) {
            return Err(Refusal::NoSuchZone { record, zone: assignments[record].zone });
        }
        let missing = self.pending.as_ref().map_or(0, |state| state.missing);
        Ok(header.step == self.next_step && missing >> index & 1 == 1)
    }

    /// Asks for the coordination in force, and again while no answer comes.
    fn catch_up(&mut self) -> Result<(), Error> {
        let now = Instant::now();
        match self.ask_again_at {
            Some(at) if now < at => return Ok(()),
            Some(_) => {}
            // What lies here is older than what the answer will say; it would only be in the way.
            None => {
                for _ in 0..AT_ONCE {
                    if self.coordination.receive()?.is_none() {
                        break;
                    }
                }
                while self.line.reply()?.is_some() {}
            }
        }
        self.line.catch_up(self.reply.index)?;
        self.ask_again_at = Some(now + REPEAT);
        Ok(())
    }

    fn take_reply(&mut self) -> Result<(), Error> {
        if let Some((next_step, in_force)) = self.line.caught_up()? {
            self.ask_again_at = None;
            self.next_step = next_step;
            self.board.restore(&in_force);
        }
        Ok(())
    }

    /// Number of vehicles to be commanded in this step.
    pub fn count(&self) -> usize {
        self.board.count()
    }

    /// The step to be answered.
    ///
    /// # Panics
    /// When [`wait`](Self::wait) has not returned [`Wake::Step`].
    pub fn step(&self) -> Step<'_> {
        let state = self.pending.as_ref().filter(|_| self.is_complete);
        let state = state.expect("a step is there once wait has returned one");
        Step {
            header: &state.header,
            time_s: state.header.time_ns as f64 * 1e-9,
            states: state.frame.payload(),
            missed: state.header.flags & FLAG_MISSED != 0,
            skipped: match self.summary.answered {
                0 => 0,
                _ => state.header.step.saturating_sub(self.open_from),
            },
            // Of an older answer nothing says what was applied.
            commanded: if state.header.step == self.open_from { &self.commanded } else { &[] },
            bounded: if state.header.step == self.open_from {
                self.bounded_before(state.header.step)
            } else {
                &[]
            },
            refusals: &self.told_refusals,
            run: &self.run,
            board: &self.board,
        }
    }

    /// What the shield found of the commands before a step.
    fn bounded_before(&self, step: u64) -> &[Feedback] {
        let is_older = |f: &Feedback| f.step.saturating_add(1) < step;
        let from = self.bounded.partition_point(is_older);
        let count = self.bounded[from..].partition_point(|f| f.step.saturating_add(1) == step);
        &self.bounded[from..from + count]
    }

    /// What the run has been so far, as this controller saw it.
    pub fn summary(&self) -> Summary {
        self.summary
    }

    /// The coordination in force in a zone.
    pub fn assignments(&self, zone: u32) -> &[Assignment] {
        self.board.assignments(zone)
    }

    /// What was refused so far, by sender.
    pub fn refused(&self) -> Vec<Refused> {
        self.refusals.report()
    }

    /// Lends a command frame with header, vehicles and zones filled in and accelerations of 0.
    pub fn take_commands(&mut self) -> Result<Commands, Error> {
        self.lend(self.count())
    }

    /// The same with another number of records, for tests of those who check frames.
    #[doc(hidden)]
    pub fn lend(&mut self, count: usize) -> Result<Commands, Error> {
        let Some(state) = self.pending.as_ref().filter(|_| self.is_complete) else {
            return Err(Error::OutOfTurn("there is no step to answer; wait for one first"));
        };
        let (states, board) = (state.frame.payload(), &self.board);
        let mut sample = self
            .commands
            .loan_slice_uninit(count)
            .map_err(|e| failed("lend a command frame; send the one lent before first", &e))?
            .write_from_fn(|i| {
                let Some((vehicle, zone)) = board.named(states, i) else { return VehicleCommand::default() };
                VehicleCommand { vehicle, zone, mode: frames::MODE_OCBF, ..VehicleCommand::default() }
            });
        *sample.user_header_mut() = FrameHeader {
            run_id: self.reply.run_id,
            schema_hash: frames::schema_hash(),
            step: state.header.step,
            time_ns: state.header.time_ns,
            sender_role: frames::ROLE_CONTROLLER,
            sender_index: self.reply.index as u16,
            generation: self.reply.generation,
            record_count: count as u32,
            ..FrameHeader::default()
        };
        Ok(Commands(sample))
    }

    /// Sends the answer to this step. One that comes too late is dropped: the next step is another chance.
    pub fn send(&mut self, commands: Commands) -> Result<(), Error> {
        self.commanded.clear();
        self.commanded.extend(commands.0.payload().iter().map(|c| (c.vehicle, c.u_mps2)));
        self.commanded.sort_unstable_by_key(|(vehicle, _)| *vehicle);
        let reached = commands.0.send().map_err(|e| failed("send commands", &e))?;
        // Nobody has room for an answer that is too late, and nobody is there once the world has gone.
        if reached == 0 && !is_alive(self.reply.world_process_id) {
            return Err(self.world_gone());
        }
        self.told_refusals.clear();
        self.summary.answered += 1;
        self.open_from = self.pending.as_ref().map_or(0, |state| state.header.step.saturating_add(1));
        self.pending = None;
        self.is_complete = false;
        Ok(())
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // There is no summary in which it could stand.
        self.refused().iter().for_each(|refused| eprintln!("{refused}"));
    }
}

/// Notes the sending end of the process expected, unless it is known to be that of another.
fn prove(
    known: &mut Option<u128>,
    origin: u128,
    expected: u32,
    process: impl FnOnce() -> Option<u32>,
) -> Result<(), Refusal> {
    if *known != Some(origin) {
        if process().is_some_and(|process| process != expected) {
            return Err(Refusal::Stranger { expected });
        }
        *known = Some(origin);
    }
    Ok(())
}

/// Whether a process exists and is not merely waiting to be reaped.
fn is_alive(process_id: u32) -> bool {
    match std::fs::read_to_string(format!("/proc/{process_id}/stat")) {
        Ok(stat) => stat.rsplit(')').next().is_some_and(|rest| !rest.trim_start().starts_with(['Z', 'X'])),
        Err(_) => rustix::process::Pid::from_raw(process_id as i32)
            .is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok()),
    }
}
