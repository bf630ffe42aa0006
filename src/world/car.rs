//! A vehicle as the world keeps it while it is in a zone or on a link.

use crate::vehicle::Held;

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
    /// Acceleration commanded for the coming step, once shielded, m/s^2.
    pub command_mps2: f64,
    /// Motion over the coming step, set by the vehicle's command (on a link: by its driver).
    pub held: Held,
    pub entry_time_s: f64,
    pub entry_speed_mps: f64,
    /// Broadcast intent from the last command.
    pub planned_exit_time_s: f64,
    pub planned_exit_speed_mps: f64,
    pub visit: Visit,
    /// Entered during the step just ended.
    pub entered: bool,
}

/// What is accounted while a vehicle is in a zone.
#[derive(Clone, Copy, Debug)]
pub(super) struct Visit {
    pub energy: f64,
    pub fe_s: f64,
    pub infeasible: bool,
    /// Whether all rear-end (merging) entry conditions held at the first sample in the zone.
    pub clean_rear_end: bool,
    pub clean_merge: bool,
    pub least_rear_end_m: f64,
    /// What the shield holds the vehicle to.
    pub rear_end: Guard,
    pub merge: Guard,
}

/// Whether a vehicle was safe toward a partner when it came to owe it something.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Guard {
    pub partner: Option<u32>,
    pub safe: bool,
}

impl Visit {
    pub(super) const NEW: Visit = Visit {
        energy: 0.0,
        fe_s: 0.0,
        infeasible: false,
        clean_rear_end: true,
        clean_merge: true,
        least_rear_end_m: f64::INFINITY,
        rear_end: Guard { partner: None, safe: false },
        merge: Guard { partner: None, safe: false },
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
            held: Held::new(0.0, entry_speed_mps, 0.0),
            entry_time_s,
            entry_speed_mps,
            planned_exit_time_s: 0.0,
            planned_exit_speed_mps: 0.0,
            visit: Visit::NEW,
            entered: true,
        }
    }
}

/// The vehicle that left a zone last (paper: index 0), in the zone's coordinate.
#[derive(Clone, Copy, Debug)]
pub(super) struct LeftCar {
    pub car: Car,
    /// Left during the step just ended.
    pub left_now: bool,
}
