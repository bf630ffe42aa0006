//! The supervisor: starts the processes of a run, watches them, and leaves nothing behind.
//!
//! What is to be done is decided by [`life`]; this is its shell.

mod child;
mod keep;
mod life;
mod programs;

use super::args::{ConductArgs, Restart, ScenarioArgs, ShareArgs};
use super::lines::{PartLine, WorldLine};
use super::progress::{Bar, Position};
use super::record::Recording;
use super::say::Crier;
use super::{AppError, record};
use crate::lockstep::RefusedFrames;
use crate::own_time::OwnTime;
use crate::process::{
    Observation, Outcome, ProcessError, Settled, children_of, is_orphaned, is_stopped, signals_to_heed,
};
use crate::record::Reader;
use crate::scenario::{OnExit, Plugin};
use crate::trace;
use crate::transport::iox::{RunName, RunSpace, clean};
use child::{Event, Stdout};
use crossbeam::channel::{Receiver, Sender, bounded, select, unbounded};
pub(super) use keep::keep;
use life::{Act, Failure, GRACE, Kind, Life, Stage};
pub(super) use programs::Programs;
use rustix::process::{Resource, Signal, getpid, getrlimit, set_child_subreaper};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// What to start.
#[derive(Clone, Debug)]
pub(super) struct Plan<'a> {
    pub run: RunName,
    pub scenario: &'a ScenarioArgs,
    pub share: ShareArgs,
    /// Controllers written elsewhere.
    pub plugins: &'a [Plugin],
    /// Number of processes of the built-in pool.
    pub pool: u32,
    pub conduct: ConductArgs,
    /// Id of the run.
    pub run_id: u64,
    /// The recording the run goes on from, and so many of its steps.
    pub resume: Option<(&'a Path, u64)>,
    /// Where what each process did when is written.
    pub trace: Option<&'a Path>,
    /// Who takes the world's place, for `sh -c`.
    pub world: Option<&'a str>,
    /// The plug-in that is debugged.
    pub debugged: Option<usize>,
    /// Whether plug-ins that may be started again are when their programs change.
    pub reloads: bool,
}

impl Plan<'_> {
    /// How long a plug-in may take to end once the run is over.
    fn linger(&self) -> Duration {
        // Whoever debugs one may look at it for as long as others wait.
        let longest = if self.debugged.is_some() { Duration::MAX } else { LONGEST_LINGER };
        self.conduct.wait.peer_timeout.min(longest)
    }
}

/// No plug-in takes longer than this to end.
const LONGEST_LINGER: Duration = Duration::from_secs(60);
/// Events that may wait to be dealt with: whoever floods us waits.
const WAITING: usize = 1024;
/// The clock is looked at this often.
const LOOK: Duration = Duration::from_secs(1);
/// Whoever has lost its supervisor leaves at once, but a busy machine may take its time over it.
const LEAVING: Duration = Duration::from_secs(15);
/// What a process has not finished creating that long after its end, nobody will finish.
const SETTLED: Duration = Duration::from_millis(200);
/// Of what a process has said last, this much is in a message, characters.
const LAST_WORDS: usize = 500;

/// Runs a plan to its end. Results come first: they are handed to `deliver` as soon as they are complete, before the
/// recording is closed and whoever lingers is ended.
pub(super) fn conduct(
    plan: &Plan<'_>,
    recording: Option<Recording>,
    bar: Option<&Bar>,
    deliver: impl FnOnce(Outcome) -> Result<(), AppError>,
) -> Result<(), AppError> {
    let path = recording.as_ref().map(|recording| recording.path().to_owned());
    let mut observation = None;
    let mut recording = recording;
    let mut watch = || {
        check_memory()?;
        claim(&plan.run)?;
        let mut children = Children::new(plan, recording.is_some())?;
        observation = recording.take().map(|recording| {
            Observation::start(plan.run.clone(), recording, |r: &mut Recording, step, b| {
                r.push_block(step, b)
            })
        });
        let outcome = children.watch(|position| bar.iter().for_each(|bar| bar.show(position)));
        Ok((children, outcome))
    };
    let (children, outcome) = match watch() {
        Ok((children, outcome)) => (Some(children), outcome),
        Err(error) => (None, Err(error)),
    };
    bar.iter().for_each(|bar| bar.finish());
    let events = outcome.as_ref().map_or_else(|_| Vec::new(), |outcome| outcome.events.clone());
    let (outcome, delivered) = match outcome {
        Ok(outcome) => (Ok(()), deliver(outcome)),
        Err(error) => (Err(error), Ok(())),
    };
    let recording = match observation.map(Observation::stop) {
        Some(Ok(mut recording)) => {
            recording.happened(&events);
            Some(recording)
        }
        Some(Err(error)) => {
            super::say::say(format_args!("cz: the recording broke off: {error}"));
            None
        }
        None => recording,
    };
    let recorded = record::finish(recording, path.as_deref(), &outcome);
    let mut traced = Ok(());
    if let Some(children) = children {
        children.close();
        traced = plan.trace.map_or(Ok(()), put_together);
        // Whoever is still alive in the space keeps it; then there is nothing to be swept.
        let _ = RunSpace::sweep(&plan.run);
        if outcome.is_err() {
            // What cannot be known by a marker that was written over is known by its lock.
            let _ = clean(false);
        }
    }
    outcome.map_err(|error| point_to(path, error)).and(delivered).and(recorded).and(traced)
}

