//! What is said of a place that is not what it should be.

use super::super::block::BlockFault;
use std::io;

/// A place where the file is not what it should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Bytes from the start of the file.
    pub offset: u64,
    /// The sound step before that place.
    pub after: Option<u64>,
    /// What is wrong.
    pub flaw: Flaw,
}

/// What is wrong at a damaged place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Flaw {
    /// The file ends within a step, or within its end section: whatever follows was never written.
    CutOff,
    /// What should be a step is none.
    Block(BlockFault),
    /// The checksum of a step does not fit.
    Digest,
    /// A step that is sound by itself is not the one that was written after the one before it.
    Chain,
    /// A step comes twice, or before an earlier one.
    Order {
        /// The step.
        step: u64,
    },
    /// The index, the footer or the tail is damaged; steps do not depend on them.
    End,
    /// The footer tells of another last step than the file has.
    Footer,
    /// The file could not be read there.
    Io(String),
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "byte {}", self.offset)?;
        match self.after {
            Some(step) => write!(f, ", after step {step}: ")?,
            None => write!(f, ", before the first step: ")?,
        }
        match &self.flaw {
            Flaw::CutOff => f.write_str("the file is cut off"),
            Flaw::Block(fault) => write!(f, "{fault}"),
            Flaw::Digest => f.write_str("the checksum of the step does not fit"),
            Flaw::Chain => f.write_str("the step is not the one that was written here"),
            Flaw::Order { step } => write!(f, "step {step} is out of order"),
            Flaw::End => f.write_str("the index or the footer is damaged or cut off"),
            Flaw::Footer => f.write_str("the footer tells of other steps than the file has"),
            Flaw::Io(error) => write!(f, "cannot read: {error}"),
        }
    }
}

impl std::error::Error for Damage {}

impl From<io::Error> for Flaw {
    fn from(error: io::Error) -> Flaw {
        Flaw::Io(error.to_string())
    }
}
