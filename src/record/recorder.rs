//! The recorder: a thread that writes what it is handed, so that a run never waits for a disk unless it wants to.
//!
//! Blocks wait in a bounded queue. When it is full, whoever hands one over waits, or leaves the step out, and that
//! is remembered: in the footer, and for whoever asks at the end. What has been written is handed to the system
//! every 100 ms, so a program that is killed loses no more than that; at the end it is forced onto the disk.
//! Nothing is made before there is a step to write (`file`).

use super::file::{RecordingFile, probe};
use super::format::{Metadata, RunEnd, RunEvent};
use super::writer::{WriteError, Writer};
use crate::step::{Step, StepFrames};
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Time after which what has been written is handed to the system.
const FLUSH_EVERY: Duration = Duration::from_millis(100);
/// Bytes collected before the system is asked to write.
const BUFFER: usize = 256 << 10;

/// How much may wait to be written.
#[derive(Clone, Copy, Debug)]
pub struct QueueLimits {
    /// Steps.
    pub steps: usize,
    /// Bytes. One step is always let in.
    pub bytes: usize,
}

impl Default for QueueLimits {
    /// 8192 steps, 128 MiB.
    fn default() -> QueueLimits {
        QueueLimits { steps: 8192, bytes: 128 << 20 }
    }
}

/// Where a recorder writes.
pub trait Output: Write + Send + 'static {
    /// Makes what has been written outlast a power cut.
    fn sync(&mut self) -> io::Result<()>;

    /// The first step has been written: whoever looks for the recording is to find it.
    fn appear(&mut self) -> io::Result<()> {
        Ok(())
    }

    /// Whether what is written can still be found.
    fn check(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Why a recording could not be made, or is not whole.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// There is a file of that name which is no recording.
    #[error("{} exists and is not a recording; it is left as it is", .0.display())]
    Occupied(PathBuf),
    /// Another run records into the file.
    #[error("another run is recording into {}", .0.display())]
    Busy(PathBuf),
    /// The scenario is larger than anybody reads.
    #[error("cannot create {}: the scenario takes {found} bytes, expected at most {limit}: its traces are too long", .path.display())]
    TooLarge {
        /// Path as given.
        path: PathBuf,
        /// Bytes of the metadata.
        found: usize,
        /// What a reader takes.
        limit: usize,
    },
    /// The file cannot be created.
    #[error("cannot create {}: {source}", .path.display())]
    Create {
        /// Path as given.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file cannot be written; it holds what was written before.
    #[error("cannot write the recording after {steps} steps: {source}")]
    Write {
        /// Steps written before.
        steps: u64,
        /// Why.
        source: WriteError,
    },
}

/// What was recorded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// Number of steps in the file.
    pub steps: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Steps that are not in it, because they came faster than they could be written: first and last of
    /// each range.
    pub missing: Vec<(u64, u64)>,
}

impl Recorded {
    /// Number of steps that are not in the file.
    pub fn missing_steps(&self) -> u64 {
        steps_in(&self.missing)
    }
}

/// Number of steps in ranges of first and last. Saturates: ranges may come from a file.
pub fn steps_in(ranges: &[(u64, u64)]) -> u64 {
    let length = |(first, last): &(u64, u64)| last.saturating_sub(*first).saturating_add(1);
    ranges.iter().map(length).fold(0, u64::saturating_add)
}

enum Message {
    Block(Vec<u8>),
    End(RunEnd, Vec<(u64, u64)>, Vec<RunEvent>),
}

/// Takes steps, and waits only where it is asked to.
#[derive(Debug)]
pub struct Recorder {
    queue: Sender<Message>,
    /// Buffers the thread is done with.
    spares: Receiver<Vec<u8>>,
    /// One that was filled for a step that was then not let in.
    spare: Option<Vec<u8>>,
    waiting_bytes: Arc<AtomicUsize>,
    limits: QueueLimits,
    /// Until its failure has been taken.
    thread: Option<JoinHandle<Result<Recorded, RecordError>>>,
    next: u64,
    /// Steps that could not be let in so far, and those that were never pushed between two that were.
    missing: Vec<(u64, u64)>,
    events: Vec<RunEvent>,
}

