//! What must hold between any two vehicles, worked out from a network's shape and the passing order alone: without
//! duties, conflict points or safe sets in closed form, step by step from what frames say.

use control_zones::scenario::{Crossing, Network, Path, Scenario, Segment, Zone};
use ipc_schemas::{NO_ZONE, STATE_ENTERED, VehicleState};
use std::collections::{HashMap, HashSet};

/// Rounding, m. A vehicle that stands 1e-9 m before a place passes it at an instant that its rounded positions give to
/// some 1e-6 s only, in which the other drives 2e-5 m.
const TOLERANCE_M: f64 = 1e-4;
/// A vehicle that has less than this when it enters is not relied on: sampling errs by less.
const CLEARLY_SAFE_M: f64 = 0.01;
/// Whoever comes to stand this close before a place, or at it, has not passed it yet, m: positions are rounded, and a
/// vehicle may go on to the place itself where it is admitted by the end of the step.
const STANDS_AT_M: f64 = 1e-9;
/// Instants within a step at which margins are looked at.
const SAMPLES: u32 = 8;

/// A stretch of two paths with the same segments: where it begins on each, and how long it is.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    own_m: f64,
    other_m: f64,
    length_m: f64,
}

/// A crossing of two paths: where its area begins on each, and how long it is.
#[derive(Clone, Copy, Debug)]
struct Cross {
    own_m: f64,
    other_m: f64,
    length_m: f64,
}

/// A motion in a path's coordinate, from one sample to the next.
#[derive(Clone, Copy, Debug)]
struct Motion {
    x_m: f64,
    v_mps: f64,
    u_mps2: f64,
    /// From then on it stands, s.
    until_s: f64,
}

impl Motion {
    fn between((x_m, v_mps): (f64, f64), (x1_m, v1_mps): (f64, f64), dt_s: f64) -> Motion {
        if v_mps > 0.0 && v1_mps == 0.0 {
            let until_s = (2.0 * (x1_m - x_m) / v_mps).min(dt_s);
            return Motion { x_m, v_mps, u_mps2: -v_mps / until_s.max(1e-12), until_s };
        }
        Motion { x_m, v_mps, u_mps2: (v1_mps - v_mps) / dt_s, until_s: dt_s }
    }

    fn braking(x_m: f64, v_mps: f64, braking_mps2: f64) -> Motion {
        Motion { x_m, v_mps, u_mps2: -braking_mps2, until_s: v_mps / braking_mps2 }
    }

    fn at(&self, s: f64) -> (f64, f64) {
        let s = s.min(self.until_s);
        (self.x_m + self.v_mps * s + 0.5 * self.u_mps2 * s * s, (self.v_mps + self.u_mps2 * s).max(0.0))
    }

    /// Where it has passed a place for good.
    fn behind_m(&self, place_m: f64, within_s: f64) -> f64 {
        if self.at(within_s).1 < 1e-9 { place_m + STANDS_AT_M } else { place_m }
    }

    /// When it reaches a place, by bisection.
    fn reaches(&self, place_m: f64, within_s: f64) -> Option<f64> {
        let place_m = self.behind_m(place_m, within_s);
        if self.x_m >= place_m || self.at(within_s).0 < place_m {
            return None;
        }
        let (mut low, mut high) = (0.0, within_s);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if self.at(middle).0 < place_m { low = middle } else { high = middle }
        }
        Some(high)
    }
}

/// A vehicle in one zone's coordinates.
#[derive(Clone, Copy, Debug)]
struct Seen {
    vehicle: u32,
    zone: u32,
    path: u32,
    next_path: u32,
    kind: usize,
    entry_time_s: f64,
    x_m: f64,
    v_mps: f64,
}

/// Watches a run.
pub struct Oracle<'a> {
    scenario: &'a Scenario,
    is_roomy: bool,
    /// Vehicles that were not clearly safe when they entered a zone.
    unsafe_: HashSet<u32>,
    /// Where links begin, by their index.
    links: Vec<(u32, u32)>,
    /// Pairs of vehicles and steps that were looked at.
    pub checked: u64,
}

fn starts(zone: &Zone, path: &Path) -> Vec<f64> {
    let mut at_m = 0.0;
    let start = |&s: &u32| {
        let here = at_m;
        at_m += zone.segments[s as usize].length_m;
        here
    };
    path.segments.iter().map(start).collect()
}

