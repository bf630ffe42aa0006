//! The names of the services of a run. One transport prefix isolates a run, so the names are fixed.

use crate::code::codes;

codes! {
    /// World → controllers: [`VehicleState`](crate::VehicleState) of every step.
    pub const SERVICE_STATE: &str = "cz/state";
    /// World → coordinator `i`: [`VehicleState`](crate::VehicleState), only of the steps it acts in and
    /// only of its zones that act; `i` is appended.
    pub const SERVICE_COORDINATOR_STATE_PREFIX: &str = "cz/coordinator-state/";
    /// Coordinators → controllers: [`Assignment`](crate::Assignment) of the steps they act in.
    pub const SERVICE_COORDINATION: &str = "cz/coordination";
    /// Coordinators → coordinator `i`: [`ZoneSummary`](crate::ZoneSummary); `i` is appended.
    pub const SERVICE_SUMMARY_PREFIX: &str = "cz/summary/";
    /// Controllers → world: [`VehicleCommand`](crate::VehicleCommand) of every step.
    pub const SERVICE_COMMAND: &str = "cz/command";
    /// World → controller `i`, where it is one written elsewhere: [`Feedback`](crate::Feedback), where there is something to
    /// say; `i` is appended.
    pub const SERVICE_FEEDBACK_PREFIX: &str = "cz/feedback/";
    /// World → coordinators and controllers: [`Member`](crate::Member), who has which place. Overflows: only
    /// the last frame counts.
    pub const SERVICE_MEMBERS: &str = "cz/members";
    /// World → whoever records the run: every step as one block of bytes. Overflows, so that nobody waits for
    /// its reader.
    pub const SERVICE_OBSERVER: &str = "cz/observer";
    /// Participants → world: [`AttachRequest`](crate::AttachRequest).
    pub const SERVICE_ATTACH: &str = "cz/attach";
    /// World → participants: the scenario as bytes, behind the [`AttachReply`](crate::AttachReply).
    pub const SERVICE_ATTACH_REPLY: &str = "cz/attach-reply";
}
