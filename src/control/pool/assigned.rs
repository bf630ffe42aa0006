//! A zone's members and what binds them, put together from its slice of the state frame and its assignments.

use super::super::law::{Schedule, Words};
use super::super::reference::Terminal;
use crate::conflict::{Duty, DutyKind};
use crate::scenario::ZoneId;
use ipc_schemas::{self as frames, Assignment, VehicleCommand, VehicleState};

/// The vehicles of one zone and what binds them.
#[derive(Debug, Default)]
pub(super) struct Renewed {
    pub(super) members: Vec<Member>,
    pub(super) constraints: Vec<Duty>,
    pub(super) schedules: Vec<Option<Schedule>>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Member {
    pub(super) vehicle: u32,
    pub(super) terminal: Terminal,
    pub(super) memory: Words,
    /// Range in the zone's constraints.
    pub(super) first_constraint: u32,
    pub(super) end_constraint: u32,
}

/// A frame that contradicts the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// A zone's membership changed and its coordinator said nothing.
    #[error("zone {zone} has {present} vehicles but its coordinator assigned {assigned}")]
    Unassigned {
        /// The zone.
        zone: ZoneId,
        /// Vehicles in the state frame.
        present: usize,
        /// Vehicles in the coordination in force.
        assigned: usize,
    },
    /// An assignment names a vehicle that is not in the zone.
    #[error("an assignment in zone {zone} names vehicle {vehicle}, which is not there")]
    UnknownVehicle {
        /// The zone.
        zone: ZoneId,
        /// The vehicle.
        vehicle: u32,
    },
    /// An assignment has a kind no constraint has, distances that are not positive numbers, a terminal
    /// speed no vehicle may have, or an instant that is none.
    #[error("an assignment of vehicle {vehicle} in zone {zone} is malformed")]
    Malformed {
        /// The zone.
        zone: ZoneId,
        /// The vehicle.
        vehicle: u32,
    },
}

impl Member {
    /// A vehicle as its controller remembered it when it sent this command.
    pub(super) fn remembered(command: &VehicleCommand) -> Member {
        Member {
            vehicle: command.vehicle,
            terminal: Terminal::Free,
            memory: Words { mode: command.mode, words: command.memory() },
            first_constraint: 0,
            end_constraint: 0,
        }
    }
}

impl Renewed {
    /// Puts a zone's members together from its slice and its assignments; memories are kept by vehicle.
    pub(super) fn assign(
        &mut self,
        zone: ZoneId,
        slice: &[VehicleState],
        assignments: &[Assignment],
        before: &[Member],
        v_max_mps: f64,
    ) -> Result<(), PoolError> {
        self.members.clear();
        self.constraints.clear();
        self.schedules.clear();
        let mut groups = assignments.chunk_by(|a, b| a.vehicle == b.vehicle);
        let mut known = before.iter().peekable();
        for state in slice.iter().filter(|state| !state.has_left()) {
            let group = groups.next().unwrap_or(&[]);
            if group.first().is_none_or(|a| a.vehicle != state.vehicle) {
                let present = slice.len();
                return Err(PoolError::Unassigned { zone, present, assigned: self.members.len() });
            }
            // Both lists are in order of entry, so one pass finds every vehicle that stayed.
            // One that has come back is a newcomer, also when nothing was said of the zone since it left it empty.
            let is_newcomer = state.flags & frames::STATE_ENTERED != 0;
            let memory = loop {
                match known.peek() {
                    Some(old) if old.vehicle == state.vehicle => {
                        break if is_newcomer { Words::ENTERED } else { old.memory };
                    }
                    Some(_) if before.iter().any(|m| m.vehicle == state.vehicle) => known.next(),
                    _ => break Words::ENTERED,
                };
            };
            let first = self.constraints.len() as u32;
            for assignment in group {
                if let Some(constraint) = resolve(slice, assignment, v_max_mps)? {
                    self.constraints.push(constraint);
                }
            }
            let terminal = if group[0].flags & frames::ASSIGNMENT_FREE_TERMINAL != 0 {
                Terminal::Free
            } else {
                Terminal::Speed(group[0].terminal_speed_mps)
            };
            let Assignment { scheduled_at_m: at_m, scheduled_time_s: time_s, .. } = group[0];
            self.schedules.push((time_s > 0.0).then_some(Schedule { at_m, time_s }));
            self.members.push(Member {
                vehicle: state.vehicle,
                terminal,
                memory,
                first_constraint: first,
                end_constraint: self.constraints.len() as u32,
            });
        }
        if self.schedules.iter().all(Option::is_none) {
            self.schedules.clear();
        }
        match groups.next() {
            Some(group) => Err(PoolError::UnknownVehicle { zone, vehicle: group[0].vehicle }),
            None => Ok(()),
        }
    }
}

/// No path is longer than this, m.
const MAX_CONFLICT_M: f64 = 1e9;

/// Turns an assignment into a duty toward a place in the zone's slice; `None` for one without partner.
fn resolve(slice: &[VehicleState], a: &Assignment, v_max_mps: f64) -> Result<Option<Duty>, PoolError> {
    let malformed = PoolError::Malformed { zone: a.zone, vehicle: a.vehicle };
    let is_distance = |m: f64| (0.0..=MAX_CONFLICT_M).contains(&m);
    let kind = match a.kind {
        frames::CONSTRAINT_NONE => None,
        frames::CONSTRAINT_REAR_END => Some(DutyKind::RearEnd),
        frames::CONSTRAINT_MERGE => Some(DutyKind::Merge),
        frames::CONSTRAINT_CROSS => Some(DutyKind::Cross),
        _ => return Err(malformed),
    };
    // The law plans with the terminal speed of any of them, and divides by the distance to a conflict point.
    let sound = is_distance(a.own_conflict_m)
        && is_distance(a.partner_conflict_m)
        && is_distance(a.gap_m)
        && !a.until_m.is_nan()
        && (a.own_conflict_m > 0.0 || !matches!(kind, Some(DutyKind::Merge | DutyKind::Cross)))
        && (0.0..=v_max_mps).contains(&a.terminal_speed_mps)
        && is_distance(a.scheduled_at_m)
        && a.scheduled_time_s.is_finite();
    if !sound {
        return Err(malformed);
    }
    let Some(kind) = kind else { return Ok(None) };
    let partner = slice
        .iter()
        .position(|s| s.vehicle == a.partner)
        .ok_or(PoolError::UnknownVehicle { zone: a.zone, vehicle: a.partner })?;
    Ok(Some(Duty {
        kind,
        partner: partner as u32,
        point: a.point,
        own_m: a.own_conflict_m,
        partner_m: a.partner_conflict_m,
        gap_m: a.gap_m,
        until_m: a.until_m,
    }))
}