/// Segment by segment: adjacent ones are separate stretches here.
fn stretches(zone: &Zone, own: u32, other: u32) -> Vec<Stretch> {
    let (a, b) = (&zone.paths[own as usize], &zone.paths[other as usize]);
    let (a_starts, b_starts) = (starts(zone, a), starts(zone, b));
    let mut found = Vec::new();
    for (i, s) in a.segments.iter().enumerate() {
        if let Some(j) = b.segments.iter().position(|t| t == s) {
            let Segment { length_m, .. } = zone.segments[*s as usize];
            let near_m = near_m(zone, a.segments.get(i + 1), b.segments.get(j + 1));
            found.push(Stretch { own_m: a_starts[i], other_m: b_starts[j], length_m: length_m + near_m });
        }
    }
    found
}

/// Whether ways part at a crossing: behind one segment, at the beginnings of theirs.
fn parts(zone: &Zone, crossing: &Crossing) -> bool {
    let mut before = HashSet::new();
    for area in &crossing.places {
        for path in &zone.paths {
            for (at, segment) in path.segments.iter().enumerate() {
                if *segment == area.segment {
                    before.insert(if at == 0 { None } else { Some(path.segments[at - 1]) });
                }
            }
        }
    }
    before.len() == 1 && !before.contains(&None) && crossing.places.iter().all(|area| area.from_m == 0.0)
}

/// For how long two ways that part are near each other behind that, on the first of them.
fn near_m(zone: &Zone, own: Option<&u32>, other: Option<&u32>) -> f64 {
    let (Some(own), Some(other)) = (own, other) else { return 0.0 };
    let has = |crossing: &&Crossing, segment| crossing.places.iter().any(|area| area.segment == segment);
    let mut crossings = zone.crossings.iter().filter(|crossing| parts(zone, crossing));
    let found = crossings.find(|c| own != other && has(c, *own) && has(c, *other));
    found.map_or(0.0, |c| c.places.iter().find(|area| area.segment == *own).map_or(0.0, |area| area.length_m))
}

fn crossings(zone: &Zone, own: u32, other: u32) -> Vec<Cross> {
    let place = |path: u32, segment: u32| {
        let path = &zone.paths[path as usize];
        let at = path.segments.iter().position(|s| *s == segment)?;
        Some(starts(zone, path)[at])
    };
    let mut found = Vec::new();
    for crossing in zone.crossings.iter().filter(|crossing| !parts(zone, crossing)) {
        for a in &crossing.places {
            for b in crossing.places.iter().filter(|b| b.segment != a.segment) {
                if let (Some(own_m), Some(other_m)) = (place(own, a.segment), place(other, b.segment)) {
                    let length_m = b.length_m;
                    found.push(Cross { own_m: own_m + a.from_m, other_m: other_m + b.from_m, length_m });
                }
            }
        }
    }
    found
}

