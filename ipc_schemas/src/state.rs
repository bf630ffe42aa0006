//! World → controllers, coordinators, observers: where everything is.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// No vehicle: the value of a vehicle field that names nobody.
    pub const NO_VEHICLE: u32 = u32::MAX;
    /// No zone: a vehicle between zones, on a plain link.
    pub const NO_ZONE: u32 = u32::MAX;

    /// [`VehicleState::kind`]: a connected automated vehicle, driven by a controller.
    pub const KIND_CAV: u16 = 0;
    /// [`VehicleState::kind`]: a human-driven vehicle (reserved; no v1 world sends one).
    pub const KIND_HUMAN: u16 = 1;

    /// [`VehicleState::flags`]: entered the zone during the step just ended (an event of the zone).
    pub const STATE_ENTERED: u16 = 1;
    /// [`VehicleState::flags`]: index 0 of the zone, the vehicle that left it last. Not to be commanded.
    pub const STATE_LEFT: u16 = 2;
    /// [`VehicleState::flags`]: left the zone during the step just ended (an event of the zone).
    pub const STATE_LEFT_NOW: u16 = 4;
}

record! {
    /// One vehicle as one zone sees it.
    ///
    /// A state frame lists zone after zone in ascending order. Each zone's records are the paper's
    /// set S(t): first the vehicle that left the zone last (`STATE_LEFT`, absent until one has), in
    /// the zone's own coordinate growing past the conflict point; then the members in order of
    /// entry. That vehicle therefore appears a second time as a member of the next zone. Vehicles
    /// on plain links follow at the end with `zone = NO_ZONE`.
    #[type_name("cz.VehicleState.v1")]
    pub struct VehicleState {
        /// Distance travelled since the zone's origin on this path, m.
        pub x_m: f64,
        /// Speed, m/s.
        pub v_mps: f64,
        /// Acceleration applied over the step just ended, m/s^2 (0 before the first).
        pub u_mps2: f64,
        /// Instant at which the vehicle passed the zone's origin, s since the start of the run.
        pub entry_time_s: f64,
        /// Speed at that instant, m/s.
        pub entry_speed_mps: f64,
        /// Broadcast intent: instant at which the vehicle plans to pass the conflict point, s (0 when
        /// it has no plan yet).
        pub planned_exit_time_s: f64,
        /// Broadcast intent: speed at that instant, m/s.
        pub planned_exit_speed_mps: f64,
        /// Vehicle length, m.
        pub length_m: f64,
        /// Vehicle id, unique in the run, ascending with arrival.
        pub vehicle: u32,
        /// Zone index, or `NO_ZONE` on a plain link.
        pub zone: u32,
        /// Index of the path (approach) within the zone.
        pub path: u32,
        /// Kind of vehicle: 0 CAV, 1 human-driven.
        pub kind: u16,
        /// Bit 0 entered, bit 1 index 0 (left), bit 2 left in the step just ended.
        pub flags: u16,
    }
}
