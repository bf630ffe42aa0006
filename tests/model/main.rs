//! What is computed: laws, the shield, orders and schedules, scenarios, whole runs in memory. Nothing here starts a process.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod adversaries;
mod bounds;
mod extremes;
mod humans;
mod law;
mod lost_frames;
mod network_properties;
mod qp;
mod random;
mod random_zones;
mod reference;
mod reproduce;
mod scenario_errors;
mod scheduling;
mod shares;
mod shield;
mod standstill;
mod turncoats;
mod viable;
