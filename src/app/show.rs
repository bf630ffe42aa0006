//! `cz show`: a recording for people, and as JSON.

use super::args::ShowArgs;
use super::record::{bytes, open, ranges};
use super::say::number;
use super::{AppError, print};
use crate::record::words::{mode, place, verdict, zone_name};
use crate::record::{Damage, Flaw, Reader, Source, Step, steps_in};
use crate::scenario::Scenario;
use comfy_table::{CellAlignment, LineStyle, Table, TableStyle};
use ipc_schemas::{self as frames, Assignment, VehicleCommand, VehicleState};
use serde_json::{Value, json};
use std::path::Path;

pub(super) fn show(args: &ShowArgs) -> Result<(), AppError> {
    if args.network {
        let name = args.file.to_string_lossy();
        let scenario = crate::scenario::load(Some(&name), &[], None)?;
        let out = args.out.clone().unwrap_or_else(|| format!("{}.svg", scenario.name).into());
        super::draw::network(&scenario, &out)?;
        return print(&format!("{}\n", out.display()));
    }
    let reader = open(&args.file)?;
    let path = args.file.display();
    let (text, damage) = match (args.step, args.vehicle) {
        _ if args.scenario => (scenario_text(&reader), Vec::new()),
        (None, None) => all(&reader, args.json),
        (Some(step), _) => (one_step(&reader, step, args.json).map_err(|e| e.at(&path))?, Vec::new()),
        (None, Some(vehicle)) => match course(&reader, vehicle, args.json) {
            (Some(text), damage) => (text, damage),
            (None, damage) => {
                judge(&args.file, &damage)?;
                return Err(AppError::Usage(format!("{path}: vehicle {vehicle} is in none of its steps")));
            }
        },
    };
    print(&text)?;
    judge(&args.file, &damage)
}

/// Everything that can be shown of a recording, for the fuzzer: it must come to an end without a panic.
#[cfg(fuzzing)]
pub fn everything<S: Source>(reader: &Reader<S>) -> usize {
    let mut length = scenario_text(reader).len();
    let mut vehicles = std::collections::BTreeSet::from([0, u32::MAX]);
    let numbers: Vec<u64> = reader.step_numbers().step_by(7).take(3).chain([u64::MAX]).collect();
    for as_json in [false, true] {
        length += all(reader, as_json).0.len();
        for number in &numbers {
            length += one_step(reader, *number, as_json).map_or(0, |text| text.len());
            if let Ok(Some(step)) = reader.step(*number) {
                vehicles.extend(step.state.iter().take(2).map(|s| s.vehicle));
            }
        }
        for vehicle in &vehicles {
            length += course(reader, *vehicle, as_json).0.map_or(0, |text| text.len());
        }
    }
    length
}

/// Why one step cannot be shown.
#[derive(Debug)]
enum NoStep {
    NotThere { number: u64, there: String },
    Damaged(Damage),
}

impl NoStep {
    fn at(&self, path: &std::path::Display<'_>) -> AppError {
        AppError::Usage(match self {
            NoStep::NotThere { number, there } => format!("{path}: step {number} is not in it; {there}"),
            NoStep::Damaged(damage) => format!("{path}: damaged at {damage}"),
        })
    }
}

fn pretty(value: &Value) -> String {
    serde_json::to_string_pretty(value).expect("the value has string keys only") + "\n"
}

/// The scenario's text with what was changed as comments: a file one can run.
fn scenario_text<S: Source>(reader: &Reader<S>) -> String {
    let metadata = reader.metadata();
    let mut text = format!("# {}, seed {}\n", metadata.scenario_name, metadata.seed);
    for set in &metadata.overrides {
        text.push_str(&format!("# --set {}\n", set.replace('\n', " ")));
    }
    text + &metadata.scenario_text
}

/// What a pass over the whole file has found.
#[derive(Default)]
struct Survey {
    steps: u64,
    last: Option<(u64, u64)>,
    damage: Vec<Damage>,
    /// Steps in which each controller was missed.
    missed: Vec<u64>,
    vehicles: u32,
}

impl Survey {
    fn of<S: Source>(reader: &Reader<S>) -> Survey {
        let mut survey =
            Survey { missed: vec![0; reader.metadata().controllers as usize], ..Survey::default() };
        for step in reader.steps() {
            match step {
                Ok(step) => survey.count(&step),
                Err(damage) => survey.damage.push(damage),
            }
        }
        survey
    }

