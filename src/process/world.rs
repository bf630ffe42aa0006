//! The world process.

use super::attach::Reception;
use super::placement::number_of_cores;
use super::{Patience, ProcessError, Settled, Settling, StopFlag, WaitMode, Waiter};
use crate::lockstep::in_process::InProcess;
use crate::lockstep::{Progress, WorldDriver, WorldPorts};
use crate::scenario::Scenario;
use crate::scenario::share::neighbour_coordinators;
use crate::transport::iox::{BellRope, BellService, RunName, RunSpace, Service, ServiceLimits, SpaceError};
use crate::world::{World, WorldSummary};
use hdrhistogram::Histogram;
use ipc_schemas::{self as frames, Assignment, Role, VehicleCommand, VehicleState, ZoneSummary};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How a world process is to run.
#[derive(Clone, Debug)]
pub struct WorldOptions {
    /// Run name.
    pub run: RunName,
    /// Number of coordinator processes.
    pub coordinators: u32,
    /// Number of controller processes.
    pub controllers: u32,
    /// How long to wait for participants at the start.
    pub attach_timeout: Duration,
    /// How long to wait for a frame.
    pub peer_timeout: Duration,
    /// How the processes of the run wait.
    pub wait: WaitMode,
}

/// Percentiles of the time a step takes, from the state's publication to the end of integration, us.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LatencyUs {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// 99.9th percentile.
    pub p999: f64,
    /// Greatest.
    pub max: f64,
}

/// What a finished run has come to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// The world's results.
    pub world: WorldSummary,
    /// Wall time of the stepping, s.
    pub wall_s: f64,
    /// Step latency.
    pub step_latency_us: LatencyUs,
    /// Latency of steps in which no coordinator acted, after a warm-up.
    pub steady_ns: Percentiles,
    /// Latency of steps in which one did, after a warm-up.
    pub event_ns: Percentiles,
    /// Peak resident memory of the process, bytes (0 where it cannot be known).
    pub peak_rss_bytes: u64,
    /// Where each process was and what it was granted; filled in by who started them.
    #[serde(default)]
    pub placement: Vec<Settled>,
}

/// Peak resident memory of this process, bytes.
fn peak_rss_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kib =
        status.lines().find_map(|l| l.strip_prefix("VmHWM:")?.trim().strip_suffix("kB")?.trim().parse().ok());
    kib.map_or(0, |kib: u64| kib * 1024)
}

/// Percentiles of a measured time, ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Percentiles {
    /// Median.
    pub p50: u64,
    /// 90th percentile.
    pub p90: u64,
    /// 99th percentile.
    pub p99: u64,
    /// 99.9th percentile.
    pub p999: u64,
    /// Greatest.
    pub max: u64,
    /// Number of measurements.
    pub count: u64,
}

impl Percentiles {
    /// Of a histogram.
    pub fn of(histogram: &Histogram<u64>) -> Percentiles {
        let at = |quantile| histogram.value_at_quantile(quantile);
        Percentiles {
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p999: at(0.999),
            max: histogram.max(),
            count: histogram.len(),
        }
    }
}

/// An empty latency histogram of three significant digits that grows as needed.
pub fn new_histogram() -> Histogram<u64> {
    let mut histogram = Histogram::new_with_bounds(1, AT_FIRST_NS, 3).expect("the bounds are valid");
    histogram.auto(true);
    // Writes to all of it, so that no page of it is missing when time is measured.
    histogram.clear();
    histogram
}

/// What a histogram has room for from the beginning, ns: a second.
const AT_FIRST_NS: u64 = 1_000_000_000;

/// Steps before the steady and event latencies are recorded: memory is mapped and caches fill.
pub const WARM_UP_STEPS: u64 = 500;

/// Steps between two looks at the signal flag and the clock for progress.
const STEPS_PER_LOOK: u64 = 64;

/// Measures steps and decides when to report progress.
#[derive(Debug)]
struct StepMeter {
    latency_ns: Histogram<u64>,
    steady_ns: Histogram<u64>,
    event_ns: Histogram<u64>,
    start: Instant,
    step_start: Instant,
}

impl StepMeter {
    fn start() -> StepMeter {
        let now = Instant::now();
        StepMeter {
            latency_ns: new_histogram(),
            steady_ns: new_histogram(),
            event_ns: new_histogram(),
            start: now,
            step_start: now,
        }
    }

    fn step_done(&mut self, was_event: bool) {
        let now = Instant::now();
        let ns = (now - self.step_start).as_nanos() as u64;
        // The histograms resize themselves; only an absurd latency could not be recorded.
        let _ = self.latency_ns.record(ns);
        if self.latency_ns.len() > WARM_UP_STEPS {
            let _ = if was_event { &mut self.event_ns } else { &mut self.steady_ns }.record(ns);
        }
        self.step_start = now;
    }

