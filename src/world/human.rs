//! Human drivers: what they see, when they notice it, and what they do.
//!
//! A driver knows its own position and speed now, and what others do as it was a delay ago. Toward vehicles ahead it
//! follows the intelligent driver model, within the speed from which it can still stop; where it has to let somebody pass,
//! a line before the conflict point is what it stops at. Random numbers are hashes of seed, time and vehicle.

use super::car::Car;
use super::faults::{Draws, Purpose};
use super::role::World;
use crate::conflict::{Conflicts, Use, clear_m, line_before_m};
use crate::lists::Lists;
use crate::scenario::{HumanParams, Scenario, Source, VehicleKind, VehicleParams, Yielding};
use crate::vehicle::driver::{Ahead, reach_s, safe_mps2, wish_mps2};
use std::collections::{BTreeMap, VecDeque};

/// What they keep from a conflict point at least when they stop for it, m.
const BEFORE_POINT_M: f64 = 0.1;
/// Slower than this is standing, m/s.
const STANDING_MPS: f64 = 0.3;
/// Faster than this is driving, m/s.
const DRIVING_MPS: f64 = 3.0;
/// A speed with which nobody is expected sooner than never, m/s.
const CREEPING_MPS: f64 = 0.1;
/// Whoever is seen to brake harder than this means to stop, m/s^2.
const BRAKING_MPS2: f64 = 0.5;
/// Time that whoever starts gives those that come to notice it: until it moves, and their reaction, s.
const LOOKING_S: f64 = 1.0;
/// Whoever is seen to brake for so long does not only waver, s.
const BRAKES_S: f64 = 0.5;
/// So many times as long as patience lasts and to notice takes is the turn of one of two that stand.
const TURN: f64 = 2.0;
/// Between errors of one driver's acceleration, s.
const NOISE_S: f64 = 1.0;
/// How long one brakes for no reason, s.
const SCARE_S: f64 = 2.0;

/// Whether drivers of a kind go by how long others have stood.
fn goes_by_standing(kind: &VehicleKind) -> bool {
    kind.human.is_some_and(|human| human.yields == Yielding::Gap)
}

/// The human drivers of a run.
#[derive(Debug)]
pub(super) struct Humans {
    /// By kind of vehicle.
    drivers: Vec<Option<HumanParams>>,
    minds: BTreeMap<u32, Mind>,
    draws: Draws,
    /// By zone and path: who has the right of way by the entrance's rank.
    ranks: Lists<u32>,
    /// Place in the passing order by car of the zone that is looked at.
    places: Vec<u32>,
    /// How long vehicles have stood and braked, if there are drivers who go by it.
    stood: Option<BTreeMap<u32, Stood>>,
    /// The same by car of the zone that is looked at.
    stands: Vec<Stood>,
    dt_s: f64,
    longest_m: f64,
}

/// What one driver remembers.
#[derive(Debug)]
struct Mind {
    /// Added to its position in the zone to have one that grows on, m.
    base_m: f64,
    desired_mps: f64,
    /// Steps for which it has stood since it drove last.
    stands: u64,
    /// What it saw, the oldest first.
    seen: VecDeque<Seen>,
    /// Most that is remembered.
    delay: usize,
}

/// For how many steps a vehicle has stood or braked: whoever looks on can see it.
#[derive(Clone, Copy, Debug, Default)]
struct Stood {
    /// Has stood since it drove last.
    queued: u64,
    /// Has stood without a break.
    still: u64,
    /// Has braked without a break.
    brakes: u64,
}

/// What is to be seen in one step, in the coordinate that grows on.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    /// The vehicle ahead, and the one whose stopping point is nearest.
    leaders: [Option<Ahead>; 2],
    stop: Option<Stop>,
}

/// Where to stop.
#[derive(Clone, Copy, Debug)]
struct Stop {
    line_m: f64,
    point_m: f64,
}

