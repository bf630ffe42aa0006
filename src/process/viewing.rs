//! Looking at a run while it goes on, from another process, and steering it: for views, not for recordings.
//!
//! Whoever looks gets steps when they are over: while no step is due, or, in a run that goes as fast as it can, some of
//! them, while others work on the next one. It loses some when it is too slow; the run never waits for it, and as long
//! as nobody looks it does nothing for anybody. What the run is of, is in a file beside the run's others.

use super::outcome::Events;
use super::pace::Pacer;
use super::services::Driver;
use super::{MissedBy, ProcessError};
use crate::encoding;
use crate::lockstep::{LockstepError, Observer};
use crate::record::{Metadata, Processes, RunEvent, RunEventKind, ScenarioSource};
use crate::scenario::{Scenario, kept};
use crate::step::{Step, StepFrames};
use crate::trace;
use crate::transport::TransportError;
use crate::transport::iox::{
    Block, BlockInbox, BlockOutbox, Condition, Leftover, RunName, RunSpace, SpaceError, SteeringInbox,
    SteeringOutbox, clean,
};
use ipc_schemas::{Assignment, Role, VehicleCommand, VehicleState};
use serde::{Deserialize, Serialize};
use std::cell::Cell;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// World → views: every step as one block of bytes, while somebody looks. Overflows.
const SERVICE_VIEW: &str = "cz/view";
/// World → views: a [`Notice`] now and then, while somebody looks. Overflows.
const SERVICE_NOTICES: &str = "cz/notices";
/// Views → world: [`Steering`].
const SERVICE_STEERING: &str = "cz/steering";
/// What the file is called in which the run says what it is.
const ABOUT: &str = "about";

/// Memory for steps that wait to be taken, bytes, and bounds of their number.
const WAITING_BYTES: usize = 8 << 20;
const MOST_WAITING: usize = 256;
const FEWEST_WAITING: usize = 4;
/// Views at once.
const VIEWS: usize = 2;
/// Time between two notices.
const NOTICE_EVERY: Duration = Duration::from_millis(100);
/// A paused run goes on when nobody has looked for this long.
const LEAVING: Duration = Duration::from_secs(2);
/// Latencies in a notice at most.
const MOST_LATENCIES: usize = 4096;

/// How a run goes, told to whoever looks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Notice {
    /// The step that is next.
    pub step: u64,
    /// The first of the steps whose latencies follow.
    pub first_latency: u64,
    /// How long steps took since the last notice, us.
    pub latency_us: Vec<f32>,
    /// Who has which place, the world first.
    pub members: Vec<Place>,
    /// Steps that missed their deadlines.
    pub missed_steps: u64,
    /// Who had not answered by the deadline, and in how many steps.
    pub missed_by: Vec<MissedBy>,
    /// Frames that were refused, in words.
    pub refused: Vec<String>,
    /// What has happened since the last notice.
    pub events: Vec<RunEvent>,
    /// Answers that came too late or twice.
    pub late_frames: u64,
    /// Steps not shown since somebody has begun to look, for they would have taken too much of the run's time.
    pub left_out_steps: u64,
    /// Whether it makes no step until told.
    pub is_paused: bool,
    /// So many times real time; 0 as fast as it can.
    pub pace: f64,
    /// Whether it may be steered.
    pub is_steered: bool,
}

/// A process of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// Role and index, or the name of a controller written elsewhere.
    pub name: String,
    /// The process.
    pub process_id: u32,
    /// How often the place has been taken anew.
    pub generation: u32,
}

/// What may be asked of a run that is steered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Steering {
    /// No further step until told.
    Pause,
    /// On, at the pace there was.
    Resume,
    /// So many steps, then pause.
    Step(u32),
    /// So many times real time; 0 as fast as it can.
    Pace(f64),
}

/// Showing steps of a run that goes as fast as it can takes this share of the time at most, one in so many.
const SHARE: u32 = 20;
/// Among so many steps shown one says what is in force in every zone, for whoever has lost some.
const ALL_IN_FORCE_EVERY: u32 = 64;

