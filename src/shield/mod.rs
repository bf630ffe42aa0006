//! The safety shield: the greatest acceleration that keeps a vehicle safe, whoever commands it.
//!
//! Pure functions of the present state and of what the partners will do in this step. A state is safe
//! toward a leader when the margin `x_p - x - phi v - delta` stays non-negative if both brake at `u_min`
//! to a stop; toward a merging partner when, both braking, the vehicle stops before the conflict point or
//! is safe toward it, as toward a leader, once it gets there. Both sets are closed forms, both are invariant
//! under `u_min`, and in both the set of admissible accelerations of a step is an interval that begins at
//! `u_min`. So the projection always exists, and it is one number. The derivation is in `docs/shield.md`.

use crate::conflict::{Conflicts, Duties, DutyKind, Row as Vehicle, stands_on};
use crate::scenario::VehicleParams;
use crate::vehicle::Held;

/// A partner and its motion over the coming step, in the vehicle's coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Partner {
    /// What is owed to it.
    pub kind: DutyKind,
    /// Place of the conflict point on the vehicle's path, m; means nothing toward a leader.
    pub at_m: f64,
    /// Distance delta to be kept, m.
    pub gap_m: f64,
    /// Its strongest braking as a positive number, m/s^2.
    pub braking_mps2: f64,
    /// Its motion over the step, already shielded.
    pub motion: Held,
}

/// The other vehicle at one instant, in the vehicle's coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Position, m.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// Distance delta to be kept to it, m.
    pub gap_m: f64,
    /// Its strongest braking as a positive number, m/s^2.
    pub braking_mps2: f64,
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
    /// The crossing margin.
    Cross,
}

/// A command after the shield.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// Acceleration, m/s^2: the wish, or the greatest admissible one.
    pub u_mps2: f64,
    /// What bounded it; `None` when it is the wish.
    pub row: Option<Row>,
    /// Toward which of the partners, by its place among them; `None` when it is none of theirs.
    pub toward: Option<usize>,
}

/// Slack below which the shield leaves a vehicle no choice but `u_min`, m. Braking at `u_min` keeps the
/// slack constant but for rounding (some 1e-14 m a step), so this absorbs 10^4 steps of it.
pub const RESERVE_M: f64 = 1e-9;
/// Slack from which a state is viable, m. Whoever is driven along the edge has the reserve left but for rounding, and is
/// viable still when it passes into the next zone.
pub const VIABLE_FROM_M: f64 = 0.5 * RESERVE_M;
/// What a speed may exceed the greatest one by, m/s: rounding.
const RESERVE_MPS: f64 = 1e-9;
/// Crossing speeds are taken to be at least this, m/s.
const LEAST_CROSSING_MPS: f64 = 1e-3;
/// Halvings of the bracket `[u_min, wish]`: to the last bits of a double.
const HALVINGS: u32 = 52;

/// A step of a vehicle from end to end, for conditions that need no more.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ends {
    x0_m: f64,
    v0_mps: f64,
    x1_m: f64,
    v1_mps: f64,
    /// What a margin may be less within the step than at its ends, m.
    dip_m: f64,
}

/// The shield of one kind of vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shield {
    /// Strongest braking as a positive number, m/s^2.
    braking_mps2: f64,
    v_max_mps: f64,
    reaction_s: f64,
    dt_s: f64,
}

impl Shield {
    /// The shield for vehicles of these limits and a step of `dt_s`.
    pub fn new(vehicle: &VehicleParams, dt_s: f64) -> Shield {
        Shield {
            braking_mps2: -vehicle.u_min_mps2,
            v_max_mps: vehicle.v_max_mps,
            reaction_s: vehicle.reaction_time_s,
            dt_s,
        }
    }

    /// The shield of bodies alone: without reaction time, so that what is kept is the gap.
    pub fn of_bodies(vehicle: &VehicleParams, dt_s: f64) -> Shield {
        Shield { reaction_s: 0.0, ..Shield::new(vehicle, dt_s) }
    }

    /// How far the state is inside the set that is safe toward a leader, m; negative outside.
    ///
    /// The least margin while both brake fully to a stop. For equal braking in closed form: the lesser of the
    /// margin now, and of the leader's stopping point less the farthest that `x + phi v` gets while braking.
    pub fn slack_m(&self, x_m: f64, v_mps: f64, leader: Seen) -> f64 {
        let b = self.braking_mps2;
        if leader.braking_mps2 != b {
            let own = Held::new(x_m, v_mps, -b);
            let other = Held::new(leader.x_m, leader.v_mps, -leader.braking_mps2);
            let both_stand_s = (v_mps / b).max(leader.v_mps / leader.braking_mps2);
            return own.least_margin_m(&other, 0.0, self.reaction_s, leader.gap_m, both_stand_s);
        }
        let lead = leader.x_m - x_m - leader.gap_m;
        let now = lead - self.reaction_s * v_mps;
        let shed = (v_mps - self.reaction_s * b).max(0.0);
        // Only while the vehicle is faster than the leader by more than it sheds in a reaction time does
        // the margin shrink, until both have stopped shrinking it.
        now.min(now + (leader.v_mps * leader.v_mps - shed * shed) / (2.0 * b))
    }

