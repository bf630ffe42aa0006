//! A run that is looked at: a recording, or one that goes on.

use crate::index::Index;
use crate::network::NetworkView;
use crate::steps::Steps;
use control_zones::process::Steering;
use control_zones::record::{FileSource, Metadata, Reader};
use control_zones::scenario::Scenario;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What goes beyond a recording: a run that goes on.
pub trait Live: Send + Sync {
    /// How it goes, as the page is told.
    fn status(&self) -> Value;
    /// Lets it begin, if it waits for somebody to look.
    fn begin(&self);
    /// Steers it, or says why it cannot be.
    fn steer(&self, steering: &Steering) -> Result<(), String>;
    /// How long steps took: first step of each stretch, and nanoseconds.
    fn latencies(&self) -> Vec<(u64, f32)>;
}

/// A run that is looked at.
pub struct Run {
    /// What it is called.
    pub name: String,
    /// What it is of.
    pub metadata: Metadata,
    /// Its scenario.
    pub scenario: Arc<Scenario>,
    /// Its steps.
    pub steps: Box<dyn Steps>,
    /// What is known besides.
    index: Mutex<Index>,
    /// Where it goes on.
    pub live: Option<Box<dyn Live>>,
}

impl std::fmt::Debug for Run {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Run").field("name", &self.name).finish_non_exhaustive()
    }
}

/// Steps between two looks of the page at what is known.
const AT_ONCE: usize = 64;

impl Run {
    /// Opens a recording and begins to read it through.
    pub fn open(path: &Path) -> Result<Arc<Run>, String> {
        let failed = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
        let reader = Reader::open(path).map_err(|error| failed(&error))?;
        // Twice: one to be read through from beginning to end, the other here and there.
        let through = Reader::open(path).map_err(|error| failed(&error))?;
        let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let (metadata, scenario) = (reader.metadata().clone(), reader.scenario().clone());
        let run = Arc::new(Run::new(name, metadata, scenario, Box::new(reader), None));
        let reading = run.clone();
        std::thread::Builder::new()
            .name("read".to_owned())
            .spawn(move || reading.read(&through))
            .map_err(|error| failed(&error))?;
        Ok(run)
    }

    /// A run of which nothing is known yet.
    pub fn new(
        name: String,
        metadata: Metadata,
        scenario: Arc<Scenario>,
        steps: Box<dyn Steps>,
        live: Option<Box<dyn Live>>,
    ) -> Run {
        let index = Mutex::new(Index::new(&scenario));
        Run { name, metadata, scenario, steps, index, live }
    }

    fn read(&self, reader: &Reader<FileSource>) {
        let mut steps = reader.steps();
        loop {
            let some: Vec<_> = steps.by_ref().take(AT_ONCE).collect();
            let mut index = self.index();
            if some.is_empty() {
                index.take_events(reader.events());
                index.is_complete = true;
                return;
            }
            // What is damaged is missing, and the next step says so.
            some.iter().flatten().for_each(|step| index.take(&self.scenario, step));
        }
    }

    /// What is known of it.
    pub fn index(&self) -> MutexGuard<'_, Index> {
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What it is of, for the page.
    pub fn describe(&self) -> Value {
        let Metadata { seed, overrides, coordinators, controllers, build, scenario_hash, .. } =
            &self.metadata;
        let vehicle = &self.scenario.vehicle;
        json!({
            "name": self.name,
            "is_live": self.live.is_some(),
            "scenario": self.scenario.name,
            "scenario_hash": format!("{scenario_hash:016x}"),
            "seed": seed,
            "overrides": overrides,
            "coordinators": coordinators,
            "controllers": controllers,
            "build": build.to_string(),
            "dt_s": self.scenario.dt_s(),
            "beta": self.scenario.beta,
            "v_max_mps": self.scenario.fleet.iter().map(|k| k.vehicle.v_max_mps).fold(vehicle.v_max_mps, f64::max),
            "u_min_mps2": vehicle.u_min_mps2,
            "u_max_mps2": vehicle.u_max_mps2,
            "network": NetworkView::of(&self.scenario),
        })
    }

    /// How far it is, for the page.
    pub fn status(&self) -> Value {
        let range = self.steps.range();
        // Before the index is locked: whoever takes notices locks one after the other.
        let live = self.live.as_ref().map(|live| live.status());
        let index = self.index();
        json!({
            "first": range.map(|(first, _)| first),
            "last": range.map(|(_, last)| last),
            "known": index.lines.last().map(|line| line.step),
            "is_complete": index.is_complete,
            "skipped": index.skipped,
            "vehicles": index.vehicles.len(),
            "events": index.events.len(),
            "live": live,
        })
    }
}
