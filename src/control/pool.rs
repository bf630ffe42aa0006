//! The controller role: the vehicles of some zones, from state and coordination frames to commands.

use super::law::{Law, Memory, Mode, Partner, PartnerKind, Program, Situation, Verdict};
use super::reference::Terminal;
use super::rows::Row;
use crate::lanes::{AHEAD, Lanes, fetch};
use crate::scenario::{Scenario, ZoneId};
use crate::vehicle::Inequality;
use ipc_schemas::{self as frames, Assignment, VehicleCommand, VehicleState};
use std::ops::Range;
use std::sync::Arc;

/// Drives the vehicles of a contiguous range of zones with the built-in law.
#[derive(Debug)]
pub struct ControllerPool {
    law: Law,
    zones: Range<ZoneId>,
    /// Lengths of each zone's approaches, m.
    lengths_m: Lanes<f64>,
    /// The vehicles of each zone, aligned with its members in the state frame.
    members: Lanes<Member>,
    /// Their constraints.
    constraints: Lanes<Constraint>,
    /// Where each zone's slice began in the last frame: about where it begins in the next.
    starts: Vec<usize>,
    /// A zone's new members and constraints while they are put together; kept for their allocations.
    crew: Crew,
    /// Approaches of these zones that plug-ins drive.
    plugged: Vec<(ZoneId, u32)>,
}

/// The vehicles of one zone and what binds them.
#[derive(Debug, Default)]
struct Crew {
    members: Vec<Member>,
    constraints: Vec<Constraint>,
}

#[derive(Clone, Copy, Debug)]
struct Member {
    vehicle: u32,
    terminal: Terminal,
    memory: Memory,
    /// Range in the zone's constraints.
    first_constraint: u32,
    end_constraint: u32,
}

/// About as many records as [`AHEAD`] zones have.
const RECORDS_AHEAD: usize = 24;

/// An assignment, resolved to a place in the zone's slice of the state frame. The slice keeps its
/// shape until the zone's next event, and with that event come new assignments.
#[derive(Clone, Copy, Debug)]
struct Constraint {
    kind: PartnerKind,
    partner_at: u32,
    /// Added to the partner's position to express it in the vehicle's coordinate, m.
    shift_m: f64,
    conflict_m: f64,
}

/// The partners of one vehicle, looked up in its zone's slice of the state frame.
#[derive(Clone, Debug)]
struct Partners<'a> {
    constraints: std::slice::Iter<'a, Constraint>,
    slice: &'a [VehicleState],
}

impl Iterator for Partners<'_> {
    type Item = Partner;

    #[inline]
    fn next(&mut self) -> Option<Partner> {
        let c = self.constraints.next()?;
        let partner = &self.slice[c.partner_at as usize];
        Some(Partner {
            kind: c.kind,
            x_m: partner.x_m + c.shift_m,
            v_mps: partner.v_mps,
            u_mps2: partner.u_mps2,
            conflict_m: c.conflict_m,
        })
    }
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
    /// An assignment has a kind no constraint has, or distances that are not positive numbers.
    #[error("an assignment of vehicle {vehicle} in zone {zone} is malformed")]
    Malformed {
        /// The zone.
        zone: ZoneId,
        /// The vehicle.
        vehicle: u32,
    },
}

impl ControllerPool {
    /// A pool for the given zones.
    pub fn new(scenario: Arc<Scenario>, zones: Range<ZoneId>) -> ControllerPool {
        let count = zones.len();
        let mut lengths_m = Lanes::new(count);
        for (lane, zone) in zones.clone().enumerate() {
            let approaches = &scenario.network.zones[zone as usize].approaches;
            approaches.iter().for_each(|a| lengths_m.push(lane, a.length_m));
        }
        let plugged = scenario.plugins.iter().flat_map(|p| p.approaches.iter().copied());
        ControllerPool {
            law: Law::new(&scenario),
            lengths_m,
            members: Lanes::new(count),
            constraints: Lanes::new(count),
            starts: vec![0; count],
            crew: Crew::default(),
            plugged: plugged.filter(|(zone, _)| zones.contains(zone)).collect(),
            zones,
        }
    }

    /// The number of commands a state frame asks of this pool.
    pub fn command_count(&self, states: &[VehicleState]) -> usize {
        let own = self.own(states).iter().filter(|s| s.flags & frames::STATE_LEFT == 0);
        own.filter(|s| !self.is_plugged(s)).count()
    }

