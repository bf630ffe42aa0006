//! A recording as tables: states, commands, assignments, summaries, visits, vehicles, events, and what was run.
//!
//! The columns of the first four are those of the records themselves, from the layouts that also make the C header and
//! the Python module: a field that is new there is new here.

use crate::events::{Event, Events};
use crate::fcd::{Places, is_present};
use crate::out::OutError;
use crate::trips::Trips;
use crate::walk::{Ended, Moment, walk};
use control_zones::record::words::{mode, verdict, zone_name};
use control_zones::record::{Reader, Source};
use control_zones::scenario::Scenario;
use ipc_schemas::{Assignment, Layout, Record, Scalar, VehicleCommand, VehicleState, ZoneSummary, bytes_of};

/// The type of a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    /// Double precision.
    Number,
    /// Whole number of up to 64 bits, not negative.
    Count,
    /// Text.
    Text,
    /// True or false.
    Truth,
}

/// A column of a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Name, unit suffix included.
    pub name: String,
    /// Type of its values; each may be missing.
    pub kind: Type,
    /// Unit, where it has one.
    pub unit: Option<&'static str>,
    /// What it means.
    pub meaning: String,
}

/// A value of a row.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// There is none.
    None,
    /// A number.
    Number(f64),
    /// A whole number.
    Count(u64),
    /// Text.
    Text(String),
    /// True or false.
    Truth(bool),
}

/// A table's name and columns.
#[derive(Clone, Debug)]
pub struct Table {
    /// Name.
    pub name: &'static str,
    /// Columns.
    pub columns: Vec<Column>,
}

/// Takes the rows of a table.
pub trait Sink {
    /// Takes a row, one value per column.
    fn row(&mut self, row: &[Value]) -> Result<(), OutError>;
    /// Takes the last of them.
    fn finish(self) -> Result<(), OutError>;
}

/// The unit that a name ends in, as [the style](../../docs/style.md) has it.
fn unit_of(name: &str) -> Option<&'static str> {
    let units = [
        ("_per_s", "1/s"),
        ("_m_s", "m s"),
        ("_mps2", "m/s^2"),
        ("_mps", "m/s"),
        ("_rad", "rad"),
        ("_ns", "ns"),
        ("_m", "m"),
        ("_s", "s"),
    ];
    units.into_iter().find(|(end, _)| name.ends_with(end)).map(|(_, unit)| unit)
}

fn column(name: &str, kind: Type, meaning: &str) -> Column {
    let energy = (name == "energy" || name == "objective").then_some("m^2/s^3");
    Column {
        name: name.to_owned(),
        kind,
        unit: energy.or_else(|| unit_of(name)),
        meaning: meaning.to_owned(),
    }
}

fn record_columns(layout: &Layout) -> impl Iterator<Item = Column> {
    layout.fields.iter().map(|field| {
        let kind = if field.scalar == Scalar::F64 { Type::Number } else { Type::Count };
        let meaning = field.docs.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ");
        column(field.name, kind, &meaning)
    })
}

/// The values of a record, field by field. The greatest 32-bit number stands for nobody and nothing.
fn record_values<R: Record>(record: &R, row: &mut Vec<Value>) {
    let bytes = bytes_of(std::slice::from_ref(record));
    for field in R::LAYOUT.fields {
        let own = &bytes[field.offset..field.offset + field.scalar.size()];
        let mut wide = [0; 8];
        wide[..own.len()].copy_from_slice(own);
        row.push(match field.scalar {
            Scalar::F64 => Value::Number(f64::from_le_bytes(wide)),
            Scalar::U32 if own == [0xff; 4] => Value::None,
            Scalar::U64 | Scalar::U32 | Scalar::U16 => Value::Count(u64::from_le_bytes(wide)),
        });
    }
}

const STEP: (&str, &str) = ("step", "Step of the run.");
const TIME: (&str, &str) = ("time_s", "Simulated time of the step.");

fn stepwise(name: &'static str, layout: &Layout, own: Vec<Column>) -> Table {
    let mut columns = vec![column(STEP.0, Type::Count, STEP.1), column(TIME.0, Type::Number, TIME.1)];
    columns.extend(record_columns(layout));
    columns.extend(own);
    Table { name, columns }
}

