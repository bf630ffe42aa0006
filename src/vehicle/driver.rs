//! How a human drives: the intelligent driver model, within the speed from which the driver can still stop.

use crate::scenario::HumanParams;

/// What a driver has ahead, in its own coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ahead {
    /// Rear of the vehicle ahead, or the line at which to stop, m.
    pub rear_m: f64,
    /// Its speed; 0 for a line, m/s.
    pub v_mps: f64,
    /// How hard it may brake, m/s^2, positive.
    pub braking_mps2: f64,
    /// Distance to be kept from it at a standstill, m.
    pub gap_m: f64,
}

/// Headways shorter than this count as this, m.
const LEAST_GAP_M: f64 = 0.1;

/// The acceleration of the intelligent driver model toward whatever is ahead, m/s^2.
pub fn wish_mps2(
    human: &HumanParams,
    desired_mps: f64,
    x_m: f64,
    v_mps: f64,
    ahead: impl Iterator<Item = Ahead>,
) -> f64 {
    let (a, b) = (human.acceleration_mps2, human.comfortable_mps2);
    let share = v_mps / desired_mps;
    let square = share * share;
    // Above the desired speed the model would brake without bound.
    let free = (a * (1.0 - square * square)).max(-b);
    let mut wish = free;
    for other in ahead {
        let gap_m = (other.rear_m - x_m - other.gap_m + human.jam_gap_m).max(LEAST_GAP_M);
        let closing = v_mps * (v_mps - other.v_mps) / (2.0 * (a * b).sqrt());
        let desired_m = human.jam_gap_m + (v_mps * human.headway_s + closing).max(0.0);
        let ratio = desired_m / gap_m;
        wish = wish.min(free.min(a) - a * ratio * ratio);
    }
    wish
}

/// The greatest acceleration over a step after which the driver, braking with `hardest_mps2` or as hard as the vehicle
/// ahead if that is less, still stops behind where that one stops, m/s^2.
pub fn safe_mps2(hardest_mps2: f64, x_m: f64, v_mps: f64, ahead: &Ahead, dt_s: f64) -> f64 {
    let b = hardest_mps2.min(ahead.braking_mps2);
    let stops_m = ahead.rear_m - ahead.gap_m + ahead.v_mps * ahead.v_mps / (2.0 * ahead.braking_mps2);
    // v1^2 + b dt v1 + b dt v - 2 b (stops - x) <= 0 for the speed v1 at the step's end.
    let half = 0.5 * b * dt_s;
    let square = half * half - b * dt_s * v_mps + 2.0 * b * (stops_m - x_m);
    if square <= half * half {
        // It stops within the step, and no further on than that.
        let left_m = stops_m - x_m;
        let u_mps2 = if left_m > 0.0 { -v_mps * v_mps / (2.0 * left_m) } else { -hardest_mps2 };
        return u_mps2.max(-hardest_mps2);
    }
    (square.sqrt() - half - v_mps) / dt_s
}

/// Whether a driver who learns now that it is to stop before a point so far ahead can, after its delay and whatever it does
/// until then, braking no harder than `braking_mps2`.
pub fn can_be_told(human: &HumanParams, braking_mps2: f64, distance_m: f64, v_mps: f64) -> bool {
    let (a, tau) = (human.acceleration_mps2, human.delay_s);
    let later_mps = v_mps + a * tau;
    distance_m >= (v_mps + 0.5 * a * tau) * tau + later_mps * later_mps / (2.0 * braking_mps2)
}

