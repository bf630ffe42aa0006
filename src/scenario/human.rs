//! Human drivers: a kind of vehicle that nobody commands.

use super::keys;
use serde::{Deserialize, Serialize};

/// How humans decide who passes a conflict point first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Yielding {
    /// They obey the coordinator: each lets those pass that are before it in the zone's passing order.
    Order,
    /// By the road's rank; of equal roads, and among those of one rank, who came into the zone first. Whoever has to give
    /// way goes ahead nevertheless where the gap is large enough.
    Priority,
    /// The same as if all roads were of one rank.
    Gap,
}

impl Yielding {
    /// The words a scenario uses, the default first.
    pub(super) const WORDS: &'static [(&'static str, Yielding)] =
        &[("order", Yielding::Order), ("priority", Yielding::Priority), ("gap", Yielding::Gap)];
}

/// A human driver (docs/mixed.md): the intelligent driver model of Treiber, Hennecke and Helbing on what was seen a
/// reaction time ago, within the speed from which it can still stop.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HumanParams {
    /// How they decide who goes first.
    pub yields: Yielding,
    /// Mean over drivers of the speed they drive where nobody is in the way, m/s.
    pub desired_mps: f64,
    /// Its standard deviation, m/s.
    pub desired_sd_mps: f64,
    /// Time headway T, s.
    pub headway_s: f64,
    /// Distance between bodies at a standstill s0, m.
    pub jam_gap_m: f64,
    /// Acceleration a, m/s^2.
    pub acceleration_mps2: f64,
    /// Comfortable deceleration b, m/s^2, positive.
    pub comfortable_mps2: f64,
    /// Delay with which they notice what others do, s.
    pub delay_s: f64,
    /// Standard deviation of the acceleration's error, which is drawn anew every second, m/s^2.
    pub noise_mps2: f64,
    /// Least time between their passing a point and the arrival of one that they should have let pass, s.
    pub critical_gap_s: f64,
    /// Having stood for this time since they drove last they go ahead of whoever stands, s.
    pub patience_s: f64,
    /// Hardest braking, m/s^2, positive.
    pub hardest_mps2: f64,
    /// How often they brake as hard as that for two seconds for no reason, 1/h.
    pub scares_per_h: f64,
}

impl HumanParams {
    /// What holds when a kind says nothing; its vehicle's limits give the rest.
    pub(super) const DEFAULT: HumanParams = HumanParams {
        yields: Yielding::Order,
        desired_mps: f64::NAN,
        desired_sd_mps: keys::DESIRED_SD.default(),
        headway_s: keys::TIME_HEADWAY.default(),
        jam_gap_m: keys::JAM_GAP.default(),
        acceleration_mps2: keys::IDM_ACCELERATION.default(),
        comfortable_mps2: keys::COMFORTABLE.default(),
        delay_s: keys::DELAY.default(),
        noise_mps2: keys::NOISE.default(),
        critical_gap_s: keys::CRITICAL_GAP.default(),
        patience_s: keys::PATIENCE.default(),
        hardest_mps2: f64::NAN,
        scares_per_h: keys::SCARES.default(),
    };

    /// Whether it does what coordinators decide.
    pub fn obeys(&self) -> bool {
        self.yields == Yielding::Order
    }
}
