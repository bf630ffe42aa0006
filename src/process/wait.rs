//! How a process waits for a frame: busily at first, then asleep, never for ever.

use super::placement::number_of_cores;
use super::realtime::Breather;
use super::{Peers, ProcessError, StopFlag};
use crate::lockstep::{Awaited, Handover, LockstepError, Progress};
use crate::scenario::ControllerNames;
use crate::transport::iox::Bell;
use ipc_schemas::{Role, WAITING_BLOCK, WAITING_HYBRID, WAITING_SPIN};
use std::time::{Duration, Instant};

/// How the processes of a run wait for each other's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum WaitMode {
    /// World and controllers spin, then yield; coordinators sleep from event to event.
    #[default]
    Hybrid,
    /// Everyone spins; needs a core for each process.
    Spin,
    /// Everyone sleeps until rung.
    Block,
}

impl WaitMode {
    /// The code in attach replies.
    pub fn code(self) -> u32 {
        match self {
            WaitMode::Hybrid => WAITING_HYBRID,
            WaitMode::Spin => WAITING_SPIN,
            WaitMode::Block => WAITING_BLOCK,
        }
    }

    /// The mode a reply names; an unknown code is the default, which always works.
    pub fn from_code(code: u32) -> WaitMode {
        match code {
            WAITING_SPIN => WaitMode::Spin,
            WAITING_BLOCK => WaitMode::Block,
            _ => WaitMode::Hybrid,
        }
    }

    /// Whether receivers of this role sleep on a bell, so that senders must ring.
    pub fn has_bell(self, receiver: Role) -> bool {
        match self {
            WaitMode::Hybrid => receiver == Role::Coordinator,
            WaitMode::Spin => false,
            WaitMode::Block => true,
        }
    }

    /// Processes of a run that wait busily: world and controllers, or everybody.
    pub fn hot_processes(self, coordinators: u32, controllers: u32) -> usize {
        1 + controllers as usize + if self == WaitMode::Spin { coordinators as usize } else { 0 }
    }
}

/// How long a process spins, yields and sleeps for one frame.
#[derive(Clone, Copy, Debug)]
pub struct Patience {
    /// Time spent spinning.
    spin: Duration,
    /// Time after which yielding ends too and sleeping begins.
    busy: Duration,
    /// Longest sleep between two polls.
    nap: Duration,
    /// A frame that takes longer ends the run.
    timeout: Duration,
}

/// Frames are sure to come within this time while all is well; beyond it, spinning is a waste.
const SPIN: Duration = Duration::from_micros(200);
/// Yielding gives way to sleeping after this time.
const BUSY: Duration = Duration::from_millis(2);
/// Sleep between polls without a bell.
const NAP: Duration = Duration::from_micros(50);
/// Sleep on a bell: the ring ends it; this only bounds how late signals and dead peers are noticed.
const BELL_NAP: Duration = Duration::from_millis(20);

impl Patience {
    /// What suits a role under a mode in a run with that many hot processes (world and controllers).
    pub fn of(mode: WaitMode, role: Role, hot_processes: usize, timeout: Duration) -> Patience {
        let cores = number_of_cores();
        let sleeper = Patience { spin: Duration::ZERO, busy: Duration::ZERO, nap: BELL_NAP, timeout };
        match mode {
            WaitMode::Block => sleeper,
            WaitMode::Hybrid if role == Role::Coordinator => sleeper,
            // More spinners than cores would only keep each other from working.
            WaitMode::Hybrid if hot_processes > cores => {
                Patience { spin: Duration::ZERO, busy: BUSY, nap: NAP, timeout }
            }
            WaitMode::Hybrid => Patience { spin: SPIN, busy: BUSY, nap: NAP, timeout },
            WaitMode::Spin => Patience { spin: Duration::MAX, busy: Duration::MAX, nap: NAP, timeout },
        }
    }

    /// Whether spinning is followed by yielding: neither where it never ends nor under SCHED_FIFO.
    fn yields(&self) -> bool {
        self.spin < self.busy
    }
}

/// A driver of a participant.
pub trait Participant {
    /// Does what can be done now.
    fn advance(&mut self) -> Result<Progress, LockstepError>;
    /// Goes on from what another has left, or from where the run is now.
    fn take_over(&mut self, handover: Handover);
}

/// Waits for one frame after another.
#[derive(Debug)]
pub struct Waiter {
    patience: Patience,
    bell: Option<Bell>,
    stop: StopFlag,
    peers: Peers,
    names: ControllerNames,
    polls: u32,
    since: Option<Instant>,
    waited: Duration,
    peers_checked: Duration,
    /// There is one when the process would keep others from running.
    breather: Option<Breather>,
}

