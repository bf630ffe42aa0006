//! The controller role: the vehicles of some zones, from state and coordination frames to commands.

mod assigned;

pub use assigned::PoolError;

use super::law::{Decision, Law, Laws, Partner, Schedule, Situation, Verdict, Words, with_law};
use super::ocbf::Program;
use super::rows::Row;
use crate::conflict::Duty;
use crate::lists::{AHEAD, Lists, fetch};
use crate::scenario::{Scenario, ZoneId};
use crate::vehicle::Inequality;
use assigned::{Member, Renewed};
use ipc_schemas::{self as frames, Assignment, VehicleCommand, VehicleState};
use std::hint::select_unpredictable;
use std::ops::Range;
use std::sync::Arc;

/// Drives the vehicles of a contiguous range of zones with the laws of these.
#[derive(Debug)]
pub struct ControllerPool {
    laws: Vec<Laws>,
    /// By zone, index of its law.
    law_of: Vec<u8>,
    v_max_mps: f64,
    kinds: u16,
    zones: Range<ZoneId>,
    /// Lengths of each zone's paths, m.
    lengths_m: Lists<f64>,
    /// The vehicles of each zone, aligned with its members in the state frame.
    members: Lists<Member>,
    /// Their constraints.
    constraints: Lists<Duty>,
    /// What they are scheduled for, aligned with the members; empty where nobody is, as always under coordinators that
    /// do not schedule.
    schedules: Lists<Option<Schedule>>,
    /// Where each zone's slice began in the last frame: about where it begins in the next.
    starts: Vec<usize>,
    /// A zone's new members and constraints while they are put together; kept for their allocations.
    renewed: Renewed,
    /// Paths of these zones that others drive.
    others: Vec<(ZoneId, u32)>,
}

/// About as many records as [`AHEAD`] zones have.
const RECORDS_AHEAD: usize = 24;

/// The partners of one vehicle, looked up in its zone's slice of the state frame. The slice keeps its
/// shape until the zone's next event, and with that event come new assignments.
#[derive(Clone, Debug)]
struct Partners<'a> {
    constraints: std::slice::Iter<'a, Duty>,
    slice: &'a [VehicleState],
    lengths_m: &'a [f64],
    x_m: f64,
}

impl Iterator for Partners<'_> {
    type Item = Partner;

    #[inline(always)]
    fn next(&mut self) -> Option<Partner> {
        loop {
            let duty = self.constraints.next()?;
            let partner = &self.slice[duty.partner as usize];
            let Some(kind) = duty.in_force(self.x_m, partner.x_m) else { continue };
            // Laws that do not look at exits pay nothing for them: no index that could be out of bounds.
            let length_m = self.lengths_m.get(partner.path as usize).copied().unwrap_or(f64::INFINITY);
            return Some(Partner {
                kind,
                x_m: partner.x_m + duty.shift_m(),
                v_mps: partner.v_mps,
                u_mps2: partner.u_mps2,
                conflict_m: duty.own_m,
                gap_m: duty.gap_m,
                until_m: duty.until_m + duty.shift_m(),
                vehicle_kind: partner.kind,
                exit_at_m: length_m + duty.shift_m(),
                exit_time_s: partner.planned_exit_time_s,
                exit_speed_mps: partner.planned_exit_speed_mps,
            });
        }
    }
}

impl ControllerPool {
    /// A pool for the given zones, but for what plug-ins drive there.
    pub fn new(scenario: Arc<Scenario>, zones: Range<ZoneId>) -> ControllerPool {
        let plugged = scenario.plugins.iter().flat_map(|p| p.paths.iter().copied());
        let others = plugged.filter(|(zone, _)| zones.contains(zone)).collect();
        ControllerPool::beside(scenario, zones, others)
    }

    /// A pool for what a plug-in was to drive.
    ///
    /// # Panics
    /// When there is no such plug-in.
    pub fn in_place_of(scenario: Arc<Scenario>, plugin: usize) -> ControllerPool {
        let own = &scenario.plugins[plugin].paths;
        let first = own.iter().map(|(zone, _)| *zone).min().unwrap_or(0);
        let behind = own.iter().map(|(zone, _)| *zone + 1).max().unwrap_or(0);
        let zones = first..behind;
        let all = zones.clone().flat_map(|zone| {
            let paths = scenario.network.zones[zone as usize].paths.len() as u32;
            (0..paths).map(move |path| (zone, path))
        });
        let others = all.filter(|path| !own.contains(path)).collect();
        ControllerPool::beside(scenario, zones, others)
    }

