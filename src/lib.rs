//! Control Zones: safe, optimal coordination of connected automated vehicles through networks of
//! control zones, as a lockstep multi-process runtime.

pub mod app;
pub mod bench;
pub mod bounds;
pub mod compare;
pub mod conflict;
pub mod control;
pub mod coordination;
pub mod encoding;
mod lists;
pub mod lockstep;
pub mod own_time;
pub mod process;
pub mod record;
pub mod reproduce;
pub mod scenario;
pub mod shield;
pub mod step;
pub mod trace;
pub mod transport;
pub mod vehicle;
pub mod world;
