//! The header every frame carries in front of its records.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`FrameHeader::sender_role`]: the world integrator.
    pub const ROLE_WORLD: u16 = 1;
    /// [`FrameHeader::sender_role`]: a coordinator process.
    pub const ROLE_COORDINATOR: u16 = 2;
    /// [`FrameHeader::sender_role`]: a vehicle-controller process.
    pub const ROLE_CONTROLLER: u16 = 3;

    /// [`FrameHeader::flags`]: this is the last state frame of the run; answer nothing, detach.
    pub const FLAG_END_OF_RUN: u32 = 1;
    /// [`FrameHeader::flags`]: in the step before, the world put in commands for a controller that had not
    /// answered in time. What the controllers remember is what was applied, not what they sent.
    pub const FLAG_MISSED: u32 = 2;
}

/// Who sent a frame; the value of [`FrameHeader::sender_role`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u16)]
pub enum Role {
    /// The world integrator.
    World = ROLE_WORLD,
    /// A coordinator process.
    Coordinator = ROLE_COORDINATOR,
    /// A vehicle-controller process.
    Controller = ROLE_CONTROLLER,
}

impl Role {
    /// The role a header names, or `None` for a value no role has.
    pub fn from_code(code: u16) -> Option<Role> {
        match code {
            ROLE_WORLD => Some(Role::World),
            ROLE_COORDINATOR => Some(Role::Coordinator),
            ROLE_CONTROLLER => Some(Role::Controller),
            _ => None,
        }
    }
}

impl core::fmt::Display for Role {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Role::World => "world",
            Role::Coordinator => "coordinator",
            Role::Controller => "controller",
        })
    }
}

record! {
    /// Precedes the records of every frame, whatever its type.
    ///
    /// Free-running: step `k` is answered as soon as it is seen. Paced: the world sends step `k` at
    /// its scheduled instant and the rest is the same.
    #[type_name("cz.FrameHeader.v1")]
    pub struct FrameHeader {
        /// Run the frame belongs to; a frame of another run is refused.
        pub run_id: u64,
        /// Hash of all record layouts; equal on both sides of every attach.
        pub schema_hash: u64,
        /// Step the frame belongs to. State `k` is the world at `k * dt`; command `k` acts on
        /// `[k * dt, (k + 1) * dt)`.
        pub step: u64,
        /// Simulated time of the step, in nanoseconds since the start of the run.
        pub time_ns: u64,
        /// State frames: bit `i` is set when coordinator process `i` acts in this step. Controllers
        /// wait for its coordination frame of this step, and only then.
        pub coordinators_acting: u64,
        /// State frames: bit `i` is set when coordinator process `i` had an event of its own in the
        /// previous step, and therefore sent its neighbours a summary then.
        pub coordinators_summarised: u64,
        /// Role of the sender: 1 world, 2 coordinator, 3 controller.
        pub sender_role: u16,
        /// Index of the sender among the processes of its role.
        pub sender_index: u16,
        /// Generation of the sender: 0 at first, one more after each restart.
        pub generation: u32,
        /// Number of records that follow.
        pub record_count: u32,
        /// Bit 0: end of run. Bit 1: commands were put in in the step before.
        pub flags: u32,
    }
}