    /// A pool for these zones, but for paths that others drive.
    fn beside(scenario: Arc<Scenario>, zones: Range<ZoneId>, others: Vec<(ZoneId, u32)>) -> ControllerPool {
        let count = zones.len();
        let mut lengths_m = Lists::new(count);
        for (place, zone) in zones.clone().enumerate() {
            let paths = &scenario.network.zones[zone as usize].paths;
            paths.iter().for_each(|path| lengths_m.push(place, path.length_m));
        }
        let mut kinds: Vec<crate::scenario::LawKind> = Vec::new();
        let law_of = zones.clone().map(|zone| {
            let kind = scenario.network.zones[zone as usize].law;
            let at = kinds.iter().position(|known| *known == kind).unwrap_or_else(|| {
                kinds.push(kind);
                kinds.len() - 1
            });
            at as u8
        });
        let law_of = law_of.collect();
        ControllerPool {
            laws: kinds.iter().map(|kind| Laws::of(&scenario, *kind)).collect(),
            law_of,
            kinds: scenario.fleet.len() as u16,
            v_max_mps: scenario.vehicle.v_max_mps,
            lengths_m,
            members: Lists::new(count),
            constraints: Lists::new(count),
            schedules: Lists::new(count),
            starts: vec![0; count],
            renewed: Renewed::default(),
            others,
            zones,
        }
    }

    /// The number of commands a state frame asks of this pool.
    pub fn command_count(&self, states: &[VehicleState]) -> usize {
        self.own(states).iter().filter(|s| s.is_commanded() && !self.is_anothers(s)).count()
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
                let place = (zone - self.zones.start) as usize;
                let expected = self.starts[place].wrapping_add(drift);
                let from = first_of(states, zone, expected);
                drift = from.wrapping_sub(self.starts[place]);
                let slice = states[from..].chunk_by(|a, b| a.zone == b.zone).next().unwrap_or(&[]);
                let slice = if slice.first().is_some_and(|s| s.zone == zone) { slice } else { &[] };
                self.renewed.assign(zone, slice, group, &self.members[place], self.v_max_mps)?;
                self.members.set(place, &self.renewed.members);
                self.constraints.set(place, &self.renewed.constraints);
                self.schedules.set(place, &self.renewed.schedules);
            }
        }
        Ok(())
    }

    /// Takes over from another pool: what it remembered stands in its last commands, and `in_force` is the
    /// coordination its zones were under before the step of `states`. A zone that has changed since is left
    /// without assignments; its coordinator sends new ones in this very step.
    ///
    /// # Errors
    /// When the assignments contradict the state.
    pub fn restore(
        &mut self,
        states: &[VehicleState],
        commands: &[VehicleCommand],
        in_force: &[Assignment],
    ) -> Result<(), PoolError> {
        for place in 0..self.zones.len() {
            self.members.set(place, &[]);
            self.constraints.set(place, &[]);
            self.schedules.set(place, &[]);
        }
        for group in commands.chunk_by(|a, b| a.zone == b.zone) {
            if self.zones.contains(&group[0].zone) {
                let remembered: Vec<Member> = group.iter().map(Member::remembered).collect();
                self.members.set((group[0].zone - self.zones.start) as usize, &remembered);
            }
        }
        for group in in_force.chunk_by(|a, b| a.zone == b.zone) {
            let from = states.partition_point(|s| s.zone < group[0].zone);
            let slice = states[from..].iter().take_while(|s| s.zone == group[0].zone);
            let members = slice.filter(|state| !state.has_left()).map(|state| state.vehicle);
            if members.eq(group.chunk_by(|a, b| a.vehicle == b.vehicle).map(|g| g[0].vehicle)) {
                self.coordinate(states, group)?;
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
        self.visit(time_s, states, |laws, scene| with_law!(laws, law => scene.decide(law, &mut emit)))
    }

    /// Shows every program that a law solves in this step, and changes nothing.
    pub fn inspect(
        &mut self,
        time_s: f64,
        states: &[VehicleState],
        mut show: impl FnMut(&Program, Vec<(Inequality, Row)>),
    ) -> Result<(), PoolError> {
        self.visit(time_s, states, |laws, mut scene| {
            // The others solve none.
            if let Laws::Ocbf(law) = laws {
                scene.each(|_, situation, partners, member| {
                    if let Some((program, rows)) = law.posed(situation, partners, &member.memory) {
                        show(&program, rows);
                    }
                });
            }
        })
    }

    /// Shows what the laws decide by, of each vehicle in the order of its command, and changes nothing.
    ///
    /// # Errors
    /// When state and coordination contradict each other.
    pub fn survey(
        &mut self,
        time_s: f64,
        states: &[VehicleState],
        mut show: impl FnMut(&VehicleState, &Situation, &mut dyn Iterator<Item = Partner>),
    ) -> Result<(), PoolError> {
        self.visit(time_s, states, |_, mut scene| {
            scene.each(|state, situation, mut partners, _| show(state, situation, &mut partners));
        })
    }

    /// Calls `with` for each zone of the pool that has members, in frame order.
    #[inline]
    fn visit(
        &mut self,
        time_s: f64,
        states: &[VehicleState],
        mut with: impl FnMut(&Laws, Scene<'_>),
    ) -> Result<(), PoolError> {
        let range = self.own_range(states);
        let (mut start, end) = (range.start, range.end);
        for slice in states[range].chunk_by(|a, b| a.zone == b.zone) {
            let zone = slice[0].zone;
            let place = (zone - self.zones.start) as usize;
            self.starts[place] = start;
            start += slice.len();
            let ahead = (start + RECORDS_AHEAD).min(end);
            fetch(&states[ahead..(ahead + slice.len()).min(end)]);
            self.members.fetch(place + AHEAD);
            self.constraints.fetch(place + AHEAD);
            let left = slice.iter().take_while(|state| state.has_left()).count();
            let present = &slice[left..];
            if present.is_empty() {
                continue;
            }
            let members = &mut self.members[place];
            let unassigned = PoolError::Unassigned { zone, present: present.len(), assigned: members.len() };
            // No branch per vehicle: that all fit is what one expects.
            let others =
                present.iter().zip(&*members).filter(|(state, member)| state.vehicle != member.vehicle);
            if present.len() != members.len() || others.count() > 0 {
                return Err(unassigned);
            }
            let scene = Scene {
                time_s,
                slice,
                present,
                members,
                lengths_m: &self.lengths_m[place],
                constraints: &self.constraints[place],
                schedules: &self.schedules[place],
                others: &self.others,
                kinds: self.kinds,
            };
            with(&self.laws[usize::from(self.law_of[place])], scene);
        }
        Ok(())
    }

    /// Whether another drives the vehicle.
    fn is_anothers(&self, state: &VehicleState) -> bool {
        is_anothers(&self.others, state)
    }

    fn own_range(&self, states: &[VehicleState]) -> Range<usize> {
        // One pool mostly has all zones, and of several the first and the last begin or end with the frame. A search
        // takes as long as a vehicle or two.
        let from = match states.first() {
            Some(first) if first.zone >= self.zones.start => 0,
            _ => states.partition_point(|s| s.zone < self.zones.start),
        };
        let to = match states.last() {
            Some(last) if last.zone < self.zones.end => states.len(),
            _ => from + states[from..].partition_point(|s| s.zone < self.zones.end),
        };
        from..to.max(from)
    }

    fn own<'a>(&self, states: &'a [VehicleState]) -> &'a [VehicleState] {
        &states[self.own_range(states)]
    }
}

