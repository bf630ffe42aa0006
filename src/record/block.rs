//! One step as one block of bytes, which needs nothing outside itself to be read.
//!
//! ```text
//! BlockHead | Part per controller | states | summaries | assignments | commands | feedback
//! ```
//!
//! All parts are multiples of 8 bytes, little-endian, records as they travel. The head ends with a checksum
//! of its own, so that the length in it may be believed before the rest has been read.

use crate::step::{CommandPart, Commands, Step, StepFrames};
use ipc_schemas::{
    Assignment, Feedback, FrameHeader, Record, VehicleCommand, VehicleState, ZoneSummary, bytes_of,
    records_from,
};
use xxhash_rust::xxh3::xxh3_64;
use zerocopy::{FromBytes, Immutable, IntoBytes};

/// First bytes of a block.
pub const BLOCK_MAGIC: [u8; 8] = *b"CZstep\0\x01";

/// What a block starts with.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct BlockHead {
    pub magic: [u8; 8],
    /// Bytes of the whole block, this head included.
    pub length: u64,
    pub header: FrameHeader,
    pub state_hash: u64,
    pub misses: u64,
    pub summaries: u32,
    pub assignments: u32,
    pub commands: u32,
    pub controllers: u32,
    pub policy: u32,
    pub feedback: u32,
    /// XXH3-64 of all that is above.
    pub check: u64,
}

#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
struct PartHead {
    generation: u32,
    records: u32,
}

/// Bytes of a block's head.
pub(super) const HEAD: usize = size_of::<BlockHead>();

/// Bytes of a record of each section, in order.
const SIZES: [u64; 6] = [
    size_of::<PartHead>() as u64,
    size_of::<VehicleState>() as u64,
    size_of::<ZoneSummary>() as u64,
    size_of::<Assignment>() as u64,
    size_of::<VehicleCommand>() as u64,
    size_of::<Feedback>() as u64,
];

/// Why bytes are not a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BlockFault {
    /// They do not start as a block does.
    #[error("no step begins here")]
    NoBlock,
    /// The head's checksum does not fit.
    #[error("the head of the step is damaged")]
    Head,
    /// The counts in the head, or in the parts, contradict each other or the length.
    #[error("the counts of the step contradict its length")]
    Counts,
}

impl BlockHead {
    /// The head of a block that starts with these bytes; of the block's length it only says that it fits
    /// the head's own counts.
    pub fn of(bytes: &[u8]) -> Result<BlockHead, BlockFault> {
        let Ok((head, _)) = BlockHead::read_from_prefix(bytes) else { return Err(BlockFault::NoBlock) };
        if head.magic != BLOCK_MAGIC {
            return Err(BlockFault::NoBlock);
        }
        if head.check != head.checksum() {
            return Err(BlockFault::Head);
        }
        if head.length != head.length_by_counts() {
            return Err(BlockFault::Counts);
        }
        Ok(head)
    }

    /// Sets length and checksum to what the other fields ask for.
    pub fn seal(&mut self) {
        self.length = self.length_by_counts();
        self.check = self.checksum();
    }

    fn checksum(&self) -> u64 {
        xxh3_64(&self.as_bytes()[..HEAD - size_of::<u64>()])
    }

    fn counts(&self) -> [u32; 6] {
        let BlockHead { controllers, summaries, assignments, commands, feedback, .. } = *self;
        [controllers, self.header.record_count, summaries, assignments, commands, feedback]
    }

    /// 32-bit counts of small records do not overflow 64 bits.
    fn length_by_counts(&self) -> u64 {
        let sections = self.counts().into_iter().zip(SIZES).map(|(count, size)| u64::from(count) * size);
        HEAD as u64 + sections.sum::<u64>()
    }
}

