//! Whether processes of others want a core, from what its waiter sees of turns, numbers and idle time.

use super::MS;

/// How long a core is taken for crowded after it was seen to be, at least and at most.
pub(super) const LEAST_HOLD: u64 = MS;
pub(super) const GREATEST_HOLD: u64 = 2_000 * MS;
/// After this long idle time says whether it still is; it is told in units of 10 ms.
const IDLE_HOLD: u64 = 100 * MS;
/// A crowd that is back within this time, and four times as long as it was taken to be there, is here to stay.
const BACK: u64 = 50 * MS;
/// The cores are free when together they have been idle for more than the time that has passed, by this.
const IDLE_SHARE: u64 = 8;

/// What the machine tells of the cores that the waiter may use.
#[derive(Clone, Copy, Debug)]
pub(in crate::process) struct Cores {
    /// How long they have been idle so far, in all.
    pub idle_ns: u64,
    /// More processes want to run than there are cores, and this run may want; `None` where the system does not tell.
    pub are_full: Option<bool>,
}

/// Whether others want this core.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crowd {
    pub(super) until: u64,
    pub(super) hold_ns: u64,
    pub(super) is_there: bool,
    /// When the idle time of the cores was asked for last, and what it was.
    pub(super) asked: Option<u64>,
    idle_ns: u64,
    /// How many processes want to run says whether others do; otherwise only that they do not.
    numbers_tell: bool,
}

impl Crowd {
    /// Nothing is known yet; `numbers_tell` how many processes want to run says whether others do.
    pub(super) fn new(numbers_tell: bool) -> Crowd {
        Crowd { until: 0, hold_ns: LEAST_HOLD, is_there: false, asked: None, idle_ns: 0, numbers_tell }
    }

    /// Somebody had the core for as long as others' turns take: whether it is one who will want it again.
    pub(super) fn is_seen(&mut self, now: u64, cores: impl Fn() -> Cores) -> bool {
        if self.is_there {
            self.until = now + self.hold_ns;
            return true;
        }
        let cores = cores();
        if cores.are_full == Some(false) {
            return false;
        }
        let is_known = self.numbers_tell && cores.are_full.is_some();
        let least = if is_known { LEAST_HOLD } else { IDLE_HOLD };
        let is_back = self.until > 0 && now < self.until + 4 * self.hold_ns + BACK;
        self.hold_ns = if is_back { (2 * self.hold_ns).min(GREATEST_HOLD) } else { least };
        self.is_there_since(now, &cores);
        true
    }

    fn is_there_since(&mut self, now: u64, cores: &Cores) {
        (self.asked, self.idle_ns, self.is_there) = (Some(now), cores.idle_ns, true);
        self.until = now + self.hold_ns;
    }

    pub(super) fn is_there(&mut self, now: u64, cores: impl Fn() -> Cores) -> bool {
        let Some(asked) = self.asked else {
            // Nothing is known yet: whoever spins from the beginning loses turns before it learns better.
            let cores = cores();
            self.asked = Some(now);
            if cores.are_full == Some(true) {
                self.is_there_since(now, &cores);
            }
            return self.is_there;
        };
        if self.is_there && now >= self.until {
            let cores = cores();
            self.is_there = match cores.are_full {
                // That nobody else wants to run is believed in any case.
                Some(are_full) if self.hold_ns < IDLE_HOLD && (self.numbers_tell || !are_full) => are_full,
                _ => cores.idle_ns.saturating_sub(self.idle_ns) < (now - asked) / IDLE_SHARE,
            };
            if self.is_there {
                self.hold_ns = self.hold_ns.max((2 * self.hold_ns).min(IDLE_HOLD));
                self.is_there_since(now, &cores);
            }
        }
        self.is_there
    }
}
