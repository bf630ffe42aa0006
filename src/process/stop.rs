//! SIGINT, SIGTERM and SIGHUP as a flag that is looked at between frames.

use super::ProcessError;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The signals that ask a process to end. SIGHUP, a closed terminal, does unless whoever started the process
/// has had it ignored, as `nohup` does.
pub fn signals_to_heed() -> Vec<i32> {
    let mut signals = vec![SIGINT, SIGTERM];
    if !is_ignored(SIGHUP) {
        signals.push(SIGHUP);
    }
    signals
}

fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    ignored >> (signal - 1) & 1 == 1
}

/// Set once one of them has come.
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
        for signal in signals_to_heed() {
            signal_hook::flag::register(signal, flag.0.clone()).map_err(ProcessError::Signals)?;
        }
        Ok(flag)
    }

    /// Has whoever looks at it stop.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether to stop.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
