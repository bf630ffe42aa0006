//! `cz bench latency`: one step, next to the floor beneath it and to what one would write instead.

use super::PATIENCE;
use super::machine::Machine;
use super::peer::receive;
use super::shared_word::SharedWords;
use super::socket::{Connection, Stream};
use super::step::{Stepped, lead};
use super::waiting::Timed;
use super::{BenchError, io};
use crate::process::{
    Affinity, Outcome, Percentiles, Placement, StopFlag, expected_vehicles, new_histogram, place,
    run_in_process, unplaced,
};
use crate::scenario::Scenario;
use crate::transport::iox::{RunName, RunSpace, ServiceLimits};
use crate::transport::{Backlog, Frame, Loan, Outbox};
use ipc_schemas::{self as frames, Assignment, Role, VehicleCommand, VehicleState};
use serde::Serialize;
use std::hint::black_box;
use std::net::TcpListener;
use std::os::unix::net::UnixListener;
use std::process::Child;
use std::sync::Arc;
use std::time::Instant;

/// What to measure, and how to start the other processes.
pub struct LatencyOptions<'a> {
    /// The scenario whose steps are measured.
    pub scenario: Arc<Scenario>,
    /// Round trips of the floor and of iceoryx2.
    pub round_trips: u64,
    /// Starts this program as the other process of a measurement.
    pub start_peer: &'a dyn Fn(&[String]) -> std::io::Result<Child>,
    /// Runs the scenario in three processes.
    pub run_processes: &'a dyn Fn() -> Result<Outcome, String>,
    /// The same, ready to replace processes and recorded.
    pub run_recorded: &'a dyn Fn() -> Result<Outcome, String>,
}

/// The results; the JSON keys are a contract. All times in ns.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyReport {
    /// Where it was measured.
    pub machine: Machine,
    /// Scenario name.
    pub scenario: String,
    /// Mean number of records in a state frame.
    pub mean_records: f64,
    /// A word of shared memory there and back.
    pub floor_round_trip: Percentiles,
    /// A state frame there and a command frame back over iceoryx2, each written and read, nothing
    /// computed.
    pub iceoryx2_round_trip: Percentiles,
    /// A step with all roles in one process; steps without coordination.
    pub in_process_step: Percentiles,
    /// The same for steps in which the coordinator acts.
    pub in_process_event_step: Percentiles,
    /// A step with three processes; steps without coordination.
    pub steady_step: Percentiles,
    /// The same for steps in which the coordinator acts.
    pub event_step: Percentiles,
    /// A step with two processes, the controller apart from world and coordinator; steps without
    /// coordination.
    pub two_process_step: Percentiles,
    /// The same for steps in which the coordinator acts.
    pub two_process_event_step: Percentiles,
    /// A step (without coordination) with three processes in a run that is recorded and in which processes
    /// may be replaced; a fourth writes the file.
    pub recorded_step: Percentiles,
    /// A step (without coordination) over a unix socket, two processes.
    pub unix_socket_step: Percentiles,
    /// The same over TCP on the loopback interface.
    pub tcp_step: Percentiles,
    /// `steady_step.p50 / (in_process_step.p50 + iceoryx2_round_trip.p50)`.
    pub ratio_to_parts: f64,
    /// `recorded_step.p50 / steady_step.p50`.
    pub ratio_recorded: f64,
    /// `unix_socket_step.p50 / steady_step.p50`.
    pub ratio_unix: f64,
    /// `tcp_step.p50 / steady_step.p50`.
    pub ratio_tcp: f64,
    /// `steady_step.p99 / steady_step.p50`.
    pub ratio_tail: f64,
}

