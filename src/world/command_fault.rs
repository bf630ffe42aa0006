//! What can be wrong with a command frame, and how its sender is told.

use ipc_schemas::{self as frames, Feedback};

/// A command frame the world cannot take.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CommandFault {
    /// The vehicle is not a member of any zone: it never existed, is on a link, or has left.
    #[error("record {record}, field vehicle: vehicle {vehicle} is in no zone")]
    UnknownVehicle {
        /// Place in the frame.
        record: usize,
        /// Vehicle named.
        vehicle: u32,
    },
    /// Another controller drives the vehicle.
    #[error("record {record}, field vehicle: vehicle {vehicle} is driven by controller {driver}")]
    ForeignVehicle {
        /// Place in the frame.
        record: usize,
        /// Vehicle named.
        vehicle: u32,
        /// Index of the controller that drives it.
        driver: u32,
    },
    /// The frame commands the vehicle twice.
    #[error("record {record}, field vehicle: vehicle {vehicle} is commanded twice")]
    Duplicate {
        /// Place in the frame of the second.
        record: usize,
        /// Vehicle named.
        vehicle: u32,
    },
    /// A vehicle of the sender has no command where it should have one.
    #[error("record {record}, field vehicle: vehicle {vehicle} of zone {zone} has no command there")]
    MissingVehicle {
        /// Place in the frame at which it was expected.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Its zone.
        zone: u32,
    },
    /// The record names a zone the vehicle is not in.
    #[error("record {record}, field zone: vehicle {vehicle} is in zone {expected}, not {zone}")]
    OtherZone {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Zone named.
        zone: u32,
        /// Zone the vehicle is in.
        expected: u32,
    },
    /// The acceleration is not a number.
    #[error("record {record}, field u_mps2: vehicle {vehicle} is commanded {u_mps2}")]
    NotFinite {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Acceleration commanded.
        u_mps2: f64,
    },
    /// The acceleration is not within the vehicle's limits.
    #[error(
        "record {record}, field u_mps2: vehicle {vehicle} is commanded {u_mps2} m/s^2, which is not within \
         [{min_mps2}, {max_mps2}]"
    )]
    OutOfLimits {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Acceleration commanded.
        u_mps2: f64,
        /// Least allowed.
        min_mps2: f64,
        /// Greatest allowed.
        max_mps2: f64,
    },
    /// The verdict is one that only the world gives, or has no meaning.
    #[error(
        "record {record}, field verdict: vehicle {vehicle} has verdict {verdict}, expected 0 to {}",
        frames::VERDICT_INFEASIBLE
    )]
    BadVerdict {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Verdict claimed.
        verdict: u16,
    },
    /// The planned exit, which other vehicles may read, is not a number.
    #[error("record {record}, field {}: vehicle {vehicle} has {value}", if *is_speed { "planned_exit_speed_mps" } else { "planned_exit_time_s" })]
    BadIntent {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Whether it is the speed, and not the instant.
        is_speed: bool,
        /// What was sent.
        value: f64,
    },
}

impl CommandFault {
    /// The same as a controller is told it; step and controller are for the caller to fill in.
    pub fn feedback(&self) -> Feedback {
        let told = |record: usize, vehicle, rule, field| Feedback {
            record: record as u32,
            vehicle,
            rule,
            field,
            zone: frames::NO_ZONE,
            toward: frames::NO_VEHICLE,
            ..Feedback::default()
        };
        use CommandFault as Fault;
        match *self {
            Fault::UnknownVehicle { record, vehicle } => {
                told(record, vehicle, frames::RULE_UNKNOWN, frames::FIELD_VEHICLE)
            }
            Fault::ForeignVehicle { record, vehicle, .. } => {
                told(record, vehicle, frames::RULE_FOREIGN, frames::FIELD_VEHICLE)
            }
            Fault::Duplicate { record, vehicle } => {
                told(record, vehicle, frames::RULE_TWICE, frames::FIELD_VEHICLE)
            }
            Fault::MissingVehicle { record, vehicle, zone } => {
                Feedback { zone, ..told(record, vehicle, frames::RULE_MISSING, frames::FIELD_VEHICLE) }
            }
            Fault::OtherZone { record, vehicle, zone, expected } => Feedback {
                value: f64::from(zone),
                least: f64::from(expected),
                greatest: f64::from(expected),
                zone: expected,
                ..told(record, vehicle, frames::RULE_OTHER, frames::FIELD_ZONE)
            },
            Fault::NotFinite { record, vehicle, .. } => {
                told(record, vehicle, frames::RULE_NOT_FINITE, frames::FIELD_U_MPS2)
            }
            Fault::OutOfLimits { record, vehicle, u_mps2, min_mps2, max_mps2 } => Feedback {
                value: u_mps2,
                least: min_mps2,
                greatest: max_mps2,
                ..told(record, vehicle, frames::RULE_LIMITS, frames::FIELD_U_MPS2)
            },
            Fault::BadVerdict { record, vehicle, verdict } => Feedback {
                value: f64::from(verdict),
                greatest: f64::from(frames::VERDICT_INFEASIBLE),
                ..told(record, vehicle, frames::RULE_LIMITS, frames::FIELD_VERDICT)
            },
            Fault::BadIntent { record, vehicle, is_speed, .. } => {
                let fields = [frames::FIELD_PLANNED_EXIT_TIME_S, frames::FIELD_PLANNED_EXIT_SPEED_MPS];
                told(record, vehicle, frames::RULE_NOT_FINITE, fields[usize::from(is_speed)])
            }
        }
    }
}
