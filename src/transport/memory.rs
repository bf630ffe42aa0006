//! Frames within one thread: the same boxes over shared buffers.

use super::{Backlog, Frame, Inbox, Loan, Outbox, Slots, TransportError};
use ipc_schemas::{FrameHeader, Record};
use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

#[derive(Debug)]
struct Buffer<R> {
    header: FrameHeader,
    records: Vec<R>,
}

/// A frame on its way, and which of the service's outboxes sent it.
#[derive(Debug)]
struct Sent<R> {
    sender: u64,
    buffer: Rc<Buffer<R>>,
}

/// What has been sent to one receiver.
#[derive(Debug)]
struct Queue<R> {
    frames: VecDeque<Sent<R>>,
    /// Outboxes whose frames stay when they go: those of whom a frame has been taken.
    familiar: Vec<u64>,
    /// Whether the receiver only looks on.
    is_tap: bool,
    process_id: Option<u32>,
}

/// The ends of a service. Outboxes are numbered in the order in which they were opened.
#[derive(Debug)]
struct Ends<R> {
    queues: Vec<Rc<RefCell<Queue<R>>>>,
    backlog: Backlog,
    /// Outboxes opened so far, and the open ones with their processes.
    opened: u64,
    senders: Vec<(u64, Option<u32>)>,
}

/// A service within one thread.
///
/// As between processes, a frame may be lost with its sender: an outbox that is dropped takes along what it
/// has sent to those that have not taken a frame of it yet.
#[derive(Debug)]
pub struct MemoryService<R>(Rc<RefCell<Ends<R>>>);

impl<R: Record> Default for MemoryService<R> {
    fn default() -> MemoryService<R> {
        MemoryService::new()
    }
}

impl<R: Record> MemoryService<R> {
    /// A service without receivers, of frames of every step.
    pub fn new() -> MemoryService<R> {
        MemoryService::holding(Backlog::STEPS)
    }

    /// A service without receivers, in which these frames may wait.
    pub fn holding(backlog: Backlog) -> MemoryService<R> {
        let ends = Ends { queues: Vec::new(), backlog, opened: 0, senders: Vec::new() };
        MemoryService(Rc::new(RefCell::new(ends)))
    }

    /// A new receiver.
    pub fn inbox(&self) -> MemoryInbox<R> {
        self.inbox_of(None)
    }

    /// A new receiver in a process of that id.
    pub fn inbox_of(&self, process_id: impl Into<Option<u32>>) -> MemoryInbox<R> {
        self.open(false, process_id.into())
    }

    /// A receiver that only looks on: it is not counted among those a frame reaches, and may leave as many
    /// frames untaken as it likes.
    pub fn tap(&self) -> MemoryInbox<R> {
        self.open(true, None)
    }

    fn open(&self, is_tap: bool, process_id: Option<u32>) -> MemoryInbox<R> {
        let mut ends = self.0.borrow_mut();
        let frames = VecDeque::with_capacity(ends.backlog.frames());
        let queue = Queue { frames, familiar: Vec::new(), is_tap, process_id };
        let queue = Rc::new(RefCell::new(queue));
        ends.queues.push(queue.clone());
        MemoryInbox { queue, ends: self.0.clone() }
    }

    /// A new sender.
    pub fn outbox(&self) -> MemoryOutbox<R> {
        self.outbox_of(None)
    }

    /// A new sender in a process of that id.
    pub fn outbox_of(&self, process_id: impl Into<Option<u32>>) -> MemoryOutbox<R> {
        let mut ends = self.0.borrow_mut();
        let sender = ends.opened;
        ends.opened += 1;
        ends.senders.push((sender, process_id.into()));
        MemoryOutbox { sender, ends: self.0.clone(), buffers: Vec::new() }
    }
}

/// The sending end.
#[derive(Debug)]
pub struct MemoryOutbox<R> {
    /// Number among the outboxes of the service.
    sender: u64,
    ends: Rc<RefCell<Ends<R>>>,
    /// Buffers sent before; those nobody reads any more are used again.
    buffers: Vec<Rc<Buffer<R>>>,
}

impl<R> Drop for MemoryOutbox<R> {
    fn drop(&mut self) {
        let mut ends = self.ends.borrow_mut();
        ends.senders.retain(|(sender, _)| *sender != self.sender);
        for queue in &ends.queues {
            let mut queue = queue.borrow_mut();
            // Taps see all there is.
            if !queue.is_tap && !queue.familiar.contains(&self.sender) {
                queue.frames.retain(|sent| sent.sender != self.sender);
            }
        }
    }
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

    fn receivers(&self, visit: &mut dyn FnMut(Option<u32>)) {
        for queue in &self.ends.borrow().queues {
            let queue = queue.borrow();
            if !queue.is_tap {
                visit(queue.process_id);
            }
        }
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
        let ends = self.outbox.ends.borrow();
        for queue in &ends.queues {
            let mut queue = queue.borrow_mut();
            if ends.backlog == Backlog::Last && !queue.is_tap {
                queue.frames.retain(|sent| sent.sender != sender);
            }
            let waiting = || queue.frames.iter().filter(|sent| sent.sender == sender).count();
            if queue.is_tap || waiting() < ends.backlog.frames() {
                queue.frames.push_back(Sent { sender, buffer: self.buffer.clone() });
                reached += usize::from(!queue.is_tap);
            }
        }
        drop(ends);
        self.outbox.buffers.push(self.buffer);
        Ok(reached)
    }
}

/// The receiving end.
#[derive(Debug)]
pub struct MemoryInbox<R> {
    queue: Rc<RefCell<Queue<R>>>,
    ends: Rc<RefCell<Ends<R>>>,
}

impl<R> Drop for MemoryInbox<R> {
    fn drop(&mut self) {
        self.ends.borrow_mut().queues.retain(|queue| !Rc::ptr_eq(queue, &self.queue));
    }
}

impl<R: Record> Inbox<R> for MemoryInbox<R> {
    type Frame = MemoryFrame<R>;

    fn receive(&mut self) -> Result<Option<MemoryFrame<R>>, TransportError> {
        let mut queue = self.queue.borrow_mut();
        let Some(Sent { sender, buffer }) = queue.frames.pop_front() else { return Ok(None) };
        if !queue.familiar.contains(&sender) {
            queue.familiar.push(sender);
        }
        Ok(Some(MemoryFrame { origin: u128::from(sender), buffer }))
    }

    fn process_of(&self, origin: u128) -> Option<u32> {
        let ends = self.ends.borrow();
        ends.senders.iter().find(|(sender, _)| u128::from(*sender) == origin)?.1
    }
}

/// A received frame.
#[derive(Debug)]
pub struct MemoryFrame<R> {
    origin: u128,
    buffer: Rc<Buffer<R>>,
}

impl<R: Record> Frame<R> for MemoryFrame<R> {
    fn header(&self) -> &FrameHeader {
        &self.buffer.header
    }

    fn records(&self) -> &[R] {
        &self.buffer.records
    }

    fn origin(&self) -> u128 {
        self.origin
    }
}
