//! Coordination that schedules: the instants at which a zone's vehicles leave it, at least cost for all of them.
//!
//! [`cost`] has what a passage costs, [`pooling`] the least sum of such costs under headways, [`chain`] headways from
//! duties. `Scheduler` puts the three together for a zone and what it knows of its neighbours.
//! The derivation is in `docs/scheduling.md`.

pub mod chain;
pub mod cost;
pub mod pooling;
mod scheduler;

pub(super) use scheduler::{Heard, Queue, Scene, Scheduler};
