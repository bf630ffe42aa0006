//! How far a run is, and the bar that shows it.

use crate::scenario::Scenario;
use crate::world::World;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// How far a run is.
#[derive(Clone, Copy, Debug, serde::Serialize, serde::Deserialize)]
pub(super) struct Position {
    pub step: u64,
    pub arrived: u32,
    pub departed: u32,
}

impl Position {
    pub fn of(world: &World) -> Position {
        let departed = world.departed();
        Position { step: world.step(), arrived: world.arrived(), departed }
    }
}

/// The progress bar: vehicles when their number is known, simulated time otherwise.
pub(super) struct Bar {
    bar: ProgressBar,
    by_vehicle: bool,
    dt_s: f64,
}

impl Bar {
    pub fn new(scenario: &Scenario) -> Bar {
        let length = scenario.max_vehicles.map_or(scenario.max_time_s as u64, u64::from);
        // Hidden by itself when stderr is no terminal.
        let bar = ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::stderr());
        let style = "{msg} [{wide_bar}] {percent}% {eta}";
        bar.set_style(ProgressStyle::with_template(style).expect("the template is well formed"));
        Bar { bar, by_vehicle: scenario.max_vehicles.is_some(), dt_s: scenario.dt_s() }
    }

    pub fn show(&self, position: Position) {
        let time_s = position.step as f64 * self.dt_s;
        self.bar.set_position(if self.by_vehicle { u64::from(position.departed) } else { time_s as u64 });
        let inside = position.arrived - position.departed;
        self.bar.set_message(format!("step {}, {time_s:.0} s, {inside} vehicles", position.step));
    }

    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
