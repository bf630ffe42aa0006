//! SUMO's surrogate safety measures: conflicts between pairs of vehicles, with time to collision, deceleration to avoid
//! one, and post-encroachment time, from the duties in force.
//!
//! Toward a leader the gap is from front to the leader's rear. Toward somebody who passes a merge first it is the
//! difference of the distances to the merge, as if the two were on one lane. At a crossing there is only the time from
//! the one's clearing it to the other's reaching it.

use crate::fcd::Places;
use crate::out::OutError;
use crate::walk::Moment;
use crate::xml::{Document, number, seconds};
use control_zones::conflict::{Conflicts, DutyKind};
use control_zones::record::Owed;
use control_zones::scenario::Scenario;
use ipc_schemas::VehicleState;
use std::collections::BTreeMap;
use std::path::Path;

/// A pair is in conflict while its time to collision is below this, s; SUMO's default, as the next two.
const TTC_S: f64 = 3.0;
/// Or the deceleration to avoid a collision is above this, m/s^2.
const DRAC_MPS2: f64 = 3.0;
/// Or the post-encroachment time is below this, s.
const PET_S: f64 = 2.0;

/// SUMO's codes of encounters.
fn code(kind: DutyKind) -> &'static str {
    match kind {
        DutyKind::RearEnd => "2",
        DutyKind::Merge => "7",
        DutyKind::Cross => "11",
    }
}

/// What is said of the worst sample: place, time, code of the encounter, value, speed.
type Extreme = ((f64, f64), String, &'static str, String, String);

/// One sample of a conflict.
#[derive(Clone, Debug)]
struct Sample {
    time_ns: u64,
    kind: DutyKind,
    ttc_s: Option<f64>,
    drac_mps2: Option<f64>,
    place: (f64, f64),
    speed_mps: f64,
}

/// A pair while it owes.
#[derive(Debug, Default)]
struct Encounter {
    samples: Vec<Sample>,
    /// Last step in which something was owed.
    last_step: u64,
    pet: Option<Pet>,
}

#[derive(Clone, Debug)]
struct Pet {
    time_s: f64,
    value_s: f64,
    kind: DutyKind,
    place: (f64, f64),
    speed_mps: f64,
}

/// Who is to reach a conflict point after whom: instants, once they are known.
#[derive(Clone, Copy, Debug)]
struct Passing {
    kind: DutyKind,
    own_m: f64,
    /// Position of the partner on its own path at which it has cleared the point, m.
    clear_m: f64,
    cleared_s: Option<f64>,
    before: (f64, f64),
    before_s: f64,
}

/// A file of safety measures being written.
pub struct Ssm<'a> {
    document: Document,
    places: Places<'a>,
    conflicts: Vec<Conflicts>,
    open: BTreeMap<(u32, u32), Encounter>,
    /// By zone, ego, foe and point.
    passings: BTreeMap<(u32, u32, u32, u32), Passing>,
}

