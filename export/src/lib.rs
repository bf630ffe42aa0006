//! Recordings of Control Zones for other tools: SUMO's XML, CSV, Parquet, MCAP and Perfetto traces, and a page to
//! read.
//!
//! Everything is made in one pass over the recorded steps ([`walk`]), with the world brought on beside them by the
//! recorded commands, so that visits and results are the run's own.

pub mod csv;
pub mod events;
pub mod export;
pub mod fcd;
pub mod mcap;
mod out;
pub mod parquet;
pub mod perfetto;
pub mod report;
pub mod ssm;
pub mod tables;
pub mod tripinfo;
pub mod trips;
pub mod walk;
mod xml;

pub use out::OutError;