impl std::fmt::Display for Steering {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Steering::Pause => f.write_str("steered: pause"),
            Steering::Resume => f.write_str("steered: go on"),
            Steering::Step(1) => f.write_str("steered: one step"),
            Steering::Step(steps) => write!(f, "steered: {steps} steps"),
            Steering::Pace(0.0) => f.write_str("steered: as fast as it can"),
            Steering::Pace(pace) => write!(f, "steered: {pace} times real time"),
        }
    }
}

/// The world's side.
#[derive(Debug)]
pub(super) struct Viewing {
    steps: BlockOutbox,
    notices: BlockOutbox,
    steering: Option<SteeringInbox>,
    /// When a run that somebody has paused goes on, if nobody looks.
    left_at: Instant,
    is_watched: bool,
    /// When a step may be shown again; before, those that begin are left out.
    next_at: Instant,
    /// How long it took to keep the step that is kept, and to show the last one.
    keeping: Duration,
    showing: Duration,
    shown: u32,
    left_out: u64,
    /// Events told.
    told: usize,
    noticed: Option<Instant>,
    first_latency: u64,
    latency_us: Vec<f32>,
}

/// Sends steps to whoever looks.
#[derive(Debug)]
struct Sender<'a>(&'a BlockOutbox);

impl Observer for Sender<'_> {
    fn observe(&mut self, frames: &StepFrames<'_>) -> Result<(), TransportError> {
        // A view that cannot keep up, or has no room, does without.
        let _ = self.0.send(frames.encoded_len(), |write| frames.encode(write));
        Ok(())
    }
}

impl Viewing {
    /// Creates what a run of so many vehicles at once is looked at by; and steered by, where somebody is waited for so
    /// long when it begins paused.
    pub fn create(
        space: &RunSpace,
        scenario: &Scenario,
        (vehicles, run_id): (usize, u64),
        processes: Processes,
        patience: Option<Duration>,
    ) -> Result<Viewing, SpaceError> {
        let metadata = Metadata::new(scenario, ScenarioSource::default(), run_id, processes);
        let mut about = Vec::new();
        encoding::keep_onto(&mut about, &metadata);
        space.put(ABOUT, &about)?;
        let per_vehicle =
            size_of::<VehicleState>() + size_of::<VehicleCommand>() + 2 * size_of::<Assignment>();
        let expected = vehicles * per_vehicle + 64 * scenario.network.zones.len() + 1024;
        let waiting = (WAITING_BYTES / expected).clamp(FEWEST_WAITING, MOST_WAITING);
        Ok(Viewing {
            steps: space.create_blocks(SERVICE_VIEW, expected, (waiting, VIEWS), true)?,
            notices: space.create_blocks(SERVICE_NOTICES, 4096, (16, VIEWS), true)?,
            steering: if patience.is_some() { Some(space.create_steering(SERVICE_STEERING)?) } else { None },
            left_at: Instant::now() + patience.unwrap_or_default(),
            is_watched: false,
            next_at: Instant::now(),
            keeping: Duration::ZERO,
            showing: Duration::ZERO,
            shown: 0,
            left_out: 0,
            told: 0,
            noticed: None,
            first_latency: 0,
            latency_us: Vec::with_capacity(MOST_LATENCIES),
        })
    }

    /// The state of a step has been published, and others work on it: shows the step before, if it was kept and has not
    /// been shown, and keeps this one if its turn has come, or somebody has asked for it.
    pub fn overlap(&mut self, driver: &mut Driver, is_asked_for: bool) -> Result<(), ProcessError> {
        if !self.is_watched {
            return Ok(());
        }
        let is_last = driver.world().is_finished();
        let begin = Instant::now();
        if self.show(driver)? {
            self.next_at = begin + (self.keeping + self.showing) * SHARE;
        }
        if begin >= self.next_at || is_asked_for || is_last {
            driver.keep_step();
            self.keeping = begin.elapsed();
        } else {
            self.left_out += 1;
        }
        if is_last {
            self.show(driver)?;
        }
        Ok(())
    }

