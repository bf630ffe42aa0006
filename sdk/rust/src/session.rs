//! One attachment to a run, step by step.

use crate::attach::{self, name};
use crate::space::{Space, failed};
use crate::view::{Run, Step, is_member};
use crate::{Error, Options};
use iceoryx2::node::Node;
use iceoryx2::port::BackpressureAction;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::AllocationStrategy;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::ipc;
use ipc_schemas::{
    self as frames, Assignment, AttachReply, ExpectedHeader, FLAG_END_OF_RUN, FrameHeader, Record, Role,
    VehicleCommand, VehicleState,
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

/// An attachment to a run.
pub struct Session {
    // Ports before the space, so that they are dropped before it.
    pending: Option<Sample<ipc::Service, [VehicleState], FrameHeader>>,
    states: Subscriber<ipc::Service, [VehicleState], FrameHeader>,
    coordination: Subscriber<ipc::Service, [Assignment], FrameHeader>,
    commands: Publisher<ipc::Service, [VehicleCommand], FrameHeader>,
    _line: attach::Line,
    _space: Space,
    run: Run,
    reply: AttachReply,
    next_step: u64,
    /// Coordinators whose frame of this step is still to come.
    missing: u64,
    is_complete: bool,
    /// Coordination in force, by zone.
    assignments: Vec<Vec<Assignment>>,
    /// Places of the vehicles to be commanded in the state frame.
    members: Vec<u32>,
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
        let states = subscriber(node, frames::SERVICE_STATE)?;
        let coordination = subscriber(node, frames::SERVICE_COORDINATION)?;
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
            .set_backpressure_handler(|_| BackpressureAction::DiscardDataAndFail)
            .create()
            .map_err(|e| failed("create a publisher of commands", &e))?;
        line.ready(reply.index)?;
        Ok(Session {
            pending: None,
            states,
            coordination,
            commands,
            _line: line,
            _space: space,
            next_step: reply.first_step,
            missing: 0,
            is_complete: false,
            assignments: vec![Vec::new(); run.spec.zones as usize],
            members: Vec::new(),
            run,
            reply,
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
                if !is_alive(self.reply.world_process_id) {
                    // Its last frame may have come in the meantime.
                    return self.poll()?.ok_or(Error::WorldGone(self.reply.world_process_id));
                }
            }
            if waited >= BUSY {
                std::thread::sleep(NAP);
            }
        }
    }

    fn poll(&mut self) -> Result<Option<Wake>, Error> {
        if self.pending.is_none() {
            let received = self.states.receive().map_err(|e| failed("receive a state frame", &e))?;
            let Some(sample) = received else { return Ok(None) };
            self.check(sample.user_header(), Role::World, sample.payload().len())?;
            if sample.user_header().flags & FLAG_END_OF_RUN != 0 {
                return Ok(Some(Wake::End));
            }
            self.missing = sample.user_header().coordinators_acting;
            self.members.clear();
            let run = &self.run;
            let own = (0..).zip(sample.payload()).filter(|(_, s)| is_member(s) && run.drives(s.zone, s.path));
            self.members.extend(own.map(|(at, _)| at));
            self.pending = Some(sample);
        }
        while self.missing != 0 {
            let received = self.coordination.receive().map_err(|e| failed("receive coordination", &e))?;
            let Some(sample) = received else { return Ok(None) };
            self.check(sample.user_header(), Role::Coordinator, sample.payload().len())?;
            for group in sample.payload().chunk_by(|a, b| a.zone == b.zone) {
                if let Some(list) = self.assignments.get_mut(group[0].zone as usize) {
                    list.clear();
                    list.extend_from_slice(group);
                }
            }
            self.missing &= !1_u64.checked_shl(sample.user_header().sender_index.into()).unwrap_or(0);
        }
        self.is_complete = true;
        Ok(Some(Wake::Step))
    }

    fn check(&self, header: &FrameHeader, role: Role, records: usize) -> Result<(), Error> {
        let index = if role == Role::World { 0 } else { header.sender_index };
        let step = self.next_step;
        ExpectedHeader { run_id: self.reply.run_id, role, index, generation: header.generation, step }
            .check(header, records)
            .map_err(|fault| Error::Frame { step, fault })
    }

    /// Number of vehicles to be commanded in this step.
    pub fn count(&self) -> usize {
        self.members.len()
    }

    /// The step to be answered.
    ///
    /// # Panics
    /// When [`wait`](Self::wait) has not returned [`Wake::Step`].
    pub fn step(&self) -> Step<'_> {
        let sample = self.pending.as_ref().expect("a step is there once wait has returned one");
        Step {
            header: sample.user_header(),
            time_s: sample.user_header().time_ns as f64 * 1e-9,
            states: sample.payload(),
            run: &self.run,
            members: &self.members,
            assignments: &self.assignments,
        }
    }

    /// The coordination in force in a zone.
    pub fn assignments(&self, zone: u32) -> &[Assignment] {
        self.assignments.get(zone as usize).map_or(&[], Vec::as_slice)
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
        let states = state.payload();
        let members = &self.members;
        let mut sample = self
            .commands
            .loan_slice_uninit(count)
            .map_err(|e| failed("lend a command frame; send the one lent before first", &e))?
            .write_from_fn(|i| {
                let Some(&at) = members.get(i) else { return VehicleCommand::default() };
                let VehicleState { vehicle, zone, .. } = states[at as usize];
                VehicleCommand { vehicle, zone, mode: frames::MODE_OCBF, ..VehicleCommand::default() }
            });
        *sample.user_header_mut() = FrameHeader {
            run_id: self.reply.run_id,
            schema_hash: frames::schema_hash(),
            step: self.next_step,
            time_ns: state.user_header().time_ns,
            sender_role: frames::ROLE_CONTROLLER,
            sender_index: self.reply.index as u16,
            generation: self.reply.generation,
            record_count: count as u32,
            ..FrameHeader::default()
        };
        Ok(Commands(sample))
    }

    /// Sends the answer to this step.
    pub fn send(&mut self, commands: Commands) -> Result<(), Error> {
        let reached = commands.0.send().map_err(|e| failed("send commands", &e))?;
        if reached == 0 {
            return Err(Error::WorldGone(self.reply.world_process_id));
        }
        self.pending = None;
        self.is_complete = false;
        self.next_step += 1;
        Ok(())
    }
}

fn subscriber<R: Record>(
    node: &Node<ipc::Service>,
    service: &str,
) -> Result<Subscriber<ipc::Service, [R], FrameHeader>, Error> {
    node.service_builder(&name(service)?)
        .publish_subscribe::<[R]>()
        .user_header::<FrameHeader>()
        .open()
        .map_err(|e| failed(&format!("open {service}"), &e))?
        .subscriber_builder()
        .create()
        .map_err(|e| failed(&format!("subscribe to {service}"), &e))
}

/// Whether a process exists and is not merely waiting to be reaped.
fn is_alive(process_id: u32) -> bool {
    match std::fs::read_to_string(format!("/proc/{process_id}/stat")) {
        Ok(stat) => stat.rsplit(')').next().is_some_and(|rest| !rest.trim_start().starts_with(['Z', 'X'])),
        Err(_) => rustix::process::Pid::from_raw(process_id as i32)
            .is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok()),
    }
}
