//! Frames between processes: iceoryx2 publish/subscribe over shared memory.

mod bell;
mod blocks;
mod error;
mod leftovers;
mod name;
mod place;
mod ports;
mod space;
mod unfinished;
mod watchdog;

pub use bell::{Bell, BellRope, Bells, Ring, monotonic_ns};
pub use blocks::{Block, BlockInbox, BlockOutbox, SteeringInbox, SteeringOutbox};
pub use error::SpaceError;
pub use leftovers::{Condition, Leftover, clean, sweep_dead_runs};
pub use name::{RunName, RunNameError};
pub use ports::{IoxFrame, IoxInbox, IoxLoan, IoxOutbox};
pub use space::{AttachLine, AttachServer, ReplyFrame, RunSpace, Service, ServiceLimits};
