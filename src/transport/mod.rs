//! How frames travel: one interface, two transports.
//!
//! An [`Outbox`] lends memory in which a frame is written where its receivers will read it; an
//! [`Inbox`] hands out frames where they lie. Nothing is copied on either side. Neither blocks.

pub mod iox;
pub mod memory;

use ipc_schemas::{FrameHeader, Record};
use std::mem::MaybeUninit;

/// What becomes of frames that are not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Backlog {
    /// So many of one sender wait for their receiver; a further one does not reach it.
    Bounded(usize),
    /// The last one waits; it drives out the one before.
    Last,
}

impl Backlog {
    /// In lockstep one frame is being read while the next arrives.
    pub const STEPS: Backlog = Backlog::Bounded(2);

    /// How many frames of a sender may wait.
    pub fn frames(self) -> usize {
        match self {
            Backlog::Bounded(frames) => frames,
            Backlog::Last => 1,
        }
    }
}

/// The sending end of a service.
pub trait Outbox<R: Record> {
    /// A frame being written.
    type Loan<'a>: Loan<R>
    where
        Self: 'a;

    /// Lends memory for a frame of `count` records, all of which `fill` must write. `record_count` of
    /// the header is set here.
    ///
    /// # Panics
    /// When `fill` writes another number of records.
    fn loan(
        &mut self,
        header: FrameHeader,
        count: usize,
        fill: impl FnOnce(&mut Slots<'_, R>),
    ) -> Result<Self::Loan<'_>, TransportError>;

    /// Visits every receiving end that is open, with the process it belongs to where the transport knows.
    /// What has been sent is safe from its sender's leaving once a receiver has taken it, not before.
    fn receivers(&self, _visit: &mut dyn FnMut(Option<u32>)) {}
}

/// A frame that has been written and not yet sent; dropped, it is never seen.
pub trait Loan<R: Record> {
    /// The records.
    fn records(&self) -> &[R];
    /// Sends the frame to every receiver that has room for it, and returns the number of those reached. A
    /// receiver that has not taken the frames before misses this one: it cannot stall anybody.
    fn send(self) -> Result<usize, TransportError>;
}

/// The receiving end of a service.
pub trait Inbox<R: Record> {
    /// A received frame.
    type Frame: Frame<R>;

    /// The next frame, if there is one. Frames of one sender come in order; a sender two of whose frames
    /// are still held is passed over. What a sender has left that is gone by now comes only if this end
    /// has taken a frame of it before.
    fn receive(&mut self) -> Result<Option<Self::Frame>, TransportError>;

    /// The process behind a frame's [`origin`](Frame::origin), where the transport knows.
    fn process_of(&self, _origin: u128) -> Option<u32> {
        None
    }
}

/// A received frame, borrowed from the transport until dropped.
pub trait Frame<R: Record> {
    /// The header, not yet checked.
    fn header(&self) -> &FrameHeader;
    /// The records.
    fn records(&self) -> &[R];

    /// What the transport, not the header, says of the sending end: the same for all its frames.
    fn origin(&self) -> u128 {
        0
    }
}

/// Memory for the records of a frame, filled front to back.
#[derive(Debug)]
pub struct Slots<'a, R> {
    slots: &'a mut [MaybeUninit<R>],
    filled: usize,
}

impl<'a, R: Record> Slots<'a, R> {
    fn new(slots: &'a mut [MaybeUninit<R>]) -> Slots<'a, R> {
        Slots { slots, filled: 0 }
    }

    /// Replaces the records of a vector by `count` that `fill` writes.
    ///
    /// # Panics
    /// When `fill` writes another number of records.
    pub(crate) fn fill_vec(records: &mut Vec<R>, count: usize, fill: impl FnOnce(&mut Slots<'_, R>)) {
        records.clear();
        records.reserve(count);
        let mut slots = Slots { slots: &mut records.spare_capacity_mut()[..count], filled: 0 };
        fill(&mut slots);
        slots.assert_full();
        // SAFETY: `count` records of spare capacity were reserved above and all have been written.
        unsafe { records.set_len(count) };
    }

    /// Writes the next record.
    ///
    /// # Panics
    /// When all records have been written already.
    pub fn push(&mut self, record: R) {
        self.slots[self.filled].write(record);
        self.filled += 1;
    }

    /// The records written so far.
    pub fn written(&self) -> &[R] {
        // SAFETY: `push` alone raises `filled`, by one, after it has written the slot there; a slot has the layout
        // of what it holds.
        unsafe { std::slice::from_raw_parts(self.slots.as_ptr().cast(), self.filled) }
    }

    fn assert_full(&self) {
        assert_eq!(self.filled, self.slots.len(), "a frame is filled with as many records as were asked for");
    }
}

/// Why a frame could not be sent or received.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TransportError {
    /// The transport failed.
    #[error("{service}: {reason}")]
    Failed {
        /// Service name.
        service: String,
        /// What the transport said.
        reason: String,
    },
}
