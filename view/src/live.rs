//! A run that goes on, as the page sees it.

use crate::run::{Live, Run};
use crate::steps::{Kept, Steps};
use control_zones::process::{Notice, ProcessError, Steering, Watched};
use control_zones::record::Metadata;
use control_zones::scenario::Scenario;
use control_zones::step::Step;
use control_zones::transport::iox::RunName;
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Latencies kept at most; the oldest give way.
const MOST_LATENCIES: usize = 200_000;

/// What is known of how the run goes.
#[derive(Debug, Default)]
struct Progress {
    notice: Notice,
    latencies: Vec<(u64, f32)>,
    is_over: bool,
    problem: Option<String>,
}

/// A run that goes on.
#[derive(Debug)]
struct Going {
    progress: Arc<Mutex<Progress>>,
    steering: Mutex<Sender<Steering>>,
    /// Whether it waits for somebody to look, and has been told that somebody does.
    waits: bool,
    has_begun: AtomicBool,
}

impl Going {
    fn progress(&self) -> MutexGuard<'_, Progress> {
        locked(&self.progress)
    }
}

fn locked(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Live for Going {
    fn status(&self) -> Value {
        let progress = self.progress();
        let notice = &progress.notice;
        json!({
            "is_over": progress.is_over,
            "problem": progress.problem,
            "is_steered": notice.is_steered,
            "is_paused": notice.is_paused,
            "pace": notice.pace,
            "missed_steps": notice.missed_steps,
            "late_frames": notice.late_frames,
            "left_out_steps": notice.left_out_steps,
            "refused": notice.refused,
            "members": notice.members,
        })
    }

    fn begin(&self) {
        if !self.has_begun.swap(true, Ordering::Relaxed) && self.waits {
            let _ = self.steering.lock().unwrap_or_else(PoisonError::into_inner).send(Steering::Resume);
        }
    }

    fn steer(&self, wish: &Steering) -> Result<(), String> {
        let progress = self.progress();
        if progress.is_over {
            return Err("the run is over".to_owned());
        }
        if !progress.notice.is_steered {
            return Err("the run was not started with --steered".to_owned());
        }
        let steering = self.steering.lock().unwrap_or_else(PoisonError::into_inner);
        steering.send(*wish).map_err(|_| "the run is over".to_owned())
    }

    fn latencies(&self) -> Vec<(u64, f32)> {
        self.progress().latencies.clone()
    }
}

/// The steps, shared between who takes them and who looks at them.
struct Shared(Arc<Kept>);

impl Steps for Shared {
    fn range(&self) -> Option<(u64, u64)> {
        self.0.range()
    }

    fn step(&self, number: u64) -> Result<Option<Step>, String> {
        self.0.step(number)
    }

    fn last_until(&self, number: u64) -> Option<u64> {
        self.0.last_until(number)
    }
}

/// Begins to look at a run as soon as it is there, which it is to be within this time; `goes_on` says whether it can
/// still come, `waits` whether it begins only when told.
pub fn watch(
    name: &RunName,
    within: Duration,
    waits: bool,
    mut goes_on: impl FnMut() -> bool,
) -> Result<Arc<Run>, String> {
    let deadline = Instant::now() + within;
    // Ports of the run stay with one thread.
    let (opened, is_open) = channel();
    let (steering, to_give) = channel();
    let run_name = name.clone();
    let thread = std::thread::Builder::new().name("watch".to_owned());
    let (stop, stopped) = channel::<()>();
    thread.spawn(move || take(&run_name, &opened, &to_give, &stopped)).map_err(|error| error.to_string())?;
    loop {
        match is_open.recv_timeout(Duration::from_millis(20)) {
            Ok(Ok((metadata, scenario, kept, progress, whole))) => {
                let live = Going {
                    progress,
                    steering: Mutex::new(steering),
                    waits,
                    has_begun: AtomicBool::new(false),
                };
                let run = Run::new(
                    name.to_string(),
                    metadata,
                    scenario,
                    Box::new(Shared(kept)),
                    Some(Box::new(live)),
                );
                let run = Arc::new(run);
                whole.send(run.clone()).map_err(|_| "the run is over".to_owned())?;
                return Ok(run);
            }
            Ok(Err(error)) => return Err(error),
            Err(_) if !goes_on() => return Err(format!("run {name} ended before it could be looked at")),
            Err(_) if Instant::now() >= deadline => {
                drop(stop);
                return Err(format!("there is no run {name} that can be looked at"));
            }
            Err(_) => {}
        }
    }
}

type Opened = (Metadata, Arc<Scenario>, Arc<Kept>, Arc<Mutex<Progress>>, Sender<Arc<Run>>);

fn take(
    name: &RunName,
    opened: &Sender<Result<Opened, String>>,
    steering: &Receiver<Steering>,
    stopped: &Receiver<()>,
) {
    // The processes of the run go first.
    let _ = rustix::process::nice(Watched::NICENESS);
    let (watched, metadata, scenario) = loop {
        match Watched::find(name) {
            Ok(Some(opened)) => break opened,
            Ok(None) => {}
            Err(error) => {
                let _ = opened.send(Err(error.to_string()));
                return;
            }
        }
        if stopped.recv_timeout(Duration::from_millis(5))
            == Err(std::sync::mpsc::RecvTimeoutError::Disconnected)
        {
            return;
        }
    };
    let (kept, progress) = (Arc::new(Kept::default()), Arc::new(Mutex::new(Progress::default())));
    let (whole, is_whole) = channel();
    if opened.send(Ok((metadata, scenario, kept.clone(), progress.clone(), whole))).is_err() {
        return;
    }
    let Ok(run) = is_whole.recv() else { return };
    let ended = follow(&watched, &run, &kept, &progress, steering);
    run.index().is_complete = true;
    let mut progress = locked(&progress);
    progress.is_over = true;
    progress.problem = ended.err().map(|error| error.to_string());
}

/// Takes steps and notices, and steers, until the run is over.
fn follow(
    watched: &Watched,
    run: &Run,
    kept: &Kept,
    progress: &Mutex<Progress>,
    steering: &Receiver<Steering>,
) -> Result<(), ProcessError> {
    loop {
        let mut is_idle = true;
        let goes_on = watched.goes_on();
        while let Some((number, block)) = watched.step()? {
            is_idle = false;
            if let Ok(step) = Step::decode(block.bytes()) {
                kept.keep(number, block.bytes());
                run.index().take(&run.scenario, &step);
                if step.header.flags & ipc_schemas::FLAG_END_OF_RUN != 0 {
                    return Ok(());
                }
            }
        }
        while let Some(notice) = watched.notice()? {
            run.index().take_events(&notice.events);
            take_notice(&mut locked(progress), notice);
        }
        while let Ok(wish) = steering.try_recv() {
            watched.steer(&wish)?;
        }
        if is_idle {
            if !goes_on {
                return Ok(());
            }
            std::thread::sleep(Watched::LOOK);
        }
    }
}

fn take_notice(progress: &mut Progress, notice: Notice) {
    let latencies = (notice.first_latency..).zip(notice.latency_us.iter().copied());
    progress.latencies.extend(latencies);
    let surplus = progress.latencies.len().saturating_sub(MOST_LATENCIES);
    progress.latencies.drain(..surplus);
    progress.notice = notice;
}
