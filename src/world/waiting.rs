//! Humans who wait: whoever does not follow the passing order, and stands before a conflict point, perhaps lets others go.
//!
//! Nobody knows whom they wait for; that they stand is to be seen. Automated vehicles that would wait for them for ever
//! may pass before them then ([`crate::coordination`]).

use super::role::World;
use crate::scenario::Scenario;

/// Slower than this is standing, m/s.
const STANDING_MPS: f64 = 0.3;
/// Whoever has stood so long waits, s; and every time that it has stood so long again, the order is looked at again.
const WAITS_AFTER_S: f64 = 2.0;

impl World {
    /// Notes who of a zone's humans waits at the end of the step. Returns whether that is an event: somebody has come to wait,
    /// waits still after a while, or waits no more.
    pub(super) fn observe_waiting(&mut self, scenario: &Scenario, zone: usize, dt_s: f64) -> bool {
        if self.uncommanded == 0 {
            return false;
        }
        let shape = &scenario.network.zones[zone];
        let conflicts = &self.conflicts[zone];
        let motions = &self.scratch.motions;
        let held_up = &mut self.scratch.held_up;
        held_up.clear();
        let period = ((WAITS_AFTER_S / dt_s) as u32).max(1);
        let mut is_event = false;
        let first = self.zones[zone].first();
        for (car, held) in self.cars[zone][first..].iter_mut().zip(&motions[first..]) {
            if !car.is_free(scenario) {
                continue;
            }
            let (x_m, v_mps) = (held.position_m(dt_s), held.speed_mps(dt_s));
            let lane = shape.paths[car.path as usize].segments[0];
            let visit = &mut car.visit;
            visit.stands = if v_mps < STANDING_MPS { visit.stands + 1 } else { 0 };
            let stands = visit.stands >= period && conflicts.uses(car.path).iter().any(|own| own.at_m > x_m);
            // Ahead on a lane is whoever is earlier among the cars.
            let waits = stands || held_up.contains(&lane);
            if stands && x_m < shape.segments[lane as usize].length_m {
                held_up.push(lane);
            }
            let is_again = stands && visit.stands.is_multiple_of(period);
            if waits != visit.waits || is_again {
                visit.passes = true;
                is_event = true;
            }
            visit.waits = waits;
        }
        is_event
    }
}
