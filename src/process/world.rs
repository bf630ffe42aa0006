//! The world process.

use super::attach::{Readiness, Reception};
use super::observe::{self, ObservedSteps};
use super::pace::Pacer;
use super::placement::number_of_cores;
use super::{
    OnMiss, Pace, Patience, Peer, Peers, ProcessError, Punctuality, Settled, Settling, StopFlag, Timing,
    WaitMode, Waiter,
};
use crate::lockstep::in_process::InProcess;
use crate::lockstep::{Awaited, Handover, Ledger, Progress, RefusedFrames, Seat, WorldDriver, WorldPorts};
use crate::record::{FileSource, Reader, ReplayError, StepFrames, replay_world};
use crate::scenario::Scenario;
use crate::scenario::share::neighbour_coordinators;
use crate::transport::iox::{BellRope, BellService, RunName, RunSpace, Service, ServiceLimits, SpaceError};
use crate::transport::{Inbox, Outbox};
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
    /// Whether the run waits, as long as for a frame, for somebody to take the place of a coordinator or
    /// controller that has died.
    pub replace: bool,
    /// When steps begin, and what becomes of late ones.
    pub timing: Timing,
    /// Whether the run is looked on; it begins once somebody does.
    pub observed: bool,
    /// The run's id, where it has been chosen already.
    pub run_id: Option<u64>,
}

impl WorldOptions {
    /// Whether the world keeps what others need who take a place, or catch up.
    fn keeps(&self) -> bool {
        self.replace || self.observed || self.timing.on_miss.verdict().is_some()
    }
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
    /// Processes that took the place of others.
    pub replacements: Vec<Replacement>,
    /// Frames that were not taken, by sender.
    pub refused: Vec<RefusedFrames>,
    /// Answers that came too late or twice.
    pub late_frames: u64,
    /// How punctual the run was, where it had a schedule or deadlines.
    pub punctuality: Option<Punctuality>,
    /// Where each process was and what it was granted; filled in by who started them.
    #[serde(default)]
    pub placement: Vec<Settled>,
}

/// A process that took the place of one that had died.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Replacement {
    /// Role and index.
    pub participant: String,
    /// The place's generation since.
    pub generation: u32,
    /// Step during which it came.
    pub step: u64,
    /// How long that step took, ms.
    pub step_ms: f64,
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

    /// A step begins now.
    fn begin_step(&mut self, is_paced: bool) {
        if is_paced {
            self.step_start = Instant::now();
        }
    }

    /// Returns how long the step took, ns.
    fn step_done(&mut self, was_event: bool) -> u64 {
        let now = Instant::now();
        let ns = (now - self.step_start).as_nanos() as u64;
        // The histograms resize themselves; only an absurd latency could not be recorded.
        let _ = self.latency_ns.record(ns);
        if self.latency_ns.len() > WARM_UP_STEPS {
            let _ = if was_event { &mut self.event_ns } else { &mut self.steady_ns }.record(ns);
        }
        self.step_start = now;
        ns
    }

    fn outcome(&self, world: &World, history: History) -> Outcome {
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
            replacements: history.replacements,
            refused: history.refused,
            late_frames: history.late_frames,
            punctuality: history.punctuality,
            placement: Vec::new(),
        }
    }
}

/// What happened to the participants of a run.
#[derive(Debug, Default)]
struct History {
    replacements: Vec<Replacement>,
    refused: Vec<RefusedFrames>,
    late_frames: u64,
    punctuality: Option<Punctuality>,
}

/// Refuses to spin with more processes than cores.
pub fn check_cores(processes: usize) -> Result<(), ProcessError> {
    let cores = number_of_cores();
    if processes > cores { Err(ProcessError::TooFewCores { processes, cores }) } else { Ok(()) }
}

/// The first step a recording does not have: where an interrupted run goes on.
pub fn first_missing_step(reader: &Reader<FileSource>) -> u64 {
    let sound = reader.steps().map_while(Result::ok);
    let in_order = (0..).zip(sound).take_while(|(expected, step)| step.header.step == *expected);
    in_order.count() as u64
}

/// An id nobody else has.
pub fn new_run_id() -> u64 {
    let mut id = [0u8; 8];
    if rustix::rand::getrandom(&mut id, rustix::rand::GetRandomFlags::NONBLOCK).is_err() {
        id = u64::from(std::process::id()).to_le_bytes();
    }
    u64::from_le_bytes(id)
}

