//! What a controller sees.

use ipc_schemas::{
    self as frames, ASSIGNMENT_FREE_TERMINAL, Assignment, Feedback, FrameHeader, KindSpec, PATH_OWN,
    PathSpec, RunSpec, VehicleState,
};
use std::ops::Range;

/// The run a controller has joined.
#[derive(Clone, Debug)]
pub struct Run {
    /// Step, limits, distances and gains.
    pub spec: RunSpec,
    /// All paths of all zones.
    pub paths: Vec<Path>,
    /// Kinds of vehicles, by `VehicleState::kind`.
    pub kinds: Vec<KindSpec>,
    /// Own index among the controller processes.
    pub index: u32,
    /// Place of each zone's first path, and behind the last one.
    first: Vec<u32>,
    /// Zones of which this controller drives a path, ascending.
    own_zones: Vec<u32>,
}

/// An path and its name, `ZONE.PATH`.
#[derive(Clone, Debug)]
pub struct Path {
    /// Its numbers.
    pub spec: PathSpec,
    /// Its name.
    pub name: String,
}

impl Run {
    /// A run of these paths; nothing when they do not come zone by zone and path by path.
    pub(crate) fn new(spec: RunSpec, paths: Vec<Path>, kinds: Vec<KindSpec>, index: u32) -> Option<Run> {
        let mut first = Vec::new();
        let mut at = 0;
        for group in paths.chunk_by(|a, b| a.spec.zone == b.spec.zone) {
            let in_order = (0..).zip(group).all(|(path, a)| a.spec.path == path);
            if !in_order || group[0].spec.zone as usize != first.len() {
                return None;
            }
            first.push(at);
            at += group.len() as u32;
        }
        if first.len() != spec.zones as usize {
            return None;
        }
        first.push(at);
        let mut own_zones: Vec<u32> = paths.iter().filter(|a| a.is_own()).map(|a| a.spec.zone).collect();
        own_zones.dedup();
        Some(Run { spec, paths, kinds, index, first, own_zones })
    }

    /// A path of a zone.
    pub fn path(&self, zone: u32, path: u32) -> Option<&Path> {
        let [from, to] = *self.first.get(zone as usize..)?.first_chunk()?;
        self.paths.get(from.checked_add(path).filter(|at| *at < to)? as usize)
    }

    /// Whether this controller drives a path.
    pub fn drives(&self, zone: u32, path: u32) -> bool {
        self.path(zone, path).is_some_and(Path::is_own)
    }
}

impl Path {
    fn is_own(&self) -> bool {
        self.spec.flags & PATH_OWN != 0
    }
}

/// The coordination in force in one zone.
#[derive(Debug, Default)]
struct Zone {
    assignments: Vec<Assignment>,
    /// Place of each assignment's partner in the zone's slice of the state frame. The slice keeps its shape
    /// until the zone's next event, and with that come new assignments.
    partners: Vec<u32>,
    is_resolved: bool,
}

/// What a run has been for a controller, as the controller saw it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Summary {
    /// Step of the last state seen.
    pub step: u64,
    /// Simulated time of it, s.
    pub time_s: f64,
    /// Steps answered.
    pub answered: u64,
    /// Steps that passed without this controller between its answers.
    pub skipped: u64,
    /// Of the states seen, those before which the world had put something in for a controller that was late.
    pub missed: u64,
    /// Answers that the world refused, as far as it said so: once in a step.
    pub refused: u64,
}

/// One vehicle to be commanded: places in the state frame and in its zone's assignments.
#[derive(Clone, Debug)]
struct Member {
    at: u32,
    zone: u32,
    path: u32,
    /// The zone's slice of the frame.
    slice: Range<u32>,
    assignments: Range<u32>,
}

/// The coordination in force, and who is to be commanded.
#[derive(Debug)]
pub(crate) struct Board {
    zones: Vec<Zone>,
    members: Vec<Member>,
    /// Vehicles of a zone and their places, while partners are resolved; kept for its allocation.
    places: Vec<(u32, u32)>,
}

