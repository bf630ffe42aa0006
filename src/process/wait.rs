//! How a process waits for a frame: busily at first, then asleep, never for ever.

use super::placement::{core_of, cores_online, go_to, idle_ns, number_of_cores};
use super::realtime::{Breather, is_fifo};
use super::wait_policy::{Advice, Cores, Situation, WaitPolicy};
use super::{Peers, ProcessError, StopFlag};
use crate::lockstep::{Awaited, Handover, LockstepError, Progress};
use crate::own_time::LONGEST_PAUSE;
use crate::scenario::ControllerNames;
use crate::trace::{self, Phase};
use crate::transport::iox::{Bell, BellRope, monotonic_ns};
use ipc_schemas::{Role, WAITING_ADAPTIVE, WAITING_BLOCK, WAITING_HYBRID, WAITING_SPIN};
use rustix::thread::sched_getcpu;
use std::io::Read;
use std::time::{Duration, Instant};

/// How the processes of a run wait for each other's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum WaitMode {
    /// World and controllers spin while that pays and sleep otherwise; coordinators sleep from event to event.
    #[default]
    Adaptive,
    /// World and controllers spin, then yield; coordinators sleep from event to event.
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
            WaitMode::Adaptive => WAITING_ADAPTIVE,
            WaitMode::Hybrid => WAITING_HYBRID,
            WaitMode::Spin => WAITING_SPIN,
            WaitMode::Block => WAITING_BLOCK,
        }
    }

    /// The mode a reply names; an unknown code is the default, which always works.
    pub fn from_code(code: u32) -> WaitMode {
        match code {
            WAITING_HYBRID => WaitMode::Hybrid,
            WAITING_SPIN => WaitMode::Spin,
            WAITING_BLOCK => WaitMode::Block,
            _ => WaitMode::Adaptive,
        }
    }

    /// Whether receivers of this role may sleep on a bell, so that senders must ring.
    pub fn has_bell(self, receiver: Role) -> bool {
        match self {
            WaitMode::Hybrid => receiver == Role::Coordinator,
            WaitMode::Spin => false,
            WaitMode::Adaptive | WaitMode::Block => true,
        }
    }

    /// Processes of a run that wait busily: world and controllers, or everybody.
    pub fn hot_processes(self, coordinators: u32, controllers: u32) -> usize {
        1 + controllers as usize + if self == WaitMode::Spin { coordinators as usize } else { 0 }
    }
}

/// How a process waits for a frame, and how long at most.
#[derive(Debug)]
pub struct Patience {
    manner: Manner,
    /// Who is woken goes to the core that is given away to it.
    follows: bool,
    /// A frame that takes longer ends the run.
    timeout: Duration,
}

/// When a process spins, yields and sleeps.
#[derive(Debug)]
enum Manner {
    /// For times laid down.
    Fixed {
        /// Time spent spinning.
        spin: Duration,
        /// Time after which yielding ends too and sleeping begins.
        busy: Duration,
    },
    /// As experience tells, in a run of that many processes that wait busily.
    Learned(WaitPolicy, usize),
}

/// Frames are sure to come within this time while all is well; beyond it, spinning is a waste.
const SPIN: Duration = Duration::from_micros(200);
/// Yielding gives way to sleeping after this time.
const BUSY: Duration = Duration::from_millis(2);
/// Sleep between polls without a bell.
const NAP: Duration = Duration::from_micros(50);
/// Sleep on a bell: the ring ends it; this only bounds how late signals and dead peers are noticed.
const BELL_NAP: Duration = Duration::from_millis(10);

impl Patience {
    /// What suits a role under a mode in a run with that many hot processes (world and controllers).
    pub fn of(mode: WaitMode, role: Role, hot_processes: usize, timeout: Duration) -> Patience {
        let shares_cores = hot_processes > number_of_cores();
        // Under SCHED_FIFO a yield lets nobody run who does not have it too: sleeping does.
        let may_yield = !is_fifo();
        let busy = if may_yield { BUSY } else { SPIN };
        let manner = match mode {
            WaitMode::Block => Manner::ASLEEP,
            WaitMode::Adaptive | WaitMode::Hybrid if role == Role::Coordinator => Manner::ASLEEP,
            WaitMode::Adaptive => {
                Manner::Learned(WaitPolicy::new(Situation { shares_cores, may_yield }), hot_processes)
            }
            // More spinners than cores would only keep each other from working.
            WaitMode::Hybrid if shares_cores => Manner::Fixed { spin: Duration::ZERO, busy },
            WaitMode::Hybrid => Manner::Fixed { spin: SPIN, busy },
            WaitMode::Spin => Manner::Fixed { spin: Duration::MAX, busy: Duration::MAX },
        };
        // Controllers that wake a coordinator give their core away until it has answered. On another it would have to
        // interrupt whoever is there, most likely the world, which spins.
        let follows = mode == WaitMode::Adaptive && role == Role::Coordinator;
        Patience { manner, follows, timeout }
    }
}

