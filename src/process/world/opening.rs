//! How a world begins: from where, and whom it meets.

use super::{WorldOptions, new_run_id};
use crate::lockstep::{Handover, Ledger, WorldDriver};
use crate::own_time::Bound;
use crate::process::attach::{Readiness, Reception};
use crate::process::membership::Membership;
use crate::process::observe::{self, ObservedSteps};
use crate::process::outcome::Events;
use crate::process::pace::Pacer;
use crate::process::peers::is_alive;
use crate::process::plugin_log::PluginLog;
use crate::process::services::{Driver, Services, coordinator_ropes, expected_vehicles, ropes_of_others};
use crate::process::viewing::Viewing;
use crate::process::{Patience, ProcessError, StopFlag, Waiter};
use crate::record::{FileSource, Processes, Reader, ReplayError, replay_world};
use crate::scenario::Scenario;
use crate::transport::iox::{RunName, RunSpace, SpaceError};
use crate::world::{Traffic, World};
use ipc_schemas::Role;
use std::sync::Arc;
use std::time::Duration;

/// How long whoever knew a killed world may take to let its services go.
const LETTING_GO: Duration = Duration::from_secs(3);
/// A world at its first step.
pub(super) struct Begun {
    world: World,
    /// What others need who take a place, if anybody may.
    ledger: Option<Ledger>,
    /// Whether somebody missed the step before.
    missed: bool,
    /// Whether there were steps before.
    is_resumed: bool,
}

impl Begun {
    /// From the beginning, or on from so many steps of a recording.
    pub(super) fn new(
        scenario: &Arc<Scenario>,
        options: &WorldOptions,
        resume: Option<(&Reader<FileSource>, u64)>,
        traffic: Option<Box<dyn Traffic>>,
    ) -> Result<Begun, ProcessError> {
        let world = match (resume, traffic) {
            (Some((reader, steps)), _) => replay_world(reader, steps)?,
            (None, Some(traffic)) => World::played(scenario.clone(), options.coordinators, traffic),
            (None, None) => World::new(scenario.clone(), options.coordinators),
        };
        let keeps = options.keeps(scenario) || resume.is_some();
        let mut ledger = keeps.then(|| Ledger::new(scenario, options.controllers));
        let mut missed = false;
        // Behind these the file may be cut off.
        for step in resume.iter().flat_map(|(reader, _)| reader.steps().take(world.step() as usize)) {
            let step = step.map_err(ReplayError::from)?;
            ledger.iter_mut().for_each(|ledger| ledger.relive(&step));
            missed = step.misses != 0;
        }
        Ok(Begun { world, ledger, missed, is_resumed: resume.is_some() })
    }
}

/// A world that everybody has come to.
// What is dropped first stands first: who waits and who is waited for, services, space.
pub(super) struct Opened {
    pub(super) membership: Membership,
    pub(super) waiter: Waiter,
    pub(super) driver: Driver,
    pub(super) services: Services,
    pub(super) space: RunSpace,
}

impl Opened {
    /// Creates all services of the run, and waits for its participants.
    pub(super) fn new(
        scenario: &Arc<Scenario>,
        options: &WorldOptions,
        begun: Begun,
        stop: &StopFlag,
    ) -> Result<Opened, ProcessError> {
        let Begun { world, ledger, missed, is_resumed } = begun;
        let first_step = world.step();
        let WorldOptions { coordinators, controllers, wait, .. } = *options;
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
        let observed = observed(&space, scenario, options, stop)?;
        // What is shown is what is kept.
        let is_viewed = ledger.is_some();
        let viewing = is_viewed.then(|| viewing(&space, scenario, options, run_id, stop)).transpose()?;
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
            let ledger = ledger.as_ref().filter(|_| is_resumed)?;
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
        let others = ropes_of_others(&bells, coordinators, controllers, (Role::World, 0));
        let waiter = waiter.apart(Role::World, 0).among(others);
        let mut waiter = waiter.waking(coordinator_ropes(&bells, wait, coordinators));
        waiter.call(driver.names());
        for (role, index, seat) in reception.seats() {
            driver.seat(role, index, seat);
        }
        members.tell(first_step, driver.members())?;
        let mut plugins = PluginLog::new(scenario, driver.world().drivers().pool());
        for (_, index, _) in reception.seats().filter(|(.., seat)| seat.stands_in) {
            // Its process ended before the run began.
            plugins.taken(index, 0, true);
        }
        let membership = Membership {
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
            plugins,
            silent: options.silent,
            // Sooner than others lose patience with the world.
            silence: options.peer_timeout / 2,
            told_of_silence: None,
        };
        Ok(Opened { membership, waiter, driver, services, space })
    }
}

/// The service of whoever looks on, if the run is looked on.
fn observed(
    space: &RunSpace,
    scenario: &Arc<Scenario>,
    options: &WorldOptions,
    stop: &StopFlag,
) -> Result<Option<ObservedSteps>, ProcessError> {
    if !options.observed {
        return Ok(None);
    }
    // Less than others wait for the world, so that it is the world that says what it waited for.
    let lag = (options.record_lag, options.peer_timeout.mul_f64(0.9));
    let attempt = || observe::create(space, expected_vehicles(scenario), scenario, lag, stop);
    Ok(Some(create(space, &options.run, stop, attempt)?))
}

/// What views of the run are shown.
fn viewing(
    space: &RunSpace,
    scenario: &Arc<Scenario>,
    options: &WorldOptions,
    run_id: u64,
    stop: &StopFlag,
) -> Result<Viewing, ProcessError> {
    let sizes = (expected_vehicles(scenario), run_id);
    let processes = Processes { coordinators: options.coordinators, controllers: options.controllers };
    let steering = options.is_steered.then_some(options.attach_timeout);
    create(space, &options.run, stop, || Viewing::create(space, scenario, sizes, processes, steering))
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
