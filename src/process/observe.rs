//! Looking on: the steps of a run, as blocks of bytes, for whoever records them.

use super::{ProcessError, StopFlag};
use crate::lockstep::Observer;
use crate::scenario::Scenario;
use crate::step::{Step, StepFrames};
use crate::transport::TransportError;
use crate::transport::iox::{BlockOutbox, RunName, RunSpace, SpaceError};
use ipc_schemas::{Assignment, SERVICE_OBSERVER, VehicleCommand, VehicleState};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What becomes of a step that the recorder cannot take yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordLag {
    /// It is left out of the recording, which says so; the run keeps its time.
    Drop,
    /// The run waits; the recording is whole.
    Wait,
}

/// The world's side: publishes each step.
#[derive(Debug)]
pub(super) struct ObservedSteps {
    pub outbox: BlockOutbox,
    lag: RecordLag,
    /// How long a step may wait to be taken.
    patience: Duration,
    stop: StopFlag,
    /// Nothing follows what was lost, so that what was recorded has no gap.
    ended: bool,
}

/// Time between two tries to hand on a step that is to wait.
const RETRY: Duration = Duration::from_micros(100);

impl Observer for ObservedSteps {
    fn observe(&mut self, frames: &StepFrames<'_>) -> Result<(), TransportError> {
        let length = frames.encoded_len();
        let mut since = None;
        while !self.ended {
            let taken = self.outbox.send(length, |write| frames.encode(write))?;
            if taken || self.lag == RecordLag::Drop {
                break;
            }
            let waited = since.get_or_insert_with(Instant::now).elapsed();
            // Whoever recorded has gone, or the run is to end.
            self.ended = !self.outbox.has_reader() || self.stop.is_set();
            if waited >= self.patience {
                let seconds = self.patience.as_secs_f64();
                let reason = format!(
                    "whoever records the run has taken no step for {seconds} s; --record-lag drop leaves out what it \
                     cannot take"
                );
                return Err(TransportError::Failed { service: SERVICE_OBSERVER.to_owned(), reason });
            }
            std::thread::sleep(RETRY);
        }
        Ok(())
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
    (lag, patience): (RecordLag, Duration),
    stop: &StopFlag,
) -> Result<ObservedSteps, SpaceError> {
    let per_vehicle = size_of::<VehicleState>() + size_of::<VehicleCommand>() + 2 * size_of::<Assignment>();
    let expected = vehicles * per_vehicle + 64 * scenario.network.zones.len() + 1024;
    let waiting = (WAITING_BYTES / expected).clamp(FEWEST_WAITING, MOST_WAITING);
    let outbox = space.create_blocks(SERVICE_OBSERVER, expected, (waiting, 1), lag == RecordLag::Drop)?;
    Ok(ObservedSteps { outbox, lag, patience, stop: stop.clone(), ended: false })
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