impl Stop {
    /// Where it can still be stopped: at the line, before the point, or nowhere.
    fn ahead(&self, x_m: f64, v_mps: f64, hardest_mps2: f64) -> Option<Ahead> {
        let stops_m = x_m + v_mps * v_mps / (2.0 * hardest_mps2);
        let latest_m = self.point_m - BEFORE_POINT_M;
        let rear_m = if stops_m <= self.line_m + 1e-6 { self.line_m } else { latest_m };
        let line = Ahead { rear_m, v_mps: 0.0, braking_mps2: hardest_mps2, gap_m: 0.0 };
        (stops_m <= latest_m + 1e-6).then_some(line)
    }
}

/// A zone as drivers in it see it.
#[derive(Clone, Copy)]
struct Scene<'a> {
    conflicts: &'a Conflicts,
    cars: &'a [Car],
    kinds: &'a [VehicleParams],
    places: &'a [u32],
    stands: &'a [Stood],
    ranks: &'a [u32],
    longest_m: f64,
    dt_s: f64,
}

impl Humans {
    /// Those of a scenario, if it has any.
    pub(super) fn of(scenario: &Scenario) -> Option<Box<Humans>> {
        if !scenario.has_humans() {
            return None;
        }
        let zones = &scenario.network.zones;
        let mut ranks = Lists::new(zones.len());
        for (at, zone) in zones.iter().enumerate() {
            for path in 0..zone.paths.len() as u32 {
                ranks.push(
                    at,
                    match zone.entrance(path).source {
                        Some(Source::Road(road)) => scenario.network.roads[road as usize].rank,
                        _ => u32::MAX,
                    },
                );
            }
        }
        Some(Box::new(Humans {
            drivers: scenario.fleet.iter().map(|kind| kind.human).collect(),
            minds: BTreeMap::new(),
            draws: Draws::of(scenario.seed),
            ranks,
            places: Vec::new(),
            stood: scenario.fleet.iter().any(goes_by_standing).then(BTreeMap::new),
            stands: Vec::new(),
            dt_s: scenario.dt_s(),
            longest_m: scenario.fleet.iter().map(|kind| kind.vehicle.length_m).fold(0.0, f64::max),
        }))
    }

    /// Whether vehicles of a kind have one.
    pub(super) fn drive(&self, kind: u16) -> bool {
        self.drivers[usize::from(kind)].is_some()
    }

    /// A vehicle has passed the end of a path or link of this length; behind a link nothing is remembered.
    pub(super) fn pass(&mut self, vehicle: u32, length_m: f64, forgets: bool) {
        if let Some(mind) = self.minds.get_mut(&vehicle) {
            mind.base_m += length_m;
            if forgets {
                mind.seen.clear();
            }
        }
    }

    /// A vehicle has left the network.
    pub(super) fn forget(&mut self, vehicle: u32) {
        self.minds.remove(&vehicle);
        if let Some(stood) = &mut self.stood {
            stood.remove(&vehicle);
        }
    }

    /// Notes who of a zone's vehicles stands or brakes.
    fn watch(&mut self, cars: &[Car], first: usize) {
        self.stands.clear();
        self.stands.resize(cars.len(), Stood::default());
        let Some(all) = &mut self.stood else { return };
        for (car, noted) in cars[first..].iter().zip(&mut self.stands[first..]) {
            let stood = all.entry(car.vehicle).or_default();
            let stands = car.v_mps < STANDING_MPS;
            stood.still = if stands { stood.still + 1 } else { 0 };
            stood.brakes = if car.u_mps2 < -BRAKING_MPS2 { stood.brakes + 1 } else { 0 };
            if car.v_mps > DRIVING_MPS {
                stood.queued = 0
            } else {
                stood.queued += u64::from(stands)
            }
            *noted = *stood;
        }
    }

