//! Whether a process that waits for a frame spins, yields or sleeps, learned from how its waits have gone.
//!
//! Spinning gets a frame at once and keeps a core; sleeping gives the core away and costs a wake-up. Alone on its
//! core a waiter may poll for as long as it likes; it yields now and then, and if a yield takes a while, the peer
//! it waits for was on this very core: it is to go to its own core, and sleeps once, for who is woken goes to a free
//! one; but not with every kernel that has few of them.
//!
//! On a *crowded* core, where processes of others want to run, it spins for as long as being woken takes and then
//! sleeps: that costs at most twice what knowing the future would (the ski-rental rule), and two processes that
//! exchange frames come to run at the same time, each woken by the other's return. Where spinning is in vain, the
//! waiter sleeps at once for some waits, more each time; where it pays, for fewer.
//!
//! A core is crowded when a spinning waiter finds a hole in its own time, or a yield takes as long as others'
//! turns do, and more processes want to run than there is room for: one such turn costs as much as a thousand steps. A
//! hole while nobody wants to run is the system's, or that of the machine this one is a guest of, and says nothing of the
//! next step. At first it is crowded when more want to run than there is room for: that may be a program that is just
//! ending, so it is asked again soon, and after ever longer. Once that has gone on for long the cores must have
//! had idle time, which they have among waiters that sleep, and have not beside work that never ends. Where this run
//! alone has more processes that wait busily than there are cores, their number only says that there is no crowd, when no
//! others are among them; turns and idle time say that there is.
//!
//! Times are nanoseconds on one clock, and are given; so the policy can be tested without waiting.

mod crowd;

pub(super) use crowd::Cores;
use crowd::Crowd;

/// What a waiter does until it looks again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Advice {
    /// Poll on.
    Spin,
    /// Let others run and poll on.
    Yield,
    /// Sleep until rung.
    Sleep,
}

/// What is known of a waiter's situation from the start.
#[derive(Clone, Copy, Debug)]
pub(super) struct Situation {
    /// There are fewer cores than processes that wait like this one: a peer may need this very core.
    pub shares_cores: bool,
    /// Yielding lets run whoever wants to; under real-time scheduling it does not.
    pub may_yield: bool,
}

/// Learns how to wait.
#[derive(Debug)]
pub(super) struct WaitPolicy {
    situation: Situation,
    /// What being woken costs, smoothed.
    wake_cost_ns: u64,
    crowd: Crowd,
    /// Times in a row that polling on a free core did not bring the frame.
    in_vain: u32,
    /// Waits from here on in which sleep comes at once.
    sleeps_left: u32,
    /// How many there will be the next time spinning turns out to be in vain.
    sleeps: u32,
    wait: Option<Wait>,
}

/// The present wait.
#[derive(Clone, Copy, Debug)]
struct Wait {
    since: u64,
    last_look: u64,
    last: Advice,
    /// It is for a process that has just been woken, perhaps on this core.
    gives_way: bool,
    /// It began with sleep.
    slept_at_once: bool,
    slept: bool,
    /// The frame came later than spinning would have waited for it.
    came_late: bool,
}

const US: u64 = 1_000;
const MS: u64 = 1_000_000;

/// A frame that comes later than this is waited for by yielding, on a core of one's own.
const SPIN: u64 = 20 * US;
/// The same where a yield lets nobody run.
const SPIN_ALONE: u64 = 200 * US;
/// A frame that comes later than this is slept for.
const BUSY: u64 = 2 * MS;
/// A hole of this length in a spinning waiter's time is somebody else's turn. Brief work of the system, or of
/// a peer that was woken here, takes less.
const HOLE: u64 = 100 * US;
/// A yield that takes this long has let a peer run, or the system.
const SHARED: u64 = 10 * US;
/// A yield that takes this long has let somebody run who is not of this run.
const TURN: u64 = 500 * US;
/// What being woken is first taken to cost, and the bounds within which it is believed.
const WAKE_COST: u64 = 20 * US;
const LEAST_WAKE_COST: u64 = 4 * US;
const GREATEST_WAKE_COST: u64 = 100 * US;
/// Polling in vain so many times in a row on a free core makes sleep come at once.
const IN_VAIN: u32 = 3;
/// For so many waits at most.
const MOST_SLEEPS: u32 = 128;

impl WaitPolicy {
    pub(super) fn new(situation: Situation) -> WaitPolicy {
        WaitPolicy {
            situation,
            wake_cost_ns: WAKE_COST,
            crowd: Crowd::new(!situation.shares_cores),
            in_vain: 0,
            sleeps_left: 0,
            sleeps: 1,
            wait: None,
        }
    }