/// The tables, in the order of [`Sheets`].
pub fn tables() -> [Table; 8] {
    let states = vec![
        column("zone_name", Type::Text, "Name of the zone."),
        column("lane", Type::Text, "Lane the front is on: zone and segment, or link."),
        column("plane_x_m", Type::Number, "Place of the front in the plane, x."),
        column("plane_y_m", Type::Number, "Place of the front in the plane, y."),
        column("heading_rad", Type::Number, "Direction of travel, counter-clockwise from the x axis."),
    ];
    let commands = vec![
        column("controller", Type::Count, "Index of the controller process."),
        column("generation", Type::Count, "Its generation: one more after each restart."),
        column("in_time", Type::Truth, "Whether it answered in time; otherwise the world chose."),
        column("mode_name", Type::Text, "The mode in words."),
        column("verdict_name", Type::Text, "The verdict in words, with the rows that decided."),
    ];
    let visits = vec![
        column("vehicle", Type::Count, "The vehicle."),
        column("zone", Type::Count, "Zone index."),
        column("zone_name", Type::Text, "Name of the zone."),
        column("path", Type::Count, "Index of the path within the zone."),
        column("path_name", Type::Text, "Name of the path."),
        column("entry_time_s", Type::Number, "Instant of entry."),
        column("exit_time_s", Type::Number, "Instant at which it left."),
        column("exit_speed_mps", Type::Number, "Speed at which it left."),
        column("energy", Type::Number, "Integral of u^2/2 over the visit."),
        column("fe_s", Type::Number, "Time in feasibility-enforcement mode."),
        column("wait_s", Type::Number, "Time it waited outside before it entered."),
        column("exposure_m_s", Type::Number, "Integral over time of what its rear-end margin lacks."),
        column("objective", Type::Number, "beta times the time, and the energy."),
    ];
    let vehicles = vec![
        column("vehicle", Type::Count, "The vehicle."),
        column("kind", Type::Text, "Kind of vehicle."),
        column("road", Type::Text, "Entry road."),
        column("depart_s", Type::Number, "Instant at which it entered the network."),
        column("depart_delay_s", Type::Number, "Time it had waited outside."),
        column("depart_mps", Type::Number, "Speed at which it entered."),
        column("arrival_s", Type::Number, "Instant at which it left; none when it was inside at the end."),
        column("distance_m", Type::Number, "Distance travelled."),
        column("waiting_s", Type::Number, "Time at less than 0.1 m/s."),
        column("visits", Type::Count, "Completed visits to zones."),
        column("energy", Type::Number, "Energy over these, the integral of u^2/2."),
        column("fe_s", Type::Number, "Time in feasibility-enforcement mode over these."),
    ];
    let events = vec![
        column("kind", Type::Text, "What happened."),
        column("first_step", Type::Count, "First step of it."),
        column("last_step", Type::Count, "Last step of it."),
        column("time_s", Type::Number, "When it began."),
        column("vehicle", Type::Count, "To which vehicle."),
        column("zone", Type::Count, "In which zone."),
        column("partner", Type::Count, "On account of which vehicle."),
        column("controller", Type::Count, "By which controller."),
        column("reason", Type::Text, "Why, in words."),
    ];
    let run = vec![
        column("key", Type::Text, "What is said of the run."),
        column("value", Type::Text, "What it is."),
    ];
    [
        stepwise("states", &VehicleState::LAYOUT, states),
        stepwise("commands", &VehicleCommand::LAYOUT, commands),
        stepwise(
            "assignments",
            &Assignment::LAYOUT,
            vec![column("zone_name", Type::Text, "Name of the zone.")],
        ),
        stepwise("summaries", &ZoneSummary::LAYOUT, Vec::new()),
        Table { name: "visits", columns: visits },
        Table { name: "vehicles", columns: vehicles },
        Table { name: "events", columns: events },
        Table { name: "run", columns: run },
    ]
}

/// A sink per table.
pub type Sheets<S> = [S; 8];

/// Writes all tables in one pass.
pub fn write<R: Source, S: Sink>(reader: &Reader<R>, mut sheets: Sheets<S>) -> Result<Ended, OutError> {
    let scenario = reader.scenario();
    let places = Places::of(scenario);
    let (mut trips, mut events) = (Trips::of(scenario).with_passages(), Events::of(scenario));
    let mut row = Vec::new();
    let ended = walk(reader, |moment| {
        trips.step(moment);
        events.step(moment);
        step_rows(&mut sheets, &places, moment, &mut row)
    })?;
    let [.., visits, vehicles, happened, run] = &mut sheets;
    visit_rows(visits, scenario, &trips)?;
    vehicle_rows(vehicles, &places, &trips)?;
    events.finish(reader.events()).iter().try_for_each(|event| happened.row(&event_row(event)))?;
    for (key, value) in facts(reader, &ended) {
        run.row(&[Value::Text(key.to_owned()), Value::Text(value)])?;
    }
    sheets.into_iter().try_for_each(Sink::finish)?;
    Ok(ended)
}