impl<'a> Oracle<'a> {
    pub fn new(scenario: &'a Scenario, is_roomy: bool) -> Oracle<'a> {
        let mut links = Vec::new();
        for (zone, shape) in (0..).zip(&scenario.network.zones) {
            for (exit, to) in (0..).zip(shape.exits.iter().map(|exit| exit.to)) {
                if to.is_some_and(|to| to.link_m > 0.0) {
                    links.push((zone, exit));
                }
            }
        }
        Oracle { scenario, is_roomy, unsafe_: HashSet::new(), links, checked: 0 }
    }

    fn network(&self) -> &Network {
        &self.scenario.network
    }

    fn seen(state: &VehicleState) -> Seen {
        Seen {
            vehicle: state.vehicle,
            zone: state.zone,
            path: state.path,
            next_path: state.next_path,
            kind: usize::from(state.kind),
            entry_time_s: state.entry_time_s,
            x_m: state.x_m,
            v_mps: state.v_mps,
        }
    }

    /// What is behind an exit of a path: zone, entrance, link.
    fn behind(&self, zone: u32, path: u32) -> Option<(u32, u32, f64)> {
        let to = self.network().zones[zone as usize].exit_of(path).to?;
        Some((to.zone, to.segment, to.link_m))
    }

    /// Where a vehicle that was seen in a zone is one step later, in that zone's coordinate.
    fn later(&self, was: &Seen, after: &[VehicleState]) -> Option<(f64, f64)> {
        let own: Vec<&VehicleState> = after.iter().filter(|s| s.vehicle == was.vehicle).collect();
        if let Some(s) = own.iter().find(|s| s.zone == was.zone && s.entry_time_s == was.entry_time_s) {
            return Some((s.x_m, s.v_mps));
        }
        let length_m = self.network().zones[was.zone as usize].paths[was.path as usize].length_m;
        let (zone, entrance, link_m) = self.behind(was.zone, was.path)?;
        own.iter().find_map(|s| {
            let entered = s.zone != NO_ZONE && s.flags & STATE_ENTERED != 0 && s.zone == zone;
            let paths = &self.network().zones[zone as usize].paths;
            if entered && paths[s.path as usize].segments[0] == entrance {
                return Some((length_m + link_m + s.x_m, s.v_mps));
            }
            (s.zone == NO_ZONE).then_some((length_m + s.x_m, s.v_mps))
        })
    }

    /// Those that are ahead on the way behind a path's end: as if they were on the path, with where the common
    /// stretch ends for a vehicle that goes on to `next_path`.
    fn onward(&self, zone: u32, path: u32, next_path: u32, frame: &[VehicleState]) -> Vec<(Seen, f64, f64)> {
        let Some((down, entrance, link_m)) = self.behind(zone, path) else { return Vec::new() };
        let length_m = self.network().zones[zone as usize].paths[path as usize].length_m;
        let exit = self.network().zones[zone as usize].paths[path as usize].exit;
        let there = &self.network().zones[down as usize];
        let common_m = |other: u32| {
            let own = there.paths.get(next_path as usize)?;
            let theirs = &there.paths[other as usize];
            let same = own.segments.iter().zip(&theirs.segments).take_while(|(a, b)| a == b);
            Some(same.map(|(s, _)| there.segments[*s as usize].length_m).sum::<f64>())
        };
        let mut found = Vec::new();
        for s in frame {
            if s.zone == NO_ZONE && self.links.get(s.link as usize) == Some(&(zone, exit)) {
                let to_m = length_m + link_m + common_m(s.path).unwrap_or(0.0);
                found.push((Oracle::seen(s), length_m, to_m));
            }
            let enters = |s: &VehicleState| there.paths[s.path as usize].segments[0] == entrance;
            if s.zone == down && !s.has_left() && enters(s) {
                let shift_m = length_m + link_m;
                found.push((Oracle::seen(s), shift_m, shift_m + common_m(s.path).unwrap_or(0.0)));
            }
        }
        found
    }

    fn gap_m(&self, own: usize, other: usize) -> f64 {
        let kind = |k: usize| &self.scenario.fleet[k].vehicle;
        kind(own).standstill_gap_m + (kind(other).length_m - self.scenario.vehicle.length_m).max(0.0)
    }

    /// The least margin of a vehicle toward another that passes before it, in one zone, over some time: on common
    /// stretches at every instant, at crossings at the instant at which it gets there; infinite when the two do not
    /// meet.
    fn pair_m(
        &self,
        (i, own): (&Seen, &Motion),
        (j, other): (&Seen, &Motion),
        within_s: f64,
        count: u32,
    ) -> f64 {
        let zone = &self.network().zones[i.zone as usize];
        let mut least_m = f64::INFINITY;
        for s in stretches(zone, i.path, j.path) {
            let to_m = s.own_m + s.length_m;
            let margin =
                self.along_m((i, own), (j, other), (s.own_m, to_m), s.own_m - s.other_m, within_s, count);
            least_m = least_m.min(margin);
        }
        let (a, b) = (&zone.paths[i.path as usize], &zone.paths[j.path as usize]);
        if a.exit == b.exit {
            // Behind a common exit they drive on together as far as both go the same way.
            let behind_m = self.behind(i.zone, i.path).map_or(1e9, |(down, _, link_m)| {
                let there = &self.network().zones[down as usize];
                let (Some(p), Some(q)) =
                    (there.paths.get(i.next_path as usize), there.paths.get(j.next_path as usize))
                else {
                    return 1e9;
                };
                let same = p.segments.iter().zip(&q.segments).take_while(|(a, b)| a == b);
                link_m + same.map(|(s, _)| there.segments[*s as usize].length_m).sum::<f64>()
            });
            let stretch = (a.length_m, a.length_m + behind_m);
            let shift_m = a.length_m - b.length_m;
            least_m = least_m.min(self.along_m((i, own), (j, other), stretch, shift_m, within_s, count));
            // On the path itself the other counts once it is behind the end.
            if a.segments.last() == b.segments.last() {
                let last_m =
                    zone.segments[*a.segments.last().expect("a path has segments") as usize].length_m;
                let stretch = (a.length_m - last_m, a.length_m + behind_m);
                least_m = least_m.min(self.along_m((i, own), (j, other), stretch, shift_m, within_s, count));
            }
        }
        let phi_s = self.scenario.fleet[i.kind].vehicle.reaction_time_s;
        let body_m = self.scenario.fleet[j.kind].vehicle.length_m;
        for c in crossings(zone, i.path, j.path) {
            let Some(at_s) = own.reaches(c.own_m, within_s) else { continue };
            let (y_m, _) = other.at(at_s);
            least_m = least_m.min(y_m - c.other_m - phi_s * own.at(at_s).1 - c.length_m - body_m);
        }
        least_m
    }

    /// The same along one stretch, given in the vehicle's coordinate.
    fn along_m(
        &self,
        (i, own): (&Seen, &Motion),
        (j, other): (&Seen, &Motion),
        (from_m, to_m): (f64, f64),
        shift_m: f64,
        within_s: f64,
        count: u32,
    ) -> f64 {
        if own.x_m >= to_m || own.at(within_s).0 < from_m.min(own.x_m) {
            return f64::INFINITY;
        }
        let phi_s = self.scenario.fleet[i.kind].vehicle.reaction_time_s;
        let body_m = self.scenario.fleet[j.kind].vehicle.length_m;
        let gap_m = self.gap_m(i.kind, j.kind);
        let passed_m = own.behind_m(from_m, within_s);
        let margin_at = |s: f64| {
            let ((x_m, v_mps), (y_m, _)) = (own.at(s), other.at(s));
            let y_m = y_m + shift_m;
            let is_on = (x_m >= passed_m || from_m == 0.0) && x_m < to_m && y_m < to_m + body_m;
            if is_on { y_m - x_m - phi_s * v_mps - gap_m } else { f64::INFINITY }
        };
        let mut least_m = f64::INFINITY;
        for at in 0..=count {
            least_m = least_m.min(margin_at(within_s * f64::from(at) / f64::from(count)));
        }
        if let Some(at_s) = own.reaches(from_m, within_s) {
            least_m = least_m.min(margin_at(at_s));
        }
        least_m
    }

    /// The least margin of a vehicle toward one in the zone behind, or on the link there.
    fn onward_m(
        &self,
        (i, own): (&Seen, &Motion),
        (j, other): (&Seen, &Motion),
        (shift_m, to_m): (f64, f64),
        within_s: f64,
        count: u32,
    ) -> f64 {
        // It may have come to the end on another lane. While both were on one, the pair is looked at in its own zone.
        let end_m = self.network().zones[i.zone as usize].paths[i.path as usize].length_m;
        self.along_m((i, own), (j, other), (end_m, to_m), shift_m, within_s, count)
    }

    /// Judges those that have just entered: whether, when all brake fully, they keep their margins toward everybody
    /// that passes before them.
    pub fn enter(
        &mut self,
        before: &[VehicleState],
        frame: &[VehicleState],
        orders: &HashMap<u32, Vec<u32>>,
    ) -> Result<(), String> {
        for state in frame.iter().filter(|s| s.zone != NO_ZONE && s.flags & STATE_ENTERED != 0) {
            let i = Oracle::seen(state);
            let mut least_m = f64::INFINITY;
            let mut toward = 0;
            let own = self.brakes(&i);
            let mut worst = |margin: f64, j: u32| {
                if margin < least_m {
                    (least_m, toward) = (margin, j);
                }
            };
            let (earlier, _) = self.earlier(&i, frame, orders);
            for j in &earlier {
                worst(self.pair_m((&i, &own), (j, &self.brakes(j)), 12.0, 1200), j.vehicle);
            }
            for (j, shift_m, to_m) in self.onward(i.zone, i.path, i.next_path, frame) {
                let other = self.brakes(&j);
                worst(self.onward_m((&i, &own), (&j, &other), (shift_m, to_m), 12.0, 1200), j.vehicle);
            }
            let came = before.iter().any(|s| s.vehicle == i.vehicle && s.zone != NO_ZONE && !s.has_left());
            let was_safe = came && !self.unsafe_.contains(&i.vehicle);
            let all_safe = earlier.iter().all(|j| !self.unsafe_.contains(&j.vehicle));
            if self.is_roomy && was_safe && all_safe && least_m < -TOLERANCE_M {
                return Err(format!(
                    "vehicle {} was safe, and enters zone {} {least_m} m short of being safe toward {toward}",
                    i.vehicle, i.zone
                ));
            }
            if least_m < CLEARLY_SAFE_M && !(self.is_roomy && was_safe) {
                self.unsafe_.insert(i.vehicle);
            }
        }
        Ok(())
    }

    fn brakes(&self, seen: &Seen) -> Motion {
        let braking_mps2 = -self.scenario.fleet[seen.kind].vehicle.u_min_mps2;
        Motion::braking(seen.x_m, seen.v_mps, braking_mps2)
    }

    /// Who passes before a vehicle in its zone, nearest in the order first, as far back as everybody had entered
    /// safely; and whether that is all of them.
    fn earlier(
        &self,
        i: &Seen,
        frame: &[VehicleState],
        orders: &HashMap<u32, Vec<u32>>,
    ) -> (Vec<Seen>, bool) {
        let here = |vehicle: u32| {
            let is = |s: &&VehicleState| s.vehicle == vehicle && s.zone == i.zone && !s.has_left();
            frame.iter().find(is).map(Oracle::seen)
        };
        let order = &orders[&i.zone];
        let rank = order.iter().position(|v| *v == i.vehicle).expect("an order has all members");
        let mut found = Vec::new();
        for vehicle in order[..rank].iter().rev() {
            if self.unsafe_.contains(vehicle) {
                return (found, false);
            }
            found.extend(here(*vehicle));
        }
        let left = frame.iter().filter(|s| s.zone == i.zone && s.has_left());
        for s in left {
            if !self.unsafe_.contains(&s.vehicle) {
                found.push(Oracle::seen(s));
            }
        }
        (found, true)
    }

    /// Looks at a step, from one frame to the next, with the orders in force.
    pub fn watch(
        &mut self,
        before: &[VehicleState],
        after: &[VehicleState],
        orders: &HashMap<u32, Vec<u32>>,
    ) -> Result<(), String> {
        let dt_s = self.scenario.dt_s();
        let mut checked = 0;
        for state in before.iter().filter(|s| s.zone != NO_ZONE && !s.has_left()) {
            let i = Oracle::seen(state);
            if self.unsafe_.contains(&i.vehicle) {
                continue;
            }
            let Some(later) = self.later(&i, after) else { continue };
            let own = Motion::between((i.x_m, i.v_mps), later, dt_s);
            let (earlier, is_all) = self.earlier(&i, before, orders);
            for j in &earlier {
                let Some(there) = self.later(j, after) else { continue };
                let other = Motion::between((j.x_m, j.v_mps), there, dt_s);
                let margin = self.pair_m((&i, &own), (j, &other), dt_s, SAMPLES);
                checked += 1;
                if margin < -TOLERANCE_M {
                    return Err(format!("margin {margin} m of {i:?} toward {j:?}"));
                }
            }
            if !is_all {
                continue;
            }
            for (j, shift_m, to_m) in self.onward(i.zone, i.path, i.next_path, before) {
                if self.unsafe_.contains(&j.vehicle) {
                    continue;
                }
                let Some(there) = self.later_anywhere(&j, after) else { continue };
                let other = Motion::between((j.x_m, j.v_mps), there, dt_s);
                let margin = self.onward_m((&i, &own), (&j, &other), (shift_m, to_m), dt_s, SAMPLES);
                checked += 1;
                if margin < -TOLERANCE_M {
                    return Err(format!("margin {margin} m of {i:?} toward {j:?}, who is ahead of its zone"));
                }
            }
        }
        self.checked += checked;
        Ok(())
    }

    /// As [`later`](Self::later), also of a vehicle on a link.
    fn later_anywhere(&self, was: &Seen, after: &[VehicleState]) -> Option<(f64, f64)> {
        if was.zone != NO_ZONE {
            return self.later(was, after);
        }
        // Those that leave the link in this step are looked at again in the next.
        let s = after.iter().find(|s| s.vehicle == was.vehicle && s.zone == NO_ZONE)?;
        (s.entry_time_s == was.entry_time_s).then_some((s.x_m, s.v_mps))
    }
}