/// Time to cover a distance when speeding up to the desired speed, s.
pub fn reach_s(distance_m: f64, v_mps: f64, desired_mps: f64, acceleration_mps2: f64) -> f64 {
    if distance_m <= 0.0 {
        return 0.0;
    }
    let (a, top) = (acceleration_mps2, desired_mps.max(v_mps));
    let rise_m = (top * top - v_mps * v_mps) / (2.0 * a);
    if distance_m <= rise_m {
        return ((v_mps * v_mps + 2.0 * a * distance_m).sqrt() - v_mps) / a;
    }
    (top - v_mps) / a + (distance_m - rise_m) / top
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Yielding;
    use crate::vehicle::Held;
    use proptest::prelude::*;

    const HUMAN: HumanParams = HumanParams {
        yields: Yielding::Order,
        desired_mps: 15.0,
        desired_sd_mps: 0.0,
        headway_s: 1.2,
        jam_gap_m: 2.0,
        acceleration_mps2: 1.5,
        comfortable_mps2: 2.0,
        delay_s: 0.6,
        noise_mps2: 0.0,
        critical_gap_s: 2.0,
        patience_s: 10.0,
        hardest_mps2: 4.0,
        scares_per_h: 0.0,
    };

    /// The equilibrium gap of the model, (s0 + v T) / sqrt(1 - (v / v0)^4), is one.
    #[test]
    fn in_equilibrium_nobody_accelerates() {
        for v in [0.0_f64, 3.0, 8.0, 12.0, 14.0] {
            let share = v / 15.0;
            let gap_m = (2.0 + 1.2 * v) / (1.0 - share * share * share * share).sqrt();
            let ahead = Ahead { rear_m: gap_m, v_mps: v, braking_mps2: 4.0, gap_m: 2.0 };
            assert!(wish_mps2(&HUMAN, 15.0, 0.0, v, [ahead].into_iter()).abs() < 1e-12, "{v}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

        /// Whoever drives no faster than is safe, by what it saw a delay ago, never touches a leader that does anything.
        #[test]
        fn safe_speeds_keep_bodies_apart(
            v in 0.0..25.0f64, w in 0.0..25.0f64, delay in 0usize..15,
            own_braking in 3.0..8.0f64, braking in 3.0..8.0f64,
            flips in proptest::collection::vec(-8.0..3.0f64, 30),
        ) {
            let (dt, gap_m) = (0.1, 2.0);
            // It begins where it can stop.
            let b = own_braking.min(braking);
            let rear_m = gap_m + (v * v / (2.0 * b) - w * w / (2.0 * braking)).max(0.0) + 1e-6;
            let mut own = Held::new(0.0, v, 0.0);
            let mut leader = Held::new(rear_m, w, 0.0);
            let mut seen = vec![(rear_m, w)];
            for step in 0..300 {
                let (rear_m, v_mps) = seen[seen.len().saturating_sub(1 + delay)];
                let ahead = Ahead { rear_m, v_mps, braking_mps2: braking, gap_m };
                let u = safe_mps2(own_braking, own.x0_m, own.v0_mps, &ahead, dt).clamp(-own_braking, 3.0);
                own = Held::new(own.x0_m, own.v0_mps, u);
                leader = Held::new(leader.x0_m, leader.v0_mps, flips[step / 10].max(-braking));
                let least = own.least_margin_m(&leader, 0.0, 0.0, 0.0, dt);
                // A step's arc may dip below its ends, by no more than this.
                prop_assert!(least >= gap_m - 0.125 * 12.0 * dt * dt - 1e-6, "{least} in step {step}");
                own = Held::new(own.position_m(dt), own.speed_mps(dt), 0.0);
                leader = Held::new(leader.position_m(dt), leader.speed_mps(dt), 0.0);
                seen.push((leader.x0_m, leader.v0_mps));
            }
        }

        #[test]
        fn reaching_takes_as_long_as_driving_there(d in 0.1..200.0f64, v in 0.0..20.0f64) {
            let (dt, mut x, mut w, mut t) = (1e-3, 0.0, v, 0.0);
            while x < d {
                let u = if w < 15.0 { 1.5 } else { 0.0 };
                x += w * dt + 0.5 * u * dt * dt;
                w += u * dt;
                t += dt;
            }
            prop_assert!((reach_s(d, v, 15.0, 1.5) - t).abs() < 0.02, "{} {}", reach_s(d, v, 15.0, 1.5), t);
        }
    }
}
