//! All steps of a recording, one after the other.

use super::super::format::{Digest, Entry, next_link};
use super::{Damage, Flaw, Reader, Source, numbered};
use crate::step::Step;

/// The steps of a recording in order; a damaged place is an error, after which the rest follows.
#[derive(Debug)]
pub struct Steps<'r, S> {
    reader: &'r Reader<S>,
    /// Step and damage to come next.
    next: usize,
    damage: usize,
    /// Where the next block must be, and the link before it when it is known.
    at: u64,
    link: Option<Digest>,
    ended: bool,
}

impl<'r, S: Source> Steps<'r, S> {
    /// From one of the steps on; unless it is the first, it is not known what that one must follow.
    pub(super) fn from(reader: &'r Reader<S>, next: usize) -> Steps<'r, S> {
        let (at, link) = if next == 0 { (reader.first, Some(reader.first_link)) } else { (u64::MAX, None) };
        let damage = reader.damage.partition_point(|(before, _)| *before < next);
        Steps { reader, next, damage, at, link, ended: false }
    }

    /// The place of the step to come next.
    pub(super) fn behind(&self) -> usize {
        self.next
    }

    fn read(&mut self, entry: Entry) -> Result<Step, Flaw> {
        let reader = self.reader;
        let expected = std::mem::replace(&mut self.at, u64::MAX);
        let link = self.link.take();
        let (block, seal, next) = reader.block(entry.offset)?;
        (self.at, self.link) = (next, Some(seal.link));
        // Blocks lie side by side, except behind a damaged place.
        let aside = expected != entry.offset && expected != u64::MAX;
        if aside || link.is_some_and(|link| next_link(&link, &seal.digest) != seal.link) {
            self.link = None;
            return Err(Flaw::Chain);
        }
        numbered(&block, entry.step)
    }
}

impl<S: Source> Iterator for Steps<'_, S> {
    type Item = Result<Step, Damage>;

    fn next(&mut self) -> Option<Self::Item> {
        let reader = self.reader;
        if let Some((before, damage)) = reader.damage.get(self.damage)
            && *before <= self.next
        {
            self.damage += 1;
            (self.at, self.link) = (u64::MAX, None);
            return Some(Err(damage.clone()));
        }
        let after = self.next.checked_sub(1).map(|before| reader.steps[before].step);
        if let Some(&entry) = reader.steps.get(self.next) {
            self.next += 1;
            return Some(self.read(entry).map_err(|flaw| Damage { offset: entry.offset, after, flaw }));
        }
        let end = reader.end.as_ref().filter(|_| !std::mem::replace(&mut self.ended, true))?;
        let footer = &end.footer;
        let whole = footer.steps == reader.steps.len() as u64
            && (self.at == u64::MAX || self.at == end.offset)
            && self.link.is_none_or(|link| link == footer.link);
        (!whole).then_some(Err(Damage { offset: end.offset, after, flaw: Flaw::Footer }))
    }
}
