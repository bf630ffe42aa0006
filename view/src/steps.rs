//! Where the steps that are looked at come from.

use control_zones::record::{FileSource, Reader};
use control_zones::step::Step;
use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Steps by number.
pub trait Steps: Send + Sync {
    /// The first and the last that is there.
    fn range(&self) -> Option<(u64, u64)>;
    /// One of them, or why it cannot be read; `None` when it is not there.
    fn step(&self, number: u64) -> Result<Option<Step>, String>;
    /// The last one up to this number that is there.
    fn last_until(&self, number: u64) -> Option<u64>;
}

impl Steps for Reader<FileSource> {
    fn range(&self) -> Option<(u64, u64)> {
        let mut numbers = self.step_numbers();
        let first = numbers.next()?;
        Some((first, numbers.next_back().unwrap_or(first)))
    }

    fn step(&self, number: u64) -> Result<Option<Step>, String> {
        Reader::step(self, number).map_err(|damage| format!("damaged at {damage}"))
    }

    fn last_until(&self, number: u64) -> Option<u64> {
        self.step_numbers().rev().find(|step| *step <= number)
    }
}

/// Memory for the steps of a run that goes on, bytes; the oldest give way.
const KEPT_BYTES: usize = 512 << 20;

/// The steps of a run that goes on, as far back as there is memory for.
#[derive(Debug, Default)]
pub struct Kept(Mutex<Blocks>);

#[derive(Debug, Default)]
struct Blocks {
    by_step: BTreeMap<u64, Box<[u8]>>,
    bytes: usize,
}

impl Kept {
    /// Keeps the block of a step.
    pub fn keep(&self, step: u64, block: &[u8]) {
        let mut blocks = self.blocks();
        blocks.bytes += block.len();
        if let Some(before) = blocks.by_step.insert(step, block.into()) {
            blocks.bytes -= before.len();
        }
        while blocks.bytes > KEPT_BYTES {
            let Some((_, oldest)) = blocks.by_step.pop_first() else { break };
            blocks.bytes -= oldest.len();
        }
    }

    fn blocks(&self) -> MutexGuard<'_, Blocks> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Steps for Kept {
    fn range(&self) -> Option<(u64, u64)> {
        let blocks = self.blocks();
        Some((*blocks.by_step.first_key_value()?.0, *blocks.by_step.last_key_value()?.0))
    }

    fn step(&self, number: u64) -> Result<Option<Step>, String> {
        let blocks = self.blocks();
        let Some(block) = blocks.by_step.get(&number) else { return Ok(None) };
        Step::decode(block).map(Some).map_err(|fault| fault.to_string())
    }

    fn last_until(&self, number: u64) -> Option<u64> {
        self.blocks().by_step.range(..=number).next_back().map(|(step, _)| *step)
    }
}
