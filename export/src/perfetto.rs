//! A trace for Perfetto: what vehicles, zones and controllers did, in simulated time.
//!
//! Zones have a track per vehicle with its visits and, within these, what it did in feasibility-enforcement mode or
//! with rows that could not be satisfied, and counters of vehicles and terminal speeds. The messages are the part of
//! Perfetto's public schema that this takes.

use crate::events::{Event, EventKind, Events};
use crate::fcd::is_present;
use crate::out::{Out, OutError};
use crate::trips::{Passage, Trips};
use crate::walk::{Ended, walk};
use control_zones::record::{Reader, Source};
use control_zones::scenario::Scenario;
use ipc_schemas::{ASSIGNMENT_FREE_TERMINAL, NO_ZONE};
use prost::Message;
use std::collections::HashMap;
use std::io::Write;
use std::path::Path;

/// `perfetto.protos.Trace`.
#[derive(Clone, PartialEq, Message)]
pub struct Trace {
    /// Packets.
    #[prost(message, repeated, tag = "1")]
    pub packet: Vec<TracePacket>,
}

/// `perfetto.protos.TracePacket`.
#[derive(Clone, PartialEq, Message)]
pub struct TracePacket {
    /// Instant, ns.
    #[prost(uint64, optional, tag = "8")]
    pub timestamp: Option<u64>,
    /// Sequence the packet belongs to.
    #[prost(uint32, optional, tag = "10")]
    pub trusted_packet_sequence_id: Option<u32>,
    /// Something on a track.
    #[prost(message, optional, tag = "11")]
    pub track_event: Option<TrackEvent>,
    /// What the sequence needs from before.
    #[prost(uint32, optional, tag = "13")]
    pub sequence_flags: Option<u32>,
    /// A track.
    #[prost(message, optional, tag = "60")]
    pub track_descriptor: Option<TrackDescriptor>,
}

/// `perfetto.protos.TrackEvent`.
#[derive(Clone, PartialEq, Message)]
pub struct TrackEvent {
    /// What it says beside.
    #[prost(message, repeated, tag = "4")]
    pub debug_annotations: Vec<DebugAnnotation>,
    /// 1 a slice begins, 2 it ends, 3 an instant, 4 a counter's value.
    #[prost(int32, optional, tag = "9")]
    pub r#type: Option<i32>,
    /// Track.
    #[prost(uint64, optional, tag = "11")]
    pub track_uuid: Option<u64>,
    /// Categories.
    #[prost(string, repeated, tag = "22")]
    pub categories: Vec<String>,
    /// Name.
    #[prost(string, optional, tag = "23")]
    pub name: Option<String>,
    /// Value of a counter.
    #[prost(double, optional, tag = "44")]
    pub double_counter_value: Option<f64>,
}

/// `perfetto.protos.DebugAnnotation`.
#[derive(Clone, PartialEq, Message)]
pub struct DebugAnnotation {
    /// A number.
    #[prost(uint64, optional, tag = "3")]
    pub uint_value: Option<u64>,
    /// A number.
    #[prost(double, optional, tag = "5")]
    pub double_value: Option<f64>,
    /// Text.
    #[prost(string, optional, tag = "6")]
    pub string_value: Option<String>,
    /// Name.
    #[prost(string, optional, tag = "10")]
    pub name: Option<String>,
}

/// `perfetto.protos.TrackDescriptor`.
#[derive(Clone, PartialEq, Message)]
pub struct TrackDescriptor {
    /// Its number.
    #[prost(uint64, optional, tag = "1")]
    pub uuid: Option<u64>,
    /// Its name.
    #[prost(string, optional, tag = "2")]
    pub name: Option<String>,
    /// The track it is below.
    #[prost(uint64, optional, tag = "5")]
    pub parent_uuid: Option<u64>,
    /// Set when it is a counter.
    #[prost(message, optional, tag = "8")]
    pub counter: Option<CounterDescriptor>,
}

/// `perfetto.protos.CounterDescriptor`.
#[derive(Clone, PartialEq, Message)]
pub struct CounterDescriptor {
    /// Its unit.
    #[prost(string, optional, tag = "6")]
    pub unit_name: Option<String>,
}

const BEGIN: i32 = 1;
const END: i32 = 2;
const INSTANT: i32 = 3;
const COUNTER: i32 = 4;
/// All packets are of one sequence.
const SEQUENCE: u32 = 1;
/// `SEQ_INCREMENTAL_STATE_CLEARED`: the first packet needs nothing from before.
const CLEARED: u32 = 1;

/// A trace being written.
struct Writer {
    out: Out,
    next_uuid: u64,
    is_first: bool,
}

