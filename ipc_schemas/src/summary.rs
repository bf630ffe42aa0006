//! Coordinator → neighbouring coordinators: what a zone looks like from outside.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`ZoneSummary::flags`]: the vehicle is in the zone that is described and goes to the one that is told; without it,
    /// it is ahead of those that come from the zone that is told.
    pub const SUMMARY_COMING: u16 = 1;
}

record! {
    /// A zone's traffic, told to one neighbour at the zone's own events.
    ///
    /// Sent in step `k`, acted upon in step `k + 1`, whether or not both zones live in one process. Where zones
    /// schedule in tandem, there is a record for each vehicle that concerns the neighbour: those that go there, and, for
    /// those from there, those ahead of them; in order of entry. Otherwise, and when there are none, it is one record
    /// with `vehicle = NO_VEHICLE`. What is not about the vehicle is the same in all.
    #[type_name("cz.ZoneSummary.v2")]
    pub struct ZoneSummary {
        /// Length l of the first segment the neighbour asked about, m.
        pub segment_m: f64,
        /// Mean speed of the vehicles in that segment, m/s (0 when it is empty).
        pub segment_mean_speed_mps: f64,
        /// Position of the vehicle on its path in the downstream one of the two zones, m; negative before its origin.
        pub x_m: f64,
        /// Its speed, m/s.
        pub v_mps: f64,
        /// Instant at which it plans to leave the zone that is described, s (0 when it has no plan).
        pub planned_exit_time_s: f64,
        /// Speed at that instant, m/s.
        pub planned_exit_speed_mps: f64,
        /// Zone that is described.
        pub from_zone: u32,
        /// Zone that is told.
        pub to_zone: u32,
        /// Number of vehicles in the zone, N.
        pub vehicles: u32,
        /// Number of them within the first segment, N(l).
        pub segment_vehicles: u32,
        /// A vehicle, or `NO_VEHICLE`.
        pub vehicle: u32,
        /// Its path in the downstream one of the two zones.
        pub path: u32,
        /// Its path in the zone after that, or `NO_PATH`.
        pub next_path: u32,
        /// Its kind: index in the scenario's fleet.
        pub kind: u16,
        /// Bit 0: the vehicle comes to the zone that is told.
        pub flags: u16,
    }
}
