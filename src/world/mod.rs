//! The world role: arrivals, vehicle states, integration, metrics. Commands in, states out.

mod car;
mod gate;
mod integrate;
mod link;
mod metrics;
mod role;

pub use metrics::{CompletedVisit, WorldSummary, ZoneSummaryRow};
pub use role::{CommandFault, CoordinatorMasks, World};