    fn outcome(&self, world: &World) -> Outcome {
        let us = |ns: u64| ns as f64 / 1e3;
        Outcome {
            world: world.summary(),
            wall_s: self.start.elapsed().as_secs_f64(),
            step_latency_us: LatencyUs {
                p50: us(self.latency_ns.value_at_quantile(0.5)),
                p99: us(self.latency_ns.value_at_quantile(0.99)),
                p999: us(self.latency_ns.value_at_quantile(0.999)),
                max: us(self.latency_ns.max()),
            },
            steady_ns: Percentiles::of(&self.steady_ns),
            event_ns: Percentiles::of(&self.event_ns),
            peak_rss_bytes: peak_rss_bytes(),
            placement: Vec::new(),
        }
    }
}

/// Refuses to spin with more processes than cores.
pub fn check_cores(processes: usize) -> Result<(), ProcessError> {
    let cores = number_of_cores();
    if processes > cores { Err(ProcessError::TooFewCores { processes, cores }) } else { Ok(()) }
}

/// Runs the world of a multi-process run to its end; `progress` is called now and then.
pub fn run_world(
    scenario: &Arc<Scenario>,
    options: &WorldOptions,
    settling: &Settling<'_>,
    stop: &StopFlag,
    mut progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    let WorldOptions { coordinators, controllers, wait, .. } = *options;
    if wait == WaitMode::Spin {
        check_cores(1 + (coordinators + controllers) as usize)?;
    }
    let held = settling.settle(Role::World, 0, wait, wait.hot_processes(coordinators, controllers));
    let space = RunSpace::enter(&options.run)?;
    let mut run_id = [0u8; 8];
    if rustix::rand::getrandom(&mut run_id, rustix::rand::GetRandomFlags::NONBLOCK).is_err() {
        run_id = u64::from(std::process::id()).to_le_bytes();
    }
    let run_id = u64::from_le_bytes(run_id);
    let active = |error| match error {
        SpaceError::Exists { .. } => ProcessError::AlreadyActive { run: options.run.to_string() },
        other => other.into(),
    };
    // The desk last: once it exists, everything else does.
    let services = Services::create(&space, scenario, coordinators, controllers).map_err(active)?;
    let _bells = create_bells(&space, wait, coordinators, controllers)?;
    // Plug-ins ring no bells: with one in the run, the world polls.
    let rung = wait.has_bell(Role::World) && scenario.plugins.is_empty();
    let bell = rung.then(|| space.bell(frames::BELL_WORLD)).flatten();
    let mut reception =
        Reception::open(&space, scenario, run_id, (coordinators, controllers), wait).map_err(active)?;
    receive_all(&mut reception, options, stop)?;
    // Bells are hung up by now, so that the ropes hold.
    let ports = services.world_ports(&space, scenario, wait)?;

    let world = World::new(scenario.clone(), coordinators);
    let mut driver = WorldDriver::new(world, ports, run_id, controllers);
    let patience = Patience::of(wait, Role::World, 1 + controllers as usize, options.peer_timeout);
    let mut waiter = Waiter::new(patience, bell, stop.clone(), reception.peers());
    // Declared last, so let go first.
    let _held = held;
    let mut meter = StepMeter::start();
    let mut step = 0;
    loop {
        match driver.advance().map_err(|error| waiter.explain(error))? {
            Progress::Finished => return Ok(meter.outcome(driver.world())),
            Progress::Waiting(awaited) => waiter.wait(awaited)?,
            Progress::Advanced => {
                waiter.reset();
                if driver.world().step() != step {
                    step = driver.world().step();
                    meter.step_done(driver.was_event());
                    if step.is_multiple_of(STEPS_PER_LOOK) {
                        progress(driver.world());
                        if stop.is_set() {
                            return Err(ProcessError::Interrupted { step: Some(step) });
                        }
                    }
                }
            }
        }
    }
}

/// Runs a whole run in this process.
pub fn run_in_process(
    scenario: &Arc<Scenario>,
    coordinators: u32,
    controllers: u32,
    stop: &StopFlag,
    mut progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    let mut run = InProcess::new(scenario, coordinators, controllers);
    let mut meter = StepMeter::start();
    while run.step()? {
        meter.step_done(run.was_event());
        let step = run.world().step();
        if step.is_multiple_of(STEPS_PER_LOOK) {
            progress(run.world());
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
            }
        }
    }
    Ok(meter.outcome(run.world()))
}

