//! The world role: arrivals, vehicle states, integration, metrics. Commands in, states out.

mod car;
mod gate;
mod integrate;
mod link;
mod metrics;
mod world;

pub use metrics::{CompletedVisit, WorldSummary, ZoneSummaryRow};
pub use world::{CommandFault, CoordinatorMasks, World};
