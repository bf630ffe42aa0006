//! Scenario text in, validated [`Scenario`] out.
//!
//! The text is parsed into a tree of values with their origins (`document`), `--set`s are written over it
//! (`overrides`), and one pass reads and checks it (`sections`, `topology`, `demand`), so that each failure
//! is one message naming place, key, value and what was expected.

mod demand;
mod document;
pub(super) mod error;
mod faults;
mod overrides;
mod plugins;
mod routes;
mod scope;
mod sections;
pub(super) mod table;
mod topology;
mod zone;

pub use error::{Place, ScenarioError, printable};
pub use overrides::Override;

use super::ranges::MAX_TIME_S;
use super::{LawKind, Network, Road, Scenario, embedded, flow, keys, ranges};
use demand::{DemandReader, TraceBase};
use document::{Document, Node, Origin, Value};
use std::collections::BTreeMap;
use std::path::Path;
use table::Table;

/// The scenario that runs when none is named.
pub const DEFAULT_SCENARIO: &str = "two-merges";

/// Names of the embedded scenarios, the default first.
pub fn embedded_names() -> impl Iterator<Item = &'static str> {
    embedded::SCENARIOS.iter().map(|(name, _)| *name)
}

/// Text of an embedded scenario.
pub fn embedded_text(name: &str) -> Option<&'static str> {
    embedded::SCENARIOS.iter().find(|(n, _)| *n == name).map(|(_, text)| *text)
}

/// Loads the scenario a command line names: nothing for the default, a file, or an embedded name.
///
/// A name with a `/` or ending in `.toml` is a file, and so is one that exists as a file.
pub fn load(
    argument: Option<&str>,
    overrides: &[Override],
    seed: Option<u64>,
) -> Result<Scenario, ScenarioError> {
    match file_of(argument) {
        Some(path) => load_file(path, overrides, seed),
        None => load_embedded(argument.unwrap_or(DEFAULT_SCENARIO), overrides, seed),
    }
}

/// The text of the scenario a command line names, as it is before anything is changed in it.
pub fn text_of(argument: Option<&str>) -> Result<String, ScenarioError> {
    match file_of(argument) {
        Some(path) => read_text(path),
        None => Ok(text_of_embedded(argument.unwrap_or(DEFAULT_SCENARIO))?.to_owned()),
    }
}

/// The file an argument names, if it names one.
fn file_of(argument: Option<&str>) -> Option<&Path> {
    // The default must not depend on what the current directory happens to hold.
    let name = argument?;
    let path = Path::new(name);
    (name.contains('/') || name.ends_with(".toml") || path.is_file()).then_some(path)
}

fn read_text(path: &Path) -> Result<String, ScenarioError> {
    std::fs::read_to_string(path).map_err(|source| ScenarioError::Read { path: path.to_owned(), source })
}

fn text_of_embedded(name: &str) -> Result<&'static str, ScenarioError> {
    embedded_text(name).ok_or_else(|| ScenarioError::UnknownScenario {
        name: name.to_owned(),
        known: embedded_names().collect::<Vec<_>>().join(", "),
        suggestion: error::nearest(name, embedded_names()),
    })
}

/// Loads a scenario file. Traces are relative to its directory. `seed` goes before the file's.
pub fn load_file(path: &Path, overrides: &[Override], seed: Option<u64>) -> Result<Scenario, ScenarioError> {
    let text = read_text(path)?;
    let base = TraceBase::Directory(path.parent().unwrap_or(Path::new("")).to_owned());
    load_text(&path.display().to_string(), &text, base, overrides, seed)
}

/// Loads an embedded scenario. Traces are embedded ones, or relative to the current directory.
pub fn load_embedded(
    name: &str,
    overrides: &[Override],
    seed: Option<u64>,
) -> Result<Scenario, ScenarioError> {
    let text = text_of_embedded(name)?;
    load_text(&format!("<embedded>/{name}.toml"), text, TraceBase::Embedded, overrides, seed)
}

