//! Steps at their instants, and what becomes of those that are not done in time.

use super::viewing::Steering;
use super::{Percentiles, new_histogram};
use crate::lockstep::Awaited;
use crate::scenario::ControllerNames;
use hdrhistogram::Histogram;
use ipc_schemas::{Role, VERDICT_FALLBACK, VERDICT_HELD};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

/// When steps begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Pace {
    /// Each as soon as the one before is done.
    #[default]
    Free,
    /// Step k at k times the step length after the first.
    Realtime,
}

/// What the world does about a controller that has not answered by the deadline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnMiss {
    /// It waits, and makes up for lost time afterwards.
    #[default]
    Wait,
    /// It goes on; the vehicles hold their accelerations.
    Hold,
    /// It goes on; the vehicles hold their accelerations as far as the shield allows.
    ShieldFallback,
    /// It ends the run.
    Abort,
}

impl OnMiss {
    /// The verdict of commands put in, where the world goes on.
    pub(super) fn verdict(self) -> Option<u16> {
        match self {
            OnMiss::Wait | OnMiss::Abort => None,
            OnMiss::Hold => Some(VERDICT_HELD),
            OnMiss::ShieldFallback => Some(VERDICT_FALLBACK),
        }
    }
}

/// When steps begin, by when they are to be done, and what happens otherwise.
#[derive(Clone, Copy, Debug, Default)]
pub struct Timing {
    /// When steps begin.
    pub pace: Pace,
    /// Time from a step's beginning, on time, to its deadline; by default the step length when paced, and none
    /// otherwise. A step that begins late has at least half of it.
    pub deadline: Option<Duration>,
    /// What happens when a deadline is missed.
    pub on_miss: OnMiss,
}

/// How punctual a run was.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Punctuality {
    /// Whether steps began at scheduled instants.
    pub paced: bool,
    /// From a step's beginning to its deadline, us.
    pub deadline_us: f64,
    /// What happened when a deadline was missed.
    pub on_miss: OnMiss,
    /// Steps that were not done by their deadlines.
    pub missed_steps: u64,
    /// Of these, steps that only began after their deadlines, because those before them took too long.
    pub began_late: u64,
    /// Who had not answered by the deadline, and in how many steps; those that began late have one too.
    pub missed_by: Vec<MissedBy>,
    /// How long after its scheduled instant each step's state was published, ns; all 0 in a free run.
    pub lateness_ns: Percentiles,
}

/// The missed deadlines of one participant.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissedBy {
    /// Role and index.
    pub participant: String,
    /// Steps.
    pub steps: u64,
}

/// Keeps a run's schedule.
#[derive(Debug)]
pub(super) struct Pacer {
    timing: Timing,
    /// Wall time of a step.
    step_length: Duration,
    /// Simulated time of one.
    dt: Duration,
    /// Nobody begins a step, but for those that are granted.
    is_paused: bool,
    granted: u32,
    /// Scheduled beginning of the first step, and its number.
    origin: Option<(Instant, u64)>,
    deadline: Option<Instant>,
    /// The present step began after the deadline it would have had on time.
    began_late: bool,
    missed_steps: u64,
    missed_by: Vec<(Role, u32, u64)>,
    /// Missed steps that began after their deadlines.
    backlog: u64,
    /// Controllers, one bit each, while which are waited for no clock goes on.
    unhurried: u64,
    lateness_ns: Histogram<u64>,
}

/// The last stretch before an instant is spent polling the clock: a sleep may take this much longer.
const LAST_STRETCH: Duration = Duration::from_micros(200);
/// Time between two looks in a pause for somebody who steers.
const PAUSE_LOOK: Duration = Duration::from_millis(5);
/// Paces that may be asked for, times real time.
const PACES: std::ops::RangeInclusive<f64> = 0.001..=1000.0;

impl Pacer {
    pub fn new(timing: Timing, dt_ns: u64) -> Pacer {
        Pacer {
            timing,
            step_length: Duration::from_nanos(dt_ns),
            dt: Duration::from_nanos(dt_ns),
            is_paused: false,
            granted: 0,
            origin: None,
            deadline: None,
            began_late: false,
            missed_steps: 0,
            missed_by: Vec::new(),
            backlog: 0,
            unhurried: 0,
            lateness_ns: new_histogram(),
        }
    }

    /// Keeps no schedule while it is waited for these controllers, one bit each.
    pub fn unhurried_by(self, controllers: u64) -> Pacer {
        Pacer { unhurried: controllers, ..self }
    }

    /// What happens when a deadline is missed.
    pub fn on_miss(&self) -> OnMiss {
        self.timing.on_miss
    }

