//! Time in which this process ran. Bounds of waits count it, so that a machine that slept, or a whole run that
//! was stopped and goes on, has used up nobody's patience.

use std::time::{Duration, Instant};

/// The longest pause between two looks that counts in full, where whoever looks says nothing else.
pub(crate) const LONGEST_PAUSE: Duration = Duration::from_millis(250);

/// A clock that stands still while its process does not run: it must be looked at, and counts no more of the time
/// between two looks than a running process could have let pass.
#[derive(Clone, Copy, Debug)]
pub struct OwnTime {
    counted: Duration,
    last: Instant,
}

impl OwnTime {
    /// Starts at zero.
    pub fn start() -> OwnTime {
        OwnTime { counted: Duration::ZERO, last: Instant::now() }
    }

    /// The time counted; of what has passed since the last look at most `longest` is.
    pub fn look(&mut self, longest: Duration) -> Duration {
        self.look_at(Instant::now(), longest)
    }

    fn look_at(&mut self, now: Instant, longest: Duration) -> Duration {
        self.counted += now.saturating_duration_since(self.last).min(longest);
        self.last = now;
        self.counted
    }
}

/// A wait that may not take longer than that.
#[derive(Clone, Copy, Debug)]
pub struct Bound {
    time: OwnTime,
    limit: Duration,
}

impl Bound {
    /// A wait that begins now. Whoever waits looks several times within 250 ms.
    pub fn of(limit: Duration) -> Bound {
        Bound { time: OwnTime::start(), limit }
    }

    /// Whether it has taken too long.
    pub fn is_over(&mut self) -> bool {
        self.time.look(LONGEST_PAUSE) >= self.limit
    }

    /// The limit, s.
    pub fn seconds(&self) -> f64 {
        self.limit.as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pause_in_which_the_process_did_not_run_is_not_counted() {
        let mut time = OwnTime::start();
        let start = time.last;
        let after = |seconds| start + Duration::from_secs(seconds);
        assert_eq!(time.look_at(after(1), Duration::from_secs(2)), Duration::from_secs(1));
        // Stopped for an hour.
        assert_eq!(time.look_at(after(3601), Duration::from_secs(2)), Duration::from_secs(3));
        assert_eq!(time.look_at(after(3602), Duration::from_secs(2)), Duration::from_secs(4));
        // A clock never goes back.
        assert_eq!(time.look_at(after(3600), Duration::from_secs(2)), Duration::from_secs(4));
    }
}