/// Puts together what the processes of a run have written of themselves.
fn put_together(path: &Path) -> Result<(), AppError> {
    let failed = |error| AppError::Failed(format!("--trace {}: cannot be written: {error}", path.display()));
    let parts = trace::put_together(path).map_err(failed)?;
    super::say::say(format_args!(
        "cz: {} has what {parts} processes did; ui.perfetto.dev shows it",
        path.display()
    ));
    Ok(())
}

/// Says how the run can go on, where something of it has been recorded.
fn point_to(recording: Option<PathBuf>, error: AppError) -> AppError {
    let has_steps = |path: &PathBuf| Reader::open(path).is_ok_and(|reader| reader.steps().next().is_some());
    let Some(path) = recording.filter(has_steps) else { return error };
    let how = format!("`cz resume {}` goes on from the last step recorded", path.display());
    match error {
        AppError::Failed(text) => AppError::Failed(format!("{text}\n  {how}")),
        AppError::Interrupted(text) => AppError::Interrupted(format!("{text}; {how}")),
        other => other,
    }
}

/// Memory that a process may map, bytes: with less it may be that none is left to say so.
const LEAST_MEMORY: u64 = 64 << 20;

/// Refuses a run whose processes, which have the limits of this one, could not get by.
fn check_memory() -> Result<(), AppError> {
    match getrlimit(Resource::As).current {
        Some(most) if most < LEAST_MEMORY => Err(AppError::Failed(format!(
            "each process may have {} kB of memory only, see `ulimit -v`; expected {} or more",
            most >> 10,
            LEAST_MEMORY >> 10
        ))),
        _ => Ok(()),
    }
}

