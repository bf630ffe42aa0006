//! Motion over one step with the acceleration held (paper: `VehicleDynamics`).

use std::hint::select_unpredictable;

/// Motion from `(x0, v0)` under a held acceleration, for any time up to one step.
///
/// A vehicle that would reverse stops at `v = 0` and stays there; the instant is exact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Held {
    /// Position at the start, m.
    pub x0_m: f64,
    /// Speed at the start, m/s, >= 0.
    pub v0_mps: f64,
    /// Held acceleration, m/s^2.
    pub u_mps2: f64,
    /// Time until the vehicle comes to a stop, s; infinite when it never does.
    stop_s: f64,
}

impl Held {
    /// Starts at position `x0_m` with speed `v0_mps >= 0` under acceleration `u_mps2`.
    pub fn new(x0_m: f64, v0_mps: f64, u_mps2: f64) -> Held {
        // A vehicle brakes or does not with about equal odds: no branch could be foretold.
        let stop_s = select_unpredictable(u_mps2 < 0.0, v0_mps / -u_mps2, f64::INFINITY);
        Held { x0_m, v0_mps, u_mps2, stop_s }
    }

    /// Position after `t_s >= 0`, m.
    pub fn position_m(&self, t_s: f64) -> f64 {
        let t = t_s.min(self.stop_s);
        self.x0_m + (self.v0_mps + 0.5 * self.u_mps2 * t) * t
    }

    /// Speed after `t_s >= 0`, m/s.
    pub fn speed_mps(&self, t_s: f64) -> f64 {
        if t_s >= self.stop_s { 0.0 } else { (self.v0_mps + self.u_mps2 * t_s).max(0.0) }
    }

    /// Energy spent until `t_s`, the integral of u^2/2 while moving, m^2/s^3.
    pub fn energy(&self, t_s: f64) -> f64 {
        0.5 * self.u_mps2 * self.u_mps2 * t_s.min(self.stop_s)
    }

    /// Acceleration as an observer sees it over `[0, t_s]`: the held one, or the mean when the
    /// vehicle came to a stop on the way, m/s^2.
    pub fn observed_mps2(&self, t_s: f64) -> f64 {
        if t_s > self.stop_s { -self.v0_mps / t_s } else { self.u_mps2 }
    }

    /// Instant at which the vehicle passes `x_m`, s, if that is within `[0, within_s]`.
    ///
    /// The root is taken in the form that does not cancel, so it is exact to rounding.
    pub fn passes_m(&self, x_m: f64, within_s: f64) -> Option<f64> {
        let distance = x_m - self.x0_m;
        if distance <= 0.0 {
            return Some(0.0);
        }
        if self.position_m(within_s) < x_m {
            return None;
        }
        let discriminant = self.v0_mps * self.v0_mps + 2.0 * self.u_mps2 * distance;
        let root = 2.0 * distance / (self.v0_mps + discriminant.max(0.0).sqrt());
        Some(root.min(within_s))
    }