    fn mind(&mut self, car: &Car, human: &HumanParams, v_max_mps: f64) -> &mut Mind {
        let Humans { minds, draws, dt_s, .. } = self;
        minds.entry(car.vehicle).or_insert_with(|| {
            let drawn = human.desired_sd_mps * draws.normal(0, car.vehicle, Purpose::Desired);
            let delay = (human.delay_s / *dt_s + 0.5) as usize;
            Mind {
                base_m: 0.0,
                // Nobody crawls for want of wishing to get on.
                desired_mps: (human.desired_mps + drawn).max(0.3 * human.desired_mps).min(v_max_mps),
                stands: 0,
                seen: VecDeque::with_capacity(delay + 2),
                delay,
            }
        })
    }

    /// What a driver does over the coming step.
    fn decide(&mut self, scene: &Scene<'_>, at: usize, human: &HumanParams, step: u64) -> f64 {
        let car = &scene.cars[at];
        let vehicle = &scene.kinds[usize::from(car.kind)];
        let (dt_s, draws) = (self.dt_s, self.draws);
        let mind = self.mind(car, human, vehicle.v_max_mps);
        if car.v_mps < STANDING_MPS {
            mind.stands += 1;
        } else if car.v_mps > DRIVING_MPS {
            mind.stands = 0;
        }
        let waited_s = mind.stands as f64 * dt_s;
        let stood = scene.stands[at];
        let driver = Driver { human, car, desired_mps: mind.desired_mps, waited_s, stood, vehicle };
        let base_m = mind.base_m;
        let mut seen = scene.look(&driver, at);
        seen.leaders.iter_mut().flatten().for_each(|ahead| ahead.rear_m += base_m);
        if let Some(stop) = &mut seen.stop {
            stop.line_m += base_m;
            stop.point_m += base_m;
        }
        if mind.seen.len() > mind.delay {
            mind.seen.pop_front();
        }
        mind.seen.push_back(seen);
        let noticed = mind.seen[0];
        let (x_m, v_mps) = (base_m + car.x_m, car.v_mps);
        let stop = noticed.stop.and_then(|stop| stop.ahead(x_m, v_mps, human.hardest_mps2));
        let all = || noticed.leaders.iter().flatten().copied().chain(stop);
        let second = |every_s: f64| (step as f64 * dt_s / every_s) as u64;
        if human.scares_per_h > 0.0 {
            let probability = human.scares_per_h * SCARE_S / 3600.0;
            if draws.uniform(second(SCARE_S), car.vehicle, Purpose::Scare) < probability {
                return -human.hardest_mps2;
            }
        }
        let mut u_mps2 = wish_mps2(human, mind.desired_mps, x_m, v_mps, all());
        if human.noise_mps2 > 0.0 {
            u_mps2 += human.noise_mps2 * draws.normal(second(NOISE_S), car.vehicle, Purpose::Wavering);
        }
        u_mps2 = u_mps2.min(human.acceleration_mps2);
        for ahead in all() {
            u_mps2 = u_mps2.min(safe_mps2(human.hardest_mps2, x_m, v_mps, &ahead, dt_s));
        }
        u_mps2.min((vehicle.v_max_mps - v_mps) / dt_s).max(-human.hardest_mps2)
    }
}

/// A driver as it looks around.
struct Driver<'a> {
    human: &'a HumanParams,
    car: &'a Car,
    vehicle: &'a VehicleParams,
    desired_mps: f64,
    waited_s: f64,
    stood: Stood,
}

/// Two vehicles at a point that both are to pass: distances to it, m.
struct Meeting {
    own_m: f64,
    other_m: f64,
    /// Distance of the other to the box in which the point is, m.
    other_box_m: f64,
    /// Whether the driver is in it.
    is_inside: bool,
    /// What has to be driven beyond the point until it is clear, m.
    clear_m: f64,
}

