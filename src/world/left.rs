//! Those that have left a zone and still count there: they move as the vehicles do that they stand for, wherever these are by
//! now.

use super::car::{Beyond, Car};
use super::role::World;
use crate::scenario::Scenario;

/// A vehicle that leaves the network more slowly speeds up to this outside, m/s.
const LEAST_EXIT_MPS: f64 = 5.0;
/// How it does, m/s^2.
const EXIT_MPS2: f64 = 2.0;

/// What a vehicle that left a zone holds over the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Followed {
    pub u_mps2: f64,
    /// Whether that is settled when the zone it left is about to be.
    is_settled: bool,
}

impl World {
    /// Those that have left a zone move with the vehicles they stand for. With `settling`, what is not settled yet
    /// is taken for full braking until it is.
    pub(super) fn hold_left(&mut self, scenario: &Scenario, zone: usize, settling: bool) {
        for at in 0..self.zones[zone].first() {
            let Followed { u_mps2, is_settled } = self.followed(scenario, zone, at);
            let car = &mut self.cars[zone][at];
            car.command_mps2 = u_mps2;
            if settling && !is_settled {
                car.command_mps2 = self.kinds[usize::from(car.kind)].u_min_mps2;
                self.scratch.assumed.push((zone as u32, at));
            }
        }
    }

    /// What a vehicle that left a zone holds over the step, wherever it is now.
    pub(super) fn followed(&mut self, scenario: &Scenario, zone: usize, at: usize) -> Followed {
        let mut car = self.cars[zone][at];
        let followed = self.follow(scenario, zone, &mut car);
        self.cars[zone][at].beyond = car.beyond;
        followed
    }

    /// The same, of a vehicle that need not be among the zone's; it is told how far it has come.
    pub(super) fn follow(&self, scenario: &Scenario, zone: usize, car: &mut Car) -> Followed {
        let Car { vehicle, v_mps, kind, mut beyond, .. } = *car;
        let found = loop {
            if self.links.cars > 0
                && let Some(link) = self.links.behind(beyond.zone, beyond.exit)
                && let Some(on_link) = self.links.all[link].cars.iter().find(|c| c.car.vehicle == vehicle)
            {
                break Some((on_link.held.u_mps2, beyond.zone as usize >= zone));
            }
            let exit = &scenario.network.zones[beyond.zone as usize].exits[beyond.exit as usize];
            let Some(to) = exit.to else { break None };
            if let Some(car) = self.members(to.zone as usize).iter().rev().find(|c| c.vehicle == vehicle) {
                beyond.next_exit = self.conflicts[to.zone as usize].exit(car.path);
                break Some((car.command_mps2, to.zone as usize > zone));
            }
            beyond = Beyond { zone: to.zone, exit: beyond.next_exit, next_exit: 0 };
        };
        car.beyond = beyond;
        match found {
            Some((u_mps2, is_settled)) => Followed { u_mps2, is_settled },
            // Out of the network nobody drives it. Whoever left it creeping must not creep for ever: those behind
            // would have to leave more slowly each, down to a standstill.
            None if v_mps < LEAST_EXIT_MPS => {
                let u_max_mps2 = self.kinds[usize::from(kind)].u_max_mps2;
                Followed { u_mps2: EXIT_MPS2.min(u_max_mps2), is_settled: true }
            }
            None => Followed { u_mps2: 0.0, is_settled: true },
        }
    }
}
