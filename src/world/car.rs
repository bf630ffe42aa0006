//! A vehicle as the world keeps it while it is in a zone or on a link.

use crate::vehicle::Held;
use ipc_schemas::{NO_VEHICLE, VERDICT_NOMINAL};

/// One vehicle in one place.
#[derive(Clone, Copy, Debug)]
pub(super) struct Car {
    pub vehicle: u32,
    /// Approach within the zone.
    pub path: u32,
    /// Distance since the zone's (or link's) origin, m.
    pub x_m: f64,
    pub v_mps: f64,
    /// Acceleration an observer saw over the step just ended, m/s^2.
    pub u_mps2: f64,
    /// Acceleration held over the coming step, m/s^2: commanded, once shielded; of a vehicle that has left
    /// the zone, what it does elsewhere.
    pub command_mps2: f64,
    pub entry_time_s: f64,
    pub entry_speed_mps: f64,
    /// Broadcast intent from the last command.
    pub planned_exit_time_s: f64,
    pub planned_exit_speed_mps: f64,
    pub visit: Visit,
}

/// What is accounted while a vehicle is in a zone.
#[derive(Clone, Copy, Debug)]
pub(super) struct Visit {
    pub energy: f64,
    pub fe_s: f64,
    pub least_rear_end_m: f64,
    /// What the shield holds the vehicle to.
    pub rear_end: Guard,
    pub merge: Guard,
    /// Verdict of the command in force, a `frames::VERDICT_*`.
    pub verdict: u16,
    /// Entered during the step just ended.
    pub entered: bool,
    pub infeasible: bool,
    /// Whether the command in force was no number or beyond the limits as it came.
    pub beyond: bool,
    /// Whether all rear-end (merging) entry conditions held at the first sample in the zone.
    pub clean_rear_end: bool,
    pub clean_merge: bool,
}

/// Whether a vehicle was safe toward a partner when it came to owe it something.
#[derive(Clone, Copy, Debug)]
pub(super) struct Guard {
    /// `NO_VEHICLE` before the first.
    pub partner: u32,
    pub safe: bool,
}

impl Guard {
    const NONE: Guard = Guard { partner: NO_VEHICLE, safe: false };
}

impl Visit {
    pub(super) const NEW: Visit = Visit {
        energy: 0.0,
        fe_s: 0.0,
        least_rear_end_m: f64::INFINITY,
        rear_end: Guard::NONE,
        merge: Guard::NONE,
        entered: true,
        verdict: VERDICT_NOMINAL,
        infeasible: false,
        beyond: false,
        clean_rear_end: true,
        clean_merge: true,
    };
}

impl Car {
    /// A vehicle that passed a zone's (or link's) origin at `entry_time_s` with `entry_speed_mps`, and is
    /// at `x_m` with `v_mps` at the end of the step.
    pub(super) fn entering(vehicle: u32, path: u32, entry_time_s: f64, entry_speed_mps: f64) -> Car {
        Car {
            vehicle,
            path,
            x_m: 0.0,
            v_mps: entry_speed_mps,
            u_mps2: 0.0,
            command_mps2: 0.0,
            entry_time_s,
            entry_speed_mps,
            planned_exit_time_s: 0.0,
            planned_exit_speed_mps: 0.0,
            visit: Visit::NEW,
        }
    }

    /// Motion over the coming step.
    pub(super) fn held(&self) -> Held {
        Held::new(self.x_m, self.v_mps, self.command_mps2)
    }

    /// Moves the vehicle to the end of the step.
    pub(super) fn move_on(&mut self, held: &Held, dt_s: f64) {
        self.x_m = held.position_m(dt_s);
        self.v_mps = held.speed_mps(dt_s);
        self.u_mps2 = held.observed_mps2(dt_s);
    }
}
