//! The safety shield: the greatest acceleration that keeps a vehicle safe, whoever commands it.
//!
//! Pure functions of the present state and of what the partners will do in this step. A state is safe
//! toward a leader when the margin `x_p - x - phi v - delta` stays non-negative if both brake at `u_min`
//! to a stop; toward a merging partner when, both braking, the vehicle stops before the conflict point or
//! is safe toward it, as toward a leader, once it gets there. Both sets are closed forms, both are invariant
//! under `u_min`, and in both the set of admissible accelerations of a step is an interval that begins at
//! `u_min`. So the projection always exists, and it is one number. The derivation is in `docs/shield.md`.

use crate::scenario::VehicleParams;
use crate::vehicle::Held;

/// What a partner is to the vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Duty {
    /// The partner drives ahead on the same path: the margin is kept at every instant.
    RearEnd,
    /// The partner passes the conflict point at this distance (m, on the vehicle's path) first: the margin
    /// is kept from the instant at which the vehicle passes it.
    Merge {
        /// Position of the conflict point on the vehicle's path, m.
        conflict_m: f64,
    },
}

/// A partner and its motion over the coming step, in the vehicle's coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Partner {
    /// What is owed to it.
    pub duty: Duty,
    /// Its motion over the step, already shielded.
    pub motion: Held,
}

/// What bounded a projected command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Row {
    /// The greatest speed.
    Speed,
    /// The rear-end margin.
    RearEnd,
    /// The merging margin.
    Merge,
}

/// A command after the shield.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Acceleration, m/s^2: the wish, or the greatest admissible one.
    pub u_mps2: f64,
    /// What bounded it; `None` when it is the wish.
    pub row: Option<Row>,
}

/// Slack below which the shield leaves a vehicle no choice but `u_min`, m. Braking at `u_min` keeps the
/// slack constant but for rounding (some 1e-14 m a step), so this absorbs 10^4 steps of it.
pub const RESERVE_M: f64 = 1e-9;
/// What a speed may exceed the greatest one by, m/s: rounding.
const RESERVE_MPS: f64 = 1e-9;
/// Crossing speeds are taken to be at least this, m/s.
const LEAST_CROSSING_MPS: f64 = 1e-3;
/// Halvings of the bracket `[u_min, wish]`: to the last bits of a double.
const HALVINGS: u32 = 52;

/// The shield of one kind of vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shield {
    /// Strongest braking as a positive number, m/s^2.
    braking_mps2: f64,
    v_max_mps: f64,
    reaction_s: f64,
    gap_m: f64,
    dt_s: f64,
}

impl Shield {
    /// The shield for vehicles of these limits and a step of `dt_s`.
    pub fn new(vehicle: &VehicleParams, dt_s: f64) -> Shield {
        Shield {
            braking_mps2: -vehicle.u_min_mps2,
            v_max_mps: vehicle.v_max_mps,
            reaction_s: vehicle.reaction_time_s,
            gap_m: vehicle.standstill_gap_m,
            dt_s,
        }
    }

    /// How far the state is inside the set that is safe toward a leader, m; negative outside.
    ///
    /// The least margin while both brake at `u_min` to a stop. In closed form: the lesser of the margin
    /// now, and of the leader's stopping point less the farthest that `x + phi v` gets while braking.
    pub fn slack_m(&self, x_m: f64, v_mps: f64, leader_x_m: f64, leader_v_mps: f64) -> f64 {
        let b = self.braking_mps2;
        let lead = leader_x_m - x_m - self.gap_m;
        let now = lead - self.reaction_s * v_mps;
        let shed = (v_mps - self.reaction_s * b).max(0.0);
        // Only while the vehicle is faster than the leader by more than it sheds in a reaction time does
        // the margin shrink, until both have stopped shrinking it.
        now.min(now + (leader_v_mps * leader_v_mps - shed * shed) / (2.0 * b))
    }

    /// How far the state is inside the set that is safe toward a merging partner, m; negative outside.
    ///
    /// Both brake at `u_min`. Either the vehicle stops before the conflict point, or it is safe toward the
    /// partner, as toward a leader, when it gets there.
    pub fn merge_slack_m(&self, x_m: f64, v_mps: f64, other_x_m: f64, other_v_mps: f64, at_m: f64) -> f64 {
        if x_m >= at_m {
            return self.slack_m(x_m, v_mps, other_x_m, other_v_mps);
        }
        let b = self.braking_mps2;
        let stopping = at_m - x_m - v_mps * v_mps / (2.0 * b);
        // Below the least crossing speed the square root would magnify rounding; taking it greater than
        // it is errs on the safe side.
        let crossing_mps = (-2.0 * b * stopping).max(LEAST_CROSSING_MPS * LEAST_CROSSING_MPS).sqrt();
        let after_s = ((v_mps - crossing_mps) / b).max(0.0);
        let other = Held::new(other_x_m, other_v_mps, -b);
        let crossing = self.slack_m(at_m, crossing_mps, other.position_m(after_s), other.speed_mps(after_s));
        stopping.max(crossing)
    }

