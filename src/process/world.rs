//! The world process.

use super::attach::{Readiness, Reception};
use super::membership::Membership;
use super::observe::{self, ObservedSteps};
use super::outcome::{Events, History, Outcome, StepMeter};
use super::pace::Pacer;
use super::peers::is_alive;
use super::placement::number_of_cores;
use super::plugin_log::PluginLog;
use super::services::{Driver, Services, coordinator_ropes, expected_vehicles};
use super::viewing::{Steering, Viewing};
use super::{Patience, Peer, ProcessError, RecordLag, Settling, StopFlag, Timing, WaitMode, Waiter};
use crate::lockstep::in_process::InProcess;
use crate::lockstep::{Handover, Ledger, Progress, WorldDriver};
use crate::own_time::Bound;
use crate::record::{FileSource, Processes, Reader, ReplayError, replay_world};
use crate::scenario::{OnExit, Scenario};
use crate::step::StepFrames;
use crate::trace::{self, Phase};
use crate::transport::iox::{RunName, RunSpace, SpaceError};
use crate::world::{Traffic, World};
use ipc_schemas::Role;
use std::sync::Arc;
use std::time::Duration;

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
    /// What becomes of steps that whoever looks on cannot take yet.
    pub record_lag: RecordLag,
    /// Whether whoever looks may pause the run, have it make steps, and set its pace.
    pub is_steered: bool,
    /// Whether it begins paused, as long as it waits for participants at most, until somebody who looks lets it go on.
    pub begins_paused: bool,
    /// Told of a controller (its index) that has not answered for half of `peer_timeout` and that the run can do
    /// without; it is to end it.
    pub silent: fn(u32),
    /// Controllers that are debugged, one bit each: no clock goes on while they are waited for.
    pub debugged: u64,
    /// The run's id, where it has been chosen already.
    pub run_id: Option<u64>,
}

impl WorldOptions {
    /// Whether the world keeps what others need who take a place, or catch up.
    fn keeps(&self, scenario: &Scenario) -> bool {
        scenario.plugins.iter().any(|plugin| plugin.on_exit != OnExit::End)
            || self.replace
            || self.observed
            || self.is_steered
            || self.timing.on_miss.verdict().is_some()
    }
}

/// How long whoever knew a killed world may take to let its services go.
const LETTING_GO: Duration = Duration::from_secs(3);
/// Steps between two looks at the signal flag and the clock for progress.
const STEPS_PER_LOOK: u64 = 64;

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

/// The world of a run that is over, on its way out. What it has sent last goes with it, so it leaves when all
/// the others have.
#[derive(Debug)]
#[must_use = "the world leaves last"]
pub struct Departure {
    // Dropped in this order: ends, services, space.
    driver: Driver,
    patience: Duration,
    _services: Services,
    _space: RunSpace,
}

/// Time between two looks for those who are still there.
const LEAVE_LOOK: Duration = Duration::from_micros(200);

impl Departure {
    /// Waits until everybody has left the services or died, as long as for a frame; returns who has not.
    pub fn wait(self, stop: &StopFlag) -> Vec<Peer> {
        let mut bound = Bound::of(self.patience);
        loop {
            let peer = |(role, index, process_id)| Peer { role, index, process_id };
            let mut there: Vec<Peer> = self.driver.receivers().into_iter().map(peer).collect();
            there.retain(Peer::is_alive);
            if there.is_empty() || stop.is_set() || bound.is_over() {
                return there;
            }
            std::thread::sleep(LEAVE_LOOK);
        }
    }
}