impl Manner {
    const ASLEEP: Manner = Manner::Fixed { spin: Duration::ZERO, busy: Duration::ZERO };

    /// Whether a wait begins with spinning, so that the first look can wait too.
    fn begins_spinning(&self, gives_way: bool) -> bool {
        match self {
            Manner::Fixed { spin, busy } => !(spin.is_zero() || gives_way && spin < busy),
            Manner::Learned(policy, _) => policy.begins_spinning(gives_way),
        }
    }

    /// Whether others are taken to want the cores.
    fn is_crowded(&self) -> bool {
        matches!(self, Manner::Learned(policy, _) if policy.is_crowded())
    }

    /// How many yields there are to a look: the time that one takes may say something.
    fn yields_per_look(&self) -> u64 {
        match self {
            Manner::Fixed { .. } => POLLS_PER_LOOK,
            Manner::Learned(policy, _) if policy.expects_company() => YIELDS_PER_LOOK,
            Manner::Learned(..) => 1,
        }
    }
}

/// How many processes run or want to, where the system tells.
fn runnable() -> Option<usize> {
    // See proc(5): the fourth field is those that run or wait to run, a slash, and all there are.
    let mut text = [0; 64];
    let length = std::fs::File::open("/proc/loadavg").and_then(|mut file| file.read(&mut text)).unwrap_or(0);
    let load = std::str::from_utf8(&text[..length]).unwrap_or_default();
    load.split_whitespace().nth(3)?.split('/').next()?.parse().ok()
}

/// Whether the cores are too few for others and for those of this run that wait busily, with so many processes that want
/// to run, this one and so many others of this run among them.
fn are_full(runnable: usize, own_awake: usize, hot_processes: usize, cores: usize) -> bool {
    let others = runnable.saturating_sub(1 + own_awake);
    others > 0 && others + hot_processes > cores
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
    /// The bells of coordinators, by index.
    coordinators: Vec<BellRope>,
    /// Those of all other processes of the run.
    others: Vec<BellRope>,
    /// What to do until the next look; nothing is known yet at the beginning of a wait.
    advice: Option<Advice>,
    /// The bell has been told that this process is about to sleep.
    lies_down: bool,
    stop: StopFlag,
    peers: Peers,
    names: ControllerNames,
    polls: u64,
    /// When the clock was looked at last.
    since: Option<u64>,
    /// The bound of the first wait, where it is another.
    first: Option<Duration>,
    waited: Duration,
    peers_checked: Duration,
    /// The core that is this process's among those of the run, where it goes when it finds a peer on its own.
    home: Option<usize>,
    /// Another core, which whoever has woken it has given away to it.
    given: Option<usize>,
    /// When it last went to another core, ns on the monotonic clock.
    moved_ns: u64,
    /// There is one when the process would keep others from running.
    breather: Option<Breather>,
}

/// How often the clock is read while polling busily: reading it costs about as much as a poll.
const POLLS_PER_LOOK: u64 = 32;
/// The same while yielding where peers run in every yield: together these take less than a turn of others.
const YIELDS_PER_LOOK: u64 = 4;
/// How long a peer that has left the services may take to end.
const LEAVING: Duration = Duration::from_millis(200);
/// How often a process goes to another core, at most, ns: where the system takes it away there is nothing to be gained.
const MOVE_EVERY_NS: u64 = 2_000_000;
/// How often the peers are checked during a long wait.
const PEER_CHECK: Duration = Duration::from_millis(10);