    /// How long within `[from_s, to_s]` another vehicle, moved on by `shift_m`, is less than `distance_m` away,
    /// ahead or behind, s; and the least distance in that time, m.
    pub fn time_within(
        &self,
        other: &Held,
        shift_m: f64,
        distance_m: f64,
        (from_s, to_s): (f64, f64),
    ) -> (f64, f64) {
        let ahead_m = |t: f64| other.position_m(t) + shift_m - self.position_m(t);
        let (mut time_s, mut least_m) = (0.0, f64::INFINITY);
        let mut start = from_s;
        // Between the instants at which one of the two stops, the distance is a parabola.
        let (a, b) = (self.stop_s.min(other.stop_s), self.stop_s.max(other.stop_s));
        for end in [a.min(to_s), b.min(to_s), to_s] {
            if end < start || (end == start && end != to_s) {
                continue;
            }
            let mid = 0.5 * (start + end);
            let u = |held: &Held| if mid < held.stop_s { held.u_mps2 } else { 0.0 };
            let curvature = u(other) - u(self);
            let slope = other.speed_mps(start) - self.speed_mps(start);
            let distance = ahead_m(start);
            let turn_s = start - slope / curvature;
            let turns = if turn_s > start && turn_s < end { turn_s } else { start };
            let (a_m, b_m, c_m) = (distance, ahead_m(turns), ahead_m(end));
            let (lowest, highest) = (a_m.min(b_m).min(c_m), a_m.max(b_m).max(c_m));
            // Mostly the two are too far apart all the time, or near enough.
            let (is_away, is_within) = (
                lowest >= distance_m || highest <= -distance_m,
                lowest > -distance_m && highest < distance_m && (lowest > 0.0 || highest < 0.0),
            );
            if is_away || is_within {
                least_m = least_m.min(lowest.abs().min(highest.abs()));
                time_s += if is_within { end - start } else { 0.0 };
                start = end;
                continue;
            }
            // Where it turns, and where it reaches one of these distances.
            let mut turns = [start, end, turns, start, start, start, start, start, start];
            let mut put = |at: usize, after_s: f64| {
                if after_s > 0.0 && start + after_s < end {
                    turns[at] = start + after_s;
                }
            };
            for (i, level) in [distance_m, 0.0, -distance_m].into_iter().enumerate() {
                let c = distance - level;
                let root = (slope * slope - 2.0 * curvature * c).sqrt();
                // In the form that does not cancel; NaN and infinity, where there is none, are not put.
                let q = -(slope + root.copysign(slope));
                put(3 + 2 * i, q / curvature);
                put(4 + 2 * i, 2.0 * c / q);
            }
            turns.sort_unstable_by(f64::total_cmp);
            least_m = turns.iter().fold(least_m, |least, &t| least.min(ahead_m(t).abs()));
            let spans = turns.windows(2).filter(|w| ahead_m(0.5 * (w[0] + w[1])).abs() < distance_m);
            time_s += spans.map(|w| w[1] - w[0]).sum::<f64>();
            start = end;
        }
        (time_s, least_m)
    }

