//! What runs: the programs, one or several processes each, from their start to what they leave.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

#[path = "../common/mod.rs"]
mod common;
#[allow(dead_code)] // its `main`
#[path = "../../examples/rust/world.rs"]
mod world;

mod cli;
mod compare;
mod endings;
mod faults;
mod hostile;
mod many_runs;
mod overlaps;
mod parts_by_hand;
mod played_world;
mod plugin_check;
mod plugins;
mod random_kills;
mod record;
mod replacement;
mod resume;
mod run_hashes;
mod seeded_faults;
mod short_runs;
mod siblings;
mod traces;
mod transport_conformance;
mod waiting;
mod world_check;