impl Recorder {
    /// Starts a recording in a new file, which only its owner can read. A recording of that name is
    /// replaced once the first step has been written, any other file is refused: a mistyped name costs nobody a
    /// file, a run that does not begin nobody a recording. That the file can be written is tried here.
    pub fn create(path: &Path, metadata: &Metadata) -> Result<Recorder, RecordError> {
        probe(path, metadata)?;
        let path = path.to_owned();
        Ok(Recorder::start(move || RecordingFile::begin(path), metadata.clone(), QueueLimits::default()))
    }

    /// Starts a recording to anything.
    pub fn over(out: impl Output, metadata: Metadata, limits: QueueLimits) -> Recorder {
        Recorder::start(move || Ok(out), metadata, limits)
    }

    fn start<W: Output>(
        open: impl FnOnce() -> io::Result<W> + Send + 'static,
        metadata: Metadata,
        limits: QueueLimits,
    ) -> Recorder {
        let (queue, inbox) = bounded(limits.steps.max(1));
        let (done, spares) = bounded(limits.steps.max(1) + 1);
        let waiting_bytes = Arc::new(AtomicUsize::new(0));
        let waiting = waiting_bytes.clone();
        let thread = Some(std::thread::spawn(move || write(open, &metadata, &inbox, &done, &waiting)));
        Recorder {
            queue,
            spares,
            spare: None,
            waiting_bytes,
            limits,
            thread,
            next: 0,
            missing: Vec::new(),
            events: Vec::new(),
        }
    }

    /// Records a step, and waits while the queue is full: for runs that keep no clock, which come out the same
    /// however long a step takes. `false` when the recorder has failed.
    pub fn push_or_wait(&mut self, frames: &StepFrames<'_>) -> bool {
        let mut block = self.buffer();
        frames.encode_onto(&mut block);
        self.enqueue_or_wait(frames.header.step, block)
    }

    /// Records a step that was read from another recording; waits while the queue is full.
    pub fn push_step_or_wait(&mut self, step: &Step) -> bool {
        self.enqueue_or_wait(step.header.step, step.encode())
    }

    fn enqueue_or_wait(&mut self, step: u64, block: Vec<u8>) -> bool {
        let length = block.len();
        while !self.has_room(length) && !self.has_ended() {
            // Bytes are the tighter limit only for steps so large that writing one takes milliseconds.
            std::thread::sleep(Duration::from_millis(1));
        }
        self.advance(step);
        self.waiting_bytes.fetch_add(length, Ordering::Relaxed);
        let sent = self.queue.send(Message::Block(block)).is_ok();
        if !sent {
            self.miss(step, step);
        }
        sent
    }

    /// Records the block of a step that somebody else made; `false` when it could not be let in. Never waits.
    pub fn push_block(&mut self, step: u64, bytes: &[u8]) -> bool {
        let mut block = self.buffer();
        block.extend_from_slice(bytes);
        self.enqueue(step, block)
    }

    /// The same, and waits while the queue is full; `false` when the recorder has failed.
    pub fn push_block_or_wait(&mut self, step: u64, bytes: &[u8]) -> bool {
        let mut block = self.buffer();
        block.extend_from_slice(bytes);
        self.enqueue_or_wait(step, block)
    }

    /// Why nothing is written any more, once it is known; told once.
    pub fn failure(&mut self) -> Option<RecordError> {
        if !self.has_ended() {
            return None;
        }
        let ended = self.thread.take()?.join().expect("the recorder's thread returns its errors");
        ended.err()
    }

    fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// What happened to the run beside its steps; its end says so.
    pub fn happened(&mut self, events: Vec<RunEvent>) {
        self.events = events;
    }

    /// Writes what waits, then the end. Waits for the disk. Of a failure that has been told, nothing is said
    /// again.
    pub fn finish(self, end: RunEnd) -> Result<Recorded, RecordError> {
        // When the thread has failed nobody takes this; it says why below.
        let _ = self.queue.send(Message::End(end, self.missing, self.events));
        drop(self.queue);
        match self.thread {
            Some(thread) => thread.join().expect("the recorder's thread returns its errors"),
            None => Ok(Recorded { steps: 0, bytes: 0, missing: Vec::new() }),
        }
    }

    fn buffer(&mut self) -> Vec<u8> {
        let mut buffer = self.spare.take().or_else(|| self.spares.try_recv().ok()).unwrap_or_default();
        buffer.clear();
        buffer
    }