impl Waiter {
    /// A waiter that gives up when asked to stop, when a peer has died, or when patience runs out.
    pub fn new(patience: Patience, bell: Option<Bell>, stop: StopFlag, peers: Peers) -> Waiter {
        Waiter {
            patience,
            bell,
            coordinators: Vec::new(),
            others: Vec::new(),
            advice: None,
            lies_down: false,
            stop,
            peers,
            names: ControllerNames::default(),
            polls: 0,
            since: None,
            first: None,
            waited: Duration::ZERO,
            peers_checked: Duration::ZERO,
            home: None,
            given: None,
            moved_ns: 0,
            breather: Breather::if_needed(),
        }
    }

    /// Has the first wait be bounded so.
    pub fn begin_within(mut self, bound: Duration) -> Waiter {
        self.first = Some(bound);
        self
    }

    /// Goes to the core of this process, unless it is there, when it finds a peer on its own.
    pub fn apart(mut self, role: Role, index: u32) -> Waiter {
        self.home = core_of(role, index);
        self
    }

    /// Tells others' processes from those of this run, whose bells these are.
    pub fn among(mut self, others: Vec<BellRope>) -> Waiter {
        self.others = others;
        self
    }

    /// Wakes the coordinators it waits for, by these ropes of theirs.
    pub fn waking(mut self, coordinators: Vec<BellRope>) -> Waiter {
        self.coordinators = coordinators;
        self
    }

    /// Wakes the coordinators of this mask that sleep.
    pub fn wake(&self, mask: u64) {
        self.coordinators_of(mask).for_each(BellRope::ring);
    }

    /// The same, before this process gives its core away to them.
    fn give_way_to(&self, mask: u64) {
        self.coordinators_of(mask).for_each(BellRope::ring_and_give_way);
    }

    fn coordinators_of(&self, mask: u64) -> impl Iterator<Item = &BellRope> {
        let all = self.coordinators.iter().enumerate();
        all.filter(move |(i, _)| mask >> i & 1 == 1).map(|(_, rope)| rope)
    }

    /// Something came.
    pub fn reset(&mut self) {
        if let Some(breather) = &mut self.breather {
            breather.breathe();
        }
        self.first = None;
        if std::mem::take(&mut self.polls) == 0 {
            return;
        }
        self.advice = None;
        if let Manner::Learned(policy, _) = &mut self.patience.manner
            && policy.came(monotonic_ns)
            && !policy.is_crowded()
            && let Some(home) = self.home
            && self.may_move()
        {
            go_to(home);
        }
        if self.since.take().is_none() {
            // Nobody has so much as looked at the clock.
            return;
        }
        if std::mem::take(&mut self.lies_down)
            && let Some(bell) = &self.bell
        {
            bell.stay_awake();
        }
        self.waited = Duration::ZERO;
        self.peers_checked = Duration::ZERO;
    }

    /// Nothing came: waits a little, `at_most` so long, or says why waiting is over.
    pub fn wait(&mut self, awaited: Awaited, at_most: Option<Duration>) -> Result<(), ProcessError> {
        self.polls += 1;
        // A coordinator has just been woken, likely on this core: spinning would only keep it from it.
        let gives_way = awaited.role == Role::Coordinator;
        let is_time = match self.advice {
            None => !self.patience.manner.begins_spinning(gives_way),
            Some(Advice::Spin) => false,
            Some(Advice::Yield) => self.polls.is_multiple_of(self.patience.manner.yields_per_look()),
            Some(Advice::Sleep) => true,
        };
        if is_time || self.polls.is_multiple_of(POLLS_PER_LOOK) {
            let now = self.look(awaited)?;
            let waited = self.waited;
            self.advice = Some(match &mut self.patience.manner {
                Manner::Fixed { spin, busy } => {
                    let gives_way = gives_way && *spin < *busy;
                    match waited {
                        waited if waited < *spin && !gives_way => Advice::Spin,
                        waited if waited < *busy => Advice::Yield,
                        _ => Advice::Sleep,
                    }
                }
                Manner::Learned(policy, hot_processes) => {
                    let (hot_processes, was_crowded) = (*hot_processes, policy.is_crowded());
                    let awake = || self.others.iter().filter(|rope| !rope.is_asleep()).count();
                    let cores = || {
                        // One that has fallen asleep or was woken in the meantime was not counted as running, perhaps.
                        let (before, runnable) = (awake(), runnable());
                        let own_awake = awake().min(before);
                        let are_full =
                            runnable.map(|all| are_full(all, own_awake, hot_processes, cores_online()));
                        Cores { idle_ns: idle_ns(), are_full }
                    };
                    let advice = policy.look(now, gives_way, cores);
                    if policy.is_crowded() != was_crowded {
                        trace::note(|| {
                            let wanted = if was_crowded { "cores are free" } else { "others want the cores" };
                            wanted.to_owned()
                        });
                    }
                    advice
                }
            });
        }
        match self.advice {
            None | Some(Advice::Spin) => std::hint::spin_loop(),
            Some(Advice::Yield) => std::thread::yield_now(),
            Some(Advice::Sleep) => self.sleep(at_most),
        }
        Ok(())
    }

