//! Measurements a user runs on their own machine: `cz bench`.

mod instructions;
mod latency;
mod machine;
mod peer;
mod scale;
mod shared_word;
mod side_by_side;
mod socket;
mod solver;
mod step;
mod sumo;
mod viewed;
mod waiting;

pub use latency::{LatencyOptions, LatencyReport, latency, two_processes};
pub use machine::Machine;
pub use peer::{PeerKind, keep_busy, run_peer};
pub use scale::{ScaleOptions, ScaleReport, scale};
pub use side_by_side::{Family, side_by_side};
pub use solver::{SolverReport, solver};
pub use sumo::{Sumo, SumoSide};
pub use viewed::{RunSeen, Seen, ViewedOptions, ViewedPoint, ViewedReport, look, viewed};
pub(crate) use waiting::median;
pub use waiting::{NINE, Side, THREE, Timed, WaitingOptions, WaitingPoint, WaitingReport, waiting};

use crate::lockstep::LockstepError;
use crate::process::ProcessError;
use crate::transport::iox::SpaceError;
use std::time::Duration;

/// The embedded scenario that measurements run unless they say another: the paper's setting, whatever becomes of the default.
pub const MEASURED: &str = "paper";

/// Why a measurement could not be made.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// A run of the measurement failed.
    #[error(transparent)]
    Process(#[from] ProcessError),
    /// A step failed.
    #[error(transparent)]
    Lockstep(#[from] LockstepError),
    /// Shared memory failed.
    #[error(transparent)]
    Space(#[from] SpaceError),
    /// A frame could not be exchanged.
    #[error(transparent)]
    Transport(#[from] crate::transport::TransportError),
    /// A file or socket failed.
    #[error("{what}: {source}")]
    Io {
        /// What was attempted.
        what: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The other process did not do its part.
    #[error("the other process of the measurement ended early or does not answer")]
    Peer,
    /// SUMO is not there.
    #[error(
        "no SUMO in {python} ({reason}); install it with `{python} -m pip install eclipse-sumo==1.28.0`, or \
         name another Python in CZ_PYTHON"
    )]
    NoSumo {
        /// The Python that was asked.
        python: String,
        /// What it said.
        reason: String,
    },
    /// SUMO failed.
    #[error("SUMO with {vehicles} vehicles: {reason}")]
    Sumo {
        /// Vehicles at once.
        vehicles: usize,
        /// What it said.
        reason: String,
    },
    /// A supervised run failed.
    #[error("{0}")]
    Run(String),
    /// Two variants that must agree do not.
    #[error("{0}")]
    Disagreement(String),
}

/// How long anything is waited for.
const PATIENCE: Duration = Duration::from_secs(10);

fn io(what: &'static str) -> impl Fn(std::io::Error) -> BenchError {
    move |source| BenchError::Io { what, source }
}