impl StepFrames<'_> {
    /// The block's head but for its checksum and length.
    fn unsealed_head(&self) -> BlockHead {
        let total = |lengths: &mut dyn Iterator<Item = usize>| lengths.sum::<usize>() as u32;
        BlockHead {
            magic: BLOCK_MAGIC,
            length: 0,
            header: FrameHeader { record_count: self.state.len() as u32, ..self.header },
            state_hash: self.state_hash,
            misses: self.misses,
            summaries: total(&mut self.summaries.iter().map(|s| s.len())),
            assignments: total(&mut self.coordination.iter().map(|s| s.len())),
            commands: total(&mut self.commands.iter().map(|p| p.records.len())),
            controllers: self.commands.len() as u32,
            policy: self.policy,
            feedback: self.feedback.len() as u32,
            check: 0,
        }
    }

    /// Number of bytes of the block.
    pub fn encoded_len(&self) -> usize {
        self.unsealed_head().length_by_counts() as usize
    }

    /// Hands out the block's bytes piece by piece, in order.
    pub fn encode(&self, mut write: impl FnMut(&[u8])) {
        let mut head = self.unsealed_head();
        head.seal();
        write(head.as_bytes());
        for part in self.commands {
            let head = PartHead { generation: part.generation, records: part.records.len() as u32 };
            write(head.as_bytes());
        }
        write(bytes_of(self.state));
        self.summaries.iter().for_each(|s| write(bytes_of(s)));
        self.coordination.iter().for_each(|s| write(bytes_of(s)));
        self.commands.iter().for_each(|p| write(bytes_of(p.records)));
        write(bytes_of(self.feedback));
    }

    /// Appends the block to a buffer.
    pub fn encode_onto(&self, bytes: &mut Vec<u8>) {
        bytes.reserve(self.encoded_len());
        self.encode(|piece| bytes.extend_from_slice(piece));
    }
}

impl Step {
    /// The number of the step a block is of, if it is one.
    pub fn number_in(block: &[u8]) -> Option<u64> {
        BlockHead::of(block).ok().map(|head| head.header.step)
    }

    /// The step of a block.
    pub fn decode(block: &[u8]) -> Result<Step, BlockFault> {
        let head = BlockHead::of(block)?;
        if head.length != block.len() as u64 {
            return Err(BlockFault::Counts);
        }
        let [controllers, states, summaries, assignments, commands, feedback] = head.counts();
        let mut rest = Rest(&block[HEAD..]);
        let mut parts = Vec::new();
        for _ in 0..controllers {
            let (part, after) = PartHead::read_from_prefix(rest.0).map_err(|_| BlockFault::Counts)?;
            rest.0 = after;
            parts.push(part);
        }
        if parts.iter().map(|p| u64::from(p.records)).sum::<u64>() != u64::from(commands) {
            return Err(BlockFault::Counts);
        }
        Ok(Step {
            header: head.header,
            state: rest.records(states)?,
            summaries: rest.records(summaries)?,
            coordination: rest.records(assignments)?,
            commands: parts
                .iter()
                .map(|p| Ok(Commands { generation: p.generation, records: rest.records(p.records)? }))
                .collect::<Result<_, BlockFault>>()?,
            feedback: rest.records(feedback)?,
            misses: head.misses,
            policy: head.policy,
            state_hash: head.state_hash,
        })
    }

    /// The block of the step.
    pub fn encode(&self) -> Vec<u8> {
        let commands: Vec<_> = self
            .commands
            .iter()
            .map(|c| CommandPart { generation: c.generation, records: &c.records })
            .collect();
        let frames = StepFrames {
            header: self.header,
            state: &self.state,
            summaries: &[&self.summaries],
            coordination: &[&self.coordination],
            commands: &commands,
            feedback: &self.feedback,
            misses: self.misses,
            policy: self.policy,
            state_hash: self.state_hash,
        };
        let mut bytes = Vec::new();
        frames.encode_onto(&mut bytes);
        bytes
    }
}

struct Rest<'a>(&'a [u8]);

impl Rest<'_> {
    fn records<R: Record>(&mut self, count: u32) -> Result<Vec<R>, BlockFault> {
        let bytes = (count as usize).checked_mul(size_of::<R>()).ok_or(BlockFault::Counts)?;
        let (own, after) = self.0.split_at_checked(bytes).ok_or(BlockFault::Counts)?;
        self.0 = after;
        records_from(own).ok_or(BlockFault::Counts)
    }
}
