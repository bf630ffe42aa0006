//! Plain links between zones: uncontrolled road on which vehicles follow at their own discretion.

use super::car::Car;
use crate::scenario::{Downstream, Network, VehicleParams, ZoneId};
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

/// The acceleration a vehicle on a link chooses: toward the link's speed, unless the sampled rear-end
/// condition asks for less. `leader` is the motion of the vehicle ahead, in the link's coordinate, and the
/// standstill gap to it, m.
pub(super) fn drive(
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
