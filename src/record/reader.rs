//! A recording read back, from bytes nobody vouches for.
//!
//! A file that was closed in order has an index and is read by it. In any other the blocks are looked for one
//! after the other. Either way a step is handed out only after its checksum has been compared, and nothing
//! is allocated that is larger than the file.

use super::block::{BLOCK_MAGIC, BlockFault, BlockHead, HEAD, Step};
use super::format::{
    Digest, END_MAGIC, EndHead, Entry, FILE_MAGIC, FORMAT_VERSION, FileHead, Footer, Metadata, Seal,
    TAIL_MAGIC, Tail, digest, next_link, unpadded,
};
use crate::scenario::{DecodeError, Scenario, ScenarioFault, decode, scenario_hash};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::Arc;
use zerocopy::{FromBytes, IntoBytes};

/// Bytes that can be read at any place.
pub trait Source {
    /// Their number.
    fn length(&self) -> u64;
    /// Fills the buffer from the bytes at `offset`, all of which are there.
    fn read_at(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()>;
}

/// A file, as long as it was when it was opened.
///
/// Read, not mapped: a mapped file that somebody cuts short ends the reader with a signal.
#[derive(Debug)]
pub struct FileSource {
    file: File,
    length: u64,
}

impl Source for FileSource {
    fn length(&self) -> u64 {
        self.length
    }

    fn read_at(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(buffer, offset)
    }
}

impl Source for &[u8] {
    fn length(&self) -> u64 {
        self.len() as u64
    }

    fn read_at(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()> {
        let from = usize::try_from(offset).ok().and_then(|offset| self.get(offset..));
        match from.and_then(|from| from.get(..buffer.len())) {
            Some(bytes) => buffer.copy_from_slice(bytes),
            None => return Err(io::ErrorKind::UnexpectedEof.into()),
        }
        Ok(())
    }
}

/// Why a file cannot be read as a recording at all.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// It cannot be read.
    #[error("cannot read it: {0}")]
    Io(#[from] io::Error),
    /// It does not start as a recording does.
    #[error("not a recording: it does not begin as a .czlog file does")]
    NotARecording,
    /// It was written by another version of the format.
    #[error("the recording has format version {found}, this program reads version {FORMAT_VERSION}")]
    OtherVersion {
        /// The file's.
        found: u32,
    },
    /// The head or the metadata is cut off or damaged; without it no step means anything.
    #[error("the head of the file is {0}")]
    Head(&'static str),
    /// The records have another layout.
    #[error("its records have schema {found:016x}, this program's have {expected:016x}")]
    OtherSchema {
        /// Ours.
        expected: u64,
        /// The file's.
        found: u64,
    },
    /// The metadata cannot be decoded.
    #[error("the metadata cannot be read: {0}")]
    Metadata(DecodeError),
    /// The scenario cannot be decoded.
    #[error("the scenario in it cannot be read: {0}")]
    Scenario(DecodeError),
    /// The scenario is none that the loader would have let pass.
    #[error("the scenario in it is not valid: {0}")]
    BadScenario(#[from] ScenarioFault),
    /// The metadata contradicts the scenario.
    #[error("the metadata contradicts itself: {0}")]
    Contradiction(&'static str),
}

/// A place where the file is not what it should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Bytes from the start of the file.
    pub offset: u64,
    /// The sound step before that place.
    pub after: Option<u64>,
    /// What is wrong.
    pub flaw: Flaw,
}

/// What is wrong at a damaged place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Flaw {
    /// The file ends within a step, or within its end section: whatever follows was never written.
    CutOff,
    /// What should be a step is none.
    Block(BlockFault),
    /// The checksum of a step does not fit.
    Digest,
    /// A step that is sound by itself is not the one that was written after the one before it.
    Chain,
    /// A step comes twice, or before an earlier one.
    Order {
        /// The step.
        step: u64,
    },
    /// The index, the footer or the tail is damaged; steps do not depend on them.
    End,
    /// The footer tells of another last step than the file has.
    Footer,
    /// The file could not be read there.
    Io(String),
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "byte {}", self.offset)?;
        match self.after {
            Some(step) => write!(f, ", after step {step}: ")?,
            None => write!(f, ", before the first step: ")?,
        }
        match &self.flaw {
            Flaw::CutOff => f.write_str("the file is cut off"),
            Flaw::Block(fault) => write!(f, "{fault}"),
            Flaw::Digest => f.write_str("the checksum of the step does not fit"),
            Flaw::Chain => f.write_str("the step is not the one that was written here"),
            Flaw::Order { step } => write!(f, "step {step} is out of order"),
            Flaw::End => f.write_str("the index or the footer is damaged or cut off"),
            Flaw::Footer => f.write_str("the footer tells of other steps than the file has"),
            Flaw::Io(error) => write!(f, "cannot read: {error}"),
        }
    }
}

impl std::error::Error for Damage {}

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

/// A sound end section.
#[derive(Debug)]
struct End {
    offset: u64,
    footer: Footer,
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
        let mut magic = [0; FILE_MAGIC.len()];
        if source.length() < magic.len() as u64 {
            return Err(OpenError::NotARecording);
        }
        source.read_at(0, &mut magic)?;
        if magic != FILE_MAGIC {
            return Err(OpenError::NotARecording);
        }
        let cut_off = OpenError::Head("cut off");
        let Some(head) = fixed::<FileHead, S>(&source, 0)? else { return Err(cut_off) };
        if head.version != FORMAT_VERSION {
            return Err(OpenError::OtherVersion { found: head.version });
        }
        let begin = size_of::<FileHead>() as u64;
        let Some(bytes) = bytes(&source, begin, head.metadata)? else { return Err(cut_off) };
        if head.digest != head.digest_with(&bytes) {
            return Err(OpenError::Head("damaged"));
        }
        let expected = ipc_schemas::schema_hash();
        if head.schema_hash != expected {
            return Err(OpenError::OtherSchema { expected, found: head.schema_hash });
        }
        let metadata: Metadata = unpadded(&bytes).map_err(OpenError::Metadata)?;
        let scenario = sound_scenario(&metadata)?;
        let mut reader = Reader {
            source,
            metadata,
            scenario: Arc::new(scenario),
            first: begin + head.metadata,
            first_link: head.digest,
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
        let mut steps = self.steps_from(at.saturating_sub(2));
        while let Some(read) = steps.next() {
            if steps.next > at {
                return read.map(Some);
            }
        }
        Ok(None)
    }

