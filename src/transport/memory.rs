//! Frames within one thread: the same boxes over shared buffers.

use super::{Frame, Inbox, Loan, Outbox, Slots, TransportError};
use ipc_schemas::{FrameHeader, Record};
use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

/// Frames a receiver may leave untaken, as on the other transport.
const QUEUE_LIMIT: usize = 2;

#[derive(Debug)]
struct Buffer<R> {
    header: FrameHeader,
    records: Vec<R>,
}

type Queue<R> = Rc<RefCell<VecDeque<Rc<Buffer<R>>>>>;

/// A service within one thread. Make its inboxes first; outboxes send to those that exist by then.
#[derive(Debug)]
pub struct MemoryService<R> {
    name: &'static str,
    queues: Vec<Queue<R>>,
}

impl<R: Record> MemoryService<R> {
    /// A service without receivers.
    pub fn new(name: &'static str) -> MemoryService<R> {
        MemoryService { name, queues: Vec::new() }
    }

    /// A new receiver.
    pub fn inbox(&mut self) -> MemoryInbox<R> {
        let queue = Rc::new(RefCell::new(VecDeque::with_capacity(QUEUE_LIMIT)));
        self.queues.push(queue.clone());
        MemoryInbox { queue }
    }

    /// A sender to all present receivers.
    pub fn outbox(&self) -> MemoryOutbox<R> {
        MemoryOutbox { name: self.name, queues: self.queues.clone(), buffers: Vec::new() }
    }
}

/// The sending end.
#[derive(Debug)]
pub struct MemoryOutbox<R> {
    name: &'static str,
    queues: Vec<Queue<R>>,
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
        if self.outbox.queues.iter().any(|q| q.borrow().len() >= QUEUE_LIMIT) {
            return Err(TransportError::ReceiverFull { service: self.outbox.name.to_owned() });
        }
        for queue in &self.outbox.queues {
            queue.borrow_mut().push_back(self.buffer.clone());
        }
        self.outbox.buffers.push(self.buffer);
        Ok(self.outbox.queues.len())
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
        Ok(self.queue.borrow_mut().pop_front().map(|buffer| MemoryFrame { buffer }))
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
