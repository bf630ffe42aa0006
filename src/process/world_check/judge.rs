//! What the frames of a world say of vehicles, judged one after the other.

use super::WorldRule;
use crate::scenario::Scenario;
use ipc_schemas::{self as frames, VehicleCommand, VehicleState};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// How far what happens may be from what was asked for.
#[derive(Clone, Copy, Debug)]
pub struct Tolerances {
    /// Of accelerations, m/s^2.
    pub acceleration_mps2: f64,
    /// Of ways, m.
    pub way_m: f64,
}

/// Further behind its zone than any vehicle comes in a step, m: the world has taken it out.
const TAKEN_OUT_M: f64 = 1e5;
/// Speeds differ by so much by rounding, m/s.
const ROUNDING_MPS: f64 = 1e-6;

/// Compares each state with the one before and with what was commanded.
#[derive(Debug)]
pub(super) struct Judge {
    scenario: Arc<Scenario>,
    tolerances: Tolerances,
    /// Those who are in the network, as they were in the last frame.
    last: BTreeMap<u32, VehicleState>,
    /// What they were to hold since.
    commanded: BTreeMap<u32, f64>,
    /// The next vehicle to come has this number.
    pub(super) next: u32,
    /// Vehicles that were commanded, and vehicles that have left the network.
    pub(super) driven: u64,
    pub(super) left: u64,
    pub(super) greatest_disobedience_mps2: f64,
    pub(super) greatest_deviation_m: f64,
}

impl Judge {
    pub(super) fn new(scenario: Arc<Scenario>, tolerances: Tolerances) -> Judge {
        Judge {
            scenario,
            tolerances,
            last: BTreeMap::new(),
            commanded: BTreeMap::new(),
            next: 0,
            driven: 0,
            left: 0,
            greatest_disobedience_mps2: 0.0,
            greatest_deviation_m: 0.0,
        }
    }

    /// What is to be held over the coming step.
    pub(super) fn command(&mut self, commands: &[VehicleCommand]) {
        self.commanded = commands.iter().map(|c| (c.vehicle, c.u_mps2)).collect();
        self.driven += commands.len() as u64;
    }

    /// Judges a frame; `note` is told of what is wrong.
    pub(super) fn judge(&mut self, states: &[VehicleState], note: &mut impl FnMut(WorldRule, String)) {
        let mut here: BTreeMap<u32, VehicleState> = BTreeMap::new();
        for state in states.iter().filter(|state| !state.has_left()) {
            self.place(state, note);
            if here.insert(state.vehicle, *state).is_some() {
                note(WorldRule::Unique, format!("vehicle {} is in two places", state.vehicle));
            }
        }
        let mut next = self.next;
        // Those that come behind an exit have numbers, too.
        let came: BTreeSet<u32> = states.iter().map(|state| state.vehicle).filter(|v| *v >= next).collect();
        for vehicle in came {
            if vehicle != next {
                note(WorldRule::Numbered, format!("vehicle {vehicle} came, expected {next}"));
            }
            next = vehicle + 1;
            if let Some(state) = here.get(&vehicle) {
                self.newcomer(state, states, note);
            }
        }
        for (vehicle, state) in
            here.range(..self.next).filter(|(vehicle, _)| !self.last.contains_key(vehicle))
        {
            let zone = self.zone_name(state);
            note(WorldRule::Kept, format!("vehicle {vehicle} was gone, and is in {zone} again (vehicle)"));
        }
        let last = std::mem::take(&mut self.last);
        for before in last.values() {
            match here.get(&before.vehicle) {
                Some(now) if (now.zone, now.path) == (before.zone, before.path) => {
                    self.moved(before, now, note)
                }
                // In the next zone, or on a link.
                Some(_) => {}
                None => self.gone(before, states, note),
            }
        }
        self.next = next;
        self.last = here;
        self.commanded.clear();
    }

    fn zone_name(&self, state: &VehicleState) -> String {
        let zone = self.scenario.network.zones.get(state.zone as usize);
        zone.map_or_else(|| "a link".to_owned(), |zone| zone.name.clone())
    }

    fn length_m(&self, state: &VehicleState) -> Option<f64> {
        let zone = self.scenario.network.zones.get(state.zone as usize)?;
        zone.paths.get(state.path as usize).map(|path| path.length_m)
    }

