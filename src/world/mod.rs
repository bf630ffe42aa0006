//! The world role: arrivals, vehicle states, integration, metrics. Commands in, states out.

mod car;
mod change;
mod command_fault;
mod faults;
mod gate;
mod gateway;
mod human;
mod integrate;
mod left;
mod link;
#[cfg(test)]
mod merge_hashes;
mod metrics;
mod overlap;
mod owed;
mod role;
mod standstill;
mod traffic;
mod waiting;
mod way;

pub use change::ChangeError;
pub use command_fault::CommandFault;
pub use gateway::PutIn;
pub use metrics::{CompletedVisit, FaultCounts, ShieldRow, ShieldSummary, WorldSummary, ZoneSummaryRow};
pub use overlap::{FirstOverlap, OverlapSummary};
pub use role::{CoordinatorMasks, Sheet, World};
pub use standstill::Stall;
pub use traffic::{
    Admitted, AdvanceError, Coming, Done, Newcomer, Task, Traffic, TrafficError, TrafficSummary,
};
