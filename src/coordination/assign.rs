//! A zone's assignments: its vehicles' duties, and the terminal speed each is to leave with.

use crate::conflict::{Conflicts, Duties, Duty, DutyKind, Row};
use crate::control::Terminal;
use crate::scenario::Scenario;
use ipc_schemas::{
    ASSIGNMENT_FREE_TERMINAL, Assignment, CONSTRAINT_CROSS, CONSTRAINT_MERGE, CONSTRAINT_NONE,
    CONSTRAINT_REAR_END, NO_POINT, NO_VEHICLE, VehicleState,
};

/// Makes assignments; kept from use to use for its allocations.
#[derive(Debug, Default)]
pub(super) struct Assigner {
    duties: Duties,
    rows: Vec<Row>,
    /// Place in the order of each member.
    ranks: Vec<u32>,
}

impl Assigner {
    /// Appends the assignments of a zone's members, in the order of the frame.
    ///
    /// `slice` is the zone's S(t) from the state frame, `order` has all its members, first to last; `terminals` has the terminal condition of each exit.
    pub(super) fn assign(
        &mut self,
        scenario: &Scenario,
        conflicts: &Conflicts,
        slice: &[VehicleState],
        order: &[u32],
        terminals: &[Terminal],
        out: &mut Vec<Assignment>,
    ) {
        let left = slice.iter().take_while(|state| state.has_left()).count();
        let (gone, members) = slice.split_at(left);
        self.rows.clear();
        self.rows.extend(gone.iter().zip(0..).map(|(state, id)| row(scenario, state, id)));
        self.ranks.clear();
        self.ranks.resize(members.len(), 0);
        for (rank, vehicle) in order.iter().enumerate() {
            // Mostly members are in the order in which they pass.
            let is_here = members.get(rank).is_some_and(|state| state.vehicle == *vehicle);
            let at = if is_here { Some(rank) } else { members.iter().position(|s| s.vehicle == *vehicle) };
            let at = at.expect("an order is one of the zone's members");
            self.ranks[at] = rank as u32;
            self.rows.push(row(scenario, &members[at], (left + at) as u32));
        }
        self.duties.derive(conflicts, &self.rows);
        for (state, &rank) in members.iter().zip(&self.ranks) {
            let place = left + rank as usize;
            let length_m = conflicts.length_m(state.path);
            let (terminal_speed_mps, flags) = match terminals[conflicts.exit(state.path) as usize] {
                Terminal::Free => (0.0, ASSIGNMENT_FREE_TERMINAL),
                Terminal::Speed(w) => (w, 0),
            };
            let none = Assignment {
                own_conflict_m: length_m,
                partner_conflict_m: length_m,
                gap_m: 0.0,
                until_m: f64::INFINITY,
                terminal_speed_mps,
                scheduled_at_m: 0.0,
                scheduled_time_s: 0.0,
                vehicle: state.vehicle,
                partner: NO_VEHICLE,
                zone: state.zone,
                point: NO_POINT,
                rank,
                kind: CONSTRAINT_NONE,
                flags,
            };
            let duties = self.duties.of(place);
            if duties.is_empty() {
                out.push(none);
            }
            out.extend(duties.iter().map(|duty| Assignment {
                own_conflict_m: duty.own_m,
                partner_conflict_m: duty.partner_m,
                gap_m: duty.gap_m,
                until_m: duty.until_m,
                point: duty.point,
                partner: slice[duty.partner as usize].vehicle,
                kind: code(duty),
                ..none
            }));
        }
    }
}

fn code(duty: &Duty) -> u16 {
    match duty.kind {
        DutyKind::RearEnd => CONSTRAINT_REAR_END,
        DutyKind::Merge => CONSTRAINT_MERGE,
        DutyKind::Cross => CONSTRAINT_CROSS,
    }
}

/// A vehicle as the order of passing sees it.
pub(super) fn row(scenario: &Scenario, state: &VehicleState, id: u32) -> Row {
    let kind = scenario.fleet.get(usize::from(state.kind)).unwrap_or(&scenario.fleet[0]);
    let VehicleState { path, next_path, x_m, v_mps, .. } = *state;
    let has_left = state.has_left();
    Row { path, next_path, x_m, v_mps, has_left, ..Row::new(&kind.vehicle, &scenario.vehicle, id) }
}
