//! What the processes of a run tell their supervisor, a line each.

use super::run::Position;
use crate::lockstep::RefusedFrames;
use crate::process::{Outcome, Settled};
use crate::world::World;
use serde::{Deserialize, Serialize};

/// What a supervised world says on its stdout, one JSON object a line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum WorldLine {
    Progress(Position),
    Outcome(Box<Outcome>),
}

impl WorldLine {
    pub fn progress(world: &World) -> WorldLine {
        WorldLine::Progress(Position::of(world))
    }
}

/// What each process says on stderr before its run begins: where it is and what it was granted.
#[derive(Debug)]
pub(super) struct SettledLine(pub Settled);

impl SettledLine {
    /// Sets the line apart from everything else that is said on stderr.
    const MARK: &str = "cz-settled ";

    pub fn to_line(&self) -> String {
        format!("{}{}", Self::MARK, serde_json::to_string(&self.0).expect("it has string keys only"))
    }

    pub fn of(line: &str) -> Option<SettledLine> {
        serde_json::from_str(line.strip_prefix(Self::MARK)?).ok().map(SettledLine)
    }
}

/// What a coordinator or controller says on stderr when it ends: whose frames it has refused.
#[derive(Debug)]
pub(super) struct RefusedLine(pub RefusedFrames);

impl RefusedLine {
    /// Sets the line apart from everything else that is said on stderr.
    const MARK: &str = "cz-refused ";

    pub fn to_line(&self) -> String {
        format!("{}{}", Self::MARK, serde_json::to_string(&self.0).expect("it has string keys only"))
    }

    pub fn of(line: &str) -> Option<RefusedLine> {
        serde_json::from_str(line.strip_prefix(Self::MARK)?).ok().map(RefusedLine)
    }
}