/// Measures everything, one after the other.
pub fn latency(options: &LatencyOptions<'_>) -> Result<LatencyReport, BenchError> {
    let machine = Machine::here();
    let scenario = &options.scenario;
    let affinity = Affinity::current();
    place(Placement::Auto, Role::World, 0);
    let in_process = run_in_process(scenario, 1, 1, &StopFlag::none(), |_| {})?;
    let mean_records = mean_records(scenario)?;
    let floor = floor(options, affinity.as_ref())?;
    let iceoryx2 = iceoryx2(options, affinity.as_ref(), mean_records.round() as usize)?;
    let processes = unplaced(affinity.as_ref(), options.run_processes).map_err(BenchError::Run)?;
    let recorded = unplaced(affinity.as_ref(), options.run_recorded).map_err(BenchError::Run)?;
    let two = iceoryx2_step(scenario, options.start_peer, affinity.as_ref())?;
    let unix = socket_step(options, affinity.as_ref(), SocketKind::Unix)?;
    let tcp = socket_step(options, affinity.as_ref(), SocketKind::Tcp)?;
    for (name, hash) in [
        ("three processes", processes.world.state_hash),
        ("three processes, recorded", recorded.world.state_hash),
        ("two processes", two.state_hash),
        ("unix socket", unix.state_hash),
        ("tcp", tcp.state_hash),
    ] {
        if hash != in_process.world.state_hash {
            let expected = in_process.world.state_hash;
            return Err(BenchError::Disagreement(format!(
                "state hash over {name} is {hash:016x}, in one process {expected:016x}"
            )));
        }
    }
    let (unix, tcp) = (unix.steady, tcp.steady);
    let ratio = |a: u64, b: u64| a as f64 / b.max(1) as f64;
    Ok(LatencyReport {
        machine,
        scenario: scenario.name.clone(),
        mean_records,
        floor_round_trip: floor,
        iceoryx2_round_trip: iceoryx2,
        in_process_step: in_process.steady_ns,
        in_process_event_step: in_process.event_ns,
        steady_step: processes.steady_ns,
        event_step: processes.event_ns,
        two_process_step: two.steady,
        two_process_event_step: two.event,
        recorded_step: recorded.steady_ns,
        ratio_recorded: ratio(recorded.steady_ns.p50, processes.steady_ns.p50),
        unix_socket_step: unix,
        tcp_step: tcp,
        ratio_to_parts: ratio(processes.steady_ns.p50, in_process.steady_ns.p50 + iceoryx2.p50),
        ratio_unix: ratio(unix.p50, processes.steady_ns.p50),
        ratio_tcp: ratio(tcp.p50, processes.steady_ns.p50),
        ratio_tail: ratio(processes.steady_ns.p99, processes.steady_ns.p50),
    })
}

fn mean_records(scenario: &Arc<Scenario>) -> Result<f64, BenchError> {
    let mut run = crate::lockstep::in_process::InProcess::new(scenario, 1, 1);
    let (mut records, mut steps) = (0usize, 0usize);
    while run.step()? {
        records += run.world().record_count();
        steps += 1;
    }
    Ok(records as f64 / steps.max(1) as f64)
}

/// A child that is killed when the measurement does not get to its end.
struct Peer(Child);

