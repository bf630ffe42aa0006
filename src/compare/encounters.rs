//! Surrogate safety measures over a run: how many pairs came close, by time to collision, deceleration to avoid one, and
//! post-encroachment time, whoever owes whom what.

use crate::conflict::Conflicts;
use crate::world::World;
use ipc_schemas::{NO_ZONE, VehicleState};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// A pair counts while its time to collision is below this, s; SUMO's default, as the next two.
const TTC_S: f64 = 3.0;
/// Or the deceleration to avoid a collision is above this, m/s^2.
const DRAC_MPS2: f64 = 3.0;
/// Or one reached a point sooner than this after the other had cleared it, s.
const PET_S: f64 = 2.0;
/// Slower than this is standing, m/s.
const STANDING_MPS: f64 = 0.3;
/// Faster than this is driving again, m/s.
const DRIVING_MPS: f64 = 1.5;

/// Counts over a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Counts {
    /// Pairs of vehicles, one behind the other, with a time to collision below 3 s.
    pub ttc: u32,
    /// Pairs with a deceleration to avoid a collision above 3 m/s^2.
    pub drac: u32,
    /// Passages of conflict points less than 2 s after another had cleared them, on another lane.
    pub pet: u32,
    /// How often vehicles came to a standstill.
    pub stops: u32,
}

/// Looks at every state of a run.
#[derive(Debug)]
pub(super) struct Encounters {
    conflicts: Vec<Conflicts>,
    ttc: BTreeSet<(u32, u32)>,
    drac: BTreeSet<(u32, u32)>,
    counts: Counts,
    standing: BTreeSet<u32>,
    /// Position in the state before, by zone and vehicle.
    before_m: BTreeMap<(u32, u32), f64>,
    now_m: BTreeMap<(u32, u32), f64>,
    /// Who cleared a point last: by zone and point, its paths and the instants.
    cleared: BTreeMap<(u32, u32), Vec<(u32, f64)>>,
}

impl Encounters {
    pub(super) fn of(world: &World) -> Encounters {
        Encounters {
            conflicts: Conflicts::of_all(&world.scenario().network),
            ttc: BTreeSet::new(),
            drac: BTreeSet::new(),
            counts: Counts::default(),
            standing: BTreeSet::new(),
            before_m: BTreeMap::new(),
            now_m: BTreeMap::new(),
            cleared: BTreeMap::new(),
        }
    }

    pub(super) fn see(&mut self, world: &World) {
        let states: Vec<VehicleState> = world.records().filter(|s| s.zone != NO_ZONE).collect();
        let time_s = world.scenario().time_s(world.step());
        for slice in states.chunk_by(|a, b| a.zone == b.zone) {
            for state in slice {
                self.pass(state, time_s);
                if state.has_left() {
                    continue;
                }
                self.follow(state, slice);
                if state.v_mps < STANDING_MPS {
                    self.counts.stops += u32::from(self.standing.insert(state.vehicle));
                } else if state.v_mps > DRIVING_MPS {
                    self.standing.remove(&state.vehicle);
                }
            }
        }
        std::mem::swap(&mut self.before_m, &mut self.now_m);
        self.now_m.clear();
    }

    pub(super) fn counts(&self) -> Counts {
        Counts { ttc: self.ttc.len() as u32, drac: self.drac.len() as u32, ..self.counts }
    }

    /// Toward the nearest vehicle ahead.
    fn follow(&mut self, own: &VehicleState, slice: &[VehicleState]) {
        let mut nearest: Option<(f64, &VehicleState)> = None;
        for other in slice.iter().filter(|other| other.vehicle != own.vehicle) {
            let (a, b) = ((own.path, own.next_path), (other.path, other.next_path));
            self.conflicts[own.zone as usize].runs(a, b, |run| {
                let there_m = other.x_m - run.other_from_m + run.from_m;
                let is_on_it = other.x_m >= run.other_from_m || run.other_from_m == 0.0;
                let gap_m = there_m - other.length_m - own.x_m;
                let is_nearer = nearest.is_none_or(|(least_m, _)| gap_m < least_m);
                if is_on_it && there_m > own.x_m && own.x_m < run.to_m && is_nearer {
                    nearest = Some((gap_m, other));
                }
            });
        }
        let Some((gap_m, other)) = nearest else { return };
        let closing_mps = own.v_mps - other.v_mps;
        if closing_mps > 0.0 && gap_m > 0.0 {
            let pair = (own.vehicle, other.vehicle);
            if gap_m < TTC_S * closing_mps {
                self.ttc.insert(pair);
            }
            if closing_mps * closing_mps > 2.0 * DRAC_MPS2 * gap_m {
                self.drac.insert(pair);
            }
        }
    }

