//! Recordings of small runs, made in this process.

#![allow(dead_code)] // every test file uses its part of this
#![allow(clippy::unwrap_used)] // as in the tests themselves

use control_zones::lockstep::in_process::InProcess;
use control_zones::record::{FileSource, Metadata, Processes, Reader, RunEnd, ScenarioSource, Writer};
use control_zones::scenario::{Override, load};
use control_zones::world::WorldSummary;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tempfile::TempDir;

/// A recorded run and what its world said at the end.
pub struct Recording {
    directory: TempDir,
    pub path: PathBuf,
    pub summary: WorldSummary,
    /// Steps in the file, the last frame included.
    pub steps: u64,
    /// Energy of all completed visits, m^2/s^3.
    pub energy: f64,
    pub links: usize,
    pub dt_s: f64,
    pub beta: f64,
    pub u_min_mps2: f64,
    pub length_m: f64,
}

impl Recording {
    /// A run of an embedded scenario with some keys changed.
    pub fn of(scenario: &str, sets: &[&str]) -> Recording {
        Recording::seeded(scenario, sets, None)
    }

    /// The same with another seed.
    pub fn seeded(scenario: &str, sets: &[&str], seed: Option<u64>) -> Recording {
        let overrides: Vec<Override> = sets.iter().map(|set| set.parse().unwrap()).collect();
        let scenario = Arc::new(load(Some(scenario), &overrides, seed).unwrap());
        let source = ScenarioSource {
            overrides: sets.iter().map(|set| (*set).to_owned()).collect(),
            ..ScenarioSource::default()
        };
        // What coordinators tell each other is recorded where there are two of them.
        let count = scenario.network.zones.len().min(2) as u32;
        let processes = Processes { coordinators: count, controllers: count };
        let metadata = Metadata::new(&scenario, source, InProcess::RUN_ID, processes);
        let mut writer = Writer::new(Vec::new(), &metadata).unwrap();
        let mut process = InProcess::observed(&scenario, count, count);
        let mut steps = 0;
        loop {
            let goes_on = process.step().unwrap();
            process
                .frames(|frames| {
                    let mut block = Vec::new();
                    frames.encode_onto(&mut block);
                    writer.append(&block).unwrap();
                    steps += 1;
                })
                .unwrap();
            if !goes_on {
                break;
            }
        }
        let (bytes, _, _) = writer.finish(RunEnd::Finished, Vec::new()).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run.czlog");
        std::fs::write(&path, bytes).unwrap();
        let summary = process.world().summary();
        let exits = scenario.network.zones.iter().flat_map(|zone| &zone.exits);
        Recording {
            directory,
            path,
            energy: summary.zones.iter().map(|zone| zone.mean_energy * f64::from(zone.vehicles)).sum(),
            summary,
            steps,
            links: exits.filter(|exit| exit.to.is_some_and(|to| to.link_m > 0.0)).count(),
            dt_s: scenario.dt_s(),
            beta: scenario.beta,
            u_min_mps2: scenario.vehicle.u_min_mps2,
            length_m: scenario.vehicle.length_m,
        }
    }

    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    pub fn reader(&self) -> Reader<FileSource> {
        Reader::open(&self.path).unwrap()
    }
}
