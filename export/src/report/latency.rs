//! How long steps took: from the summaries that `cz run --json` writes.

use serde::Deserialize;
use std::path::Path;

/// What a page shows of a summary.
#[derive(Clone, Debug)]
pub struct Latency {
    pub name: String,
    pub state_hash: String,
    pub processes: u32,
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    pub max_us: f64,
    pub deadlines: String,
    /// Upper ends, us, and numbers of steps.
    pub bins: Vec<(f64, u64)>,
}

#[derive(Deserialize)]
struct Summary {
    processes: u32,
    state_hash: String,
    step_latency_us: Quantiles,
    punctuality: Option<Punctuality>,
    #[serde(default)]
    step_latency_histogram: Vec<Bin>,
}

#[derive(Deserialize)]
struct Bin {
    up_to_us: f64,
    steps: u64,
}

#[derive(Deserialize)]
struct Quantiles {
    p50: f64,
    p99: f64,
    p999: f64,
    max: f64,
}

#[derive(Deserialize)]
struct Punctuality {
    deadline_us: f64,
    missed_steps: u64,
}

impl Latency {
    /// Reads a summary; the error names the file.
    pub fn read(path: &Path) -> Result<Latency, String> {
        let failed = |error: &dyn std::fmt::Display| format!("--summary {}: {error}", path.display());
        let text = std::fs::read_to_string(path).map_err(|error| failed(&error))?;
        let summary: Summary = serde_json::from_str(&text)
            .map_err(|error| failed(&format!("expected what `cz run --json` writes: {error}")))?;
        let deadlines = summary.punctuality.map_or_else(
            || "none".to_owned(),
            |p| format!("{:.0} µs, missed in {} steps", p.deadline_us, p.missed_steps),
        );
        let Quantiles { p50, p99, p999, max } = summary.step_latency_us;
        Ok(Latency {
            name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            state_hash: summary.state_hash,
            processes: summary.processes,
            p50_us: p50,
            p99_us: p99,
            p999_us: p999,
            max_us: max,
            deadlines,
            bins: summary.step_latency_histogram.iter().map(|bin| (bin.up_to_us, bin.steps)).collect(),
        })
    }
}
