//! Plain links between zones: uncontrolled road on which vehicles follow at their own discretion.

use super::car::Car;
use super::role::World;
use crate::conflict::DutyKind;
use crate::scenario::{Downstream, Network, Scenario, VehicleParams, ZoneId};
use crate::shield::Partner;
use crate::vehicle::{Held, Pair, RearEnd};

/// A link and its vehicles, front first.
#[derive(Clone, Debug)]
pub(super) struct Link {
    /// The zone and exit it begins at.
    pub from: (ZoneId, u32),
    pub to: Downstream,
    pub cars: Vec<LinkCar>,
}

/// A vehicle on a link.
#[derive(Clone, Copy, Debug)]
pub(super) struct LinkCar {
    pub car: Car,
    /// Motion over the coming step, chosen by its driver; in the step in which it came, what it had been
    /// commanded.
    pub held: Held,
}

/// The links of a network, by zone, then exit.
#[derive(Clone, Debug, Default)]
pub(super) struct Links {
    pub all: Vec<Link>,
    /// Vehicles on all of them.
    pub cars: usize,
}

impl Links {
    pub(super) fn of(network: &Network) -> Links {
        let mut all = Vec::new();
        for (zone, shape) in (0..).zip(&network.zones) {
            for (exit, to) in (0..).zip(shape.exits.iter().map(|exit| exit.to)) {
                if let Some(to) = to.filter(|to| to.link_m > 0.0) {
                    all.push(Link { from: (zone, exit), to, cars: Vec::new() });
                }
            }
        }
        Links { all, cars: 0 }
    }

    /// The link behind an exit, if there is one.
    pub(super) fn behind(&self, zone: ZoneId, exit: u32) -> Option<usize> {
        self.all.binary_search_by_key(&(zone, exit), |link| link.from).ok()
    }

    /// The links behind a zone's exits.
    pub(super) fn range(&self, zone: ZoneId) -> std::ops::Range<usize> {
        let from = self.all.partition_point(|link| link.from.0 < zone);
        from..from + self.all[from..].partition_point(|link| link.from.0 == zone)
    }
}

/// Time constant with which a vehicle on a link goes over to the link's speed, s.
const RECOVERY_S: f64 = 2.0;

impl World {
    /// Lets the vehicles on a link choose, front first, so that each sees what its leader will do.
    pub(super) fn drive_link(&mut self, scenario: &Scenario, zone: usize, link: usize, dt_s: f64) {
        if self.links.all[link].cars.is_empty() {
            return;
        }
        let to = self.links.all[link].to;
        let there = &scenario.network.zones[to.zone as usize];
        let enters = |path: u32| there.paths[path as usize].segments[0] == to.segment;
        let last = self.members(to.zone as usize).iter().rev().find(|c| enters(c.path));
        // In a network that closes a circle the zone there may not be settled yet.
        let is_settled = to.zone as usize > zone;
        let mut leader = last.map(|c| {
            let u_mps2 = if is_settled && c.is_commanded {
                c.command_mps2
            } else {
                self.kinds[usize::from(c.kind)].u_min_mps2
            };
            (Held::new(c.x_m + to.link_m, c.v_mps, u_mps2), c.kind)
        });
        let shields = self.gateway.shields_of_links();
        for LinkCar { car, held } in &mut self.links.all[link].cars {
            let k = scenario.control.k_rear_end_per_s;
            let own = &self.kinds[usize::from(car.kind)];
            let gap_m = |other: u16| {
                let extra_m = self.kinds[usize::from(other)].length_m - scenario.vehicle.length_m;
                own.standstill_gap_m + extra_m.max(0.0)
            };
            let ahead = leader.map(|(motion, kind)| (motion, gap_m(kind)));
            let mut u = drive(car, to.link_speed_mps, ahead, own, k, dt_s);
            if let Some(shields) = shields {
                let partner = leader.map(|(motion, kind)| Partner {
                    kind: DutyKind::RearEnd,
                    at_m: 0.0,
                    gap_m: gap_m(kind),
                    braking_mps2: -self.kinds[usize::from(kind)].u_min_mps2,
                    motion,
                });
                let shield = &shields[usize::from(car.kind)];
                u = shield.project(car.x_m, car.v_mps, u, partner.into_iter()).u_mps2;
            }
            *held = Held::new(car.x_m, car.v_mps, u);
            leader = Some((*held, car.kind));
        }
    }
}

/// The acceleration a vehicle on a link chooses: toward the link's speed, unless the sampled rear-end
/// condition asks for less. `leader` is the motion of the vehicle ahead, in the link's coordinate, and the
/// standstill gap to it, m.
fn drive(
    car: &Car,
    link_speed_mps: f64,
    leader: Option<(Held, f64)>,
    vehicle: &VehicleParams,
    k_per_s: f64,
    dt_s: f64,
) -> f64 {
    let wish = (link_speed_mps - car.v_mps) / RECOVERY_S;
    let Some((leader, gap_m)) = leader else { return wish.clamp(vehicle.u_min_mps2, vehicle.u_max_mps2) };
    let rear_end =
        RearEnd { reaction_s: vehicle.reaction_time_s, gap_m, k_per_s, u_min_mps2: vehicle.u_min_mps2 };
    let pair = Pair {
        x_m: car.x_m,
        v_mps: car.v_mps,
        partner_x_m: leader.x0_m,
        partner_v_mps: leader.v0_mps,
        partner_u_mps2: leader.u_mps2,
    };
    let row = rear_end.sampled_row(&pair, dt_s);
    wish.min(row.bound / row.coefficient).clamp(vehicle.u_min_mps2, vehicle.u_max_mps2)
}
