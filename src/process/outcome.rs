//! What a run comes to: its results, and how long its steps took.

use super::{PluginRow, Punctuality, Settled};
use crate::lockstep::{Awaited, RefusedFrames};
use crate::record::{RunEvent, RunEventKind};
use crate::scenario::ControllerNames;
use crate::world::{World, WorldSummary};
use hdrhistogram::Histogram;
use ipc_schemas::Role;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Percentiles of the time a step takes, from the state's publication to the end of integration, us.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LatencyUs {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// 99.9th percentile.
    pub p999: f64,
    /// Greatest.
    pub max: f64,
}

/// Steps whose latency was above the bin before and not above this.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LatencyBin {
    /// Upper end, us.
    pub up_to_us: f64,
    /// Number of steps.
    pub steps: u64,
}

/// What a finished run has come to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// The world's results.
    pub world: WorldSummary,
    /// Wall time of the stepping, s.
    pub wall_s: f64,
    /// Step latency.
    pub step_latency_us: LatencyUs,
    /// The same as a histogram: four bins to an octave, from the least to the greatest that has a step.
    #[serde(default)]
    pub step_latency_histogram: Vec<LatencyBin>,
    /// Latency of steps in which no coordinator acted, after a warm-up.
    pub steady_ns: Percentiles,
    /// Latency of steps in which one did, after a warm-up.
    pub event_ns: Percentiles,
    /// Peak resident memory of the process, bytes (0 where it cannot be known).
    pub peak_rss_bytes: u64,
    /// Processes that took the place of others.
    pub replacements: Vec<Replacement>,
    /// Frames that were not taken, by sender.
    pub refused: Vec<RefusedFrames>,
    /// Answers that came too late or twice.
    pub late_frames: u64,
    /// What happened to the run beside its steps, in order: the first thousand of it.
    #[serde(default)]
    pub events: Vec<RunEvent>,
    /// How controllers written elsewhere have fared.
    #[serde(default)]
    pub controllers: Vec<PluginRow>,
    /// How punctual the run was, where it had a schedule or deadlines.
    pub punctuality: Option<Punctuality>,
    /// Where each process was and what it was granted; filled in by who started them.
    #[serde(default)]
    pub placement: Vec<Settled>,
}

/// A process that took the place of one that had died.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Replacement {
    /// Role and index.
    pub participant: String,
    /// The place's generation since.
    pub generation: u32,
    /// Step during which it came.
    pub step: u64,
    /// How long that step took, ms.
    pub step_ms: f64,
}

/// Peak resident memory of this process, bytes.
fn peak_rss_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kib =
        status.lines().find_map(|l| l.strip_prefix("VmHWM:")?.trim().strip_suffix("kB")?.trim().parse().ok());
    kib.map_or(0, |kib: u64| kib * 1024)
}

/// Percentiles of a measured time, ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Percentiles {
    /// Median.
    pub p50: u64,
    /// 90th percentile.
    pub p90: u64,
    /// 99th percentile.
    pub p99: u64,
    /// 99.9th percentile.
    pub p999: u64,
    /// Greatest.
    pub max: u64,
    /// Number of measurements.
    pub count: u64,
}

impl Percentiles {
    /// Of a histogram.
    pub fn of(histogram: &Histogram<u64>) -> Percentiles {
        let at = |quantile| histogram.value_at_quantile(quantile);
        Percentiles {
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p999: at(0.999),
            max: histogram.max(),
            count: histogram.len(),
        }
    }
}

/// An empty latency histogram of three significant digits that grows as needed.
pub fn new_histogram() -> Histogram<u64> {
    let mut histogram = Histogram::new_with_bounds(1, AT_FIRST_NS, 3).expect("the bounds are valid");
    histogram.auto(true);
    // Writes to all of it, so that no page of it is missing when time is measured.
    histogram.clear();
    histogram
}

/// What a histogram has room for from the beginning, ns: a second.
const AT_FIRST_NS: u64 = 1_000_000_000;

/// Steps before the steady and event latencies are recorded: memory is mapped and caches fill.
pub const WARM_UP_STEPS: u64 = 500;

/// Measures how long steps take.
#[derive(Debug)]
pub(super) struct StepMeter {
    latency_ns: Histogram<u64>,
    steady_ns: Histogram<u64>,
    event_ns: Histogram<u64>,
    start: Instant,
    step_start: Instant,
}

impl StepMeter {
    pub(super) fn start() -> StepMeter {
        let now = Instant::now();
        StepMeter {
            latency_ns: new_histogram(),
            steady_ns: new_histogram(),
            event_ns: new_histogram(),
            start: now,
            step_start: now,
        }
    }

