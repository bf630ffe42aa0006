//! Coordinator → controllers: who yields to whom, and the terminal speed.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`Assignment::kind`]: no partner; the record only carries the terminal speed.
    pub const CONSTRAINT_NONE: u16 = 0;
    /// [`Assignment::kind`]: the partner drives ahead on the same path (paper: i_p).
    pub const CONSTRAINT_REAR_END: u16 = 1;
    /// [`Assignment::kind`]: the partner passes the shared conflict point first (paper: i-1).
    pub const CONSTRAINT_MERGE: u16 = 2;

    /// [`Assignment::flags`]: the terminal speed is free; `terminal_speed_mps` is 0 and means nothing.
    pub const ASSIGNMENT_FREE_TERMINAL: u16 = 1;
}

record! {
    /// One constraint of one vehicle, as the zone's coordinator decided it.
    ///
    /// A coordinator sends the whole list of each zone that acts in this step; it replaces what the
    /// zone had before. Each member has at least one record; a path with several conflict points
    /// has one per point.
    #[type_name("cz.Assignment.v1")]
    pub struct Assignment {
        /// Distance of the conflict point from the zone's origin on the vehicle's path, m.
        pub own_conflict_m: f64,
        /// The same point's distance from the origin on the partner's path, m.
        pub partner_conflict_m: f64,
        /// Terminal speed v_m the vehicle is to leave the zone with, m/s.
        pub terminal_speed_mps: f64,
        /// The vehicle bound by this record.
        pub vehicle: u32,
        /// The vehicle it yields to, or `NO_VEHICLE`.
        pub partner: u32,
        /// Zone index.
        pub zone: u32,
        /// 0 none, 1 rear end, 2 merge.
        pub kind: u16,
        /// Bit 0: the terminal speed is free.
        pub flags: u16,
    }
}
