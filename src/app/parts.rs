//! `cz world`, `cz coord`, `cz ctrl`: one process of a run.

use super::AppError;
use super::args::{PartArgs, Restart, WorldArgs};
use super::report::{Summary, Transport};
use super::supervise::WorldLine;
use crate::process::{Joining, StopFlag, WorldOptions, place, run_controller, run_coordinator, run_world};
use crate::scenario::scenario_hash;
use crate::world::World;
use ipc_schemas::Role;
use std::io::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Time between two progress reports to the supervisor.
const REPORT_EVERY: Duration = Duration::from_millis(50);

pub(super) fn world(args: &WorldArgs) -> Result<(), AppError> {
    let scenario = Arc::new(args.scenario.load()?);
    args.share.check(&scenario)?;
    let stop = StopFlag::from_signals()?;
    follow_supervisor(args.supervised)?;
    let options = WorldOptions {
        run: args.run.clone(),
        coordinators: args.share.coord_procs,
        controllers: scenario.controllers(args.share.ctrl_procs),
        attach_timeout: args.wait.attach_timeout,
        peer_timeout: args.wait.peer_timeout,
        wait: args.wait_mode,
        replace: args.restart == Restart::OnFailure,
    };
    place(args.wait.pin, Role::World, 0);
    if args.supervised.is_some() {
        let mut last = Instant::now();
        let outcome = run_world(&scenario, &options, &stop, |world| {
            if last.elapsed() >= REPORT_EVERY {
                last = Instant::now();
                say(&WorldLine::progress(world));
            }
        })?;
        say(&WorldLine::Outcome(Box::new(outcome)));
        return Ok(());
    }
    let outcome = run_world(&scenario, &options, &stop, |_: &World| {})?;
    let processes = 1 + options.coordinators + options.controllers;
    Summary::new(&scenario, Transport::Iceoryx2 { processes }, outcome).deliver(args.json.as_deref())
}

pub(super) fn coordinator(args: &PartArgs) -> Result<(), AppError> {
    let (joining, stop) = prepare(args, Role::Coordinator)?;
    Ok(run_coordinator(&args.run, joining, args.wait.peer_timeout, args.wait.pin, &stop)?)
}

pub(super) fn controller(args: &PartArgs) -> Result<(), AppError> {
    let (joining, stop) = prepare(args, Role::Controller)?;
    Ok(run_controller(&args.run, joining, args.wait.peer_timeout, args.wait.pin, &stop)?)
}

fn prepare(args: &PartArgs, role: Role) -> Result<(Joining, StopFlag), AppError> {
    let scenario_hash =
        if args.scenario.is_given() { Some(scenario_hash(&args.scenario.load()?)) } else { None };
    let stop = StopFlag::from_signals()?;
    follow_supervisor(args.supervised)?;
    let joining = Joining { role, index: args.index, scenario_hash, timeout: args.wait.attach_timeout };
    Ok((joining, stop))
}

/// Has the kernel send SIGTERM when the supervisor dies, however it dies.
fn follow_supervisor(supervisor: Option<u32>) -> Result<(), AppError> {
    use rustix::process::{Signal, getppid, set_parent_process_death_signal};
    let Some(supervisor) = supervisor else { return Ok(()) };
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(|e| AppError::Failed(format!("cannot follow the supervisor: {e}")))?;
    // It may have died before the line above.
    let alive = getppid().is_some_and(|parent| parent.as_raw_nonzero().get() as u32 == supervisor);
    if alive { Ok(()) } else { Err(AppError::Interrupted("the supervisor has gone".to_owned())) }
}

/// One line of JSON to the supervisor; if it has gone, a signal is under way.
fn say(line: &WorldLine) {
    let mut out = std::io::stdout().lock();
    let _ = serde_json::to_writer(&mut out, line);
    let _ = out.write_all(b"\n").and_then(|()| out.flush());
}