/// Loads the text of a scenario and the traces it names, all given: path as the text has it, and contents.
/// Nothing is read from anywhere else.
pub fn load_given(
    text: &str,
    traces: Vec<(String, Vec<u8>)>,
    overrides: &[Override],
    seed: Option<u64>,
) -> Result<Scenario, ScenarioError> {
    load_text("<given>", text, TraceBase::Given(traces), overrides, seed)
}

/// Loads a recorded scenario's text again, with what was changed in it then and what is to be changed now.
/// Traces are embedded ones, or relative to the current directory.
pub fn load_recorded(
    text: &str,
    recorded: &[String],
    overrides: &[Override],
    seed: u64,
) -> Result<Scenario, ScenarioError> {
    let seed = format!("seed={seed}");
    let recorded = recorded.iter().chain([&seed]).map(|set| set.parse());
    let recorded = recorded.collect::<Result<Vec<Override>, _>>()?;
    let all = [&recorded, overrides].concat();
    load_text("<recording>", text, TraceBase::Embedded, &all, None)
}

fn load_text(
    file: &str,
    text: &str,
    base: TraceBase,
    overrides: &[Override],
    seed: Option<u64>,
) -> Result<Scenario, ScenarioError> {
    let mut document = Document::parse(file, text)?;
    for set in overrides {
        set.apply(&mut document)?;
    }
    if let (Some(seed), Value::Table(root)) = (seed, &mut document.root.value) {
        let node = Node { origin: Origin::Seed(seed), value: Value::Integer(seed.into()) };
        root.insert("seed".to_owned(), node);
    }
    read(&document, base)
}

fn read(document: &Document, base: TraceBase) -> Result<Scenario, ScenarioError> {
    let root = Table::root(document);
    root.only_declared(keys::ROOT)?;
    let name = root.name()?.to_owned();
    let seed = match root.get("seed") {
        Some(field) => field.integer(0, "an integer from 0 to 2^64 - 1")?,
        None => 1,
    };
    let dt_ns = dt_ns(&root)?;
    let dt_s = dt_ns as f64 * 1e-9;
    let section = |key: &str| root.get(key).map(|field| field.table("a table")).transpose();
    let (max_vehicles, max_time_s) = end(section("end")?.as_ref(), dt_s)?;
    let vehicle = sections::vehicle(section("vehicle")?.as_ref())?;
    let objective = root.need("objective", "a table with alpha or beta")?.table("a table")?;
    let beta = sections::beta(&objective, &vehicle)?;
    let control_table = section("control")?;
    let control = sections::control(control_table.as_ref(), beta)?;
    let coordination_table = section("coordination")?;
    let (coordination, order) = sections::coordination(coordination_table.as_ref())?;
    let fleet = sections::fleet(&root, &vehicle)?;

    let road_tables = root.tables("roads", "a list of entry roads, at least one")?;
    let zone_tables = root.tables("zones", "a list of zones, at least one")?;
    for table in &road_tables {
        table.only_declared(keys::ROADS)?;
    }
    for table in &zone_tables {
        table.only_declared(keys::ZONES)?;
    }
    let law = sections::law(control_table.as_ref(), LawKind::default())?;
    let road_names = table::unique_names(&road_tables, "road")?;
    let zone_names = table::unique_names(&zone_tables, "zone")?;
    let step_m = vehicle.v_max_mps * dt_s;
    let mut topology = topology::read(
        &zone_tables,
        &zone_names,
        &road_tables,
        &road_names,
        (step_m, vehicle.v_max_mps),
        (law, order),
    )?;

    flow_policies(&zone_tables, &mut topology, &vehicle)?;

    let routes = road_tables.iter().zip(&topology.road_ends);
    let routes = routes.map(|(table, &end)| routes::read(table, &topology.zones, end));
    let routes = routes.collect::<Result<Vec<_>, _>>()?;
    let mut reader = DemandReader { base, seed, roads: road_names, routes, vehicle, traces: BTreeMap::new() };
    let gate = section("gate")?;
    if let Some(table) = &gate {
        table.only_declared(keys::GATE)?;
    }
    let entry_everywhere = sections::entry(gate.as_ref(), keys::ENTRY.default())?;
    let mut roads = Vec::with_capacity(road_tables.len());
    for (index, (table, &(zone, segment))) in road_tables.iter().zip(&topology.road_ends).enumerate() {
        let demand = reader.read(index as u32, table)?;
        let name = reader.roads[index].to_owned();
        let routes = std::mem::take(&mut reader.routes[index]);
        let entry = sections::entry(Some(table), entry_everywhere)?;
        let (automated, rank) = sections::mixture(table, &fleet)?;
        roads.push(Road { name, zone, segment, demand, routes, entry, automated, rank });
    }
    let plugins = plugins::read(&root, &topology.zones)?;
    let shield = root.chosen(&keys::SHIELD)?;
    let faults = faults::read(section("faults")?.as_ref(), &topology.zones)?;
    let network = Network { zones: topology.zones, roads };
    Ok(Scenario {
        name,
        seed,
        dt_ns,
        max_vehicles,
        max_time_s,
        network,
        fleet,
        vehicle,
        control,
        coordination,
        beta,
        plugins,
        shield,
        faults,
    })
}