    /// How far a state is inside the safe set toward a partner at the beginning of its motion, m.
    pub fn state_slack_m(&self, x_m: f64, v_mps: f64, partner: &Partner) -> f64 {
        let Held { x0_m, v0_mps, .. } = partner.motion;
        self.slack_of(partner.duty, x_m, v_mps, x0_m, v0_mps)
    }

    /// The slack at the end of a step driven with `own`, m.
    pub fn slack_after_m(&self, own: &Held, partner: &Partner) -> f64 {
        let (x, v) = (own.position_m(self.dt_s), own.speed_mps(self.dt_s));
        let other = &partner.motion;
        self.slack_of(partner.duty, x, v, other.position_m(self.dt_s), other.speed_mps(self.dt_s))
    }

    fn slack_of(&self, duty: Duty, x_m: f64, v_mps: f64, other_x_m: f64, other_v_mps: f64) -> f64 {
        match duty {
            Duty::RearEnd => self.slack_m(x_m, v_mps, other_x_m, other_v_mps),
            Duty::Merge { conflict_m } => self.merge_slack_m(x_m, v_mps, other_x_m, other_v_mps, conflict_m),
        }
    }

    /// The least margin that counts during the step, m: toward a leader that of every instant, toward a
    /// merging partner that from the crossing on; infinite when there is no crossing in the step.
    pub fn least_margin_m(&self, own: &Held, partner: &Partner) -> f64 {
        match partner.duty {
            Duty::RearEnd => own.least_margin_m(&partner.motion, 0.0, self.reaction_s, self.gap_m, self.dt_s),
            Duty::Merge { conflict_m } => match own.passes_m(conflict_m, self.dt_s) {
                None => f64::INFINITY,
                Some(after_s) => {
                    let later = |held: &Held| {
                        Held::new(held.position_m(after_s), held.speed_mps(after_s), held.u_mps2)
                    };
                    let rest_s = self.dt_s - after_s;
                    later(own).least_margin_m(
                        &later(&partner.motion),
                        0.0,
                        self.reaction_s,
                        self.gap_m,
                        rest_s,
                    )
                }
            },
        }
    }

    /// Whether the step may be driven so: its end is safe, and the margin has not been negative, nor less
    /// than it was to begin with, in between.
    fn admits(&self, own: &Held, partner: &Partner) -> bool {
        let floor = match partner.duty {
            Duty::RearEnd => {
                let leader = &partner.motion;
                leader.x0_m - own.x0_m - self.reaction_s * own.v0_mps - self.gap_m
            }
            Duty::Merge { .. } => RESERVE_M,
        };
        self.slack_after_m(own, partner) >= RESERVE_M
            && self.least_margin_m(own, partner) >= floor.min(RESERVE_M)
    }

    /// The command nearest to `wish_mps2` (which is within the vehicle's limits) that keeps the vehicle at
    /// `(x_m, v_mps)` safe toward all partners; `u_min` when there is none, as there may be for a vehicle
    /// that was not safe before.
    pub fn project<P>(&self, x_m: f64, v_mps: f64, wish_mps2: f64, partners: P) -> Projection
    where
        P: Iterator<Item = Partner>,
    {
        let u_min = -self.braking_mps2;
        let mut best = Projection { u_mps2: wish_mps2, row: None };
        if v_mps + best.u_mps2 * self.dt_s > self.v_max_mps + RESERVE_MPS {
            let u = ((self.v_max_mps - v_mps) / self.dt_s).max(u_min);
            best = Projection { u_mps2: u, row: Some(Row::Speed) };
        }
        for partner in partners {
            let admits = |u: f64| self.admits(&Held::new(x_m, v_mps, u), &partner);
            if admits(best.u_mps2) {
                continue;
            }
            // The admissible set is an interval from u_min on, so a bracket closes on its end; what is
            // returned has been found admissible, or is u_min.
            let (mut low, mut high) = (u_min, best.u_mps2);
            if admits(low) {
                for _ in 0..HALVINGS {
                    let middle = 0.5 * (low + high);
                    if admits(middle) {
                        low = middle;
                    } else {
                        high = middle;
                    }
                }
            }
            if low < best.u_mps2 {
                let row = if partner.duty == Duty::RearEnd { Row::RearEnd } else { Row::Merge };
                best = Projection { u_mps2: low, row: Some(row) };
            }
        }
        best
    }
}

#[cfg(test)]
mod tests;