    /// How far the state is inside the set that is safe toward a merging partner, m; negative outside.
    ///
    /// Both brake fully. Either the vehicle stops before the conflict point, or it is safe toward the partner, as
    /// toward a leader, when it gets there.
    pub fn merge_slack_m(&self, x_m: f64, v_mps: f64, other: Seen, at_m: f64) -> f64 {
        if x_m >= at_m {
            return self.slack_m(x_m, v_mps, other);
        }
        let (stopping, crossing_mps, then) = self.brake_to(x_m, v_mps, other, at_m);
        stopping.max(self.slack_m(at_m, crossing_mps, then))
    }

    /// How far the state is inside the set that is safe toward a crossing partner, m; negative outside, infinite
    /// once the vehicle has reached the crossing.
    ///
    /// Both brake fully. Either the vehicle stops before the conflict area, or the partner is `phi v + delta`
    /// behind its beginning when the vehicle gets there.
    pub fn cross_slack_m(&self, x_m: f64, v_mps: f64, other: Seen, at_m: f64) -> f64 {
        if x_m >= at_m {
            return f64::INFINITY;
        }
        let (stopping, crossing_mps, then) = self.brake_to(x_m, v_mps, other, at_m);
        stopping.max(then.x_m - at_m - self.reaction_s * crossing_mps - other.gap_m)
    }

    /// Both brake fully: by how much the vehicle stops before `at_m` (negative: it does not), the speed with which it
    /// gets there otherwise, and the other vehicle at that instant.
    fn brake_to(&self, x_m: f64, v_mps: f64, other: Seen, at_m: f64) -> (f64, f64, Seen) {
        let b = self.braking_mps2;
        let stopping = at_m - x_m - v_mps * v_mps / (2.0 * b);
        // Below the least crossing speed the square root would magnify rounding; taking it greater than
        // it is errs on the safe side.
        let crossing_mps = (-2.0 * b * stopping).max(LEAST_CROSSING_MPS * LEAST_CROSSING_MPS).sqrt();
        let after_s = ((v_mps - crossing_mps) / b).max(0.0);
        let braking = Held::new(other.x_m, other.v_mps, -other.braking_mps2);
        let then = Seen { x_m: braking.position_m(after_s), v_mps: braking.speed_mps(after_s), ..other };
        (stopping, crossing_mps, then)
    }

    /// How far a state is inside the safe set toward a partner at the beginning of its motion, m.
    pub fn state_slack_m(&self, x_m: f64, v_mps: f64, partner: &Partner) -> f64 {
        self.slack_of(x_m, v_mps, partner, 0.0)
    }

    /// Whether a state is viable toward a partner at the beginning of its motion: full braking keeps what is owed, whatever
    /// the partner does.
    pub fn is_viable(&self, x_m: f64, v_mps: f64, partner: &Partner) -> bool {
        self.state_slack_m(x_m, v_mps, partner) >= VIABLE_FROM_M
    }

    /// The slack at the end of a step driven with `own`, m.
    pub fn slack_after_m(&self, own: &Held, partner: &Partner) -> f64 {
        self.slack_of(own.position_m(self.dt_s), own.speed_mps(self.dt_s), partner, self.dt_s)
    }

    fn slack_of(&self, x_m: f64, v_mps: f64, partner: &Partner, after_s: f64) -> f64 {
        let Partner { kind, at_m, gap_m, braking_mps2, motion } = partner;
        let other = Seen {
            x_m: motion.position_m(after_s),
            v_mps: motion.speed_mps(after_s),
            gap_m: *gap_m,
            braking_mps2: *braking_mps2,
        };
        match kind {
            DutyKind::RearEnd => self.slack_m(x_m, v_mps, other),
            DutyKind::Merge => self.merge_slack_m(x_m, v_mps, other, *at_m),
            DutyKind::Cross => self.cross_slack_m(x_m, v_mps, other, *at_m),
        }
    }

    /// The least margin that counts during the step, m: toward a leader that of every instant, toward a merging
    /// partner that from the merge on, toward a crossing one that at the crossing; infinite when the vehicle
    /// does not get there in the step.
    pub fn least_margin_m(&self, own: &Held, partner: &Partner) -> f64 {
        let Partner { kind, at_m, gap_m, motion, .. } = partner;
        if *kind == DutyKind::RearEnd {
            return own.least_margin_m(motion, 0.0, self.reaction_s, *gap_m, self.dt_s);
        }
        let Some(after_s) = own.passes_m(*at_m, self.dt_s) else { return f64::INFINITY };
        if *kind == DutyKind::Cross {
            return motion.position_m(after_s) - at_m - self.reaction_s * own.speed_mps(after_s) - gap_m;
        }
        let later = |held: &Held| Held::new(held.position_m(after_s), held.speed_mps(after_s), held.u_mps2);
        later(own).least_margin_m(&later(motion), 0.0, self.reaction_s, *gap_m, self.dt_s - after_s)
    }

