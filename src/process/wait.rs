//! How a process waits for a frame: busily at first, then asleep, never for ever.

use super::{Peer, Peers, ProcessError, StopFlag};
use crate::lockstep::{Awaited, LockstepError, Progress};
use crossbeam::utils::Backoff;
use std::time::{Duration, Instant};

/// How long to wait, and how.
#[derive(Clone, Copy, Debug)]
pub struct Patience {
    /// Time spent polling (spinning, then yielding) before going to sleep between polls.
    pub busy: Duration,
    /// Time slept between polls after that.
    pub nap: Duration,
    /// A frame that takes longer ends the run.
    pub timeout: Duration,
}

impl Patience {
    /// For the world and the controllers, which are busy in every step.
    pub fn hot(timeout: Duration) -> Patience {
        Patience { busy: Duration::from_millis(2), nap: Duration::from_micros(100), timeout }
    }

    /// For coordinators, which sleep from event to event and leave the cores to the others.
    pub fn cold(timeout: Duration) -> Patience {
        Patience { busy: Duration::ZERO, nap: Duration::from_micros(50), timeout }
    }
}

fn peer_gone(peer: Peer, consequence: String) -> ProcessError {
    ProcessError::PeerGone { who: peer.to_string(), process_id: peer.process_id, consequence }
}

/// Waits for one frame after another.
#[derive(Debug)]
pub struct Waiter {
    patience: Patience,
    stop: StopFlag,
    peers: Peers,
    backoff: Backoff,
    polls: u32,
    is_busy: bool,
    since: Option<Instant>,
    peers_checked: Duration,
}

/// How often the clock is read while polling busily.
const POLLS_PER_LOOK: u32 = 32;
/// How long a peer that has left the services may take to end.
const LEAVING: Duration = Duration::from_millis(200);
/// How often the peers are checked during a long wait.
const PEER_CHECK: Duration = Duration::from_millis(50);

impl Waiter {
    /// A waiter that gives up when asked to stop, when a peer has died, or when patience runs out.
    pub fn new(patience: Patience, stop: StopFlag, peers: Peers) -> Waiter {
        Waiter {
            patience,
            stop,
            peers,
            backoff: Backoff::new(),
            polls: 0,
            is_busy: !patience.busy.is_zero(),
            since: None,
            peers_checked: Duration::ZERO,
        }
    }

    /// Something came.
    pub fn reset(&mut self) {
        if self.polls > 0 {
            self.polls = 0;
            self.is_busy = !self.patience.busy.is_zero();
            self.since = None;
            self.peers_checked = Duration::ZERO;
            self.backoff.reset();
        }
    }

    /// Nothing came: waits a little, or says why waiting is over.
    pub fn wait(&mut self, awaited: Awaited) -> Result<(), ProcessError> {
        self.polls = self.polls.wrapping_add(1);
        // Reading the clock costs as much as a poll: look at it now and then.
        if self.is_busy && !self.polls.is_multiple_of(POLLS_PER_LOOK) {
            self.backoff.snooze();
            return Ok(());
        }
        if self.stop.is_set() {
            return Err(ProcessError::Interrupted { step: Some(awaited.step) });
        }
        let waited = self.since.get_or_insert_with(Instant::now).elapsed();
        if waited >= self.patience.timeout {
            return Err(ProcessError::Timeout { awaited, seconds: self.patience.timeout.as_secs_f64() });
        }
        if waited >= self.peers_checked + PEER_CHECK {
            self.peers_checked = waited;
            self.check_peers(awaited)?;
        }
        self.is_busy = waited < self.patience.busy;
        if self.is_busy {
            self.backoff.snooze();
        } else {
            std::thread::sleep(self.patience.nap);
        }
        Ok(())
    }

    /// Drives a state machine to the end of the run.
    pub fn drive(
        &mut self,
        mut advance: impl FnMut() -> Result<Progress, LockstepError>,
    ) -> Result<(), ProcessError> {
        loop {
            match advance().map_err(|error| self.explain(error))? {
                Progress::Finished => return Ok(()),
                Progress::Advanced => self.reset(),
                Progress::Waiting(awaited) => self.wait(awaited)?,
            }
        }
    }

    /// Why the protocol broke: the end of a peer, if one ended, is the better explanation.
    pub fn explain(&self, error: LockstepError) -> ProcessError {
        // A peer first leaves the services and then ends.
        let deadline = Instant::now() + LEAVING;
        loop {
            if let Some(peer) = self.peers.first_gone() {
                return peer_gone(peer, error.to_string());
            }
            if Instant::now() >= deadline {
                return error.into();
            }
            std::thread::sleep(self.patience.nap);
        }
    }

    fn check_peers(&self, awaited: Awaited) -> Result<(), ProcessError> {
        match self.peers.first_gone() {
            None => Ok(()),
            Some(peer) => Err(peer_gone(peer, format!("this one was waiting for {awaited}"))),
        }
    }
}
