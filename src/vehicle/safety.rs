//! Safety conditions between two vehicles: margins, and the barrier rows that keep them.

/// `coefficient * u <= bound`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inequality {
    /// Factor of u; >= 0 in every safety row.
    pub coefficient: f64,
    /// Right-hand side.
    pub bound: f64,
}

/// The vehicle and its partner as a safety row sees them; positions in the vehicle's coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Own position, m.
    pub x_m: f64,
    /// Own speed, m/s.
    pub v_mps: f64,
    /// Partner's position, m.
    pub partner_x_m: f64,
    /// Partner's speed, m/s.
    pub partner_v_mps: f64,
    /// Partner's acceleration over the step just ended, m/s^2.
    pub partner_u_mps2: f64,
}

/// Rear-end safety (paper: `Safety`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RearEnd {
    /// Reaction time phi, s.
    pub reaction_s: f64,
    /// Standstill gap delta, m.
    pub gap_m: f64,
    /// Barrier gain k1, 1/s.
    pub k_per_s: f64,
    /// Strongest braking, m/s^2.
    pub u_min_mps2: f64,
}

impl RearEnd {
    /// `b1 = x_p - x - phi v - delta`, m.
    pub fn margin_m(&self, p: &Pair) -> f64 {
        p.partner_x_m - p.x_m - self.reaction_s * p.v_mps - self.gap_m
    }

    /// `phi u <= v_p - v + k1 b1`.
    pub fn row(&self, p: &Pair) -> Inequality {
        Inequality {
            coefficient: self.reaction_s,
            bound: p.partner_v_mps - p.v_mps + self.k_per_s * self.margin_m(p),
        }
    }

    /// The row for u held over `dt_s`: `b1` after the step keeps `1 - k1 dt` of its value. Exact, with
    /// the partner assumed to hold the acceleration it last showed.
    pub fn sampled_row(&self, p: &Pair, dt_s: f64) -> Inequality {
        Inequality {
            coefficient: self.reaction_s * dt_s + 0.5 * dt_s * dt_s,
            bound: (p.partner_v_mps - p.v_mps) * dt_s
                + 0.5 * p.partner_u_mps2 * dt_s * dt_s
                + (self.k_per_s * dt_s).min(1.0) * self.margin_m(p),
        }
    }

    /// `v_p - v - phi u_min`, which the feasibility row keeps non-negative, m/s.
    pub fn reserve_mps(&self, p: &Pair) -> f64 {
        p.partner_v_mps - p.v_mps - self.reaction_s * self.u_min_mps2
    }

    /// Whether the conditions for leaving FE mode hold (section "Feasibility Enforcement Mode").
    pub fn may_be_tracked(&self, p: &Pair) -> bool {
        self.margin_m(p) >= 0.0 && satisfiable_at(&self.row(p), self.u_min_mps2) && self.reserve_mps(p) >= 0.0
    }

    /// `u <= u_p + k1 (v_p - v - phi u_min)` (`equ:candidate`).
    pub fn feasibility_row(&self, p: &Pair) -> Inequality {
        Inequality { coefficient: 1.0, bound: p.partner_u_mps2 + self.k_per_s * self.reserve_mps(p) }
    }
}

/// Merging safety (paper: `SafeMerging`), with phi_2 = phi / L.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Merge {
    /// phi / L, s/m.
    pub reaction_per_length: f64,
    /// Standstill gap delta, m.
    pub gap_m: f64,
    /// Barrier gain k2, 1/s.
    pub k_per_s: f64,
    /// Strongest braking, m/s^2.
    pub u_min_mps2: f64,
}

impl Merge {
    /// `b2 = x_c - x - (phi/L) x v - delta`, m.
    pub fn margin_m(&self, p: &Pair) -> f64 {
        p.partner_x_m - p.x_m - self.reaction_per_length * p.x_m * p.v_mps - self.gap_m
    }

    /// `v_c - v - (phi/L) v^2`, m/s.
    fn drift_mps(&self, p: &Pair) -> f64 {
        p.partner_v_mps - p.v_mps - self.reaction_per_length * p.v_mps * p.v_mps
    }

    /// `(phi/L) x u <= v_c - v - (phi/L) v^2 + k2 b2`.
    pub fn row(&self, p: &Pair) -> Inequality {
        Inequality {
            coefficient: (self.reaction_per_length * p.x_m).max(0.0),
            bound: self.drift_mps(p) + self.k_per_s * self.margin_m(p),
        }
    }

    /// `v_c - v - (phi/L) v^2 - (phi/L) x u_min`, which the feasibility row keeps non-negative, m/s.
    pub fn reserve_mps(&self, p: &Pair) -> f64 {
        self.drift_mps(p) - self.reaction_per_length * p.x_m * self.u_min_mps2
    }

    /// Whether the conditions for leaving FE mode hold (section "Feasibility Enforcement Mode").
    pub fn may_be_tracked(&self, p: &Pair) -> bool {
        self.margin_m(p) >= 0.0 && satisfiable_at(&self.row(p), self.u_min_mps2) && self.reserve_mps(p) >= 0.0
    }

    /// `(1 + 2 (phi/L) v) u <= u_c - (phi/L) v u_min + k2 (reserve)` (`equ:candidate2`).
    pub fn feasibility_row(&self, p: &Pair) -> Inequality {
        Inequality {
            coefficient: 1.0 + 2.0 * self.reaction_per_length * p.v_mps,
            bound: p.partner_u_mps2 - self.reaction_per_length * p.v_mps * self.u_min_mps2
                + self.k_per_s * self.reserve_mps(p),
        }
    }
}

/// Whether a row can be satisfied by braking at `u_min_mps2`.
pub fn satisfiable_at(row: &Inequality, u_min_mps2: f64) -> bool {
    row.coefficient * u_min_mps2 <= row.bound
}