    /// No step is due for so long: shows the one before, where there is time enough.
    pub fn idle(&mut self, driver: &mut Driver, left: Duration) -> Result<(), ProcessError> {
        if self.is_watched && left > self.showing * 2 && self.show(driver)? {
            // Nobody waited for it.
            self.next_at = Instant::now() + self.keeping * SHARE;
        }
        Ok(())
    }

    fn show(&mut self, driver: &mut Driver) -> Result<bool, ProcessError> {
        let begin = Instant::now();
        let is_shown = driver.show_kept(&mut Sender(&self.steps)).map_err(LockstepError::from)?;
        if is_shown {
            self.showing = begin.elapsed();
            self.shown = self.shown.wrapping_add(1);
            if self.shown.is_multiple_of(ALL_IN_FORCE_EVERY) {
                driver.show_all_in_force();
            }
        }
        Ok(is_shown)
    }

    /// A step took so long.
    pub fn step_done(&mut self, step: u64, ns: u64) {
        if self.is_watched && self.latency_us.len() < MOST_LATENCIES {
            if self.latency_us.is_empty() {
                self.first_latency = step;
            }
            self.latency_us.push(ns as f32 * 1e-3);
        }
    }

    /// Sees whether somebody looks and steers, and tells how the run goes; called between two steps, now and then.
    pub fn attend(
        &mut self,
        driver: &mut Driver,
        pacer: &mut Pacer,
        events: &mut Events,
    ) -> Result<(), ProcessError> {
        let is_watched = self.steps.has_reader();
        if is_watched != self.is_watched {
            self.is_watched = is_watched;
            driver.show_all_in_force();
            (self.keeping, self.showing, self.next_at) = (Duration::ZERO, Duration::ZERO, Instant::now());
            (self.left_out, self.told) = (0, 0);
            self.latency_us.clear();
            self.noticed = None;
        }
        if let Some(steering) = &self.steering {
            let step = driver.world().step();
            while let Some(bytes) = steering.receive()? {
                // What is none is nobody's of ours.
                if let Ok(wish) = serde_json::from_slice::<Steering>(&bytes)
                    && pacer.steer(wish, step)
                {
                    trace::note(|| wish.to_string());
                    events.say(step, RunEventKind::Steered, wish.to_string(), 0);
                    self.noticed = None;
                }
            }
            if is_watched {
                self.left_at = Instant::now() + LEAVING;
            } else if Instant::now() >= self.left_at {
                // Nobody is left to let it go on.
                pacer.steer(Steering::Resume, step);
            }
        }
        if is_watched && self.noticed.is_none_or(|at| at.elapsed() >= NOTICE_EVERY) {
            self.noticed = Some(Instant::now());
            let notice = self.notice(driver, pacer, events.since(self.told));
            self.told += notice.events.len();
            let bytes = serde_json::to_vec(&notice).expect("a notice is numbers and text");
            let _ = self.notices.send(bytes.len(), |write| write(&bytes));
        }
        Ok(())
    }

    fn notice(&mut self, driver: &Driver, pacer: &Pacer, events: &[RunEvent]) -> Notice {
        let names = driver.names();
        let world = Place { name: "world".to_owned(), process_id: std::process::id(), generation: 0 };
        let others = driver.members().map(|member| Place {
            name: match Role::from_code(member.role) {
                Some(Role::Controller) => names.of(u32::from(member.index)),
                _ => format!("coordinator {}", member.index),
            },
            process_id: member.process_id,
            generation: member.generation,
        });
        let report = pacer.report(&names);
        Notice {
            step: driver.world().step(),
            first_latency: self.first_latency,
            latency_us: self.latency_us.drain(..).collect(),
            members: std::iter::once(world).chain(others).collect(),
            missed_steps: report.as_ref().map_or(0, |report| report.missed_steps),
            missed_by: report.map_or_else(Vec::new, |report| report.missed_by),
            refused: driver.refused().iter().map(ToString::to_string).collect(),
            events: events.to_vec(),
            late_frames: driver.late_frames(),
            left_out_steps: self.left_out,
            is_paused: pacer.is_paused(),
            pace: pacer.pace(),
            is_steered: self.steering.is_some(),
        }
    }
}

