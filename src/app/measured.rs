//! What all measurements of `cz bench` use: their scenario, runs in processes, and tables.

use super::AppError;
use super::args::{ConductArgs, ScenarioArgs, ShareArgs, WaitArgs};
use super::record::Recording;
use super::run::own_name;
use super::supervise::{self, Plan};
use crate::bench::{MEASURED, THREE};
use crate::process::{Outcome, Placement, new_run_id};
use comfy_table::{CellAlignment, Table, presets};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// The scenario that is measured, with the whole trace: ten times as many steps as `cz run` takes.
pub(super) fn scenario_of(quick: bool) -> ScenarioArgs {
    let set = if quick { vec![] } else { vec!["end.vehicles=600".to_owned()] };
    ScenarioArgs { scenario: Some(MEASURED.to_owned()), seed: Some(1), set, side_by_side: None }
}

/// A scene of measurements in processes, by name: [`THREE`] or [`NINE`](crate::bench::NINE).
pub(super) fn scene(name: &str, quick: bool) -> (ScenarioArgs, ShareArgs) {
    if name == THREE {
        return (scenario_of(quick), ShareArgs { ctrl_procs: 1, coord_procs: 1 });
    }
    let scenario = ScenarioArgs { scenario: Some("corridor-8".to_owned()), ..ScenarioArgs::none() };
    (scenario, ShareArgs { ctrl_procs: 4, coord_procs: 4 })
}

pub(super) const WAIT: WaitArgs = WaitArgs {
    attach_timeout: Duration::from_secs(30),
    peer_timeout: Duration::from_secs(30),
    pin: Placement::Auto,
    rt: false,
};

/// Runs a scenario in processes of its own.
pub(super) fn run_as(
    scenario: &ScenarioArgs,
    share: ShareArgs,
    conduct: ConductArgs,
    record: Option<&Path>,
) -> Result<Outcome, String> {
    let plan = Plan {
        run: own_name(),
        scenario,
        share,
        plugins: &[],
        pool: share.ctrl_procs,
        conduct,
        run_id: new_run_id(),
        resume: None,
        trace: None,
        world: None,
        debugged: None,
        reloads: false,
    };
    let words = |e: AppError| e.to_string();
    let recording = match record {
        Some(path) => {
            let loaded = scenario.load().map_err(|e| e.to_string())?;
            Some(Recording::start(path, scenario, &loaded, plan.share, plan.run_id, None).map_err(words)?)
        }
        None => None,
    };
    let mut outcome = None;
    supervise::conduct(&plan, recording, None, |result| {
        outcome = Some(result);
        Ok(())
    })
    .map_err(words)?;
    Ok(outcome.expect("a run that has not failed has results"))
}

/// Starts this program as the other process of a measurement.
pub(super) fn start_peer(scenario: &ScenarioArgs, kind: &[String]) -> std::io::Result<Child> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["bench", "peer"]).args(scenario.to_flags()).args(kind);
    command.stdin(Stdio::null()).spawn()
}

pub(super) fn table(header: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY);
    table.set_header(header.iter().copied());
    table
}

pub(super) fn align(table: &mut Table) {
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
}
