//! The ranges values are taken from. They are far wider than any road or vehicle needs, and far narrower than
//! where formulas overflow, a step never ends, or a frame does not fit into memory.

use std::fmt;

/// Values from one to another, both included.
#[derive(Clone, Copy, Debug)]
pub(super) struct Range {
    least: f64,
    greatest: f64,
    /// Whether 0 is taken as well.
    zero: bool,
    /// What it is a range of, and its unit; for messages.
    what: &'static str,
    unit: &'static str,
}

const fn range(what: &'static str, least: f64, greatest: f64, unit: &'static str) -> Range {
    Range { least, greatest, zero: false, what, unit }
}

/// `dt_s`.
pub(super) const STEP: Range = range("a step", 1e-4, 10.0, "s");
/// `vehicle.u_min_mps2`.
pub(super) const BRAKING: Range = range("an acceleration", -100.0, -0.01, "m/s^2");
/// `vehicle.u_max_mps2`.
pub(super) const ACCELERATION: Range = range("an acceleration", 0.01, 100.0, "m/s^2");
/// `vehicle.v_min_mps`.
pub(super) const LEAST_SPEED: Range = range("a speed", 0.0, 1000.0, "m/s");
/// `vehicle.v_max_mps`.
pub(super) const GREATEST_SPEED: Range = range("a speed", 0.1, 1000.0, "m/s");
/// `vehicle.length_m`.
pub(super) const VEHICLE_LENGTH: Range = range("a length", 0.01, 1000.0, "m");
/// `vehicle.reaction_time_s`.
pub(super) const REACTION_TIME: Range = range("a time", 0.001, 100.0, "s");
/// `vehicle.standstill_gap_m`.
pub(super) const STANDSTILL_GAP: Range = range("a gap", 0.0, 1000.0, "m");
/// `objective.beta`, also where it comes from `alpha`.
pub(super) const BETA: Range = range("a weight", 1e-6, 1e6, "m^2/s^4");
/// `control.k_*_per_s` and `control.clf_rate_per_s`.
pub(super) const GAIN: Range = range("a gain", 1e-6, 1e6, "1/s");
/// `control.slack_weight`.
pub(super) const SLACK_WEIGHT: Range = Range { zero: true, ..range("a weight", 1e-6, 1e6, "m^2/s^4") };
/// `zones.approaches.length_m`, and of every path. A frame has room for the vehicles that fit.
pub(super) const PATH_LENGTH: Range = range("a length", 1.0, 1e6, "m");
/// `zones.segments.length_m`; a path as a whole has at least [`PATH_LENGTH`].
pub(super) const SEGMENT_LENGTH: Range = range("a length", 0.01, 1e6, "m");
/// `zones.crossings.length_m`.
pub(super) const CROSSING_LENGTH: Range = range("a length", 0.1, 1000.0, "m");
/// `share` of paths, routes and kinds of vehicles.
pub(super) const SHARE: Range = Range { zero: true, ..range("a weight", 1e-6, 1e6, "") };
/// `zones.approaches.link_m`.
pub(super) const LINK_LENGTH: Range = Range { zero: true, ..range("a length", 1.0, 1e6, "m") };
/// `zones.approaches.link_speed_mps`, which does not exceed `v_max_mps` either.
pub(super) const LINK_SPEED: Range = range("a speed", 0.01, 1000.0, "m/s");
/// Terminal speeds of flow policies, which do not exceed `v_max_mps` either.
pub(super) const FLOW_SPEED: Range = range("a speed", 0.01, 1000.0, "m/s");
/// `gain_mps` of flow policies.
pub(super) const FLOW_GAIN: Range = range("a gain", 0.0, 1000.0, "m/s per vehicle");
/// `offset_mps` of a flow policy.
pub(super) const FLOW_OFFSET: Range = range("a speed difference", -1000.0, 1000.0, "m/s");
/// `control.viable.price_of_exposure_mps4`.
pub(super) const PRICE_OF_EXPOSURE: Range = Range { zero: true, ..range("a price", 1e-6, 1e6, "m/s^4") };
/// `coordination.price_of_time`.
pub(super) const PRICE_OF_TIME: Range = range("a share", 0.0, 100.0, "");
/// `coordination.tandem_weight`.
pub(super) const TANDEM_WEIGHT: Range = range("a weight", 0.01, 1.0, "");
/// Speeds and deviations of human drivers.
pub(super) const HUMAN_SPEED: Range = range("a speed", 0.1, 1000.0, "m/s");
/// The same, where none is one.
pub(super) const DEVIATION: Range = range("a deviation", 0.0, 10.0, "");
/// Accelerations of human drivers, as positive numbers.
pub(super) const HUMAN_ACCELERATION: Range = range("an acceleration", 0.1, 100.0, "m/s^2");
/// Times of human drivers.
pub(super) const HUMAN_TIME: Range = range("a time", 0.0, 100.0, "s");
/// `delay_s`: what is seen is remembered that long, step by step.
pub(super) const HUMAN_DELAY: Range = range("a time", 0.0, 5.0, "s");
/// `scares_per_h`.
pub(super) const RATE: Range = range("a rate", 0.0, 1800.0, "1/h");
/// `automated` of a road.
pub(super) const PART: Range = range("a share", 0.0, 1.0, "");
/// `min_headway_s` of random arrivals.
pub(super) const HEADWAY: Range = range("a time", 0.0, 1e6, "s");

/// No run has more steps than this.
pub(super) const MAX_STEPS: f64 = 1e9;

/// Instants above this are refused: step numbers times nanoseconds stay far within 64 bits.
pub(super) const MAX_TIME_S: f64 = 1e9;

/// 10 vehicles per second: no lane carries it, and it bounds the work per simulated second.
pub(super) const MAX_RATE_PER_HOUR: f64 = 36_000.0;

/// Nothing is measured more wrongly than this, in m or m/s.
pub(super) const MAX_ERROR: f64 = 1e6;

/// No command is later than this, in steps.
pub(super) const MAX_DELAY: u32 = 1000;

/// No more kinds of vehicles than this.
pub(super) const MAX_KINDS: usize = 64;

/// No more zones, roads, or paths of a zone than this: frames carry their indices in 16 bits.
pub(super) const MAX_COUNT: usize = 65_535;

impl Range {
    /// Whether the value is one of them; NaN is not.
    pub fn contains(&self, value: f64) -> bool {
        (self.zero && value == 0.0) || (self.least..=self.greatest).contains(&value)
    }
}

/// What is expected, in words.
impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Range { least, greatest, zero, what, unit } = *self;
        let zero = if zero { "0, or " } else { "" };
        write!(f, "{zero}{what} from {} to {}", Short(least), Short(greatest))?;
        if unit.is_empty() { Ok(()) } else { write!(f, " {unit}") }
    }
}

/// A number with its zeros in the exponent when they are many.
struct Short(f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = self.0.abs();
        let is_plain = size == 0.0 || (1e-3..1e5).contains(&size);
        if is_plain { write!(f, "{}", self.0) } else { write!(f, "{:e}", self.0) }
    }
}
