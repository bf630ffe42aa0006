//! The steps of a file without a sound index, looked for one after the other.

use super::super::block::BLOCK_MAGIC;
use super::super::format::{Digest, END_MAGIC, Entry, Seal, next_link};
use super::{Damage, Flaw, OpenError, Reader, Source};
use crate::step::Step;
use std::io;

impl<S: Source> Reader<S> {
    /// Looks for the steps one after the other.
    pub(super) fn scan(&mut self) -> Result<(), OpenError> {
        let mut at = self.first;
        let mut link = Some(self.first_link);
        // What may be hashed in vain, so that a file made for it cannot keep a reader busy for ever.
        let mut budget = self.source.length().saturating_mul(4);
        while at < self.source.length() {
            if let Some((_, end, next)) = self.end_section(at)? {
                // The tail is damaged, or missing: else the index would have been used.
                self.note(if next < self.source.length() { next } else { at }, Flaw::End);
                self.end = Some(end);
                return Ok(());
            }
            let flaw = match self.block(at) {
                Ok((block, seal, next)) => match self.accept(at, &block, &seal, link) {
                    Ok(()) => {
                        (at, link) = (next, Some(seal.link));
                        continue;
                    }
                    Err(flaw) => flaw,
                },
                Err(Flaw::Io(error)) => return Err(OpenError::Io(io::Error::other(error))),
                Err(flaw) => flaw,
            };
            self.note(at, flaw);
            link = None;
            match self.resume(at + 1, &mut budget)? {
                Some(next) => at = next,
                None => return Ok(()),
            }
        }
        Ok(())
    }

    /// Takes a block into the list of steps.
    fn accept(&mut self, at: u64, block: &[u8], seal: &Seal, link: Option<Digest>) -> Result<(), Flaw> {
        let step = Step::decode(block).map_err(Flaw::Block)?.header.step;
        if self.steps.last().is_some_and(|last| step <= last.step) {
            return Err(Flaw::Order { step });
        }
        if link.is_some_and(|link| next_link(&link, &seal.digest) != seal.link) {
            return Err(Flaw::Chain);
        }
        self.steps.push(Entry { step, offset: at });
        Ok(())
    }

    fn note(&mut self, offset: u64, flaw: Flaw) {
        let after = self.steps.last().map(|entry| entry.step);
        self.damage.push((self.steps.len(), Damage { offset, after, flaw }));
    }

    /// The next place from `from` on with a sound block or end section.
    fn resume(&self, from: u64, budget: &mut u64) -> Result<Option<u64>, OpenError> {
        const CHUNK: u64 = 1 << 20;
        const MAGIC: u64 = BLOCK_MAGIC.len() as u64;
        let mut buffer = Vec::new();
        let mut at = from;
        while self.source.length().saturating_sub(at) >= MAGIC {
            buffer.resize((self.source.length() - at).min(CHUNK) as usize, 0);
            self.source.read_at(at, &mut buffer)?;
            for (offset, word) in (at..).zip(buffer.windows(BLOCK_MAGIC.len())) {
                let length = match word {
                    _ if word == BLOCK_MAGIC => self.block_length(offset).ok(),
                    _ if word == END_MAGIC => self.end_length(offset)?,
                    _ => None,
                };
                let Some(length) = length else { continue };
                let Some(left) = budget.checked_sub(length) else { return Ok(None) };
                *budget = left;
                if self.block(offset).is_ok() || self.end_section(offset)?.is_some() {
                    return Ok(Some(offset));
                }
            }
            // A magic may lie across two chunks.
            at += buffer.len() as u64 - (MAGIC - 1);
        }
        Ok(None)
    }
}
