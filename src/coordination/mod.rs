//! The coordinator role: passing order, constraint partners and terminal speed of some zones.

mod assign;
mod coordinator;
mod flow;
mod order;
pub mod schedule;
mod summaries;

pub use coordinator::Coordinator;
pub use flow::FlowController;
pub use summaries::{Audience, is_event};