    /// Takes a coordination frame; assignments of other pools' zones are skipped.
    pub fn coordinate(
        &mut self,
        states: &[VehicleState],
        assignments: &[Assignment],
    ) -> Result<(), PoolError> {
        // How far zones begin from where they did in the last frame, as seen at the zone before.
        let mut drift = 0;
        for group in assignments.chunk_by(|a, b| a.zone == b.zone) {
            let zone = group[0].zone;
            if self.zones.contains(&zone) {
                let lane = (zone - self.zones.start) as usize;
                let expected = self.starts[lane].wrapping_add(drift);
                let from = first_of(states, zone, expected);
                drift = from.wrapping_sub(self.starts[lane]);
                let slice = states[from..].chunk_by(|a, b| a.zone == b.zone).next().unwrap_or(&[]);
                let slice = if slice.first().is_some_and(|s| s.zone == zone) { slice } else { &[] };
                self.crew.assign(zone, slice, group, &self.members[lane])?;
                self.members.set(lane, &self.crew.members);
                self.constraints.set(lane, &self.crew.constraints);
            }
        }
        Ok(())
    }

    /// Decides every vehicle of the pool's zones; `emit` receives the commands in frame order.
    pub fn command(
        &mut self,
        time_s: f64,
        states: &[VehicleState],
        mut emit: impl FnMut(VehicleCommand),
    ) -> Result<(), PoolError> {
        self.visit(time_s, states, |law, state, situation, partners, memory| {
            let decision = law.decide(situation, partners, memory);
            emit(command(state, &decision, memory));
        })
    }

    /// Shows every program the law would solve in this step, and changes nothing.
    pub fn inspect(
        &mut self,
        time_s: f64,
        states: &[VehicleState],
        mut show: impl FnMut(&Program, Vec<(Inequality, Row)>),
    ) -> Result<(), PoolError> {
        self.visit(time_s, states, |law, _, situation, partners, memory| {
            if let Some(program) = law.program(situation, partners.clone(), &mut memory.clone()) {
                show(&program, law.row_list(situation, partners));
            }
        })
    }

    /// Calls `with` for each vehicle of the pool's zones, in frame order.
    #[inline]
    fn visit(
        &mut self,
        time_s: f64,
        states: &[VehicleState],
        mut with: impl FnMut(&Law, &VehicleState, &Situation, Partners<'_>, &mut Memory),
    ) -> Result<(), PoolError> {
        let range = self.own_range(states);
        let (mut start, end) = (range.start, range.end);
        for slice in states[range].chunk_by(|a, b| a.zone == b.zone) {
            let zone = slice[0].zone;
            let lane = (zone - self.zones.start) as usize;
            self.starts[lane] = start;
            start += slice.len();
            let ahead = (start + RECORDS_AHEAD).min(end);
            fetch(&states[ahead..(ahead + slice.len()).min(end)]);
            self.members.fetch(lane + AHEAD);
            self.constraints.fetch(lane + AHEAD);
            let present = &slice[usize::from(slice[0].flags & frames::STATE_LEFT != 0)..];
            if present.is_empty() {
                continue;
            }
            let members = &mut self.members[lane];
            let unassigned = PoolError::Unassigned { zone, present: present.len(), assigned: members.len() };
            if present.len() != members.len() {
                return Err(unassigned);
            }
            let (lengths_m, constraints) = (&self.lengths_m[lane], &self.constraints[lane]);
            for (state, member) in present.iter().zip(members) {
                if state.vehicle != member.vehicle {
                    return Err(unassigned);
                }
                if !self.plugged.is_empty() && self.plugged.contains(&(zone, state.path)) {
                    continue;
                }
                let situation = Situation {
                    time_s,
                    x_m: state.x_m,
                    v_mps: state.v_mps,
                    entry_time_s: state.entry_time_s,
                    entry_speed_mps: state.entry_speed_mps,
                    length_m: lengths_m[state.path as usize],
                    terminal: member.terminal,
                };
                let own = &constraints[member.first_constraint as usize..member.end_constraint as usize];
                let partners = Partners { constraints: own.iter(), slice };
                with(&self.law, state, &situation, partners, &mut member.memory);
            }
        }
        Ok(())
    }

    /// Whether a plug-in drives the vehicle.
    fn is_plugged(&self, state: &VehicleState) -> bool {
        !self.plugged.is_empty() && self.plugged.contains(&(state.zone, state.path))
    }

    fn own_range(&self, states: &[VehicleState]) -> Range<usize> {
        let from = states.partition_point(|s| s.zone < self.zones.start);
        from..from + states[from..].partition_point(|s| s.zone < self.zones.end)
    }

    fn own<'a>(&self, states: &'a [VehicleState]) -> &'a [VehicleState] {
        &states[self.own_range(states)]
    }
}

/// The place of a zone's first record, or where it would be. Zones move little from frame to frame, so the
/// place expected is tried before all are searched.
fn first_of(states: &[VehicleState], zone: ZoneId, expected: usize) -> usize {
    let begins_at =
        |i: usize| states.get(i).is_some_and(|s| s.zone == zone) && (i == 0 || states[i - 1].zone < zone);
    if begins_at(expected) { expected } else { states.partition_point(|s| s.zone < zone) }
}

