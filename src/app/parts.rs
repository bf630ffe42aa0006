//! `cz world`, `cz coord`, `cz ctrl`: one process of a run.

use super::args::{PartArgs, Restart, WaitArgs, WorldArgs};
use super::lines::{PartLine, WorldLine};
use super::record::Recording;
use super::report::{Summary, Transport};
use super::say::say;
use super::{AppError, record, report};
use crate::lockstep::RefusedFrames;
use crate::process::{
    Conduct, Departure, Joining, Observation, ProcessError, Settled, Settling, StopFlag, WorldOptions,
    first_missing_step, new_run_id, run_controller, run_coordinator, run_world,
};
use crate::scenario::scenario_hash;
use crate::trace::Tracing;
use crate::transport::iox::RunName;
use crate::world::{Traffic, World};
use ipc_schemas::Role;
use std::io::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Time between two progress reports to the supervisor.
const REPORT_EVERY: Duration = Duration::from_millis(50);

pub(super) fn world(args: &WorldArgs, traffic: Option<Box<dyn Traffic>>) -> Result<(), AppError> {
    let _tracing = Tracing::begin("world");
    let resume = args.resume.as_deref().map(record::open).transpose()?;
    let (scenario, share) = match &resume {
        None => (Arc::new(args.scenario.load()?), args.share),
        Some(reader) => (reader.scenario().clone(), record::share_of(reader)),
    };
    share.check(&scenario)?;
    let stop = StopFlag::from_signals()?;
    follow_supervisor(args.supervised)?;
    if let (Some(traffic), Some(from)) = (&traffic, &args.resume) {
        let problem = format!(
            "--resume {}: {} moves the vehicles and cannot go on from there",
            from.display(),
            traffic.name()
        );
        return Err(AppError::Usage(problem));
    }
    let run_id = args.run_id.unwrap_or_else(new_run_id);
    let past = resume
        .as_ref()
        .map(|reader| (reader, args.resume_steps.unwrap_or_else(|| first_missing_step(reader))));
    report::check_json(args.json.as_deref())?;
    let played_by = traffic.as_ref().map(|traffic| traffic.name());
    let observation = match &args.record {
        Some(path) => {
            let recording = match (past, &args.resume) {
                (Some((reader, steps)), Some(from)) => {
                    Recording::continuation(path, reader, from, steps, run_id)?
                }
                _ => Recording::start(path, &args.scenario, &scenario, share, run_id, played_by)?,
            };
            let recording = recording.lagging(args.conduct.record_lag());
            let push = |r: &mut Recording, step, block: &[u8]| r.push_block(step, block);
            Some(Observation::start(args.run.clone(), recording, push))
        }
        None => None,
    };
    let options = WorldOptions {
        run: args.run.clone(),
        coordinators: share.coord_procs,
        controllers: scenario.controllers(share.ctrl_procs),
        attach_timeout: args.conduct.wait.attach_timeout,
        peer_timeout: args.conduct.wait.peer_timeout,
        wait: args.conduct.wait_mode,
        replace: args.conduct.restart == Restart::OnFailure,
        timing: args.conduct.timing.timing()?,
        observed: args.observed || observation.is_some(),
        record_lag: args.conduct.record_lag(),
        is_steered: args.conduct.steering.steered,
        begins_paused: args.conduct.steering.begin_paused,
        silent: if args.supervised.is_some() { tell_of_silence } else { |_| {} },
        debugged: args.debugged.map_or(0, |index| 1_u64.checked_shl(index).unwrap_or(0)),
        run_id: Some(run_id),
    };
    let tell = report_to(args.supervised, &args.conduct.wait);
    let settling = settling(&args.conduct.wait, &*tell);
    if args.supervised.is_some() {
        let mut last: Option<Instant> = None;
        let progress = |world: &World| {
            // The first at once: it says that the run has begun.
            if last.is_none_or(|last| last.elapsed() >= REPORT_EVERY) {
                last = Some(Instant::now());
                tell_supervisor(&WorldLine::progress(world));
            }
        };
        let run = run_world(&scenario, &options, past, traffic, &settling, &stop, progress);
        let (outcome, departure) = run?;
        tell_supervisor(&WorldLine::Outcome(Box::new(outcome)));
        leave(departure, &options, &stop);
        return Ok(());
    }
    let run = run_world(&scenario, &options, past, traffic, &settling, &stop, |_: &World| {});
    let (outcome, departure) = match run {
        Ok((outcome, departure)) => (Ok(outcome), Some(departure)),
        Err(error) => (Err(AppError::from(error)), None),
    };
    let recorded = match observation {
        Some(observation) => match observation.stop() {
            Ok(mut recording) => {
                outcome.iter().for_each(|outcome| recording.happened(&outcome.events));
                recording.finish(&outcome)
            }
            Err(error) => Err(error.into()),
        },
        None => Ok(()),
    };
    let outcome = outcome?;
    let processes = 1 + options.coordinators + options.controllers;
    let summary = Summary::new(&scenario, Transport::Iceoryx2 { processes }, outcome);
    let delivered = summary.deliver(args.json.as_deref());
    if let Some(departure) = departure {
        leave(departure, &options, &stop);
    }
    delivered.and(recorded)
}

