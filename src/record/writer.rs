//! A recording as a stream of bytes: head, sealed blocks, end.

use super::block::{BlockFault, BlockHead};
use super::format::{
    Digest, EndHead, Entry, FileHead, Footer, Metadata, RunEnd, RunEvent, Seal, Tail, digest, padded,
};
use std::io::{self, Write};
use zerocopy::IntoBytes;

/// Writes a recording to anything that takes bytes.
#[derive(Debug)]
pub struct Writer<W> {
    out: W,
    offset: u64,
    link: Digest,
    index: Vec<Entry>,
    state_hash: u64,
    events: Vec<RunEvent>,
}

/// Why a block was not written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// It is no block.
    #[error("not a recorded step: {0}")]
    Block(#[from] BlockFault),
    /// Its step is not after the one before.
    #[error("step {step} comes after step {last}")]
    Order {
        /// The block's.
        step: u64,
        /// The one written before.
        last: u64,
    },
    /// The output failed.
    #[error(transparent)]
    Io(#[from] io::Error),
}

impl<W: Write> Writer<W> {
    /// Begins a recording.
    pub fn new(mut out: W, metadata: &Metadata) -> io::Result<Writer<W>> {
        let metadata = padded(metadata);
        let head = FileHead::new(ipc_schemas::schema_hash(), &metadata);
        out.write_all(head.as_bytes())?;
        out.write_all(&metadata)?;
        let offset = (size_of::<FileHead>() + metadata.len()) as u64;
        Ok(Writer { out, offset, link: head.digest, index: Vec::new(), state_hash: 0, events: Vec::new() })
    }

    /// Appends a step's block and seals it.
    pub fn append(&mut self, block: &[u8]) -> Result<(), WriteError> {
        let head = BlockHead::of(block)?;
        if head.length != block.len() as u64 {
            return Err(BlockFault::Counts.into());
        }
        let step = head.header.step;
        if let Some(last) = self.last_step().filter(|last| step <= *last) {
            return Err(WriteError::Order { step, last });
        }
        let seal = Seal::new(&self.link, block);
        self.out.write_all(block)?;
        self.out.write_all(seal.as_bytes())?;
        self.index.push(Entry { step, offset: self.offset });
        self.offset += head.length + size_of::<Seal>() as u64;
        self.link = seal.link;
        self.state_hash = head.state_hash;
        Ok(())
    }

    /// Hands what has been buffered to the system.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// What is written to.
    pub(super) fn out_mut(&mut self) -> &mut W {
        &mut self.out
    }

    /// The step written last.
    pub fn last_step(&self) -> Option<u64> {
        self.index.last().map(|entry| entry.step)
    }

    /// Number of steps written.
    pub fn steps(&self) -> u64 {
        self.index.len() as u64
    }

    /// Bytes written.
    pub fn bytes(&self) -> u64 {
        self.offset
    }

    /// What happened to the run beside its steps, for its end.
    pub fn happened(&mut self, events: Vec<RunEvent>) {
        self.events = events;
    }

    /// Ends the recording: index, footer, tail. Returns the number of bytes of it all as well.
    pub fn finish(mut self, end: RunEnd, missing: Vec<(u64, u64)>) -> io::Result<(W, Footer, u64)> {
        let steps = self.steps();
        let events = std::mem::take(&mut self.events);
        let footer = Footer { steps, state_hash: self.state_hash, end, missing, link: self.link, events };
        let bytes = padded(&footer);
        let head = EndHead::new(self.index.len(), bytes.len());
        let seal = digest(&[head.as_bytes(), self.index.as_bytes(), &bytes]);
        let tail = Tail::new(self.offset);
        for piece in [head.as_bytes(), self.index.as_bytes(), &bytes, &seal, tail.as_bytes()] {
            self.out.write_all(piece)?;
            self.offset += piece.len() as u64;
        }
        self.out.flush()?;
        Ok((self.out, footer, self.offset))
    }
}
