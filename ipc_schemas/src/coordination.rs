//! Coordinator → controllers: who yields to whom, and the terminal speed.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`Assignment::kind`]: no partner; the record only carries the terminal speed.
    pub const CONSTRAINT_NONE: u16 = 0;
    /// [`Assignment::kind`]: the partner drives ahead on the way the two share (paper: i_p).
    pub const CONSTRAINT_REAR_END: u16 = 1;
    /// [`Assignment::kind`]: the partner passes the merge first (paper: i-1). Behind it, it is the leader.
    pub const CONSTRAINT_MERGE: u16 = 2;
    /// [`Assignment::kind`]: the partner crosses first. Nothing is owed once the vehicle has reached the crossing.
    pub const CONSTRAINT_CROSS: u16 = 3;

    /// [`Assignment::point`]: none; toward a leader.
    pub const NO_POINT: u32 = u32::MAX;

    /// [`Assignment::flags`]: the terminal speed is free; `terminal_speed_mps` is 0 and means nothing.
    pub const ASSIGNMENT_FREE_TERMINAL: u16 = 1;
    /// [`Assignment::flags`]: how often the vehicle was passed in its zone by others that entered later, in units of
    /// [`ASSIGNMENT_PASSED_ONCE`].
    pub const ASSIGNMENT_PASSED: u16 = 6;
    /// [`Assignment::flags`]: the unit of [`ASSIGNMENT_PASSED`].
    pub const ASSIGNMENT_PASSED_ONCE: u16 = 2;
}

record! {
    /// One constraint of one vehicle, as the zone's coordinator decided it.
    ///
    /// A coordinator sends the whole list of each zone that acts in this step; it replaces what the
    /// zone had before. Each member has at least one record, and one per conflict point at which somebody passes
    /// before it; members come in the order of the state frame. Between events the positions of the two decide what is
    /// in force: nothing once the partner is at `until_m`; toward a merging partner what is owed to a leader once the
    /// vehicle has passed the point; toward a crossing one nothing from then on.
    #[type_name("cz.Assignment.v3")]
    pub struct Assignment {
        /// Distance of the conflict point from the zone's origin on the vehicle's path, m. Toward a leader, of a
        /// place that both pass: what counts is the difference to the next field.
        pub own_conflict_m: f64,
        /// The same point's distance from the origin on the partner's path, m.
        pub partner_conflict_m: f64,
        /// Distance delta to be kept to the partner beside phi v, m.
        pub gap_m: f64,
        /// Position of the partner on its own path from which on nothing is owed to it, m; infinite while the two
        /// drive on together.
        pub until_m: f64,
        /// Terminal speed v_m the vehicle is to leave the zone with, m/s.
        pub terminal_speed_mps: f64,
        /// Place on the vehicle's path that its coordinator has scheduled it for, m: normally its last conflict point or
        /// its path's end. Like the terminal speed the same in all records of a vehicle.
        pub scheduled_at_m: f64,
        /// Instant at which it is to be there, and before which it is not, s since the start of the run; 0 when nothing
        /// is scheduled.
        pub scheduled_time_s: f64,
        /// The vehicle bound by this record.
        pub vehicle: u32,
        /// The vehicle it yields to, or `NO_VEHICLE`.
        pub partner: u32,
        /// Zone index.
        pub zone: u32,
        /// Index of the conflict point within the zone, or `NO_POINT`.
        pub point: u32,
        /// Place of the vehicle in the zone's passing order, from 0.
        pub rank: u32,
        /// 0 none, 1 rear end, 2 merge, 3 cross.
        pub kind: u16,
        /// Bit 0: the terminal speed is free; bits 1 and 2: how often the vehicle was passed in its zone.
        pub flags: u16,
    }
}