/// The view's side: a run that goes on.
#[derive(Debug)]
pub struct Watched {
    steps: BlockInbox,
    notices: BlockInbox,
    steering: Option<SteeringOutbox>,
    world: u32,
    /// When the world was last seen.
    seen: Cell<Instant>,
    _space: RunSpace,
}

/// Time between two looks whether a world is still there.
const STILL_THERE: Duration = Duration::from_millis(50);

impl Watched {
    /// Time between two looks for steps.
    pub const LOOK: Duration = Duration::from_micros(500);
    /// How nice whoever looks is to be to the processes of the run.
    pub const NICENESS: i32 = 10;

    /// Looks for a run and opens it, without entering it as long as it is not there, which would be in the way of
    /// whoever begins it.
    ///
    /// # Errors
    /// When shared memory cannot be read, or the run not opened.
    pub fn find(run: &RunName) -> Result<Option<(Watched, Metadata, Arc<Scenario>)>, ProcessError> {
        let is_there =
            |other: &Leftover| other.condition == Condition::Alive && other.name == run.to_string();
        if clean(true)?.iter().any(is_there) { Watched::open(run) } else { Ok(None) }
    }

    /// Begins to look at a run; returns what it is as well. `None` while there is no such run that can be looked at.
    fn open(run: &RunName) -> Result<Option<(Watched, Metadata, Arc<Scenario>)>, ProcessError> {
        let space = RunSpace::enter(run)?;
        let Some(world) = space.world().filter(|world| super::peers::is_alive(*world)) else {
            return Ok(None);
        };
        let Some(about) = space.get(ABOUT) else { return Ok(None) };
        let Ok(metadata) = encoding::kept::<Metadata>(&about) else { return Ok(None) };
        let Some(scenario) = kept(&metadata.scenario).ok().filter(|s| s.check().is_ok()) else {
            return Ok(None);
        };
        let (Some(notices), Some(steps)) =
            (space.open_blocks(SERVICE_NOTICES)?, space.open_blocks(SERVICE_VIEW)?)
        else {
            return Ok(None);
        };
        let steering = space.open_steering(SERVICE_STEERING)?;
        Ok(Some((
            Watched { steps, notices, steering, world, seen: Cell::new(Instant::now()), _space: space },
            metadata,
            Arc::new(scenario),
        )))
    }

    /// The next step, with its number.
    pub fn step(&self) -> Result<Option<(u64, Block)>, ProcessError> {
        while let Some(block) = self.steps.receive()? {
            if let Some(step) = Step::number_in(block.bytes()) {
                return Ok(Some((step, block)));
            }
        }
        Ok(None)
    }

    /// The next notice.
    pub fn notice(&self) -> Result<Option<Notice>, ProcessError> {
        while let Some(block) = self.notices.receive()? {
            if let Ok(notice) = serde_json::from_slice(block.bytes()) {
                return Ok(Some(notice));
            }
        }
        Ok(None)
    }

    /// Whether it may be steered.
    pub fn is_steered(&self) -> bool {
        self.steering.is_some()
    }

    /// Steers it; `false` when the run does not let itself be steered.
    pub fn steer(&self, wish: &Steering) -> Result<bool, ProcessError> {
        let Some(steering) = &self.steering else { return Ok(false) };
        steering.send(&serde_json::to_vec(wish).expect("steering is a word and a number"))?;
        Ok(true)
    }

    /// Whether its world is still there, or was just now. To be asked before the last steps are taken: what was sent
    /// before it ended is there then.
    pub fn goes_on(&self) -> bool {
        if self.seen.get().elapsed() < STILL_THERE {
            return true;
        }
        let is_there = super::peers::is_alive(self.world);
        if is_there {
            self.seen.set(Instant::now());
        }
        is_there
    }
}
