//! @NAME@: goes for the terminal speed, and keeps its distance to all it must respect.

use control_zones_plugin::{Controller, Step, Summary, Vehicle, run, schemas::RunSpec};

struct Mine;

/// One acceleration, m/s^2.
fn decide(spec: &RunSpec, vehicle: &Vehicle<'_>) -> f64 {
    let (x, v) = (vehicle.state.x_m, vehicle.state.v_mps);
    let mut u = 0.6 * (vehicle.terminal_mps().unwrap_or(18.0) - v);
    for partner in vehicle.partners() {
        let gap = partner.x_m - x - partner.gap_m - spec.reaction_time_s * v;
        u = u.min(0.4 * gap + 1.2 * (partner.state.v_mps - v));
    }
    u.clamp(spec.u_min_mps2, spec.u_max_mps2)
}

impl Controller for Mine {
    fn step(&mut self, step: &Step<'_>, u_mps2: &mut [f64]) {
        for (u, vehicle) in u_mps2.iter_mut().zip(step.vehicles()) {
            *u = decide(&step.run().spec, &vehicle);
        }
    }

    fn on_end(&mut self, summary: &Summary) {
        println!("{} steps answered, {} passed without this controller", summary.answered, summary.skipped);
    }
}

fn main() -> std::process::ExitCode {
    match run(&mut Mine) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            std::process::ExitCode::FAILURE
        }
    }
}