    /// A step begins now.
    pub(super) fn begin_step(&mut self, is_paced: bool) {
        if is_paced {
            self.step_start = Instant::now();
        }
    }

    /// Returns how long the step took, ns.
    pub(super) fn step_done(&mut self, was_event: bool) -> u64 {
        let now = Instant::now();
        let ns = (now - self.step_start).as_nanos() as u64;
        // The histograms resize themselves; only an absurd latency could not be recorded.
        let _ = self.latency_ns.record(ns);
        if self.latency_ns.len() > WARM_UP_STEPS {
            let _ = if was_event { &mut self.event_ns } else { &mut self.steady_ns }.record(ns);
        }
        self.step_start = now;
        ns
    }

    pub(super) fn outcome(&self, world: &World, history: History) -> Outcome {
        let us = |ns: u64| ns as f64 / 1e3;
        Outcome {
            world: world.summary(),
            wall_s: self.start.elapsed().as_secs_f64(),
            step_latency_us: LatencyUs {
                p50: us(self.latency_ns.value_at_quantile(0.5)),
                p99: us(self.latency_ns.value_at_quantile(0.99)),
                p999: us(self.latency_ns.value_at_quantile(0.999)),
                max: us(self.latency_ns.max()),
            },
            step_latency_histogram: bins(&self.latency_ns),
            steady_ns: Percentiles::of(&self.steady_ns),
            event_ns: Percentiles::of(&self.event_ns),
            peak_rss_bytes: peak_rss_bytes(),
            replacements: history.replacements,
            refused: history.refused,
            late_frames: history.late_frames,
            events: history.events,
            controllers: history.controllers,
            punctuality: history.punctuality,
            placement: Vec::new(),
        }
    }
}

/// A histogram's counts by bins whose ends have the ratio 2^(1/4).
fn bins(histogram: &Histogram<u64>) -> Vec<LatencyBin> {
    const FIRST_NS: u64 = 64;
    let bins = histogram.iter_log(FIRST_NS, 2.0_f64.powf(0.25)).map(|bin| LatencyBin {
        up_to_us: bin.value_iterated_to() as f64 / 1e3,
        steps: bin.count_since_last_iteration(),
    });
    bins.skip_while(|bin| bin.steps == 0).collect()
}

/// What happened to the participants of a run.
#[derive(Debug, Default)]
pub(super) struct History {
    pub replacements: Vec<Replacement>,
    pub refused: Vec<RefusedFrames>,
    pub late_frames: u64,
    pub events: Vec<RunEvent>,
    pub controllers: Vec<PluginRow>,
    pub punctuality: Option<Punctuality>,
}

/// Events kept of a run at most.
const MOST_EVENTS: usize = 1000;

/// What happens to a run, as it comes.
#[derive(Debug, Default)]
pub(super) struct Events {
    all: Vec<RunEvent>,
    /// The last step somebody missed, and who.
    missed: Option<(u64, String)>,
    /// Senders of whom frames were refused, by number.
    refused: usize,
}

impl Events {
    /// `controllers` are those it is about, one bit each.
    pub fn say(&mut self, step: u64, kind: RunEventKind, text: String, controllers: u64) {
        if self.all.len() < MOST_EVENTS {
            self.all.push(RunEvent { step, kind, text, controllers });
        }
    }

    /// Somebody was not in time; news only where it was the step before.
    pub fn missed(&mut self, awaited: &Awaited, names: &ControllerNames) {
        let (step, senders) = (awaited.step, awaited.senders(names));
        let is_news = self.missed.as_ref().is_none_or(|(last, who)| step > last + 1 || *who != senders);
        if is_news {
            let controllers = if awaited.role == Role::Controller { awaited.missing } else { 0 };
            self.say(step, RunEventKind::Missed, format!("not in time: {senders}"), controllers);
        }
        self.missed = Some((step, senders));
    }

    /// So many senders have sent what was refused; those not known yet are news.
    pub fn refused(&mut self, step: u64, senders: usize, report: impl FnOnce() -> Vec<RefusedFrames>) {
        if senders > self.refused {
            for refused in report().into_iter().skip(self.refused) {
                self.say(step, RunEventKind::Refused, refused.to_string(), 0);
            }
            self.refused = senders;
        }
    }

    /// Those behind so many.
    pub fn since(&self, told: usize) -> &[RunEvent] {
        self.all.get(told..).unwrap_or_default()
    }

    pub fn take(&mut self) -> Vec<RunEvent> {
        std::mem::take(&mut self.all)
    }
}