    fn count(&mut self, step: &Step) {
        self.steps += 1;
        self.last = Some((step.header.step, step.state_hash));
        for (controller, missed) in self.missed.iter_mut().enumerate() {
            *missed += u64::from(step.missed(controller));
        }
        let vehicles = step.state.iter().map(|s| s.vehicle.saturating_add(1)).max().unwrap_or(0);
        self.vehicles = self.vehicles.max(vehicles);
    }
}

/// Damage decides the exit code; a file that ends early is what a power cut leaves and is no fault.
fn judge(path: &Path, damage: &[Damage]) -> Result<(), AppError> {
    match damage.iter().find(|damage| damage.flaw != Flaw::CutOff) {
        Some(damage) => Err(AppError::Usage(format!("{}: damaged at {damage}", path.display()))),
        None => Ok(()),
    }
}

/// What the recording is of and whether it is whole, and where it is damaged.
fn all<S: Source>(reader: &Reader<S>, as_json: bool) -> (String, Vec<Damage>) {
    let survey = Survey::of(reader);
    let metadata = reader.metadata();
    let gaps = reader.gaps();
    let footer = reader.footer();
    let created =
        i64::try_from(metadata.created_unix_s).ok().and_then(|s| jiff::Timestamp::from_second(s).ok());
    let created = created.map_or_else(|| "at an unknown time".to_owned(), |time| time.to_string());
    let (last, state_hash) = survey.last.unwrap_or_default();
    let time_s = last as f64 * (metadata.dt_ns as f64 * 1e-9);
    let whole = footer.is_some() && survey.damage.is_empty() && gaps.is_empty();
    if as_json {
        let build = &metadata.build;
        let text = pretty(&json!({
            "scenario": metadata.scenario_name,
            "seed": metadata.seed,
            "scenario_hash": format!("{:016x}", metadata.scenario_hash),
            "overrides": metadata.overrides,
            "coordinators": metadata.coordinators,
            "controllers": metadata.controllers,
            "run_id": format!("{:016x}", metadata.run_id),
            "created": created,
            "build": { "version": build.version, "commit": build.commit, "target": build.target, "profile": build.profile },
            "bytes": reader.length(),
            "dt_s": metadata.dt_ns as f64 * 1e-9,
            "steps": survey.steps,
            "last_step": survey.last.map(|(step, _)| step),
            "vehicles": survey.vehicles,
            "state_hash": format!("{state_hash:016x}"),
            "whole": whole,
            "end": footer.map(|footer| footer.end.to_string()),
            "missing": gaps,
            "missed_answers": survey.missed,
            "damage": survey.damage.iter().map(Damage::to_string).collect::<Vec<_>>(),
        }));
        return (text, survey.damage);
    }
    let mut lines = vec![
        ("scenario", format!("{}, seed {}", metadata.scenario_name, metadata.seed)),
        ("recorded", { format!("{created} by {}", metadata.build) }),
        (
            "processes",
            format!(
                "{}, {}",
                number(metadata.coordinators.into(), "coordinator"),
                number(metadata.controllers.into(), "controller")
            ),
        ),
        ("steps", {
            let step_s = metadata.dt_ns as f64 * 1e-9;
            format!("{}, the last {last} at {time_s:.1} s, each {step_s} s", survey.steps)
        }),
        ("vehicles", survey.vehicles.to_string()),
        ("size", bytes(reader.length())),
    ];
    if !metadata.overrides.is_empty() {
        lines.insert(1, ("changed", metadata.overrides.join(" ")));
    }
    if survey.missed.iter().any(|missed| *missed > 0) {
        let missed = survey.missed.iter().enumerate().filter(|(_, missed)| **missed > 0);
        let missed = missed.map(|(controller, missed)| format!("controller {controller}: {missed} steps"));
        lines.push(("not in time", missed.collect::<Vec<_>>().join(", ")));
    }
    if !gaps.is_empty() {
        let known = footer.is_some_and(|footer| gaps.iter().all(|gap| footer.missing.contains(gap)));
        let why = if known { "not written in time" } else { "damaged or not written" };
        lines.push(("missing", format!("{} steps, {why}: {}", steps_in(&gaps), ranges(&gaps))));
    }
    for damage in &survey.damage {
        let what = if damage.flaw == Flaw::CutOff { "cut off" } else { "damaged" };
        lines.push((what, damage.to_string()));
    }
    lines.push((
        "end",
        match footer {
            Some(footer) => footer.end.to_string(),
            None => "none: the recorder was killed, or the power failed".to_owned(),
        },
    ));
    lines.push(("whole", if whole { "yes, every step checked" } else { "no" }.to_owned()));
    lines.push(("state hash", format!("{state_hash:016x}")));
    let text: String = lines.iter().map(|(name, value)| format!("{name:<12}{value}\n")).collect();
    (text, survey.damage)
}

