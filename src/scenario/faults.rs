//! What goes wrong on purpose: with sensors, on the way to the vehicles, and in controllers.

use super::ZoneId;
use serde::{Deserialize, Serialize};

/// All faults of a scenario.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Faults {
    /// Noise on what every vehicle reports.
    pub noise: Option<Noise>,
    /// Sensors that are wrong, in the order in which they act on a report.
    pub sensors: Vec<SensorFault>,
    /// Commands that come late or never.
    pub commands: Option<CommandFaults>,
    /// Controllers that are silent for a while.
    pub stalls: Vec<Stall>,
}

/// Part of the run: from an instant up to, but not including, another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Span {
    /// First instant, s.
    pub from_s: f64,
    /// First instant after it, s.
    pub until_s: f64,
}

impl Span {
    /// Whether the instant is within it.
    pub fn contains(&self, time_s: f64) -> bool {
        self.from_s <= time_s && time_s < self.until_s
    }
}

/// Part of the vehicles: those on some paths, and of these a fraction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scope {
    /// Zone and path, ascending; everywhere, links included, when absent.
    pub paths: Option<Vec<(ZoneId, u32)>>,
    /// Probability with which a vehicle belongs to it, for its whole life; 0 < fraction <= 1.
    pub fraction: f64,
}

impl Scope {
    /// Whether the place belongs to it; a link has no zone's index.
    pub fn reaches(&self, zone: ZoneId, path: u32) -> bool {
        self.paths.as_ref().is_none_or(|all| all.binary_search(&(zone, path)).is_ok())
    }
}

/// Errors of every measurement, of mean 0 and independent of each other.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Noise {
    /// Standard deviation of the position, m.
    pub position_sd_m: f64,
    /// Standard deviation of the speed, m/s.
    pub speed_sd_mps: f64,
    /// When.
    pub span: Span,
}

/// Sensors that are wrong.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SensorFault {
    /// In what way.
    pub kind: SensorKind,
    /// Whose.
    pub scope: Scope,
    /// When.
    pub span: Span,
}

/// How a sensor is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum SensorKind {
    /// By a constant.
    Bias {
        /// Added to the position, m.
        position_m: f64,
        /// Added to the speed, m/s.
        speed_mps: f64,
    },
    /// It repeats what it said when the fault began, or when the vehicle came into the zone.
    Frozen,
}

/// What happens to commands on their way to the vehicles.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CommandFaults {
    /// Probability with which a command never arrives.
    pub loss: f64,
    /// By how many steps those that are late are late.
    pub delay_steps: u32,
    /// Probability with which a command that is not lost is late.
    pub delay_probability: f64,
    /// When they are sent.
    pub span: Span,
}

/// A controller that says nothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stall {
    /// To whom.
    pub scope: Scope,
    /// When.
    pub span: Span,
}
