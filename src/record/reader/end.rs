//! The end of a file that was closed in order: index, footer and tail.

use super::super::format::{Digest, END_MAGIC, EndHead, Entry, Footer, TAIL_MAGIC, Tail, digest, unpadded};
use super::source::{bytes, fixed};
use super::{OpenError, Reader, Source};
use std::io;
use zerocopy::FromBytes;

/// A sound end section.
#[derive(Debug)]
pub(super) struct End {
    pub offset: u64,
    pub footer: Footer,
}

impl<S: Source> Reader<S> {
    /// Uses the index at the end of the file; `false` when there is none, or none that is sound.
    pub(super) fn read_index(&mut self) -> Result<bool, OpenError> {
        let Some(at) = self.source.length().checked_sub(size_of::<Tail>() as u64) else { return Ok(false) };
        let Some(tail) = fixed::<Tail, S>(&self.source, at)? else { return Ok(false) };
        if tail.magic != TAIL_MAGIC || tail.check != tail.checksum() || tail.end < self.first {
            return Ok(false);
        }
        let Some((steps, end, next)) = self.end_section(tail.end)? else { return Ok(false) };
        let ascending = steps.windows(2).all(|w| w[0].step < w[1].step && w[0].offset < w[1].offset);
        let begins = steps.first().map_or(tail.end, |entry| entry.offset) == self.first;
        let within = steps.last().is_none_or(|entry| entry.offset < tail.end);
        if next != at || !ascending || !begins || !within {
            return Ok(false);
        }
        self.steps = steps;
        self.end = Some(end);
        Ok(true)
    }

    /// The index and the footer at this place, and the place after them; `None` when there is no sound end
    /// section.
    pub(super) fn end_section(&self, at: u64) -> Result<Option<(Vec<Entry>, End, u64)>, OpenError> {
        let Some(section) = self.end_length(at)? else { return Ok(None) };
        let Some(all) = bytes(&self.source, at, section)? else { return Ok(None) };
        let Ok((head, _)) = EndHead::read_from_prefix(&all) else { return Ok(None) };
        let (body, seal) = all.split_at(all.len() - size_of::<Digest>());
        if digest(&[body]) != seal {
            return Ok(None);
        }
        let index_length = head.entries as usize * size_of::<Entry>();
        let (index, footer) = body[size_of::<EndHead>()..].split_at(index_length);
        let entries = index.chunks_exact(size_of::<Entry>()).filter_map(|e| Entry::read_from_bytes(e).ok());
        let Ok(footer) = unpadded::<Footer>(footer) else { return Ok(None) };
        Ok(Some((entries.collect(), End { offset: at, footer }, at + section)))
    }

    /// Bytes of the end section at this place, if its head is sound and the file holds it.
    pub(super) fn end_length(&self, at: u64) -> io::Result<Option<u64>> {
        let head = fixed::<EndHead, S>(&self.source, at)?;
        let head = head.filter(|head| head.magic == END_MAGIC && head.check == head.checksum());
        let left = self.source.length().saturating_sub(at);
        Ok(head.and_then(|head| head.section()).filter(|length| *length <= left))
    }
}