/// Runs the world of a multi-process run to its end; `progress` is called now and then.
pub fn run_world(
    scenario: &Arc<Scenario>,
    options: &WorldOptions,
    resume: Option<&Reader<FileSource>>,
    settling: &Settling<'_>,
    stop: &StopFlag,
    mut progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    // First of all: it may take a while, and may fail.
    let world = match resume {
        Some(reader) => replay_world(reader, first_missing_step(reader))?,
        None => World::new(scenario.clone(), options.coordinators),
    };
    let first_step = world.step();
    let mut ledger =
        (options.keeps() || resume.is_some()).then(|| Ledger::new(scenario, options.controllers));
    // Behind these the file may be cut off.
    for step in resume.iter().flat_map(|reader| reader.steps().take(first_step as usize)) {
        let step = step.map_err(ReplayError::from)?;
        ledger.iter_mut().for_each(|ledger| ledger.relive(&step));
    }
    let WorldOptions { coordinators, controllers, wait, .. } = *options;
    if wait == WaitMode::Spin {
        check_cores(1 + (coordinators + controllers) as usize)?;
    }
    let held = settling.settle(Role::World, 0, wait, wait.hot_processes(coordinators, controllers));
    let space = RunSpace::enter(&options.run)?;
    let run_id = options.run_id.unwrap_or_else(new_run_id);
    let active = |error| match error {
        SpaceError::Exists { .. } => ProcessError::AlreadyActive { run: options.run.to_string() },
        other => other.into(),
    };
    // The desk last: once it exists, everything else does.
    let services =
        Services::create(&space, scenario, (coordinators, controllers), ledger.is_some()).map_err(active)?;
    let observed = match options.observed {
        true => Some(observe::create(&space, expected_vehicles(scenario), scenario).map_err(active)?),
        false => None,
    };
    let _bells = create_bells(&space, wait, coordinators, controllers)?;
    // Plug-ins ring no bells: with one in the run, the world polls.
    let rung = wait.has_bell(Role::World) && scenario.plugins.is_empty();
    let bell = rung.then(|| space.bell(frames::BELL_WORLD)).flatten();
    let mut reception =
        Reception::open(&space, scenario, run_id, (coordinators, controllers), wait).map_err(active)?;
    reception.first_step = first_step;
    let handed = |role, index| {
        let ledger = ledger.as_ref().filter(|_| resume.is_some())?;
        Some(Handover { step: first_step, ..ledger.handover(role, index) })
    };
    receive_all(&mut reception, &handed, observed.as_ref(), options, stop)?;
    // Bells are hung up by now, so that the ropes hold.
    let ports = services.world_ports(&space, scenario, wait)?;

    let mut driver = WorldDriver::new(world, ports, run_id, controllers);
    driver.keep(ledger);
    if let Some(steps) = observed {
        driver.observe(Box::new(steps));
    }
    let patience = Patience::of(wait, Role::World, 1 + controllers as usize, options.peer_timeout);
    let mut waiter = Waiter::new(patience, bell, stop.clone(), reception.peers());
    for Peer { role, index, process_id } in reception.peers().0 {
        driver.seat(role, index, Seat::new(0, process_id));
    }
    let mut house = House {
        reception,
        replace: options.replace,
        pacer: Pacer::new(options.timing, scenario.dt_ns),
        overdue: None,
        gone: None,
        arrived: Vec::new(),
    };
    let mut history = History::default();
    let is_paced = options.timing.pace == Pace::Realtime;
    // Declared last, so let go first.
    let _held = held;
    let mut meter = StepMeter::start();
    let mut step = first_step;
    loop {
        if driver.is_between_steps() {
            house.begin_step(&mut driver, &mut waiter, stop)?;
            meter.begin_step(is_paced);
        }
        match driver.advance().map_err(|error| waiter.explain(error))? {
            Progress::Finished => {
                history.punctuality = house.pacer.report();
                history.refused = driver.refused();
                history.late_frames = driver.late_frames();
                return Ok(meter.outcome(driver.world(), history));
            }
            Progress::Waiting(awaited) => house.wait(&mut driver, &mut waiter, awaited)?,
            Progress::Behind => unreachable!("the world is where the run is"),
            Progress::Advanced => waiter.reset(),
        }
        if driver.world().step() == step {
            continue;
        }
        step = driver.world().step();
        waiter.reset();
        house.overdue = None;
        let ns = meter.step_done(driver.was_event());
        history.replacements.extend(house.step_done(ns));
        if is_paced || step.is_multiple_of(STEPS_PER_LOOK) {
            progress(driver.world());
            house.attend(&mut driver, &mut waiter)?;
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
            }
        }
    }
}