impl Writer {
    fn push(&mut self, packet: TracePacket) -> Result<(), OutError> {
        let flags = std::mem::take(&mut self.is_first).then_some(CLEARED);
        let packet =
            TracePacket { trusted_packet_sequence_id: Some(SEQUENCE), sequence_flags: flags, ..packet };
        // A trace is the concatenation of traces of its packets.
        let bytes = Trace { packet: vec![packet] }.encode_to_vec();
        let fault = self.out.fault();
        self.out.write_all(&bytes).map_err(fault)
    }

    fn track(&mut self, name: String, parent: Option<u64>, unit: Option<&str>) -> Result<u64, OutError> {
        self.next_uuid += 1;
        let counter = unit.map(|unit| CounterDescriptor { unit_name: Some(unit.to_owned()) });
        let (uuid, name) = (Some(self.next_uuid), Some(name));
        let descriptor = TrackDescriptor { uuid, name, parent_uuid: parent, counter };
        self.push(TracePacket { track_descriptor: Some(descriptor), ..TracePacket::default() })?;
        Ok(self.next_uuid)
    }

    fn event(&mut self, time_s: f64, event: TrackEvent) -> Result<(), OutError> {
        let timestamp = Some((time_s * 1e9).round().max(0.0) as u64);
        self.push(TracePacket { timestamp, track_event: Some(event), ..TracePacket::default() })
    }

