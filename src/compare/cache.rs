//! Results of runs, kept by what they depend on: scenario with seed, and program.

use super::CompareError;
use super::sample::Sample;
use crate::bounds::{Bounds, Traffic, joint};
use crate::reproduce::ReproduceError;
use crate::scenario::{Scenario, scenario_hash};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64;

/// A directory of results, or none.
#[derive(Clone, Debug)]
pub struct Cache {
    directory: Option<PathBuf>,
    /// Hash of the program.
    build: u64,
}

impl Cache {
    /// Nothing is kept.
    pub fn none() -> Cache {
        Cache { directory: None, build: 0 }
    }

    /// Results are kept in a directory, which is made if need be.
    pub fn at(directory: &Path) -> Result<Cache, CompareError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| ReproduceError::Write { path, source }
        };
        std::fs::create_dir_all(directory).map_err(failed(directory))?;
        let program = std::env::current_exe().map_err(failed(directory))?;
        let build = xxh3_64(&std::fs::read(&program).map_err(failed(&program))?);
        Ok(Cache { directory: Some(directory.to_owned()), build })
    }

    /// What a scenario's run shows, from the directory or from a run.
    pub fn sample(&self, scenario: &Arc<Scenario>, what: &str) -> Result<Sample, CompareError> {
        let file = format!("run-{:016x}-{:016x}.json", scenario_hash(scenario), self.build);
        self.kept(&file, || Ok(Sample::of(scenario, &format!("policy {what}, seed {}", scenario.seed))?))
    }

    /// The rigorous bounds for a sample's vehicles, from the directory or worked out.
    pub fn bounds(&self, scenario: &Scenario, sample: &Sample) -> Result<Bounds, CompareError> {
        let entrants = sample.entrants();
        let key = serde_json::to_vec(&(&entrants, &scenario.network.zones, scenario.beta, scenario.vehicle));
        let key = xxh3_64(&key.expect("lists and tables with string keys"));
        self.kept(&format!("bounds-{key:016x}-{:016x}.json", self.build), || {
            Ok(Traffic { scenario, entrants: &entrants }.bounds())
        })
    }

    /// The centralised optimum for a sample's order, from the directory or sought.
    pub fn joint(&self, scenario: &Scenario, sample: &Sample) -> Result<Option<joint::Found>, CompareError> {
        let order = serde_json::to_vec(sample).expect("a sample has string keys only");
        let file = format!("joint-{:016x}-{:016x}.json", xxh3_64(&order), self.build);
        self.kept(&file, || {
            if !sample.complete {
                return Ok(None);
            }
            let entrants = sample.entrants();
            let exposure_ms = sample.zones.iter().map(|zone| zone.exposure_ms).sum();
            Ok(joint::seek(&Traffic { scenario, entrants: &entrants }, &sample.courses(), exposure_ms))
        })
    }

    fn kept<T: Serialize + DeserializeOwned>(
        &self,
        file: &str,
        make: impl FnOnce() -> Result<T, CompareError>,
    ) -> Result<T, CompareError> {
        let Some(directory) = &self.directory else { return make() };
        let path = directory.join(file);
        // What cannot be read is done again.
        if let Some(value) = std::fs::read(&path).ok().and_then(|text| serde_json::from_slice(&text).ok()) {
            return Ok(value);
        }
        let value = make()?;
        let text = serde_json::to_vec(&value).expect("results have string keys only");
        // Whole or not at all, whoever else writes or interrupts.
        let partial = directory.join(format!("{file}.{}", std::process::id()));
        let written = std::fs::write(&partial, text).and_then(|()| std::fs::rename(&partial, &path));
        written.map_err(|source| ReproduceError::Write { path, source })?;
        Ok(value)
    }
}
