//! How a run is shared out, waits, keeps time and replaces.

use crate::app::AppError;
use crate::process::{OnMiss, Pace, Placement, RecordLag, Timing, WaitMode};
use crate::scenario::Scenario;
use crate::scenario::share::{MAX_CONTROLLERS, MAX_COORDINATORS};
use clap::{Args, ValueEnum};
use std::time::Duration;

/// Into how many processes coordination and control are divided.
#[derive(Clone, Copy, Debug, Args)]
pub(in crate::app) struct ShareArgs {
    /// Number of controller processes; zones are shared out evenly.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_CONTROLLERS)))]
    pub ctrl_procs: u32,
    /// Number of coordinator processes; zones are shared out evenly.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_COORDINATORS)))]
    pub coord_procs: u32,
}

impl ShareArgs {
    /// Refuses more processes than there are zones to share out.
    pub fn check(&self, scenario: &Scenario) -> Result<(), AppError> {
        let zones = scenario.network.zones.len() as u32;
        for (name, count) in [("--ctrl-procs", self.ctrl_procs), ("--coord-procs", self.coord_procs)] {
            if count > zones {
                let scenario = &scenario.name;
                return Err(AppError::Usage(format!(
                    "{name} {count}: expected at most {zones}, the number of zones of scenario {scenario}"
                )));
            }
        }
        let (controllers, plugins) = (scenario.controllers(self.ctrl_procs), scenario.plugins.len());
        if controllers > MAX_CONTROLLERS {
            return Err(AppError::Usage(format!(
                "--ctrl-procs {}: with the scenario's {plugins} controllers, expected at most {MAX_CONTROLLERS}",
                self.ctrl_procs
            )));
        }
        Ok(())
    }
}

/// Bounds of all waiting.
#[derive(Clone, Copy, Debug, Args)]
pub(in crate::app) struct WaitArgs {
    /// How long to wait for the other processes of the run to appear, s.
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = seconds)]
    pub attach_timeout: Duration,
    /// How long to wait for a frame before giving the run up, s.
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = seconds)]
    pub peer_timeout: Duration,
    /// Pin the processes to cores.
    #[arg(long, value_enum, default_value_t = Placement::None)]
    pub pin: Placement,
    /// Ask for real-time scheduling (SCHED_FIFO) and locked memory, and say what was granted.
    #[arg(long)]
    pub rt: bool,
}

impl WaitArgs {
    /// Whether anything is asked of the system of which it is worth saying what was granted.
    pub fn asks_for_placement(&self) -> bool {
        self.rt || self.pin != Placement::None
    }

    /// As a process of the run is given them.
    pub fn to_flags(self) -> Vec<String> {
        let seconds = |d: Duration| d.as_secs_f64().to_string();
        let mut flags = vec!["--attach-timeout".to_owned(), seconds(self.attach_timeout)];
        flags.extend(["--peer-timeout".to_owned(), seconds(self.peer_timeout)]);
        flags.extend(["--pin".to_owned(), name_of(self.pin)]);
        flags.extend(self.rt.then(|| "--rt".to_owned()));
        flags
    }
}

fn seconds(text: &str) -> Result<Duration, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s <= 86_400.0 => Ok(Duration::from_secs_f64(s)),
        _ => Err("expected a number of seconds > 0 and <= 86400".to_owned()),
    }
}

/// When steps begin, and what becomes of late ones.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(in crate::app) struct TimingArgs {
    /// Begin each step as soon as the one before is done, or at its instant in real time.
    #[arg(long, value_enum, default_value_t = Pace::Free)]
    pub pace: Pace,
    /// Time a step may take [default: with `--pace realtime` the step length, otherwise any].
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub deadline: Option<Duration>,
    /// What to do about controllers that have not answered by the deadline.
    #[arg(long, value_enum, default_value_t = OnMiss::Wait)]
    pub on_miss: OnMiss,
}

impl TimingArgs {
    /// What they mean.
    pub fn timing(&self) -> Result<Timing, AppError> {
        let TimingArgs { pace, deadline, on_miss } = *self;
        if on_miss != OnMiss::Wait && pace == Pace::Free && deadline.is_none() {
            let problem =
                "--on-miss: without a deadline nothing is missed; add --pace realtime or --deadline";
            return Err(AppError::Usage(problem.to_owned()));
        }
        Ok(Timing { pace, deadline, on_miss })
    }

    /// Whether anything is asked for.
    pub fn is_given(&self) -> bool {
        self.pace != Pace::Free || self.deadline.is_some()
    }

    /// As a process of the run is given them.
    pub fn to_flags(self) -> Vec<String> {
        let mut flags = vec!["--pace".to_owned(), name_of(self.pace)];
        flags.extend(["--on-miss".to_owned(), name_of(self.on_miss)]);
        flags.extend(self.deadline.map(|d| format!("--deadline={}", d.as_secs_f64())));
        flags
    }
}

/// What becomes of a run when a participant dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(in crate::app) enum Restart {
    /// It ends.
    Never,
    /// Another process takes its place and goes on to the same result.
    OnFailure,
}

/// What whoever looks may do.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(in crate::app) struct SteeringArgs {
    /// Let a view pause the run, have it make single steps, and set its pace.
    #[arg(long)]
    pub steered: bool,
    /// Begin only when the view says so.
    #[arg(long, hide = true, requires = "steered")]
    pub begin_paused: bool,
}

/// How the processes of a run wait, keep time, and what becomes of those that die.
#[derive(Clone, Copy, Debug, Args)]
pub(in crate::app) struct ConductArgs {
    #[command(flatten)]
    pub wait: WaitArgs,
    /// How the processes of the run wait for frames.
    #[arg(long = "wait", value_enum, default_value_t = WaitMode::Adaptive)]
    pub wait_mode: WaitMode,
    /// What becomes of the run when a coordinator or a process of the built-in pool dies.
    #[arg(long, value_enum, default_value_t = Restart::OnFailure)]
    pub restart: Restart,
    #[command(flatten)]
    pub timing: TimingArgs,
    #[command(flatten)]
    pub steering: SteeringArgs,
    /// What becomes of a step that cannot be recorded in time: the run waits, or the recording lacks it
    /// [default: wait; with a deadline: drop].
    #[arg(long, value_enum)]
    pub record_lag: Option<RecordLag>,
}

impl ConductArgs {
    /// As the world of the run is given them.
    pub fn to_flags(self) -> Vec<String> {
        let mut flags = self.wait.to_flags();
        flags.extend(["--wait".to_owned(), name_of(self.wait_mode)]);
        flags.extend(["--restart".to_owned(), name_of(self.restart)]);
        flags.extend(self.timing.to_flags());
        flags.extend(["--record-lag".to_owned(), name_of(self.record_lag())]);
        flags.extend(self.steering.steered.then(|| "--steered".to_owned()));
        flags.extend(self.steering.begin_paused.then(|| "--begin-paused".to_owned()));
        flags
    }

    /// What becomes of steps that cannot be recorded in time.
    pub fn record_lag(&self) -> RecordLag {
        let keeps_time = self.timing.is_given();
        self.record_lag.unwrap_or(if keeps_time { RecordLag::Drop } else { RecordLag::Wait })
    }
}

/// A choice as it is written on the command line.
fn name_of(choice: impl ValueEnum) -> String {
    choice.to_possible_value().map_or_else(String::new, |v| v.get_name().to_owned())
}