    fn pass(&mut self, state: &VehicleState, time_s: f64) {
        let key = (state.zone, state.vehicle);
        let before_m = self.before_m.get(&key).copied().unwrap_or(state.x_m);
        self.now_m.insert(key, state.x_m);
        let conflicts = &self.conflicts[state.zone as usize];
        for own in conflicts.uses(state.path) {
            let passes = |at_m: f64| before_m < at_m && at_m <= state.x_m;
            let cleared = self.cleared.entry((state.zone, own.point)).or_default();
            if passes(own.at_m) {
                let on_another_lane = |&&(path, _): &&(u32, f64)| {
                    let theirs = conflicts.uses(path).iter().find(|u| u.point == own.point);
                    theirs.is_some_and(|theirs| !theirs.on_lane_of(own))
                };
                let last_s = cleared.iter().filter(on_another_lane).map(|(_, s)| *s).fold(-1e9, f64::max);
                self.counts.pet += u32::from(time_s - last_s < PET_S);
            }
            if passes(own.at_m + own.area_m + state.length_m) {
                cleared.retain(|(path, _)| *path != state.path);
                cleared.push((state.path, time_s));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::load_embedded;
    use std::sync::Arc;

    fn encounters() -> Encounters {
        Encounters::of(&World::new(Arc::new(load_embedded("intersection", &[], None).expect("embedded")), 1))
    }

    fn state(vehicle: u32, path: u32, x_m: f64, v_mps: f64) -> VehicleState {
        VehicleState {
            vehicle,
            path,
            x_m,
            v_mps,
            length_m: 4.5,
            next_zone: NO_ZONE,
            ..VehicleState::default()
        }
    }

    /// 10 m/s toward one that stands so far ahead: 2 s and 2.5 m/s^2 at 20 m, 4 s at 40 m, 5 m/s^2 at 10 m.
    #[test]
    fn who_closes_in_on_the_vehicle_ahead_is_counted_once_a_pair() {
        for (gap_m, ttc, drac) in [(40.0, 0, 0), (20.0, 1, 0), (10.0, 1, 1)] {
            let mut encounters = encounters();
            let own = state(1, 1, 100.0, 10.0);
            let slice = [own, state(2, 1, 104.5 + gap_m, 0.0)];
            encounters.follow(&own, &slice);
            encounters.follow(&own, &slice);
            let counts = encounters.counts();
            assert_eq!((counts.ttc, counts.drac), (ttc, drac), "{gap_m} m");
        }
    }

    /// From the north straight on over p6 at 310.539 m, whose area of 5.5 m and length of 4.5 m it has cleared at 320.539 m;
    /// from the west over it at 300 m.
    #[test]
    fn who_passes_a_point_soon_after_another_was_clear_of_it_is_counted() {
        for (after_s, pet) in [(1.9, 1), (2.1, 0)] {
            let mut encounters = encounters();
            for (x_m, time_s) in [(300.0, 0.0), (320.6, 10.0)] {
                encounters.pass(&state(1, 1, x_m, 10.0), time_s);
                std::mem::swap(&mut encounters.before_m, &mut encounters.now_m);
            }
            for (x_m, time_s) in [(299.0, 10.0), (300.1, 10.0 + after_s)] {
                encounters.pass(&state(2, 4, x_m, 10.0), time_s);
                std::mem::swap(&mut encounters.before_m, &mut encounters.now_m);
            }
            assert_eq!(encounters.counts().pet, pet, "{after_s} s");
        }
    }
}
