//! Results of runs, kept by what they depend on: scenario with seed, and program.

use super::CompareError;
use super::sample::Sample;
use crate::bounds::{Bounds, Traffic, joint};
use crate::encoding;
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
        let failed = |source| ReproduceError::Write { path: directory.to_owned(), source };
        std::fs::create_dir_all(directory).map_err(failed)?;
        Ok(Cache { directory: Some(directory.to_owned()), build: own_build()? })
    }

    /// The hash of the program whose results these are.
    pub fn build(&self) -> String {
        format!("{:016x}", self.build)
    }

    /// The name of the file that keeps what this program found by what this hash is of.
    pub fn file(&self, what: &str, hash: u64) -> String {
        format!("{what}-{hash:016x}-{:016x}.cbor", self.build)
    }

    /// What a scenario's run shows, from the directory or from a run.
    pub fn sample(&self, scenario: &Arc<Scenario>, what: &str) -> Result<Sample, CompareError> {
        let make = || Ok(Sample::of(scenario, &format!("policy {what}, seed {}", scenario.seed))?);
        self.kept(&self.file("run", scenario_hash(scenario)), make)
    }

    /// The rigorous bounds for a sample's vehicles, from the directory or worked out.
    pub fn bounds(&self, scenario: &Scenario, sample: &Sample) -> Result<Bounds, CompareError> {
        let entrants = sample.entrants();
        let key = bytes(&(&entrants, &scenario.network.zones, scenario.beta, scenario.vehicle));
        self.kept(&self.file("bounds", xxh3_64(&key)), || {
            Ok(Traffic { scenario, entrants: &entrants }.bounds())
        })
    }

    /// The centralised optimum for a sample's order, from the directory or sought.
    pub fn joint(&self, scenario: &Scenario, sample: &Sample) -> Result<Option<joint::Found>, CompareError> {
        self.kept(&self.file("joint", xxh3_64(&bytes(sample))), || {
            if !sample.complete {
                return Ok(None);
            }
            let entrants = sample.entrants();
            let exposure_ms = sample.zones.iter().map(|zone| zone.exposure_ms).sum();
            Ok(joint::seek(&Traffic { scenario, entrants: &entrants }, &sample.courses(), exposure_ms))
        })
    }

    /// What this file keeps, if it is there and whole.
    pub fn find<T: DeserializeOwned>(&self, file: &str) -> Option<T> {
        let path = self.directory.as_ref()?.join(file);
        encoding::kept(&std::fs::read(path).ok()?).ok()
    }

    /// Has this file keep [`bytes`].
    pub fn put(&self, file: &str, bytes: &[u8]) -> Result<(), CompareError> {
        let Some(directory) = &self.directory else { return Ok(()) };
        let path = directory.join(file);
        // Whole or not at all, whoever else writes or interrupts.
        let partial = directory.join(format!("{file}.{}", std::process::id()));
        let written = std::fs::write(&partial, bytes).and_then(|()| std::fs::rename(&partial, &path));
        Ok(written.map_err(|source| ReproduceError::Write { path, source })?)
    }

    fn kept<T: Serialize + DeserializeOwned>(
        &self,
        file: &str,
        make: impl FnOnce() -> Result<T, CompareError>,
    ) -> Result<T, CompareError> {
        // What cannot be read is done again.
        if let Some(value) = self.find(file) {
            return Ok(value);
        }
        let value = make()?;
        self.put(file, &bytes(&value))?;
        Ok(value)
    }
}

/// A value as it is kept: numbers come back as they were, to the last bit.
pub fn bytes(value: &impl Serialize) -> Vec<u8> {
    let mut bytes = Vec::new();
    encoding::keep_onto(&mut bytes, value);
    bytes
}

/// The hash of this program.
pub fn own_build() -> Result<u64, CompareError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| ReproduceError::Write { path, source }
    };
    let program = std::env::current_exe().map_err(failed(Path::new("this program")))?;
    Ok(xxh3_64(&std::fs::read(&program).map_err(failed(&program))?))
}