    /// The ends of a step driven with an acceleration.
    #[inline]
    pub fn ends(&self, x_m: f64, v_mps: f64, u_mps2: f64) -> Ends {
        let (b, dt) = (self.braking_mps2, self.dt_s);
        let end_mps = v_mps + u_mps2 * dt;
        // A vehicle that stops within the step gets no further than with the speed it began with.
        let mean_mps = if end_mps > 0.0 { v_mps + 0.5 * u_mps2 * dt } else { v_mps };
        let (x1_m, v1_mps) = (x_m + mean_mps * dt, end_mps.max(0.0));
        Ends { x0_m: x_m, v0_mps: v_mps, x1_m, v1_mps, dip_m: 0.125 * (u_mps2.abs() + b) * dt * dt }
    }

    /// Whether a step is admissible toward a partner at `(x_m, v_mps)` that brakes fully, by a wide berth: what most steps keep,
    /// and takes no root and no division to see. Who does not keep it may still be admissible.
    #[inline]
    pub fn plainly_admits(&self, own: &Ends, kind: DutyKind, at_m: f64, other: &Seen) -> bool {
        let (b, dt) = (self.braking_mps2, self.dt_s);
        if kind != DutyKind::RearEnd && own.x1_m < at_m {
            // It can stop before the point; times 2 B, so that nothing is divided.
            return 2.0 * b * (at_m - own.x1_m - 2.0 * RESERVE_M) >= own.v1_mps * own.v1_mps;
        }
        if kind == DutyKind::Cross || own.x0_m < at_m && kind == DutyKind::Merge || other.braking_mps2 != b {
            return false;
        }
        // No further than this while it brakes, and no faster.
        let (y1_m, w1_mps) = (other.x_m + (other.v_mps - 0.5 * b * dt) * dt, (other.v_mps - b * dt).max(0.0));
        let before_m = other.x_m - own.x0_m - self.reaction_s * own.v0_mps - other.gap_m;
        let after_m = y1_m - own.x1_m - self.reaction_s * own.v1_mps - other.gap_m;
        let shed = (own.v1_mps - self.reaction_s * b).max(0.0);
        let berth_m = own.dip_m + 2.0 * RESERVE_M;
        // The slack is the margin less what speed takes.
        before_m >= berth_m
            && after_m >= berth_m
            && 2.0 * b * (after_m - berth_m) >= shed * shed - w1_mps * w1_mps
    }

    /// Whether the step may be driven so: its end is safe, and the margin has not been negative, nor less
    /// than it was to begin with, in between.
    fn admits(&self, own: &Held, partner: &Partner) -> bool {
        let floor = match partner.kind {
            DutyKind::RearEnd => {
                let leader = &partner.motion;
                leader.x0_m - own.x0_m - self.reaction_s * own.v0_mps - partner.gap_m
            }
            DutyKind::Merge | DutyKind::Cross => RESERVE_M,
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
        let mut best = Projection { u_mps2: wish_mps2, row: None, toward: None };
        if v_mps + best.u_mps2 * self.dt_s > self.v_max_mps + RESERVE_MPS {
            let u = ((self.v_max_mps - v_mps) / self.dt_s).max(u_min);
            best = Projection { u_mps2: u, row: Some(Row::Speed), toward: None };
        }
        for (at, partner) in partners.enumerate() {
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
                let row = match partner.kind {
                    DutyKind::RearEnd => Row::RearEnd,
                    DutyKind::Merge => Row::Merge,
                    DutyKind::Cross => Row::Cross,
                };
                best = Projection { u_mps2: low, row: Some(row), toward: Some(at) };
            }
        }
        best
    }
}

/// Whether a vehicle may be told to let another pass first: by how much it is inside the safe sets of all it then owes
/// to it, m; infinite when the two do not meet, negatively so where it stands on a point that the other has yet to pass.
pub fn yielding_slack_m(
    shield: &Shield,
    conflicts: &Conflicts,
    duties: &mut Duties,
    first: &Vehicle,
    second: &Vehicle,
) -> f64 {
    if stands_on(conflicts, second, first) {
        return f64::NEG_INFINITY;
    }
    duties.derive(conflicts, &[*first, *second]);
    let slack = |duty: &crate::conflict::Duty| {
        let Some(kind) = duty.in_force(second.x_m, first.x_m) else { return f64::INFINITY };
        let partner = Partner {
            kind,
            at_m: duty.own_m,
            gap_m: duty.gap_m,
            braking_mps2: first.braking_mps2,
            motion: Held::new(first.x_m + duty.shift_m(), first.v_mps, 0.0),
        };
        shield.state_slack_m(second.x_m, second.v_mps, &partner)
    };
    duties.of(1).iter().map(slack).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests;