impl Scene<'_> {
    fn look(&self, driver: &Driver<'_>, at: usize) -> Seen {
        let car = driver.car;
        let mut seen = Seen::default();
        let [mut nearest_m, mut stops_m] = [f64::INFINITY; 2];
        for (index, other) in self.cars.iter().enumerate().filter(|(index, _)| *index != at) {
            let length_m = self.kinds[usize::from(other.kind)].length_m;
            self.conflicts.runs((car.path, car.next_path), (other.path, other.next_path), |run| {
                let there_m = other.x_m - run.other_from_m + run.from_m;
                let is_on_it = other.x_m >= run.other_from_m || run.other_from_m == 0.0;
                let is_ahead = there_m > car.x_m || there_m == car.x_m && index < at;
                if !is_on_it || !is_ahead || car.x_m >= run.to_m || there_m - length_m >= run.to_m {
                    return;
                }
                let braking_mps2 = -self.kinds[usize::from(other.kind)].u_min_mps2;
                let ahead = Ahead {
                    rear_m: there_m - length_m,
                    v_mps: other.v_mps,
                    braking_mps2,
                    gap_m: driver.human.jam_gap_m,
                };
                if ahead.rear_m < nearest_m {
                    (nearest_m, seen.leaders[0]) = (ahead.rear_m, Some(ahead));
                }
                let stop_m = ahead.rear_m + other.v_mps * other.v_mps / (2.0 * braking_mps2);
                if stop_m < stops_m {
                    (stops_m, seen.leaders[1]) = (stop_m, Some(ahead));
                }
            });
        }
        seen.stop = self.stop(driver, at);
        seen
    }

    /// The nearest line at which the driver has to stop.
    fn stop(&self, driver: &Driver<'_>, at: usize) -> Option<Stop> {
        let (car, human) = (driver.car, driver.human);
        let points = self.conflicts.points();
        for own in self.conflicts.uses(car.path).iter().filter(|own| own.at_m > car.x_m) {
            let is_inside = own.box_m <= car.x_m;
            let point = &points[own.point as usize];
            let waits = (0..self.cars.len()).filter(|&index| index != at).any(|index| {
                let other = &self.cars[index];
                let theirs = self.conflicts.uses(other.path).iter().find(|u| u.point == own.point);
                let Some(theirs) = theirs.filter(|theirs| !theirs.on_lane_of(own)) else { return false };
                let length_m = self.kinds[usize::from(other.kind)].length_m;
                if other.x_m >= theirs.at_m + clear_m(point, theirs, length_m) {
                    return false;
                }
                if other.x_m >= theirs.at_m {
                    return true;
                }
                let stood = self.stands[index];
                // Of a queue only the first can come.
                if human.yields == Yielding::Gap
                    && driver.stood.queued > 0
                    && stood.queued > 0
                    && self.is_behind_another(other, theirs)
                {
                    return false;
                }
                let meeting = Meeting {
                    own_m: own.at_m - car.x_m,
                    other_m: theirs.at_m - other.x_m,
                    other_box_m: theirs.box_m - other.x_m,
                    is_inside,
                    clear_m: driver.vehicle.length_m + own.area_m,
                };
                match human.yields {
                    Yielding::Order => self.places[index] < self.places[at],
                    Yielding::Priority | Yielding::Gap => self.gives_way(driver, other, stood, &meeting),
                }
            });
            if waits {
                // Where several points are passed in one go, nobody stops among them.
                let stops_here = is_inside || human.yields == Yielding::Order;
                let point_m = if stops_here { own.at_m } else { own.box_m };
                let before_m = line_before_m(point.kind, human.jam_gap_m, self.longest_m);
                return Some(Stop { line_m: point_m - before_m, point_m });
            }
        }
        None
    }

    /// Whether a driver has the right of way over another.
    ///
    /// Without ranks, of two that have queued the one whose patience has ended goes before the one whose patience has not,
    /// and otherwise who came first. Each grants it to the other by what is to be seen, and takes it for itself only
    /// when the other must have noticed: so they never both have it.
    fn has_way(&self, driver: &Driver<'_>, other: &Car, seen: Stood) -> bool {
        let Driver { human, car, stood, .. } = *driver;
        let came = |car: &Car| (car.entry_time_s, car.vehicle);
        let came_first = came(car) < came(other);
        if human.yields != Yielding::Gap {
            let [own, theirs] = [car, other].map(|car| self.ranks[car.path as usize]);
            return own > theirs || own == theirs && came_first;
        }
        let notices_s = human.delay_s + LOOKING_S;
        let has_ended = self.lasts_s(stood.queued) >= human.patience_s + notices_s;
        let theirs_has_ended = self.lasts_s(seen.queued) >= human.patience_s;
        // Whoever came first and yet stands still has its turn, then the other has, and so on: there may be reasons for it that
        // no rule between the two knows of.
        let first = if came_first { stood } else { seen };
        let turn_s = TURN * (human.patience_s + notices_s);
        let turns = self.lasts_s(first.still) / turn_s;
        let turn = turns as u64;
        if turn > 0 {
            let is_own = came_first == turn.is_multiple_of(2);
            return is_own && (turns - turn as f64) * turn_s >= notices_s;
        }
        match came_first {
            true => has_ended || !theirs_has_ended || stood.queued == 0,
            false => has_ended && !theirs_has_ended && self.lasts_s(seen.queued) >= notices_s,
        }
    }

    fn lasts_s(&self, steps: u64) -> f64 {
        steps as f64 * self.dt_s
    }

    /// Whether a driver that does not follow the passing order lets another go first.
    fn gives_way(&self, driver: &Driver<'_>, other: &Car, seen: Stood, meeting: &Meeting) -> bool {
        let Driver { human, car, desired_mps, waited_s, .. } = *driver;
        let is_gap = human.yields == Yielding::Gap;
        let has_way = self.has_way(driver, other, seen);
        let Meeting { own_m, other_m, other_box_m, is_inside, clear_m } = *meeting;
        if !is_inside && other_box_m <= 0.0 {
            // It is in the midst of it.
            return true;
        }
        let clears_s = reach_s(own_m + clear_m, car.v_mps, desired_mps, human.acceleration_mps2);
        // Whoever has the way may make use of it from now on.
        let counts_on_it = has_way || is_inside && other_box_m > 0.0;
        let comes_s = match counts_on_it {
            true => other_m / other.v_mps.max(CREEPING_MPS),
            false => reach_s(other_m, other.v_mps, desired_mps, human.acceleration_mps2),
        };
        let comfortable_m = |v_mps: f64| v_mps * v_mps / (2.0 * human.comfortable_mps2);
        let mut is_patient = waited_s < human.patience_s || other.v_mps >= STANDING_MPS;
        let mut means_to_stop = other.u_mps2 <= -BRAKING_MPS2;
        if is_gap {
            // Patience is in the right of way.
            is_patient = true;
            means_to_stop =
                self.lasts_s(seen.brakes) >= BRAKES_S && comfortable_m(other.v_mps) <= other_box_m;
        }
        let drives = other.v_mps >= STANDING_MPS && !means_to_stop;
        if is_inside && other_box_m <= 0.0 {
            // Both have entered, at the same instant perhaps. What the other does is to be seen: nobody drives on into one that
            // does, whoever has the way; and of two that stand the one that has it goes, or whom the other is in the way of.
            return match has_way {
                true => drives && comes_s < clears_s,
                false => {
                    is_patient
                        && comes_s < clears_s + human.critical_gap_s
                        && !self.stands_in_the_way(car, other)
                }
            };
        }
        let looks = has_way && !is_inside && car.v_mps < DRIVING_MPS;
        if looks && is_gap && other.v_mps > 0.0 && other.u_mps2 > 0.0 {
            // One that is starting next to the point is over it before it could notice.
            let over_m = (other.v_mps + 0.5 * human.acceleration_mps2 * LOOKING_S) * LOOKING_S;
            if over_m > other_box_m && comes_s < clears_s {
                return true;
            }
        }
        if looks && drives {
            // Whoever has stood looks before it starts whether those that show no sign of stopping still can without haste.
            let gains_mps = if is_gap { other.u_mps2.max(0.0) * LOOKING_S } else { 0.0 };
            let later_mps = other.v_mps + gains_mps;
            let stops_m = (other.v_mps + 0.5 * gains_mps) * LOOKING_S + comfortable_m(later_mps);
            return stops_m > other_box_m && comes_s < clears_s;
        }
        let braking_mps2 = -self.kinds[usize::from(other.kind)].u_min_mps2;
        let stops_by_m = if other_box_m > 0.0 { other_box_m } else { other_m };
        let stops = other.v_mps * other.v_mps / (2.0 * braking_mps2) <= stops_by_m;
        if counts_on_it {
            // Nobody insists on it toward one that cannot stop any more.
            return !stops && comes_s < clears_s;
        }
        comes_s - clears_s < human.critical_gap_s && is_patient
    }

    /// Whether somebody drives ahead of a vehicle on its lane up to a conflict point.
    fn is_behind_another(&self, other: &Car, theirs: &Use) -> bool {
        self.cars.iter().any(|car| {
            let own = self.conflicts.uses(car.path).iter().find(|u| u.point == theirs.point);
            own.is_some_and(|own| {
                let left_m = own.at_m - car.x_m;
                own.on_lane_of(theirs) && left_m > 0.0 && left_m < theirs.at_m - other.x_m
            })
        })
    }

    /// Whether a vehicle is on a conflict point that another has yet to pass.
    fn stands_in_the_way(&self, car: &Car, other: &Car) -> bool {
        let length_m = self.kinds[usize::from(car.kind)].length_m;
        self.conflicts.uses(car.path).iter().any(|own| {
            let to_m = own.at_m + clear_m(&self.conflicts.points()[own.point as usize], own, length_m);
            let theirs = self.conflicts.uses(other.path).iter().find(|u| u.point == own.point);
            (own.at_m..to_m).contains(&car.x_m)
                && theirs.is_some_and(|theirs| !theirs.on_lane_of(own) && other.x_m < theirs.at_m)
        })
    }
}

