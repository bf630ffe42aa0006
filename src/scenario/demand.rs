//! Who arrives when, on which road, how fast.

use serde::{Deserialize, Serialize};

/// The demand of one entry road.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Demand {
    /// Arrivals read from a trace, in order of time.
    Trace(Vec<Arrival>),
    /// A seeded random process.
    Poisson(Poisson),
}

/// One vehicle reaching the origin of its first zone.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Arrival {
    /// Instant, s since the start of the run.
    pub time_s: f64,
    /// Speed at that instant, m/s.
    pub speed_mps: f64,
    /// The route it takes: index in its road's routes; drawn when absent.
    pub route: Option<u32>,
}

/// Shifted-Poisson arrivals: headway = minimum headway + exponential, with the mean set by the rate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Poisson {
    /// Rates, in order of time; the last one's end is the end of the demand.
    pub rates: Vec<RatePeriod>,
    /// Least time between two arrivals on the road, s.
    pub min_headway_s: f64,
    /// Entry speeds.
    pub speed: SpeedDistribution,
}

/// A constant rate over a period.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RatePeriod {
    /// End of the period, s.
    pub until_s: f64,
    /// Vehicles per hour; may be 0.
    pub vehicles_per_hour: f64,
}

/// Normal distribution cut off at both ends (redrawn until within).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpeedDistribution {
    /// Mean, m/s.
    pub mean_mps: f64,
    /// Standard deviation, m/s.
    pub sd_mps: f64,
    /// Least speed, m/s.
    pub min_mps: f64,
    /// Greatest speed, m/s.
    pub max_mps: f64,
}