impl Board {
    /// Without coordination, for so many zones.
    pub(crate) fn new(zones: u32) -> Board {
        let zones = (0..zones).map(|_| Zone::default()).collect();
        Board { zones, members: Vec::new(), places: Vec::new() }
    }

    /// Replaces all coordination.
    pub(crate) fn restore(&mut self, assignments: &[Assignment]) {
        self.zones.iter_mut().for_each(|zone| *zone = Zone::default());
        self.coordinate(assignments);
    }

    /// Replaces the coordination of the zones that these are for.
    pub(crate) fn coordinate(&mut self, assignments: &[Assignment]) {
        for group in assignments.chunk_by(|a, b| a.zone == b.zone) {
            if let Some(zone) = self.zones.get_mut(group[0].zone as usize) {
                zone.assignments.clear();
                zone.assignments.extend_from_slice(group);
                zone.is_resolved = false;
            }
        }
    }

    /// The coordination in force in a zone.
    pub(crate) fn assignments(&self, zone: u32) -> &[Assignment] {
        self.zones.get(zone as usize).map_or(&[], |zone| &zone.assignments)
    }

    /// Finds in a state frame who is to be commanded, and what binds them.
    pub(crate) fn muster(&mut self, run: &Run, states: &[VehicleState]) {
        self.members.clear();
        for &number in &run.own_zones {
            let from = states.partition_point(|s| s.zone < number);
            let count = states[from..].partition_point(|s| s.zone == number);
            let slice = &states[from..from + count];
            let zone = &mut self.zones[number as usize];
            if !zone.is_resolved {
                zone.resolve(slice, &mut self.places);
            }
            // Assignments come in the order of the members.
            let mut next = 0;
            for (state, at) in slice.iter().zip(from as u32..) {
                if state.has_left() {
                    continue;
                }
                let VehicleState { vehicle, path, .. } = *state;
                let of_vehicle = zone.of_vehicle(vehicle, next);
                next = of_vehicle.end;
                if state.is_commanded() && run.drives(number, path) {
                    let slice = from as u32..(from + count) as u32;
                    let assignments = of_vehicle.start as u32..of_vehicle.end as u32;
                    self.members.push(Member { at, zone: number, path, slice, assignments });
                }
            }
        }
    }

    /// Number of vehicles to be commanded.
    pub(crate) fn count(&self) -> usize {
        self.members.len()
    }

    /// Vehicle and zone of one that is to be commanded.
    pub(crate) fn named(&self, states: &[VehicleState], member: usize) -> Option<(u32, u32)> {
        let Member { at, zone, .. } = *self.members.get(member)?;
        Some((states.get(at as usize)?.vehicle, zone))
    }
}

impl Zone {
    fn resolve(&mut self, slice: &[VehicleState], places: &mut Vec<(u32, u32)>) {
        places.clear();
        places.extend(slice.iter().zip(0..).map(|(s, at)| (s.vehicle, at)));
        places.sort_unstable();
        let place_of = |vehicle: u32| {
            let found = places.binary_search_by_key(&vehicle, |&(v, _)| v);
            found.map_or(u32::MAX, |found| places[found].1)
        };
        self.partners.clear();
        self.partners.extend(self.assignments.iter().map(|a| place_of(a.partner)));
        self.is_resolved = true;
    }

    /// The assignments of a vehicle, which are likely to begin at `next`.
    fn of_vehicle(&self, vehicle: u32, next: usize) -> Range<usize> {
        let is_its = |a: &Assignment| a.vehicle == vehicle;
        let all = &self.assignments;
        let from = match all.get(next).is_some_and(is_its) {
            true => next,
            false => all.iter().position(is_its).unwrap_or(next),
        };
        from..from + all[from..].iter().take_while(|a| is_its(a)).count()
    }
}