impl Crew {
    /// Puts a zone's crew together from its slice and its assignments; memories are kept by vehicle.
    fn assign(
        &mut self,
        zone: ZoneId,
        slice: &[VehicleState],
        assignments: &[Assignment],
        before: &[Member],
    ) -> Result<(), PoolError> {
        self.members.clear();
        self.constraints.clear();
        let mut groups = assignments.chunk_by(|a, b| a.vehicle == b.vehicle);
        let mut known = before.iter().peekable();
        for state in slice.iter().filter(|s| s.flags & frames::STATE_LEFT == 0) {
            let group = groups.next().unwrap_or(&[]);
            if group.first().is_none_or(|a| a.vehicle != state.vehicle) {
                let present = slice.len();
                return Err(PoolError::Unassigned { zone, present, assigned: self.members.len() });
            }
            // Both lists are in order of entry, so one pass finds every vehicle that stayed.
            let memory = loop {
                match known.peek() {
                    Some(old) if old.vehicle == state.vehicle => break old.memory,
                    Some(_) if before.iter().any(|m| m.vehicle == state.vehicle) => known.next(),
                    _ => break Memory::ENTERED,
                };
            };
            let first = self.constraints.len() as u32;
            for assignment in group {
                if let Some(constraint) = resolve(slice, assignment)? {
                    self.constraints.push(constraint);
                }
            }
            let terminal = if group[0].flags & frames::ASSIGNMENT_FREE_TERMINAL != 0 {
                Terminal::Free
            } else {
                Terminal::Speed(group[0].terminal_speed_mps)
            };
            self.members.push(Member {
                vehicle: state.vehicle,
                terminal,
                memory,
                first_constraint: first,
                end_constraint: self.constraints.len() as u32,
            });
        }
        match groups.next() {
            Some(group) => Err(PoolError::UnknownVehicle { zone, vehicle: group[0].vehicle }),
            None => Ok(()),
        }
    }
}

/// Turns an assignment into a place in the zone's slice; `None` for one without partner.
fn resolve(slice: &[VehicleState], a: &Assignment) -> Result<Option<Constraint>, PoolError> {
    let malformed = PoolError::Malformed { zone: a.zone, vehicle: a.vehicle };
    let kind = match a.kind {
        frames::CONSTRAINT_NONE => return Ok(None),
        frames::CONSTRAINT_REAR_END => PartnerKind::RearEnd,
        frames::CONSTRAINT_MERGE => PartnerKind::Merge,
        _ => return Err(malformed),
    };
    let sound = a.own_conflict_m > 0.0
        && a.own_conflict_m.is_finite()
        && a.partner_conflict_m.is_finite()
        && a.terminal_speed_mps.is_finite();
    if !sound {
        return Err(malformed);
    }
    let partner_at = slice
        .iter()
        .position(|s| s.vehicle == a.partner)
        .ok_or(PoolError::UnknownVehicle { zone: a.zone, vehicle: a.partner })?;
    Ok(Some(Constraint {
        kind,
        partner_at: partner_at as u32,
        shift_m: a.own_conflict_m - a.partner_conflict_m,
        conflict_m: a.own_conflict_m,
    }))
}

/// The wire form of a decision and the memory behind it.
fn command(state: &VehicleState, decision: &super::Decision, memory: &Memory) -> VehicleCommand {
    let (verdict, binding_rows) = match decision.verdict {
        Verdict::Nominal => (frames::VERDICT_NOMINAL, 0),
        Verdict::Fe => (frames::VERDICT_FE, 0),
        Verdict::Bound(row) => (frames::VERDICT_BOUND, row as u32),
        Verdict::Infeasible => (frames::VERDICT_INFEASIBLE, 0),
    };
    let mode = match memory.mode {
        Mode::Fe => frames::MODE_FE,
        Mode::Ocbf => frames::MODE_OCBF,
    };
    let mut command = VehicleCommand {
        u_mps2: decision.u_mps2,
        vehicle: state.vehicle,
        zone: state.zone,
        binding_rows,
        mode,
        verdict,
        ..VehicleCommand::default()
    };
    if let Some(plan) = &memory.plan {
        command.planned_exit_time_s = plan.exit_time_s();
        command.planned_exit_speed_mps = plan.exit_speed_mps();
        command.plan_start_s = plan.start_s;
        command.plan_origin_m = plan.origin_m;
        command.plan_v0_mps = plan.v0_mps;
        command.plan_a = plan.optimum.a;
        command.plan_b = plan.optimum.b;
        command.plan_duration_s = plan.optimum.duration_s;
        command.plan_terminal_mps = match plan.terminal {
            Terminal::Free => -1.0,
            Terminal::Speed(w) => w,
        };
    }
    command
}