/// Longest sleep between two looks at signals and newcomers while a step is not due.
const LONGEST_SLEEP: Duration = Duration::from_millis(5);
/// A participant that has sent a bad frame may take this long to send a good one.
const SECOND_CHANCE: Duration = Duration::from_secs(1);
/// Newcomers are seen to when a wait takes longer than this.
const ATTEND_AFTER: Duration = Duration::from_millis(1);

/// Who is in the run, and who comes and goes.
#[derive(Debug)]
struct House {
    reception: Reception,
    replace: bool,
    pacer: Pacer,
    /// The step's deadline has passed, and this is the verdict of what is put in for whoever is missing.
    overdue: Option<u16>,
    /// Who has died last and was not replaced yet.
    gone: Option<Peer>,
    /// Who has come since the last step ended.
    arrived: Vec<(Peer, u32)>,
}

impl House {
    /// Waits until the present step is due.
    fn begin_step<S, C, M, A>(
        &mut self,
        driver: &mut WorldDriver<S, C, M, A>,
        waiter: &mut Waiter,
        stop: &StopFlag,
    ) -> Result<(), ProcessError>
    where
        S: Outbox<VehicleState>,
        C: Outbox<VehicleState>,
        M: Inbox<VehicleCommand>,
        A: Inbox<Assignment>,
    {
        let step = driver.world().step();
        while let Some(left) = self.pacer.until(step) {
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
            }
            if left.is_zero() {
                std::hint::spin_loop();
            } else {
                std::thread::sleep(left.min(LONGEST_SLEEP));
                self.attend(driver, waiter)?;
            }
        }
        self.pacer.begin(step);
        Ok(())
    }

    /// Waits a little; sees to newcomers when it takes long.
    fn wait<S, C, M, A>(
        &mut self,
        driver: &mut WorldDriver<S, C, M, A>,
        waiter: &mut Waiter,
        awaited: Awaited,
    ) -> Result<(), ProcessError>
    where
        S: Outbox<VehicleState>,
        C: Outbox<VehicleState>,
        M: Inbox<VehicleCommand>,
        A: Inbox<Assignment>,
    {
        if self.pacer.has_missed(&awaited) {
            match self.pacer.on_miss() {
                OnMiss::Abort => return Err(ProcessError::DeadlineMissed { awaited }),
                policy => self.overdue = policy.verdict(),
            }
        }
        // While a coordinator is missing too, there is nothing the vehicles could go by.
        if let Some(verdict) = self.overdue
            && driver.put_in(verdict)?
        {
            self.overdue = None;
            return Ok(());
        }
        if driver.expects_requests() {
            self.attend(driver, waiter)?;
        }
        if waiter.waited() >= ATTEND_AFTER {
            self.attend(driver, waiter)?;
            if waiter.waited() >= SECOND_CHANCE
                && let Some((who, fault)) = driver.suspect()
            {
                return Err(ProcessError::Faulty { who, fault: fault.clone() });
            }
        }
        match (waiter.wait(awaited), self.gone) {
            (Err(ProcessError::PeerGone { peer, .. }), _) if self.may_be_replaced(peer) => {
                self.gone = Some(peer);
                let others = self.reception.peers().0.into_iter().filter(|p| *p != peer);
                waiter.set_peers(Peers(others.collect()));
                Ok(())
            }
            (Err(ProcessError::Timeout { awaited, seconds }), Some(peer)) => {
                let consequence =
                    format!("nobody took its place within {seconds} s of waiting for {awaited}");
                Err(ProcessError::PeerGone { peer, consequence })
            }
            (result, _) => result,
        }
    }

    fn may_be_replaced(&self, peer: Peer) -> bool {
        let is_plugin = peer.role == Role::Controller && self.reception.is_plugin(peer.index as usize);
        self.replace && !is_plugin
    }

    /// Sees to whoever has come.
    fn attend<S, C, M, A>(
        &mut self,
        driver: &mut WorldDriver<S, C, M, A>,
        waiter: &mut Waiter,
    ) -> Result<(), ProcessError>
    where
        S: Outbox<VehicleState>,
        C: Outbox<VehicleState>,
        M: Inbox<VehicleCommand>,
        A: Inbox<Assignment>,
    {
        let House { reception, arrived, gone, .. } = self;
        (reception.under_way, reception.first_step) = (true, driver.world().step());
        let before = arrived.len();
        reception.serve(&mut |role, index, seat| {
            driver.seat(role, index, seat);
            let Some(handover) = driver.handover(role, index) else { return Readiness::Later };
            if let Some(process_id) = seat.process_id {
                arrived.push((Peer { role, index, process_id }, seat.generation));
            }
            Readiness::Now(Box::new(handover))
        })?;
        if arrived.len() > before {
            *gone = None;
            waiter.set_peers(reception.peers());
        }
        Ok(())
    }

    /// The replacements of a step that took so long.
    fn step_done(&mut self, ns: u64) -> impl Iterator<Item = Replacement> + '_ {
        let step = self.reception.first_step;
        let step_ms = ns as f64 / 1e6;
        self.arrived.drain(..).filter(|(_, generation)| *generation > 0).map(move |(peer, generation)| {
            Replacement { participant: peer.to_string(), generation, step, step_ms }
        })
    }
}

