//! Controller → world: one acceleration per vehicle, with the controller's memory.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`VehicleCommand::mode`]: entered, not yet decided on (never sent by the built-in law).
    pub const MODE_ENTERED: u16 = 0;
    /// [`VehicleCommand::mode`]: feasibility-enforcement mode.
    pub const MODE_FE: u16 = 1;
    /// [`VehicleCommand::mode`]: OCBF mode, tracking the reference.
    pub const MODE_OCBF: u16 = 2;
    /// [`VehicleCommand::mode`]: law `viable`, on the way of its own optimum.
    pub const MODE_FREE: u16 = 3;
    /// [`VehicleCommand::mode`]: law `viable`, on schedule.
    pub const MODE_SCHEDULED: u16 = 4;
    /// [`VehicleCommand::mode`]: law `viable`, in a slot behind somebody.
    pub const MODE_SLOT: u16 = 5;

    /// [`VehicleCommand::verdict`]: no row binds, the reference is tracked as wished.
    pub const VERDICT_NOMINAL: u16 = 0;
    /// [`VehicleCommand::verdict`]: feasibility-enforcement mode decided the command.
    pub const VERDICT_FE: u16 = 1;
    /// [`VehicleCommand::verdict`]: at least one row of `binding_rows` decided the command.
    pub const VERDICT_BOUND: u16 = 2;
    /// [`VehicleCommand::verdict`]: no command satisfies all rows; `u_min` was sent.
    pub const VERDICT_INFEASIBLE: u16 = 3;
    /// [`VehicleCommand::verdict`]: the controller missed its deadline; the acceleration before is held.
    pub const VERDICT_HELD: u16 = 4;
    /// [`VehicleCommand::verdict`]: the controller missed its deadline; the acceleration before is held as
    /// far as the shield allows.
    pub const VERDICT_FALLBACK: u16 = 5;
}

/// Number of words a controller may remember of each vehicle.
pub const MEMORY_WORDS: usize = 8;

record! {
    /// One vehicle's command for the step, and what its controller must remember.
    ///
    /// Commands come in the order of the state frame. `mode` and the memory words are the controller's own: they
    /// mean what its law says, and with them a frame holds all that a controller needs to go on from it.
    #[type_name("cz.VehicleCommand.v2")]
    pub struct VehicleCommand {
        /// Acceleration over `[k * dt, (k + 1) * dt)`, m/s^2.
        pub u_mps2: f64,
        /// Broadcast intent: planned instant at the end of the path, s (0 when there is no plan).
        pub planned_exit_time_s: f64,
        /// Broadcast intent: planned speed there, m/s.
        pub planned_exit_speed_mps: f64,
        /// Memory.
        pub memory_0: f64,
        /// Memory.
        pub memory_1: f64,
        /// Memory.
        pub memory_2: f64,
        /// Memory.
        pub memory_3: f64,
        /// Memory.
        pub memory_4: f64,
        /// Memory.
        pub memory_5: f64,
        /// Memory.
        pub memory_6: f64,
        /// Memory.
        pub memory_7: f64,
        /// The vehicle.
        pub vehicle: u32,
        /// Its zone.
        pub zone: u32,
        /// Bit per row that decided the command: 0 u_min, 1 u_max, 2 v_min, 3 v_max, 4 rear end,
        /// 5 rear-end feasibility, 6 merge, 7 merge feasibility, 8 cross, 9 cross feasibility, 10 comfort, 11 bodies.
        pub binding_rows: u32,
        /// Memory: 0 entered, 1 FE, 2 OCBF, 3 free, 4 scheduled, 5 slot; other laws may have other modes.
        pub mode: u16,
        /// 0 nominal, 1 FE, 2 bound by rows, 3 infeasible; only put in by the world when a deadline was
        /// missed, and refused from a controller: 4 held, 5 held within what the shield allows.
        pub verdict: u16,
    }
}

impl VehicleCommand {
    /// The memory words.
    #[inline]
    pub fn memory(&self) -> [f64; MEMORY_WORDS] {
        let Self { memory_0, memory_1, memory_2, memory_3, memory_4, memory_5, memory_6, memory_7, .. } =
            *self;
        [memory_0, memory_1, memory_2, memory_3, memory_4, memory_5, memory_6, memory_7]
    }

    /// The same command with these memory words.
    #[inline]
    pub fn remembering(self, memory: [f64; MEMORY_WORDS]) -> VehicleCommand {
        let [memory_0, memory_1, memory_2, memory_3, memory_4, memory_5, memory_6, memory_7] = memory;
        VehicleCommand {
            memory_0,
            memory_1,
            memory_2,
            memory_3,
            memory_4,
            memory_5,
            memory_6,
            memory_7,
            ..self
        }
    }
}