fn step_rows<S: Sink>(
    sheets: &mut Sheets<S>,
    places: &Places<'_>,
    moment: &Moment<'_>,
    row: &mut Vec<Value>,
) -> Result<(), OutError> {
    let [states, commands, assignments, summaries, ..] = sheets;
    let (step, scenario) = (moment.step, places.scenario);
    let instant = [Value::Count(step.header.step), Value::Number(step.header.time_ns as f64 * 1e-9)];
    let begin = |row: &mut Vec<Value>| {
        row.clear();
        row.extend_from_slice(&instant);
    };
    for state in &step.state {
        begin(row);
        record_values(state, row);
        row.push(Value::Text(zone_name_or_link(scenario, state.zone)));
        // One that has left is drawn where it is now, not here.
        match places.layout.lane_of(state).filter(|_| is_present(state)) {
            Some(on) => {
                let pose = places.layout.pose(on);
                row.push(Value::Text(places.lane_name(on.lane)));
                row.extend([pose.place.0, pose.place.1, pose.heading_rad].map(Value::Number));
            }
            None => row.extend([const { Value::None }; 4]),
        }
        states.row(row)?;
    }
    for (controller, part) in step.commands.iter().enumerate() {
        for command in &part.records {
            begin(row);
            record_values(command, row);
            row.push(Value::Count(controller as u64));
            row.push(Value::Count(part.generation.into()));
            row.push(Value::Truth(!step.missed(controller)));
            row.push(Value::Text(mode(command)));
            row.push(Value::Text(verdict(command)));
            commands.row(row)?;
        }
    }
    for assignment in &step.coordination {
        begin(row);
        record_values(assignment, row);
        row.push(Value::Text(zone_name(scenario, assignment.zone)));
        assignments.row(row)?;
    }
    for summary in &step.summaries {
        begin(row);
        record_values(summary, row);
        summaries.row(row)?;
    }
    Ok(())
}

fn zone_name_or_link(scenario: &Scenario, zone: u32) -> String {
    if zone == ipc_schemas::NO_ZONE { "link".to_owned() } else { zone_name(scenario, zone) }
}

fn visit_rows<S: Sink>(sheet: &mut S, scenario: &Scenario, trips: &Trips<'_>) -> Result<(), OutError> {
    for passage in trips.passages() {
        let visit = &passage.visit;
        let zone = &scenario.network.zones[visit.zone as usize];
        sheet.row(&[
            Value::Count(visit.vehicle.into()),
            Value::Count(visit.zone.into()),
            Value::Text(zone.name.clone()),
            Value::Count(passage.path.into()),
            Value::Text(zone.paths[passage.path as usize].name.clone()),
            Value::Number(visit.entry_time_s),
            Value::Number(visit.exit_time_s),
            Value::Number(visit.exit_speed_mps),
            Value::Number(visit.energy),
            Value::Number(visit.fe_s),
            Value::Number(visit.wait_s),
            Value::Number(visit.exposure_m_s),
            Value::Number(scenario.beta * visit.time_s() + visit.energy),
        ])?;
    }
    Ok(())
}

fn vehicle_rows<S: Sink>(sheet: &mut S, places: &Places<'_>, trips: &Trips<'_>) -> Result<(), OutError> {
    for trip in trips.all() {
        let road = trip.road.and_then(|road| places.scenario.network.roads.get(road as usize));
        sheet.row(&[
            Value::Count(trip.vehicle.into()),
            Value::Text(places.kind_name(trip.kind)),
            road.map_or(Value::None, |road| Value::Text(road.name.clone())),
            Value::Number(trip.depart_s),
            Value::Number(trip.depart_delay_s),
            Value::Number(trip.depart_mps),
            trip.arrival_s.map_or(Value::None, Value::Number),
            Value::Number(trip.distance_m),
            Value::Number(trip.waiting_s),
            Value::Count(trip.visits.into()),
            Value::Number(trip.energy),
            Value::Number(trip.fe_s),
        ])?;
    }
    Ok(())
}

fn event_row(event: &Event) -> [Value; 9] {
    let number = |value: Option<u32>| value.map_or(Value::None, |value| Value::Count(value.into()));
    [
        Value::Text(event.kind.name().to_owned()),
        Value::Count(event.first_step),
        Value::Count(event.last_step),
        Value::Number(event.time_s),
        number(event.vehicle),
        number(event.zone),
        number(event.partner),
        number(event.controller),
        Value::Text(event.reason.clone()),
    ]
}

/// What is said of a run: key and value.
pub(crate) fn facts<S: Source>(reader: &Reader<S>, ended: &Ended) -> Vec<(&'static str, String)> {
    let metadata = reader.metadata();
    let mut facts = vec![
        ("scenario", metadata.scenario_name.clone()),
        ("seed", metadata.seed.to_string()),
        ("changed", metadata.overrides.join(" ")),
        ("dt_s", reader.scenario().dt_s().to_string()),
        ("beta", reader.scenario().beta.to_string()),
        ("steps", ended.steps.to_string()),
        ("build", metadata.build.to_string()),
        ("coordinators", metadata.coordinators.to_string()),
        ("controllers", metadata.controllers.to_string()),
        ("scenario_hash", format!("{:016x}", metadata.scenario_hash)),
    ];
    if let Some(summary) = &ended.summary {
        facts.push(("arrived", summary.arrived.to_string()));
        facts.push(("departed", summary.departed.to_string()));
    }
    if let Some(footer) = reader.footer() {
        facts.push(("state_hash", format!("{:016x}", footer.state_hash)));
        facts.push(("end", footer.end.to_string()));
    }
    facts
}