    /// Where it is, and how fast.
    fn place(&self, state: &VehicleState, note: &mut impl FnMut(WorldRule, String)) {
        let &VehicleState { vehicle, x_m, v_mps, zone, path, .. } = state;
        if !(x_m.is_finite() && v_mps.is_finite() && x_m >= 0.0 && v_mps >= 0.0) {
            let said = format!("vehicle {vehicle}: x_m is {x_m} and v_mps {v_mps}, expected numbers >= 0");
            return note(WorldRule::Numbers, said);
        }
        if zone == frames::NO_ZONE {
            return;
        }
        let Some(length_m) = self.length_m(state) else {
            return note(
                WorldRule::Numbers,
                format!("vehicle {vehicle}: there is no path {path} of zone {zone}"),
            );
        };
        if x_m >= length_m + self.tolerances.way_m {
            let said =
                format!("vehicle {vehicle}: x_m is {x_m} on a path of {length_m} m, and it has not left");
            note(WorldRule::Numbers, said);
        }
        let Some(kind) = self.scenario.fleet.get(usize::from(state.kind)) else {
            return note(WorldRule::Numbers, format!("vehicle {vehicle}: there is no kind {}", state.kind));
        };
        let v_max_mps = kind.vehicle.v_max_mps.max(state.entry_speed_mps) + ROUNDING_MPS;
        if state.is_commanded() && self.commanded.contains_key(&vehicle) && v_mps > v_max_mps {
            note(
                WorldRule::Numbers,
                format!("vehicle {vehicle}: v_mps is {v_mps}, expected at most {v_max_mps:.3}"),
            );
        }
    }

    /// One that came during the step.
    fn newcomer(
        &self,
        state: &VehicleState,
        states: &[VehicleState],
        note: &mut impl FnMut(WorldRule, String),
    ) {
        let zone = self.scenario.network.zones.get(state.zone as usize);
        let entrance = |path: u32| Some(*zone?.paths.get(path as usize)?.segments.first()?);
        let others = states.iter().filter(|other| {
            other.zone == state.zone
                && other.vehicle != state.vehicle
                && !other.has_left()
                && entrance(other.path).is_some()
                && entrance(other.path) == entrance(state.path)
        });
        for other in others {
            let (front, back) = if other.x_m >= state.x_m { (other, state) } else { (state, other) };
            if front.x_m - front.length_m < back.x_m {
                note(
                    WorldRule::Apart,
                    format!(
                        "vehicle {} came into {} at {:.2} m, where vehicle {} is, at {:.2} m and {:.2} m long",
                        state.vehicle,
                        self.zone_name(state),
                        state.x_m,
                        other.vehicle,
                        other.x_m,
                        front.length_m
                    ),
                );
            }
        }
    }

    /// One that is on the same path as before.
    fn moved(&mut self, before: &VehicleState, now: &VehicleState, note: &mut impl FnMut(WorldRule, String)) {
        let dt_s = self.scenario.dt_s();
        let Tolerances { acceleration_mps2, way_m } = self.tolerances;
        let (vehicle, way) = (now.vehicle, now.x_m - before.x_m);
        let commanded = self.commanded.get(&vehicle).copied();
        let stops = now.v_mps == 0.0;
        // Who is commanded to a standstill stands for the rest of the step.
        let expected_m = match commanded {
            Some(u_mps2) if before.v_mps + u_mps2 * dt_s < 0.0 => {
                before.v_mps * before.v_mps / (-2.0 * u_mps2)
            }
            _ => 0.5 * (before.v_mps + now.v_mps) * dt_s,
        };
        let off_m = match (stops, commanded) {
            (true, None) => (way - before.v_mps * dt_s).max(-way).max(0.0),
            _ => (way - expected_m).abs(),
        };
        self.greatest_deviation_m = self.greatest_deviation_m.max(off_m);
        if off_m > way_m {
            note(
                WorldRule::Motion,
                format!(
                    "vehicle {vehicle} came {way:.4} m from {:.3} to {:.3} m/s, expected {expected_m:.4} m (x_m)",
                    before.v_mps, now.v_mps
                ),
            );
        }
        let Some(u_mps2) = commanded else { return };
        let expected_mps = (before.v_mps + u_mps2 * dt_s).max(0.0);
        let off_mps2 = (now.v_mps - expected_mps).abs() / dt_s;
        self.greatest_disobedience_mps2 = self.greatest_disobedience_mps2.max(off_mps2);
        if expected_mps == 0.0 {
            if now.v_mps > acceleration_mps2 * dt_s || (before.v_mps == 0.0 && way.abs() > 1e-6) {
                note(
                    WorldRule::Standing,
                    format!(
                        "vehicle {vehicle} was at {:.3} m/s to hold {u_mps2:.3} m/s^2, and came {way:.4} m, to {:.3} m/s",
                        before.v_mps, now.v_mps
                    ),
                );
            }
        } else if off_mps2 > acceleration_mps2 {
            note(
                WorldRule::Obedience,
                format!(
                    "vehicle {vehicle} was at {:.3} m/s to hold {u_mps2:.3} m/s^2, and held {:.3} (v_mps {:.3})",
                    before.v_mps,
                    (now.v_mps - before.v_mps) / dt_s,
                    now.v_mps
                ),
            );
        }
    }

