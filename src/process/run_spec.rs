//! What a plug-in is told of the run: the numbers of the scenario as fixed-layout records.

use crate::scenario::{
    Drivers, Exit, FeConditions, PositionFeedback, ReferenceLaw, Replan, SafetyRows, Scenario,
};
use ipc_schemas::{self as frames, ApproachSpec, RunSpec, bytes_of};

/// The bytes behind the reply to a plug-in: a [`RunSpec`], its [`ApproachSpec`]s, and their names.
pub fn plugin_bytes(scenario: &Scenario, drivers: &Drivers, index: u32) -> Vec<u8> {
    let approaches: Vec<ApproachSpec> = approaches(scenario, drivers, index).collect();
    let spec = RunSpec { approaches: approaches.len() as u32, ..spec(scenario) };
    let mut bytes = bytes_of(&[spec]).to_vec();
    bytes.extend_from_slice(bytes_of(&approaches));
    for zone in &scenario.network.zones {
        for approach in &zone.approaches {
            bytes.extend_from_slice(format!("{}.{}\n", zone.name, approach.name).as_bytes());
        }
    }
    bytes
}

fn approaches<'a>(
    scenario: &'a Scenario,
    drivers: &'a Drivers,
    index: u32,
) -> impl Iterator<Item = ApproachSpec> + 'a {
    (0..).zip(&scenario.network.zones).flat_map(move |(zone, z)| {
        (0..).zip(&z.approaches).map(move |(path, approach)| {
            let (next_zone, next_path, link_m) = match z.exit {
                Exit::Out => (frames::NO_ZONE, 0, 0.0),
                Exit::Zone { zone, path, link_m, .. } => (zone, path, link_m),
            };
            let controller = drivers.of(zone, path);
            let flags = if controller == index { frames::APPROACH_OWN } else { 0 };
            let length_m = approach.length_m;
            ApproachSpec { length_m, link_m, zone, path, next_zone, next_path, controller, flags }
        })
    })
}

fn spec(scenario: &Scenario) -> RunSpec {
    let (vehicle, control) = (&scenario.vehicle, &scenario.control);
    let law = [
        (control.reference == ReferenceLaw::AsPrinted, frames::LAW_AS_PRINTED),
        (control.replan == Replan::FromState, frames::LAW_REPLAN_FROM_STATE),
        (control.position_feedback == PositionFeedback::Exact, frames::LAW_EXACT_FEEDBACK),
        (control.safety_rows == SafetyRows::Sampled, frames::LAW_SAMPLED_ROWS),
        (control.feasibility_rows, frames::LAW_FEASIBILITY_ROWS),
        (control.clf, frames::LAW_CLF),
        (control.fe_conditions == FeConditions::Barrier, frames::LAW_FE_BARRIER),
        (control.fe_conditions == FeConditions::Off, frames::LAW_FE_OFF),
    ];
    RunSpec {
        dt_s: scenario.dt_s(),
        max_time_s: scenario.max_time_s,
        beta: scenario.beta,
        u_min_mps2: vehicle.u_min_mps2,
        u_max_mps2: vehicle.u_max_mps2,
        v_min_mps: vehicle.v_min_mps,
        v_max_mps: vehicle.v_max_mps,
        reaction_time_s: vehicle.reaction_time_s,
        standstill_gap_m: vehicle.standstill_gap_m,
        vehicle_length_m: vehicle.length_m,
        k_rear_end_per_s: control.k_rear_end_per_s,
        k_merge_per_s: control.k_merge_per_s,
        k_speed_per_s: control.k_speed_per_s,
        clf_rate_per_s: control.clf_rate_per_s,
        slack_weight: control.slack_weight,
        fe_fraction: control.fe_fraction,
        dt_ns: scenario.dt_ns,
        seed: scenario.seed,
        zones: scenario.network.zones.len() as u32,
        approaches: 0,
        law_flags: law.iter().filter(|(on, _)| *on).map(|(_, flag)| flag).sum(),
        // The frame's codes are in the order of the variants.
        shield: scenario.shield as u32,
    }
}