    /// Whether others are taken to want the cores.
    pub(super) fn is_crowded(&self) -> bool {
        self.crowd.is_there
    }

    /// Whether peers are expected to run when this process yields.
    pub(super) fn expects_company(&self) -> bool {
        self.situation.shares_cores
    }

    /// Whether a wait that begins now begins with spinning.
    pub(super) fn begins_spinning(&self, gives_way: bool) -> bool {
        !gives_way && !self.situation.shares_cores && self.sleeps_left == 0
    }

    /// The waiter looks up: what now? `gives_way` when it waits for a process that has just been woken, perhaps
    /// on this core; `cores` asks the machine.
    pub(super) fn look(&mut self, now: u64, gives_way: bool, cores: impl Fn() -> Cores) -> Advice {
        let mut wait = self.wait.unwrap_or(Wait {
            since: now,
            last_look: now,
            last: Advice::Spin,
            gives_way,
            slept_at_once: self.sleeps_left > 0,
            slept: false,
            came_late: false,
        });
        let away = now.saturating_sub(wait.last_look);
        let longest = match wait.last {
            Advice::Spin => HOLE,
            Advice::Yield => TURN,
            Advice::Sleep => u64::MAX,
        };
        let was_turn = away > longest && self.crowd.is_seen(now, &cores);
        if wait.last == Advice::Yield && away > SHARED && !was_turn && !self.needs_core(wait.gives_way) {
            wait.slept = true;
        }
        let is_crowded = self.crowd.is_there(now, &cores);
        let advice = self.advise(&mut wait, now, gives_way, is_crowded);
        self.wait = Some(Wait { last: advice, last_look: now, ..wait });
        advice
    }

    fn advise(&mut self, wait: &mut Wait, now: u64, gives_way: bool, is_crowded: bool) -> Advice {
        if wait.slept_at_once || wait.slept {
            return Advice::Sleep;
        }
        let waited = now - wait.since;
        let (spin, busy) = match (is_crowded, self.situation.may_yield) {
            (true, _) if self.needs_core(gives_way) => (0, 0),
            (true, _) => (self.wake_cost_ns, self.wake_cost_ns),
            (false, true) => (if self.needs_core(gives_way) { 0 } else { SPIN }, BUSY),
            (false, false) => (SPIN_ALONE, SPIN_ALONE),
        };
        if waited < spin {
            return Advice::Spin;
        }
        if waited < busy {
            return Advice::Yield;
        }
        if busy > 0 {
            self.in_vain += 1;
            if is_crowded || self.in_vain >= IN_VAIN {
                self.sleeps_left = self.sleeps;
                self.sleeps = (2 * self.sleeps).min(MOST_SLEEPS);
            }
        }
        Advice::Sleep
    }

    /// Whether whoever is waited for may need this core.
    fn needs_core(&self, gives_way: bool) -> bool {
        gives_way || self.situation.shares_cores
    }

    /// The waiter has slept, and was woken at `now`, at `rung_at` or without having been rung.
    pub(super) fn slept(&mut self, now: u64, rung_at: Option<u64>) {
        let Some(wait) = &mut self.wait else { return };
        wait.slept = true;
        // Somebody else may have written it.
        let rung_at = rung_at.filter(|at| (wait.since..=now).contains(at));
        if let Some(rung_at) = rung_at {
            let cost = (now - rung_at).clamp(LEAST_WAKE_COST, GREATEST_WAKE_COST);
            // Down fast and up slowly: a wake-up that others' turns have delayed says nothing of its cost.
            let known = self.wake_cost_ns;
            self.wake_cost_ns = if cost < known {
                known - (known - cost) / 4
            } else {
                known + (cost - known).min(known) / 16
            };
        }
        let waited = rung_at.unwrap_or(now) - wait.since;
        wait.came_late = waited > if self.crowd.is_there { self.wake_cost_ns } else { BUSY };
    }

    /// The frame has come, after polling for it at least once; returns whether from this very core, where it was not
    /// expected. `now` is asked for the time where it matters.
    pub(super) fn came(&mut self, now: impl FnOnce() -> u64) -> bool {
        let Some(wait) = self.wait.take() else {
            self.polling_paid();
            return false;
        };
        if wait.slept_at_once {
            // While frames come late there is nothing to be tried.
            if !wait.came_late || self.sleeps_left > 1 {
                self.sleeps_left -= 1;
            }
        } else if !wait.slept {
            self.polling_paid();
            let yielded = wait.last == Advice::Yield && !self.needs_core(wait.gives_way);
            let was_here = yielded && now() - wait.last_look > SHARED;
            // The next wait begins with sleep, and ends on a free core.
            self.sleeps_left = u32::from(was_here);
            return was_here;
        }
        false
    }

