//! The processes of a run: thin shells that give the pure roles a clock, signals and a transport.

mod attach;
mod in_process;
mod membership;
mod observe;
mod outcome;
mod pace;
mod participant;
mod peers;
mod placement;
pub mod plugin_check;
mod plugin_child;
mod plugin_log;
mod plugin_replay;
mod realtime;
mod restore;
mod run_spec;
pub mod seating;
mod services;
mod stop;
mod viewing;
mod wait;
mod wait_policy;
mod world;
mod world_check;

pub use attach::{Attachment, Joining};
pub use in_process::{
    run_in_process, run_in_process_observed, run_on_in_process, run_on_in_process_observed,
};
pub use observe::{Observation, RecordLag};
pub use outcome::{LatencyBin, LatencyUs, Outcome, Percentiles, Replacement, WARM_UP_STEPS, new_histogram};
pub use pace::{MissedBy, OnMiss, Pace, Punctuality, Timing};
pub use participant::{Conduct, run_controller, run_coordinator};
pub use peers::{Peer, Peers, children_of, is_orphaned, is_stopped};
pub use placement::{Affinity, Placement, place, unplaced};
pub use plugin_log::{DrivenBy, PluginRow};
pub use plugin_replay::{
    CommandDifference, PluginReplay, PluginReplayError, PluginReplayOptions, replay_plugin,
};
pub use realtime::{Held, Settled, Settling};
pub use restore::{RestoreError, restore};
pub use run_spec::plugin_bytes;
pub use services::expected_vehicles;
pub use stop::{StopFlag, signals_to_heed};
pub use viewing::{Notice, Place, Steering, Watched};
pub use wait::{Patience, WaitMode, Waiter};
pub use world::{Departure, WorldOptions, check_cores, first_missing_step, new_run_id, run_world};
pub use world_check::{
    CHANGES, Tolerances, WorldBreach, WorldCheckOptions, WorldReport, WorldRule, check_world,
};

use crate::lockstep::LockstepError;
use crate::scenario::DecodeError;
use crate::transport::TransportError;
use crate::transport::iox::SpaceError;

/// Why a process of a run ended early.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The shared-memory space failed.
    #[error(transparent)]
    Space(#[from] SpaceError),
    /// A frame could not be sent or received.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The protocol was broken.
    #[error(transparent)]
    Lockstep(#[from] LockstepError),
    /// SIGINT or SIGTERM.
    #[error("interrupted{}", .step.map(|s| format!(" at step {s}")).unwrap_or_default())]
    Interrupted {
        /// Step at that time, once the run had begun.
        step: Option<u64>,
    },
    /// Another world is running under that name.
    #[error("run {run} is active already; choose another name with --run")]
    AlreadyActive {
        /// Run name.
        run: String,
    },
    /// Nobody answered an attach request.
    #[error("no world of run {run} answered within {seconds} s; start one with `cz-world --run {run}`")]
    NoWorld {
        /// Run name.
        run: String,
        /// How long was waited.
        seconds: f64,
    },
    /// The world did not let a participant in.
    #[error("the world of run {run} refused this {role}: {reason}")]
    Refused {
        /// Run name.
        run: String,
        /// Own role.
        role: ipc_schemas::Role,
        /// Why.
        reason: String,
    },
    /// Participants are missing at the start.
    #[error("waited {seconds} s for {missing} of run {run}; start it with `{command} --run {run}`")]
    Missing {
        /// Run name.
        run: String,
        /// Who.
        missing: String,
        /// Program that would start one.
        command: &'static str,
        /// How long was waited.
        seconds: f64,
    },
    /// A recording to go on from cannot be replayed.
    #[error(transparent)]
    Resume(#[from] crate::record::ReplayError),
    /// Nobody came to record a run that is to be recorded.
    #[error("waited {seconds} s for whoever is to record the run")]
    NotObserved {
        /// How long was waited.
        seconds: f64,
    },
    /// There are more processes than cores to spin on.
    #[error(
        "waiting by spinning needs a core for each of the {processes} processes, and there are {cores}; use --wait hybrid"
    )]
    TooFewCores {
        /// Processes of the run.
        processes: usize,
        /// Cores this process may use.
        cores: usize,
    },
    /// A frame did not come in time.
    #[error("waited {seconds} s for {awaited}")]
    Timeout {
        /// What was waited for.
        awaited: String,
        /// How long.
        seconds: f64,
    },
    /// A step was not done by its deadline, in a run that ends then.
    #[error("the deadline of step {step} was missed: no {awaited}")]
    DeadlineMissed {
        /// The step.
        step: u64,
        /// What had not come.
        awaited: String,
    },
    /// A participant sent what it should not have and nothing better since.
    #[error("{who} sent a frame that cannot be taken, and no good one since: {fault}")]
    Faulty {
        /// Who.
        who: String,
        /// What was wrong with the frame.
        fault: crate::lockstep::Refusal,
    },
    /// A process of the run has ended or died.
    #[error("{name} (process {}) is gone; {consequence}", .peer.process_id)]
    PeerGone {
        /// Who.
        peer: Peer,
        /// What it is called.
        name: String,
        /// What that meant here.
        consequence: String,
    },
    /// The scenario or the handover that came with an attach reply cannot be read.
    #[error("what the world sent cannot be read: {0}")]
    Scenario(#[from] DecodeError),
    /// Signal handlers could not be installed.
    #[error("cannot handle signals: {0}")]
    Signals(std::io::Error),
    /// A folder for a check's files could not be made.
    #[error("cannot make {}: {error}", .path.display())]
    Folder {
        /// Where.
        path: std::path::PathBuf,
        /// Why.
        error: std::io::Error,
    },
}
