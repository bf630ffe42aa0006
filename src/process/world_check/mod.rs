//! The conformance kit of foreign worlds: a stranger's world between our coordinator and a scripted controller.
//!
//! The world under test is another process, started as `cz run --world` starts it; coordinator and controller are played
//! here, one after the other, so that each state can be judged before it is answered. Four runs: one in which the
//! controller has vehicles pulse, brake to a stop, stand and start again, keeps the world waiting, and stops its
//! process for a while; the same without the waiting, which is to come to the same hash; one in which nobody answers
//! any more; and one in which the world is told to end.

mod foreign;
mod judge;
mod rules;
mod session;

pub use judge::Tolerances;
pub use rules::{WorldBreach, WorldReport, WorldRule};

use super::ProcessError;
use crate::scenario::Scenario;
use rustix::process::Signal;
use session::{Session, Went};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// What the scripted controller does, in steps.
const PULSES_FROM: u64 = 200;
const PULSES_TO: u64 = 300;
const LATE_AT: u64 = 300;
const STOP_AT: u64 = 350;
const BRAKE_FROM: u64 = 400;
const BRAKE_TO: u64 = 500;
const START_TO: u64 = 540;
/// What is changed in the scenario: the world does not change commands, nobody is let in where there is no room, and the
/// run ends by its clock.
pub const CHANGES: [&str; 3] = ["shield=off", "gate.entry=viable", "end.time_s=80"];
/// How long the controller keeps the world waiting, and how long that is stopped.
const LATE: Duration = Duration::from_millis(1000);
const STOPPED: Duration = Duration::from_millis(500);
/// How long it may take to open the run, at least: some are slow to start.
const JOIN: Duration = Duration::from_secs(30);
/// How long the world of the third run waits for an answer, and how much longer it may take.
const PEER_TIMEOUT: Duration = Duration::from_secs(1);
const LEAVING: Duration = Duration::from_secs(10);
/// The step in which nobody answers any more, or the world is told to end.
const BREAKS_OFF_AT: u64 = 60;

/// How a world is checked.
#[derive(Clone, Debug)]
pub struct WorldCheckOptions {
    /// Arguments that name the scenario and what is changed in it.
    pub scenario: Vec<String>,
    /// How far what happens may be from what was asked for.
    pub tolerances: Tolerances,
    /// How long it may take to state a step and to end, and, where it is more than 30 s, to open the run.
    pub patience: Duration,
}

/// How a run is played.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Play {
    /// To its end, keeping the world waiting or not.
    Whole { hampers: bool },
    /// Until nobody answers any more.
    Abandoned,
    /// Until the world is told to end.
    Told,
}

/// Checks a command line as the world of a scenario.
///
/// # Errors
/// When the check itself cannot be made.
pub fn check_world(
    scenario: &Arc<Scenario>,
    command: &[String],
    options: &WorldCheckOptions,
) -> Result<WorldReport, ProcessError> {
    let mut kit = Kit {
        scenario,
        command,
        options,
        folder: Folder::new()?,
        runs: 0,
        step: 0,
        breaches: Vec::new(),
        tried: BTreeSet::new(),
        report: Found::default(),
    };
    let first = kit.whole(true)?;
    if let Some(first) = first {
        if let Some(second) = kit.whole(false)? {
            kit.tried.insert(WorldRule::Repeats);
            if first != second {
                let what = format!("the state hash was {first:016x}, and is {second:016x} the second time");
                kit.breach(WorldRule::Repeats, what);
            }
        }
        kit.broken_off(Play::Abandoned)?;
        kit.broken_off(Play::Told)?;
    }
    let untried =
        |rule: &WorldRule| !kit.tried.contains(rule) && !kit.breaches.iter().any(|b| b.rule == *rule);
    Ok(WorldReport {
        untried: WorldRule::ALL.into_iter().filter(untried).collect(),
        steps: kit.report.steps,
        vehicles: kit.report.vehicles,
        greatest_disobedience_mps2: kit.report.disobedience_mps2,
        greatest_deviation_m: kit.report.deviation_m,
        breaches: kit.breaches,
    })
}

/// What was found beside breaches.
#[derive(Debug, Default)]
struct Found {
    steps: u64,
    vehicles: u32,
    disobedience_mps2: f64,
    deviation_m: f64,
}

struct Kit<'a> {
    scenario: &'a Arc<Scenario>,
    command: &'a [String],
    options: &'a WorldCheckOptions,
    folder: Folder,
    runs: u32,
    /// The step at hand.
    step: u64,
    breaches: Vec<WorldBreach>,
    tried: BTreeSet<WorldRule>,
    report: Found,
}