    fn polling_paid(&mut self) {
        self.in_vain = 0;
        self.sleeps = (self.sleeps / 2).max(1);
    }
}

#[cfg(test)]
mod tests {
    use super::crowd::{GREATEST_HOLD, LEAST_HOLD};
    use super::*;

    const ALONE: Situation = Situation { shares_cores: false, may_yield: true };

    /// A waiter with a clock of its own, on a machine that is as busy as is said.
    struct Scene {
        policy: WaitPolicy,
        now: u64,
        is_busy: bool,
        wake_ns: u64,
        /// The frame of the last wait came from this core.
        was_here: bool,
    }

    /// What a wait cost: time spent polling, and wake-ups.
    #[derive(Debug, Default, PartialEq)]
    struct Cost {
        polled_ns: u64,
        sleeps: u32,
        yields: u32,
    }

    impl Scene {
        fn new(situation: Situation, is_busy: bool) -> Scene {
            let policy = WaitPolicy::new(situation);
            // Not at the clock's origin, where no machine ever is.
            Scene { policy, now: 3_600_000 * MS, is_busy, wake_ns: 10 * US, was_here: false }
        }

        fn look(&mut self, gives_way: bool) -> Advice {
            // A core is idle for half of the time, or never.
            let idle_ns = if self.is_busy { 0 } else { self.now / 2 };
            self.policy.look(self.now, gives_way, || Cores { idle_ns, are_full: Some(self.is_busy) })
        }

        /// A wait for a frame that comes after `ns`; polls are 1 us apart, yields take as long as `turn`.
        fn wait(&mut self, ns: u64, gives_way: bool, turn: u64) -> Cost {
            let due = self.now + ns;
            let mut cost = Cost::default();
            while self.now < due {
                let begun = self.now;
                match self.look(gives_way) {
                    Advice::Spin => self.now += US,
                    Advice::Yield => {
                        self.now += turn;
                        cost.yields += 1;
                    }
                    Advice::Sleep => {
                        self.now = due + self.wake_ns;
                        cost.sleeps += 1;
                        self.policy.slept(self.now, Some(due));
                        break;
                    }
                }
                cost.polled_ns += self.now - begun;
            }
            let now = self.now;
            self.was_here = self.policy.came(|| now);
            cost
        }

        /// The waiter loses its core for so long while it spins, to one who wants it again.
        fn is_preempted(&mut self, ns: u64) {
            assert_eq!(self.look(false), Advice::Spin);
            self.now += ns;
            let is_busy = std::mem::replace(&mut self.is_busy, true);
            self.look(false);
            self.is_busy = is_busy;
            let now = self.now;
            self.policy.came(|| now);
        }
    }

    #[test]
    fn alone_it_polls_and_only_sleeps_for_what_takes_long() {
        let mut scene = Scene::new(ALONE, false);
        for ns in [2 * US, 15 * US] {
            assert_eq!(scene.wait(ns, false, US), Cost { polled_ns: ns, ..Cost::default() });
        }
        let cost = scene.wait(1_500 * US, false, US);
        assert_eq!((cost.sleeps, cost.polled_ns), (0, 1_500 * US));
        let cost = scene.wait(30 * MS, false, US);
        assert_eq!((cost.sleeps, cost.polled_ns), (1, BUSY));
    }

    #[test]
    fn frames_that_always_take_long_are_slept_for_at_once_until_one_comes_early() {
        let mut scene = Scene::new(ALONE, false);
        for _ in 0..IN_VAIN {
            assert_eq!(scene.wait(10 * MS, false, US).polled_ns, BUSY);
        }
        for _ in 0..1_000 {
            assert_eq!(scene.wait(10 * MS, false, US), Cost { sleeps: 1, ..Cost::default() });
        }
        assert_eq!(scene.wait(100 * US, false, US).sleeps, 1);
        assert_eq!(scene.wait(100 * US, false, US).sleeps, 0, "it has come early, so polling is tried again");
    }

