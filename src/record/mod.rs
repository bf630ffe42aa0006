//! Recordings of runs: every frame of every step in one file, and what can be done with it.
//!
//! The writing side takes [`StepFrames`] from whoever has seen a step, as one block of bytes that can be made
//! in one process and written by another. The reading side trusts nothing: see [`Reader`].

mod block;
mod compare;
mod file;
mod format;
mod owed;
mod reader;
mod recorder;
mod replay;
#[cfg(fuzzing)]
mod reseal;
pub mod words;
mod writer;

pub use crate::step::{CommandPart, Commands, Step, StepFrames};
pub use block::BlockFault;
pub use compare::{Comparison, Difference, Section, compare};
pub use file::is_growing;
pub use format::{Build, Footer, Metadata, Processes, RunEnd, RunEvent, RunEventKind, ScenarioSource};
pub use owed::{Condition, InForce, Owed};
pub use reader::{Builds, Damage, FileSource, Flaw, OpenError, Reader, Source, Steps};
pub use recorder::{Output, QueueLimits, RecordError, Recorded, Recorder, steps_in};
pub use replay::{Replay, ReplayError, RoleReport, Stop, WorldReplay, replay, replay_world};
#[cfg(fuzzing)]
pub use reseal::reseal;
pub use writer::{WriteError, Writer};