/// One step in full.
fn one_step<S: Source>(reader: &Reader<S>, number: u64, as_json: bool) -> Result<String, NoStep> {
    let there = || {
        let mut numbers = reader.step_numbers();
        match (numbers.next(), numbers.next_back()) {
            (Some(first), last) => format!("it has steps {first} to {}", last.unwrap_or(first)),
            (None, _) => "it has no steps".to_owned(),
        }
    };
    let step = match reader.step(number) {
        Ok(Some(step)) => step,
        Ok(None) => return Err(NoStep::NotThere { number, there: there() }),
        Err(damage) => return Err(NoStep::Damaged(damage)),
    };
    let scenario = reader.scenario();
    let time_s = step.header.time_ns as f64 * 1e-9;
    if as_json {
        let parts = step.commands.iter().enumerate().map(|(controller, part)| {
            json!({
                "controller": controller,
                "generation": part.generation,
                "in_time": !step.missed(controller),
                "commands": part.records,
            })
        });
        return Ok(pretty(&json!({
            "step": number,
            "time_s": time_s,
            "state_hash": format!("{:016x}", step.state_hash),
            "header": step.header,
            "state": step.state,
            "summaries": step.summaries,
            "coordination": step.coordination,
            "commands": parts.collect::<Vec<_>>(),
        })));
    }
    let mut text = format!("step {number}, {time_s:.3} s, state hash {:016x}", step.state_hash);
    if step.header.flags & frames::FLAG_END_OF_RUN != 0 {
        text.push_str(", the last of the run");
    }
    text.push_str(&format!("\n\n{}", state_table(scenario, &step.state)));
    if !step.coordination.is_empty() {
        text.push_str(&format!("\n{}", assignment_table(scenario, &step.coordination)));
    }
    for s in &step.summaries {
        text.push_str(&format!(
            "\n{} told {}: {} vehicles, {} of them in the first {:.1} m at {:.3} m/s on average\n",
            zone_name(scenario, s.from_zone),
            zone_name(scenario, s.to_zone),
            s.vehicles,
            s.segment_vehicles,
            s.segment_m,
            s.segment_mean_speed_mps
        ));
    }
    for (controller, part) in step.commands.iter().enumerate().filter(|(_, part)| !part.records.is_empty()) {
        text.push_str(&format!("\ncontroller {controller}"));
        if part.generation > 0 {
            text.push_str(&format!(", generation {}", part.generation));
        }
        if step.missed(controller) {
            text.push_str(", did not answer in time; the world's own choice");
        }
        text.push_str(&format!("\n{}", command_table(scenario, &part.records)));
    }
    Ok(text)
}

/// The course of a vehicle, if it has one, and where the recording is damaged.
fn course<S: Source>(reader: &Reader<S>, vehicle: u32, as_json: bool) -> (Option<String>, Vec<Damage>) {
    let scenario = reader.scenario();
    let mut rows: Vec<(f64, u64, VehicleState, Option<VehicleCommand>)> = Vec::new();
    let mut damage = Vec::new();
    for step in reader.steps() {
        let step = match step {
            Ok(step) => step,
            Err(place) => {
                damage.push(place);
                continue;
            }
        };
        // A vehicle that has left a zone is listed there as well; where it is now comes with its command.
        let own = |s: &&VehicleState| s.vehicle == vehicle && s.flags & frames::STATE_LEFT == 0;
        let Some(state) = step.state.iter().find(own) else { continue };
        let mut commands = step.commands.iter().flat_map(|part| &part.records);
        let command = commands.find(|c| c.vehicle == vehicle).copied();
        rows.push((step.header.time_ns as f64 * 1e-9, step.header.step, *state, command));
    }
    if rows.is_empty() {
        return (None, damage);
    }
    if as_json {
        let rows = rows.iter().map(|(time_s, step, state, command)| {
            json!({
                "step": step,
                "time_s": time_s,
                "zone": place(scenario, state),
                "x_m": state.x_m,
                "v_mps": state.v_mps,
                "u_mps2": command.map(|c| c.u_mps2),
                "mode": command.map(|c| mode(&c)),
                "verdict": command.map(|c| verdict(&c)),
            })
        });
        let text = pretty(&json!({ "vehicle": vehicle, "course": rows.collect::<Vec<_>>() }));
        return (Some(text), damage);
    }
    let mut table =
        new_table(&["step", "t\n[s]", "zone", "x\n[m]", "v\n[m/s]", "u\n[m/s²]", "mode", "verdict"]);
    for (time_s, step, state, command) in &rows {
        table.add_row([
            step.to_string(),
            format!("{time_s:.3}"),
            place(scenario, state),
            format!("{:.3}", state.x_m),
            format!("{:.3}", state.v_mps),
            command.map_or_else(|| "-".to_owned(), |c| format!("{:.4}", c.u_mps2)),
            command.map_or_else(String::new, |c| mode(&c)),
            command.map_or_else(String::new, |c| verdict(&c)),
        ]);
    }
    right(&mut table, &[0, 1, 3, 4, 5]);
    (Some(format!("vehicle {vehicle}\n{table}\n")), damage)
}

