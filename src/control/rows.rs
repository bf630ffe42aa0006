//! Barrier rows: every safety condition as an upper or lower bound on the acceleration.
//!
//! The paper writes each row as `L_f b + L_g b u + k b >= 0` (`equ:cbf`). All of ours have one unknown,
//! so a row is `coefficient * u <= bound`, and their intersection is an [`Interval`].
//!
//! Which row binds differs from vehicle to vehicle, so in a large network a branch on it is mispredicted every
//! other time. Hence the selections.

use crate::vehicle::Inequality;
use std::hint::select_unpredictable;

/// A row, by the bit it has in `VehicleCommand::binding_rows`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Row {
    /// `u >= u_min`.
    UMin = 1,
    /// `u <= u_max`.
    UMax = 1 << 1,
    /// `v >= v_min` as a barrier.
    VMin = 1 << 2,
    /// `v <= v_max` as a barrier.
    VMax = 1 << 3,
    /// Rear-end safety (paper: `Safety`).
    RearEnd = 1 << 4,
    /// Its feasibility row (`equ:candidate`).
    RearEndFeasibility = 1 << 5,
    /// Merging safety (`SafeMerging`).
    Merge = 1 << 6,
    /// Its feasibility row (`equ:candidate2`).
    MergeFeasibility = 1 << 7,
    /// Safety at a crossing: the merging row with the distance to be kept there.
    Cross = 1 << 8,
    /// Its feasibility row.
    CrossFeasibility = 1 << 9,
    /// Comfort toward a leader (law `viable`).
    Comfort = 1 << 10,
    /// Nobody drives through anybody: the second tier of law `viable`.
    Bodies = 1 << 11,
}

impl Row {
    /// All rows, in bit order.
    pub const ALL: [Row; 12] = [
        Row::UMin,
        Row::UMax,
        Row::VMin,
        Row::VMax,
        Row::RearEnd,
        Row::RearEndFeasibility,
        Row::Merge,
        Row::MergeFeasibility,
        Row::Cross,
        Row::CrossFeasibility,
        Row::Comfort,
        Row::Bodies,
    ];

    /// Short name for tables and messages.
    pub fn name(self) -> &'static str {
        match self {
            Row::UMin => "u_min",
            Row::UMax => "u_max",
            Row::VMin => "v_min",
            Row::VMax => "v_max",
            Row::RearEnd => "rear-end",
            Row::RearEndFeasibility => "rear-end feasibility",
            Row::Merge => "merge",
            Row::MergeFeasibility => "merge feasibility",
            Row::Cross => "cross",
            Row::CrossFeasibility => "cross feasibility",
            Row::Comfort => "comfort",
            Row::Bodies => "bodies",
        }
    }
}

/// The accelerations that satisfy all rows: `low <= u <= high`, with the rows that set the ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Least acceleration, m/s^2.
    pub low: f64,
    /// Greatest acceleration, m/s^2.
    pub high: f64,
    /// Row that sets `low`.
    pub low_row: Row,
    /// Row that sets `high`.
    pub high_row: Row,
}

/// Something rows can be added to: the [`Interval`] that reduces them, or a list that keeps them.
pub trait Rows {
    /// Adds `u >= low`.
    fn at_least(&mut self, low: f64, row: Row);
    /// Adds `coefficient * u <= bound`.
    fn at_most(&mut self, inequality: Inequality, row: Row);
}

impl Rows for Vec<(Inequality, Row)> {
    fn at_least(&mut self, low: f64, row: Row) {
        self.push((Inequality { coefficient: -1.0, bound: -low }, row));
    }

    fn at_most(&mut self, inequality: Inequality, row: Row) {
        self.push((inequality, row));
    }
}

impl Interval {
    /// The vehicle's limits.
    pub fn limits(u_min_mps2: f64, u_max_mps2: f64) -> Interval {
        Interval { low: u_min_mps2, high: u_max_mps2, low_row: Row::UMin, high_row: Row::UMax }
    }

    /// Whether no acceleration satisfies all rows.
    pub fn is_empty(&self) -> bool {
        self.low > self.high
    }
}

impl Rows for Interval {
    #[inline]
    fn at_least(&mut self, low: f64, row: Row) {
        let binds = low > self.low;
        self.low = select_unpredictable(binds, low, self.low);
        self.low_row = select_unpredictable(binds, row, self.low_row);
    }

    /// A row without u in it is true or makes the set empty.
    #[inline]
    fn at_most(&mut self, inequality: Inequality, row: Row) {
        let high = if inequality.coefficient > 0.0 {
            inequality.bound / inequality.coefficient
        } else if inequality.bound >= 0.0 {
            return;
        } else {
            f64::NEG_INFINITY
        };
        let binds = high < self.high;
        self.high = select_unpredictable(binds, high, self.high);
        self.high_row = select_unpredictable(binds, row, self.high_row);
    }
}
