//! What a plug-in learns of the run when it attaches, in place of the encoded scenario.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`PathSpec::flags`]: the controller that asked drives this path.
    pub const PATH_OWN: u32 = 1;

    /// [`RunSpec::law_flags`]: the reference trajectory follows the condition as the paper prints it.
    pub const LAW_AS_PRINTED: u32 = 1;
    /// [`RunSpec::law_flags`]: a new terminal speed makes a new plan from the present state.
    pub const LAW_REPLAN_FROM_STATE: u32 = 2;
    /// [`RunSpec::law_flags`]: the reference time is the exact root of `x*(t_ref) = x`.
    pub const LAW_EXACT_FEEDBACK: u32 = 4;
    /// [`RunSpec::law_flags`]: the rear-end row is the one for a command held over the step.
    pub const LAW_SAMPLED_ROWS: u32 = 8;
    /// [`RunSpec::law_flags`]: the feasibility rows are present.
    pub const LAW_FEASIBILITY_ROWS: u32 = 16;
    /// [`RunSpec::law_flags`]: the CLF row is present.
    pub const LAW_CLF: u32 = 32;
    /// [`RunSpec::law_flags`]: FE mode asks only for the barriers.
    pub const LAW_FE_BARRIER: u32 = 64;
    /// [`RunSpec::law_flags`]: there is no FE mode.
    pub const LAW_FE_OFF: u32 = 128;

    /// [`RunSpec::shield`]: unsafe commands are applied.
    pub const SHIELD_OFF: u32 = 0;
    /// [`RunSpec::shield`]: unsafe commands are applied and counted.
    pub const SHIELD_OBSERVE: u32 = 1;
    /// [`RunSpec::shield`]: unsafe commands are replaced by the nearest safe ones.
    pub const SHIELD_ON: u32 = 2;
}

record! {
    /// The numbers of a run: step, limits, distances, and the built-in law's gains.
    ///
    /// The reply to a plug-in that joins carries one, then `paths` records of `PathSpec`, then `kinds` records of
    /// `KindSpec`, then for each path a line of UTF-8 text, `ZONE.PATH`.
    #[type_name("cz.RunSpec.v2")]
    pub struct RunSpec {
        /// Step length, s.
        pub dt_s: f64,
        /// The run ends at this instant at the latest, s.
        pub max_time_s: f64,
        /// Weight of time against energy, m^2/s^4.
        pub beta: f64,
        /// Strongest braking, m/s^2, negative.
        pub u_min_mps2: f64,
        /// Strongest acceleration, m/s^2.
        pub u_max_mps2: f64,
        /// Least speed, m/s.
        pub v_min_mps: f64,
        /// Greatest speed, m/s.
        pub v_max_mps: f64,
        /// Reaction time phi, s.
        pub reaction_time_s: f64,
        /// Standstill gap delta, m.
        pub standstill_gap_m: f64,
        /// Vehicle length, m.
        pub vehicle_length_m: f64,
        /// Gain k1 of the rear-end barrier, 1/s.
        pub k_rear_end_per_s: f64,
        /// Gain k2 of the merging barrier, 1/s.
        pub k_merge_per_s: f64,
        /// Gain of the speed barriers, 1/s.
        pub k_speed_per_s: f64,
        /// Rate epsilon of the CLF row, 1/s.
        pub clf_rate_per_s: f64,
        /// Weight lambda of the squared slack.
        pub slack_weight: f64,
        /// Fraction of the path within which FE mode may act.
        pub fe_fraction: f64,
        /// Step length, ns. Simulated time is `step * dt_ns`.
        pub dt_ns: u64,
        /// Seed of the run's random streams.
        pub seed: u64,
        /// Number of zones.
        pub zones: u32,
        /// Number of paths, of all zones.
        pub paths: u32,
        /// Number of kinds of vehicles.
        pub kinds: u32,
        /// 0; room for what comes later.
        pub reserved: u32,
        /// Switches of the built-in law, one bit each.
        pub law_flags: u32,
        /// 0 off, 1 observe, 2 on.
        pub shield: u32,
    }
}

record! {
    /// One path of one zone; zones ascending, then paths.
    #[type_name("cz.PathSpec.v2")]
    pub struct PathSpec {
        /// Length from the zone's origin to its exit, m.
        pub length_m: f64,
        /// Length of the link behind the exit, m (0: none).
        pub link_m: f64,
        /// Zone index.
        pub zone: u32,
        /// Index of the path within the zone.
        pub path: u32,
        /// Index of the exit it leads to within the zone.
        pub exit: u32,
        /// Zone the exit leads to, or `NO_ZONE`. Which path a vehicle takes there is in its `VehicleState`.
        pub next_zone: u32,
        /// Index of the controller process that drives the path.
        pub controller: u32,
        /// Bit 0: the controller that asked drives it.
        pub flags: u32,
    }
}

record! {
    /// One kind of vehicle, in the order of `VehicleState::kind`.
    #[type_name("cz.KindSpec.v1")]
    pub struct KindSpec {
        /// Strongest braking, m/s^2, negative.
        pub u_min_mps2: f64,
        /// Strongest acceleration, m/s^2.
        pub u_max_mps2: f64,
        /// Least speed, m/s.
        pub v_min_mps: f64,
        /// Greatest speed, m/s.
        pub v_max_mps: f64,
        /// Length, m.
        pub length_m: f64,
        /// Reaction time phi, s.
        pub reaction_time_s: f64,
        /// Standstill gap delta, m.
        pub standstill_gap_m: f64,
    }
}

/// FNV-1a, 64 bits, of a plug-in's name: the value of `AttachRequest::controller`. Never 0, which stands
/// for the built-in pool.
pub fn name_hash(name: &str) -> u64 {
    let hash = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325_u64, |h, byte| (h ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3));
    hash.max(1)
}
