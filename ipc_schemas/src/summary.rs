//! Coordinator → neighbouring coordinators: what a zone looks like from outside.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::record;

record! {
    /// A zone's traffic, told to one neighbour at the zone's own events.
    ///
    /// Sent in step `k`, acted upon in step `k + 1`, whether or not both zones live in one process.
    #[type_name("cz.ZoneSummary.v1")]
    pub struct ZoneSummary {
        /// Length l of the first segment the neighbour asked about, m.
        pub segment_m: f64,
        /// Mean speed of the vehicles in that segment, m/s (0 when it is empty).
        pub segment_mean_speed_mps: f64,
        /// Zone that is described.
        pub from_zone: u32,
        /// Zone that is told.
        pub to_zone: u32,
        /// Number of vehicles in the zone, N.
        pub vehicles: u32,
        /// Number of them within the first segment, N(l).
        pub segment_vehicles: u32,
    }
}