impl<'a> Ssm<'a> {
    /// Begins a file.
    pub fn begin(path: &Path, scenario: &'a Scenario) -> Result<Ssm<'a>, OutError> {
        Ok(Ssm {
            document: Document::begin(path, "SSMLog", "ssm_file.xsd")?,
            places: Places::of(scenario),
            conflicts: Conflicts::of_all(&scenario.network),
            open: BTreeMap::new(),
            passings: BTreeMap::new(),
        })
    }

    /// Takes a step; steps come in order.
    pub fn step(&mut self, moment: &Moment<'_>) -> Result<(), OutError> {
        let step = moment.step;
        let mut all = Vec::new();
        moment.in_force.owed(self.places.scenario, step, |owed| all.push(owed));
        for owed in &all {
            let in_zone =
                |vehicle: u32| step.state.iter().find(|s| s.vehicle == vehicle && s.zone == owed.zone);
            let (Some(ego), Some(foe)) = (in_zone(owed.vehicle), in_zone(owed.partner)) else { continue };
            self.sample(owed, ego, foe, step.header.step, step.header.time_ns);
            self.expect(owed, ego, foe, step.header.time_ns as f64 * 1e-9);
        }
        self.pass(moment);
        let over: Vec<(u32, u32)> = self
            .open
            .iter()
            .filter(|(_, encounter)| encounter.last_step + 1 < step.header.step)
            .map(|(pair, _)| *pair)
            .collect();
        over.into_iter().try_for_each(|pair| self.close(pair))
    }

    fn place(&self, state: &VehicleState) -> (f64, f64) {
        let on = self.places.layout.lane_of(state);
        on.map_or((0.0, 0.0), |on| self.places.layout.pose(on).place)
    }

    fn sample(&mut self, owed: &Owed, ego: &VehicleState, foe: &VehicleState, step: u64, time_ns: u64) {
        let place = self.place(ego);
        let closing_mps = ego.v_mps - foe.v_mps;
        let gap_m = owed.pair.partner_x_m - foe.length_m - owed.pair.x_m;
        let approaches = owed.kind != DutyKind::Cross && closing_mps > 0.0 && gap_m > 0.0;
        let encounter = self.open.entry((owed.vehicle, owed.partner)).or_default();
        // A pair may owe at several points; the nearest counts.
        if encounter.last_step == step && !encounter.samples.is_empty() {
            return;
        }
        encounter.last_step = step;
        encounter.samples.push(Sample {
            time_ns,
            kind: owed.kind,
            ttc_s: approaches.then(|| gap_m / closing_mps),
            drac_mps2: approaches.then(|| 0.5 * closing_mps * closing_mps / gap_m),
            place,
            speed_mps: ego.v_mps,
        });
    }

    /// Remembers that the one is to pass a point after the other.
    fn expect(&mut self, owed: &Owed, ego: &VehicleState, foe: &VehicleState, time_s: f64) {
        if owed.kind == DutyKind::RearEnd {
            return;
        }
        let mut uses = self.conflicts[owed.zone as usize].uses(foe.path).iter();
        let area_m = uses.find(|u| u.point == owed.point).map_or(0.0, |u| u.area_m);
        let partner_m = foe.x_m - (owed.pair.partner_x_m - owed.own_m);
        let key = (owed.zone, owed.vehicle, owed.partner, owed.point);
        self.passings.entry(key).or_insert(Passing {
            kind: owed.kind,
            own_m: owed.own_m,
            clear_m: partner_m + area_m + foe.length_m,
            cleared_s: None,
            before: (ego.x_m, foe.x_m),
            before_s: time_s,
        });
    }

    /// Notes who has passed.
    fn pass(&mut self, moment: &Moment<'_>) {
        let time_s = moment.step.header.time_ns as f64 * 1e-9;
        let mut done = Vec::new();
        for (&key, passing) in &mut self.passings {
            let (zone, ego, foe, _) = key;
            let in_zone =
                |vehicle: u32| moment.step.state.iter().find(|s| s.vehicle == vehicle && s.zone == zone);
            let (Some(ego_state), Some(foe_state)) = (in_zone(ego), in_zone(foe)) else {
                done.push((key, None));
                continue;
            };
            let instant = |from_m: f64, to_m: f64, at_m: f64| {
                let share = if to_m > from_m { (at_m - from_m) / (to_m - from_m) } else { 1.0 };
                passing.before_s + share.clamp(0.0, 1.0) * (time_s - passing.before_s)
            };
            if passing.cleared_s.is_none() && foe_state.x_m >= passing.clear_m {
                passing.cleared_s = Some(instant(passing.before.1, foe_state.x_m, passing.clear_m));
            }
            if ego_state.x_m >= passing.own_m {
                let reached_s = instant(passing.before.0, ego_state.x_m, passing.own_m);
                let on = self.places.layout.lane_of(ego_state);
                let place = on.map_or((0.0, 0.0), |on| self.places.layout.pose(on).place);
                // One that has not cleared it yet is a leader by now, and its time to collision counts.
                let pet = passing.cleared_s.map(|cleared_s| Pet {
                    time_s: reached_s,
                    value_s: reached_s - cleared_s,
                    kind: passing.kind,
                    place,
                    speed_mps: ego_state.v_mps,
                });
                done.push((key, pet));
            }
            (passing.before, passing.before_s) = ((ego_state.x_m, foe_state.x_m), time_s);
        }
        for (key, pet) in done {
            self.passings.remove(&key);
            let (_, ego, foe, _) = key;
            if let (Some(pet), Some(encounter)) = (pet, self.open.get_mut(&(ego, foe)))
                && encounter.pet.as_ref().is_none_or(|known| pet.value_s < known.value_s)
            {
                encounter.pet = Some(pet);
            }
        }
    }

    /// Writes a pair's encounter if it was a conflict.
    fn close(&mut self, (ego, foe): (u32, u32)) -> Result<(), OutError> {
        let Some(encounter) = self.open.remove(&(ego, foe)) else { return Ok(()) };
        let is_critical = |sample: &Sample| {
            sample.ttc_s.is_some_and(|ttc| ttc < TTC_S)
                || sample.drac_mps2.is_some_and(|drac| drac > DRAC_MPS2)
        };
        let pet = encounter.pet.filter(|pet| pet.value_s < PET_S);
        if pet.is_none() && !encounter.samples.iter().any(is_critical) {
            return Ok(());
        }
        let samples = &encounter.samples;
        let (first, last) = (&samples[0], &samples[samples.len() - 1]);
        self.document.start(
            "conflict",
            &[
                ("begin", &seconds(first.time_ns)),
                ("end", &seconds(last.time_ns)),
                ("ego", &ego.to_string()),
                ("foe", &foe.to_string()),
            ],
        )?;
        let join = |of: &dyn Fn(&Sample) -> String| samples.iter().map(of).collect::<Vec<_>>().join(" ");
        let maybe = |value: Option<f64>| value.map_or_else(|| "NA".to_owned(), number);
        self.document.empty("timeSpan", &[("values", &join(&|s| seconds(s.time_ns)))])?;
        self.document.empty("typeSpan", &[("values", &join(&|s| code(s.kind).to_owned()))])?;
        self.document.empty("TTCSpan", &[("values", &join(&|s| maybe(s.ttc_s)))])?;
        self.document.empty("DRACSpan", &[("values", &join(&|s| maybe(s.drac_mps2)))])?;
        let least = samples.iter().filter(|s| s.ttc_s.is_some()).min_by(|a, b| order(a.ttc_s, b.ttc_s));
        self.extreme("minTTC", least.map(|s| (s, s.ttc_s)))?;
        let most =
            samples.iter().filter(|s| s.drac_mps2.is_some()).max_by(|a, b| order(a.drac_mps2, b.drac_mps2));
        self.extreme("maxDRAC", most.map(|s| (s, s.drac_mps2)))?;
        let pet = pet.map(|pet| {
            (pet.place, number(pet.time_s), code(pet.kind), number(pet.value_s), number(pet.speed_mps))
        });
        self.values("PET", pet)?;
        self.document.end("conflict")
    }

    fn extreme(&mut self, name: &str, sample: Option<(&Sample, Option<f64>)>) -> Result<(), OutError> {
        let values = sample.and_then(|(s, value)| {
            Some((s.place, seconds(s.time_ns), code(s.kind), number(value?), number(s.speed_mps)))
        });
        self.values(name, values)
    }

    fn values(&mut self, name: &str, values: Option<Extreme>) -> Result<(), OutError> {
        let na = || "NA".to_owned();
        let (position, time, kind, value, speed) = match values {
            Some(((x, y), time, kind, value, speed)) => {
                (format!("{},{}", number(x), number(y)), time, kind.to_owned(), value, speed)
            }
            None => (na(), na(), na(), na(), na()),
        };
        self.document.empty(
            name,
            &[
                ("position", &position),
                ("time", &time),
                ("type", &kind),
                ("value", &value),
                ("speed", &speed),
            ],
        )
    }

    /// Ends the file.
    pub fn finish(mut self) -> Result<(), OutError> {
        let open: Vec<(u32, u32)> = self.open.keys().copied().collect();
        open.into_iter().try_for_each(|pair| self.close(pair))?;
        self.document.finish()
    }
}

fn order(a: Option<f64>, b: Option<f64>) -> std::cmp::Ordering {
    a.unwrap_or_default().total_cmp(&b.unwrap_or_default())
}
