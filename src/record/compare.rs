//! Do two recordings tell the same?
//!
//! What is compared is what happened: states, assignments, commands, misses, and the times of steps. What may
//! differ between equal runs is not: run ids, generations, and, where the numbers of processes differ, what
//! depends on these: masks of processes and the summaries between them.

use super::reader::{Damage, Flaw, Reader, Source};
use crate::step::Step;
use ipc_schemas::{Assignment, Record, Scalar, VehicleCommand, VehicleState, ZoneSummary, bytes_of};
use serde::Serialize;

/// Which record a difference is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Section {
    /// The header of the state frame, or what the world says of the step.
    Step,
    /// A vehicle's state.
    State,
    /// What a zone told its neighbour.
    Summary,
    /// Whom a vehicle yields to.
    Coordination,
    /// A vehicle's command.
    Command,
}

impl std::fmt::Display for Section {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Section::Step => "step",
            Section::State => "state",
            Section::Summary => "summary",
            Section::Coordination => "coordination",
            Section::Command => "command",
        })
    }
}

/// One field that differs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// Step it is in.
    pub step: u64,
    /// Kind of record.
    pub section: Section,
    /// Vehicle concerned, if it is one.
    pub vehicle: Option<u32>,
    /// Zone concerned, if it is one.
    pub zone: Option<u32>,
    /// Field; absent when one side does not have the record at all.
    pub field: Option<&'static str>,
    /// Value in the first recording, or how many records it has.
    pub first: String,
    /// Value in the second.
    pub second: String,
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "step {}", self.step)?;
        if let Some(vehicle) = self.vehicle {
            write!(f, ", vehicle {vehicle}")?;
        }
        match self.zone {
            Some(ipc_schemas::NO_ZONE) => write!(f, " on a link")?,
            Some(zone) if self.vehicle.is_some() => write!(f, " in zone {zone}")?,
            Some(zone) => write!(f, ", zone {zone}")?,
            None => {}
        }
        write!(f, ", {}", self.section)?;
        if let Some(field) = self.field {
            write!(f, " {field}")?;
        }
        write!(f, ": {} / {}", self.first, self.second)
    }
}

/// A record that is about something with a name.
trait Named: Record {
    const SECTION: Section;
    /// What two records must share to be about the same thing.
    fn key(&self) -> (u32, u32);
    /// The vehicle, and the zone, it is about.
    fn names(&self) -> (Option<u32>, Option<u32>);
}

macro_rules! named_by_vehicle {
    ($type:ty, $section:expr) => {
        impl Named for $type {
            const SECTION: Section = $section;
            fn key(&self) -> (u32, u32) {
                (self.zone, self.vehicle)
            }
            fn names(&self) -> (Option<u32>, Option<u32>) {
                (Some(self.vehicle), Some(self.zone))
            }
        }
    };
}
named_by_vehicle!(VehicleState, Section::State);
named_by_vehicle!(Assignment, Section::Coordination);
named_by_vehicle!(VehicleCommand, Section::Command);

impl Named for ZoneSummary {
    const SECTION: Section = Section::Summary;
    fn key(&self) -> (u32, u32) {
        (self.from_zone, self.to_zone)
    }
    fn names(&self) -> (Option<u32>, Option<u32>) {
        (None, Some(self.from_zone))
    }
}

/// What two recordings may differ in and still tell of the same run.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rules {
    /// The numbers of processes are the same, so masks and summaries must be.
    pub same_processes: bool,
}

/// The first difference between two accounts of the same step.
pub(super) fn first_difference(a: &Step, b: &Step, rules: Rules) -> Option<Difference> {
    let step = a.header.step;
    let mut fields = vec![
        ("time_ns", a.header.time_ns, b.header.time_ns),
        ("flags", a.header.flags.into(), b.header.flags.into()),
        ("misses", a.misses, b.misses),
        ("policy", a.policy.into(), b.policy.into()),
    ];
    if rules.same_processes {
        let (x, y) = (&a.header, &b.header);
        fields.push(("coordinators_acting", x.coordinators_acting, y.coordinators_acting));
        fields.push(("coordinators_summarised", x.coordinators_summarised, y.coordinators_summarised));
    }
    // Last, so that a state that differs is shown as such.
    let hash = ("state_hash", a.state_hash, b.state_hash);
    let field = |(name, x, y): (&'static str, u64, u64)| {
        let show =
            |value: u64| if name == "state_hash" { format!("{value:016x}") } else { value.to_string() };
        let (first, second) = (show(x), show(y));
        let difference = Difference {
            step,
            section: Section::Step,
            vehicle: None,
            zone: None,
            field: Some(name),
            first,
            second,
        };
        (x != y).then_some(difference)
    };
    let summaries = || {
        let sorted = |summaries: &[ZoneSummary]| {
            let mut sorted = summaries.to_vec();
            sorted.sort_by_key(Named::key);
            sorted
        };
        let different = || in_records(step, &sorted(&a.summaries), &sorted(&b.summaries));
        rules.same_processes.then(different).flatten()
    };
    // A vehicle has one command, whoever sent it.
    let commands = |step: &Step| {
        let mut all: Vec<_> = step.commands.iter().flat_map(|part| part.records.iter().copied()).collect();
        all.sort_by_key(Named::key);
        all
    };
    fields
        .into_iter()
        .find_map(field)
        .or_else(|| in_records(step, &a.state, &b.state))
        .or_else(summaries)
        .or_else(|| in_records(step, &a.coordination, &b.coordination))
        .or_else(|| in_records(step, &commands(a), &commands(b)))
        .or_else(|| field(hash))
}

