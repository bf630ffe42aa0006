//! Plain links between zones: uncontrolled road on which vehicles follow at their own discretion.

use super::car::Car;
use crate::scenario::VehicleParams;
use crate::vehicle::{Held, Pair, RearEnd};

/// Vehicles on the link behind a zone's exit, front first.
#[derive(Clone, Debug, Default)]
pub(super) struct Link {
    pub length_m: f64,
    /// Speed driven on it where nobody is in the way, m/s.
    pub speed_mps: f64,
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

/// Time constant with which a vehicle on a link goes over to the link's speed, s.
const RECOVERY_S: f64 = 2.0;

/// The acceleration a vehicle on a link chooses: toward the link's speed, unless the sampled rear-end
/// condition asks for less. `leader` is the motion of the vehicle ahead, in the link's coordinate.
pub(super) fn drive(
    car: &Car,
    link_speed_mps: f64,
    leader: Option<&Held>,
    vehicle: &VehicleParams,
    k_per_s: f64,
    dt_s: f64,
) -> f64 {
    let wish = (link_speed_mps - car.v_mps) / RECOVERY_S;
    let Some(leader) = leader else { return wish.clamp(vehicle.u_min_mps2, vehicle.u_max_mps2) };
    let rear_end = RearEnd {
        reaction_s: vehicle.reaction_time_s,
        gap_m: vehicle.standstill_gap_m,
        k_per_s,
        u_min_mps2: vehicle.u_min_mps2,
    };
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
