//! Who yields to whom: the passing order of a zone and the partners that follow from it.

use crate::control::Terminal;
use crate::scenario::Zone;
use ipc_schemas::{
    ASSIGNMENT_FREE_TERMINAL, Assignment, CONSTRAINT_MERGE, CONSTRAINT_NONE, CONSTRAINT_REAR_END, NO_VEHICLE,
    STATE_LEFT, VehicleState,
};

/// Appends the assignments of a zone.
///
/// `slice` is the zone's S(t) from the state frame: index 0 (the vehicle that left last), then the
/// members in order of entry, ties broken by path. That order is the FIFO passing order, so i-1 is the
/// record before i; i_p is the nearest record before i on the same path. When they are the same vehicle
/// the merging constraint is redundant (paper: "Constraint 2").
pub(super) fn assign(zone: &Zone, slice: &[VehicleState], terminal: Terminal, out: &mut Vec<Assignment>) {
    let (terminal_speed_mps, flags) = match terminal {
        Terminal::Free => (0.0, ASSIGNMENT_FREE_TERMINAL),
        Terminal::Speed(w) => (w, 0),
    };
    for (i, state) in slice.iter().enumerate() {
        if state.flags & STATE_LEFT != 0 {
            continue;
        }
        let record = |partner: Option<&VehicleState>, kind| {
            let length = |path: u32| zone.approaches[path as usize].length_m;
            Assignment {
                own_conflict_m: length(state.path),
                partner_conflict_m: length(partner.map_or(state.path, |p| p.path)),
                terminal_speed_mps,
                vehicle: state.vehicle,
                partner: partner.map_or(NO_VEHICLE, |p| p.vehicle),
                zone: state.zone,
                kind,
                flags,
            }
        };
        let before = &slice[..i];
        let ahead = before.iter().rev().find(|p| p.path == state.path);
        let previous = before.last().filter(|p| p.path != state.path);
        if let Some(ahead) = ahead {
            out.push(record(Some(ahead), CONSTRAINT_REAR_END));
        }
        if let Some(previous) = previous {
            out.push(record(Some(previous), CONSTRAINT_MERGE));
        }
        if ahead.is_none() && previous.is_none() {
            out.push(record(None, CONSTRAINT_NONE));
        }
    }
}
