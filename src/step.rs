//! All frames of one step: as the world saw them, and as somebody keeps them.
//!
//! The step protocol shows them to whoever looks on; recordings hold them. Neither needs to know the other.

use ipc_schemas::{Assignment, Feedback, FrameHeader, VehicleCommand, VehicleState, ZoneSummary};

/// [`StepFrames::policy`]: nobody missed the step, or nothing was put in anybody's place.
pub const POLICY_NONE: u32 = 0;

/// One step as the world saw it, borrowed from where its frames lie.
///
/// A list of slices stands for their concatenation, so that frames of several processes need not be copied
/// together first.
#[derive(Clone, Copy, Debug)]
pub struct StepFrames<'a> {
    /// Header of the state frame; its record count is set by the encoding.
    pub header: FrameHeader,
    /// The state frame's records.
    pub state: &'a [VehicleState],
    /// Summaries sent in this step between coordinator processes, in any order.
    pub summaries: &'a [&'a [ZoneSummary]],
    /// Assignments of all coordinators that acted, zones ascending.
    pub coordination: &'a [&'a [Assignment]],
    /// Commands as they were handed to the gateway, one part per controller process in order of index; none
    /// in the last step of a run.
    pub commands: &'a [CommandPart<'a>],
    /// What controllers written elsewhere were told since the state before: of their last commands, and of frames refused.
    pub feedback: &'a [Feedback],
    /// Bit `i`: controller `i` did not answer in time, and its part is what the world put in its place.
    pub misses: u64,
    /// How the world chose that: a code of the world's; [`POLICY_NONE`] where there are no misses.
    pub policy: u32,
    /// The world's state hash with this state frame in it.
    pub state_hash: u64,
}

/// The commands of one controller process.
#[derive(Clone, Copy, Debug, Default)]
pub struct CommandPart<'a> {
    /// Generation of the process that sent them.
    pub generation: u32,
    /// The records.
    pub records: &'a [VehicleCommand],
}

/// One step read back.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// Header of the state frame.
    pub header: FrameHeader,
    /// The state frame's records.
    pub state: Vec<VehicleState>,
    /// Summaries sent in this step between coordinator processes.
    pub summaries: Vec<ZoneSummary>,
    /// Assignments of all coordinators that acted.
    pub coordination: Vec<Assignment>,
    /// Commands per controller process.
    pub commands: Vec<Commands>,
    /// What controllers written elsewhere were told since the state before.
    pub feedback: Vec<Feedback>,
    /// Controllers in whose place the world decided, one bit each.
    pub misses: u64,
    /// How it did.
    pub policy: u32,
    /// The world's state hash with this state frame in it.
    pub state_hash: u64,
}

/// The commands of one controller process, read back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Commands {
    /// Generation of the process that sent them.
    pub generation: u32,
    /// The records.
    pub records: Vec<VehicleCommand>,
}

impl Step {
    /// Whether a controller did not answer in time.
    pub fn missed(&self, controller: usize) -> bool {
        controller < 64 && self.misses >> controller & 1 == 1
    }
}
