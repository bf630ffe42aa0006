//! The step protocol over any transport.
//!
//! Each role has a driver: a state machine around the pure role that takes what has arrived, sends what
//! is due, and says whom it waits for. Drivers never block; how to wait is the caller's business
//! (the `process` module between processes, a simple round in [`in_process`]).

mod controller;
mod coordinator;
pub mod in_process;
mod kept;
mod ledger;
mod members;
mod refusals;
mod world;

pub use controller::{ControllerDriver, ControllerPorts};
pub use coordinator::{CoordinatorDriver, CoordinatorPorts};
pub use ledger::{Handover, Ledger};
pub use members::{Members, Seat};
pub use refusals::{Refusal, RefusedFrames};
pub use world::{WorldDriver, WorldPorts};

use crate::control::pool::PoolError;
use crate::scenario::ControllerNames;
use crate::step::StepFrames;
use crate::transport::{Frame, TransportError};
use crate::world::AdvanceError;
use ipc_schemas::{Feedback, FrameHeader, HeaderFault, Role, VehicleState};

/// What a driver did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Something; ask again at once.
    Advanced,
    /// Nothing: a frame is missing.
    Waiting(Awaited),
    /// The run has gone on without this participant, which must be handed over to before it can go on.
    Behind,
    /// The run is over.
    Finished,
}

/// The frame a driver waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Awaited {
    /// Role of the sender.
    pub role: Role,
    /// Bit per process of that role still missing.
    pub missing: u64,
    /// What it is to send.
    pub what: &'static str,
    /// Step the frame belongs to.
    pub step: u64,
}

impl Awaited {
    /// What is awaited, in words.
    pub fn named(&self, names: &ControllerNames) -> String {
        let Awaited { what, step, .. } = *self;
        format!("{what} of step {step} from {}", self.senders(names))
    }

    /// From whom.
    pub fn senders(&self, names: &ControllerNames) -> String {
        let Awaited { role, missing, .. } = *self;
        let of = |index| match role {
            Role::Controller => names.of(index),
            role => format!("{role} {index}"),
        };
        let senders: Vec<String> = match role {
            Role::World => vec!["the world".to_owned()],
            _ => (0..64).filter(|i| missing >> i & 1 == 1).map(of).collect(),
        };
        senders.join(", ")
    }
}

/// Who a driver is, for the headers it writes and checks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// Run id.
    pub run_id: u64,
    /// Own role.
    pub role: Role,
    /// Own index among the processes of the role.
    pub index: u16,
    /// Own generation.
    pub generation: u32,
}

impl Identity {
    /// A header from this sender for a step.
    pub fn header(&self, step: u64, time_ns: u64) -> FrameHeader {
        FrameHeader {
            run_id: self.run_id,
            schema_hash: ipc_schemas::schema_hash(),
            step,
            time_ns,
            sender_role: self.role as u16,
            sender_index: self.index,
            generation: self.generation,
            ..FrameHeader::default()
        }
    }
}

/// Why a driver cannot go on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LockstepError {
    /// The transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The world's frame is not what the protocol asks for.
    #[error("frame from {sender}: {fault}")]
    Header {
        /// Who sent it.
        sender: String,
        /// What is wrong.
        fault: HeaderFault,
    },
    /// The world cannot go on, although all have answered.
    #[error("step {step}: {error}")]
    World {
        /// Step.
        step: u64,
        /// Why.
        error: AdvanceError,
    },
    /// State and coordination frames contradict each other.
    #[error("step {step}: {fault}")]
    Pool {
        /// Step.
        step: u64,
        /// What is wrong.
        fault: PoolError,
    },
}

/// Whoever looks on.
pub trait Observer: std::fmt::Debug {
    /// A step has been answered, or is the last, which nobody answers.
    fn observe(&mut self, frames: &StepFrames<'_>) -> Result<(), TransportError>;
}

/// The way to controllers written elsewhere: what became of their answers.
pub trait Feedbacks: std::fmt::Debug {
    /// Tells one of them, if there is such a one: at once, before anything that is sent later.
    fn tell(
        &mut self,
        controller: u16,
        header: FrameHeader,
        records: &[Feedback],
    ) -> Result<(), TransportError>;
}

/// A state to be answered.
#[derive(Debug)]
enum InHand<F> {
    /// As it came.
    Frame(F),
    /// Handed over.
    Handed(FrameHeader, Vec<VehicleState>),
}

impl<F: Frame<VehicleState>> InHand<F> {
    fn header(&self) -> &FrameHeader {
        match self {
            InHand::Frame(frame) => frame.header(),
            InHand::Handed(header, _) => header,
        }
    }

    fn records(&self) -> &[VehicleState] {
        match self {
            InHand::Frame(frame) => frame.records(),
            InHand::Handed(_, records) => records,
        }
    }
}

/// The sender a header names, for messages.
fn sender(header: &FrameHeader) -> String {
    match Role::from_code(header.sender_role) {
        Some(Role::World) => "the world".to_owned(),
        Some(role) => format!("{role} {}", header.sender_index),
        None => format!("a sender of unknown role {}", header.sender_role),
    }
}

/// A mask with one bit for each of `count` processes.
fn mask_of(count: u32) -> u64 {
    if count >= 64 { u64::MAX } else { (1 << count) - 1 }
}