/// One step: the state frame, and the coordination in force.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// Header of the state frame.
    pub header: &'a FrameHeader,
    /// Simulated time, s.
    pub time_s: f64,
    /// The whole state frame, all zones.
    pub states: &'a [VehicleState],
    /// Whether the world put something in for a controller that was late in the step before.
    pub missed: bool,
    /// Steps that have passed without this controller since its last answer.
    pub skipped: u64,
    /// What this controller commanded for the step just ended, by vehicle, ascending.
    pub(crate) commanded: &'a [(u32, f64)],
    /// What the shield found of these commands, by vehicle, ascending.
    pub(crate) bounded: &'a [Feedback],
    /// Answers of this controller that the world refused since the last one it took, with field and rule.
    pub refusals: &'a [Feedback],
    pub(crate) run: &'a Run,
    pub(crate) board: &'a Board,
}

impl<'a> Step<'a> {
    /// The run's numbers.
    pub fn run(&self) -> &'a Run {
        self.run
    }

    /// The vehicles to be commanded, in the order of the commands.
    pub fn vehicles(&self) -> impl Iterator<Item = Vehicle<'a>> + use<'a> {
        let Step { run, states, board, commanded, bounded, .. } = *self;
        board.members.iter().map(move |member| {
            let zone = &board.zones[member.zone as usize];
            let bound = member.assignments.start as usize..member.assignments.end as usize;
            let state = &states[member.at as usize];
            let known = commanded.binary_search_by_key(&state.vehicle, |(vehicle, _)| *vehicle);
            Vehicle {
                state,
                place: (member.at - member.slice.start) as usize,
                commanded_mps2: known.ok().map(|at| commanded[at].1),
                bounded: bounded
                    .binary_search_by_key(&state.vehicle, |f| f.vehicle)
                    .ok()
                    .map(|at| &bounded[at]),
                length_m: run.path(member.zone, member.path).map_or(f64::NAN, |a| a.spec.length_m),
                assignments: &zone.assignments[bound.clone()],
                partners: &zone.partners[bound],
                slice: &states[member.slice.start as usize..member.slice.end as usize],
            }
        })
    }
}

/// One vehicle to be commanded.
#[derive(Clone, Copy, Debug)]
pub struct Vehicle<'a> {
    /// Where it is.
    pub state: &'a VehicleState,
    /// Its place among [`zone_states`](Self::zone_states).
    pub place: usize,
    /// What this controller commanded it for the step just ended, m/s^2, if it did: `state.u_mps2` is what was applied,
    /// and the rest is the shield's, or what the speed limit allowed.
    pub commanded_mps2: Option<f64>,
    /// What the shield found of that command, if it did not let it pass: `row` says what bounded it, `toward` which vehicle, and
    /// `greatest` is what it allowed, m/s^2.
    pub bounded: Option<&'a Feedback>,
    /// Length of its path, m.
    pub length_m: f64,
    /// Its constraints, as the coordinator sent them.
    pub assignments: &'a [Assignment],
    /// Where their partners are in the zone's slice of the frame.
    partners: &'a [u32],
    slice: &'a [VehicleState],
}

/// A vehicle that another must respect.
#[derive(Clone, Copy, Debug)]
pub struct Partner<'a> {
    /// Its record in the same zone; its broadcast intent stands there too.
    pub state: &'a VehicleState,
    /// Its place among the records of the zone.
    pub place: usize,
    /// What is owed to it now.
    pub kind: PartnerKind,
    /// Its position in the vehicle's own coordinate, m.
    pub x_m: f64,
    /// Distance of the conflict point on the vehicle's path, m; means nothing toward a leader.
    pub conflict_m: f64,
    /// Distance delta to be kept to it beside phi v, m.
    pub gap_m: f64,
}

/// What is owed to a partner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PartnerKind {
    /// It drives ahead: the distance is kept at every instant.
    RearEnd,
    /// It passes a merge first: the distance is kept from the instant at which the vehicle passes it.
    Merge,
    /// It crosses first: the distance is kept at the instant at which the vehicle reaches the crossing.
    Cross,
}