    #[test]
    fn a_hole_in_its_time_makes_it_sleep_after_as_long_as_waking_takes() {
        let mut scene = Scene::new(ALONE, false);
        scene.is_preempted(3 * MS);
        scene.is_busy = true;
        let first = scene.wait(MS, false, US);
        assert_eq!((first.polled_ns, first.sleeps, first.yields), (WAKE_COST, 1, 0));
        // What waking costs is learned, down fast.
        scene.wake_ns = 6 * US;
        (0..40).for_each(|_| {
            scene.wait(US, false, US);
            scene.wait(MS, false, US);
        });
        assert!((5 * US..8 * US).contains(&scene.policy.wake_cost_ns), "{:?}", scene.policy);
        // And not from a wake-up that others' turns have held up.
        scene.wake_ns = 6 * MS;
        scene.wait(MS, false, US);
        assert!(scene.policy.wake_cost_ns < 8 * US, "{:?}", scene.policy);
    }

    #[test]
    fn in_a_crowd_it_costs_little_more_than_the_better_of_spinning_and_sleeping() {
        let mut random = 1_u64;
        for early_of_100 in [0, 10, 50, 90, 100] {
            let mut scene = Scene::new(ALONE, true);
            let (mut ours, mut spinning, mut sleeping) = (0, 0, 0);
            for _ in 0..20_000 {
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                let ns = if (random >> 33) % 100 < early_of_100 { 2 * US } else { 200 * US };
                let cost = scene.wait(ns, false, US);
                assert_eq!(cost.yields, 0);
                ours += cost.polled_ns + u64::from(cost.sleeps) * scene.wake_ns;
                spinning += ns;
                sleeping += scene.wake_ns;
            }
            let best = spinning.min(sleeping);
            // Half and half is the worst case: nothing is to be learned.
            let most = if [0, 100].contains(&early_of_100) { 1.1 } else { 1.6 };
            assert!(ours as f64 <= most * best as f64, "{early_of_100}: {ours} against {best}");
        }
    }

    #[test]
    fn a_crowd_is_gone_once_nobody_wants_to_run_and_lasts_longer_when_it_comes_back() {
        let mut scene = Scene::new(ALONE, false);
        scene.is_preempted(3 * MS);
        assert_eq!(scene.wait(100 * US, true, US).sleeps, 1, "it is crowded");
        let mut holds = Vec::new();
        for _ in 0..12 {
            let seen = scene.policy.crowd.until - scene.policy.crowd.hold_ns;
            while scene.wait(100 * US, true, US).sleeps > 0 {}
            holds.push(scene.now - seen);
            scene.is_preempted(3 * MS);
        }
        assert!(holds[0] < 2 * LEAST_HOLD && holds.windows(2).all(|h| h[1] + MS > h[0]), "{holds:?}");
        assert!((GREATEST_HOLD..GREATEST_HOLD + 10 * MS).contains(&holds[11]), "{holds:?}");
        // While no core has idle time, it is not tried at all.
        scene.is_busy = true;
        let until = scene.now + 10 * GREATEST_HOLD;
        while scene.now < until {
            assert_eq!(scene.wait(MS, true, US).yields, 0);
        }
    }

    #[test]
    fn a_hole_while_nobody_else_wants_to_run_is_no_crowd() {
        let mut scene = Scene::new(ALONE, false);
        assert_eq!(scene.look(false), Advice::Spin);
        scene.now += MS;
        assert_eq!(scene.look(false), Advice::Yield, "it has waited for long, on a core of its own");
        let now = scene.now;
        scene.policy.came(|| now);
        // Such a yield took long because somebody ran in it, and it was no turn of others.
        assert_eq!(scene.wait(MS, false, 600 * US).sleeps, 1);
        scene.wait(US, false, US);
        assert_eq!(scene.wait(100 * US, true, US).sleeps, 0);
    }

    #[test]
    fn who_finds_the_cores_full_at_first_asks_again_soon_and_then_after_ever_longer() {
        let mut scene = Scene::new(ALONE, true);
        assert_eq!(scene.wait(100 * US, true, US).sleeps, 1);
        scene.is_busy = false;
        let begun = scene.now;
        while scene.wait(100 * US, true, US).sleeps > 0 {}
        assert!(scene.now - begun < 2 * LEAST_HOLD, "{:?}", scene.policy);

        let mut scene = Scene::new(ALONE, true);
        let until = scene.now + 400 * MS;
        let mut asked = std::collections::BTreeSet::new();
        while scene.now < until {
            scene.wait(100 * US, true, US);
            asked.insert(scene.policy.crowd.asked);
        }
        assert!((8..14).contains(&asked.len()), "{asked:?}");
    }

