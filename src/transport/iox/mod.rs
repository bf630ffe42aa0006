//! Frames between processes: iceoryx2 publish/subscribe over shared memory.

mod ports;
mod space;

pub use ports::{IoxFrame, IoxInbox, IoxLoan, IoxOutbox};
pub use space::{
    AttachDesk, AttachLine, ReplyFrame, RunName, RunNameError, RunSpace, Service, ServiceLimits, SpaceError,
};
