//! What a scenario that came as bytes has that no loader leaves in one.

use super::keys;
use super::ranges::Range;

/// The first thing in a scenario that is not as the loader leaves it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ScenarioFault(String);

impl ScenarioFault {
    pub(super) fn of(what: String) -> ScenarioFault {
        ScenarioFault(what)
    }
}

/// What a check gives.
pub(super) type Check = Result<(), ScenarioFault>;

/// Gives a fault unless something holds.
pub(super) fn require(holds: bool, what: impl FnOnce() -> String) -> Check {
    if holds { Ok(()) } else { Err(ScenarioFault::of(what())) }
}

/// Whether a number is finite and within a range; NaN is in none.
pub(super) fn number(what: &str, value: f64, within: impl FnOnce(f64) -> bool) -> Check {
    require(value.is_finite() && within(value), || format!("{what} = {value}"))
}

/// Whether a number is within a range.
pub(super) fn inside(what: &str, value: f64, range: &Range) -> Check {
    number(what, value, |value| range.contains(value))
}

/// Whether a number is one that a declared key takes.
pub(super) fn within(key: &keys::Number, value: f64) -> Check {
    inside(key.name, value, &key.range)
}
