//! A recording read back, from bytes nobody vouches for.
//!
//! A file that was closed in order has an index and is read by it. In any other the blocks are looked for one
//! after the other. Either way a step is handed out only after its checksum has been compared, and nothing
//! is allocated that is larger than the file.

mod damage;
mod end;
mod head;
mod scan;
mod source;
mod steps;

pub use damage::{Damage, Flaw};
pub use head::{Builds, OpenError};
pub use source::{FileSource, Source};
pub use steps::Steps;

use super::block::{BlockHead, HEAD};
use super::format::{Digest, END_MAGIC, Entry, Footer, Metadata, RunEvent, Seal, digest};
use crate::scenario::Scenario;
use crate::step::Step;
use end::End;
use head::Head;
use source::bytes;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use zerocopy::FromBytes;

/// A recording.
#[derive(Debug)]
pub struct Reader<S> {
    source: S,
    metadata: Metadata,
    scenario: Arc<Scenario>,
    /// Where the first block is, and the link before it.
    first: u64,
    first_link: Digest,
    /// Steps ascending.
    steps: Vec<Entry>,
    /// Where a file without sound index is damaged, and how many steps are before that.
    damage: Vec<(usize, Damage)>,
    end: Option<End>,
}

impl Reader<FileSource> {
    /// Opens a recording.
    pub fn open(path: &Path) -> Result<Reader<FileSource>, OpenError> {
        let file = File::open(path)?;
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(OpenError::NotARecording);
        }
        Reader::new(FileSource { file, length: metadata.len() })
    }
}

impl<S: Source> Reader<S> {
    /// Reads head and index, or looks for the steps where there is no sound index.
    pub fn new(source: S) -> Result<Reader<S>, OpenError> {
        let Head { metadata, scenario, first, first_link } = Head::read(&source)?;
        let mut reader = Reader {
            source,
            metadata,
            scenario,
            first,
            first_link,
            steps: Vec::new(),
            damage: Vec::new(),
            end: None,
        };
        if !reader.read_index()? {
            reader.scan()?;
        }
        Ok(reader)
    }

    /// What the recording is of.
    pub fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// The scenario of the run.
    pub fn scenario(&self) -> &Arc<Scenario> {
        &self.scenario
    }

    /// What is known at the end, when the file was closed in order.
    pub fn footer(&self) -> Option<&Footer> {
        self.end.as_ref().map(|end| &end.footer)
    }

    /// What happened to the run beside its steps; nothing is known where the recording was cut off.
    pub fn events(&self) -> &[RunEvent] {
        self.footer().map_or(&[], |footer| &footer.events)
    }

    /// Bytes of the file.
    pub fn length(&self) -> u64 {
        self.source.length()
    }

    /// The numbers of the steps that are there, ascending. Those of a file with an index have not been
    /// looked at yet.
    pub fn step_numbers(&self) -> impl DoubleEndedIterator<Item = u64> + ExactSizeIterator + '_ {
        self.steps.iter().map(|entry| entry.step)
    }

    /// Ranges of steps that are not in the file, first and last: between 0 and the last that is there, and
    /// those after it of which the footer knows.
    pub fn gaps(&self) -> Vec<(u64, u64)> {
        let mut next = 0;
        let mut gaps = Vec::new();
        for step in self.step_numbers() {
            if step > next {
                gaps.push((next, step - 1));
            }
            next = step.saturating_add(1);
        }
        let known = self.footer().map_or(&[][..], |footer| &footer.missing);
        gaps.extend(known.iter().filter(|(first, last)| *first >= next && first <= last));
        gaps
    }

    /// One step; `None` when the file does not have it. Refused exactly when it is damaged itself, or not the
    /// one that was written behind the step before it.
    pub fn step(&self, step: u64) -> Result<Option<Step>, Damage> {
        let Ok(at) = self.steps.binary_search_by_key(&step, |entry| entry.step) else { return Ok(None) };
        // The one before tells what this one must follow, if it is sound, which the one before that tells.
        let mut steps = Steps::from(self, at.saturating_sub(2));
        while let Some(read) = steps.next() {
            if steps.behind() > at {
                return read.map(Some);
            }
        }
        Ok(None)
    }

    /// All steps in order, and between them every place where the file is damaged.
    pub fn steps(&self) -> Steps<'_, S> {
        Steps::from(self, 0)
    }

    /// Bytes of the block at this place with its seal, if its head is sound and the file holds it.
    fn block_length(&self, at: u64) -> Result<u64, Flaw> {
        let left = self.source.length().saturating_sub(at);
        let mut head = [0; HEAD];
        if left < HEAD as u64 {
            return Err(Flaw::CutOff);
        }
        self.source.read_at(at, &mut head)?;
        let head = match BlockHead::of(&head) {
            Ok(head) => head,
            Err(_) if head.starts_with(&END_MAGIC) => return Err(Flaw::End),
            Err(fault) => return Err(Flaw::Block(fault)),
        };
        let length = head.length + size_of::<Seal>() as u64;
        if length > left { Err(Flaw::CutOff) } else { Ok(length) }
    }

    /// The block at this place, its seal, and the place after it.
    fn block(&self, at: u64) -> Result<(Vec<u8>, Seal, u64), Flaw> {
        let length = self.block_length(at)?;
        let mut block = bytes(&self.source, at, length)?.ok_or(Flaw::CutOff)?;
        let own = block.len() - size_of::<Seal>();
        let seal = Seal::read_from_bytes(&block[own..]).expect("a seal is as long as a seal");
        block.truncate(own);
        if digest(&[&block]) != seal.digest {
            return Err(Flaw::Digest);
        }
        Ok((block, seal, at + length))
    }
}

/// The step of a sound block, if it has this number.
fn numbered(block: &[u8], step: u64) -> Result<Step, Flaw> {
    let found = Step::decode(block).map_err(Flaw::Block)?;
    if found.header.step == step { Ok(found) } else { Err(Flaw::Order { step: found.header.step }) }
}
