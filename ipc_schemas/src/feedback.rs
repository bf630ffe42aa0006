//! World → a controller written elsewhere: what became of its last answer.

use core::fmt;

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::state::NO_VEHICLE;
use crate::{CodeValue, record};

codes! {
    /// [`Feedback::row`]: nothing of the shield's; the record is about a frame that was refused.
    pub const ROW_NONE: u16 = 0;
    /// [`Feedback::row`]: the greatest speed of the vehicle.
    pub const ROW_SPEED: u16 = 1;
    /// [`Feedback::row`]: the margin toward a vehicle ahead.
    pub const ROW_REAR_END: u16 = 2;
    /// [`Feedback::row`]: the margin toward a vehicle that passes a merge first.
    pub const ROW_MERGE: u16 = 3;
    /// [`Feedback::row`]: the margin toward a vehicle that crosses first.
    pub const ROW_CROSS: u16 = 4;
    /// [`Feedback::row`]: the command was not within the vehicle's limits, or no number.
    pub const ROW_LIMITS: u16 = 5;

    /// [`Feedback::rule`]: no frame was refused; the record is about the shield.
    pub const RULE_NONE: u16 = 0;
    /// [`Feedback::rule`]: not within the limits.
    pub const RULE_LIMITS: u16 = 1;
    /// [`Feedback::rule`]: no number.
    pub const RULE_NOT_FINITE: u16 = 2;
    /// [`Feedback::rule`]: another value than the only one there can be.
    pub const RULE_OTHER: u16 = 3;
    /// [`Feedback::rule`]: the vehicle is in no zone.
    pub const RULE_UNKNOWN: u16 = 4;
    /// [`Feedback::rule`]: another controller drives the vehicle.
    pub const RULE_FOREIGN: u16 = 5;
    /// [`Feedback::rule`]: the vehicle is commanded twice.
    pub const RULE_TWICE: u16 = 6;
    /// [`Feedback::rule`]: the vehicle has no command at its place in the frame.
    pub const RULE_MISSING: u16 = 7;
    /// [`Feedback::rule`]: nobody asked for an answer to the step.
    pub const RULE_UNASKED: u16 = 8;

    /// [`Feedback::field`]: none; the record is about the shield.
    pub const FIELD_NONE: u16 = 0;
    /// [`Feedback::field`]: `u_mps2` of a command.
    pub const FIELD_U_MPS2: u16 = 1;
    /// [`Feedback::field`]: `planned_exit_time_s` of a command.
    pub const FIELD_PLANNED_EXIT_TIME_S: u16 = 2;
    /// [`Feedback::field`]: `planned_exit_speed_mps` of a command.
    pub const FIELD_PLANNED_EXIT_SPEED_MPS: u16 = 3;
    /// [`Feedback::field`]: `vehicle` of a command.
    pub const FIELD_VEHICLE: u16 = 4;
    /// [`Feedback::field`]: `zone` of a command.
    pub const FIELD_ZONE: u16 = 5;
    /// [`Feedback::field`]: `verdict` of a command.
    pub const FIELD_VERDICT: u16 = 6;
    /// [`Feedback::field`]: `step` of the header.
    pub const FIELD_STEP: u16 = 7;
    /// [`Feedback::field`]: `record_count` of the header.
    pub const FIELD_RECORD_COUNT: u16 = 8;
    /// [`Feedback::field`]: `generation` of the header.
    pub const FIELD_GENERATION: u16 = 9;
    /// [`Feedback::field`]: `run_id` of the header; its values do not stand here.
    pub const FIELD_RUN_ID: u16 = 10;
    /// [`Feedback::field`]: `schema_hash` of the header; its values do not stand here.
    pub const FIELD_SCHEMA_HASH: u16 = 11;
    /// [`Feedback::field`]: `sender_role` or `sender_index` of the header; their values do not stand here.
    pub const FIELD_SENDER: u16 = 12;
}