/// The flow policy of each exit: its own, or else its zone's.
fn flow_policies(
    tables: &[Table<'_>],
    topology: &mut topology::Topology,
    vehicle: &super::VehicleParams,
) -> Result<(), ScenarioError> {
    let longest_m: Vec<(String, f64)> =
        topology.zones.iter().map(|zone| (zone.name.clone(), zone.longest_m())).collect();
    for (zone, &declared) in topology.zones.iter_mut().zip(&topology.declared) {
        let table = &tables[declared];
        let own: Vec<Table<'_>> = match table.get("exits") {
            Some(_) => table.tables("exits", "a list of exits")?,
            None => Vec::new(),
        };
        for (index, exit) in zone.exits.iter_mut().enumerate() {
            let downstream = exit.to.map(|to| {
                let (zone, longest_m) = &longest_m[to.zone as usize];
                flow::Downstream { zone, longest_m: *longest_m }
            });
            let table = own.get(index).filter(|exit| exit.get("flow").is_some()).unwrap_or(table);
            exit.flow = flow::flow(table, downstream.as_ref(), vehicle)?;
        }
    }
    Ok(())
}

/// `dt_s` as nanoseconds.
fn dt_ns(root: &Table<'_>) -> Result<u64, ScenarioError> {
    let range = keys::DT.range;
    let expected = format!("{range}, a whole number of nanoseconds");
    // Decimal fractions of a second are not exact in binary: a relative error of some bits is no fraction
    // of a nanosecond.
    let whole = |dt_s: f64| {
        let ns = dt_s * 1e9;
        range.contains(dt_s) && (ns - ns.round()).abs() <= 1e-12 * ns
    };
    Ok((root.f64_or(keys::DT.name, keys::DT.default(), whole, &expected)? * 1e9).round() as u64)
}

/// `[end]`: greatest number of vehicles, and time in s.
fn end(table: Option<&Table<'_>>, dt_s: f64) -> Result<(Option<u32>, f64), ScenarioError> {
    const DEFAULT_TIME_S: f64 = 7200.0;
    let Some(t) = table else { return Ok((None, DEFAULT_TIME_S)) };
    t.only_declared(keys::END)?;
    let vehicles = match t.get("vehicles") {
        Some(field) => Some(field.integer(1, "an integer from 1 to 4294967295")?),
        None => None,
    };
    let longest_s = MAX_TIME_S.min(dt_s * ranges::MAX_STEPS);
    let time_ok = |time| time >= dt_s && time <= longest_s;
    let expected = format!("a time from dt_s = {dt_s} to {longest_s:e} s");
    Ok((vehicles, t.f64_or("time_s", DEFAULT_TIME_S, time_ok, &expected)?))
}