/// A zone in one step.
struct Scene<'a> {
    time_s: f64,
    slice: &'a [VehicleState],
    /// Those of it that have not left.
    present: &'a [VehicleState],
    members: &'a mut [Member],
    lengths_m: &'a [f64],
    constraints: &'a [Duty],
    schedules: &'a [Option<Schedule>],
    others: &'a [(ZoneId, u32)],
    kinds: u16,
}

impl Scene<'_> {
    /// Lets a law decide each vehicle.
    #[inline(always)]
    fn decide<L: Law>(mut self, law: &L, emit: &mut impl FnMut(VehicleCommand)) {
        self.each(|state, situation, partners, member| {
            let decision = law.decide(situation, partners, &mut member.memory);
            emit(command(state, &decision, &member.memory));
        });
    }

    #[inline(always)]
    fn each(&mut self, mut with: impl FnMut(&VehicleState, &Situation, Partners<'_>, &mut Member)) {
        for (at, (state, member)) in self.present.iter().zip(&mut *self.members).enumerate() {
            if is_anothers(self.others, state) || !state.is_commanded() {
                continue;
            }
            let situation = Situation {
                time_s: self.time_s,
                x_m: state.x_m,
                v_mps: state.v_mps,
                entry_time_s: state.entry_time_s,
                entry_speed_mps: state.entry_speed_mps,
                length_m: self.lengths_m[state.path as usize],
                terminal: member.terminal,
                schedule: self.schedules.get(at).copied().flatten(),
                // A kind nobody has heard of cannot be told apart from the first.
                kind: if state.kind < self.kinds { state.kind } else { 0 },
            };
            let own = &self.constraints[member.first_constraint as usize..member.end_constraint as usize];
            let (slice, lengths_m) = (self.slice, self.lengths_m);
            let partners = Partners { constraints: own.iter(), slice, lengths_m, x_m: state.x_m };
            with(state, &situation, partners, member);
        }
    }
}

