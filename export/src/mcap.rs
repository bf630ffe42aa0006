//! MCAP files that Foxglove and Lichtblick show as they are: a scene with lanes and vehicles of true length, a log of
//! events, and plain JSON of vehicles, zones and visits to plot.

use crate::events::{EventKind, Events};
use crate::fcd::{Places, is_present};
use crate::out::{Out, OutError};
use crate::tables::facts;
use crate::trips::Trips;
use crate::walk::{Ended, Moment, walk};
use ::mcap::records::{MessageHeader, Metadata};
use ::mcap::{Compression, WriteOptions};
use control_zones::record::words::{mode, verdict, zone_name};
use control_zones::record::{Reader, Source};
use ipc_schemas::{NO_ZONE, VehicleCommand, VehicleState};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

/// The schemas as their publisher generates them.
const SCENE_UPDATE: &str = include_str!("../schemas/foxglove.SceneUpdate.json");
const FRAME_TRANSFORM: &str = include_str!("../schemas/foxglove.FrameTransform.json");
const LOG: &str = include_str!("../schemas/foxglove.Log.json");

/// Width and height of a body, m; a scenario gives its length only.
const WIDTH_M: f64 = 1.8;
const HEIGHT_M: f64 = 1.5;
/// Frame of all places.
const FRAME: &str = "map";

/// Speeds from 0 to the greatest as colours: viridis, which everybody can tell apart.
const SPEEDS: [[f64; 3]; 6] = [
    [0.267, 0.005, 0.329],
    [0.254, 0.265, 0.530],
    [0.164, 0.471, 0.558],
    [0.135, 0.659, 0.518],
    [0.478, 0.821, 0.319],
    [0.993, 0.906, 0.144],
];

struct Channel {
    id: u16,
    sequence: u32,
}

struct Writer {
    writer: ::mcap::Writer<Out>,
    path: PathBuf,
    channels: HashMap<&'static str, Channel>,
}

impl Writer {
    fn begin(path: &Path) -> Result<Writer, OutError> {
        let options = WriteOptions::new().compression(Some(Compression::Lz4)).library("control-zones");
        let writer = options.create(Out::create(path)?);
        let writer = writer.map_err(|error| fault(path, error))?;
        Ok(Writer { writer, path: path.to_owned(), channels: HashMap::new() })
    }

    fn channel(&mut self, topic: &'static str, schema: &str, text: &str) -> Result<(), OutError> {
        let schema = self.writer.add_schema(schema, "jsonschema", text.as_bytes());
        let schema = schema.map_err(|error| fault(&self.path, error))?;
        let id = self.writer.add_channel(schema, topic, "json", &BTreeMap::new());
        let id = id.map_err(|error| fault(&self.path, error))?;
        self.channels.insert(topic, Channel { id, sequence: 0 });
        Ok(())
    }

    fn write(&mut self, topic: &'static str, time_ns: u64, message: &Value) -> Result<(), OutError> {
        let channel = self.channels.get_mut(topic).expect("every topic has a channel");
        let header = MessageHeader {
            channel_id: channel.id,
            sequence: channel.sequence,
            log_time: time_ns,
            publish_time: time_ns,
        };
        channel.sequence += 1;
        let bytes = serde_json::to_vec(message).expect("the value has string keys only");
        self.writer.write_to_known_channel(&header, &bytes).map_err(|error| fault(&self.path, error))
    }
}

fn fault(path: &Path, error: ::mcap::McapError) -> OutError {
    OutError::Format { path: path.to_owned(), what: error.to_string() }
}