    /// How long may be slept before a step is due; nothing in the last stretch, in which the clock is to be
    /// polled. `None` once it is due.
    pub fn until(&mut self, step: u64) -> Option<Duration> {
        if self.is_paused && self.granted == 0 {
            return Some(PAUSE_LOOK);
        }
        if self.is_paused {
            return None;
        }
        if self.timing.pace == Pace::Free {
            return None;
        }
        let due = self.due(step);
        let left = due.saturating_duration_since(Instant::now());
        (!left.is_zero()).then(|| left.saturating_sub(LAST_STRETCH))
    }

    fn due(&mut self, step: u64) -> Instant {
        let (start, first) = *self.origin.get_or_insert_with(|| (Instant::now(), step));
        let steps = step - first;
        start + Duration::from_nanos(self.step_length.as_nanos() as u64 * steps)
    }

    /// A step begins now.
    pub fn begin(&mut self, step: u64) {
        if self.is_paused {
            self.granted = self.granted.saturating_sub(1);
            // The schedule begins anew when the run goes on.
            self.origin = None;
        }
        if self.timing.pace == Pace::Free && self.timing.deadline.is_none() {
            return;
        }
        let now = Instant::now();
        let start = if self.timing.pace == Pace::Free { now } else { self.due(step) };
        // Only an absurd lateness could not be recorded.
        let _ = self.lateness_ns.record(now.saturating_duration_since(start).as_nanos() as u64);
        let allowed = self.timing.deadline.unwrap_or(self.step_length);
        self.began_late = now >= start + allowed;
        // Half of it is left to every step: late ones wait for nobody without end, and make up for lost time.
        self.deadline = Some((start + allowed).max(now + allowed / 2));
        if self.began_late {
            // Whoever held up the steps before has been counted there.
            self.missed_steps += 1;
            self.backlog += 1;
        }
    }

    /// Does what somebody who steers the run asks for, between two steps; `false` where that is nothing it can do.
    pub fn steer(&mut self, steering: Steering, step: u64) -> bool {
        match steering {
            Steering::Pause => (self.is_paused, self.granted) = (true, 0),
            Steering::Resume if self.is_paused => {
                self.is_paused = false;
                self.origin = None;
            }
            Steering::Resume => {}
            Steering::Step(steps) => {
                (self.is_paused, self.granted) = (true, self.granted.saturating_add(steps))
            }
            Steering::Pace(0.0) => self.timing.pace = Pace::Free,
            Steering::Pace(pace) if PACES.contains(&pace) => {
                self.timing.pace = Pace::Realtime;
                self.step_length = self.dt.div_f64(pace);
                self.origin = Some((Instant::now(), step));
            }
            Steering::Pace(_) => return false,
        }
        true
    }

    /// Whether no step begins until somebody says so.
    pub fn is_paused(&self) -> bool {
        self.is_paused
    }

    /// Whether steps begin at scheduled instants.
    pub fn is_scheduled(&self) -> bool {
        self.is_paused || self.timing.pace == Pace::Realtime
    }

    /// So many times real time; 0 as fast as possible.
    pub fn pace(&self) -> f64 {
        match self.timing.pace {
            Pace::Free => 0.0,
            Pace::Realtime => self.dt.as_secs_f64() / self.step_length.as_secs_f64(),
        }
    }

