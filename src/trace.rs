//! What the processes of a run do when, in wall-clock time: computing, publishing, waiting.
//!
//! Each process keeps the last spans in memory and writes them when it ends; whoever started them puts the parts
//! together. Where nobody asked, it is one load and a branch. The format is Chrome's trace events, as JSON, which
//! Perfetto reads.

use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;
use std::cell::RefCell;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// The environment variable that says where a part is written.
pub const VARIABLE: &str = "CZ_TRACE_PARTS";
/// Spans of a process at most; the oldest give way.
const MOST_SPANS: usize = 1 << 18;
/// Events of a process at most; after that they are counted only.
const MOST_NOTES: usize = 4096;
/// What parts end in, behind the name of the trace and the process.
const PART: &str = "part";

/// What a process is at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Phase {
    /// It has what it needs.
    #[default]
    Compute,
    /// It writes a frame where others read it.
    Publish,
    /// A frame of somebody is missing.
    Wait,
    /// No step is due.
    Idle,
}

impl Phase {
    fn name(self) -> &'static str {
        match self {
            Phase::Compute => "compute",
            Phase::Publish => "publish",
            Phase::Wait => "wait",
            Phase::Idle => "idle",
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Span {
    begin_ns: u64,
    step: u64,
    phase: Phase,
}

#[derive(Debug)]
struct Spans {
    name: String,
    path: PathBuf,
    /// A ring once it is full.
    spans: Vec<Span>,
    next: usize,
    left_out: u64,
    phase: Phase,
    step: u64,
    notes: Vec<(u64, u64, String)>,
    more_notes: u64,
}

/// Whether this process is traced. The spans are the main thread's.
static IS_ON: AtomicBool = AtomicBool::new(false);

thread_local! {
    static SPANS: RefCell<Option<Spans>> = const { RefCell::new(None) };
}

fn now_ns() -> u64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

fn with(act: impl FnOnce(&mut Spans)) {
    if IS_ON.load(Ordering::Relaxed) {
        SPANS.with_borrow_mut(|spans| {
            if let Some(spans) = spans {
                act(spans);
            }
        });
    }
}

/// This process is at something else now.
#[inline]
pub fn enter(phase: Phase) {
    with(|spans| {
        if spans.phase != phase {
            spans.phase = phase;
            spans.push(now_ns());
        }
    });
}

/// The same, for this step.
#[inline]
pub fn begin(phase: Phase, step: u64) {
    with(|spans| {
        if (spans.phase, spans.step) != (phase, step) {
            (spans.phase, spans.step) = (phase, step);
            spans.push(now_ns());
        }
    });
}

/// Something happened.
pub fn note(text: impl FnOnce() -> String) {
    with(|spans| {
        if spans.notes.len() < MOST_NOTES {
            spans.notes.push((now_ns(), spans.step, text()));
        } else {
            spans.more_notes += 1;
        }
    });
}

impl Spans {
    fn push(&mut self, begin_ns: u64) {
        let span = Span { begin_ns, step: self.step, phase: self.phase };
        if self.spans.len() < MOST_SPANS {
            self.spans.push(span);
        } else {
            self.spans[self.next] = span;
            self.next = (self.next + 1) % MOST_SPANS;
            self.left_out += 1;
        }
    }

    /// One event a line.
    fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let process_id = std::process::id();
        let mut line = |event: &Event<'_>| -> io::Result<()> {
            serde_json::to_writer(&mut *out, event)?;
            out.write_all(b"\n")
        };
        let named = |name, value| Event {
            args: Args { name: Some(value), step: None },
            ..Event::new("M", name, 0, process_id)
        };
        line(&named("process_name", &self.name))?;
        line(&named("thread_name", "main"))?;
        let in_order = || self.spans[self.next..].iter().chain(&self.spans[..self.next]);
        let ends = in_order().skip(1).map(|span| span.begin_ns).chain([now_ns()]);
        for (span, end_ns) in in_order().zip(ends) {
            let args = Args { name: None, step: Some(span.step) };
            // A nanosecond less, so that rounding never makes one begin within another.
            let dur = Some((end_ns - span.begin_ns).saturating_sub(1) as f64 / 1e3);
            line(&Event { dur, args, ..Event::new("X", span.phase.name(), span.begin_ns, process_id) })?;
        }
        for (at_ns, step, text) in &self.notes {
            let args = Args { name: None, step: Some(*step) };
            line(&Event { s: Some("p"), args, ..Event::new("i", text, *at_ns, process_id) })?;
        }
        if self.left_out + self.more_notes > 0 {
            let text = format!("{} earlier spans and {} events are left out", self.left_out, self.more_notes);
            let first_ns = in_order().next().map_or(0, |span| span.begin_ns);
            line(&Event { s: Some("p"), ..Event::new("i", &text, first_ns, process_id) })?;
        }
        Ok(())
    }
}

/// A trace event as Chrome's format names its members; instants and durations in us.
#[derive(Debug, Serialize)]
struct Event<'a> {
    ph: &'static str,
    name: &'a str,
    ts: f64,
    pid: u32,
    tid: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    dur: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    s: Option<&'static str>,
    args: Args<'a>,
}

#[derive(Debug, Default, Serialize)]
struct Args<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    step: Option<u64>,
}

