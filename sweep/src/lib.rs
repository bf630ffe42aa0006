//! Sweeps: policies by scenarios by seeds, a run each, as one table.
//!
//! A run is a function of a scenario, seed included, and of the program. So its [`outcome`] is kept under the hash of
//! both, a [`plan`] says which outcomes there are not yet, anybody may make these (the [`workers`] of this machine, or those
//! of a cluster), and the [`table`] is made of what is kept: it does not depend on who ran what, when, or how often.

pub mod cli;
pub mod outcome;
pub mod plan;
pub mod table;
pub mod workers;
