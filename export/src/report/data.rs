//! What a page shows of one recording, gathered in one pass.

use crate::events::{Event, EventKind, Events};
use crate::fcd::is_present;
use crate::trips::Trips;
use crate::walk::{Ended, Moment, walk};
use control_zones::conflict::DutyKind;
use control_zones::record::{FileSource, Owed, Reader};
use control_zones::scenario::Scenario;
use ipc_schemas::{NO_ZONE, VERDICT_FE, VERDICT_INFEASIBLE};
use std::collections::{BTreeMap, HashMap};
use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Samples of vehicles that are kept at most; of more every n-th step is.
const SAMPLES: usize = 2_000_000;
/// Worst moments that are kept of each kind.
const WORST: usize = 5;

/// One vehicle at one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    pub time_s: f64,
    pub x_m: f64,
    pub v_mps: f64,
    pub u_mps2: f64,
    pub kind: Driving,
}

/// What decided a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Driving {
    Tracking,
    FeasibilityEnforcement,
    Infeasible,
}

/// A pair at the step at which its margin was least.
#[derive(Clone, Debug)]
pub struct Worst {
    pub owed: Owed,
    pub margin_m: f64,
    pub step: u64,
    pub time_s: f64,
}

/// Margins of a zone over time: the least of all pairs at each step, m.
#[derive(Clone, Debug, Default)]
pub struct Margins {
    pub rear_end: Vec<(f64, f64)>,
    pub merge: Vec<(f64, f64)>,
    pub cross: Vec<(f64, f64)>,
}

/// A way through a zone: zone, path, vehicle, and how often it has been there before.
pub type Way = (u32, u32, u32, u32);

/// One recording.
pub struct Run {
    pub path: PathBuf,
    pub reader: Reader<FileSource>,
    pub scenario: Arc<Scenario>,
    pub ended: Ended,
    pub ways: BTreeMap<Way, Vec<Sample>>,
    pub margins: Vec<Margins>,
    pub worst: Vec<Worst>,
    pub events: Vec<Event>,
    /// Vehicles in the network, and vehicles that have left it, over time.
    pub inside: Vec<(f64, f64)>,
    pub departed: Vec<(f64, f64)>,
    /// Steps in which each controller was late.
    pub late: Vec<u64>,
    pub energy: f64,
    pub vehicles: usize,
    pub end_s: f64,
    /// The greatest speed of anybody, rounded up to 5 m/s.
    pub fastest_mps: f64,
}

impl Run {
    /// Reads a recording.
    pub fn read(path: &Path, reader: Reader<FileSource>) -> Run {
        let scenario = reader.scenario().clone();
        // A step's records are about as many bytes as the file has for it.
        let per_step = 400;
        let stride = (reader.length() / per_step / SAMPLES as u64).max(1);
        let mut gathering = Gathering::of(&scenario, stride);
        let ended = walk(&reader, |moment| {
            gathering.step(moment);
            Ok::<(), Infallible>(())
        });
        let Ok(ended) = ended;
        let Gathering { ways, margins, least, events, trips, inside, departed, late, end_s, .. } = gathering;
        let events = events.finish(reader.events());
        let speeds = ways.values().flatten().map(|sample: &Sample| sample.v_mps);
        let fastest_mps = (speeds.fold(1.0, f64::max) / 5.0).ceil() * 5.0;
        Run {
            fastest_mps,
            worst: worst_of(least),
            energy: trips.all().map(|trip| trip.energy).sum(),
            vehicles: trips.all().count(),
            path: path.to_owned(),
            reader,
            ended,
            ways,
            margins,
            events,
            inside,
            departed,
            late,
            end_s,
            scenario: scenario.clone(),
        }
    }

    /// Events of a kind.
    pub fn events_of(&self, kind: EventKind) -> impl Iterator<Item = &Event> {
        self.events.iter().filter(move |event| event.kind == kind)
    }

    /// The file's name.
    pub fn name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }
}

struct Gathering<'a> {
    scenario: &'a Scenario,
    stride: u64,
    ways: BTreeMap<Way, Vec<Sample>>,
    margins: Vec<Margins>,
    /// The least margin of each pair: ego, foe, zone, and whether the foe leads.
    least: HashMap<(u32, u32, u32, bool), Worst>,
    events: Events<'a>,
    trips: Trips<'a>,
    inside: Vec<(f64, f64)>,
    departed: Vec<(f64, f64)>,
    late: Vec<u64>,
    left: usize,
    end_s: f64,
}

