//! What records say, in words for people: one wording wherever a step is shown.

use crate::control::rows::Row;
use crate::scenario::Scenario;
use ipc_schemas::{self as frames, VehicleCommand, VehicleState};

/// A zone's name, or its number where the scenario has no such zone.
pub fn zone_name(scenario: &Scenario, zone: u32) -> String {
    let name = scenario.network.zones.get(zone as usize).map(|zone| zone.name.clone());
    name.unwrap_or_else(|| format!("zone {zone}"))
}

/// Zone and path of a vehicle, or the link.
pub fn place(scenario: &Scenario, state: &VehicleState) -> String {
    if state.zone == frames::NO_ZONE {
        return "link".to_owned();
    }
    let zone = scenario.network.zones.get(state.zone as usize);
    let path = zone.and_then(|zone| zone.paths.get(state.path as usize));
    match path {
        Some(path) => format!("{}.{}", zone_name(scenario, state.zone), path.name),
        None => format!("{}, path {}", zone_name(scenario, state.zone), state.path),
    }
}

/// The mode of a command.
pub fn mode(command: &VehicleCommand) -> String {
    match command.mode {
        frames::MODE_ENTERED => "entered".to_owned(),
        frames::MODE_FE => "FE".to_owned(),
        frames::MODE_OCBF => "OCBF".to_owned(),
        frames::MODE_FREE => "free".to_owned(),
        frames::MODE_SCHEDULED => "scheduled".to_owned(),
        frames::MODE_SLOT => "slot".to_owned(),
        other => other.to_string(),
    }
}

/// A command's verdict, with the rows that decided it.
pub fn verdict(command: &VehicleCommand) -> String {
    match command.verdict {
        frames::VERDICT_NOMINAL => "as wished".to_owned(),
        frames::VERDICT_FE => "braking until the entry conditions hold".to_owned(),
        frames::VERDICT_BOUND => {
            let rows = Row::ALL.into_iter().filter(|row| command.binding_rows & *row as u32 != 0);
            format!("bound by {}", rows.map(Row::name).collect::<Vec<_>>().join(", "))
        }
        frames::VERDICT_INFEASIBLE => "infeasible: braking fully".to_owned(),
        frames::VERDICT_HELD => "held: no answer in time".to_owned(),
        frames::VERDICT_FALLBACK => "held as far as the shield allows: no answer in time".to_owned(),
        other => format!("verdict {other}"),
    }
}
