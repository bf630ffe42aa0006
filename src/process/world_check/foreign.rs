//! The process of a foreign world: started, signalled, ended, and what it said last.

use crate::own_time::Bound;
use crate::process::StopFlag;
use rustix::io::Errno;
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use std::fs::File;
use std::io::{Error, Read, Seek, SeekFrom};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

/// Of what it said so much is looked at, bytes, and shown, lines.
const LAST_WORDS: u64 = 4 << 10;
const LAST_LINES: usize = 3;
/// Time between two looks.
const LOOK: Duration = Duration::from_millis(2);

/// A world and whatever it has started; ended when dropped.
#[derive(Debug)]
pub(super) struct Foreign {
    child: Child,
    words: PathBuf,
    /// Set once it has ended.
    pub has_ended: StopFlag,
}

impl Foreign {
    /// Starts a command line; what it says on stderr goes to the file `words`.
    pub fn start(command: &[String], arguments: &[String], words: &Path) -> Result<Foreign, Error> {
        let (program, own) = command.split_first().ok_or_else(|| Error::other("there is no command"))?;
        let mut command = Command::new(program);
        command.args(own).args(arguments).process_group(0);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(File::create(words)?);
        let child = command.spawn()?;
        let (process, has_ended) = (child.id(), StopFlag::none());
        let told = has_ended.clone();
        let watch = move || {
            // Not reaped here, so that its id stays its own until it is signalled for the last time.
            let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT;
            while let Some(pid) = Pid::from_raw(process as i32)
                && let Err(Errno::INTR) = waitid(WaitId::Pid(pid), options)
            {}
            told.set();
        };
        let foreign = Foreign { child, words: words.to_owned(), has_ended };
        std::thread::Builder::new().name("world".to_owned()).spawn(watch)?;
        Ok(foreign)
    }

    /// Sends a signal to it, and to whatever it started.
    pub fn signal(&self, signal: Signal) {
        if let Some(id) = Pid::from_raw(self.child.id() as i32) {
            // If it has ended, that is noticed soon enough.
            let _ = kill_process_group(id, signal);
        }
    }

    /// How it ended, if it does within so much time.
    pub fn ended_within(&mut self, limit: Duration) -> Option<ExitStatus> {
        let mut bound = Bound::of(limit);
        loop {
            let status = self.child.try_wait().ok().flatten();
            if status.is_some() || bound.is_over() {
                return status;
            }
            std::thread::sleep(LOOK);
        }
    }

    /// How it has ended, and what it said last.
    pub fn end(&mut self) -> String {
        let how = match self.ended_within(Duration::from_secs(1)) {
            Some(status) => format!("it ended with {status}"),
            None => "it is still there".to_owned(),
        };
        let said = self.last_words();
        if said.is_empty() { how } else { format!("{how}; it said: {said}") }
    }

    fn last_words(&self) -> String {
        let read = || -> Result<Vec<u8>, Error> {
            let mut file = File::open(&self.words)?;
            let length = file.metadata()?.len();
            file.seek(SeekFrom::Start(length.saturating_sub(LAST_WORDS)))?;
            let mut bytes = Vec::new();
            file.take(LAST_WORDS).read_to_end(&mut bytes)?;
            Ok(bytes)
        };
        let text = String::from_utf8_lossy(&read().unwrap_or_default()).into_owned();
        let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        lines[lines.len().saturating_sub(LAST_LINES)..].join(" | ")
    }
}

impl Drop for Foreign {
    fn drop(&mut self) {
        // Also what it has started and left behind; the group is its own as long as it is not reaped.
        self.signal(Signal::KILL);
        let _ = self.child.wait();
    }
}