fn is_anothers(others: &[(ZoneId, u32)], state: &VehicleState) -> bool {
    !others.is_empty() && others.contains(&(state.zone, state.path))
}

/// The place of a zone's first record, or where it would be. Zones move little from frame to frame, so the
/// place expected is tried before all are searched.
fn first_of(states: &[VehicleState], zone: ZoneId, expected: usize) -> usize {
    let begins_at =
        |i: usize| states.get(i).is_some_and(|s| s.zone == zone) && (i == 0 || states[i - 1].zone < zone);
    if begins_at(expected) { expected } else { states.partition_point(|s| s.zone < zone) }
}

/// The wire form of a decision and the memory behind it.
#[inline(always)]
fn command(state: &VehicleState, decision: &Decision, memory: &Words) -> VehicleCommand {
    let (verdict, binding_rows) = match decision.verdict {
        Verdict::Tracked(row) => {
            let rows = row.map_or(0, |row| row as u32);
            // Whether a row binds is not to be foretold: no branch.
            (select_unpredictable(rows != 0, frames::VERDICT_BOUND, frames::VERDICT_NOMINAL), rows)
        }
        Verdict::Fe => (frames::VERDICT_FE, 0),
        Verdict::Infeasible => (frames::VERDICT_INFEASIBLE, 0),
    };
    let command = VehicleCommand {
        u_mps2: decision.u_mps2,
        planned_exit_time_s: decision.exit.0,
        planned_exit_speed_mps: decision.exit.1,
        vehicle: state.vehicle,
        zone: state.zone,
        binding_rows,
        mode: memory.mode,
        verdict,
        ..VehicleCommand::default()
    };
    command.remembering(memory.words)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::load_embedded;

    #[test]
    fn a_vehicle_that_comes_back_into_a_zone_it_left_empty_remembers_nothing() {
        let scenario = Arc::new(load_embedded("roundabout", &[], None).unwrap());
        let mut pool = ControllerPool::new(scenario.clone(), 0..3);
        let enters = VehicleState {
            v_mps: 8.0,
            entry_speed_mps: 8.0,
            flags: frames::STATE_ENTERED,
            ..VehicleState::default()
        };
        let alone = Assignment {
            own_conflict_m: 60.0,
            partner_conflict_m: 60.0,
            partner: frames::NO_VEHICLE,
            flags: frames::ASSIGNMENT_FREE_TERMINAL,
            ..Assignment::default()
        };
        let mut plan_of = |time_s: f64| {
            let now = [VehicleState { entry_time_s: time_s, ..enters }];
            pool.coordinate(&now, &[alone]).unwrap();
            let mut planned = None;
            pool.command(time_s, &now, |command| planned = Some(command.planned_exit_time_s)).unwrap();
            planned.unwrap() - time_s
        };
        // Of an empty zone nothing is said, so that between the two the pool hears nothing.
        let first_s = plan_of(10.0);
        let second_s = plan_of(500.0);
        assert!((second_s - first_s).abs() < 1e-9, "{first_s} s, then {second_s} s");
        assert!(first_s > 0.0);
    }

    #[test]
    fn assignments_the_law_could_not_plan_with_are_refused() {
        let scenario = Arc::new(load_embedded("paper", &[], None).unwrap());
        let v_max_mps = scenario.vehicle.v_max_mps;
        let states = [VehicleState { v_mps: 15.0, entry_speed_mps: 15.0, ..VehicleState::default() }];
        let good = Assignment {
            own_conflict_m: 200.0,
            partner_conflict_m: 200.0,
            terminal_speed_mps: 15.0,
            partner: frames::NO_VEHICLE,
            ..Assignment::default()
        };
        let judge = |assignment: Assignment| {
            ControllerPool::new(scenario.clone(), 0..2).coordinate(&states, &[assignment])
        };
        assert_eq!(judge(good), Ok(()));
        for speed in [f64::NAN, f64::INFINITY, -1.0, v_max_mps * 1.01] {
            let refused = judge(Assignment { terminal_speed_mps: speed, ..good });
            assert_eq!(refused, Err(PoolError::Malformed { zone: 0, vehicle: 0 }), "{speed}");
        }
        for m in [f64::NAN, -200.0, 1e300] {
            assert!(judge(Assignment { own_conflict_m: m, ..good }).is_err(), "{m}");
            assert!(judge(Assignment { partner_conflict_m: m, ..good }).is_err(), "{m}");
            assert!(judge(Assignment { scheduled_at_m: m, ..good }).is_err(), "{m}");
        }
        for s in [f64::NAN, f64::INFINITY] {
            assert!(judge(Assignment { scheduled_time_s: s, ..good }).is_err(), "{s}");
        }
    }
}
