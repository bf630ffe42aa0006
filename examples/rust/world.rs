//! A world of one's own: vehicles that hold their accelerations exactly, moved by this program.
//!
//!     cargo build --release --example world
//!     cz world check -- target/release/examples/world
//!     cz run intersection --world target/release/examples/world
//!     target/release/examples/world run intersection --in-process

use control_zones::scenario::Scenario;
use control_zones::world::{Admitted, Coming, Done, Newcomer, Task, Traffic, TrafficError};
use std::collections::BTreeMap;
use std::process::ExitCode;

/// Vehicles as points with a speed; the scenario's own roads and gates let them in.
#[derive(Debug, Default)]
pub struct Points {
    dt_s: f64,
    speeds_mps: BTreeMap<u32, f64>,
}

impl Points {
    /// How fast a vehicle is, m/s; 0 when it is not there.
    pub fn v_mps(&self, vehicle: u32) -> f64 {
        self.speeds_mps.get(&vehicle).copied().unwrap_or(0.0)
    }
}

impl Traffic for Points {
    fn name(&self) -> String {
        "points".to_owned()
    }

    fn begin(&mut self, scenario: &Scenario) {
        self.dt_s = scenario.dt_s();
    }

    fn brings(&self) -> bool {
        false
    }

    fn step(
        &mut self,
        _step: u64,
        tasks: &[Task],
        done: &mut [Done],
        _newcomers: &mut Vec<Newcomer>,
    ) -> Result<Coming, TrafficError> {
        for (task, done) in tasks.iter().zip(done) {
            let unknown = || TrafficError(format!("vehicle {} was never let in", task.vehicle));
            let v_mps = self.speeds_mps.get_mut(&task.vehicle).ok_or_else(unknown)?;
            *done = moved(*v_mps, if task.is_held == 1 { task.u_mps2 } else { 0.0 }, self.dt_s);
            *v_mps = done.v_mps;
        }
        // Whoever is asked about no more is there no more.
        self.speeds_mps.retain(|vehicle, _| tasks.binary_search_by_key(vehicle, |task| task.vehicle).is_ok());
        Ok(Coming::Nobody)
    }

    fn admit(&mut self, vehicles: &mut [Admitted]) -> Result<(), TrafficError> {
        self.speeds_mps.extend(vehicles.iter().map(|admitted| (admitted.vehicle, admitted.v_mps)));
        Ok(())
    }
}

/// What a held acceleration comes to over a step; it stops rather than reverse.
pub fn moved(v_mps: f64, u_mps2: f64, dt_s: f64) -> Done {
    let end_mps = v_mps + u_mps2 * dt_s;
    if end_mps < 0.0 {
        return Done { advanced_m: v_mps * v_mps / (-2.0 * u_mps2), v_mps: 0.0 };
    }
    Done { advanced_m: 0.5 * (v_mps + end_mps) * dt_s, v_mps: end_mps }
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    ExitCode::from(control_zones::app::played(&arguments, Box::<Points>::default()))
}
