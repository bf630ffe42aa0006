//! `cz resume`: an interrupted run goes on. `cz branch`: another future of the same past.

use super::args::{BranchArgs, ResumeArgs, ScenarioArgs};
use super::progress::Bar;
use super::record::Recording;
use super::report::{Summary, Transport};
use super::run::own_name;
use super::say::say;
use super::supervise::{Plan, conduct};
use super::{AppError, print, record, report};
use crate::process::{RestoreError, StopFlag, first_missing_step, new_run_id, restore, run_on_in_process};
use crate::record::{FileSource, Reader, is_growing};
use crate::scenario::{Override, Scenario, load_recorded};
use crate::world::{World, WorldSummary};
use comfy_table::{Cell, CellAlignment, Table, presets};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;

impl From<RestoreError> for AppError {
    fn from(error: RestoreError) -> AppError {
        match error {
            RestoreError::Replay(error) => AppError::Usage(error.to_string()),
            RestoreError::Change(error) => AppError::Usage(format!("--set: {error}")),
        }
    }
}

pub(super) fn resume(args: &ResumeArgs) -> Result<(), AppError> {
    report::check_json(args.supervised.json.as_deref())?;
    if is_growing(&args.file).unwrap_or(false) {
        let problem = "a run is still recording into it; expected the recording of a run that has ended";
        return Err(AppError::Usage(format!("{}: {problem}", args.file.display())));
    }
    let reader = record::open(&args.file)?;
    let scenario = reader.scenario().clone();
    let first = first_missing_step(&reader);
    args.supervised.conduct.timing.timing()?;
    let last = reader.steps().map_while(Result::ok).last();
    if last.is_some_and(|step| step.header.flags & ipc_schemas::FLAG_END_OF_RUN != 0) {
        let problem = format!("{}: the run is complete; nothing is left to be resumed", args.file.display());
        return Err(AppError::Usage(problem));
    }
    say(format_args!("{} has {first} steps; the run goes on with step {first}", args.file.display()));
    let share = record::share_of(&reader);
    let none = ScenarioArgs::none();
    let plan = Plan {
        run: args.supervised.run.clone().unwrap_or_else(own_name),
        scenario: &none,
        plugins: &scenario.plugins,
        pool: scenario.controllers(share.ctrl_procs) - scenario.plugins.len() as u32,
        share,
        conduct: args.supervised.conduct,
        run_id: new_run_id(),
        resume: Some((&args.file, first)),
        trace: None,
        world: None,
        debugged: None,
        reloads: false,
    };
    let lag = args.supervised.conduct.record_lag();
    let recording = match &args.record {
        Some(path) => {
            Some(Recording::continuation(path, &reader, &args.file, first, plan.run_id)?.lagging(lag))
        }
        None => None,
    };
    let bar = Bar::new(&scenario);
    let processes = 1 + share.coord_procs + scenario.controllers(share.ctrl_procs);
    let asked = args.supervised.conduct.wait.asks_for_placement();
    conduct(&plan, recording, Some(&bar), |outcome| {
        let summary = Summary::new(&scenario, Transport::Iceoryx2 { processes }, outcome);
        summary.with_placement(asked).deliver(args.supervised.json.as_deref())
    })
}

pub(super) fn branch(args: &BranchArgs) -> Result<(), AppError> {
    let reader = record::open(&args.file)?;
    if !reader.scenario().plugins.is_empty() {
        let problem = "the run had controllers that are processes of their own; they cannot be branched";
        return Err(AppError::Usage(format!("{}: {problem}", args.file.display())));
    }
    let overrides: Vec<Override> =
        args.set.iter().map(|text| text.parse()).collect::<Result<_, _>>().map_err(AppError::Scenario)?;
    let other = Arc::new(changed(&reader, &overrides)?);
    let stop = StopFlag::from_signals()?;
    let as_recorded = future(&reader, args.at, None, &stop)?;
    let branched = future(&reader, args.at, Some(&other), &stop)?;
    if args.json {
        let value =
            json!({ "at": args.at, "set": args.set, "as_recorded": as_recorded, "branched": branched });
        return print(
            &(serde_json::to_string_pretty(&value).expect("the value has string keys only") + "\n"),
        );
    }
    print(&comparison(args, &as_recorded, &branched))
}

/// The recorded scenario with other settings.
fn changed(reader: &Reader<FileSource>, overrides: &[Override]) -> Result<Scenario, AppError> {
    let recorded = reader.metadata();
    Ok(load_recorded(&recorded.scenario_text, &recorded.overrides, overrides, recorded.seed)?)
}

/// Runs a recorded run from a step on to its end, under another scenario if there is one.
fn future(
    reader: &Reader<FileSource>,
    at: u64,
    scenario: Option<&Arc<Scenario>>,
    stop: &StopFlag,
) -> Result<WorldSummary, AppError> {
    let run = restore(reader, at, scenario.cloned())?;
    Ok(run_on_in_process(run, stop, |_: &World| {})?.world)
}

fn comparison(args: &BranchArgs, as_recorded: &WorldSummary, branched: &WorldSummary) -> String {
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY);
    table.set_header(["zone", "", "vehicles", "time\n[s]", "energy\n[m²/s³]", "objective\n[m²/s³]"]);
    for (one, other) in as_recorded.zones.iter().zip(&branched.zones) {
        for (name, zone) in [("as recorded", one), ("branched", other)] {
            table.add_row([
                Cell::new(&zone.zone),
                Cell::new(name),
                Cell::new(zone.vehicles),
                Cell::new(format!("{:.3}", zone.mean_time_s)),
                Cell::new(format!("{:.3}", zone.mean_energy)),
                Cell::new(format!("{:.3}", zone.mean_objective)),
            ]);
        }
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let total = |s: &WorldSummary| s.zones.iter().map(|z| z.mean_objective).sum::<f64>();
    format!(
        "{} from step {} on with {}\n{table}\ntotal objective {:.3} as recorded, {:.3} branched\n\
         state hash {:016x} after {} steps as recorded, {:016x} after {} branched\n",
        name_of(&args.file),
        args.at,
        if args.set.is_empty() { "nothing changed".to_owned() } else { args.set.join(", ") },
        total(as_recorded),
        total(branched),
        as_recorded.state_hash,
        as_recorded.steps,
        branched.state_hash,
        branched.steps,
    )
}

fn name_of(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}