    fn count(&mut self, time_s: f64, track: u64, value: f64) -> Result<(), OutError> {
        let (r#type, track_uuid) = (Some(COUNTER), Some(track));
        let double_counter_value = Some(value);
        self.event(time_s, TrackEvent { r#type, track_uuid, double_counter_value, ..TrackEvent::default() })
    }
}

fn note(name: &str, text: impl Into<String>) -> DebugAnnotation {
    DebugAnnotation {
        name: Some(name.to_owned()),
        string_value: Some(text.into()),
        ..DebugAnnotation::default()
    }
}

fn note_number(name: &str, value: f64) -> DebugAnnotation {
    DebugAnnotation { name: Some(name.to_owned()), double_value: Some(value), ..DebugAnnotation::default() }
}

/// What is known of a zone in the pass over the steps.
#[derive(Default)]
struct Zone {
    track: u64,
    vehicles: u64,
    speed: u64,
    count: Option<usize>,
    terminal_mps: Option<f64>,
}

/// Writes the trace of a recording.
pub fn write<S: Source>(path: &Path, reader: &Reader<S>) -> Result<Ended, OutError> {
    let scenario = reader.scenario();
    let mut writer = Writer { out: Out::create(path)?, next_uuid: 0, is_first: true };
    let mut zones = Vec::new();
    for zone in &scenario.network.zones {
        let track = writer.track(format!("zone {}", zone.name), None, None)?;
        let vehicles = writer.track("vehicles".to_owned(), Some(track), Some("vehicles"))?;
        let speed = writer.track("terminal speed".to_owned(), Some(track), Some("m/s"))?;
        zones.push(Zone { track, vehicles, speed, ..Zone::default() });
    }
    let (mut trips, mut events) = (Trips::of(scenario).with_passages(), Events::of(scenario));
    let ended = walk(reader, |moment| {
        trips.step(moment);
        events.step(moment);
        let time_s = moment.step.header.time_ns as f64 * 1e-9;
        let mut counts = vec![0; zones.len()];
        for state in moment.step.state.iter().filter(|s| is_present(s) && s.zone != NO_ZONE) {
            if let Some(count) = counts.get_mut(state.zone as usize) {
                *count += 1;
            }
        }
        for (zone, count) in zones.iter_mut().zip(counts) {
            if zone.count.replace(count) != Some(count) {
                writer.count(time_s, zone.vehicles, count as f64)?;
            }
        }
        for assignment in &moment.step.coordination {
            let Some(zone) = zones.get_mut(assignment.zone as usize) else { continue };
            let is_free = assignment.flags & ASSIGNMENT_FREE_TERMINAL != 0;
            let speed = assignment.terminal_speed_mps;
            if !is_free && zone.terminal_mps.replace(speed) != Some(speed) {
                writer.count(time_s, zone.speed, speed)?;
            }
        }
        Ok(())
    })?;
    slices(&mut writer, scenario, &zones, &trips, &events.finish(reader.events()))?;
    writer.out.finish()?;
    Ok(ended)
}

/// A visit on its track, and what happened within it.
struct Course {
    track: u64,
    from_s: f64,
    to_s: f64,
    event: TrackEvent,
    /// From, to.
    inner: Vec<(f64, f64, TrackEvent)>,
    /// What may overlap the others without being within them, as slices cannot.
    instants: Vec<(f64, TrackEvent)>,
}

fn slices(
    writer: &mut Writer,
    scenario: &Scenario,
    zones: &[Zone],
    trips: &Trips<'_>,
    events: &[Event],
) -> Result<(), OutError> {
    let mut courses = Vec::new();
    // A vehicle may come to a zone again.
    let mut by_vehicle: HashMap<(u32, u32), Vec<usize>> = HashMap::new();
    for passage in trips.passages() {
        by_vehicle.entry((passage.visit.zone, passage.visit.vehicle)).or_default().push(courses.len());
        courses.push(course(writer, scenario, zones, passage)?);
    }
    let controllers = writer.track("processes".to_owned(), None, None)?;
    for event in events {
        let instant = TrackEvent {
            r#type: Some(INSTANT),
            track_uuid: Some(controllers),
            name: Some(event.words(scenario)),
            categories: vec!["event".to_owned()],
            ..TrackEvent::default()
        };
        if event.vehicle.is_none() {
            writer.event(event.time_s, instant)?;
            continue;
        }
        let own = event.zone.zip(event.vehicle).and_then(|key| by_vehicle.get(&key));
        let during = own.into_iter().flatten().find(|at| {
            let course: &Course = &courses[**at];
            (course.from_s..=course.to_s).contains(&event.time_s)
        });
        let Some(course) = during.map(|at| &mut courses[*at]) else { continue };
        match event.kind {
            EventKind::Overruled => {
                course
                    .instants
                    .push((event.time_s, TrackEvent { track_uuid: Some(course.track), ..instant }));
            }
            // A vehicle has one verdict a step, so these do not overlap each other.
            EventKind::FeasibilityEnforcement | EventKind::Infeasible => {
                let steps = (event.last_step - event.first_step + 1) as f64;
                let to_s = (event.time_s + steps * scenario.dt_s()).min(course.to_s);
                let inner = TrackEvent {
                    name: Some(event.kind.name().to_owned()),
                    categories: vec!["event".to_owned()],
                    debug_annotations: vec![note("reason", &event.reason)],
                    ..TrackEvent::default()
                };
                if to_s > event.time_s {
                    course.inner.push((event.time_s, to_s, inner));
                }
            }
            _ => {}
        }
    }
    courses.into_iter().try_for_each(|course| course.write(writer))
}

fn course(
    writer: &mut Writer,
    scenario: &Scenario,
    zones: &[Zone],
    passage: &Passage,
) -> Result<Course, OutError> {
    let visit = &passage.visit;
    let path = &scenario.network.zones[visit.zone as usize].paths[passage.path as usize];
    let parent = zones[visit.zone as usize].track;
    let track = writer.track(format!("vehicle {:04}", visit.vehicle), Some(parent), None)?;
    let vehicle = DebugAnnotation {
        name: Some("vehicle".to_owned()),
        uint_value: Some(visit.vehicle.into()),
        ..DebugAnnotation::default()
    };
    let event = TrackEvent {
        name: Some(format!("vehicle {} on {}", visit.vehicle, path.name)),
        categories: vec!["visit".to_owned()],
        debug_annotations: vec![
            vehicle,
            note_number("energy", visit.energy),
            note_number("exit speed, m/s", visit.exit_speed_mps),
        ],
        ..TrackEvent::default()
    };
    let (from_s, to_s) = (visit.entry_time_s, visit.exit_time_s);
    Ok(Course { track, from_s, to_s, event, inner: Vec::new(), instants: Vec::new() })
}

impl Course {
    /// Writes what is on the track in order of time; of one instant ends come first.
    fn write(self, writer: &mut Writer) -> Result<(), OutError> {
        let on = |r#type, event: TrackEvent| TrackEvent {
            r#type: Some(r#type),
            track_uuid: Some(self.track),
            ..event
        };
        let end = || on(END, TrackEvent::default());
        let mut edges: Vec<(f64, u8, TrackEvent)> = Vec::new();
        for (from_s, to_s, event) in self.inner {
            edges.push((to_s, 0, end()));
            edges.push((from_s, 1, on(BEGIN, event)));
        }
        edges.extend(self.instants.into_iter().map(|(time_s, event)| (time_s, 2, event)));
        edges.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        writer.event(self.from_s, on(BEGIN, self.event))?;
        edges.into_iter().try_for_each(|(time_s, _, event)| writer.event(time_s, event))?;
        writer.event(self.to_s, on(END, TrackEvent::default()))
    }
}