impl<'a> Event<'a> {
    fn new(ph: &'static str, name: &'a str, at_ns: u64, pid: u32) -> Event<'a> {
        let ts = at_ns as f64 / 1e3;
        Event { ph, name, ts, pid, tid: pid, dur: None, s: None, args: Args::default() }
    }
}

/// Traces this thread, of a process that is called so, until dropped, if the environment says where.
#[derive(Debug)]
#[must_use = "the part is written when it is dropped"]
pub struct Tracing(());

impl Tracing {
    /// Begins.
    pub fn begin(name: &str) -> Tracing {
        if let Some(path) = std::env::var_os(VARIABLE).filter(|path| !path.is_empty()) {
            Tracing::to(Path::new(&path), name);
        }
        Tracing(())
    }

    fn to(trace: &Path, name: &str) {
        let mut path = trace.as_os_str().to_owned();
        path.push(format!(".{}.{PART}", std::process::id()));
        let mut spans = Spans {
            name: name.to_owned(),
            path: path.into(),
            spans: Vec::with_capacity(MOST_SPANS),
            next: 0,
            left_out: 0,
            phase: Phase::Compute,
            step: 0,
            notes: Vec::new(),
            more_notes: 0,
        };
        spans.push(now_ns());
        SPANS.set(Some(spans));
        IS_ON.store(true, Ordering::Relaxed);
    }
}

impl Drop for Tracing {
    fn drop(&mut self) {
        IS_ON.store(false, Ordering::Relaxed);
        let Some(spans) = SPANS.take() else { return };
        let written = File::create(&spans.path).and_then(|file| {
            let mut out = BufWriter::new(file);
            spans.write(&mut out)?;
            out.flush()
        });
        if let Err(error) = written {
            eprintln!("cz: {}: cannot be written: {error}", spans.path.display());
        }
    }
}

/// Puts the parts that processes have written for a trace together in it, and removes them; returns of how many
/// processes there were some.
///
/// # Errors
/// When it cannot be written, or a part not be read.
pub fn put_together(path: &Path) -> io::Result<usize> {
    let directory = path.parent().filter(|d| !d.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let is_part = |other: &str| {
        let process = other
            .strip_prefix(&name)
            .and_then(|rest| rest.strip_prefix('.')?.strip_suffix(PART)?.strip_suffix('.'));
        process.is_some_and(|id| !id.is_empty() && id.bytes().all(|b| b.is_ascii_digit()))
    };
    let mut parts = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let entry = entry?;
        if entry.file_name().to_str().is_some_and(is_part) {
            parts.push(entry.path());
        }
    }
    parts.sort();
    let mut out = BufWriter::new(File::create(path)?);
    out.write_all(b"{\"traceEvents\":[")?;
    let mut is_first = true;
    for part in &parts {
        for line in BufReader::new(File::open(part)?).lines() {
            out.write_all(if is_first { b"\n" } else { b",\n" })?;
            is_first = false;
            out.write_all(line?.as_bytes())?;
        }
    }
    out.write_all(b"\n]}\n")?;
    out.flush()?;
    parts.iter().try_for_each(std::fs::remove_file)?;
    Ok(parts.len())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use serde_json::Value;

    #[test]
    fn the_last_spans_of_a_process_follow_each_other_and_what_is_left_out_is_said() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.json");
        Tracing::to(&path, "world");
        let tracing = Tracing(());
        for number in 0..MOST_SPANS as u64 {
            let phase = if number.is_multiple_of(2) { Phase::Wait } else { Phase::Publish };
            begin(phase, number / 2);
            // Once more is no news.
            enter(phase);
        }
        note(|| "something".to_owned());
        drop(tracing);
        // What is no part of it stays.
        let others =
            ["a.json.x.part", "a.json.17.parts", "b.json.17.part"].map(|name| directory.path().join(name));
        others.iter().for_each(|other| std::fs::write(other, "{}").unwrap());
        assert_eq!(put_together(&path).unwrap(), 1);
        assert!(others.iter().all(|other| other.is_file()));

        let all: Value = serde_json::from_reader(File::open(&path).unwrap()).unwrap();
        let events = all["traceEvents"].as_array().unwrap();
        assert_eq!(events[0]["args"]["name"], "world");
        let spans: Vec<_> = events.iter().filter(|event| event["ph"] == "X").collect();
        assert_eq!(spans.len(), MOST_SPANS);
        let number = |event: &Value, key: &str| event[key].as_f64().unwrap();
        for pair in spans.windows(2) {
            assert!(number(pair[0], "ts") + number(pair[0], "dur") <= number(pair[1], "ts"));
        }
        let last = spans[spans.len() - 1];
        assert_eq!((&last["name"], &last["args"]["step"]), (&"publish".into(), &(MOST_SPANS / 2 - 1).into()));
        let notes: Vec<_> =
            events.iter().filter(|e| e["ph"] == "i").map(|e| e["name"].as_str().unwrap()).collect();
        // One more than there is room for: the first.
        assert_eq!(notes, ["something", "1 earlier spans and 0 events are left out"]);
        enter(Phase::Idle);
        assert!(SPANS.with_borrow(Option::is_none), "nothing is traced any more");
    }
}
