//! The supervisor: starts the processes of a run, watches them, and leaves nothing behind.

use super::AppError;
use super::args::{ConductArgs, Restart, ScenarioArgs, ShareArgs};
use super::lines::{PartLine, WorldLine};
use super::record::Recording;
use super::run::Position;
use crate::lockstep::RefusedFrames;
use crate::process::{Observation, Outcome, ProcessError, Settled};
use crate::scenario::Plugin;
use crate::transport::iox::{RunName, RunSpace};
use crossbeam::channel::{Receiver, Sender, select, unbounded};
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
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
}

/// A part that dies this often, each time soon after it was started, is given up.
const MAX_RESTARTS: u32 = 8;
/// A part that has lived this long has proved itself.
const PROBATION: Duration = Duration::from_secs(5);
/// The second restart in a row waits this long, each further one twice as long as the one before.
const BACK_OFF: Duration = Duration::from_millis(10);

/// How long the others may take to end by themselves once one has failed, and once asked to.
const GRACE: Duration = Duration::from_secs(2);

/// Starts everything, waits for the end, and returns the world's outcome, and the recording with all of it
/// that is to be in it.
pub(super) fn supervise(
    plan: &Plan<'_>,
    recording: Option<Recording>,
    progress: impl FnMut(Position),
) -> (Result<Outcome, AppError>, Option<Recording>) {
    if let Err(error) = claim(&plan.run) {
        return (Err(error), recording);
    }
    let observed = recording.is_some();
    let observation = recording
        .map(|r| Observation::start(plan.run.clone(), r, |r: &mut Recording, step, b| r.push_block(step, b)));
    let result = oversee(plan, observed, progress);
    let recording = observation.and_then(|observation| match observation.stop() {
        Ok(recording) => Some(recording),
        Err(error) => {
            eprintln!("cz: the recording broke off: {error}");
            None
        }
    });
    sweep(&plan.run);
    (result, recording)
}

fn oversee(plan: &Plan<'_>, observed: bool, progress: impl FnMut(Position)) -> Result<Outcome, AppError> {
    // Signals first: from here on a Ctrl-C ends the children in order.
    let (signal_sender, signals) = unbounded();
    let mut source =
        signal_hook::iterator::Signals::new([signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM])
            .map_err(|e| AppError::Failed(format!("cannot handle signals: {e}")))?;
    std::thread::spawn(move || {
        for signal in source.forever() {
            let _ = signal_sender.send(signal);
        }
    });

    let (events, inbox) = unbounded();
    let mut family = Family {
        children: Vec::new(),
        plugins: Vec::new(),
        events,
        restart: plan.conduct.restart,
        due: Vec::new(),
        refused: Vec::new(),
    };
    let result = family.start(plan, observed).and_then(|()| family.watch(&inbox, &signals, progress));
    if result.is_err() {
        family.end(&inbox);
        // There is no summary to say it.
        family.refused.iter().for_each(|refused| eprintln!("cz: {refused}"));
    }
    result
}

