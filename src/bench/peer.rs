//! The other process of a two-process measurement; `cz` starts itself in this role.

use super::shared_word::SharedWords;
use super::socket::{Connection, Stream};
use super::step::{CONTROLLER, follow};
use super::{BenchError, PATIENCE, io};
use crate::control::ControllerPool;
use crate::lockstep::{ControllerDriver, ControllerPorts, Members};
use crate::process::{Placement, expected_vehicles, place};
use crate::scenario::Scenario;
use crate::transport::iox::{RunName, RunSpace, SpaceError};
use crate::transport::memory::MemoryInbox;
use crate::transport::{Frame, Inbox, Loan, Outbox};
use ipc_schemas::{self as frames, Assignment, Member, Role, VehicleCommand, VehicleState};
use std::hint::black_box;
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// What the other process is to do, and where.
#[derive(Clone, Debug)]
pub enum PeerKind {
    /// Echo a shared word that many times.
    Word {
        /// File with the word.
        path: String,
        /// Round trips.
        count: u64,
    },
    /// Echo frames over iceoryx2 that many times.
    Iceoryx2 {
        /// Run whose services are used.
        run: RunName,
        /// Round trips.
        count: u64,
    },
    /// Control a scenario's vehicles over iceoryx2.
    Step {
        /// Run whose services are used.
        run: RunName,
    },
    /// Control a scenario's vehicles over a unix socket.
    Unix {
        /// Socket path.
        path: String,
    },
    /// Control a scenario's vehicles over TCP.
    Tcp {
        /// Port on the loopback interface.
        port: u16,
    },
}

/// Runs the other process.
pub fn run_peer(kind: &PeerKind, scenario: &Arc<Scenario>) -> Result<(), BenchError> {
    place(Placement::Auto, Role::Controller, 0);
    match kind {
        PeerKind::Word { path, count } => SharedWords::open(Path::new(path))?.echo(*count),
        PeerKind::Iceoryx2 { run, count } => echo_frames(run, *count),
        PeerKind::Step { run } => control_frames(run, scenario),
        PeerKind::Unix { path } => {
            control(Stream::Unix(UnixStream::connect(path).map_err(io("connect"))?), scenario)
        }
        PeerKind::Tcp { port } => {
            let stream = TcpStream::connect(("127.0.0.1", *port)).map_err(io("connect"))?;
            stream.set_nodelay(true).map_err(io("configure the socket"))?;
            control(Stream::Tcp(stream), scenario)
        }
    }
}

/// Keeps a core busy for as long as the process that started this one lives.
pub fn keep_busy() {
    let parent = rustix::process::getppid();
    let mut sum = 0_u64;
    while rustix::process::getppid() == parent {
        sum = (0..10_000_000).fold(sum, |sum, i| black_box(sum ^ i));
    }
}

fn echo_frames(run: &RunName, count: u64) -> Result<(), BenchError> {
    let space = RunSpace::enter(run)?;
    let deadline = Instant::now() + PATIENCE;
    let state = loop {
        match space.open::<VehicleState>(frames::SERVICE_STATE) {
            Err(SpaceError::NoService { .. }) if Instant::now() < deadline => std::thread::yield_now(),
            other => break other?,
        }
    };
    let mut inbox = state.inbox()?;
    let mut outbox = space.open::<VehicleCommand>(frames::SERVICE_COMMAND)?.outbox(64)?;
    for _ in 0..count {
        let frame = receive(&mut inbox)?;
        let records = frame.records().len();
        // A frame has only arrived once it has been read: its lines move between the cores here.
        black_box(frame.records().iter().fold(0.0, |sum, r| sum + r.x_m + f64::from(r.vehicle)));
        let loan = outbox.loan(*frame.header(), records, |slots| {
            (0..records).for_each(|_| slots.push(VehicleCommand::default()));
        })?;
        loan.send()?;
    }
    // Stay until the last answer has been taken.
    let _ = receive(&mut inbox);
    Ok(())
}

/// Spins until a frame comes.
pub(super) fn receive<I: Inbox<R>, R: frames::Record>(inbox: &mut I) -> Result<I::Frame, BenchError> {
    let mut since = None;
    let mut polls = 0u32;
    loop {
        if let Some(frame) = inbox.receive()? {
            return Ok(frame);
        }
        std::hint::spin_loop();
        polls = polls.wrapping_add(1);
        if polls.is_multiple_of(1 << 16) && since.get_or_insert_with(Instant::now).elapsed() > PATIENCE {
            return Err(BenchError::Peer);
        }
    }
}

fn control(stream: Stream, scenario: &Arc<Scenario>) -> Result<(), BenchError> {
    let connection = Connection::new(stream);
    let ports = ControllerPorts {
        state: connection.inbox::<VehicleState>(),
        coordination: connection.inbox::<Assignment>(),
        command: connection.outbox::<VehicleCommand>(),
        members: Members::<MemoryInbox<Member>>::as_claimed(),
    };
    follow(ControllerDriver::new(pool(scenario), ports, CONTROLLER, 0))
}

/// Controls a scenario's vehicles over iceoryx2.
fn control_frames(run: &RunName, scenario: &Arc<Scenario>) -> Result<(), BenchError> {
    // Everything exists before this process is started.
    let space = RunSpace::enter(run)?;
    let command = space.open(frames::SERVICE_COMMAND)?.outbox(expected_vehicles(scenario))?;
    let mut ports = ControllerPorts {
        state: space.open(frames::SERVICE_STATE)?.inbox()?,
        coordination: space.open(frames::SERVICE_COORDINATION)?.inbox()?,
        command,
        members: Members::<MemoryInbox<Member>>::as_claimed(),
    };
    // This says that the ends are open.
    ports.command.loan(frames::FrameHeader::default(), 0, |_| {})?.send()?;
    follow(ControllerDriver::new(pool(scenario), ports, CONTROLLER, 0))
}

fn pool(scenario: &Arc<Scenario>) -> ControllerPool {
    ControllerPool::new(scenario.clone(), 0..scenario.network.zones.len() as u32)
}
