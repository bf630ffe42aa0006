//! A process of a run: what it is, how it ended, and in which words that is told.

use super::Now;
use crate::scenario::OnExit;

/// What a process is in the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in super::super) enum Kind {
    World,
    /// A coordinator or controller of ours.
    Part,
    /// A controller written elsewhere, under its keeper.
    Plugin,
}

/// How a process ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in super::super) enum End {
    Code(i32),
    /// Signal number and name.
    Signal(i32, &'static str),
    /// It could not be waited for.
    Unknown(String),
}

/// What becomes of a process.
#[derive(Clone, Debug)]
pub(super) enum Process {
    /// It is to be started.
    Due {
        at: Now,
    },
    /// The shell has been told to start it.
    Starting,
    /// It is to be started once its program has changed.
    Awaits,
    Runs {
        id: u32,
        since: Now,
        asked: Option<Now>,
        insisted: bool,
    },
    /// It has left with code 0, which it may when the run is over; the world will say whether it is.
    Left {
        id: u32,
        at: Now,
    },
    /// It was lost, and who takes over depends on whether the run has begun, which the world will say.
    Lost {
        at: Now,
        end: End,
        told: String,
    },
    Ended,
}

/// Who takes part in the run.
#[derive(Debug)]
pub(super) struct Member {
    pub name: String,
    pub kind: Kind,
    /// Of a plug-in: what becomes of its vehicles without it.
    pub on_exit: OnExit,
    /// Of a plug-in: whether it is started again when its program changes.
    pub reloads: bool,
    /// Whether it has been asked to end for that.
    pub is_renewed: bool,
    pub process: Process,
    /// How often it has been started.
    pub starts: u32,
    /// A plug-in that had been started again when all was over, and had not been let in.
    pub is_late: bool,
    /// Restarts in a row.
    pub restarts: u32,
    /// Whether it has been let into the run.
    pub settled: bool,
    /// The last thing it said on stderr.
    pub last_words: Option<String>,
}

impl Member {
    /// Somebody who is to be started at once.
    pub fn new(name: String, kind: Kind) -> Member {
        Member {
            name,
            kind,
            on_exit: OnExit::End,
            reloads: false,
            is_renewed: false,
            process: Process::Due { at: Now::ZERO },
            starts: 0,
            is_late: false,
            restarts: 0,
            settled: false,
            last_words: None,
        }
    }

    /// Whether nobody in the run has known it when all was over.
    pub fn is_unknown(&self) -> bool {
        match self.kind {
            Kind::World => false,
            Kind::Part => !self.settled,
            Kind::Plugin => self.is_late,
        }
    }

    /// How its process ended, and what it said last.
    pub fn describe(&self, id: u32, end: &End) -> String {
        let how = match end {
            End::Code(0) => "left with code 0".to_owned(),
            End::Code(code) => format!("ended with code {code}"),
            End::Signal(signal, name) => {
                let why = match *name {
                    "SIGBUS" => "; /dev/shm is full, or another process has cut files in it short",
                    _ => "",
                };
                format!("was killed by signal {signal} ({name}){why}")
            }
            End::Unknown(why) => format!("could not be waited for: {why}"),
        };
        let name = &self.name;
        match &self.last_words {
            Some(words) => format!("{name} (process {id}) {how}: {}", words.trim_start_matches("cz: ")),
            None => format!("{name} (process {id}) {how}"),
        }
    }
}
