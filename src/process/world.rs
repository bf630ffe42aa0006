//! The world process.

mod opening;

use super::membership::Membership;
use super::outcome::{History, Outcome, StepMeter};
use super::placement::number_of_cores;
use super::services::{Driver, Services};
use super::viewing::Steering;
use super::{Peer, ProcessError, RecordLag, Settling, StopFlag, Timing, WaitMode, Waiter};
use crate::lockstep::Progress;
use crate::own_time::Bound;
use crate::record::{FileSource, Reader};
use crate::scenario::{OnExit, Scenario};
use crate::trace::{self, Phase};
use crate::transport::iox::{RunName, RunSpace};
use crate::world::{Traffic, World};
use ipc_schemas::Role;
use opening::{Begun, Opened};
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

/// Steps between two looks at the signal flag and the clock for progress.
pub(super) const STEPS_PER_LOOK: u64 = 64;

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
    let begun = Begun::new(scenario, options, resume, traffic)?;
    let WorldOptions { coordinators, controllers, wait, .. } = *options;
    if wait == WaitMode::Spin {
        check_cores(1 + (coordinators + controllers) as usize)?;
    }
    let held = settling.settle(Role::World, 0, wait, wait.hot_processes(coordinators, controllers));
    let Opened { space, services, mut driver, mut waiter, mut membership } =
        Opened::new(scenario, options, begun, stop)?;
    if options.begins_paused && options.is_steered {
        let first_step = membership.reception.first_step;
        membership.pacer.steer(Steering::Pause, first_step);
    }
    // Declared last, so let go first.
    let _held = held;
    let outcome = run_on(&mut driver, &mut waiter, &mut membership, stop, &mut progress)?;
    let departure = Departure { driver, patience: options.peer_timeout, _services: services, _space: space };
    Ok((outcome, departure))
}

/// Makes steps until there are no more.
fn run_on(
    driver: &mut Driver,
    waiter: &mut Waiter,
    membership: &mut Membership,
    stop: &StopFlag,
    progress: &mut dyn FnMut(&World),
) -> Result<Outcome, ProcessError> {
    let mut history = History::default();
    let mut meter = StepMeter::start();
    let mut step = driver.world().step();
    loop {
        let publishes = driver.is_between_steps();
        if publishes {
            membership.begin_step(driver, waiter, stop)?;
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
                return Ok(meter.outcome(driver.world(), history));
            }
            Progress::Waiting(awaited) => {
                trace::enter(Phase::Wait);
                membership.wait(driver, waiter, awaited)?;
            }
            Progress::Behind => unreachable!("the world is where the run is"),
            Progress::Advanced => waiter.reset(),
        }
        if publishes {
            membership.plugins.asked(driver.missing_commands());
            membership.overlap_views(driver)?;
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
        history.replacements.extend(membership.step_done(driver, ns));
        if membership.pacer.is_scheduled() || step.is_multiple_of(STEPS_PER_LOOK) {
            progress(driver.world());
            membership.attend(driver, waiter)?;
            membership.attend_views(driver)?;
            if stop.is_set() {
                return Err(ProcessError::Interrupted { step: Some(step) });
            }
        }
    }
}