impl Kit<'_> {
    fn breach(&mut self, rule: WorldRule, what: String) {
        match self.breaches.iter_mut().find(|b| b.rule == rule) {
            Some(known) => known.count += 1,
            None => self.breaches.push(WorldBreach { rule, step: self.step, what, count: 1 }),
        }
    }

    /// A run to its end; returns its state hash unless the world broke off.
    fn whole(&mut self, hampers: bool) -> Result<Option<u64>, ProcessError> {
        let play = Play::Whole { hampers };
        let Some(mut session) = self.open(play)? else { return Ok(None) };
        loop {
            match session.take_state(self)? {
                Went::On => {}
                Went::Over => break,
                Went::Wrong => return Ok(None),
            }
            let step = self.step;
            if hampers && step == LATE_AT {
                self.tried.insert(WorldRule::LateCommands);
                std::thread::sleep(LATE);
                if session.has_more()? {
                    let what = format!("it went on without the commands of step {step}");
                    self.breach(WorldRule::LateCommands, what);
                }
            }
            if hampers && step == STOP_AT {
                self.tried.insert(WorldRule::Stopped);
                session.world.signal(Signal::STOP);
                session.answer(step, script)?;
                std::thread::sleep(STOPPED);
                session.world.signal(Signal::CONT);
                continue;
            }
            session.answer(step, script)?;
        }
        self.settle(session, hampers)
    }

    /// What is to be said of a run that is over.
    fn settle(&mut self, session: Session, is_first: bool) -> Result<Option<u64>, ProcessError> {
        use WorldRule::{Accounts, End, Motion, Obedience, Standing, Traffic};
        let (steps, hash) = (self.step, session.hash);
        let judge = &session.judge;
        let (came, driven, left) = (judge.next, judge.driven, judge.left);
        let Found { disobedience_mps2, deviation_m, .. } = &mut self.report;
        *disobedience_mps2 = disobedience_mps2.max(judge.greatest_disobedience_mps2);
        *deviation_m = deviation_m.max(judge.greatest_deviation_m);
        if is_first {
            self.report.vehicles = came;
            self.tried.insert(Traffic);
            if came == 0 || driven == 0 || left == 0 {
                let what = format!(
                    "{came} vehicles came, {driven} commands were given, {left} left, in {steps} steps"
                );
                self.breach(Traffic, what);
            } else {
                self.tried.extend([Motion, Obedience]);
                self.tried.extend((steps >= BRAKE_TO).then_some(Standing));
            }
        }
        let summary = session.summary();
        let mut world = session.leave();
        self.tried.extend([End, Accounts]);
        match world.ended_within(self.options.patience) {
            Some(status) if status.success() => {}
            Some(_) => {
                let how = world.end();
                self.breach(End, how);
                return Ok(None);
            }
            None => {
                let what = format!("still there {} s after it", self.options.patience.as_secs());
                self.breach(End, what);
                return Ok(None);
            }
        }
        match read_summary(&summary) {
            None => self.breach(Accounts, "it wrote no summary".to_owned()),
            Some((said, arrived)) => {
                if said != hash {
                    self.breach(
                        Accounts,
                        format!("state_hash is {said:016x}, that of its frames {hash:016x}"),
                    );
                }
                if arrived != u64::from(came) {
                    self.breach(Accounts, format!("arrived is {arrived}, its frames had {came} vehicles"));
                }
            }
        }
        Ok(Some(hash))
    }

    /// A run that is broken off.
    fn broken_off(&mut self, play: Play) -> Result<(), ProcessError> {
        let rule = if play == Play::Told { WorldRule::Told } else { WorldRule::Abandoned };
        let Some(mut session) = self.open(play)? else { return Ok(()) };
        loop {
            match session.take_state(self)? {
                Went::On => {}
                Went::Over | Went::Wrong => return Ok(()),
            }
            if self.step == BREAKS_OFF_AT {
                break;
            }
            session.answer(self.step, script)?;
        }
        self.tried.insert(rule);
        let limit = match play {
            Play::Told => {
                session.world.signal(Signal::TERM);
                LEAVING
            }
            _ => PEER_TIMEOUT + LEAVING,
        };
        match session.world.ended_within(limit) {
            Some(status) if status.success() => self.breach(rule, "it ended with code 0".to_owned()),
            Some(_) => {}
            None => self.breach(rule, format!("still there after {} s", limit.as_secs())),
        }
        Ok(())
    }

    fn open(&mut self, play: Play) -> Result<Option<Session>, ProcessError> {
        self.step = 0;
        self.runs += 1;
        Session::open(self, play)
    }
}

/// Changes what the built-in law commands a vehicle.
fn script(step: u64, vehicle: u32, u_mps2: f64, v_mps: f64, scenario: &Scenario) -> f64 {
    let limits = &scenario.vehicle;
    let wanted = match step {
        // Up and down by turns, one vehicle otherwise than the next.
        PULSES_FROM..PULSES_TO => {
            u_mps2 + if (step / 10 + u64::from(vehicle)).is_multiple_of(2) { 0.4 } else { -0.4 }
        }
        BRAKE_FROM..BRAKE_TO => limits.u_min_mps2,
        BRAKE_TO..START_TO => 0.8,
        _ => return u_mps2,
    };
    let to_v_max_mps2 = (limits.v_max_mps - v_mps) / scenario.dt_s();
    wanted.min(to_v_max_mps2.max(u_mps2)).clamp(limits.u_min_mps2, limits.u_max_mps2)
}

/// The state hash and the number of vehicles in a run's summary.
fn read_summary(path: &Path) -> Option<(u64, u64)> {
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
    let hash = u64::from_str_radix(summary["state_hash"].as_str()?, 16).ok()?;
    Some((hash, summary["arrived"].as_u64()?))
}

/// A folder of this check's own, removed with it.
#[derive(Debug)]
struct Folder(PathBuf);

impl Folder {
    fn new() -> Result<Folder, ProcessError> {
        let path = std::env::temp_dir().join(format!("cz-world-check-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir(&path).map_err(|error| ProcessError::Folder { path: path.clone(), error })?;
        Ok(Folder(path))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
