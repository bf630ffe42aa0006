//! What a law is: from one vehicle's situation and partners to its command.
//!
//! A law is one file that implements [`Law`], a variant of [`LawKind`], and three lines at the end of this file: a
//! variant of [`Laws`], and where it is made and found. It is a pure function of what the frames carry and of what it remembers, and what it remembers travels
//! in the command frame as words only it understands.

use super::ocbf::Ocbf;
use super::reference::Terminal;
use super::rows::Row;
use super::viable::Viable;
use crate::conflict::DutyKind;
use crate::scenario::{LawKind, Scenario};
use ipc_schemas::MEMORY_WORDS;

/// A vehicle this one must respect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Partner {
    /// What is owed to it.
    pub kind: DutyKind,
    /// Its position in the vehicle's own coordinate: as far from the conflict point as it is on its
    /// own path, m.
    pub x_m: f64,
    /// Its speed, m/s.
    pub v_mps: f64,
    /// Its acceleration over the step just ended, m/s^2.
    pub u_mps2: f64,
    /// Distance of the conflict point from the origin on the vehicle's path, m (paper: L); means nothing toward a
    /// leader.
    pub conflict_m: f64,
    /// Distance delta to be kept to it, m.
    pub gap_m: f64,
    /// Its position, likewise, from which on nothing is owed to it, m; infinite while the two drive on together.
    pub until_m: f64,
    /// Its kind: index in the scenario's fleet.
    pub vehicle_kind: u16,
    /// The end of its own path in the vehicle's own coordinate, m: where it is then, or has been.
    pub exit_at_m: f64,
    /// Its broadcast intent: instant at which it plans to be there, s; 0 without a plan, past once it has left.
    pub exit_time_s: f64,
    /// Its broadcast intent: speed at that instant, m/s.
    pub exit_speed_mps: f64,
}

impl Partner {
    /// A partner of the first kind that has broadcast no plan, to be completed with where it meets the vehicle.
    pub const fn unplanned(kind: DutyKind, x_m: f64, v_mps: f64, u_mps2: f64) -> Partner {
        Partner {
            kind,
            x_m,
            v_mps,
            u_mps2,
            conflict_m: 0.0,
            gap_m: 0.0,
            until_m: f64::INFINITY,
            vehicle_kind: 0,
            exit_at_m: f64::INFINITY,
            exit_time_s: 0.0,
            exit_speed_mps: 0.0,
        }
    }
}

/// What a coordinator has scheduled a vehicle for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Place on the vehicle's path, m.
    pub at_m: f64,
    /// Instant at which it is to be there, and before which it is not, s.
    pub time_s: f64,
}

/// A vehicle at the start of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Situation {
    /// Simulated time, s.
    pub time_s: f64,
    /// Position since the zone's origin, m.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// Instant of entry, s.
    pub entry_time_s: f64,
    /// Speed at entry, m/s.
    pub entry_speed_mps: f64,
    /// Length of the path, m.
    pub length_m: f64,
    /// Terminal condition in force.
    pub terminal: Terminal,
    /// What its coordinator has scheduled it for, if anything.
    pub schedule: Option<Schedule>,
    /// Kind of vehicle: index in the scenario's fleet.
    pub kind: u16,
}

/// Why the command is what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The reference is tracked: as wished, or as far as this row allows.
    Tracked(Option<Row>),
    /// FE mode brakes.
    Fe,
    /// No acceleration satisfies all rows; `u_min` is commanded.
    Infeasible,
}

/// The command and its reason.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// Acceleration for the step, m/s^2.
    pub u_mps2: f64,
    /// Why.
    pub verdict: Verdict,
    /// Broadcast intent: instant, s, and speed, m/s, at the end of the path; zeros without a plan.
    pub exit: (f64, f64),
}

/// What a law remembers of a vehicle, as it travels in frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Words {
    /// Its mode; 0 for a vehicle that has just entered.
    pub mode: u16,
    /// The rest.
    pub words: [f64; MEMORY_WORDS],
}

impl Words {
    /// Of a vehicle that has just entered.
    pub const ENTERED: Words = Words { mode: 0, words: [0.0; MEMORY_WORDS] };
}

/// A control law.
pub trait Law {
    /// Decides one vehicle's command. `memory` is what it left there in the vehicle's last step, or
    /// [`Words::ENTERED`]; a law that has nothing new to remember writes nothing, for the words are read again at
    /// once, for the frame.
    fn decide<P>(&self, s: &Situation, partners: P, memory: &mut Words) -> Decision
    where
        P: Iterator<Item = Partner> + Clone;
}

/// The laws of a scenario, one of each kind.
#[derive(Clone, Debug)]
pub enum Laws {
    /// The paper's.
    Ocbf(Ocbf),
    /// Slots within what is viable.
    Viable(Viable),
}

impl Laws {
    /// The law of that kind under a scenario's parameters.
    pub fn of(scenario: &Scenario, kind: LawKind) -> Laws {
        match kind {
            LawKind::Ocbf => Laws::Ocbf(Ocbf::new(scenario)),
            LawKind::Viable => Laws::Viable(Viable::new(scenario)),
        }
    }
}

/// Does the same with whichever law it is; each in code of its own.
macro_rules! with_law {
    ($laws:expr, $law:ident => $does:expr) => {
        match $laws {
            $crate::control::law::Laws::Ocbf($law) => $does,
            $crate::control::law::Laws::Viable($law) => $does,
        }
    };
}
pub(super) use with_law;
