//! A step that is shown when it is over, while others work on the next one: what of it would be gone by then.

use super::{Ledger, Observer, Seat};
use crate::step::{CommandPart, POLICY_NONE, StepFrames};
use crate::transport::TransportError;
use ipc_schemas::{Assignment, FrameHeader, VehicleState};

/// A step that has been kept; its commands and coordination are in the ledger.
#[derive(Debug, Default)]
pub(super) struct KeptStep {
    header: FrameHeader,
    state: Vec<VehicleState>,
    state_hash: u64,
    generations: Vec<u32>,
    misses: u64,
    policy: u32,
    stage: Stage,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Stage {
    #[default]
    None,
    /// Others are at it.
    Begun,
    /// Everybody has answered, or it is the last, which nobody answers.
    Over,
}

impl KeptStep {
    /// Keeps the state of a step.
    pub fn keep(
        &mut self,
        header: FrameHeader,
        state: impl Iterator<Item = VehicleState>,
        state_hash: u64,
        is_over: bool,
    ) {
        (self.header, self.state_hash) = (header, state_hash);
        self.state.clear();
        self.state.extend(state);
        self.generations.clear();
        (self.misses, self.policy) = (0, POLICY_NONE);
        self.stage = if is_over { Stage::Over } else { Stage::Begun };
    }

    /// The step has been answered, by those who have these places, or the world in place of some.
    pub fn end(&mut self, controllers: &[Seat], misses: u64, verdict: u16) {
        if self.stage == Stage::Begun {
            self.stage = Stage::Over;
            self.generations.extend(controllers.iter().map(|seat| seat.generation));
            self.misses = misses;
            self.policy = if misses == 0 { POLICY_NONE } else { u32::from(verdict) };
        }
    }

    /// Whether it is there, and over.
    pub fn is_over(&self) -> bool {
        self.stage == Stage::Over
    }

    /// Shows it, once. The ledger is past the step, and not past the one after it.
    pub fn show(&mut self, ledger: &mut Ledger, observer: &mut dyn Observer) -> Result<(), TransportError> {
        self.stage = Stage::None;
        let news: Vec<Assignment> = ledger.news().concat();
        let part = |(index, generation): (usize, &u32)| CommandPart {
            generation: *generation,
            records: ledger.commands_before(index),
        };
        let commands: Vec<CommandPart<'_>> = self.generations.iter().enumerate().map(part).collect();
        observer.observe(&StepFrames {
            header: self.header,
            state: &self.state,
            summaries: &[],
            coordination: &[&news],
            commands: &commands,
            // Told to controllers, and of no use to who looks on.
            feedback: &[],
            misses: self.misses,
            policy: self.policy,
            state_hash: self.state_hash,
        })
    }
}
