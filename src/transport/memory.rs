//! Frames within one thread: the same boxes over shared buffers.

use super::{Frame, Inbox, Loan, Outbox, Slots, TransportError};
use ipc_schemas::{FrameHeader, Record};
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;

/// Frames of one sender a receiver may leave untaken, as on the other transport.
const QUEUE_LIMIT: usize = 2;

#[derive(Debug)]
struct Buffer<R> {
    header: FrameHeader,
    records: Vec<R>,
}

type Queue<R> = Rc<RefCell<VecDeque<Sent<R>>>>;

/// A frame on its way, and which of the service's outboxes sent it.
#[derive(Debug)]
struct Sent<R> {
    sender: usize,
    buffer: Rc<Buffer<R>>,
}

/// A service within one thread. Make its inboxes first; outboxes send to those that exist by then.
#[derive(Debug, Default)]
pub struct MemoryService<R> {
    queues: Vec<Queue<R>>,
    /// Those who only look on.
    taps: Vec<Queue<R>>,
    senders: Cell<usize>,
}

impl<R: Record> MemoryService<R> {
    /// A service without receivers.
    pub fn new() -> MemoryService<R> {
        MemoryService { queues: Vec::new(), taps: Vec::new(), senders: Cell::new(0) }
    }

    /// A new receiver.
    pub fn inbox(&mut self) -> MemoryInbox<R> {
        let queue = Rc::new(RefCell::new(VecDeque::with_capacity(QUEUE_LIMIT)));
        self.queues.push(queue.clone());
        MemoryInbox { queue }
    }

    /// A receiver that only looks on: it is not counted among those a frame reaches, and may leave as many
    /// frames untaken as it likes.
    pub fn tap(&mut self) -> MemoryInbox<R> {
        let queue = Queue::default();
        self.taps.push(queue.clone());
        MemoryInbox { queue }
    }

    /// A sender to all present receivers.
    pub fn outbox(&self) -> MemoryOutbox<R> {
        let sender = self.senders.replace(self.senders.get() + 1);
        let (queues, taps) = (self.queues.clone(), self.taps.clone());
        MemoryOutbox { sender, queues, taps, buffers: Vec::new() }
    }
}

/// The sending end.
#[derive(Debug)]
pub struct MemoryOutbox<R> {
    /// Number among the outboxes of the service.
    sender: usize,
    queues: Vec<Queue<R>>,
    taps: Vec<Queue<R>>,
    /// Buffers sent before; those nobody reads any more are used again.
    buffers: Vec<Rc<Buffer<R>>>,
}

impl<R: Record> Outbox<R> for MemoryOutbox<R> {
    type Loan<'a> = MemoryLoan<'a, R>;

    fn loan(
        &mut self,
        header: FrameHeader,
        count: usize,
        fill: impl FnOnce(&mut Slots<'_, R>),
    ) -> Result<MemoryLoan<'_, R>, TransportError> {
        let free = self.buffers.iter().position(|b| Rc::strong_count(b) == 1);
        let mut buffer = match free {
            Some(i) => self.buffers.swap_remove(i),
            None => Rc::new(Buffer { header, records: Vec::new() }),
        };
        let inner = Rc::get_mut(&mut buffer).expect("nobody else holds a buffer taken for a loan");
        inner.header = FrameHeader { record_count: count as u32, ..header };
        Slots::fill_vec(&mut inner.records, count, fill);
        Ok(MemoryLoan { outbox: self, buffer })
    }
}

/// A frame being written.
#[derive(Debug)]
pub struct MemoryLoan<'a, R> {
    outbox: &'a mut MemoryOutbox<R>,
    buffer: Rc<Buffer<R>>,
}

impl<R: Record> Loan<R> for MemoryLoan<'_, R> {
    fn records(&self) -> &[R] {
        &self.buffer.records
    }

    fn send(self) -> Result<usize, TransportError> {
        let sender = self.outbox.sender;
        let mut reached = 0;
        for queue in &self.outbox.queues {
            let mut queue = queue.borrow_mut();
            if queue.iter().filter(|s| s.sender == sender).count() < QUEUE_LIMIT {
                queue.push_back(Sent { sender, buffer: self.buffer.clone() });
                reached += 1;
            }
        }
        for tap in &self.outbox.taps {
            tap.borrow_mut().push_back(Sent { sender, buffer: self.buffer.clone() });
        }
        self.outbox.buffers.push(self.buffer);
        Ok(reached)
    }
}

/// The receiving end.
#[derive(Debug)]
pub struct MemoryInbox<R> {
    queue: Queue<R>,
}

impl<R: Record> Inbox<R> for MemoryInbox<R> {
    type Frame = MemoryFrame<R>;

    fn receive(&mut self) -> Result<Option<MemoryFrame<R>>, TransportError> {
        Ok(self.queue.borrow_mut().pop_front().map(|sent| MemoryFrame { buffer: sent.buffer }))
    }
}

/// A received frame.
#[derive(Debug)]
pub struct MemoryFrame<R> {
    buffer: Rc<Buffer<R>>,
}

impl<R: Record> Frame<R> for MemoryFrame<R> {
    fn header(&self) -> &FrameHeader {
        &self.buffer.header
    }

    fn records(&self) -> &[R] {
        &self.buffer.records
    }
}
