//! Frames between processes: iceoryx2 publish/subscribe over shared memory.

mod bell;
mod blocks;
mod leftovers;
mod place;
mod ports;
mod space;
mod watchdog;

pub use bell::{Bell, BellRope, Bells, monotonic_ns};
pub use blocks::{Block, BlockInbox, BlockOutbox};
pub use leftovers::{Condition, Leftover, clean, sweep_dead_runs};
pub use ports::{IoxFrame, IoxInbox, IoxLoan, IoxOutbox};
pub use space::{
    AttachDesk, AttachLine, ReplyFrame, RunName, RunNameError, RunSpace, Service, ServiceLimits, SpaceError,
};