    /// Time until the present step's deadline, where it has one that has not passed.
    pub fn time_left(&self) -> Option<Duration> {
        self.deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()))
    }

    /// Whether the present step's deadline has just passed; true once per step.
    pub fn has_missed(&mut self, awaited: &Awaited) -> bool {
        if self.deadline.is_none_or(|deadline| Instant::now() < deadline) {
            return false;
        }
        if awaited.role == Role::Controller && awaited.missing & self.unhurried != 0 {
            // The schedule begins anew when the run goes on, and others have as long as ever once it does.
            self.origin = None;
            let allowed = self.timing.deadline.unwrap_or(self.step_length);
            self.deadline = Some(Instant::now() + allowed);
            return false;
        }
        self.deadline = None;
        // One that began late has been counted when it began.
        self.missed_steps += u64::from(!self.began_late);
        for index in (0..64).filter(|i| awaited.missing >> i & 1 == 1) {
            match self.missed_by.iter_mut().find(|(role, i, _)| (*role, *i) == (awaited.role, index)) {
                Some((.., steps)) => *steps += 1,
                None => self.missed_by.push((awaited.role, index, 1)),
            }
        }
        true
    }

    /// How many deadlines a participant has missed.
    pub fn missed_by(&self, role: Role, index: u32) -> u64 {
        let its = self.missed_by.iter().find(|(r, i, _)| (*r, *i) == (role, index));
        its.map_or(0, |(.., steps)| *steps)
    }

    /// How punctual the run was; `None` where nothing was asked for.
    pub fn report(&self, names: &ControllerNames) -> Option<Punctuality> {
        if self.timing.pace == Pace::Free && self.timing.deadline.is_none() {
            return None;
        }
        Some(Punctuality {
            paced: self.timing.pace == Pace::Realtime,
            deadline_us: self.timing.deadline.unwrap_or(self.step_length).as_secs_f64() * 1e6,
            on_miss: self.timing.on_miss,
            missed_steps: self.missed_steps,
            began_late: self.backlog,
            missed_by: self
                .missed_by
                .iter()
                .map(|(role, index, steps)| MissedBy {
                    participant: match role {
                        Role::Controller => names.of(*index),
                        role => format!("{role} {index}"),
                    },
                    steps: *steps,
                })
                .collect(),
            lateness_ns: Percentiles::of(&self.lateness_ns),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instants_are_absolute_and_misses_are_counted_once_per_step_and_participant() {
        let timing = Timing { pace: Pace::Realtime, deadline: None, on_miss: OnMiss::Wait };
        let mut pacer = Pacer::new(timing, 1_000_000);
        let awaited = Awaited { role: Role::Controller, missing: 0b101, what: "commands", step: 0 };
        assert_eq!(pacer.until(7), None, "the first step is due at once");
        let origin = pacer.due(7);
        pacer.begin(7);
        while !pacer.has_missed(&awaited) {}
        assert!(Instant::now() >= origin + Duration::from_millis(1));
        assert!(!pacer.has_missed(&awaited));
        // Twenty steps on, the schedule is where it would have been without the miss.
        assert_eq!(pacer.due(27), origin + Duration::from_millis(20));
        pacer.begin(8);
        while !pacer.has_missed(&Awaited { missing: 0b100, ..awaited }) {}
        let report = pacer.report(&ControllerNames::default()).expect("there was a schedule");
        let by = |i: usize| (report.missed_by[i].participant.as_str(), report.missed_by[i].steps);
        assert_eq!((report.missed_steps, by(0), by(1)), (2, ("controller 0", 1), ("controller 2", 2)));
    }

    #[test]
    fn no_clock_goes_on_while_a_controller_is_debugged() {
        let timing = Timing { pace: Pace::Realtime, deadline: None, on_miss: OnMiss::Hold };
        let mut pacer = Pacer::new(timing, 1_000_000).unhurried_by(0b10);
        let awaited = |missing| Awaited { role: Role::Controller, missing, what: "commands", step: 0 };
        assert_eq!(pacer.until(0), None);
        pacer.begin(0);
        let start = Instant::now();
        while start.elapsed() < Duration::from_millis(5) {
            assert!(!pacer.has_missed(&awaited(0b11)));
        }
        // It has answered: from now on the other has a deadline, and the next step a schedule of its own.
        while !pacer.has_missed(&awaited(0b01)) {
            assert!(start.elapsed() < Duration::from_secs(60), "no deadline in a minute");
        }
        assert!(pacer.due(1) >= start + Duration::from_millis(5));
        let report = pacer.report(&ControllerNames::default()).expect("there was a schedule");
        assert_eq!((report.missed_steps, report.began_late), (1, 0));
    }

    /// It used to have none: nobody was fallen back on while the world was behind, which is when it matters.
    #[test]
    fn a_step_that_begins_late_has_a_deadline_and_counts_once() {
        let timing = Timing { pace: Pace::Realtime, deadline: None, on_miss: OnMiss::Hold };
        let mut pacer = Pacer::new(timing, 1_000_000);
        let awaited = Awaited { role: Role::Controller, missing: 1, what: "commands", step: 0 };
        assert_eq!(pacer.until(0), None);
        let origin = pacer.due(0);
        while Instant::now() < origin + Duration::from_millis(5) {}
        // Steps 1 and 2 were due long ago; step 2 is answered in time.
        for (step, is_answered) in [(1, false), (2, true)] {
            pacer.begin(step);
            let deadline = pacer.deadline.expect("every step has a deadline");
            assert!(deadline >= origin + Duration::from_micros(5500), "half a step after its beginning");
            while !is_answered && !pacer.has_missed(&awaited) {
                assert!(origin.elapsed() < Duration::from_secs(60), "no deadline in a minute");
            }
        }
        let report = pacer.report(&ControllerNames::default()).expect("there was a schedule");
        assert_eq!((report.missed_steps, report.began_late), (2, 2));
        assert_eq!(report.missed_by.iter().map(|by| by.steps).sum::<u64>(), 1);
    }
}
