//! The OCBF quadratic program (paper: `equ:ocbf_qp`) in closed form.
//!
//! `min lambda e^2 + (u - u_ref)^2 / 2` over `(u, e)` subject to `low <= u <= high` and the CLF row
//! `2 y u + epsilon y^2 <= e`, `y = v - v_ref`. For a given u the best slack is
//! `e = max(0, 2 y u + epsilon y^2)`, which leaves a convex, piecewise quadratic function of u: its free
//! minimum is either `u_ref` (row inactive) or the stationary point of the active piece, and the minimum
//! on the interval is the nearest point of the interval.

use super::rows::Interval;
use std::hint::select_unpredictable;

/// The tracking part of the program.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tracking {
    /// Reference acceleration u_ref, m/s^2.
    pub u_ref_mps2: f64,
    /// Speed error y = v - v_ref, m/s.
    pub error_mps: f64,
    /// CLF rate epsilon, 1/s.
    pub clf_rate_per_s: f64,
    /// Weight lambda of the squared slack; 0 switches the CLF row off.
    pub slack_weight: f64,
}

impl Tracking {
    /// The minimiser without bounds on u.
    #[inline(always)]
    pub fn free_minimum_mps2(&self) -> f64 {
        let y = self.error_mps;
        let row = 2.0 * y * self.u_ref_mps2 + self.clf_rate_per_s * y * y;
        let w = self.slack_weight;
        let tracked = (self.u_ref_mps2 - 4.0 * w * self.clf_rate_per_s * y * y * y) / (1.0 + 8.0 * w * y * y);
        // Either is the case for every other vehicle: no branch could be foretold.
        select_unpredictable(row <= 0.0 || w == 0.0, self.u_ref_mps2, tracked)
    }

    /// The value of the objective at u, with the best slack.
    pub fn objective(&self, u_mps2: f64) -> f64 {
        let y = self.error_mps;
        let slack = (2.0 * y * u_mps2 + self.clf_rate_per_s * y * y).max(0.0);
        self.slack_weight * slack * slack + 0.5 * (u_mps2 - self.u_ref_mps2) * (u_mps2 - self.u_ref_mps2)
    }
}

/// Solves the program; `None` when no acceleration satisfies the rows.
#[inline(always)]
pub fn solve(tracking: &Tracking, interval: &Interval) -> Option<f64> {
    if interval.is_empty() {
        return None;
    }
    Some(tracking.free_minimum_mps2().clamp(interval.low, interval.high))
}