/// Waits until all participants are ready.
fn receive_all(
    reception: &mut Reception,
    options: &WorldOptions,
    stop: &StopFlag,
) -> Result<(), ProcessError> {
    let deadline = Instant::now() + options.attach_timeout;
    loop {
        reception.serve()?;
        let Some((role, index)) = reception.first_missing() else { return Ok(()) };
        if stop.is_set() {
            return Err(ProcessError::Interrupted { step: None });
        }
        if Instant::now() >= deadline {
            return Err(ProcessError::Missing {
                run: options.run.to_string(),
                missing: reception.name_of(role, index),
                command: if role == Role::Coordinator { "cz-coord" } else { "cz-ctrl" },
                seconds: options.attach_timeout.as_secs_f64(),
            });
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// All frame services of a run, created by its world and kept open by it.
#[derive(Debug)]
struct Services {
    state: Service<VehicleState>,
    coordinator_states: Vec<Service<VehicleState>>,
    command: Service<VehicleCommand>,
    _coordination: Service<Assignment>,
    _summaries: Vec<Service<ZoneSummary>>,
    controllers: u32,
}

impl Services {
    fn create(
        space: &RunSpace,
        scenario: &Scenario,
        coordinators: u32,
        controllers: u32,
    ) -> Result<Services, SpaceError> {
        let (m, n) = (coordinators as usize, controllers as usize);
        let limits = |publishers, subscribers| ServiceLimits { publishers, subscribers, nodes: 1 + m + n };
        let masks = neighbour_coordinators(&scenario.network, coordinators);
        Ok(Services {
            controllers,
            state: space.create(frames::SERVICE_STATE, limits(1, n))?,
            coordinator_states: (0..m)
                .map(|i| {
                    let name = format!("{}{i}", frames::SERVICE_COORDINATOR_STATE_PREFIX);
                    space.create(&name, limits(1, 1))
                })
                .collect::<Result<_, _>>()?,
            command: space.create(frames::SERVICE_COMMAND, limits(n, 1))?,
            _coordination: space.create(frames::SERVICE_COORDINATION, limits(m, n))?,
            _summaries: (0..m)
                .map(|i| {
                    let name = format!("{}{i}", frames::SERVICE_SUMMARY_PREFIX);
                    space.create(&name, limits((masks[i].count_ones() as usize).max(1), 1))
                })
                .collect::<Result<_, _>>()?,
        })
    }

    #[allow(clippy::type_complexity)] // the port types are named nowhere else
    fn world_ports(
        &self,
        space: &RunSpace,
        scenario: &Scenario,
        wait: WaitMode,
    ) -> Result<
        WorldPorts<
            crate::transport::iox::IoxOutbox<VehicleState>,
            crate::transport::iox::IoxOutbox<VehicleState>,
            crate::transport::iox::IoxInbox<VehicleCommand>,
        >,
        SpaceError,
    > {
        let expected = expected_vehicles(scenario);
        Ok(WorldPorts {
            state: self.state.outbox(expected)?.ringing(controller_ropes(space, wait, self.controllers)),
            coordinator_states: self
                .coordinator_states
                .iter()
                .zip(0..)
                .map(|(s, i)| Ok(s.outbox(expected)?.ringing(coordinator_rope(space, wait, i))))
                .collect::<Result<_, SpaceError>>()?,
            command: self.command.inbox()?,
        })
    }
}

/// Creates the bells of all who sleep under this mode.
fn create_bells(
    space: &RunSpace,
    wait: WaitMode,
    coordinators: u32,
    controllers: u32,
) -> Result<Vec<BellService>, SpaceError> {
    let (m, n) = (coordinators as usize, controllers as usize);
    let mut bells = Vec::new();
    if wait.has_bell(Role::World) {
        bells.push(space.create_bell(frames::BELL_WORLD, n)?);
    }
    if wait.has_bell(Role::Coordinator) {
        for i in 0..coordinators {
            bells.push(space.create_bell(&format!("{}{i}", frames::BELL_COORDINATOR_PREFIX), m)?);
        }
    }
    if wait.has_bell(Role::Controller) {
        for i in 0..controllers {
            bells.push(space.create_bell(&format!("{}{i}", frames::BELL_CONTROLLER_PREFIX), 1 + m)?);
        }
    }
    Ok(bells)
}

/// The ropes of all controllers' bells, when they have any.
pub(super) fn controller_ropes(space: &RunSpace, wait: WaitMode, controllers: u32) -> Vec<BellRope> {
    let count = if wait.has_bell(Role::Controller) { controllers } else { 0 };
    (0..count).filter_map(|i| space.bell_rope(&format!("{}{i}", frames::BELL_CONTROLLER_PREFIX))).collect()
}

/// The rope of a coordinator's bell, when it has one.
pub(super) fn coordinator_rope(space: &RunSpace, wait: WaitMode, index: u32) -> Option<BellRope> {
    let rope = || space.bell_rope(&format!("{}{index}", frames::BELL_COORDINATOR_PREFIX));
    wait.has_bell(Role::Coordinator).then(rope).flatten()
}

/// About as many vehicles as the network holds in dense but moving traffic. Frames may be longer; this
/// only decides how much memory is laid out at first.
pub fn expected_vehicles(scenario: &Scenario) -> usize {
    const DENSE_SPACING_M: f64 = 12.0;
    let lengths = scenario.network.zones.iter().flat_map(|z| z.approaches.iter().map(|a| a.length_m));
    lengths.map(|l| (l / DENSE_SPACING_M).ceil() as usize + 2).sum()
}
