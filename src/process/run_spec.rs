//! What a plug-in is told of the run: the numbers of the scenario as fixed-layout records.

use crate::scenario::{
    Drivers, FeConditions, PositionFeedback, ReferenceLaw, Replan, SafetyRows, Scenario, VehicleParams,
};
use ipc_schemas::{self as frames, KindSpec, PathSpec, RunSpec, bytes_of};

/// The bytes behind the reply to a plug-in: a [`RunSpec`], its [`PathSpec`]s and [`KindSpec`]s, and the names of paths.
pub fn plugin_bytes(scenario: &Scenario, drivers: &Drivers, index: u32) -> Vec<u8> {
    let paths: Vec<PathSpec> = paths(scenario, drivers, index).collect();
    let kinds: Vec<KindSpec> = scenario.fleet.iter().map(|kind| kind_spec(&kind.vehicle)).collect();
    let spec = RunSpec { paths: paths.len() as u32, kinds: kinds.len() as u32, ..spec(scenario) };
    let mut bytes = bytes_of(&[spec]).to_vec();
    bytes.extend_from_slice(bytes_of(&paths));
    bytes.extend_from_slice(bytes_of(&kinds));
    for zone in &scenario.network.zones {
        for path in &zone.paths {
            bytes.extend_from_slice(format!("{}.{}\n", zone.name, path.name).as_bytes());
        }
    }
    bytes
}

fn paths<'a>(
    scenario: &'a Scenario,
    drivers: &'a Drivers,
    index: u32,
) -> impl Iterator<Item = PathSpec> + 'a {
    (0..).zip(&scenario.network.zones).flat_map(move |(zone, z)| {
        (0..).zip(&z.paths).map(move |(path, shape)| {
            let to = z.exit_of(path).to;
            let controller = drivers.of(zone, path);
            PathSpec {
                length_m: shape.length_m,
                link_m: to.map_or(0.0, |to| to.link_m),
                zone,
                path,
                exit: shape.exit,
                next_zone: to.map_or(frames::NO_ZONE, |to| to.zone),
                controller,
                flags: if controller == index { frames::PATH_OWN } else { 0 },
            }
        })
    })
}

fn kind_spec(vehicle: &VehicleParams) -> KindSpec {
    KindSpec {
        u_min_mps2: vehicle.u_min_mps2,
        u_max_mps2: vehicle.u_max_mps2,
        v_min_mps: vehicle.v_min_mps,
        v_max_mps: vehicle.v_max_mps,
        length_m: vehicle.length_m,
        reaction_time_s: vehicle.reaction_time_s,
        standstill_gap_m: vehicle.standstill_gap_m,
    }
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
        paths: 0,
        kinds: 0,
        reserved: 0,
        law_flags: law.iter().filter(|(on, _)| *on).map(|(_, flag)| flag).sum(),
        // The frame's codes are in the order of the variants.
        shield: scenario.shield as u32,
    }
}