/// Leaves the run when the others have; whoever has not by then misses its end.
fn leave(departure: Departure, options: &WorldOptions, stop: &StopFlag) {
    for peer in departure.wait(stop) {
        let (id, seconds) = (peer.process_id, options.peer_timeout.as_secs_f64());
        say(format_args!("cz: {peer} (process {id}) has not left the run {seconds} s after its end"));
    }
}

pub(super) fn coordinator(args: &PartArgs) -> Result<(), AppError> {
    part(args, Role::Coordinator, run_coordinator)
}

pub(super) fn controller(args: &PartArgs) -> Result<(), AppError> {
    part(args, Role::Controller, run_controller)
}

fn part(
    args: &PartArgs,
    role: Role,
    run: impl FnOnce(&RunName, Conduct<'_>) -> Result<(), ProcessError>,
) -> Result<(), AppError> {
    let index = args.index.map_or_else(String::new, |index| format!(" {index}"));
    let _tracing = Tracing::begin(&format!("{role}{index}"));
    let (joining, stop) = prepare(args, role)?;
    let report = report_to(args.supervised, &args.wait);
    let (settling, refused) = (settling(&args.wait, &*report), refused_to(args));
    let peer_timeout = args.wait.peer_timeout;
    let conduct = Conduct { joining, peer_timeout, settling: &settling, refused: &refused, stop: &stop };
    Ok(run(&args.run, conduct)?)
}

fn settling<'a>(wait: &WaitArgs, report: &'a dyn Fn(&Settled)) -> Settling<'a> {
    Settling { pin: wait.pin, realtime: wait.rt, report }
}

/// Where what was granted is said: to the supervisor, which always wants it, as a line it recognises; to
/// people when they have asked.
fn report_to(supervisor: Option<u32>, wait: &WaitArgs) -> Box<dyn Fn(&Settled)> {
    match (supervisor, wait.rt) {
        (Some(_), _) => Box::new(|settled| say(PartLine::Settled(settled.clone()).to_line())),
        (None, true) => Box::new(|settled| say(settled)),
        (None, false) => Box::new(|_| {}),
    }
}

/// Where it is said whose frames were refused: to the supervisor, or to people.
fn refused_to(args: &PartArgs) -> impl Fn(RefusedFrames) + use<> {
    let is_supervised = args.supervised.is_some();
    move |refused| match is_supervised {
        true => say(PartLine::Refused(refused).to_line()),
        false => say(refused),
    }
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
pub(super) fn follow_supervisor(supervisor: Option<u32>) -> Result<(), AppError> {
    use rustix::process::{Signal, getppid, set_parent_process_death_signal};
    let Some(supervisor) = supervisor else { return Ok(()) };
    set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(|e| AppError::Failed(format!("cannot follow the supervisor: {e}")))?;
    // It may have died before the line above.
    let alive = getppid().is_some_and(|parent| parent.as_raw_nonzero().get() as u32 == supervisor);
    if alive { Ok(()) } else { Err(AppError::Interrupted("the supervisor has gone".to_owned())) }
}

fn tell_of_silence(controller: u32) {
    tell_supervisor(&WorldLine::Silent(controller));
}

/// One line of JSON to the supervisor; if it has gone, a signal is under way.
fn tell_supervisor(line: &WorldLine) {
    let mut out = std::io::stdout().lock();
    let _ = serde_json::to_writer(&mut out, line);
    let _ = out.write_all(b"\n").and_then(|()| out.flush());
}