/// Removes what a killed supervisor of the same run may have left, and refuses a run that is active: the
/// parts started here would take the places of its own.
fn claim(run: &RunName) -> Result<(), AppError> {
    // The children of a supervisor killed just now are still on their way out.
    let deadline = Instant::now() + GRACE / 2;
    while !RunSpace::sweep(run).map_err(ProcessError::from)? {
        if Instant::now() >= deadline {
            return Err(ProcessError::AlreadyActive { run: run.to_string() }.into());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(())
}

fn sweep(run: &RunName) {
    // Whoever is still alive in the space keeps it; then there is nothing to be swept.
    let _ = RunSpace::sweep(run);
}

#[derive(Debug)]
enum Event {
    Line { line: WorldLine },
    Said { child: usize, line: String },
    Ended { child: usize, status: std::io::Result<ExitStatus> },
}

/// The child processes.
struct Family {
    children: Vec<Member>,
    /// Which of them are controllers written elsewhere, each leading a process group.
    plugins: Vec<usize>,
    events: Sender<Event>,
    restart: Restart,
    /// Who is to be started again, and when.
    due: Vec<(Instant, Part)>,
    /// What those that have ended had refused.
    refused: Vec<RefusedFrames>,
}

/// How to start a process of ours.
#[derive(Clone, Debug)]
struct Part {
    name: String,
    command: &'static str,
    arguments: Vec<OsString>,
    /// Restarts in a row.
    restarts: u32,
}

struct Member {
    name: String,
    pid: u32,
    running: bool,
    /// How to start it again, unless it is a plug-in.
    part: Option<Part>,
    since: Instant,
    /// The last thing it said on stderr.
    last_words: Option<String>,
    /// Where it is and what it was granted.
    settled: Option<Settled>,
}

impl Family {
    fn start(&mut self, plan: &Plan<'_>, observed: bool) -> Result<(), AppError> {
        let (run, supervisor) = (plan.run.to_string(), std::process::id().to_string());
        let common = ["--run", &run, "--supervised", &supervisor].map(str::to_owned);
        let participant = [&common[..], &plan.conduct.wait.to_flags()].concat();
        let mut world = common.to_vec();
        world.extend(["--ctrl-procs".to_owned(), plan.share.ctrl_procs.to_string()]);
        world.extend(["--coord-procs".to_owned(), plan.share.coord_procs.to_string()]);
        world.extend(plan.conduct.to_flags());
        world.extend(["--run-id".to_owned(), plan.run_id.to_string()]);
        world.extend(observed.then(|| "--observed".to_owned()));
        world.extend(plan.scenario.to_arguments());
        world.extend(plan.resume.map(|(_, steps)| format!("--resume-steps={steps}")));
        let resume = plan.resume.map(|(path, _)| {
            let mut argument = OsString::from("--resume=");
            argument.push(path);
            argument
        });
        let arguments = resume.into_iter().chain(world.into_iter().map(OsString::from)).collect();
        self.spawn(Part { name: "world".to_owned(), command: "world", arguments, restarts: 0 })?;
        for (role, command, count) in
            [("coordinator", "coord", plan.share.coord_procs), ("controller", "ctrl", plan.pool)]
        {
            for index in 0..count {
                let mut arguments = participant.clone();
                arguments.extend(["--index".to_owned(), index.to_string()]);
                let arguments = arguments.into_iter().map(OsString::from).collect();
                self.spawn(Part { name: format!("{role} {index}"), command, arguments, restarts: 0 })?;
            }
        }
        for plugin in plan.plugins {
            if let Some(command) = &plugin.command {
                self.spawn_plugin(&plan.run, &plugin.name, command)?;
            }
        }
        Ok(())
    }

    /// Starts a controller written elsewhere, through the shell, in a process group of its own so that
    /// whatever the shell starts is ended with it. What it says goes to stderr under its name.
    fn spawn_plugin(&mut self, run: &RunName, name: &str, command: &str) -> Result<(), AppError> {
        let mut child = Command::new("sh")
            .args(["-c", command])
            .env("CZ_RUN", run.to_string())
            .env("CZ_CONTROLLER", name)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()
            .map_err(|e| AppError::Failed(format!("cannot start controller {name}: {e}")))?;
        let index = self.children.len();
        let member = Member {
            name: format!("controller {name}"),
            pid: child.id(),
            running: true,
            part: None,
            since: Instant::now(),
            last_words: None,
            settled: None,
        };
        self.children.push(member);
        let prefix = name.to_owned();
        let stdout = child.stdout.take();
        std::thread::spawn(move || {
            for line in stdout.into_iter().flat_map(|s| BufReader::new(s).lines().map_while(Result::ok)) {
                eprintln!("[{prefix}] {line}");
            }
        });
        self.plugins.push(index);
        self.listen(index, &mut child);
        Ok(())
    }

    fn spawn(&mut self, part: Part) -> Result<(), AppError> {
        let Part { name, command, arguments, .. } = &part;
        let failed = |e: std::io::Error| AppError::Failed(format!("cannot start the {name}: {e}"));
        let program = std::env::current_exe().map_err(failed)?;
        let mut child = Command::new(program)
            .arg(command)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(if *command == "world" { Stdio::piped() } else { Stdio::null() })
            .stderr(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let index = self.children.len();
        self.children.push(Member {
            name: name.clone(),
            pid: child.id(),
            running: true,
            part: Some(part),
            since: Instant::now(),
            last_words: None,
            settled: None,
        });
        self.listen(index, &mut child);
        Ok(())
    }

    /// Arranges for a coordinator or controller that has died to be started again. Whoever was asked to
    /// end, and ended, is not.
    fn replace(&mut self, child: usize, status: &std::io::Result<ExitStatus>) -> bool {
        let world_runs = self.children.first().is_some_and(|world| world.running);
        let deliberate = status.as_ref().is_ok_and(|s| s.code() == Some(130));
        let member = &self.children[child];
        let Some(part) = member.part.as_ref().filter(|part| part.command != "world") else { return false };
        if self.restart == Restart::Never || deliberate || !world_runs {
            return false;
        }
        let in_a_row = if member.since.elapsed() >= PROBATION { 0 } else { part.restarts };
        if in_a_row >= MAX_RESTARTS {
            return false;
        }
        let pause = if in_a_row == 0 { Duration::ZERO } else { BACK_OFF * (1 << (in_a_row - 1)) };
        self.due.push((Instant::now() + pause, Part { restarts: in_a_row + 1, ..part.clone() }));
        true
    }

    /// Starts whoever is due; returns how long until the next one is.
    fn restart_due(&mut self) -> Result<Option<Duration>, AppError> {
        let now = Instant::now();
        let (due, later): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.due).into_iter().partition(|(at, _)| *at <= now);
        self.due = later;
        for (_, part) in due {
            self.spawn(part)?;
        }
        Ok(self.due.iter().map(|(at, _)| at.saturating_duration_since(now)).min())
    }

    /// A thread per child passes on what it says and, after its last word, how it ended.
    fn listen(&self, child_index: usize, child: &mut Child) {
        let stderr = child.stderr.take();
        let stdout = child.stdout.take();
        let pid = child.id();
        let events = self.events.clone();
        let says = events.clone();
        let lines = std::thread::spawn(move || {
            for line in stdout.into_iter().flat_map(|s| BufReader::new(s).lines().map_while(Result::ok)) {
                if let Ok(line) = serde_json::from_str(&line) {
                    let _ = says.send(Event::Line { line });
                }
            }
        });
        std::thread::spawn(move || {
            for line in stderr.into_iter().flat_map(|s| BufReader::new(s).lines().map_while(Result::ok)) {
                let _ = events.send(Event::Said { child: child_index, line });
            }
            let _ = lines.join();
            let status = wait_for(pid);
            let _ = events.send(Event::Ended { child: child_index, status });
        });
    }

    /// Takes a line of a child's stderr.
    fn said(&mut self, child: usize, line: String) {
        let member = &mut self.children[child];
        if self.plugins.contains(&child) {
            eprintln!("[{}] {line}", member.name);
        } else {
            match PartLine::of(&line) {
                Some(PartLine::Settled(settled)) => return member.settled = Some(settled),
                Some(PartLine::Refused(refused)) => return self.refused.push(refused),
                None => {}
            }
        }
        member.last_words = Some(line);
    }

    fn watch(
        &mut self,
        inbox: &Receiver<Event>,
        signals: &Receiver<i32>,
        mut progress: impl FnMut(Position),
    ) -> Result<Outcome, AppError> {
        let mut outcome = None;
        let mut failure: Option<(AppError, Instant)> = None;
        while self.children.iter().any(|c| c.running) {
            let patience = match &failure {
                // The others notice within moments; what they say on the way out is worth having.
                Some((_, since)) => GRACE.saturating_sub(since.elapsed()),
                None => self.restart_due()?.unwrap_or(Duration::from_secs(3600)),
            };
            select! {
                recv(signals) -> signal => {
                    let name = if signal == Ok(signal_hook::consts::SIGINT) { "SIGINT" } else { "SIGTERM" };
                    return Err(AppError::Interrupted(format!("interrupted by {name}; the run was ended")));
                }
                recv(inbox) -> event => match event.expect("the family holds a sender") {
                    Event::Line { line: WorldLine::Progress(position) } => progress(position),
                    Event::Line { line: WorldLine::Outcome(result) } => outcome = Some(*result),
                    Event::Said { child, line } => self.said(child, line),
                    Event::Ended { child, status } => {
                        self.children[child].running = false;
                        if let Some(how) = describe_failure(&status) {
                            let text = message(&self.children[child], &how);
                            if failure.is_none() && self.replace(child, &status) {
                                eprintln!("cz: {text}; it is started again");
                                continue;
                            }
                            match &mut failure {
                                None => failure = Some((AppError::Failed(text), Instant::now())),
                                Some((AppError::Failed(all), _)) => {
                                    all.push_str("\n  ");
                                    all.push_str(&text);
                                }
                                Some(_) => {}
                            }
                        }
                    }
                },
                default(patience) => if let Some((error, _)) = failure {
                    return Err(error);
                },
            }
        }
        match (failure, outcome) {
            (Some((error, _)), _) => Err(error),
            (None, Some(mut outcome)) => {
                outcome.placement = self.children.iter_mut().filter_map(|c| c.settled.take()).collect();
                outcome.refused.append(&mut self.refused);
                Ok(outcome)
            }
            (None, None) => Err(AppError::Failed("the world ended without results".to_owned())),
        }
    }

    /// Ends whoever still runs: asks first, insists after a grace period.
    fn end(&mut self, inbox: &Receiver<Event>) {
        for signal in [Signal::TERM, Signal::KILL] {
            for (i, child) in self.children.iter().enumerate().filter(|(_, c)| c.running) {
                if let Some(pid) = Pid::from_raw(child.pid as i32) {
                    let _ = if self.plugins.contains(&i) {
                        kill_process_group(pid, signal)
                    } else {
                        kill_process(pid, signal)
                    };
                }
            }
            let deadline = Instant::now() + GRACE;
            while self.children.iter().any(|c| c.running) {
                match inbox.recv_deadline(deadline) {
                    Ok(Event::Ended { child, .. }) => self.children[child].running = false,
                    Ok(Event::Said { child, line }) => self.said(child, line),
                    Ok(Event::Line { .. }) => {}
                    Err(_) => break,
                }
            }
        }
    }
}

/// Reaps a child by its process id (its handle stays with the thread that started it).
fn wait_for(pid: u32) -> std::io::Result<ExitStatus> {
    use rustix::process::{WaitOptions, waitpid};
    let pid = Pid::from_raw(pid as i32);
    loop {
        match waitpid(pid, WaitOptions::empty()) {
            Ok(Some((_, status))) => return Ok(ExitStatus::from_raw(status.as_raw())),
            Ok(None) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
}

/// How a child failed, if it did.
fn describe_failure(status: &std::io::Result<ExitStatus>) -> Option<String> {
    match status {
        Ok(status) if status.success() => None,
        Ok(status) => Some(match (status.signal(), status.code()) {
            (Some(signal), _) => {
                let name = signal_hook::low_level::signal_name(signal).unwrap_or("unknown");
                format!("was killed by signal {signal} ({name})")
            }
            (None, Some(code)) => format!("ended with code {code}"),
            (None, None) => "ended in an unknown way".to_owned(),
        }),
        Err(error) => Some(format!("could not be waited for: {error}")),
    }
}

fn message(member: &Member, how: &str) -> String {
    let Member { name, pid, last_words, .. } = member;
    match last_words {
        Some(words) => format!("{name} (process {pid}) {how}: {}", words.trim_start_matches("cz: ")),
        None => format!("{name} (process {pid}) {how}"),
    }
}
