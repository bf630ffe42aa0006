//! The processes of a run as the operating system has them: starting, listening, signalling, reaping.

use super::life::End;
use crate::app::lines::WorldLine;
use crossbeam::channel::{Sender, bounded};
use rustix::io::Errno;
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, WaitOptions, kill_process, waitid, waitpid};
use std::io::{BufRead, BufReader, Error, Read};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

/// What comes from the processes of a run.
#[derive(Debug)]
pub(super) enum Event {
    /// The world reports.
    World(WorldLine),
    /// A process said a line on stderr.
    Said { member: usize, line: String },
    /// A plug-in said a line on stdout.
    Printed { member: usize, line: String },
    /// A process has ended and is to be reaped; what it said has come before.
    Ended { member: usize, process: u32 },
}

/// The longest line kept of what somebody says, bytes.
const LONGEST_LINE: usize = 8 << 10;
/// The longest line of a world of ours: results of tens of thousands of zones.
const LONGEST_REPORT: usize = 1 << 30;
/// How long what a process has said may take to arrive once it has ended. Whoever else has its pipes is not
/// waited for.
const LAST_WORDS: Duration = Duration::from_millis(200);
/// The same for a report, whose pipe nobody else has: a busy machine may take its time.
const LAST_REPORT: Duration = Duration::from_secs(10);

/// Who reads what a process says on stdout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stdout {
    Nobody,
    /// Lines of the world's report.
    Report,
    /// Lines for people.
    Lines,
    /// Whoever sits at the terminal, which the process reads too.
    Terminal,
}

/// Starts a process whose words and end come as events; returns its id.
pub(super) fn start(
    mut command: Command,
    member: usize,
    stdout: Stdout,
    events: &Sender<Event>,
) -> Result<u32, Error> {
    let (input, out) = match stdout {
        Stdout::Nobody => (Stdio::null(), Stdio::null()),
        Stdout::Terminal => (Stdio::inherit(), Stdio::inherit()),
        Stdout::Report | Stdout::Lines => (Stdio::null(), Stdio::piped()),
    };
    let mut child = command.stdin(input).stdout(out).stderr(Stdio::piped()).spawn()?;
    let process = child.id();
    listen(&mut child, member, stdout, events).inspect_err(|_| {
        signal(process, Signal::KILL);
        reap(process);
    })?;
    Ok(process)
}

fn listen(child: &mut Child, member: usize, stdout: Stdout, events: &Sender<Event>) -> Result<(), Error> {
    let process = child.id();
    let (has_read, read) = bounded::<()>(0);
    let thread = |name: &str| thread::Builder::new().name(name.to_owned());
    if let Some(from) = child.stderr.take() {
        let (events, has_read) = (events.clone(), has_read.clone());
        thread("stderr").spawn(move || {
            each_line(from, LONGEST_LINE, |line| events.send(Event::Said { member, line }).is_ok());
            drop(has_read);
        })?;
    }
    if let Some(from) = child.stdout.take() {
        let (events, has_read) = (events.clone(), has_read.clone());
        thread("stdout").spawn(move || {
            match stdout {
                Stdout::Report => each_line(from, LONGEST_REPORT, |line| {
                    let report = serde_json::from_str(&line).map(Event::World);
                    report.map_or(true, |event| events.send(event).is_ok())
                }),
                _ => {
                    each_line(from, LONGEST_LINE, |line| {
                        events.send(Event::Printed { member, line }).is_ok()
                    });
                }
            }
            drop(has_read);
        })?;
    }
    drop(has_read);
    let events = events.clone();
    thread("end").spawn(move || {
        // Not reaped here, so that its id stays its own until whoever signals it knows of its end.
        while let Some(pid) = Pid::from_raw(process as i32)
            && let Err(Errno::INTR) = waitid(WaitId::Pid(pid), WaitIdOptions::EXITED | WaitIdOptions::NOWAIT)
        {
        }
        let _ = read.recv_timeout(if stdout == Stdout::Report { LAST_REPORT } else { LAST_WORDS });
        let _ = events.send(Event::Ended { member, process });
    })?;
    Ok(())
}

/// Calls `take` with each line, whatever bytes are in it, until that returns false; of a longer one with as much
/// and the number of bytes that were left out.
fn each_line(from: impl Read, longest: usize, mut take: impl FnMut(String) -> bool) {
    let mut from = BufReader::new(from);
    let mut line = Vec::new();
    let mut left_out = 0_u64;
    loop {
        let bytes = match from.fill_buf() {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(_) => &[],
        };
        let end = bytes.iter().position(|byte| *byte == b'\n');
        let part = &bytes[..end.unwrap_or(bytes.len())];
        let kept = part.len().min(longest - line.len());
        line.extend_from_slice(&part[..kept]);
        left_out += (part.len() - kept) as u64;
        let (used, is_over) = (part.len() + usize::from(end.is_some()), bytes.is_empty());
        from.consume(used);
        if end.is_some() || (is_over && !line.is_empty()) {
            let mut text = String::from_utf8_lossy(&line).into_owned();
            if left_out > 0 {
                text.push_str(&format!(" … ({left_out} bytes more)"));
            }
            line.clear();
            left_out = 0;
            if !take(text) {
                return;
            }
        }
        if is_over {
            return;
        }
    }
}

/// Sends a signal to a process that was not reaped yet.
pub(super) fn signal(process: u32, signal: Signal) {
    if let Some(pid) = Pid::from_raw(process as i32) {
        let _ = kill_process(pid, signal);
    }
}

/// Takes the end of a process that has ended.
pub(super) fn reap(process: u32) -> End {
    loop {
        match waitpid(Pid::from_raw(process as i32), WaitOptions::empty()) {
            Ok(Some((_, status))) => {
                return match (status.terminating_signal(), status.exit_status()) {
                    (Some(signal), _) => {
                        End::Signal(signal, signal_hook::low_level::signal_name(signal).unwrap_or("unknown"))
                    }
                    (None, code) => End::Code(code.unwrap_or(-1)),
                };
            }
            Ok(None) | Err(Errno::INTR) => {}
            Err(error) => return End::Unknown(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(bytes: &[u8]) -> Vec<String> {
        let mut lines = Vec::new();
        each_line(bytes, 5, |line| {
            lines.push(line);
            true
        });
        lines
    }

    #[test]
    fn lines_are_bounded_and_whatever_bytes_are_in_them_readable() {
        assert_eq!(lines(b"one\n\ntwo"), ["one", "", "two"]);
        assert_eq!(lines(b"a\xffb\nc"), ["a\u{fffd}b", "c"]);
        assert_eq!(lines(b"abcdefgh\nij\n"), ["abcde … (3 bytes more)", "ij"]);
        let long = vec![b'x'; 100_000];
        assert_eq!(lines(&long), ["xxxxx … (99995 bytes more)"]);
    }
}