    /// Least value over `[0, within_s]` of `leader - self + shift_m - reaction_s * v - gap_m`, m: the
    /// rear-end margin between samples as well as at them.
    #[inline]
    pub fn least_margin_m(
        &self,
        leader: &Held,
        shift_m: f64,
        reaction_s: f64,
        gap_m: f64,
        within_s: f64,
    ) -> f64 {
        let margin = |t: f64| {
            leader.position_m(t) - self.position_m(t) + shift_m - reaction_s * self.speed_mps(t) - gap_m
        };
        if within_s <= self.stop_s && within_s <= leader.stop_s {
            // Nobody stops on the way: one parabola.
            let start = margin(0.0);
            let slope = leader.v0_mps - self.v0_mps - reaction_s * self.u_mps2;
            let curvature = leader.u_mps2 - self.u_mps2;
            let end = start + (slope + 0.5 * curvature * within_s) * within_s;
            let turns = slope < 0.0 && slope + curvature * within_s > 0.0;
            let least = start.min(end);
            return if turns { least.min(start - 0.5 * slope * slope / curvature) } else { least };
        }
        let mut least = margin(0.0).min(margin(within_s));
        // Between the instants at which one of the two stops, the margin is a parabola.
        let mut from = 0.0;
        let (a, b) = if self.stop_s < leader.stop_s {
            (self.stop_s, leader.stop_s)
        } else {
            (leader.stop_s, self.stop_s)
        };
        for to in [a.min(within_s), b.min(within_s), within_s] {
            if to > from {
                let mid = 0.5 * (from + to);
                let own_u = if mid < self.stop_s { self.u_mps2 } else { 0.0 };
                let lead_u = if mid < leader.stop_s { leader.u_mps2 } else { 0.0 };
                let curvature = lead_u - own_u;
                let slope = leader.speed_mps(from) - self.speed_mps(from) - reaction_s * own_u;
                least = least.min(margin(from)).min(margin(to));
                if curvature > 0.0 {
                    let vertex = from - slope / curvature;
                    if vertex > from && vertex < to {
                        least = least.min(margin(vertex));
                    }
                }
                from = to;
            }
        }
        least
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_braking_vehicle_stops_and_stays() {
        let held = Held::new(10.0, 2.0, -4.0);
        assert_eq!(held.position_m(0.5), 10.5);
        assert_eq!(held.position_m(9.0), 10.5);
        assert_eq!(held.speed_mps(0.5), 0.0);
        assert_eq!(held.speed_mps(9.0), 0.0);
        assert_eq!(held.energy(9.0), 4.0);
        assert_eq!(held.observed_mps2(1.0), -2.0);
        assert_eq!(held.passes_m(10.6, 9.0), None);
    }

    proptest! {
        #[test]
        fn crossing_instant_lies_on_the_boundary(
            v in 0.0..30.0f64, u in -4.0..4.0f64, ahead in 0.0..3.0f64,
        ) {
            let held = Held::new(100.0, v, u);
            match held.passes_m(100.0 + ahead, 0.1) {
                Some(t) => prop_assert!((held.position_m(t) - (100.0 + ahead)).abs() < 1e-12 * 200.0),
                None => prop_assert!(held.position_m(0.1) < 100.0 + ahead),
            }
        }

        #[test]
        fn time_within_a_distance_is_what_sampling_finds(
            v in 0.0..30.0f64, u in -4.0..4.0f64, vo in 0.0..30.0f64, uo in -4.0..4.0f64,
            ahead in -12.0..12.0f64, shift in -3.0..3.0f64, distance in 0.1..8.0f64,
            from in 0.0..0.5f64, dt in 0.01..3.0f64,
        ) {
            let own = Held::new(0.0, v, u);
            let other = Held::new(ahead, vo, uo);
            let to = from + dt;
            let (time, least) = own.time_within(&other, shift, distance, (from, to));
            const N: u32 = 4000;
            let apart = |i: u32| {
                let t = from + dt * (f64::from(i) + 0.5) / f64::from(N);
                (other.position_m(t) + shift - own.position_m(t)).abs()
            };
            let brute = (0..N).filter(|&i| apart(i) < distance).count() as f64 * dt / f64::from(N);
            // The boundary is met at most four times per span, of which there are three.
            prop_assert!((time - brute).abs() <= 12.0 * dt / f64::from(N), "{time}, sampled {brute}");
            let sampled = (0..N).map(apart).fold(f64::INFINITY, f64::min);
            prop_assert!(least <= sampled + 1e-9 && sampled - least < 42.0 * dt / f64::from(N));
            prop_assert_eq!(time > 0.0, least < distance, "{} {}", time, least);
        }

        #[test]
        fn least_margin_is_no_greater_than_any_sample(
            v in 0.0..30.0f64, u in -4.0..4.0f64, vl in 0.0..30.0f64, ul in -4.0..4.0f64,
            gap in -5.0..60.0f64, dt in 0.01..2.0f64,
        ) {
            let own = Held::new(0.0, v, u);
            let leader = Held::new(gap, vl, ul);
            let least = own.least_margin_m(&leader, 0.0, 1.8, 0.5, dt);
            let mut brute = f64::INFINITY;
            for i in 0..=4000 {
                let t = dt * f64::from(i) / 4000.0;
                let m = leader.position_m(t) - own.position_m(t) - 1.8 * own.speed_mps(t) - 0.5;
                prop_assert!(m >= least - 1e-9);
                brute = brute.min(m);
            }
            prop_assert!(brute - least < 0.02, "least {least} but brute force found only {brute}");
        }
    }
}