record! {
    /// What became of a command, or why a frame of commands was not taken.
    ///
    /// Where `row` is not 0: what the shield found of a vehicle's command, the last word on it where there were several. Where
    /// `rule` is not 0: why a frame was refused, by the first record at fault. A frame of the first comes before the state of
    /// the step after the command, and only where there is something to say; one of the second at once.
    #[type_name("cz.Feedback.v1")]
    pub struct Feedback {
        /// `row`: what was to be applied, m/s^2. `rule`: what the field held (0 where it is no number).
        pub value: f64,
        /// The least that was allowed.
        pub least: f64,
        /// The greatest that was allowed; the shield's, where `row` says so. What was applied is `u_mps2` of the state: with the
        /// shield only observing, this is not.
        pub greatest: f64,
        /// Step of the command.
        pub step: u64,
        /// The vehicle, or `NO_VEHICLE`.
        pub vehicle: u32,
        /// Its zone, or `NO_ZONE`.
        pub zone: u32,
        /// `row`: the vehicle toward which, or `NO_VEHICLE`.
        pub toward: u32,
        /// `rule`: place in the frame of the record at fault.
        pub record: u32,
        /// Index of the controller that sent the command.
        pub controller: u16,
        /// What of the shield bounded the command: 1 speed, 2 rear end, 3 merge, 4 cross, 5 limits.
        pub row: u16,
        /// What the frame broke.
        pub rule: u16,
        /// The field that did.
        pub field: u16,
    }
}

/// The name that a code of this module stands for, such as `rear_end` or `u_mps2`.
fn named(prefix: &str, code: u16) -> String {
    let mut known = CODES.iter().filter(|known| known.value == CodeValue::U16(code));
    let name = known.find_map(|known| known.name.strip_prefix(prefix));
    name.map_or_else(|| format!("{}{code}", prefix.to_lowercase()), str::to_lowercase)
}

impl Feedback {
    /// The field at fault, as it is called in the records.
    pub fn field_name(&self) -> String {
        named("FIELD_", self.field)
    }

    /// The rule that was broken: the name of its code.
    pub fn rule_name(&self) -> String {
        named("RULE_", self.rule)
    }

    /// What of the shield bounded the command: the name of its code.
    pub fn row_name(&self) -> String {
        named("ROW_", self.row)
    }
}

impl fmt::Display for Feedback {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Feedback { value, least, greatest, vehicle, .. } = *self;
        write!(f, "step {}: ", self.step)?;
        if self.row == ROW_LIMITS {
            return write!(f, "u_mps2 of vehicle {vehicle} was not within its limits, {greatest} taken");
        }
        if self.row != ROW_NONE {
            write!(
                f,
                "vehicle {vehicle} was to have {value} m/s^2, at most {greatest} by {}",
                self.row_name()
            )?;
            return if self.toward == NO_VEHICLE { Ok(()) } else { write!(f, " toward {}", self.toward) };
        }
        let field = self.field_name();
        match self.rule {
            RULE_UNKNOWN => return write!(f, "vehicle {vehicle} is in no zone"),
            RULE_FOREIGN => return write!(f, "vehicle {vehicle} is driven by another controller"),
            RULE_TWICE => return write!(f, "vehicle {vehicle} is commanded twice"),
            RULE_MISSING => {
                return write!(f, "vehicle {vehicle} has no command at place {} of the frame", self.record);
            }
            RULE_UNASKED => return write!(f, "nobody asked for this answer"),
            _ => f.write_str(&field)?,
        }
        if vehicle != NO_VEHICLE {
            write!(f, " of vehicle {vehicle}")?;
        }
        match self.rule {
            RULE_NOT_FINITE => write!(f, " is no number"),
            RULE_LIMITS if value > greatest => write!(f, " is {value}, at most {greatest} allowed"),
            RULE_LIMITS => write!(f, " is {value}, at least {least} allowed"),
            _ if matches!(self.field, FIELD_RUN_ID | FIELD_SCHEMA_HASH | FIELD_SENDER) => {
                write!(f, " is not the one expected")
            }
            _ => write!(f, " is {value}, expected {least}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_and_rows_in_words() {
        let refused = Feedback {
            value: 9.0,
            least: -4.0,
            greatest: 4.0,
            step: 12,
            vehicle: 17,
            rule: RULE_LIMITS,
            field: FIELD_U_MPS2,
            ..Feedback::default()
        };
        assert_eq!(refused.to_string(), "step 12: u_mps2 of vehicle 17 is 9, at most 4 allowed");
        let low = Feedback { value: -5.5, ..refused };
        assert_eq!(low.to_string(), "step 12: u_mps2 of vehicle 17 is -5.5, at least -4 allowed");
        let count = Feedback {
            rule: RULE_OTHER,
            field: FIELD_RECORD_COUNT,
            vehicle: NO_VEHICLE,
            least: 3.0,
            ..refused
        };
        assert_eq!(count.to_string(), "step 12: record_count is 9, expected 3");
        let row = Feedback { rule: 0, field: 0, row: ROW_REAR_END, toward: 16, greatest: -1.5, ..refused };
        assert_eq!(
            row.to_string(),
            "step 12: vehicle 17 was to have 9 m/s^2, at most -1.5 by rear_end toward 16"
        );
    }
}
