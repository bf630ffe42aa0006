//! World → controllers, coordinators, observers: where everything is.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// No vehicle: the value of a vehicle field that names nobody.
    pub const NO_VEHICLE: u32 = u32::MAX;
    /// No zone: a vehicle between zones, on a plain link, or a way that leads out of the network.
    pub const NO_ZONE: u32 = u32::MAX;
    /// No path: a way that leads out of the network.
    pub const NO_PATH: u32 = u32::MAX;
    /// No link: a vehicle in a zone.
    pub const NO_LINK: u32 = u32::MAX;

    /// [`VehicleState::flags`]: entered the zone during the step just ended (an event of the zone).
    pub const STATE_ENTERED: u16 = 1;
    /// [`VehicleState::flags`]: has left the zone and still counts in it (index 0 of the paper). Not to be commanded.
    pub const STATE_LEFT: u16 = 2;
    /// [`VehicleState::flags`]: somebody left the zone during the step just ended (an event of the zone); set in all
    /// its records that have `STATE_LEFT`.
    pub const STATE_LEFT_NOW: u16 = 4;
    /// [`VehicleState::flags`]: driven by a human. Not to be commanded, and without a plan.
    pub const STATE_HUMAN: u16 = 8;
    /// [`VehicleState::flags`]: a human who does not follow the passing order passed a conflict point, or came to wait,
    /// still waits after a while, or waits no more, during the step just ended (an event of the zone).
    pub const STATE_PASSED: u16 = 16;
    /// [`VehicleState::flags`]: a human who does not follow the passing order waits: it has stood for some time with a
    /// conflict point ahead, or is behind one on its lane that has.
    pub const STATE_WAITS: u16 = 32;
}

record! {
    /// One vehicle as one zone sees it.
    ///
    /// A state frame lists zone after zone in ascending order. Each zone's records are the paper's
    /// set S(t): first those that have left the zone and still count in it (`STATE_LEFT`; of each exit and each path
    /// behind it the vehicle that left last, and whoever is not clear of a crossing yet), in the zone's own
    /// coordinate growing past the end of their path; then the members in order of entry. A vehicle that has left
    /// therefore appears a second time as a member of the next zone. Vehicles on plain links follow at the end
    /// with `zone = NO_ZONE`.
    #[type_name("cz.VehicleState.v2")]
    pub struct VehicleState {
        /// Distance travelled since the zone's (or link's) origin on this path, m.
        pub x_m: f64,
        /// Speed, m/s.
        pub v_mps: f64,
        /// Acceleration applied over the step just ended, m/s^2 (0 before the first).
        pub u_mps2: f64,
        /// Instant at which the vehicle passed the zone's origin, s since the start of the run.
        pub entry_time_s: f64,
        /// Speed at that instant, m/s.
        pub entry_speed_mps: f64,
        /// Broadcast intent: instant at which the vehicle plans to reach the end of its path, s (0 when
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
        /// Index of the path within the zone; on a link, of the one it has come by.
        pub path: u32,
        /// Zone it goes to next, or `NO_ZONE`.
        pub next_zone: u32,
        /// Its path there, or `NO_PATH`.
        pub next_path: u32,
        /// Its path in the zone after that, or `NO_PATH`.
        pub then_path: u32,
        /// Index of the link it is on, or `NO_LINK`. Links are numbered by zone and exit they begin at.
        pub link: u32,
        /// Kind of vehicle: index in the scenario's fleet.
        pub kind: u16,
        /// Bit 0 entered, bit 1 has left, bit 2 somebody left in the step just ended, bit 3 human driver, bit 4 a human
        /// passed a conflict point, or came to wait or to go on, bit 5 it waits.
        pub flags: u16,
    }
}

impl VehicleState {
    /// Whether a controller is to command the vehicle by this record.
    #[inline]
    pub fn is_commanded(&self) -> bool {
        self.zone != NO_ZONE && self.flags & (STATE_LEFT | STATE_HUMAN) == 0
    }

    /// Whether it has left the zone that the record is about.
    #[inline]
    pub fn has_left(&self) -> bool {
        self.flags & STATE_LEFT != 0
    }
}
