//! Looking on: the steps of a run, as blocks of bytes, for whoever records them.

use super::ProcessError;
use crate::lockstep::Observer;
use crate::scenario::Scenario;
use crate::step::{Step, StepFrames};
use crate::transport::TransportError;
use crate::transport::iox::{BlockOutbox, RunName, RunSpace, SpaceError};
use ipc_schemas::{Assignment, SERVICE_OBSERVER, VehicleCommand, VehicleState};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// The world's side: publishes each step.
#[derive(Debug)]
pub(super) struct ObservedSteps(pub BlockOutbox);

impl Observer for ObservedSteps {
    fn observe(&mut self, frames: &StepFrames<'_>) -> Result<(), TransportError> {
        self.0.send(frames.encoded_len(), |write| frames.encode(write))
    }
}

/// Memory for steps that wait to be taken, bytes, and the greatest number of them.
const WAITING_BYTES: usize = 64 << 20;
const MOST_WAITING: usize = 8192;
/// Some always may.
const FEWEST_WAITING: usize = 16;

/// Creates the service on which a run of so many vehicles at once can be looked on.
pub(super) fn create(
    space: &RunSpace,
    vehicles: usize,
    scenario: &Scenario,
) -> Result<ObservedSteps, SpaceError> {
    let per_vehicle = size_of::<VehicleState>() + size_of::<VehicleCommand>() + 2 * size_of::<Assignment>();
    let expected = vehicles * per_vehicle + 64 * scenario.network.zones.len() + 1024;
    let waiting = (WAITING_BYTES / expected).clamp(FEWEST_WAITING, MOST_WAITING);
    space.create_blocks(SERVICE_OBSERVER, expected, waiting).map(ObservedSteps)
}

/// A thread that takes the steps of a run.
#[derive(Debug)]
pub struct Observation<T> {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Result<T, ProcessError>>,
}

/// Time between two looks for steps.
const LOOK: Duration = Duration::from_micros(200);

impl<T: Send + 'static> Observation<T> {
    /// Hands the steps of a run that is about to begin to `take`, with number and block, until told to stop.
    pub fn start(
        run: RunName,
        mut state: T,
        take: impl Fn(&mut T, u64, &[u8]) + Send + 'static,
    ) -> Observation<T> {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            let space = RunSpace::enter(&run)?;
            let inbox = loop {
                if let Some(inbox) = space.open_blocks(SERVICE_OBSERVER)? {
                    break inbox;
                }
                if stopped.load(Ordering::Relaxed) {
                    return Ok(state);
                }
                std::thread::sleep(Duration::from_millis(1));
            };
            loop {
                // In this order: what was sent before the stop is taken.
                let last_round = stopped.load(Ordering::Relaxed);
                while let Some(block) = inbox.receive()? {
                    if let Some(step) = Step::number_in(block.bytes()) {
                        take(&mut state, step, block.bytes());
                    }
                }
                if last_round {
                    return Ok(state);
                }
                std::thread::sleep(LOOK);
            }
        });
        Observation { stop, thread }
    }

    /// Takes what is left and ends.
    pub fn stop(self) -> Result<T, ProcessError> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the observer's thread returns its errors")
    }
}
