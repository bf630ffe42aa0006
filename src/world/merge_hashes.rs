//! The merge scenarios of the first version, whose zones had one conflict point, at their end: what moves is the same to
//! the bit. State records have grown since, so the chain is worked out over what they had then.
//!
//! `faulty-sensors` is not among them: a vehicle whose sensor says it has passed the merge now follows its partner, as
//! all do there, where the first version kept the merging row until the vehicle had left.

use crate::lockstep::in_process::InProcess;
use crate::scenario::load_embedded;
use ipc_schemas::VehicleState;
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64_with_seed;

/// Scenario, seed, change, and the state hash of the first version.
const HASHES: [(&str, u64, &str, u64); 36] = [
    ("paper", 1, "", 0x4bd6_1fbe_17f8_58e7),
    ("paper", 1, "shield=on", 0xbc70_dda8_843d_5106),
    ("paper", 1, "control.replan=from_state", 0x5ea9_aaa8_e092_2dae),
    ("paper", 2, "", 0x33da_63d4_4a5b_f155),
    ("paper", 2, "shield=on", 0x2778_ba31_e6f2_c2ec),
    ("paper", 2, "control.replan=from_state", 0x9128_3f31_20f5_aa6a),
    ("paper", 3, "", 0x9cce_8ee0_eb8c_9bc4),
    ("paper", 3, "shield=on", 0xb41b_2db8_79a8_550d),
    ("paper", 3, "control.replan=from_state", 0x9c08_9cf3_7096_95c8),
    ("varying-demand", 1, "", 0xe0a8_fbea_ddf7_c3f7),
    ("varying-demand", 1, "shield=on", 0x2f79_456f_a6a8_2a17),
    ("varying-demand", 1, "control.replan=from_state", 0x29f2_6299_9a9d_c843),
    ("varying-demand", 2, "", 0x3edd_bb82_99ff_70ac),
    ("varying-demand", 2, "shield=on", 0xc6eb_eed4_13b8_4a57),
    ("varying-demand", 2, "control.replan=from_state", 0x7725_47fc_fd15_9c0e),
    ("varying-demand", 3, "", 0x1998_3e4c_a67b_e674),
    ("varying-demand", 3, "shield=on", 0x088d_2a95_521d_a595),
    ("varying-demand", 3, "control.replan=from_state", 0x6ba5_a45b_71bb_5f4e),
    ("corridor-8", 1, "", 0xd425_c59c_87e7_a4b8),
    ("corridor-8", 1, "shield=on", 0xc5ca_fb68_a05f_2654),
    ("corridor-8", 1, "control.replan=from_state", 0xc02b_2447_decc_06fc),
    ("corridor-8", 2, "", 0x225f_d381_739e_7d40),
    ("corridor-8", 2, "shield=on", 0x5d64_1749_ea2e_790f),
    ("corridor-8", 2, "control.replan=from_state", 0xef0b_6948_b681_0fbb),
    ("corridor-8", 3, "", 0x85c7_90b2_7f02_0fd8),
    ("corridor-8", 3, "shield=on", 0xf2b6_9c95_6797_3b7e),
    ("corridor-8", 3, "control.replan=from_state", 0x99ff_bb33_a4c8_ddeb),
    ("tree", 1, "", 0x6c1a_cb54_2981_b708),
    ("tree", 1, "shield=on", 0x3e70_fcbd_fb43_fda1),
    ("tree", 1, "control.replan=from_state", 0x06cf_d523_f931_3773),
    ("tree", 2, "", 0x0ce3_fe74_a497_3a12),
    ("tree", 2, "shield=on", 0x87cc_fd95_4169_05af),
    ("tree", 2, "control.replan=from_state", 0xb29e_1922_92d5_ba79),
    ("tree", 3, "", 0xef6b_c45f_3bda_f8e8),
    ("tree", 3, "shield=on", 0x1493_b89c_7c69_11c4),
    ("tree", 3, "control.replan=from_state", 0xbfd4_7e3a_7f82_acc4),
];

/// A record as it was in the first version, when all vehicles were of kind 0.
fn first_version(state: &VehicleState) -> [u8; 80] {
    let mut bytes = [0; 80];
    let numbers = [
        state.x_m,
        state.v_mps,
        state.u_mps2,
        state.entry_time_s,
        state.entry_speed_mps,
        state.planned_exit_time_s,
        state.planned_exit_speed_mps,
        state.length_m,
    ];
    for (place, number) in bytes.chunks_exact_mut(8).zip(numbers) {
        place.copy_from_slice(&number.to_le_bytes());
    }
    for (place, index) in bytes[64..76].chunks_exact_mut(4).zip([state.vehicle, state.zone, state.path]) {
        place.copy_from_slice(&index.to_le_bytes());
    }
    bytes[78..].copy_from_slice(&state.flags.to_le_bytes());
    bytes
}

#[test]
#[allow(clippy::unwrap_used)]
fn merges_move_as_in_the_first_version() {
    for (name, seed, change, expected) in HASHES {
        let sets = if change.is_empty() { vec![] } else { vec![change.parse().unwrap()] };
        let scenario = Arc::new(load_embedded(name, &sets, Some(seed)).unwrap());
        let mut run = InProcess::new(&scenario, 1, 1);
        let mut hash = 0;
        let mut chain = |run: &InProcess| {
            let bytes: Vec<u8> = run.world().records().flat_map(|state| first_version(&state)).collect();
            hash = xxh3_64_with_seed(&bytes, hash);
        };
        chain(&run);
        while run.step().unwrap() {
            chain(&run);
        }
        assert_eq!(hash, expected, "{name}, seed {seed}, {change}: {hash:016x}");
    }
}