/// Writes the file of a recording.
pub fn write<S: Source>(path: &Path, reader: &Reader<S>) -> Result<Ended, OutError> {
    let scenario = reader.scenario();
    let places = Places::of(scenario);
    let mut writer = Writer::begin(path)?;
    writer.channel("/tf", "foxglove.FrameTransform", FRAME_TRANSFORM)?;
    writer.channel("/network", "foxglove.SceneUpdate", SCENE_UPDATE)?;
    writer.channel("/scene", "foxglove.SceneUpdate", SCENE_UPDATE)?;
    writer.channel("/log", "foxglove.Log", LOG)?;
    writer.channel("/vehicles", "cz.Vehicles", &own_schema("vehicles"))?;
    writer.channel("/zones", "cz.Zones", &own_schema("zones"))?;
    writer.channel("/visits", "cz.Visit", &json!({ "title": "cz.Visit", "type": "object" }).to_string())?;
    writer.write("/tf", 0, &transform())?;
    writer.write("/network", 0, &lanes(&places))?;
    let (mut trips, mut events) = (Trips::of(scenario), Events::of(scenario));
    let mut drawn = BTreeSet::new();
    let ended = walk(reader, |moment| {
        trips.step(moment);
        events.step(moment);
        let time_ns = moment.step.header.time_ns;
        writer.write("/scene", time_ns, &scene(&places, moment, &mut drawn))?;
        writer.write("/vehicles", time_ns, &vehicles(&places, moment))?;
        writer.write("/zones", time_ns, &zones(&places, moment))?;
        for visit in moment.visits {
            let exit_ns = (visit.exit_time_s * 1e9).round() as u64;
            let message = json!({
                "vehicle": visit.vehicle,
                "zone": zone_name(scenario, visit.zone),
                "entry_time_s": visit.entry_time_s,
                "exit_time_s": visit.exit_time_s,
                "exit_speed_mps": visit.exit_speed_mps,
                "energy": visit.energy,
                "fe_s": visit.fe_s,
            });
            writer.write("/visits", exit_ns, &message)?;
        }
        Ok(())
    })?;
    for event in events.finish(reader.events()) {
        let level = match event.kind {
            EventKind::Arrived | EventKind::Departed | EventKind::Steered => 2,
            EventKind::FeasibilityEnforcement | EventKind::Overruled | EventKind::Replaced => 3,
            EventKind::Infeasible | EventKind::Late | EventKind::Refused | EventKind::Exited => 4,
        };
        let time_ns = (event.time_s * 1e9).round().max(0.0) as u64;
        let name = event.zone.map_or_else(|| "run".to_owned(), |zone| zone_name(scenario, zone));
        let message = json!({
            "timestamp": time(time_ns), "level": level, "message": event.words(scenario), "name": name,
            "file": "", "line": event.first_step,
        });
        writer.write("/log", time_ns, &message)?;
    }
    let metadata = facts(reader, &ended).into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    let metadata = Metadata { name: "run".to_owned(), metadata };
    writer.writer.write_metadata(&metadata).map_err(|error| fault(path, error))?;
    writer.writer.finish().map_err(|error| fault(path, error))?;
    writer.writer.into_inner().finish()?;
    Ok(ended)
}

fn own_schema(list: &str) -> String {
    let items = json!({ "type": "array", "items": { "type": "object" } });
    json!({ "title": format!("cz.{list}"), "type": "object", "properties": { "step": { "type": "integer" }, list: items } })
        .to_string()
}

fn time(time_ns: u64) -> Value {
    json!({ "sec": time_ns / 1_000_000_000, "nsec": time_ns % 1_000_000_000 })
}