/// The first difference between two lists of records.
fn in_records<R: Named>(step: u64, a: &[R], b: &[R]) -> Option<Difference> {
    if bytes_of(a) == bytes_of(b) {
        return None;
    }
    let same = |(x, y): &(&R, &R)| bytes_of(std::slice::from_ref(*x)) == bytes_of(std::slice::from_ref(*y));
    let at = a.iter().zip(b).take_while(same).count();
    let (x, y) = (a.get(at), b.get(at));
    let record = |record: &R, field, first, second| {
        let (vehicle, zone) = record.names();
        Difference { step, section: R::SECTION, vehicle, zone, field, first, second }
    };
    let count = |record: &R, list: &[R]| match list.iter().filter(|r| r.key() == record.key()).count() {
        0 => "no record".to_owned(),
        1 => "1 record".to_owned(),
        n => format!("{n} records"),
    };
    match (x, y) {
        (None, None) => None,
        (Some(x), Some(y)) if x.key() == y.key() => {
            let (name, first, second) = differing_field(x, y)?;
            Some(record(x, Some(name), first, second))
        }
        // One of the two has a record too many, or they are in another order.
        (Some(x), Some(y)) => {
            let own = |record: &R, list: &[R]| list.iter().any(|r| r.key() == record.key());
            let odd = if own(x, b) && !own(y, a) { y } else { x };
            if own(odd, a) && own(odd, b) {
                let name = |r: &R| format!("{:?}", r.names().0.or(r.names().1).unwrap_or_default());
                return Some(record(odd, Some("order"), name(x), name(y)));
            }
            Some(record(odd, None, count(odd, a), count(odd, b)))
        }
        (Some(odd), None) | (None, Some(odd)) => Some(record(odd, None, count(odd, a), count(odd, b))),
    }
}

/// Name and both values of the first field in which two records differ.
fn differing_field<R: Record>(a: &R, b: &R) -> Option<(&'static str, String, String)> {
    let (a, b) = (bytes_of(std::slice::from_ref(a)), bytes_of(std::slice::from_ref(b)));
    R::LAYOUT.fields.iter().find_map(|field| {
        let range = field.offset..field.offset + field.scalar.size();
        let (x, y) = (&a[range.clone()], &b[range]);
        (x != y).then(|| (field.name, scalar(field.scalar, x), scalar(field.scalar, y)))
    })
}

/// A field's value in words: floating point with all digits that tell it from its neighbours.
fn scalar(scalar: Scalar, bytes: &[u8]) -> String {
    let bits = bytes.iter().rev().fold(0_u64, |bits, byte| bits << 8 | u64::from(*byte));
    match scalar {
        Scalar::F64 => {
            let value = f64::from_bits(bits);
            if value.is_nan() { format!("NaN ({bits:016x})") } else { format!("{value:?}") }
        }
        _ => bits.to_string(),
    }
}

/// What two recordings have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Comparison {
    /// Whether they are of the same scenario, seed and all.
    pub same_scenario: bool,
    /// Steps that both have and that were compared, up to the first difference.
    pub steps: u64,
    /// The first difference.
    pub difference: Option<Difference>,
    /// Steps only the first has, up to there.
    pub only_first: u64,
    /// Steps only the second has.
    pub only_second: u64,
    /// Where the comparison ended early: 0 or 1 for the recording, and what is wrong with it.
    pub damage: Option<(usize, Damage)>,
}

impl Comparison {
    /// Whether both hold the same steps of the same scenario, and nothing is wrong with either.
    pub fn same(&self) -> bool {
        self.same_scenario
            && self.difference.is_none()
            && self.damage.is_none()
            && (self.only_first, self.only_second) == (0, 0)
    }
}

/// Compares two recordings step by step up to the first difference, or to where one of them is damaged.
pub fn compare<A: Source, B: Source>(a: &Reader<A>, b: &Reader<B>) -> Comparison {
    let (x, y) = (a.metadata(), b.metadata());
    let rules = Rules { same_processes: (x.coordinators, x.controllers) == (y.coordinators, y.controllers) };
    let mut result = Comparison {
        same_scenario: x.scenario_hash == y.scenario_hash,
        steps: 0,
        difference: None,
        only_first: 0,
        only_second: 0,
        damage: None,
    };
    let (mut left, mut right) = (a.steps().peekable(), b.steps().peekable());
    loop {
        // Where a file is cut off it ends.
        let cut_off = |step: &Result<Step, Damage>| matches!(step, Err(d) if d.flaw == Flaw::CutOff);
        while left.next_if(cut_off).is_some() {}
        while right.next_if(cut_off).is_some() {}
        // Damage first: what follows it cannot be set against anything.
        if let Some(Err(damage)) = left.peek() {
            result.damage = Some((0, damage.clone()));
            return result;
        }
        if let Some(Err(damage)) = right.peek() {
            result.damage = Some((1, damage.clone()));
            return result;
        }
        let number = |step: Option<&Result<Step, Damage>>| {
            step.and_then(|step| step.as_ref().ok()).map(|step| step.header.step)
        };
        match (number(left.peek()), number(right.peek())) {
            (None, None) => return result,
            (Some(i), Some(j)) if i == j => {
                if let (Some(Ok(i)), Some(Ok(j))) = (left.next(), right.next()) {
                    result.difference = first_difference(&i, &j, rules);
                }
                if result.difference.is_some() {
                    return result;
                }
                result.steps += 1;
            }
            (Some(i), j) if j.is_none_or(|j| i < j) => {
                left.next();
                result.only_first += 1;
            }
            _ => {
                right.next();
                result.only_second += 1;
            }
        }
    }
}
