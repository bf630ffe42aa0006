//! Runs in one process.

use super::outcome::{History, Outcome, StepMeter};
use super::world::STEPS_PER_LOOK;
use super::{ProcessError, StopFlag};
use crate::lockstep::in_process::InProcess;
use crate::scenario::Scenario;
use crate::step::StepFrames;
use crate::world::World;
use std::sync::Arc;

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
    run: InProcess,
    stop: &StopFlag,
    progress: impl FnMut(&World),
) -> Result<Outcome, ProcessError> {
    run_on_in_process_observed(run, stop, progress, |_| {})
}

/// The same of one that is observed, and shows the frames of every step.
pub fn run_on_in_process_observed(
    mut run: InProcess,
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
