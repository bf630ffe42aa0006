//! `cz run`: a whole run, in this process or in several.

use super::args::{RunArgs, ScenarioArgs};
use super::progress::{Bar, Position};
use super::record::Recording;
use super::report::{Summary, Transport};
use super::supervise::{Plan, conduct};
use super::{AppError, controllers, report, sibling};
use crate::lockstep::in_process::InProcess;
use crate::process::{
    StopFlag, WaitMode, check_cores, new_run_id, run_on_in_process, run_on_in_process_observed,
};
use crate::scenario::Scenario;
use crate::transport::iox::RunName;
use crate::world::{Traffic, World};
use std::sync::Arc;
use std::time::Duration;

pub(super) fn run(args: &RunArgs, traffic: Option<Box<dyn Traffic>>) -> Result<(), AppError> {
    if args.view {
        // It starts this run itself, without the flag.
        let own = std::env::args_os().skip(2).filter(|argument| argument != "--view");
        let arguments: Vec<_> = ["--".into()].into_iter().chain(own).collect();
        return sibling::VIEW.run(&arguments);
    }
    let mut arguments = args.scenario.clone();
    arguments.set.extend(args.shield.iter().map(|mode| format!("shield={mode}")));
    let (arguments, scenario) = controllers::load(&arguments, args)?;
    let scenario = Arc::new(scenario);
    args.share.check(&scenario)?;
    if args.supervised.conduct.wait_mode == WaitMode::Spin && !args.in_process {
        check_cores(1 + (args.share.coord_procs + args.share.ctrl_procs) as usize)?;
    }
    if args.in_process && !scenario.plugins.is_empty() {
        let problem = "--in-process: the scenario has controllers that are processes of their own";
        return Err(AppError::Usage(problem.to_owned()));
    }
    args.supervised.conduct.timing.timing()?;
    report::check_json(args.supervised.json.as_deref())?;
    if args.in_process && args.supervised.conduct.timing.is_given() {
        let problem =
            "--in-process: nobody else can be late; --pace and --deadline are for several processes";
        return Err(AppError::Usage(problem.to_owned()));
    }
    let debugged = debugged(args, &scenario)?;
    let mut conduct_args = args.supervised.conduct;
    if debugged.is_some() || args.reload {
        (conduct_args.wait.attach_timeout, conduct_args.wait.peer_timeout) = (WITHOUT_END, WITHOUT_END);
    }
    let bar = Bar::new(&scenario);
    if args.in_process {
        return run_here(args, &arguments, &scenario, traffic, &bar);
    }
    let processes = 1 + args.share.coord_procs + scenario.controllers(args.share.ctrl_procs);
    let plan = Plan {
        run: args.supervised.run.clone().unwrap_or_else(own_name),
        scenario: &arguments,
        plugins: &scenario.plugins,
        pool: scenario.controllers(args.share.ctrl_procs) - scenario.plugins.len() as u32,
        share: args.share,
        conduct: conduct_args,
        run_id: new_run_id(),
        resume: None,
        trace: args.trace.as_deref(),
        world: args.world.as_deref(),
        debugged,
        reloads: args.reload,
    };
    let recording = match &args.record {
        Some(path) => {
            let recording =
                Recording::start(path, &arguments, &scenario, args.share, plan.run_id, args.world.clone())?;
            Some(recording.lagging(args.supervised.conduct.record_lag()))
        }
        None => None,
    };
    let asked = args.supervised.conduct.wait.asks_for_placement();
    // Nothing is drawn over what a debugger says.
    conduct(&plan, recording, debugged.is_none().then_some(&bar), |outcome| {
        let summary = Summary::new(&scenario, Transport::Iceoryx2 { processes }, outcome);
        summary.with_placement(asked).deliver(args.supervised.json.as_deref())
    })
}

/// No wait of a run that somebody works at is longer than this.
const WITHOUT_END: Duration = Duration::from_secs(86_400);

/// Which of the plug-ins is debugged, if one is.
fn debugged(args: &RunArgs, scenario: &Scenario) -> Result<Option<usize>, AppError> {
    let Some(target) = &args.debug else { return Ok(None) };
    let name = controllers::name_of(target);
    let names: Vec<_> = scenario.plugins.iter().map(|plugin| plugin.name.as_str()).collect();
    let at = names.iter().position(|known| *known == name).ok_or_else(|| {
        let known = if names.is_empty() { "--controller with it".to_owned() } else { names.join(", ") };
        AppError::Usage(format!("--debug {target}: expected a controller of the run: {known}"))
    })?;
    if args.supervised.json.as_deref() == Some(std::path::Path::new("-")) {
        let problem = "--debug: the controller has the terminal; expected a file for --json";
        return Err(AppError::Usage(problem.to_owned()));
    }
    Ok(Some(at))
}

/// A whole run in this process.
fn run_here(
    args: &RunArgs,
    arguments: &ScenarioArgs,
    scenario: &Arc<Scenario>,
    traffic: Option<Box<dyn Traffic>>,
    bar: &Bar,
) -> Result<(), AppError> {
    let stop = StopFlag::from_signals()?;
    let shares = args.share;
    let (coordinators, controllers) = (shares.coord_procs, shares.ctrl_procs);
    let progress = |world: &World| bar.show(Position::of(world));
    let mut recording = match &args.record {
        Some(path) => {
            let played_by = traffic.as_ref().map(|traffic| traffic.name());
            Some(Recording::start(path, arguments, scenario, shares, InProcess::RUN_ID, played_by)?)
        }
        None => None,
    };
    let observed = recording.is_some();
    let run = match traffic {
        Some(traffic) => InProcess::played(scenario, coordinators, controllers, traffic, observed),
        None if observed => InProcess::observed(scenario, coordinators, controllers),
        None => InProcess::new(scenario, coordinators, controllers),
    };
    let outcome = match &mut recording {
        None => run_on_in_process(run, &stop, progress),
        Some(recording) => run_on_in_process_observed(run, &stop, progress, |f| recording.push(f)),
    };
    let outcome = outcome.map_err(AppError::from);
    bar.finish();
    // A recording that failed does not take the results with it.
    let recorded = recording.map_or(Ok(()), |recording| recording.finish(&outcome));
    Summary::new(scenario, Transport::InProcess, outcome?).deliver(args.supervised.json.as_deref())?;
    recorded
}

/// A run name nobody else has.
pub(super) fn own_name() -> RunName {
    format!("cz-{}", std::process::id()).parse().expect("letters, a dash and digits are a run name")
}