fn transform() -> Value {
    json!({
        "timestamp": time(0), "parent_frame_id": "world", "child_frame_id": FRAME,
        "translation": { "x": 0.0, "y": 0.0, "z": 0.0 },
        "rotation": { "x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0 },
    })
}

/// An entity of a scene with nothing in it.
fn entity(id: &str, time_ns: u64) -> Value {
    json!({
        "timestamp": time(time_ns), "frame_id": FRAME, "id": id, "lifetime": { "sec": 0, "nsec": 0 },
        "frame_locked": false, "metadata": [], "arrows": [], "cubes": [], "spheres": [], "cylinders": [],
        "lines": [], "triangles": [], "texts": [], "models": [],
    })
}

fn pose((x, y): (f64, f64), z: f64, yaw_rad: f64) -> Value {
    let (sin, cos) = (0.5 * yaw_rad).sin_cos();
    json!({ "position": { "x": x, "y": y, "z": z }, "orientation": { "x": 0.0, "y": 0.0, "z": sin, "w": cos } })
}

fn lanes(places: &Places<'_>) -> Value {
    let mut network = entity("network", 0);
    let grey = json!({ "r": 0.5, "g": 0.5, "b": 0.5, "a": 1.0 });
    let lines = places.layout.lanes().into_iter().map(|(lane, _)| {
        let points: Vec<Value> =
            places.layout.shape(lane).iter().map(|(x, y)| json!({ "x": x, "y": y, "z": 0.0 })).collect();
        // A strip as wide as a lane, in metres.
        json!({
            "type": 0, "pose": pose((0.0, 0.0), 0.0, 0.0), "thickness": 0.3, "scale_invariant": false,
            "points": points, "color": grey, "colors": [], "indices": [],
        })
    });
    network["lines"] = lines.collect();
    json!({ "deletions": [], "entities": [network] })
}

fn colour(share: f64) -> Value {
    let at = share.clamp(0.0, 1.0) * (SPEEDS.len() - 1) as f64;
    let below = (at as usize).min(SPEEDS.len() - 2);
    let [r, g, b] =
        [0, 1, 2].map(|i| SPEEDS[below][i] + (at - below as f64) * (SPEEDS[below + 1][i] - SPEEDS[below][i]));
    json!({ "r": r, "g": g, "b": b, "a": 1.0 })
}

/// The vehicles of a step as boxes, and the removal of those that are gone.
fn scene(places: &Places<'_>, moment: &Moment<'_>, drawn: &mut BTreeSet<u32>) -> Value {
    let time_ns = moment.step.header.time_ns;
    let commands = commands_of(moment);
    let mut now = BTreeSet::new();
    let mut entities = Vec::new();
    for state in moment.step.state.iter().filter(|state| is_present(state)) {
        let Some(on) = places.layout.lane_of(state) else { continue };
        let front = places.layout.pose(on);
        let (sin, cos) = front.heading_rad.sin_cos();
        let middle = (front.place.0 - 0.5 * state.length_m * cos, front.place.1 - 0.5 * state.length_m * sin);
        let v_max_mps = places.scenario.vehicle.v_max_mps;
        let mut vehicle = entity(&state.vehicle.to_string(), time_ns);
        vehicle["cubes"] = json!([{
            "pose": pose(middle, 0.5 * HEIGHT_M, front.heading_rad),
            "size": { "x": state.length_m, "y": WIDTH_M, "z": HEIGHT_M },
            "color": colour(state.v_mps / v_max_mps),
        }]);
        let mut facts = vec![
            ("zone", zone_name_of(places, state)),
            ("lane", places.lane_name(on.lane)),
            ("v, m/s", format!("{:.2}", state.v_mps)),
            ("u before, m/s²", format!("{:.2}", state.u_mps2)),
        ];
        if let Some(command) = commands.get(&state.vehicle) {
            facts.extend([("mode", mode(command)), ("verdict", verdict(command))]);
        }
        vehicle["metadata"] =
            facts.into_iter().map(|(key, value)| json!({ "key": key, "value": value })).collect();
        entities.push(vehicle);
        now.insert(state.vehicle);
    }
    let gone = drawn
        .difference(&now)
        .map(|vehicle| json!({ "timestamp": time(time_ns), "type": 0, "id": vehicle.to_string() }));
    let deletions: Vec<Value> = gone.collect();
    *drawn = now;
    json!({ "deletions": deletions, "entities": entities })
}

fn commands_of<'m>(moment: &Moment<'m>) -> HashMap<u32, &'m VehicleCommand> {
    moment.step.commands.iter().flat_map(|part| &part.records).map(|c| (c.vehicle, c)).collect()
}

fn zone_name_of(places: &Places<'_>, state: &VehicleState) -> String {
    if state.zone == NO_ZONE { "link".to_owned() } else { zone_name(places.scenario, state.zone) }
}

fn vehicles(places: &Places<'_>, moment: &Moment<'_>) -> Value {
    let commands = commands_of(moment);
    let all = moment.step.state.iter().filter(|state| is_present(state)).map(|state| {
        let command = commands.get(&state.vehicle);
        json!({
            "vehicle": state.vehicle,
            "zone": zone_name_of(places, state),
            "x_m": state.x_m,
            "v_mps": state.v_mps,
            "u_before_mps2": state.u_mps2,
            "u_mps2": command.map(|c| c.u_mps2),
            "mode": command.map(|c| mode(c)),
            "verdict": command.map(|c| verdict(c)),
        })
    });
    json!({ "step": moment.step.header.step, "vehicles": all.collect::<Vec<_>>() })
}

fn zones(places: &Places<'_>, moment: &Moment<'_>) -> Value {
    let all = (0..).zip(&places.scenario.network.zones).map(|(index, zone)| {
        let inside = |s: &&VehicleState| is_present(s) && s.zone == index;
        json!({ "zone": zone.name, "vehicles": moment.step.state.iter().filter(inside).count() })
    });
    json!({ "step": moment.step.header.step, "zones": all.collect::<Vec<_>>() })
}