/// Runs a whole run in this process.
pub fn run_in_process(
    scenario: &Arc<Scenario>,
    coordinators: u32,
    controllers: u32,
    stop: &StopFlag,
    progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    let mut run = InProcess::new(scenario, coordinators, controllers);
    drive(&mut run, stop, progress, |_| {})
}

/// The same, and shows the frames of every step.
pub fn run_in_process_observed(
    scenario: &Arc<Scenario>,
    coordinators: u32,
    controllers: u32,
    stop: &StopFlag,
    progress: impl FnMut(&World),
    observe: impl FnMut(&StepFrames<'_>),
) -> Result<Outcome, ProcessError> {
    let mut run = InProcess::observed(scenario, coordinators, controllers);
    drive(&mut run, stop, progress, observe)
}

/// Runs one that goes on from a recording to its end.
pub fn run_on_in_process(
    mut run: InProcess,
    stop: &StopFlag,
    progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    drive(&mut run, stop, progress, |_| {})
}

fn drive(
    run: &mut InProcess,
    stop: &StopFlag,
    mut progress: impl FnMut(&World),
    mut observe: impl FnMut(&StepFrames<'_>),
) -> Result<Outcome, ProcessError> {
    let mut meter = StepMeter::start();
    loop {
        let goes_on = run.step()?;
        run.frames(&mut observe)?;
        if !goes_on {
            break;
        }
        meter.step_done(run.was_event());
        let step = run.world().step();
        if step.is_multiple_of(STEPS_PER_LOOK) {
            progress(run.world());
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
            }
        }
    }
    Ok(meter.outcome(run.world(), History::default()))
}

/// Waits until all participants are ready.
fn receive_all(
    reception: &mut Reception,
    handed: &dyn Fn(Role, usize) -> Option<Handover>,
    observed: Option<&ObservedSteps>,
    options: &WorldOptions,
    stop: &StopFlag,
) -> Result<(), ProcessError> {
    let deadline = Instant::now() + options.attach_timeout;
    loop {
        reception.serve(&mut |role, index, _| match handed(role, index as usize) {
            Some(handover) => Readiness::Now(Box::new(handover)),
            None => Readiness::Begin,
        })?;
        let missing = reception.first_missing();
        let is_looked_on = observed.is_none_or(|steps| steps.0.has_reader());
        if missing.is_none() && is_looked_on {
            return Ok(());
        }
        if stop.is_set() {
            return Err(ProcessError::Interrupted { step: None });
        }
        if Instant::now() >= deadline {
            let Some((role, index)) = missing else {
                return Err(ProcessError::NotObserved { seconds: options.attach_timeout.as_secs_f64() });
            };
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

/// Room for sending ends that belong to nobody in the run: what they send is counted and refused.
const STRANGERS: usize = 2;

/// All frame services of a run, created by its world and kept open by it.
#[derive(Debug)]
struct Services {
    state: Service<VehicleState>,
    coordinator_states: Vec<Service<VehicleState>>,
    command: Service<VehicleCommand>,
    coordination: Service<Assignment>,
    /// Whether the world listens to coordination too.
    keeps: bool,
    _summaries: Vec<Service<ZoneSummary>>,
    controllers: u32,
}

impl Services {
    fn create(
        space: &RunSpace,
        scenario: &Scenario,
        (coordinators, controllers): (u32, u32),
        keeps: bool,
    ) -> Result<Services, SpaceError> {
        let (m, n) = (coordinators as usize, controllers as usize);
        // Strangers may try; they shall not keep anybody out who belongs here.
        let nodes = 1 + m + n + STRANGERS;
        let limits = |publishers, subscribers| ServiceLimits { publishers, subscribers, nodes };
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
            command: space.create(frames::SERVICE_COMMAND, limits(n + STRANGERS, 1))?,
            coordination: space
                .create(frames::SERVICE_COORDINATION, limits(m + STRANGERS, n + usize::from(keeps)))?,
            keeps,
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
            crate::transport::iox::IoxInbox<Assignment>,
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
            coordination: if self.keeps { Some(self.coordination.inbox()?) } else { None },
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
