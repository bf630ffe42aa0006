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

record! {
    /// One vehicle's command for the step, and what its controller must remember.
    ///
    /// Commands come in the order of the state frame. The `plan_*` fields and `mode` are the
    /// controller's memory: with them a frame holds all that a controller needs to go on from it. A
    /// controller of another kind may use them freely.
    #[type_name("cz.VehicleCommand.v1")]
    pub struct VehicleCommand {
        /// Acceleration over `[k * dt, (k + 1) * dt)`, m/s^2.
        pub u_mps2: f64,
        /// Broadcast intent: planned instant at the conflict point, s (0 when there is no plan).
        pub planned_exit_time_s: f64,
        /// Broadcast intent: planned speed there, m/s.
        pub planned_exit_speed_mps: f64,
        /// Memory: instant at which the plan starts, s.
        pub plan_start_s: f64,
        /// Memory: position at that instant, m.
        pub plan_origin_m: f64,
        /// Memory: speed at that instant, m/s (coefficient c).
        pub plan_v0_mps: f64,
        /// Memory: coefficient a of u*(t) = a t + b, m/s^3.
        pub plan_a: f64,
        /// Memory: coefficient b, m/s^2.
        pub plan_b: f64,
        /// Memory: duration T of the plan, s (0 when there is no plan).
        pub plan_duration_s: f64,
        /// Memory: terminal speed the plan was made for, m/s (-1 when it was free).
        pub plan_terminal_mps: f64,
        /// The vehicle.
        pub vehicle: u32,
        /// Its zone.
        pub zone: u32,
        /// Bit per row that decided the command: 0 u_min, 1 u_max, 2 v_min, 3 v_max, 4 rear end,
        /// 5 rear-end feasibility, 6 merge, 7 merge feasibility.
        pub binding_rows: u32,
        /// Memory: 0 entered, 1 FE, 2 OCBF.
        pub mode: u16,
        /// 0 nominal, 1 FE, 2 bound by rows, 3 infeasible; only put in by the world when a deadline was
        /// missed, and refused from a controller: 4 held, 5 held within what the shield allows.
        pub verdict: u16,
    }
}
