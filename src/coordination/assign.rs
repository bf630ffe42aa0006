//! A zone's assignments: its vehicles' duties, the terminal speed each is to leave with, and when.

use super::schedule::{Queue, Scene};
use crate::conflict::{Duties, Duty, DutyKind, Row};
use crate::control::Terminal;
use crate::scenario::Scenario;
use ipc_schemas::{
    ASSIGNMENT_FREE_TERMINAL, ASSIGNMENT_PASSED, ASSIGNMENT_PASSED_ONCE, Assignment, CONSTRAINT_CROSS,
    CONSTRAINT_MERGE, CONSTRAINT_NONE, CONSTRAINT_REAR_END, NO_POINT, NO_VEHICLE, STATE_HUMAN, VehicleState,
    ZoneSummary,
};

/// Makes assignments; kept from use to use for its allocations.
#[derive(Debug, Default)]
pub(super) struct Assigner {
    duties: Duties,
    /// Those that have left, the members in passing order, those that are about to come.
    rows: Vec<Row>,
    /// Where each of the first two is in the slice.
    at: Vec<u32>,
    /// Place in the order of each member.
    ranks: Vec<u32>,
    coming: Vec<ZoneSummary>,
}

/// What is decided about a zone's vehicles beside what they owe.
#[derive(Clone, Copy)]
pub(super) struct Decided<'a> {
    /// Terminal condition by exit.
    pub(super) terminals: &'a [Terminal],
    /// How often members were passed, by vehicle; those that were not may be missing.
    pub(super) passed: &'a [(u32, u16)],
    /// When members are to leave, s from now, in passing order; empty when nothing is scheduled.
    pub(super) times_s: &'a [f64],
}

impl Assigner {
    /// Derives the duties of a zone's members, whose order is given, first to last, and of those that come after them.
    pub(super) fn derive(&mut self, scene: &Scene<'_>, order: &[u32]) {
        let Scene { scenario, conflicts, slice, .. } = *scene;
        let left = slice.iter().take_while(|state| state.has_left()).count();
        let (gone, members) = slice.split_at(left);
        self.rows.clear();
        self.rows.extend(gone.iter().zip(0..).map(|(state, id)| row(scenario, state, id)));
        self.at.clear();
        self.at.extend(0..left as u32);
        self.ranks.clear();
        self.ranks.resize(members.len(), 0);
        for (rank, vehicle) in order.iter().enumerate() {
            // Mostly members are in the order in which they pass.
            let is_here = members.get(rank).is_some_and(|state| state.vehicle == *vehicle);
            let at = if is_here { Some(rank) } else { members.iter().position(|s| s.vehicle == *vehicle) };
            let at = at.expect("an order is one of the zone's members");
            self.ranks[at] = rank as u32;
            self.at.push((left + at) as u32);
            self.rows.push(row(scenario, &members[at], (left + rank) as u32));
        }
        self.coming.clear();
        if scene.expects_in_order() {
            scene.coming(&mut self.coming);
            let first = self.rows.len() as u32;
            self.rows.extend(self.coming.iter().zip(first..).map(|(told, id)| scene.told_row(told, id)));
        }
        self.duties.derive(conflicts, &self.rows);
    }

    /// The vehicles as they are to pass.
    pub(super) fn queue(&self) -> Queue<'_> {
        Queue { rows: &self.rows, at: &self.at, duties: &self.duties, coming: &self.coming }
    }

    /// Appends the assignments of a zone's members, in the order of the frame, from the duties derived last.
    pub(super) fn assign(&self, scene: &Scene<'_>, decided: &Decided<'_>, out: &mut Vec<Assignment>) {
        let Scene { conflicts, slice, .. } = *scene;
        let left = slice.len() - self.ranks.len();
        for (state, &rank) in slice[left..].iter().zip(&self.ranks) {
            let place = left + rank as usize;
            let length_m = conflicts.length_m(state.path);
            let (terminal_speed_mps, free) = match decided.terminals[conflicts.exit(state.path) as usize] {
                Terminal::Free => (0.0, ASSIGNMENT_FREE_TERMINAL),
                Terminal::Speed(w) => (w, 0),
            };
            let scheduled_s = decided.times_s.get(rank as usize);
            let passed = decided.passed.iter().find(|(vehicle, _)| *vehicle == state.vehicle);
            let passed = passed.map_or(0, |(_, times)| (times * ASSIGNMENT_PASSED_ONCE) & ASSIGNMENT_PASSED);
            let none = Assignment {
                own_conflict_m: length_m,
                partner_conflict_m: length_m,
                gap_m: 0.0,
                until_m: f64::INFINITY,
                terminal_speed_mps,
                scheduled_at_m: scheduled_s.map_or(0.0, |_| length_m),
                scheduled_time_s: scheduled_s.map_or(0.0, |after_s| scene.time_s + after_s),
                vehicle: state.vehicle,
                partner: NO_VEHICLE,
                zone: state.zone,
                point: NO_POINT,
                rank,
                kind: CONSTRAINT_NONE,
                flags: free | passed,
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
                partner: slice[self.at[duty.partner as usize] as usize].vehicle,
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
    let is_free = state.flags & STATE_HUMAN != 0 && !kind.human.is_some_and(|human| human.obeys());
    Row { path, next_path, x_m, v_mps, has_left, is_free, ..Row::new(&kind.vehicle, &scenario.vehicle, id) }
}
