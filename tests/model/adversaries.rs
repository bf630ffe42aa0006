//! Controllers that mean harm: what the shield is tested against.

use crate::random::Random;
use ipc_schemas::VehicleState;

/// Everybody accelerates as hard as it can, always.
pub fn always_u_max() -> impl FnMut(u64, &VehicleState) -> f64 {
    |_, _| 4.0
}

/// Everybody accelerates or brakes as hard as it can, at random.
pub fn random_flips() -> impl FnMut(u64, &VehicleState) -> f64 {
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    move |_, _| if random.next() < 0.45 { -4.0 } else { 4.0 }
}

/// Every so often a vehicle brakes to a stop and stands for a while; all others push. Those about to leave
/// the network go on: there the world lets a vehicle keep its speed, and a standing one would stay.
pub fn leaders_that_stop() -> impl FnMut(u64, &VehicleState) -> f64 {
    let mut random = Random(0x1234_5678_9abc_def1);
    let mut until = std::collections::HashMap::new();
    move |step, s| {
        if random.next() < 0.004 {
            until.insert(s.vehicle, step + 120);
        }
        let stops = until.get(&s.vehicle).is_some_and(|&u| step < u) && s.x_m < 150.0;
        if stops { -4.0 } else { 4.0 }
    }
}
