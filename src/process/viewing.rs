//! Looking at a run while it goes on, from another process, and steering it: for views, not for recordings.
//!
//! Whoever looks gets steps as they come, and loses some when it is too slow; the run never waits for it, and as long
//! as nobody looks it does nothing for anybody. Who the run is of, is in a file beside the run's others.

use super::observe::ObservedSteps;
use super::pace::Pacer;
use super::services::Driver;
use super::{MissedBy, ProcessError};
use crate::encoding;
use crate::lockstep::Observer;
use crate::record::{Metadata, Processes, ScenarioSource};
use crate::scenario::{Scenario, kept};
use crate::step::{Step, StepFrames};
use crate::transport::TransportError;
use crate::transport::iox::{
    Block, BlockInbox, BlockOutbox, RunName, RunSpace, SpaceError, SteeringInbox, SteeringOutbox,
};
use ipc_schemas::{Assignment, Role, VehicleCommand, VehicleState};
use serde::{Deserialize, Serialize};
use std::cell::Cell;
use std::rc::Rc;
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
    /// Answers that came too late or twice.
    pub late_frames: u64,
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

/// The world's side.
#[derive(Debug)]
pub(super) struct Viewing {
    steps: Rc<BlockOutbox>,
    notices: BlockOutbox,
    steering: Option<SteeringInbox>,
    /// When a run that somebody has paused goes on, if nobody looks.
    left_at: Instant,
    is_watched: Rc<Cell<bool>>,
    is_recorded: bool,
    noticed: Option<Instant>,
    first_latency: u64,
    latency_us: Vec<f32>,
}

/// Shows steps to the recorder and to whoever looks.
#[derive(Debug)]
pub(super) struct Shown {
    recorded: Option<ObservedSteps>,
    steps: Rc<BlockOutbox>,
    is_watched: Rc<Cell<bool>>,
}

impl Observer for Shown {
    fn observe(&mut self, frames: &StepFrames<'_>) -> Result<(), TransportError> {
        if self.is_watched.get() {
            // A view that cannot keep up, or has no room, does without.
            let _ = self.steps.send(frames.encoded_len(), |write| frames.encode(write));
        }
        self.recorded.as_mut().map_or(Ok(()), |recorded| recorded.observe(frames))
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
            steps: Rc::new(space.create_blocks(SERVICE_VIEW, expected, (waiting, VIEWS), true)?),
            notices: space.create_blocks(SERVICE_NOTICES, 4096, (16, VIEWS), true)?,
            steering: if patience.is_some() { Some(space.create_steering(SERVICE_STEERING)?) } else { None },
            left_at: Instant::now() + patience.unwrap_or_default(),
            is_watched: Rc::default(),
            is_recorded: false,
            noticed: None,
            first_latency: 0,
            latency_us: Vec::with_capacity(MOST_LATENCIES),
        })
    }

    /// Whoever is to be shown all steps, besides those who look now and then.
    pub fn show_to(&mut self, driver: &mut Driver, recorded: Option<ObservedSteps>) {
        self.is_recorded = recorded.is_some();
        let (steps, is_watched) = (self.steps.clone(), self.is_watched.clone());
        driver.observe(Box::new(Shown { recorded, steps, is_watched }));
        driver.show_steps(self.is_recorded);
    }

    /// A step took so long.
    pub fn step_done(&mut self, step: u64, ns: u64) {
        if self.is_watched.get() && self.latency_us.len() < MOST_LATENCIES {
            if self.latency_us.is_empty() {
                self.first_latency = step;
            }
            self.latency_us.push(ns as f32 * 1e-3);
        }
    }

    /// Sees whether somebody looks and steers, and tells how the run goes; called between two steps, now and then.
    pub fn attend(&mut self, driver: &mut Driver, pacer: &mut Pacer) -> Result<(), ProcessError> {
        let is_watched = self.steps.has_reader();
        if is_watched != self.is_watched.replace(is_watched) {
            driver.show_steps(is_watched || self.is_recorded);
            self.latency_us.clear();
            self.noticed = None;
        }
        if let Some(steering) = &self.steering {
            let step = driver.world().step();
            while let Some(bytes) = steering.receive()? {
                // What is none is nobody's of ours.
                if let Ok(wish) = serde_json::from_slice(&bytes) {
                    pacer.steer(wish, step);
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
            let notice = self.notice(driver, pacer);
            let bytes = serde_json::to_vec(&notice).expect("a notice is numbers and text");
            let _ = self.notices.send(bytes.len(), |write| write(&bytes));
        }
        Ok(())
    }

    fn notice(&mut self, driver: &Driver, pacer: &Pacer) -> Notice {
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
            late_frames: driver.late_frames(),
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
    _space: RunSpace,
}

impl Watched {
    /// Begins to look at a run; returns what it is as well. `None` while there is no such run that can be looked at.
    pub fn open(run: &RunName) -> Result<Option<(Watched, Metadata, Arc<Scenario>)>, ProcessError> {
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
        Ok(Some((Watched { steps, notices, steering, world, _space: space }, metadata, Arc::new(scenario))))
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

    /// Whether its world is still there.
    pub fn goes_on(&self) -> bool {
        super::peers::is_alive(self.world)
    }
}