impl World {
    /// Lets human drivers decide what they do over the coming step.
    pub(super) fn drive_humans(&mut self) {
        let Some(mut humans) = self.humans.take() else { return };
        for zone in 0..self.zones.len() {
            let first = self.zones[zone].first();
            if !self.cars[zone][first..].iter().any(|car| !car.is_commanded) {
                continue;
            }
            humans.watch(&self.cars[zone], first);
            // Those that have left come first.
            let mut places = std::mem::take(&mut humans.places);
            places.clear();
            places.resize(self.cars[zone].len(), 0);
            (1..).zip(&self.order[zone]).for_each(|(place, at)| places[*at as usize] = place);
            let ranks = std::mem::replace(&mut humans.ranks, Lists::new(0));
            let stands = std::mem::take(&mut humans.stands);
            for at in first..self.cars[zone].len() {
                let Some(human) = humans.drivers[usize::from(self.cars[zone][at].kind)] else { continue };
                let scene = Scene {
                    conflicts: &self.conflicts[zone],
                    cars: &self.cars[zone],
                    kinds: &self.kinds,
                    places: &places,
                    stands: &stands,
                    ranks: &ranks[zone],
                    dt_s: humans.dt_s,
                    longest_m: humans.longest_m,
                };
                let u_mps2 = humans.decide(&scene, at, &human, self.step);
                self.cars[zone][at].command_mps2 = u_mps2;
            }
            (humans.places, humans.ranks, humans.stands) = (places, ranks, stands);
        }
        self.humans = Some(humans);
    }
}
