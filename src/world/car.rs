//! A vehicle as the world keeps it while it is in a zone or on a link.

use super::way::Way;
use crate::scenario::{HumanParams, Scenario};
use crate::vehicle::Held;
use ipc_schemas::VERDICT_NOMINAL;

/// One vehicle in one place.
#[derive(Clone, Copy, Debug)]
pub(super) struct Car {
    pub vehicle: u32,
    /// Path within the zone.
    pub path: u32,
    /// The next zone, `u32::MAX` when it leaves the network.
    pub next_zone: u32,
    /// Path within the next zone, `u32::MAX` when it leaves the network; and in the one after that.
    pub next_path: u32,
    pub then_path: u32,
    /// Index of the road's route, `u32::MAX` when its paths are drawn.
    pub route: u32,
    /// Road it came by.
    pub road: u32,
    /// Zones passed before this one.
    pub hop: u16,
    /// Kind of vehicle: index in the scenario's fleet.
    pub kind: u16,
    /// Whether it does what it is commanded; otherwise somebody else drives it.
    pub is_commanded: bool,
    /// It has been taken out where it was: nobody knows anything of it any more.
    pub is_gone: bool,
    /// Of a vehicle that has left the zone: the last zone and exit by which it is known to have left since, and
    /// the exit it will leave the next one by.
    pub beyond: Beyond,
    /// Where its duties are among its zone's.
    pub owed: (u32, u32),
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

/// How far a vehicle that has left a zone is known to have come.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Beyond {
    pub zone: u32,
    pub exit: u32,
    /// The exit of the zone behind that one, once it has been seen there.
    pub next_exit: u32,
}

/// What is accounted while a vehicle is in a zone.
#[derive(Clone, Copy, Debug)]
pub(super) struct Visit {
    pub energy: f64,
    pub fe_s: f64,
    /// Time it waited outside before it entered, s.
    pub wait_s: f64,
    /// Integral over time of what its rear-end margin lacks, m s.
    pub exposure_m_s: f64,
    pub least_rear_end_m: f64,
    pub least_merge_m: f64,
    pub least_cross_m: f64,
    /// Verdict of the command in force, a `frames::VERDICT_*`.
    pub verdict: u16,
    /// Entered during the step just ended.
    pub entered: bool,
    /// Driven by a human who does not follow the passing order, and passed a conflict point in it, or came to wait, still
    /// waits after a while, or waits no more.
    pub passes: bool,
    /// Such a human waits: it has stood for so long with a conflict point ahead, or is behind one on its lane that has.
    pub waits: bool,
    /// Steps for which such a human has stood.
    pub stands: u32,
    pub infeasible: bool,
    /// Whether the command in force was no number or beyond the limits as it came.
    pub beyond: bool,
    /// Whether it was viable toward each leader (each vehicle that passes a point before it) when it came to owe it
    /// something.
    pub clean_rear_end: bool,
    pub clean_merge: bool,
}

impl Visit {
    pub(super) const NEW: Visit = Visit {
        energy: 0.0,
        fe_s: 0.0,
        wait_s: 0.0,
        exposure_m_s: 0.0,
        least_rear_end_m: f64::INFINITY,
        least_merge_m: f64::INFINITY,
        least_cross_m: f64::INFINITY,
        entered: true,
        passes: false,
        waits: false,
        stands: 0,
        verdict: VERDICT_NOMINAL,
        infeasible: false,
        beyond: false,
        clean_rear_end: true,
        clean_merge: true,
    };
}

impl Car {
    /// A vehicle that passed its first zone's origin at `entry_time_s` with `entry_speed_mps`.
    pub(super) fn arriving(
        vehicle: u32,
        way: Way,
        kind: u16,
        entry_time_s: f64,
        entry_speed_mps: f64,
    ) -> Car {
        Car {
            vehicle,
            path: way.path,
            next_zone: way.next_zone,
            next_path: way.next_path,
            then_path: way.then_path,
            route: way.route,
            road: way.road,
            hop: way.hop,
            kind,
            is_commanded: true,
            is_gone: false,
            beyond: Beyond::default(),
            owed: (0, 0),
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

    /// The same vehicle when it has passed the next origin, of a zone or a link.
    pub(super) fn passing(&self, entry_time_s: f64, entry_speed_mps: f64) -> Car {
        Car {
            x_m: 0.0,
            v_mps: entry_speed_mps,
            u_mps2: 0.0,
            command_mps2: 0.0,
            entry_time_s,
            entry_speed_mps,
            planned_exit_time_s: 0.0,
            planned_exit_speed_mps: 0.0,
            owed: (0, 0),
            visit: Visit::NEW,
            ..*self
        }
    }

    /// Whether a human drives it who does not follow the passing order.
    pub(super) fn is_free(&self, scenario: &Scenario) -> bool {
        !self.is_commanded && !scenario.human(self.kind).is_some_and(HumanParams::obeys)
    }

    /// Where it goes.
    pub(super) fn way(&self) -> Way {
        let Car { path, next_zone, next_path, then_path, route, road, hop, .. } = *self;
        Way { path, next_zone, next_path, then_path, route, road, hop }
    }

    /// Puts it on its way through another zone.
    pub(super) fn turn(&mut self, way: Way) {
        let Way { path, next_zone, next_path, then_path, route, road, hop } = way;
        (self.path, self.next_zone, self.next_path, self.then_path) = (path, next_zone, next_path, then_path);
        (self.route, self.road, self.hop) = (route, road, hop);
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
