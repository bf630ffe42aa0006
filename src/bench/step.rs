//! A whole step with two processes: world and coordinator here, the controller in another process.

use super::BenchError;
use super::PATIENCE;
use crate::coordination::Coordinator;
use crate::lockstep::{
    ControllerDriver, CoordinatorDriver, CoordinatorPorts, Identity, Members, Progress, WorldDriver,
    WorldPorts,
};
use crate::process::{Percentiles, WARM_UP_STEPS, new_histogram};
use crate::scenario::Scenario;
use crate::transport::memory::{MemoryInbox, MemoryOutbox, MemoryService};
use crate::transport::{Inbox, Outbox};
use crate::world::World;
use ipc_schemas::{Assignment, Member, Role, VehicleCommand, VehicleState, ZoneSummary};
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

/// What a run of steps has come to.
pub(super) struct Stepped {
    /// Wall time of all steps, s.
    pub wall_s: f64,
    /// All steps, without a warm-up.
    pub all: Percentiles,
    /// Steps without coordination.
    pub steady: Percentiles,
    /// Steps in which the coordinator acts.
    pub event: Percentiles,
    /// State hash at the end.
    pub state_hash: u64,
}

/// Run id of these runs; a run of its own has nobody to be confused with.
const RUN_ID: u64 = 1;

/// Runs world and coordinator to the end; only what goes to or comes from the controller travels.
///
/// A step is timed from the state's publication to the end of integration, like everywhere.
pub(super) fn lead<S, A, C>(
    scenario: &Arc<Scenario>,
    state: S,
    coordination: A,
    command: C,
) -> Result<Stepped, BenchError>
where
    S: Outbox<VehicleState>,
    A: Outbox<Assignment>,
    C: Inbox<VehicleCommand>,
{
    let coordinator_state: MemoryService<VehicleState> = MemoryService::new();
    let summaries: MemoryService<ZoneSummary> = MemoryService::new();
    let zones = 0..scenario.network.zones.len() as u32;
    let coordinator_ports = CoordinatorPorts::<_, MemoryInbox<ZoneSummary>, _, _, MemoryInbox<Member>> {
        state: coordinator_state.inbox(),
        summaries: summaries.inbox(),
        neighbours: Vec::<(u16, Range<u32>, MemoryOutbox<ZoneSummary>)>::new(),
        coordination,
        members: Members::as_claimed(),
    };
    let identity = Identity { run_id: RUN_ID, role: Role::Coordinator, index: 0, generation: 0 };
    let role = Coordinator::new(scenario.clone(), zones);
    let mut coordinator = CoordinatorDriver::new(role, coordinator_ports, identity);
    let ports = WorldPorts {
        state,
        coordinator_states: vec![coordinator_state.outbox()],
        command,
        coordination: None::<MemoryInbox<Assignment>>,
    };
    let mut world = WorldDriver::new(World::new(scenario.clone(), 1), ports, RUN_ID, 1);
    let (mut all, mut steady, mut event) = (new_histogram(), new_histogram(), new_histogram());
    let mut steps = 0;
    let begun = Instant::now();
    loop {
        let start = Instant::now();
        if world.advance()? == Progress::Finished {
            break;
        }
        while coordinator.advance()? == Progress::Advanced {}
        // There is one controller, so the world advances when its commands come, and by a whole step.
        if spin(|| Ok(world.advance()?))? == Progress::Finished {
            break;
        }
        steps += 1;
        let ns = start.elapsed().as_nanos() as u64;
        let _ = all.record(ns);
        if steps > WARM_UP_STEPS {
            let histogram = if world.was_event() { &mut event } else { &mut steady };
            let _ = histogram.record(ns);
        }
    }
    Ok(Stepped {
        wall_s: begun.elapsed().as_secs_f64(),
        all: Percentiles::of(&all),
        steady: Percentiles::of(&steady),
        event: Percentiles::of(&event),
        state_hash: world.world().state_hash(),
    })
}

/// Answers all steps of such a run.
pub(super) fn follow<S, A, C, M>(mut driver: ControllerDriver<S, A, C, M>) -> Result<(), BenchError>
where
    S: Inbox<VehicleState>,
    A: Inbox<Assignment>,
    C: Outbox<VehicleCommand>,
    M: Inbox<Member>,
{
    while spin(|| Ok(driver.advance()?))? != Progress::Finished {}
    Ok(())
}

/// The controller's identity in such a run.
pub(super) const CONTROLLER: Identity =
    Identity { run_id: RUN_ID, role: Role::Controller, index: 0, generation: 0 };

/// Spins until the driver gets on, without a system call.
fn spin(mut advance: impl FnMut() -> Result<Progress, BenchError>) -> Result<Progress, BenchError> {
    let mut since = None;
    let mut polls = 0u32;
    loop {
        match advance()? {
            Progress::Waiting(_) => std::hint::spin_loop(),
            other => return Ok(other),
        }
        polls = polls.wrapping_add(1);
        if polls.is_multiple_of(1 << 16) && since.get_or_insert_with(Instant::now).elapsed() > PATIENCE {
            return Err(BenchError::Peer);
        }
    }
}
