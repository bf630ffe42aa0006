//! Worlds that break the contract, one way per mode: what `cz world check` is tested with.

use crate::world::Points;
use control_zones::scenario::Scenario;
use control_zones::world::{Admitted, Coming, Done, Newcomer, Task, Traffic, TrafficError};
use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// The step in which what happens once happens.
const BREAKS_AT: u64 = 150;
const FOR_EVER: Duration = Duration::from_secs(600);

#[derive(Debug)]
struct Broken {
    mode: String,
    points: Points,
    dt_s: f64,
}

impl Traffic for Broken {
    fn name(&self) -> String {
        "broken".to_owned()
    }

    fn begin(&mut self, scenario: &Scenario) {
        self.dt_s = scenario.dt_s();
        self.points.begin(scenario);
    }

    fn brings(&self) -> bool {
        ["brings-two", "brings-nobody"].contains(&&*self.mode)
    }

    fn step(
        &mut self,
        step: u64,
        tasks: &[Task],
        done: &mut [Done],
        newcomers: &mut Vec<Newcomer>,
    ) -> Result<Coming, TrafficError> {
        let (mode, dt_s) = (&*self.mode, self.dt_s);
        if mode == "brings-nobody" {
            return Ok(Coming::Nobody);
        }
        if mode == "brings-two" {
            done.fill(Done { advanced_m: 15.0 * dt_s, v_mps: 15.0 });
            let one = Newcomer { x_m: 1.0, v_mps: 15.0, is_commanded: 0, ..Newcomer::default() };
            newcomers.extend(
                (step == BREAKS_AT).then_some([one, Newcomer { x_m: 2.0, ..one }]).into_iter().flatten(),
            );
            return Ok(Coming::More);
        }
        let mut tasks = tasks.to_vec();
        match mode {
            "disobeys" => tasks.iter_mut().for_each(|task| task.u_mps2 *= 0.9),
            "hangs" if step == BREAKS_AT => std::thread::sleep(FOR_EVER),
            "fails" if step == BREAKS_AT => return Err(TrafficError("the road is closed".to_owned())),
            _ => {}
        }
        let before: Vec<f64> = tasks.iter().map(|task| self.points.v_mps(task.vehicle)).collect();
        let coming = self.points.step(step, &tasks, done, newcomers)?;
        let held = tasks.iter().position(|task| task.is_held == 1);
        match (mode, held) {
            // To a standstill over the whole step, not as hard as told.
            ("stops-late", _) => {
                done.iter_mut().zip(&before).filter(|(done, _)| done.v_mps == 0.0).for_each(
                    |(done, v_mps)| {
                        done.advanced_m = 0.5 * v_mps * dt_s;
                    },
                );
            }
            // v += u dt, then x += v dt.
            ("euler", _) => done.iter_mut().for_each(|done| done.advanced_m = done.v_mps * dt_s),
            ("creeps", _) => done.iter_mut().for_each(|done| done.v_mps = done.v_mps.max(0.2)),
            ("jumps", Some(at)) if step == BREAKS_AT => done[at].advanced_m += 2.0,
            ("loses", Some(at)) if step == BREAKS_AT => done[at] = Done::GONE,
            ("reverses", Some(at)) if step == BREAKS_AT => done[at].advanced_m = -1.0,
            ("no-number", Some(at)) if step == BREAKS_AT => done[at].v_mps = f64::NAN,
            ("random", Some(at)) if done[at].v_mps > 1.0 => {
                done[at].advanced_m += 1e-3 * (RandomState::new().hash_one(0) % 2) as f64
            }
            _ => {}
        }
        Ok(coming)
    }

    fn admit(&mut self, vehicles: &mut [Admitted]) -> Result<(), TrafficError> {
        self.points.admit(vehicles)
    }
}

/// Plays such a world, and ends this process.
pub fn play(mode: &str, arguments: &[String]) -> ! {
    if mode == "crashes" {
        std::process::abort();
    }
    let traffic = Broken { mode: mode.to_owned(), points: Points::default(), dt_s: 0.0 };
    let code = control_zones::app::played(arguments, Box::new(traffic));
    match mode {
        "always-0" => std::process::exit(0),
        "ends-badly" => std::process::exit(3),
        "never-ends" => std::thread::sleep(FOR_EVER),
        _ => {}
    }
    std::process::exit(code.into())
}