/// Runs the world of a multi-process run to its end, on from so many steps of a recording if there is one;
/// `progress` is called now and then. With a `traffic`, that one moves the vehicles; such a run does not go on from a
/// recording. Once the outcome has been put where it belongs, the departure is to be
/// waited for.
pub fn run_world(
    scenario: &Arc<Scenario>,
    options: &WorldOptions,
    resume: Option<(&Reader<FileSource>, u64)>,
    traffic: Option<Box<dyn Traffic>>,
    settling: &Settling<'_>,
    stop: &StopFlag,
    mut progress: impl FnMut(&World),
) -> Result<(Outcome, Departure), ProcessError> {
    // First of all: it may take a while, and may fail.
    let world = match (resume, traffic) {
        (Some((reader, steps)), _) => replay_world(reader, steps)?,
        (None, Some(traffic)) => World::played(scenario.clone(), options.coordinators, traffic),
        (None, None) => World::new(scenario.clone(), options.coordinators),
    };
    let first_step = world.step();
    let mut ledger =
        (options.keeps(scenario) || resume.is_some()).then(|| Ledger::new(scenario, options.controllers));
    let mut missed = false;
    // Behind these the file may be cut off.
    for step in resume.iter().flat_map(|(reader, _)| reader.steps().take(first_step as usize)) {
        let step = step.map_err(ReplayError::from)?;
        ledger.iter_mut().for_each(|ledger| ledger.relive(&step));
        missed = step.misses != 0;
    }
    let WorldOptions { coordinators, controllers, wait, .. } = *options;
    if wait == WaitMode::Spin {
        check_cores(1 + (coordinators + controllers) as usize)?;
    }
    let held = settling.settle(Role::World, 0, wait, wait.hot_processes(coordinators, controllers));
    let space = RunSpace::enter(&options.run)?;
    let run_id = options.run_id.unwrap_or_else(new_run_id);
    if space.world().is_some_and(is_alive) {
        return Err(ProcessError::AlreadyActive { run: options.run.to_string() });
    }
    space.forget_world();
    space.check_room()?;
    // The service of members last: once it exists, everything else does.
    let services = create(&space, &options.run, stop, || {
        Services::create(&space, scenario, (coordinators, controllers), ledger.is_some())
    })?;
    let observed = match options.observed {
        true => {
            // Less than others wait for the world, so that it is the world that says what it waited for.
            let lag = (options.record_lag, options.peer_timeout.mul_f64(0.9));
            Some(create(&space, &options.run, stop, || {
                observe::create(&space, expected_vehicles(scenario), scenario, lag, stop)
            })?)
        }
        false => None,
    };
    // What is shown is what is kept.
    let viewing = match ledger {
        Some(_) => {
            let sizes = (expected_vehicles(scenario), run_id);
            let processes = Processes { coordinators, controllers };
            let steering = options.is_steered.then_some(options.attach_timeout);
            let attempt = || Viewing::create(&space, scenario, sizes, processes, steering);
            Some(create(&space, &options.run, stop, attempt)?)
        }
        None => None,
    };
    let bells = space.create_bells()?;
    let ports = services.world_ports(&bells, scenario, wait)?;
    let feedbacks = services.feedbacks()?;
    let mut members = services.members_outbox(run_id)?;
    // Plug-ins ring no bells: with one in the run, the world polls.
    let rung = wait.has_bell(Role::World) && scenario.plugins.is_empty();
    let bell = rung.then(|| bells.bell(Role::World, 0));
    let mut reception = create(&space, &options.run, stop, || {
        Reception::open(&space, scenario, run_id, (coordinators, controllers), wait)
    })?;
    space.announce_world()?;
    reception.first_step = first_step;
    let handed = |role, index| {
        let ledger = ledger.as_ref().filter(|_| resume.is_some())?;
        Some(Handover { step: first_step, ..ledger.handover(role, index) })
    };
    receive_all(&mut reception, &handed, observed.as_ref(), options, stop)?;
    space.check_room()?;

    let mut driver = WorldDriver::new(world, ports, run_id, controllers);
    driver.keep(ledger);
    if missed {
        driver.go_on_after_miss();
    }
    if let Some(observed) = observed {
        driver.observe(Box::new(observed));
    }
    if let Some(feedbacks) = feedbacks {
        driver.tell(Box::new(feedbacks));
    }
    let patience = Patience::of(wait, Role::World, 1 + controllers as usize, options.peer_timeout);
    let waiter = Waiter::new(patience, bell, stop.clone(), reception.peers());
    let mut waiter = waiter.waking(coordinator_ropes(&bells, wait, coordinators));
    waiter.call(driver.names());
    for (role, index, seat) in reception.seats() {
        driver.seat(role, index, seat);
    }
    members.tell(first_step, driver.members())?;
    let scenario_pool = driver.world().drivers().pool();
    let mut membership = Membership {
        reception,
        members,
        replace: options.replace,
        pacer: Pacer::new(options.timing, scenario.dt_ns).unhurried_by(options.debugged),
        viewing,
        events: Events::default(),
        overdue: None,
        gone: None,
        coming: Vec::new(),
        arrived: Vec::new(),
        plugins: PluginLog::new(scenario, scenario_pool),
        silent: options.silent,
        // Sooner than others lose patience with the world.
        silence: options.peer_timeout / 2,
        told_of_silence: None,
    };
    for (_, index, _) in membership.reception.seats().filter(|(.., seat)| seat.stands_in) {
        // Its process ended before the run began.
        membership.plugins.taken(index, 0, true);
    }
    if options.begins_paused && options.is_steered {
        membership.pacer.steer(Steering::Pause, first_step);
    }
    let mut history = History::default();
    // Declared last, so let go first.
    let _held = held;
    let mut meter = StepMeter::start();
    let mut step = first_step;
    loop {
        let publishes = driver.is_between_steps();
        if publishes {
            membership.begin_step(&mut driver, &mut waiter, stop)?;
            meter.begin_step(membership.pacer.is_scheduled());
        }
        match driver.advance().map_err(|error| waiter.explain(error))? {
            Progress::Finished => {
                // Nobody else waits for them any more.
                waiter.wake(u64::MAX);
                history.punctuality = membership.pacer.report(&driver.names());
                history.controllers =
                    membership.plugins.report(|index| membership.pacer.missed_by(Role::Controller, index));
                history.refused = driver.refused();
                history.late_frames = driver.late_frames();
                history.events = membership.events.take();
                let outcome = meter.outcome(driver.world(), history);
                let patience = options.peer_timeout;
                let departure = Departure { driver, patience, _services: services, _space: space };
                return Ok((outcome, departure));
            }
            Progress::Waiting(awaited) => {
                trace::enter(Phase::Wait);
                membership.wait(&mut driver, &mut waiter, awaited)?;
            }
            Progress::Behind => unreachable!("the world is where the run is"),
            Progress::Advanced => waiter.reset(),
        }
        if publishes {
            membership.plugins.asked(driver.missing_commands());
            membership.overlap_views(&mut driver)?;
        }
        membership.plugins.still_missing(driver.missing_commands());
        if driver.world().step() == step {
            continue;
        }
        step = driver.world().step();
        trace::begin(Phase::Compute, step);
        waiter.reset();
        membership.overdue = None;
        let ns = meter.step_done(driver.was_event());
        if let Some(viewing) = &mut membership.viewing {
            viewing.step_done(step - 1, ns);
        }
        history.replacements.extend(membership.step_done(&driver, ns));
        if membership.pacer.is_scheduled() || step.is_multiple_of(STEPS_PER_LOOK) {
            progress(driver.world());
            membership.attend(&mut driver, &mut waiter)?;
            membership.attend_views(&mut driver)?;
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
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
    progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    run_on_in_process(InProcess::new(scenario, coordinators, controllers), stop, progress)
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
    run_on_in_process_observed(
        InProcess::observed(scenario, coordinators, controllers),
        stop,
        progress,
        observe,
    )
}

/// Runs one that has been begun to its end.
pub fn run_on_in_process(
    mut run: InProcess,
    stop: &StopFlag,
    progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    drive(&mut run, stop, progress, |_| {})
}

/// The same of one that is observed, and shows the frames of every step.
pub fn run_on_in_process_observed(
    mut run: InProcess,
    stop: &StopFlag,
    progress: impl FnMut(&World),
    observe: impl FnMut(&StepFrames<'_>),
) -> Result<Outcome, ProcessError> {
    drive(&mut run, stop, progress, observe)
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

/// Creates something of the run. What a world that was killed has created is in the way until whoever knew it has
/// let it go, which takes a moment.
fn create<T>(
    space: &RunSpace,
    run: &RunName,
    stop: &StopFlag,
    attempt: impl Fn() -> Result<T, SpaceError>,
) -> Result<T, ProcessError> {
    let mut bound = Bound::of(LETTING_GO);
    loop {
        match attempt() {
            Err(SpaceError::Exists { .. }) if bound.is_over() || stop.is_set() => {
                return Err(ProcessError::AlreadyActive { run: run.to_string() });
            }
            Err(SpaceError::Exists { .. }) => {
                space.sweep_dead();
                std::thread::sleep(Duration::from_millis(10));
            }
            result => return Ok(result?),
        }
    }
}

/// Waits until all participants are ready.
fn receive_all(
    reception: &mut Reception,
    handed: &dyn Fn(Role, usize) -> Option<Handover>,
    observed: Option<&ObservedSteps>,
    options: &WorldOptions,
    stop: &StopFlag,
) -> Result<(), ProcessError> {
    let mut bound = Bound::of(options.attach_timeout);
    loop {
        reception.serve(&mut |role, index, _| match handed(role, index as usize) {
            Some(handover) => Readiness::Now(Box::new(handover)),
            None => Readiness::Begin,
        })?;
        let missing = reception.first_missing();
        let is_looked_on = observed.is_none_or(|steps| steps.outbox.has_reader());
        if missing.is_none() && is_looked_on {
            return Ok(());
        }
        if stop.is_set() {
            return Err(ProcessError::Interrupted { step: None });
        }
        if bound.is_over() {
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