    /// One that is in the network no more.
    fn gone(
        &mut self,
        before: &VehicleState,
        states: &[VehicleState],
        note: &mut impl FnMut(WorldRule, String),
    ) {
        let dt_s = self.scenario.dt_s();
        let &VehicleState { vehicle, x_m, v_mps, .. } = before;
        let record = states.iter().find(|state| state.vehicle == vehicle && state.zone == before.zone);
        let zone = self.zone_name(before);
        if record.is_some_and(|record| record.x_m > TAKEN_OUT_M) {
            return note(WorldRule::Kept, format!("vehicle {vehicle} was taken out of {zone} at {x_m:.2} m"));
        }
        let u_mps2 = self.commanded.get(&vehicle).copied().unwrap_or(f64::INFINITY);
        let comes_m = (v_mps + 0.5 * u_mps2.max(0.0) * dt_s) * dt_s + self.tolerances.way_m;
        if self.length_m(before).is_none_or(|length_m| x_m + comes_m < length_m) {
            return note(
                WorldRule::Kept,
                format!("vehicle {vehicle} is no more; it was in {zone} at {x_m:.2} m"),
            );
        }
        self.left += 1;
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::load_embedded;

    fn state(vehicle: u32, x_m: f64, v_mps: f64) -> VehicleState {
        VehicleState {
            vehicle,
            x_m,
            v_mps,
            length_m: 4.5,
            flags: frames::STATE_ENTERED,
            ..VehicleState::default()
        }
    }

    fn command(vehicle: u32, u_mps2: f64) -> VehicleCommand {
        VehicleCommand { vehicle, u_mps2, ..VehicleCommand::default() }
    }

    /// What is said of a second frame after a first and a command, each a vehicle at 100 m and 10 m/s.
    fn judged(u_mps2: f64, second: &[VehicleState]) -> Vec<WorldRule> {
        let scenario = Arc::new(load_embedded("two-merges", &[], None).unwrap());
        let tolerances = Tolerances { acceleration_mps2: 0.01, way_m: 0.005 };
        let mut judge = Judge::new(scenario, tolerances);
        judge.judge(&[state(0, 100.0, 10.0)], &mut |rule, what| panic!("{rule:?}: {what}"));
        judge.command(&[command(0, u_mps2)]);
        let mut found = Vec::new();
        judge.judge(second, &mut |rule, _| found.push(rule));
        found
    }

    #[test]
    fn each_fault_is_named_and_nothing_else() {
        assert_eq!(judged(1.0, &[state(0, 101.005, 10.1)]), []);
        assert_eq!(judged(1.0, &[state(0, 101.005, 10.1), state(1, 0.3, 15.0)]), []);
        for (u_mps2, second, rule) in [
            (1.0, vec![state(0, 101.0, 10.0)], WorldRule::Obedience),
            // v += u dt, then x += v dt: no held acceleration comes there.
            (4.0, vec![state(0, 101.04, 10.4)], WorldRule::Motion),
            (1.0, vec![], WorldRule::Kept),
            (1.0, vec![state(0, 101.005, 10.1), state(2, 0.3, 15.0)], WorldRule::Numbered),
            (1.0, vec![state(0, 101.005, 10.1), state(1, 99.0, 10.0)], WorldRule::Apart),
            (1.0, vec![state(0, 101.005, 10.1), state(0, 101.005, 10.1)], WorldRule::Unique),
            (1.0, vec![state(0, 101.005, f64::NAN)], WorldRule::Numbers),
        ] {
            let found = judged(u_mps2, &second);
            assert!(found.first() == Some(&rule), "{rule:?}: {found:?}");
        }
        let mut taken_out = state(0, 1e6 + 400.0, 10.0);
        taken_out.flags |= frames::STATE_LEFT;
        assert_eq!(judged(1.0, &[taken_out]), [WorldRule::Kept]);
    }
}