/// How often the clock is read while polling busily: reading it costs about as much as a poll.
const POLLS_PER_LOOK: u32 = 64;
/// How long a peer that has left the services may take to end.
const LEAVING: Duration = Duration::from_millis(200);
/// How often the peers are checked during a long wait.
const PEER_CHECK: Duration = Duration::from_millis(10);

impl Waiter {
    /// A waiter that gives up when asked to stop, when a peer has died, or when patience runs out.
    pub fn new(patience: Patience, bell: Option<Bell>, stop: StopFlag, peers: Peers) -> Waiter {
        // Without a bell nobody ends a long sleep.
        let nap = if bell.is_some() { patience.nap } else { patience.nap.min(NAP) };
        let breather = Breather::if_needed();
        // Under SCHED_FIFO a yield lets nobody run who does not have it too: sleeping does.
        let busy = if breather.is_some() { patience.spin } else { patience.busy };
        Waiter {
            patience: Patience { nap, busy, ..patience },
            breather,
            bell,
            stop,
            peers,
            names: ControllerNames::default(),
            polls: 0,
            since: None,
            waited: Duration::ZERO,
            peers_checked: Duration::ZERO,
        }
    }

    /// Something came.
    pub fn reset(&mut self) {
        if let Some(breather) = &mut self.breather {
            breather.breathe();
        }
        self.polls = 0;
        self.since = None;
        self.waited = Duration::ZERO;
        self.peers_checked = Duration::ZERO;
    }

    /// Nothing came: waits a little, or says why waiting is over.
    pub fn wait(&mut self, awaited: Awaited) -> Result<(), ProcessError> {
        self.polls = self.polls.wrapping_add(1);
        let busy = self.waited < self.patience.busy;
        if !busy || self.polls.is_multiple_of(POLLS_PER_LOOK) {
            self.look(awaited)?;
        }
        // A coordinator has just been woken, likely on this core: spinning would only keep it from it.
        let give_way = awaited.role == Role::Coordinator && self.patience.yields();
        if self.waited < self.patience.spin && !give_way {
            std::hint::spin_loop();
        } else if busy {
            std::thread::yield_now();
        } else if let Some(bell) = &self.bell {
            bell.sleep(self.patience.nap);
        } else {
            std::thread::sleep(self.patience.nap);
        }
        Ok(())
    }

    /// Looks at the signals, the clock and the peers.
    fn look(&mut self, awaited: Awaited) -> Result<(), ProcessError> {
        if self.stop.is_set() {
            return Err(ProcessError::Interrupted { step: Some(awaited.step) });
        }
        if let Some(breather) = &mut self.breather {
            breather.breathe();
        }
        self.waited = self.since.get_or_insert_with(Instant::now).elapsed();
        if self.waited >= self.patience.timeout {
            let awaited = awaited.named(&self.names);
            return Err(ProcessError::Timeout { awaited, seconds: self.patience.timeout.as_secs_f64() });
        }
        if self.waited >= self.peers_checked + PEER_CHECK {
            self.peers_checked = self.waited;
            if let Some(peer) = self.peers.first_gone() {
                let consequence = format!("this one was waiting for {}", awaited.named(&self.names));
                let name = peer.name(&self.names);
                return Err(ProcessError::PeerGone { peer, name, consequence });
            }
        }
        Ok(())
    }

    /// What to call controllers from now on.
    pub fn call(&mut self, names: ControllerNames) {
        self.names = names;
    }

    /// Whom to look after from now on.
    pub fn set_peers(&mut self, peers: Peers) {
        self.peers = peers;
    }

    /// How long the present wait has lasted, as of the last look at the clock.
    pub fn waited(&self) -> Duration {
        self.waited
    }

    /// Drives a participant to the end of the run; `catch_up` gets what it needs when it has fallen behind.
    pub fn drive(
        &mut self,
        driver: &mut impl Participant,
        catch_up: impl Fn() -> Result<Option<Handover>, ProcessError>,
    ) -> Result<(), ProcessError> {
        loop {
            match driver.advance().map_err(|error| self.explain(error))? {
                Progress::Finished => return Ok(()),
                Progress::Advanced => self.reset(),
                Progress::Waiting(awaited) => self.wait(awaited)?,
                Progress::Behind => {
                    if let Some(handover) = catch_up()? {
                        driver.take_over(handover);
                    }
                    self.reset();
                }
            }
        }
    }

    /// Why the protocol broke: the end of a peer, if one ended, is the better explanation.
    pub fn explain(&self, error: LockstepError) -> ProcessError {
        // A peer first leaves the services and then ends.
        let deadline = Instant::now() + LEAVING;
        loop {
            if let Some(peer) = self.peers.first_gone() {
                let name = peer.name(&self.names);
                return ProcessError::PeerGone { peer, name, consequence: error.to_string() };
            }
            if Instant::now() >= deadline {
                return error.into();
            }
            std::thread::sleep(NAP);
        }
    }
}