    /// Whether so many bytes more may wait.
    fn has_room(&self, length: usize) -> bool {
        let waiting = self.waiting_bytes.load(Ordering::Relaxed);
        waiting == 0 || waiting + length <= self.limits.bytes
    }

    /// Notes the steps that were left out before this one.
    fn advance(&mut self, step: u64) {
        if step > self.next {
            self.miss(self.next, step - 1);
        }
        self.next = step.saturating_add(1);
    }

    fn enqueue(&mut self, step: u64, block: Vec<u8>) -> bool {
        self.advance(step);
        let length = block.len();
        let refused = if !self.has_room(length) {
            Some(block)
        } else {
            self.waiting_bytes.fetch_add(length, Ordering::Relaxed);
            match self.queue.try_send(Message::Block(block)) {
                Ok(()) => None,
                Err(TrySendError::Full(message) | TrySendError::Disconnected(message)) => {
                    self.waiting_bytes.fetch_sub(length, Ordering::Relaxed);
                    let Message::Block(block) = message else { return false };
                    Some(block)
                }
            }
        };
        let Some(block) = refused else { return true };
        self.spare = Some(block);
        self.miss(step, step);
        false
    }

    fn miss(&mut self, first: u64, last: u64) {
        match self.missing.last_mut() {
            Some(range) if range.1.saturating_add(1) == first => range.1 = last,
            _ => self.missing.push((first, last)),
        }
    }
}

/// The recorder's thread.
fn write<W: Output>(
    open: impl FnOnce() -> io::Result<W>,
    metadata: &Metadata,
    inbox: &Receiver<Message>,
    done: &Sender<Vec<u8>>,
    waiting: &AtomicUsize,
) -> Result<Recorded, RecordError> {
    let failed = |steps, source: WriteError| RecordError::Write { steps, source };
    let mut message = match inbox.recv() {
        Ok(message @ Message::Block(_)) => Ok(message),
        // Nothing happened, so nothing is made.
        Ok(Message::End(_, missing, _)) => return Ok(Recorded { steps: 0, bytes: 0, missing }),
        Err(_) => return Ok(Recorded { steps: 0, bytes: 0, missing: Vec::new() }),
    };
    let begin = || Writer::new(BufWriter::with_capacity(BUFFER, open()?), metadata);
    let mut writer = begin().map_err(|source| failed(0, source.into()))?;
    let mut flushed = None;
    loop {
        match message {
            Ok(Message::Block(block)) => {
                let appended = writer.append(&block);
                waiting.fetch_sub(block.len(), Ordering::Relaxed);
                let _ = done.try_send(block);
                appended.map_err(|source| failed(writer.steps(), source))?;
            }
            Ok(Message::End(end, missing, events)) => {
                writer.happened(events);
                return close(writer, end, missing);
            }
            Err(RecvTimeoutError::Timeout) => {}
            // Whoever recorded is gone without a word: the file ends as if it had been killed.
            Err(RecvTimeoutError::Disconnected) => return abandon(writer),
        }
        // At once the first time: a file without its head says nothing, however little of the run is in it.
        if flushed.is_none_or(|at: Instant| at.elapsed() >= FLUSH_EVERY) {
            let is_first = flushed.is_none();
            let told = writer.flush().and_then(|()| {
                let out = writer.out_mut().get_mut();
                if is_first { out.appear() } else { out.check() }
            });
            told.map_err(|source| failed(writer.steps(), source.into()))?;
            flushed = Some(Instant::now());
        }
        message = inbox.recv_timeout(FLUSH_EVERY);
    }
}

fn close<W: Output>(
    writer: Writer<BufWriter<W>>,
    end: RunEnd,
    missing: Vec<(u64, u64)>,
) -> Result<Recorded, RecordError> {
    let steps = writer.steps();
    let close = || -> io::Result<Recorded> {
        let (buffer, footer, bytes) = writer.finish(end, missing)?;
        let mut out = buffer.into_inner()?;
        out.sync()?;
        out.check()?;
        Ok(Recorded { steps, bytes, missing: footer.missing })
    };
    close().map_err(|source| RecordError::Write { steps, source: source.into() })
}

fn abandon<W: Output>(mut writer: Writer<BufWriter<W>>) -> Result<Recorded, RecordError> {
    let steps = writer.steps();
    writer.flush().map_err(|source| RecordError::Write { steps, source: source.into() })?;
    Ok(Recorded { steps, bytes: writer.bytes(), missing: Vec::new() })
}