/// Removes what a killed supervisor of the same run may have left, and refuses a run that is active: the
/// parts started here would take the places of its own.
fn claim(run: &RunName) -> Result<(), AppError> {
    let start = Instant::now();
    while !RunSpace::sweep(run).map_err(ProcessError::from)? {
        // The children of a supervisor killed just now are still on their way out.
        let waited = start.elapsed();
        if waited >= LEAVING || waited >= GRACE / 2 && !is_orphaned(run) {
            return Err(ProcessError::AlreadyActive { run: run.to_string() }.into());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(())
}

/// Arguments of `cz`, and environment, of the built-in controller that takes a plug-in's place.
type StandIn = (Vec<OsString>, Vec<(&'static str, OsString)>);

/// How to start a process of the run.
#[derive(Clone, Debug)]
struct Recipe {
    kind: Kind,
    /// Of `cz`, or of the program in its place.
    arguments: Vec<OsString>,
    environment: Vec<(&'static str, OsString)>,
    /// What a shell is to become with the arguments, where that is not `cz`.
    shell: Option<String>,
    /// Of a plug-in: arguments and environment of what may take its place.
    stand_in: Option<StandIn>,
    /// Of a plug-in: its index among the controllers.
    controller: Option<u32>,
    /// Whether it is debugged, and so has the terminal.
    has_terminal: bool,
    /// Of a plug-in that is started again when it changes: its program.
    programs: Option<Programs>,
    /// The process that was started so last.
    process: Option<u32>,
    /// Where it is and what it was granted.
    settled: Option<Settled>,
}

/// The processes of a run.
struct Children {
    life: Life,
    recipes: Vec<Recipe>,
    events: Sender<Event>,
    inbox: Receiver<Event>,
    signals: Receiver<i32>,
    time: OwnTime,
    crier: Crier,
    outcome: Option<Outcome>,
    /// What those that have ended had refused.
    refused: Vec<RefusedFrames>,
    /// When it was looked last whether programs have changed.
    looked_at_programs: Duration,
    run: RunName,
    /// When to look what who died last has not finished creating.
    looks_for_unfinished: Option<Duration>,
    /// Processes that this one had started before, for something else.
    bystanders: Vec<u32>,
}

impl Children {
    fn new(plan: &Plan<'_>, observed: bool) -> Result<Children, AppError> {
        let failed = |what: &str, why: &dyn std::fmt::Display| AppError::Failed(format!("{what}: {why}"));
        let (signal_sender, signals) = unbounded();
        let mut source = signal_hook::iterator::Signals::new(signals_to_heed())
            .map_err(|e| failed("cannot handle signals", &e))?;
        let no_thread =
            |e| failed("cannot start a thread (memory or processes may be limited, see `ulimit -a`)", &e);
        std::thread::Builder::new()
            .name("signals".to_owned())
            .spawn(move || {
                for signal in source.forever() {
                    let _ = signal_sender.send(signal);
                }
            })
            .map_err(no_thread)?;
        // Whom the keeper of a plug-in can no longer end comes to us.
        let _ = set_child_subreaper(Some(getpid()));
        let (events, inbox) = bounded(WAITING);
        let replaces = plan.conduct.restart == Restart::OnFailure;
        let mut children = Children {
            life: Life::new(replaces, plan.linger()),
            recipes: Vec::new(),
            events,
            inbox,
            signals,
            time: OwnTime::start(),
            crier: Crier::start().map_err(no_thread)?,
            outcome: None,
            refused: Vec::new(),
            looked_at_programs: Duration::ZERO,
            run: plan.run.clone(),
            looks_for_unfinished: None,
            bystanders: children_of(std::process::id()),
        };
        children.cast(plan, observed);
        Ok(children)
    }

    /// Says who takes part.
    fn cast(&mut self, plan: &Plan<'_>, observed: bool) {
        let (run, supervisor) = (plan.run.to_string(), std::process::id().to_string());
        let common = ["--run", &run, "--supervised", &supervisor].map(str::to_owned);
        let mut world = vec!["world".to_owned()];
        world.extend(common.clone());
        world.extend(["--ctrl-procs".to_owned(), plan.share.ctrl_procs.to_string()]);
        world.extend(["--coord-procs".to_owned(), plan.share.coord_procs.to_string()]);
        world.extend(plan.conduct.to_flags());
        world.extend(["--run-id".to_owned(), plan.run_id.to_string()]);
        world.extend(observed.then(|| "--observed".to_owned()));
        world.extend(plan.debugged.map(|plugin| format!("--debugged={}", plan.pool as usize + plugin)));
        world.extend(plan.scenario.to_arguments());
        world.extend(plan.resume.map(|(_, steps)| format!("--resume-steps={steps}")));
        let mut world: Vec<_> = world.into_iter().map(OsString::from).collect();
        if let Some((path, _)) = plan.resume {
            let mut argument = OsString::from("--resume=");
            argument.push(path);
            world.insert(1, argument);
        }
        let traced: Vec<_> = plan.trace.map(|path| (trace::VARIABLE, path.into())).into_iter().collect();
        self.add("world".to_owned(), Kind::World, world, traced.clone());
        // The shell becomes that program, so it is its process that is watched, and its parent is who it is to be.
        let played = plan.world.map(|command| format!("exec {command} \"$@\""));
        self.recipes[0].shell = played;
        for (role, command, count) in
            [("coordinator", "coord", plan.share.coord_procs), ("controller", "ctrl", plan.pool)]
        {
            for index in 0..count {
                let mut arguments = vec![command.to_owned()];
                arguments.extend(common.clone());
                arguments.extend(plan.conduct.wait.to_flags());
                arguments.extend(["--index".to_owned(), index.to_string()]);
                let arguments = arguments.into_iter().map(OsString::from).collect();
                self.add(format!("{role} {index}"), Kind::Part, arguments, traced.clone());
            }
        }
        for (plugin, Plugin { name, command, on_exit, .. }) in plan.plugins.iter().enumerate() {
            let Some(command) = command else { continue };
            let has_terminal = plan.debugged == Some(plugin);
            let terminal = has_terminal.then_some("--terminal");
            let arguments = ["keep", "--supervised", &supervisor].into_iter().chain(terminal);
            let arguments = arguments.chain(["--", command]).map(OsString::from).collect();
            let environment = vec![("CZ_RUN", run.clone().into()), ("CZ_CONTROLLER", name.into())];
            self.add(format!("controller {name}"), Kind::Plugin, arguments, environment);
            let mut stand_in = vec!["ctrl".to_owned()];
            stand_in.extend(common.clone());
            stand_in.extend(plan.conduct.wait.to_flags());
            stand_in.extend(["--index".to_owned(), (plan.pool as usize + plugin).to_string()]);
            let (member, recipe) = (self.recipes.len() - 1, self.recipes.last_mut());
            recipe.expect("it has just been added").stand_in =
                Some((stand_in.into_iter().map(OsString::from).collect(), traced.clone()));
            self.life.on_exit(member, *on_exit);
            self.recipes[member].has_terminal = has_terminal;
            if plan.reloads && *on_exit == OnExit::Restart {
                self.recipes[member].programs = Programs::of(command);
                self.life.reloads(member);
            }
            self.recipes[member].controller = Some(plan.pool + plugin as u32);
        }
    }

    fn add(
        &mut self,
        name: String,
        kind: Kind,
        arguments: Vec<OsString>,
        environment: Vec<(&'static str, OsString)>,
    ) {
        self.life.add(name, kind);
        let recipe = Recipe {
            kind,
            arguments,
            environment,
            shell: None,
            stand_in: None,
            controller: None,
            has_terminal: false,
            programs: None,
            process: None,
            settled: None,
        };
        self.recipes.push(recipe);
    }

    /// Watches until the results are complete, or everybody has ended without any.
    fn watch(&mut self, mut progress: impl FnMut(Position)) -> Result<Outcome, AppError> {
        while self.go_on() == Stage::Going {
            self.take_event(&mut progress);
        }
        match self.life.failure() {
            Some(Failure::Failed(text)) => Err(AppError::Failed(text.clone())),
            Some(Failure::Interrupted(text)) => Err(AppError::Interrupted(text.clone())),
            None => {
                let mut outcome = self.outcome.take().expect("a run that has not failed has results");
                outcome.placement = self.recipes.iter_mut().filter_map(|r| r.settled.take()).collect();
                outcome.refused.append(&mut self.refused);
                Ok(outcome)
            }
        }
    }

    /// Ends whoever lingers.
    fn close(mut self) {
        while self.go_on() != Stage::Done {
            self.take_event(&mut |_| {});
        }
        // Whoever got away from its keeper by killing it.
        let deadline = Instant::now() + GRACE;
        loop {
            let mut orphans = children_of(std::process::id());
            orphans.retain(|process| !self.bystanders.contains(process));
            if orphans.is_empty() || Instant::now() >= deadline {
                break;
            }
            for orphan in orphans {
                child::signal(orphan, Signal::KILL);
                child::reap(orphan);
            }
        }
        // There is no summary to say it.
        for refused in std::mem::take(&mut self.refused) {
            self.crier.cry(format!("cz: {refused}"));
        }
        self.crier.finish();
    }

    /// Does what is due; says how far the run is.
    fn go_on(&mut self) -> Stage {
        let now = self.time.look(2 * LOOK);
        let mut acts = Vec::new();
        self.look_at_programs(now, &mut acts);
        if self.looks_for_unfinished.take_if(|due| *due <= now).is_some() {
            RunSpace::remove_unfinished(&self.run);
        }
        self.life.tick(now, &mut acts);
        self.act(acts);
        self.life.stage()
    }

    /// Looks, now and then, whether programs have changed.
    fn look_at_programs(&mut self, now: Duration, acts: &mut Vec<Act>) {
        if now.saturating_sub(self.looked_at_programs) < programs::LOOK {
            return;
        }
        self.looked_at_programs = now;
        for (member, recipe) in self.recipes.iter_mut().enumerate() {
            if let Some(file) = recipe.programs.as_mut().and_then(Programs::changed) {
                self.life.changed(member, &file.display().to_string(), now, acts);
            }
        }
    }

    fn act(&mut self, acts: Vec<Act>) {
        for act in acts {
            match act {
                Act::Start(member) => self.start(member),
                Act::StandIn(member) => {
                    let recipe = &mut self.recipes[member];
                    let stand_in = recipe.stand_in.take();
                    (recipe.arguments, recipe.environment) =
                        stand_in.expect("a plug-in has one, and dies once");
                    recipe.kind = Kind::Part;
                    self.start(member);
                }
                Act::Ask(member) => self.signal(member, Signal::TERM),
                Act::Insist(member) => self.signal(member, Signal::KILL),
                Act::Say(line) => self.crier.cry(line),
            }
        }
    }

    fn start(&mut self, member: usize) {
        let recipe = &mut self.recipes[member];
        // A build may have replaced the program since.
        let own = std::env::current_exe().ok().filter(|path| path.exists());
        let mut command = match &recipe.shell {
            Some(script) => {
                let mut command = Command::new("sh");
                command.args(["-c", script, "sh"]);
                command
            }
            None => Command::new(own.unwrap_or_else(|| "/proc/self/exe".into())),
        };
        command.args(&recipe.arguments).envs(recipe.environment.iter().cloned());
        let stdout = match recipe.kind {
            Kind::World => Stdout::Report,
            Kind::Part => Stdout::Nobody,
            Kind::Plugin if recipe.has_terminal => Stdout::Terminal,
            Kind::Plugin => Stdout::Lines,
        };
        let now = self.time.look(2 * LOOK);
        match child::start(command, member, stdout, &self.events) {
            Ok(process) => {
                recipe.process = Some(process);
                self.life.started(member, process, now);
            }
            Err(error) => self.life.did_not_start(member, &error.to_string(), now),
        }
    }

    fn signal(&self, member: usize, signal: Signal) {
        if let Some(process) = self.recipes[member].process {
            child::signal(process, signal);
        }
    }

    /// Waits for something to happen, and takes it.
    fn take_event(&mut self, progress: &mut impl FnMut(Position)) {
        let now = self.time.look(2 * LOOK);
        let is_watched = self.recipes.iter().any(|recipe| recipe.programs.is_some());
        let longest = if is_watched { programs::LOOK } else { LOOK };
        let due = self.life.next_due().into_iter().chain(self.looks_for_unfinished).min();
        let patience = due.map_or(longest, |due| due.saturating_sub(now).min(longest));
        select! {
            recv(self.signals) -> signal => {
                let name = signal.ok().and_then(signal_hook::low_level::signal_name).unwrap_or("a signal");
                let now = self.time.look(2 * LOOK);
                self.life.interrupted(name, now);
            }
            recv(self.inbox) -> event => self.take(event.expect("the supervisor holds a sender"), progress),
            default(patience) => {}
        }
    }

    fn take(&mut self, event: Event, progress: &mut impl FnMut(Position)) {
        let now = self.time.look(2 * LOOK);
        let mut acts = Vec::new();
        match event {
            Event::World(WorldLine::Progress(position)) => {
                self.life.stepped(now);
                progress(position);
            }
            Event::World(WorldLine::Silent(controller)) => {
                let member = self.recipes.iter().position(|r| r.controller == Some(controller));
                member.into_iter().for_each(|member| self.life.silent(member, now, &mut acts));
            }
            Event::World(WorldLine::Outcome(outcome)) => {
                for row in &outcome.controllers {
                    self.life.came_to(&format!("controller {}", row.controller), row.generation);
                }
                self.outcome = Some(*outcome);
                self.life.results_are_in(now, &mut acts);
            }
            Event::Said { member, line } => self.take_words(member, line),
            Event::Printed { member, line } => {
                let name = self.life.name(member).trim_start_matches("controller ");
                self.crier.cry(format!("[{name}] {line}"));
            }
            Event::Ended { member, process } => {
                let end = child::reap(process);
                self.recipes[member].process = None;
                self.looks_for_unfinished = Some(now + SETTLED);
                self.life.ended(member, &end, now, is_stopped, &mut acts);
            }
        }
        self.act(acts);
    }

    /// Takes a line of somebody's stderr.
    fn take_words(&mut self, member: usize, line: String) {
        match (self.recipes[member].kind, PartLine::of(&line)) {
            (Kind::Plugin, Some(PartLine::Keeps(plugin))) => {
                if self.recipes[member].has_terminal {
                    let name = self.life.name(member);
                    // The shell that it was started by may be there too, and is no use to anybody.
                    self.crier.cry(format!(
                        "cz: {name} has the terminal, and the run waits for it; from another one: \
                         gdb -p $(pgrep -ng {plugin}), and lldb or py-spy dump likewise"
                    ));
                }
                return self.life.is_process(member, plugin);
            }
            (Kind::Plugin, _) => self.crier.cry(format!("[{}] {line}", self.life.name(member))),
            (_, Some(PartLine::Settled(settled))) => {
                self.life.settled(member);
                self.recipes[member].settled = Some(settled);
                return;
            }
            (_, Some(PartLine::Refused(refused))) => return self.refused.push(refused),
            (_, _) => {}
        }
        self.life.said(member, line.chars().take(LAST_WORDS).collect());
    }
}
