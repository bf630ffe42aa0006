//! The least a controller can be: hold 15 m/s. Run it with the shield on.

use control_zones_plugin::{Controller, Step, run};

struct Cruise;

impl Controller for Cruise {
    fn step(&mut self, step: &Step<'_>, u_mps2: &mut [f64]) {
        let spec = &step.run().spec;
        for (u, vehicle) in u_mps2.iter_mut().zip(step.vehicles()) {
            *u = (15.0 - vehicle.state.v_mps).clamp(spec.u_min_mps2, spec.u_max_mps2);
        }
    }
}

fn main() -> std::process::ExitCode {
    match run(&mut Cruise) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            std::process::ExitCode::FAILURE
        }
    }
}
