//! Frames between processes: iceoryx2 publish/subscribe over shared memory.

mod bell;
mod ports;
mod space;

pub use bell::{Bell, BellRope, BellService};
pub use ports::{IoxFrame, IoxInbox, IoxLoan, IoxOutbox};
pub use space::{
    AttachDesk, AttachLine, ReplyFrame, RunName, RunNameError, RunSpace, Service, ServiceLimits, SpaceError,
};