fn new_table(header: &[&str]) -> Table {
    let mut table = Table::new();
    // One line under the header: courses are hundreds of rows long.
    table.load_style(TableStyle::new().header_separator(LineStyle::none().fill('─').junction('─')));
    table.set_header(header.iter().copied());
    table
}

fn right(table: &mut Table, columns: &[usize]) {
    for (i, column) in table.column_iter_mut().enumerate() {
        if columns.contains(&i) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
}

fn state_table(scenario: &Scenario, states: &[VehicleState]) -> String {
    if states.is_empty() {
        return "no vehicles\n".to_owned();
    }
    let header = [
        "vehicle",
        "zone",
        "x\n[m]",
        "v\n[m/s]",
        "u before\n[m/s²]",
        "entered\n[s]",
        "plans to leave\n[s]",
        "",
    ];
    let mut table = new_table(&header);
    for s in states {
        let what = match s.flags {
            f if f & frames::STATE_LEFT_NOW != 0 => "has just left",
            f if f & frames::STATE_LEFT != 0 => "has left",
            f if f & frames::STATE_ENTERED != 0 => "has just entered",
            _ => "",
        };
        table.add_row([
            s.vehicle.to_string(),
            place(scenario, s),
            format!("{:.3}", s.x_m),
            format!("{:.3}", s.v_mps),
            format!("{:.4}", s.u_mps2),
            format!("{:.3}", s.entry_time_s),
            format!("{:.3}", s.planned_exit_time_s),
            what.to_owned(),
        ]);
    }
    right(&mut table, &[0, 2, 3, 4, 5, 6]);
    format!("{table}\n")
}

fn assignment_table(scenario: &Scenario, assignments: &[Assignment]) -> String {
    let header = ["vehicle", "zone", "yields to", "terminal speed\n[m/s]", "scheduled"];
    let mut table = new_table(&header);
    for a in assignments {
        let partner = match a.kind {
            frames::CONSTRAINT_NONE => "nobody".to_owned(),
            frames::CONSTRAINT_REAR_END => format!("{} ahead", a.partner),
            frames::CONSTRAINT_MERGE => format!("{} at the merging point", a.partner),
            frames::CONSTRAINT_CROSS => format!("{} at the crossing", a.partner),
            other => format!("{} (kind {other})", a.partner),
        };
        let scheduled = match a.scheduled_time_s > 0.0 {
            true => format!("{:.2} m at {:.3} s", a.scheduled_at_m, a.scheduled_time_s),
            false => "–".to_owned(),
        };
        let free = a.flags & frames::ASSIGNMENT_FREE_TERMINAL != 0;
        table.add_row([
            a.vehicle.to_string(),
            zone_name(scenario, a.zone),
            partner,
            if free { "free".to_owned() } else { format!("{:.3}", a.terminal_speed_mps) },
            scheduled,
        ]);
    }
    right(&mut table, &[0, 3]);
    format!("{table}\n")
}

fn command_table(scenario: &Scenario, commands: &[VehicleCommand]) -> String {
    let mut table = new_table(&["vehicle", "zone", "u\n[m/s²]", "mode", "verdict"]);
    for c in commands {
        table.add_row([
            c.vehicle.to_string(),
            zone_name(scenario, c.zone),
            format!("{:.4}", c.u_mps2),
            mode(c),
            verdict(c),
        ]);
    }
    right(&mut table, &[0, 2]);
    format!("{table}\n")
}
