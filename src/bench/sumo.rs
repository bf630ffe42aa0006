//! SUMO's own stepping, for comparison: a script runs it on the same corridors with its human drivers.

use super::BenchError;
use serde::{Deserialize, Serialize};
use std::process::{Command, Stdio};

const SCRIPT: &str = include_str!("sumo_corridors.py");

/// What the script measures between, s of simulated time: the corridors have filled up by the first.
const WINDOW_S: (f64, f64) = (60.0, 90.0);
/// Step, s; that of our corridors.
const STEP_S: f64 = 0.1;
/// Vehicles from which on a run takes minutes and is made only once.
const LARGE: usize = 50_000;
/// Runs of smaller networks; the fastest counts.
const REPEATS: u32 = 3;

/// SUMO, as found in a Python.
#[derive(Debug)]
pub struct Sumo {
    python: String,
    version: String,
}

/// What the script says when asked for nothing.
#[derive(Deserialize)]
struct Found {
    version: String,
}

/// SUMO's side of one size.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
pub struct SumoSide {
    /// Corridors of its network.
    pub corridors: usize,
    /// Mean number of vehicles in the network over the window.
    pub vehicles: f64,
    /// Mean time of a vehicle-step over the window, ns.
    pub ns_per_vehicle_step: f64,
}

impl Sumo {
    /// SUMO in the Python that `CZ_PYTHON` names, `python3` by default.
    pub fn find() -> Result<Sumo, BenchError> {
        let python = std::env::var("CZ_PYTHON").unwrap_or_else(|_| "python3".to_owned());
        let mut sumo = Sumo { python, version: String::new() };
        let found = sumo
            .call::<Found>(&[])
            .map_err(|reason| BenchError::NoSumo { python: sumo.python.clone(), reason })?;
        sumo.version = found.version;
        Ok(sumo)
    }

    /// Its version.
    pub fn version(&self) -> &str {
        &self.version
    }

    /// Steps about that many vehicles.
    pub fn measure(&self, vehicles: usize) -> Result<SumoSide, BenchError> {
        let repeats = if vehicles < LARGE { REPEATS } else { 1 };
        let (from_s, until_s) = WINDOW_S;
        let arguments = [
            vehicles.to_string(),
            STEP_S.to_string(),
            from_s.to_string(),
            until_s.to_string(),
            repeats.to_string(),
        ];
        self.call(&arguments).map_err(|reason| BenchError::Sumo { vehicles, reason })
    }

    /// Runs the script; `Err` with the last thing it said.
    fn call<T: for<'a> Deserialize<'a>>(&self, arguments: &[String]) -> Result<T, String> {
        let output = Command::new(&self.python)
            .args(["-c", SCRIPT])
            .args(arguments)
            .stdin(Stdio::null())
            .output()
            .map_err(|e| e.to_string())?;
        if output.status.success() {
            return serde_json::from_slice(&output.stdout).map_err(|e| e.to_string());
        }
        let said = String::from_utf8_lossy(&output.stderr);
        Err(said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no reason given").to_owned())
    }
}
