//! What is said on stderr. It may be full, closed, or read by nobody; that is no reason to panic or to wait.

use crossbeam::channel::{Receiver, Sender, bounded};
use std::fmt::Display;
use std::io::Write;
use std::time::Duration;

/// Says a line on stderr, if anybody takes it.
pub(super) fn say(line: impl Display) {
    let line = format!("{line}\n");
    let _ = std::io::stderr().lock().write_all(line.as_bytes());
}

/// A number of things in words.
pub(super) fn number(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// Lines that may wait to be taken.
const WAITING: usize = 4096;
/// How long whoever reads may take for what is left at the end.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// Says lines on stderr in the order they come, and never waits for whoever reads them: when more than 4096 wait,
/// the next are dropped and counted.
pub(super) struct Crier {
    lines: Sender<String>,
    done: Receiver<()>,
    dropped: u64,
}

impl Crier {
    /// Starts the thread that says them.
    pub fn start() -> std::io::Result<Crier> {
        let (lines, waiting) = bounded::<String>(WAITING);
        let (finished, done) = bounded(1);
        std::thread::Builder::new().name("crier".to_owned()).spawn(move || {
            waiting.iter().for_each(say);
            let _ = finished.send(());
        })?;
        Ok(Crier { lines, done, dropped: 0 })
    }

    /// Says a line.
    pub fn cry(&mut self, line: String) {
        if self.dropped > 0 {
            let note =
                format!("cz: {} lines were not shown: they came faster than they were read", self.dropped);
            if self.lines.try_send(note).is_ok() {
                self.dropped = 0;
            }
        }
        if self.dropped > 0 || self.lines.try_send(line).is_err() {
            self.dropped += 1;
        }
    }

    /// Waits a moment for what is left.
    pub fn finish(mut self) {
        if self.dropped > 0 {
            let note =
                format!("cz: {} lines were not shown: they came faster than they were read", self.dropped);
            let _ = self.lines.send_timeout(note, LAST_WORDS);
            self.dropped = 0;
        }
        drop(self.lines);
        let _ = self.done.recv_timeout(LAST_WORDS);
    }
}