impl<'a> Gathering<'a> {
    fn of(scenario: &'a Scenario, stride: u64) -> Gathering<'a> {
        Gathering {
            scenario,
            stride,
            ways: BTreeMap::new(),
            margins: vec![Margins::default(); scenario.network.zones.len()],
            least: HashMap::new(),
            events: Events::of(scenario),
            trips: Trips::of(scenario),
            inside: Vec::new(),
            departed: Vec::new(),
            late: Vec::new(),
            left: 0,
            end_s: 0.0,
        }
    }

    fn step(&mut self, moment: &Moment<'_>) {
        self.events.step(moment);
        self.trips.step(moment);
        let step = moment.step;
        let time_s = step.header.time_ns as f64 * 1e-9;
        self.end_s = time_s;
        let inside = step.state.iter().filter(|state| is_present(state)).count();
        self.inside.push((time_s, inside as f64));
        self.departed.push((time_s, self.left as f64));
        let zones = &self.scenario.network.zones;
        let leaves = |visit: &&control_zones::world::CompletedVisit| {
            let state = step
                .state
                .iter()
                .find(|s| s.is_commanded() && s.vehicle == visit.vehicle && s.zone == visit.zone);
            state.is_some_and(|state| zones[visit.zone as usize].exit_of(state.path).to.is_none())
        };
        self.left += moment.visits.iter().filter(leaves).count();
        self.late.resize(self.late.len().max(step.commands.len()), 0);
        for (controller, late) in self.late.iter_mut().enumerate() {
            *late += u64::from(step.missed(controller));
        }
        self.margins_of(moment, time_s);
        if step.header.step.is_multiple_of(self.stride) {
            self.samples(moment, time_s);
        }
    }

    fn samples(&mut self, moment: &Moment<'_>, time_s: f64) {
        let step = moment.step;
        let commands: HashMap<u32, (f64, u16)> = step
            .commands
            .iter()
            .flat_map(|part| &part.records)
            .map(|command| (command.vehicle, (command.u_mps2, command.verdict)))
            .collect();
        for state in step.state.iter().filter(|state| is_present(state) && state.zone != NO_ZONE) {
            let (u_mps2, verdict) = commands.get(&state.vehicle).copied().unwrap_or((state.u_mps2, 0));
            let kind = match verdict {
                VERDICT_FE => Driving::FeasibilityEnforcement,
                VERDICT_INFEASIBLE => Driving::Infeasible,
                _ => Driving::Tracking,
            };
            let sample = Sample { time_s, x_m: state.x_m, v_mps: state.v_mps, u_mps2, kind };
            let mut way = (state.zone, state.path, state.vehicle, 0);
            // Whoever is further back than it was has come round.
            while self
                .ways
                .get(&way)
                .and_then(|known| known.last())
                .is_some_and(|last| last.x_m > sample.x_m + 1.0)
            {
                way.3 += 1;
            }
            self.ways.entry(way).or_default().push(sample);
        }
    }

    fn margins_of(&mut self, moment: &Moment<'_>, time_s: f64) {
        let mut least = vec![[f64::INFINITY; 3]; self.margins.len()];
        let pairs = &mut self.least;
        moment.in_force.owed(self.scenario, moment.step, |owed| {
            if !owed.counts {
                return;
            }
            let margin_m = owed.margin_m();
            let kind = match owed.kind {
                DutyKind::RearEnd => 0,
                DutyKind::Merge => 1,
                DutyKind::Cross => 2,
            };
            if let Some(least) = least.get_mut(owed.zone as usize) {
                least[kind] = least[kind].min(margin_m);
            }
            let key = (owed.vehicle, owed.partner, owed.zone, owed.kind == DutyKind::RearEnd);
            let step = moment.step.header.step;
            let worst = pairs.entry(key).or_insert(Worst { owed, margin_m, step, time_s });
            if margin_m < worst.margin_m {
                *worst = Worst { owed, margin_m, step, time_s };
            }
        });
        for (margins, least) in self.margins.iter_mut().zip(least) {
            let lists = [&mut margins.rear_end, &mut margins.merge, &mut margins.cross];
            for (list, least) in lists.into_iter().zip(least) {
                if least.is_finite() {
                    list.push((time_s, least));
                }
            }
        }
    }
}

/// The worst pairs toward leaders, and the worst toward others.
fn worst_of(least: HashMap<(u32, u32, u32, bool), Worst>) -> Vec<Worst> {
    let mut all: Vec<Worst> = least.into_values().collect();
    all.sort_by(|a, b| a.margin_m.total_cmp(&b.margin_m).then(a.owed.vehicle.cmp(&b.owed.vehicle)));
    let (ahead, others): (Vec<Worst>, Vec<Worst>) =
        all.into_iter().partition(|worst| worst.owed.kind == DutyKind::RearEnd);
    ahead.into_iter().take(WORST).chain(others.into_iter().take(WORST)).collect()
}