    /// All steps in order, and between them every place where the file is damaged.
    pub fn steps(&self) -> Steps<'_, S> {
        self.steps_from(0)
    }

    /// The same from one of the steps on; of that one it is not known what it must follow.
    fn steps_from(&self, next: usize) -> Steps<'_, S> {
        let (at, link) = if next == 0 { (self.first, Some(self.first_link)) } else { (u64::MAX, None) };
        let damage = self.damage.partition_point(|(before, _)| *before < next);
        Steps { reader: self, next, damage, at, link, ended: false }
    }

    /// Uses the index at the end of the file; `false` when there is none, or none that is sound.
    fn read_index(&mut self) -> Result<bool, OpenError> {
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
    fn end_section(&self, at: u64) -> Result<Option<(Vec<Entry>, End, u64)>, OpenError> {
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
    fn end_length(&self, at: u64) -> io::Result<Option<u64>> {
        let head = fixed::<EndHead, S>(&self.source, at)?;
        let head = head.filter(|head| head.magic == END_MAGIC && head.check == head.checksum());
        let left = self.source.length().saturating_sub(at);
        Ok(head.and_then(|head| head.section()).filter(|length| *length <= left))
    }

    /// Looks for the steps one after the other.
    fn scan(&mut self) -> Result<(), OpenError> {
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

    /// Bytes of the block at this place with its seal, if its head is sound and the file holds it.
    fn block_length(&self, at: u64) -> Result<u64, Flaw> {
        let left = self.source.length().saturating_sub(at);
        let mut head = [0; HEAD];
        if left < HEAD as u64 {
            return Err(Flaw::CutOff);
        }
        self.source.read_at(at, &mut head).map_err(io_flaw)?;
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
        let mut block = bytes(&self.source, at, length).map_err(io_flaw)?.ok_or(Flaw::CutOff)?;
        let own = block.len() - size_of::<Seal>();
        let seal = Seal::read_from_bytes(&block[own..]).expect("a seal is as long as a seal");
        block.truncate(own);
        if digest(&[&block]) != seal.digest {
            return Err(Flaw::Digest);
        }
        Ok((block, seal, at + length))
    }
}

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

impl<S: Source> Steps<'_, S> {
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

/// The step of a sound block, if it has this number.
fn numbered(block: &[u8], step: u64) -> Result<Step, Flaw> {
    let found = Step::decode(block).map_err(Flaw::Block)?;
    if found.header.step == step { Ok(found) } else { Err(Flaw::Order { step: found.header.step }) }
}

fn io_flaw(error: io::Error) -> Flaw {
    Flaw::Io(error.to_string())
}

/// A value of fixed size; `None` when the file ends before it does.
fn fixed<T: FromBytes + IntoBytes, S: Source>(source: &S, offset: u64) -> io::Result<Option<T>> {
    if source.length().saturating_sub(offset) < size_of::<T>() as u64 {
        return Ok(None);
    }
    let mut value = T::new_zeroed();
    source.read_at(offset, value.as_mut_bytes())?;
    Ok(Some(value))
}

/// So many bytes; `None` when the file ends before that.
fn bytes<S: Source>(source: &S, offset: u64, length: u64) -> io::Result<Option<Vec<u8>>> {
    if source.length().saturating_sub(offset) < length {
        return Ok(None);
    }
    let mut bytes = vec![0; length as usize];
    source.read_at(offset, &mut bytes)?;
    Ok(Some(bytes))
}

fn sound_scenario(metadata: &Metadata) -> Result<Scenario, OpenError> {
    let scenario = decode(&metadata.scenario).map_err(OpenError::Scenario)?;
    scenario.check()?;
    if scenario_hash(&scenario) != metadata.scenario_hash {
        return Err(OpenError::Contradiction("another scenario hash than the scenario's"));
    }
    if scenario.dt_ns != metadata.dt_ns || scenario.seed != metadata.seed {
        return Err(OpenError::Contradiction("another step or seed than the scenario's"));
    }
    let zones = scenario.network.zones.len() as u32;
    let plugins = scenario.plugins.len() as u32;
    let coordinators = 1..=zones.min(crate::scenario::share::MAX_COORDINATORS);
    let pool = metadata.controllers.checked_sub(plugins);
    let shared_out = pool.is_some_and(|pool| pool <= zones && scenario.controllers(pool) == pool + plugins);
    if !coordinators.contains(&metadata.coordinators)
        || metadata.controllers > crate::scenario::share::MAX_CONTROLLERS
        || !shared_out
    {
        return Err(OpenError::Contradiction("numbers of processes the scenario cannot have"));
    }
    Ok(scenario)
}