    fn sleep(&mut self, at_most: Option<Duration>) {
        let bound = |nap: Duration| at_most.map_or(nap, |at_most| nap.min(at_most));
        let Some(bell) = &self.bell else {
            // Nobody ends a long sleep.
            std::thread::sleep(bound(NAP));
            return;
        };
        if !self.lies_down {
            if let Some(core) = self.given.take() {
                // It has done what it was woken for.
                go_to(core);
            }
            // What came before it did has been looked for in vain once more when this is called again.
            self.lies_down = true;
            bell.lie_down();
            return;
        }
        self.lies_down = false;
        let ring = bell.sleep(bound(BELL_NAP));
        if let Manner::Learned(policy, _) = &mut self.patience.manner {
            policy.slept(monotonic_ns(), ring.map(|ring| ring.at_ns));
        }
        let core = ring.and_then(|ring| ring.core).filter(|core| sched_getcpu() != *core);
        if core.is_some() && self.patience.follows && self.may_move() {
            self.given = core;
        }
    }

    /// Whether it has not been to another core for some time.
    fn may_move(&mut self) -> bool {
        let now = monotonic_ns();
        let may = now.saturating_sub(self.moved_ns) >= MOVE_EVERY_NS;
        if may {
            self.moved_ns = now;
        }
        may
    }

    /// Looks at the signals, the clock and the peers; returns what the clock says, ns.
    fn look(&mut self, awaited: Awaited) -> Result<u64, ProcessError> {
        if self.stop.is_set() {
            return Err(ProcessError::Interrupted { step: Some(awaited.step) });
        }
        if let Some(breather) = &mut self.breather {
            breather.breathe();
        }
        let now = monotonic_ns();
        let last = self.since.replace(now).unwrap_or(now);
        self.waited += Duration::from_nanos(now.saturating_sub(last)).min(LONGEST_PAUSE);
        let timeout = self.first.unwrap_or(self.patience.timeout);
        if self.waited >= timeout {
            let awaited = awaited.named(&self.names);
            return Err(ProcessError::Timeout { awaited, seconds: timeout.as_secs_f64() });
        }
        if self.waited >= self.peers_checked + PEER_CHECK {
            self.peers_checked = self.waited;
            if let Some(peer) = self.peers.first_gone() {
                let consequence = format!("this one was waiting for {}", awaited.named(&self.names));
                let name = peer.name(&self.names);
                return Err(ProcessError::PeerGone { peer, name, consequence });
            }
        }
        Ok(now)
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
                Progress::Waiting(awaited) => {
                    trace::begin(Phase::Wait, awaited.step);
                    // About to give its core away: now they are woken at the least cost.
                    if self.polls == 0 && awaited.role == Role::Coordinator {
                        match self.patience.manner.is_crowded() {
                            // There they wait for others' turns on whatever core they go to.
                            true => self.wake(awaited.missing),
                            false => self.give_way_to(awaited.missing),
                        }
                    }
                    self.wait(awaited, None)?;
                }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cores_are_full_when_others_and_the_busy_of_this_run_are_more_than_there_are() {
        // World and controller on two cores; both run, and a coordinator.
        assert!(!are_full(3, 2, 2, 2));
        assert!(!are_full(1, 0, 2, 2));
        // One of somebody else's, while the controller sleeps or not.
        assert!(are_full(2, 0, 2, 2));
        assert!(are_full(3, 1, 2, 2));
        // There is a core for it.
        assert!(!are_full(3, 1, 2, 4));
        // Alone, however many wait busily.
        assert!(!are_full(9, 8, 5, 2));
        // Asleep by now, who was counted as running.
        assert!(!are_full(1, 3, 2, 2));
    }
}
