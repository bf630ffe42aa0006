//! SIGINT and SIGTERM as a flag that is looked at between frames.

use super::ProcessError;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Set once SIGINT or SIGTERM has come.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// A flag that is never set by a signal.
    pub fn none() -> StopFlag {
        StopFlag::default()
    }

    /// Installs the handlers of this process.
    pub fn from_signals() -> Result<StopFlag, ProcessError> {
        let flag = StopFlag::default();
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            signal_hook::flag::register(signal, flag.0.clone()).map_err(ProcessError::Signals)?;
        }
        Ok(flag)
    }

    /// Whether to stop.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
