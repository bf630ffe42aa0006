//! The coordinator role: passing order, constraint partners and terminal speed of some zones.

mod coordinator;
mod flow;
mod partners;
mod summaries;

pub use coordinator::Coordinator;
pub use flow::FlowController;
pub use summaries::{Audience, is_event};
