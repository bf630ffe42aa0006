//! What the processes of a run tell their supervisor, a line each.

use super::progress::Position;
use crate::lockstep::RefusedFrames;
use crate::process::{Outcome, Settled};
use crate::world::World;
use serde::{Deserialize, Serialize};

/// What a supervised world says on its stdout, one JSON object a line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum WorldLine {
    Progress(Position),
    /// A controller that the run can do without has not answered for half as long as anybody waits: its index.
    Silent(u32),
    Outcome(Box<Outcome>),
}

impl WorldLine {
    pub fn progress(world: &World) -> WorldLine {
        WorldLine::Progress(Position::of(world))
    }
}

/// What a process says on stderr to its supervisor, one JSON object a line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum PartLine {
    /// Before its run begins: where it is and what it was granted.
    Settled(Settled),
    /// When it ends, if it is a coordinator or controller: whose frames it has refused.
    Refused(RefusedFrames),
    /// The keeper of a plug-in: the process of the plug-in. Whoever else says so deceives nobody but readers.
    Keeps(u32),
}

impl PartLine {
    /// Sets the line apart from everything else that is said on stderr.
    const MARK: &str = "cz-part ";

    pub fn to_line(&self) -> String {
        format!("{}{}", Self::MARK, serde_json::to_string(self).expect("it has string keys only"))
    }

    pub fn of(line: &str) -> Option<PartLine> {
        serde_json::from_str(line.strip_prefix(Self::MARK)?).ok()
    }
}
