//! The numbers the paper prints, as they are printed.

/// Travel time, energy and objective of one zone under one policy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Mean travel time, s.
    pub time_s: f64,
    /// Mean energy, m^2/s^3.
    pub energy: f64,
    /// Mean objective (`eqn:energyobj`).
    pub objective: f64,
}

impl Cell {
    /// The weight beta that the three printed numbers imply, with the bounds that follow from each
    /// being rounded to two decimals: (least, nominal, greatest), m^2/s^4.
    pub fn implied_beta(&self) -> (f64, f64, f64) {
        const HALF: f64 = 0.005;
        let difference = self.objective - self.energy;
        (
            (difference - 2.0 * HALF) / (self.time_s + HALF),
            difference / self.time_s,
            (difference + 2.0 * HALF) / (self.time_s - HALF),
        )
    }
}

/// One column of a performance table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Column {
    /// Name of the policy, as the paper has it.
    pub policy: &'static str,
    /// First and second zone.
    pub zones: [Cell; 2],
    /// Printed total objective.
    pub total: f64,
}

impl Column {
    /// Printed total less the sum of the zones' printed objectives.
    pub fn excess(&self) -> f64 {
        self.total - self.zones[0].objective - self.zones[1].objective
    }
}

/// A performance table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Performance {
    /// Label in the paper.
    pub label: &'static str,
    /// The weight alpha its text states.
    pub alpha: f64,
    /// Feedback, fixed, none.
    pub columns: [Column; 3],
}

const fn cell(time_s: f64, energy: f64, objective: f64) -> Cell {
    Cell { time_s, energy, objective }
}

/// `tab:feedback1`: constant traffic.
pub const COMPARISON: Performance = Performance {
    label: "tab:feedback1",
    alpha: 0.0625,
    columns: [
        Column {
            policy: "feedback",
            zones: [cell(12.45, 4.51, 12.81), cell(10.31, 8.32, 15.19)],
            total: 28.00,
        },
        Column {
            policy: "fixed 15",
            zones: [cell(13.44, 5.66, 14.62), cell(12.11, 5.38, 13.46)],
            total: 28.07,
        },
        Column { policy: "none", zones: [cell(10.65, 5.81, 12.92), cell(10.23, 13.31, 20.13)], total: 33.03 },
    ],
};

/// `tab:feedback`: varying traffic.
pub const VARYING: Performance = Performance {
    label: "tab:feedback",
    alpha: 0.25,
    columns: [
        Column {
            policy: "feedback",
            zones: [cell(10.69, 8.45, 36.96), cell(9.72, 9.88, 35.82)],
            total: 72.78,
        },
        Column {
            policy: "fixed 15",
            zones: [cell(12.48, 5.58, 38.85), cell(10.69, 9.41, 37.92)],
            total: 76.77,
        },
        Column { policy: "none", zones: [cell(10.66, 5.81, 34.23), cell(10.23, 13.31, 40.59)], total: 74.72 },
    ],
};

/// A row of `tab:fem_time`: entering the second zone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feasibility {
    /// Vehicles that braked in FE mode.
    pub fe_vehicles: f64,
    /// Their mean time in it, s.
    pub fe_mean_s: f64,
    /// Vehicles that met an infeasible QP.
    pub infeasible: f64,
}

/// `tab:fem_time`: no flow control, fixed 15 m/s, fixed 12 m/s.
pub const FEASIBILITY: [Feasibility; 3] = [
    Feasibility { fe_vehicles: 62.0, fe_mean_s: 0.86, infeasible: 1.0 },
    Feasibility { fe_vehicles: 46.0, fe_mean_s: 0.34, infeasible: 0.0 },
    Feasibility { fe_vehicles: 26.0, fe_mean_s: 0.15, infeasible: 0.0 },
];

/// Terminal speed of the second zone under flow control, m/s: said to be the mean exit speed without.
pub const SECOND_TERMINAL_MPS: f64 = 18.5;

/// beta of a weight alpha with |u| <= 4 m/s^2 (`eqn:energyobj`), m^2/s^4.
pub fn beta_of(alpha: f64) -> f64 {
    alpha * 16.0 / (2.0 * (1.0 - alpha))
}

/// The inverse of [`beta_of`].
pub fn alpha_of(beta: f64) -> f64 {
    beta / (8.0 + beta)
}