impl<'a> Vehicle<'a> {
    /// All records of its zone: those that have left it and still count, then the members.
    pub fn zone_states(&self) -> &'a [VehicleState] {
        self.slice
    }

    /// Terminal speed to leave the zone with, m/s; `None` when it is free.
    pub fn terminal_mps(&self) -> Option<f64> {
        let a = self.assignments.first()?;
        (a.flags & ASSIGNMENT_FREE_TERMINAL == 0).then_some(a.terminal_speed_mps)
    }

    /// Place on its path, m, and instant before which it is not to be there, s, that its coordinator has scheduled
    /// it for; `None` when nothing is scheduled.
    pub fn schedule(&self) -> Option<(f64, f64)> {
        let a = self.assignments.first()?;
        (a.scheduled_time_s > 0.0).then_some((a.scheduled_at_m, a.scheduled_time_s))
    }

    /// The vehicles it must respect where they are now.
    pub fn partners(&self) -> impl Iterator<Item = Partner<'a>> + use<'a> {
        let (slice, own_m) = (self.slice, self.state.x_m);
        self.assignments.iter().zip(self.partners).filter_map(move |(a, place)| {
            let state = slice.get(*place as usize).filter(|s| s.vehicle == a.partner)?;
            let kind = match a.kind {
                _ if state.x_m >= a.until_m => return None,
                frames::CONSTRAINT_REAR_END => PartnerKind::RearEnd,
                // Behind the merge the one that passed it first is the leader.
                frames::CONSTRAINT_MERGE if own_m >= a.own_conflict_m => PartnerKind::RearEnd,
                frames::CONSTRAINT_MERGE => PartnerKind::Merge,
                frames::CONSTRAINT_CROSS if own_m < a.own_conflict_m => PartnerKind::Cross,
                _ => return None,
            };
            Some(Partner {
                state,
                place: *place as usize,
                kind,
                x_m: state.x_m + a.own_conflict_m - a.partner_conflict_m,
                conflict_m: a.own_conflict_m,
                gap_m: a.gap_m,
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_schemas::{NO_VEHICLE, NO_ZONE, STATE_ENTERED, STATE_LEFT};

    /// Three zones of two paths each; the controller drives all of zone 0 and one path of zone 2.
    fn run() -> Run {
        let named = |zone, path| {
            let flags = if zone == 0 || (zone, path) == (2, 1) { PATH_OWN } else { 0 };
            let length_m = f64::from(100 + 10 * zone + path);
            let spec = PathSpec { zone, path, flags, length_m, ..PathSpec::default() };
            Path { spec, name: format!("z{zone}.a{path}") }
        };
        let paths: Vec<_> = (0..3).flat_map(|zone| (0..2).map(move |path| named(zone, path))).collect();
        let spec = RunSpec { zones: 3, paths: 6, ..RunSpec::default() };
        Run::new(spec, paths, Vec::new(), 1).expect("they come in order")
    }

    /// In each zone one that left and five members whose ids do not ascend; a vehicle on a link at the end.
    fn states() -> Vec<VehicleState> {
        let state = |zone: u32, k: u32| VehicleState {
            vehicle: (zone * 100 + k * 37) % 101,
            zone,
            path: k % 2,
            x_m: f64::from(50 - k),
            flags: if k == 0 { STATE_LEFT } else { STATE_ENTERED },
            ..VehicleState::default()
        };
        let zones = (0..3).flat_map(|zone| (0..6).map(move |k| state(zone, k)));
        zones.chain([VehicleState { vehicle: 7, zone: NO_ZONE, ..VehicleState::default() }]).collect()
    }

    /// Everybody yields to the two before it.
    fn assignments(states: &[VehicleState]) -> Vec<Assignment> {
        let mut all = Vec::new();
        for zone in states.chunk_by(|a, b| a.zone == b.zone).filter(|zone| zone[0].zone != NO_ZONE) {
            for (k, s) in zone.iter().enumerate().skip(1) {
                for (kind, back) in [(frames::CONSTRAINT_REAR_END, 1), (frames::CONSTRAINT_MERGE, 2)] {
                    let partner = k.checked_sub(back).map_or(NO_VEHICLE, |k| zone[k].vehicle);
                    let (vehicle, zone) = (s.vehicle, s.zone);
                    all.push(Assignment {
                        vehicle,
                        partner,
                        zone,
                        kind,
                        own_conflict_m: 3.0,
                        until_m: f64::INFINITY,
                        ..Assignment::default()
                    });
                }
            }
        }
        all
    }

    /// Vehicle, length of its path, and its partners with their positions.
    type Found = (u32, f64, Vec<(u32, f64)>);

    /// What a search through the whole frame finds.
    fn searched(run: &Run, states: &[VehicleState], all: &[Assignment]) -> Vec<Found> {
        let own = states.iter().filter(|s| s.is_commanded() && run.drives(s.zone, s.path));
        own.map(|s| {
            let its = all.iter().filter(|a| (a.zone, a.vehicle) == (s.zone, s.vehicle));
            let partners = its.filter_map(|a| {
                let partner = states.iter().find(|p| (p.zone, p.vehicle) == (s.zone, a.partner))?;
                Some((partner.vehicle, partner.x_m + 3.0))
            });
            let length_m = f64::from(100 + 10 * s.zone + s.path);
            (s.vehicle, length_m, partners.collect())
        })
        .collect()
    }

    fn seen(run: &Run, states: &[VehicleState], board: &Board) -> Vec<Found> {
        let header = FrameHeader::default();
        let (missed, skipped, commanded, bounded, refusals) = (false, 0, &[][..], &[][..], &[][..]);
        let (header, time_s) = (&header, 0.0);
        let step = Step { header, time_s, states, missed, skipped, commanded, bounded, refusals, run, board };
        let partners = |v: &Vehicle<'_>| v.partners().map(|p| (p.state.vehicle, p.x_m)).collect();
        step.vehicles().map(|v| (v.state.vehicle, v.length_m, partners(&v))).collect()
    }

    #[test]
    fn vehicles_and_partners_are_those_a_search_through_the_whole_frame_finds() {
        let (run, mut states) = (run(), states());
        let all = assignments(&states);
        let mut board = Board::new(3);
        board.coordinate(&all);
        board.muster(&run, &states);
        let expected = searched(&run, &states, &all);
        assert_eq!(expected.len(), 5 + 3);
        assert!(expected.iter().any(|(.., partners)| partners.len() == 2));
        assert_eq!(seen(&run, &states, &board), expected);
        // Another step of the same shape, without coordination.
        states.iter_mut().for_each(|s| s.x_m += 1.5);
        board.muster(&run, &states);
        assert_eq!(seen(&run, &states, &board), searched(&run, &states, &all));
        // A vehicle left zone 0: without the coordination that comes with it, nobody is mistaken for another.
        states.remove(1);
        board.muster(&run, &states);
        for (vehicle, _, partners) in seen(&run, &states, &board) {
            let its = |a: &&Assignment| a.vehicle == vehicle;
            assert!(partners.iter().all(|(p, _)| all.iter().filter(its).any(|a| a.partner == *p)));
        }
        board.restore(&assignments(&states));
        board.muster(&run, &states);
        assert_eq!(seen(&run, &states, &board), searched(&run, &states, &assignments(&states)));
    }

    #[test]
    fn paths_out_of_order_are_no_run() {
        let good = run();
        let mut swapped = good.paths.clone();
        swapped.swap(0, 1);
        assert!(Run::new(good.spec, swapped, Vec::new(), 0).is_none());
        assert!(Run::new(RunSpec { zones: 4, ..good.spec }, good.paths.clone(), Vec::new(), 0).is_none());
        assert!(good.path(2, 2).is_none() && good.path(3, 0).is_none());
        assert!(good.path(0, u32::MAX).is_none() && good.path(u32::MAX, 0).is_none());
    }
}