    #[test]
    fn where_the_system_does_not_tell_who_wants_to_run_holes_and_idle_time_say_it() {
        let mut policy = WaitPolicy::new(ALONE);
        let idle_ns = std::cell::Cell::new(0);
        let mut look = |now| policy.look(now, true, || Cores { idle_ns: idle_ns.get(), are_full: None });
        assert_eq!(look(3_600_000 * MS), Advice::Yield);
        assert_eq!(look(3_600_001 * MS), Advice::Sleep, "a turn of others");
        assert_eq!(look(3_600_150 * MS), Advice::Sleep, "no core has been idle");
        idle_ns.set(100 * MS);
        policy.came(|| 3_600_160 * MS);
        let cores = || Cores { idle_ns: 100 * MS, are_full: None };
        assert_eq!(policy.look(3_600_260 * MS, true, cores), Advice::Yield);
    }

    #[test]
    fn who_shares_a_core_with_its_peer_sleeps_once_so_as_to_be_woken_on_another() {
        let mut scene = Scene::new(ALONE, false);
        scene.wait(US, false, US);
        // The peer runs in the yield, and answers.
        assert_eq!(scene.wait(SPIN + US, false, 40 * US).yields, 1);
        assert!(scene.was_here);
        assert_eq!(scene.wait(SPIN + US, false, 40 * US).sleeps, 1);
        assert!(!scene.was_here);
        assert_eq!(scene.wait(US, false, US), Cost { polled_ns: US, ..Cost::default() });
        // It runs in the yield, and has not answered yet.
        let cost = scene.wait(MS, false, 40 * US);
        assert_eq!((cost.yields, cost.sleeps), (1, 1));
        assert_eq!(scene.wait(2 * US, false, US).sleeps, 0);
        // A coordinator that was woken here is expected to run here.
        let cost = scene.wait(80 * US, true, 40 * US);
        assert_eq!((cost.yields, cost.sleeps), (2, 0));
    }

    #[test]
    fn with_fewer_cores_than_pollers_it_yields_at_once_and_in_a_crowd_sleeps_at_once() {
        let shared = Situation { shares_cores: true, ..ALONE };
        let mut scene = Scene::new(shared, false);
        assert!(!scene.policy.begins_spinning(false));
        assert_eq!(scene.wait(50 * US, false, 10 * US), Cost { polled_ns: 50 * US, yields: 5, sleeps: 0 });
        // A peer's turn, which nobody else wanted.
        scene.wait(4 * MS, false, 3 * MS);
        assert_eq!(scene.wait(50 * US, false, 10 * US).sleeps, 0);
        // Somebody else's.
        scene.is_busy = true;
        scene.wait(4 * MS, false, 3 * MS);
        assert_eq!(scene.wait(50 * US, false, 10 * US), Cost { sleeps: 1, ..Cost::default() });
    }

    #[test]
    fn with_fewer_cores_than_pollers_no_crowd_lasts_once_nobody_else_wants_to_run() {
        let mut policy = WaitPolicy::new(Situation { shares_cores: true, ..ALONE });
        // Its peers keep all cores from being idle.
        let cores = |are_full| move || Cores { idle_ns: 0, are_full: Some(are_full) };
        // When it begins, others of its run are not counted for such yet.
        let begun = 3_600_000 * MS;
        assert_eq!(policy.look(begun, false, cores(true)), Advice::Sleep);
        policy.came(|| begun + 2 * MS);
        assert_eq!(policy.look(begun + 2 * MS, false, cores(true)), Advice::Sleep, "they want to run still");
        policy.came(|| begun + 6 * MS);
        assert_eq!(policy.look(begun + 6 * MS, false, cores(false)), Advice::Yield);
    }

    #[test]
    fn where_yielding_lets_nobody_run_it_never_yields() {
        let mut scene = Scene::new(Situation { may_yield: false, ..ALONE }, false);
        for gives_way in [false, true] {
            let cost = scene.wait(MS, gives_way, US);
            assert_eq!((cost.polled_ns, cost.yields, cost.sleeps), (SPIN_ALONE, 0, 1));
        }
    }

    #[test]
    fn instants_that_cannot_be_are_not_believed() {
        for rung_at in [Some(0), Some(u64::MAX), None] {
            let mut scene = Scene::new(ALONE, true);
            let mut looks = 0;
            while scene.look(false) != Advice::Sleep {
                scene.now += US;
                looks += 1;
            }
            assert!(looks > 0);
            let before = scene.policy.wake_cost_ns;
            scene.policy.slept(scene.now + MS, rung_at);
            assert_eq!(scene.policy.wake_cost_ns, before);
        }
    }
}
