//! A recorded run that goes on in one thread.

use crate::lockstep::Ledger;
use crate::lockstep::in_process::InProcess;
use crate::record::{Metadata, Reader, ReplayError, Source, replay_world};
use crate::scenario::Scenario;
use crate::world::ChangeError;
use std::sync::Arc;

/// Why a recorded run cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum RestoreError {
    /// The recording cannot be replayed that far.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// The other scenario is too different.
    #[error(transparent)]
    Change(#[from] ChangeError),
}

/// A recorded run that goes on before a step, under another scenario if there is one.
///
/// # Errors
/// When the recording does not reach that far, or the other scenario does not fit the world.
pub fn restore<S: Source>(
    reader: &Reader<S>,
    step: u64,
    scenario: Option<Arc<Scenario>>,
) -> Result<InProcess, RestoreError> {
    let Metadata { coordinators, controllers, .. } = *reader.metadata();
    let mut world = replay_world(reader, step)?;
    if let Some(scenario) = scenario {
        world.change(scenario)?;
    }
    let mut ledger = Ledger::new(world.scenario(), controllers);
    // Behind these the file may be cut off.
    for recorded in reader.steps().take(step as usize) {
        ledger.relive(&recorded.map_err(ReplayError::from)?);
    }
    Ok(InProcess::going_on(world, &ledger, coordinators, controllers))
}