impl Drop for Peer {
    fn drop(&mut self) {
        let deadline = Instant::now() + std::time::Duration::from_millis(500);
        while matches!(self.0.try_wait(), Ok(None)) && Instant::now() < deadline {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A run of two processes, each on a core of its own and never asleep.
pub fn two_processes(
    scenario: &Arc<Scenario>,
    start_peer: &dyn Fn(&[String]) -> std::io::Result<Child>,
) -> Result<Timed, BenchError> {
    let affinity = Affinity::current();
    place(Placement::Auto, Role::World, 0);
    let result = iceoryx2_step(scenario, start_peer, affinity.as_ref());
    affinity.iter().for_each(Affinity::restore);
    let Stepped { wall_s, all, steady, event, state_hash } = result?;
    let us = |ns: u64| ns as f64 / 1e3;
    Ok(Timed {
        wall_s,
        p50_us: us(all.p50),
        p99_us: us(all.p99),
        steady_p50_us: Some(us(steady.p50)),
        event_p50_us: Some(us(event.p50)),
        state_hash,
    })
}

fn start(
    start_peer: &dyn Fn(&[String]) -> std::io::Result<Child>,
    affinity: Option<&Affinity>,
    arguments: &[&str],
) -> Result<Peer, BenchError> {
    let arguments: Vec<String> = arguments.iter().map(|&a| a.to_owned()).collect();
    unplaced(affinity, || start_peer(&arguments)).map(Peer).map_err(io("start the other process"))
}

fn floor(options: &LatencyOptions<'_>, affinity: Option<&Affinity>) -> Result<Percentiles, BenchError> {
    let path = std::path::PathBuf::from(format!("/dev/shm/cz_bench_{}", std::process::id()));
    let words = SharedWords::open(&path)?;
    let count = options.round_trips.to_string();
    let result =
        start(options.start_peer, affinity, &["word", &path.to_string_lossy(), &count]).and_then(|_peer| {
            let mut histogram = new_histogram();
            for i in 1..=options.round_trips {
                let start = Instant::now();
                words.round_trip(i)?;
                let _ = histogram.record(start.elapsed().as_nanos() as u64);
            }
            Ok(Percentiles::of(&histogram))
        });
    let _ = std::fs::remove_file(path);
    result
}

fn iceoryx2(
    options: &LatencyOptions<'_>,
    affinity: Option<&Affinity>,
    records: usize,
) -> Result<Percentiles, BenchError> {
    let run = own_run("trip");
    let space = RunSpace::enter(&run)?;
    let limits = ServiceLimits { publishers: 1, subscribers: 1, nodes: 2, backlog: Backlog::STEPS };
    let command = space.create::<VehicleCommand>(frames::SERVICE_COMMAND, limits)?;
    let mut inbox = command.inbox()?;
    let state = space.create::<VehicleState>(frames::SERVICE_STATE, limits)?;
    let mut outbox = state.outbox(records.max(1))?;
    let count = options.round_trips.to_string();
    let _peer = start(options.start_peer, affinity, &["iceoryx2", &run.to_string(), &count])?;
    let mut histogram = new_histogram();
    let record = VehicleState::default();
    let deadline = Instant::now() + PATIENCE;
    let mut done = 0;
    while done <= options.round_trips {
        let start = Instant::now();
        let loan = outbox.loan(frames::FrameHeader::default(), records, |slots| {
            (0..records).for_each(|_| slots.push(record));
        })?;
        let reached = loan.send()?;
        if done == options.round_trips {
            break; // this one only tells the other that it may go
        }
        if reached == 0 {
            if Instant::now() > deadline {
                return Err(BenchError::Peer);
            }
            continue; // it is not there yet
        }
        let frame = receive(&mut inbox)?;
        black_box(frame.records().iter().fold(0.0, |sum, r| sum + r.u_mps2 + f64::from(r.vehicle)));
        drop(frame);
        let _ = histogram.record(start.elapsed().as_nanos() as u64);
        done += 1;
    }
    Ok(Percentiles::of(&histogram))
}

#[derive(Clone, Copy)]
enum SocketKind {
    Unix,
    Tcp,
}

/// World and coordinator here, the controller in another process, frames over a socket.
fn socket_step(
    options: &LatencyOptions<'_>,
    affinity: Option<&Affinity>,
    kind: SocketKind,
) -> Result<Stepped, BenchError> {
    let scenario = &options.scenario;
    let (stream, _peer) = match kind {
        SocketKind::Unix => {
            let path = std::env::temp_dir().join(format!("cz-bench-{}.sock", std::process::id()));
            // The socket is this user's from the first moment.
            let before = rustix::process::umask(rustix::fs::Mode::from_raw_mode(0o077));
            let listener = UnixListener::bind(&path).map_err(io("bind a unix socket"));
            rustix::process::umask(before);
            let listener = listener?;
            let peer = start(options.start_peer, affinity, &["unix", &path.to_string_lossy()]);
            let accepted = peer.and_then(|peer| {
                let (stream, _) = listener.accept().map_err(io("accept"))?;
                Ok((Stream::Unix(stream), peer))
            });
            let _ = std::fs::remove_file(path);
            accepted?
        }
        SocketKind::Tcp => {
            let listener = TcpListener::bind(("127.0.0.1", 0)).map_err(io("bind a TCP socket"))?;
            let port = listener.local_addr().map_err(io("read the port"))?.port();
            let peer = start(options.start_peer, affinity, &["tcp", &port.to_string()])?;
            let (stream, _) = listener.accept().map_err(io("accept"))?;
            stream.set_nodelay(true).map_err(io("configure the socket"))?;
            (Stream::Tcp(stream), peer)
        }
    };
    let connection = Connection::new(stream);
    lead(
        scenario,
        connection.outbox::<VehicleState>(),
        connection.outbox::<Assignment>(),
        connection.inbox::<VehicleCommand>(),
    )
}

/// World and coordinator here, the controller in another process, frames over iceoryx2.
fn iceoryx2_step(
    scenario: &Arc<Scenario>,
    start_peer: &dyn Fn(&[String]) -> std::io::Result<Child>,
    affinity: Option<&Affinity>,
) -> Result<Stepped, BenchError> {
    let run = own_run("step");
    let space = RunSpace::enter(&run)?;
    let limits = ServiceLimits { publishers: 1, subscribers: 1, nodes: 2, backlog: Backlog::STEPS };
    let expected = expected_vehicles(scenario);
    let command = space.create::<VehicleCommand>(frames::SERVICE_COMMAND, limits)?;
    let mut commands = command.inbox()?;
    let coordination = space.create::<Assignment>(frames::SERVICE_COORDINATION, limits)?;
    let state = space.create::<VehicleState>(frames::SERVICE_STATE, limits)?;
    let (state, coordination) = (state.outbox(expected)?, coordination.outbox(2 * expected)?);
    let _peer = start(start_peer, affinity, &["step", &run.to_string()])?;
    // An empty frame says that the other process has opened its ends.
    drop(receive(&mut commands)?);
    lead(scenario, state, coordination, commands)
}

/// A run name nobody else has.
fn own_run(kind: &str) -> RunName {
    format!("bench-{kind}-{}", std::process::id()).parse().expect("letters, dashes and digits are a run name")
}
