//! The conformance kit: a stranger's controller against a scripted world.
//!
//! World, coordinator and the built-in pool run in this process; only the controller under test is another
//! one. The script: an empty zone at first, vehicles that come and go, a world that pauses, a leader that
//! brakes to a stop, a restart in mid-run, steps that pass while the controller is stopped, and the end of the run. A bad frame is noted under the rule it
//! breaks and replaced, so that one fault does not hide the others.

use super::attach::{Readiness, Reception};
use super::services::MembersDesk;
use super::{ProcessError, WaitMode};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::lockstep::Handover;
use crate::scenario::Scenario;
use crate::transport::iox::{IoxFrame, IoxInbox, IoxOutbox, RunName, RunSpace, ServiceLimits};
use crate::transport::{Backlog, Frame, Inbox, Loan, Outbox};
use crate::world::{CommandFault, World};
use hdrhistogram::Histogram;
use ipc_schemas::{
    self as frames, Assignment, ExpectedHeader, FLAG_END_OF_RUN, FrameHeader, HeaderFault, Member, Role,
    VehicleCommand, VehicleState,
};
use rustix::process::{Pid, Signal, kill_process_group};
use serde::Serialize;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Name under which the controller under test attaches.
pub const CONTROLLER: &str = "plugin";
/// Its index: behind one built-in process.
const INDEX: u32 = 1;
/// Time after which an answer is no longer waited for.
const PATIENCE: Duration = Duration::from_secs(5);
/// How long it may take to join, and to end.
const JOIN: Duration = Duration::from_secs(15);
/// The script, in steps.
const PAUSE_AT: u64 = 300;
const BRAKE_FROM: u64 = 400;
const BRAKE_TO: u64 = 460;
const RESTART_AT: u64 = 600;
const STOP_AT: u64 = 750;
const GO_ON_AT: u64 = 780;
/// By this step it must have caught up.
const CAUGHT_UP_BY: u64 = 880;
/// How long each step waits for it meanwhile.
const CATCH_UP_STEP: Duration = Duration::from_millis(50);
const END_AT: u64 = 900;

/// A rule of `docs/plugin-contract.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)] // each is described by `text`
pub enum Rule {
    Attach,
    Schema,
    Run,
    Sender,
    Generation,
    Step,
    Count,
    OncePerStep,
    OwnVehicles,
    NoDuplicates,
    AllVehicles,
    Zone,
    Finite,
    Limits,
    Verdict,
    EmptyZone,
    Pause,
    HardBraking,
    Deadline,
    Alive,
    Restart,
    CatchUp,
    End,
}

impl Rule {
    /// All rules, in the order of the report.
    pub const ALL: [Rule; 23] = [
        Rule::Attach,
        Rule::Schema,
        Rule::Run,
        Rule::Sender,
        Rule::Generation,
        Rule::Step,
        Rule::Count,
        Rule::OncePerStep,
        Rule::OwnVehicles,
        Rule::NoDuplicates,
        Rule::AllVehicles,
        Rule::Zone,
        Rule::Finite,
        Rule::Limits,
        Rule::Verdict,
        Rule::EmptyZone,
        Rule::Pause,
        Rule::HardBraking,
        Rule::Deadline,
        Rule::Alive,
        Rule::Restart,
        Rule::CatchUp,
        Rule::End,
    ];

    /// What the rule asks for.
    pub fn text(self) -> &'static str {
        match self {
            Rule::Attach => "joins the run and says ready",
            Rule::Schema => "has the schema of this version (schema_hash)",
            Rule::Run => "answers for this run (run_id)",
            Rule::Sender => "sends as the controller it was let in as (sender_role, sender_index)",
            Rule::Generation => "carries the generation it was given (generation)",
            Rule::Step => "answers the step it was asked (step)",
            Rule::Count => "announces as many records as it sends (record_count)",
            Rule::OncePerStep => "answers each step once",
            Rule::OwnVehicles => "commands only its own vehicles (vehicle)",
            Rule::NoDuplicates => "commands no vehicle twice (vehicle)",
            Rule::AllVehicles => "commands all its vehicles, in frame order (vehicle)",
            Rule::Zone => "names the vehicle's zone (zone)",
            Rule::Finite => "sends numbers (u_mps2, planned exit)",
            Rule::Limits => "keeps the vehicles' limits (u_mps2)",
            Rule::Verdict => "gives a verdict from 0 to 3 (verdict)",
            Rule::EmptyZone => "answers steps without vehicles",
            Rule::Pause => "waits for a world that pauses",
            Rule::HardBraking => "goes on while a leader brakes to a stop",
            Rule::Deadline => "answers within the deadline, but for one step in a hundred",
            Rule::Alive => "stays alive and answers every step",
            Rule::Restart => "joins again after being killed, and goes on from there",
            Rule::CatchUp => "goes on with the step at hand after steps have passed without it",
            Rule::End => "ends with code 0 when the run does",
        }
    }
}

/// The first breach of a rule, and how many there were.
#[derive(Clone, Debug, Serialize)]
pub struct Breach {
    /// The rule.
    pub rule: Rule,
    /// Step of the first.
    pub step: u64,
    /// What was wrong with it.
    pub what: String,
    /// Number of steps in which it was broken.
    pub count: u64,
}

/// What a check has found.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Rules broken.
    pub breaches: Vec<Breach>,
    /// Rules that could not be tried, because the controller had gone.
    pub untried: Vec<Rule>,
    /// Steps answered.
    pub answered: u64,
    /// Answer times, us: median, 99th percentile, 99.9th, greatest.
    pub latency_us: [f64; 4],
}

/// Checks a command line. `scenario` has one plug-in called [`CONTROLLER`].
pub fn check(
    scenario: &Arc<Scenario>,
    command: &[String],
    deadline: Duration,
) -> Result<Report, ProcessError> {
    let run: RunName = format!("check-{}", std::process::id()).parse().expect("letters, a dash and digits");
    let space = RunSpace::enter(&run)?;
    let limits = |publishers, subscribers| {
        let backlog = Backlog::STEPS;
        ServiceLimits { publishers, subscribers, nodes: 6, backlog }
    };
    let state = space.create(frames::SERVICE_STATE, limits(1, 3))?;
    let coordination = space.create(frames::SERVICE_COORDINATION, limits(1, 3))?;
    let commands = space.create(frames::SERVICE_COMMAND, limits(3, 1))?;
    let members = space.create(frames::SERVICE_MEMBERS, MembersDesk::limits(3, 6))?;
    let run_id = 0x636f_6e66_6f72_6d00 | u64::from(std::process::id() & 0xff);
    let mut world = World::new(scenario.clone(), 1);
    world.share_out(INDEX + 1);
    let zones = 0..scenario.network.zones.len() as u32;
    let mut kit = Kit {
        reception: Reception::open(&space, scenario, run_id, (1, INDEX + 1), WaitMode::Hybrid)?,
        state: state.outbox(256)?,
        coordination: coordination.outbox(512)?,
        commands: commands.inbox()?,
        members: MembersDesk::open(&members, run_id)?,
        coordinator: Coordinator::new(scenario.clone(), zones.clone()),
        in_force: zones.clone().map(|_| Vec::new()).collect(),
        pool: ControllerPool::new(scenario.clone(), zones),
        space: &space,
        world,
        run_id,
        deadline,
        latency_ns: Histogram::new(3).expect("three significant digits are valid"),
        breaches: Vec::new(),
        answered: 0,
        command,
        run: &run,
        child: None,
    };
    let finished = kit.drive();
    kit.stop();
    finished?;
    // One late answer in a hundred is the machine's.
    let answered = kit.answered;
    kit.breaches.retain(|b| b.rule != Rule::Deadline || b.count * 100 > answered);
    let tried = |rule: &Rule| kit.breaches.iter().any(|b| b.rule == *rule) || kit.was_tried(*rule);
    let us = |q: f64| kit.latency_ns.value_at_quantile(q) as f64 / 1e3;
    Ok(Report {
        untried: Rule::ALL.into_iter().filter(|r| !tried(r)).collect(),
        answered: kit.answered,
        latency_us: [us(0.5), us(0.99), us(0.999), kit.latency_ns.max() as f64 / 1e3],
        breaches: kit.breaches,
    })
}

struct Kit<'a> {
    space: &'a RunSpace,
    reception: Reception,
    state: IoxOutbox<VehicleState>,
    coordination: IoxOutbox<Assignment>,
    commands: IoxInbox<VehicleCommand>,
    members: MembersDesk,
    coordinator: Coordinator,
    /// By zone.
    in_force: Vec<Vec<Assignment>>,
    pool: ControllerPool,
    world: World,
    run_id: u64,
    deadline: Duration,
    latency_ns: Histogram<u64>,
    breaches: Vec<Breach>,
    answered: u64,
    command: &'a [String],
    run: &'a RunName,
    child: Option<Child>,
}

impl Kit<'_> {
    fn breach(&mut self, rule: Rule, what: String) {
        let step = self.world.step();
        match self.breaches.iter_mut().find(|b| b.rule == rule) {
            Some(known) => known.count += 1,
            None => self.breaches.push(Breach { rule, step, what, count: 1 }),
        }
    }

    /// Whether the script has come far enough to try a rule.
    fn was_tried(&self, rule: Rule) -> bool {
        let step = self.world.step();
        match rule {
            Rule::Attach | Rule::Schema => true,
            Rule::Pause => step > PAUSE_AT,
            Rule::HardBraking => step >= BRAKE_TO,
            Rule::Restart => step > RESTART_AT,
            Rule::CatchUp => step > GO_ON_AT,
            Rule::End => step >= END_AT,
            _ => self.answered > 0,
        }
    }

    fn start(&mut self) -> Result<(), ProcessError> {
        let child = Command::new(&self.command[0])
            .args(&self.command[1..])
            .env("CZ_RUN", self.run.to_string())
            .env("CZ_CONTROLLER", CONTROLLER)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .process_group(0)
            .spawn();
        match child {
            Ok(child) => self.child = Some(child),
            Err(error) => self.breach(Rule::Attach, format!("cannot be started: {error}")),
        }
        Ok(())
    }

    /// Ends the controller, and whatever it started.
    fn stop(&mut self) {
        if let Some(mut child) = self.child.take() {
            if let Some(group) = Pid::from_raw(child.id() as i32) {
                let _ = kill_process_group(group, Signal::KILL);
            }
            let _ = child.wait();
        }
    }

    /// How the controller has ended, if it has.
    fn ended(&mut self) -> Option<String> {
        let status = self.child.as_mut()?.try_wait().ok()??;
        Some(format!("it ended: {status}"))
    }

    /// Waits for the controller to join and say ready.
    fn admit(&mut self, rule: Rule) -> Result<bool, ProcessError> {
        let deadline = Instant::now() + JOIN;
        while !self.reception.is_ready(INDEX as usize) {
            self.hand_over(None)?;
            if let Some(reason) = self.reception.last_refusal.take() {
                let rule = if reason.contains("schema") { Rule::Schema } else { rule };
                self.breach(rule, format!("attach request refused: {reason}"));
                return Ok(false);
            }
            let late = (Instant::now() >= deadline).then(|| format!("not ready after {} s", JOIN.as_secs()));
            if let Some(how) = self.ended().or(late) {
                self.breach(rule, how);
                return Ok(false);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        // The coordinator is in this process, and so is its sending end.
        let own =
            Member { process_id: std::process::id(), role: frames::ROLE_COORDINATOR, ..Member::default() };
        self.members.tell(self.world.step(), [own].into_iter())?;
        Ok(true)
    }

    /// Answers whoever asks what is in force; a state that has been sent has all its coordination.
    fn hand_over(&mut self, sent: Option<FrameHeader>) -> Result<(), ProcessError> {
        let Kit { reception, in_force, world, .. } = self;
        reception.serve(&mut |_, _, _| {
            let (step, in_force) = (world.step(), in_force.concat());
            Readiness::Now(Box::new(Handover { step, header: sent, in_force, ..Handover::default() }))
        })?;
        Ok(())
    }

    fn drive(&mut self) -> Result<(), ProcessError> {
        self.start()?;
        if self.child.is_none() || !self.admit(Rule::Attach)? {
            return Ok(());
        }
        let mut states = Vec::new();
        while self.world.step() < END_AT {
            let step = self.world.step();
            if step == RESTART_AT {
                self.stop();
                self.space.sweep_dead();
                // What it had sent, if anything, is of the past.
                while self.commands.receive()?.is_some() {}
                self.reception.vacate(INDEX as usize);
                self.reception.go_on_from(step);
                self.start()?;
                if !self.admit(Rule::Restart)? {
                    return Ok(());
                }
            }
            if step == PAUSE_AT {
                std::thread::sleep(Duration::from_millis(1500));
                if let Some(how) = self.ended() {
                    self.breach(Rule::Pause, how);
                    return Ok(());
                }
            }
            if step == STOP_AT {
                if !self.leave_behind(&mut states)? {
                    return Ok(());
                }
                continue;
            }
            states.clear();
            states.extend(self.world.records());
            let sent = self.publish(&states)?;
            if !self.answer(&states, sent)? {
                return Ok(());
            }
        }
        self.finish()
    }

    /// Goes on for a while without the controller, which is stopped, and then waits a little at each step until
    /// it answers the one at hand. `false` when there is no point in going on.
    fn leave_behind(&mut self, states: &mut Vec<VehicleState>) -> Result<bool, ProcessError> {
        self.signal(Signal::STOP);
        loop {
            let step = self.world.step();
            if step == GO_ON_AT {
                self.signal(Signal::CONT);
            }
            states.clear();
            states.extend(self.world.records());
            let sent = self.publish(states)?;
            let header = self.header(Role::World, step);
            while step >= GO_ON_AT && sent.elapsed() < CATCH_UP_STEP {
                self.hand_over(Some(header))?;
                match self.commands.receive()? {
                    Some(frame) if frame.header().step == step => {
                        self.take(frame, states)?;
                        return Ok(true);
                    }
                    // Late.
                    Some(_) => {}
                    None => std::thread::sleep(Duration::from_micros(100)),
                }
                if let Some(how) = self.ended() {
                    self.breach(Rule::CatchUp, how);
                    return Ok(false);
                }
            }
            if step == CAUGHT_UP_BY {
                self.breach(Rule::CatchUp, format!("it answered no step at hand from step {GO_ON_AT} on"));
                return Ok(false);
            }
            let substitute = self.substitute(states);
            self.world.command(INDEX, &substitute).expect("the substitute is as it should be");
            self.world.advance().expect("all vehicles have been commanded");
        }
    }

    /// Stops the controller, and whatever it started, or lets them go on.
    fn signal(&self, signal: Signal) {
        let id = self.child.as_ref().and_then(|child| Pid::from_raw(child.id() as i32));
        if let Some(group) = id {
            // If it has ended, that is noticed soon enough.
            let _ = kill_process_group(group, signal);
        }
    }

    /// Plays world and coordinator for one step, and decides for the built-in pool.
    fn publish(&mut self, states: &[VehicleState]) -> Result<Instant, ProcessError> {
        let step = self.world.step();
        let masks = self.world.coordinator_masks();
        let header = self.header(Role::World, step);
        let sent = Instant::now();
        let header = FrameHeader { coordinators_acting: masks.acting, ..header };
        let fill = states.iter().copied();
        self.state.loan(header, states.len(), |s| fill.for_each(|r| s.push(r)))?.send()?;
        if masks.acting != 0 {
            self.coordinator.act(step, states);
            let assignments = self.coordinator.assignments();
            // Both come from this process, so they cannot contradict each other.
            self.pool.coordinate(states, assignments).expect("our own coordination fits our own state");
            for group in assignments.chunk_by(|a, b| a.zone == b.zone) {
                self.in_force[group[0].zone as usize] = group.to_vec();
            }
            let header = FrameHeader { sender_role: Role::Coordinator as u16, ..header };
            let fill = assignments.iter().copied();
            self.coordination.loan(header, assignments.len(), |s| fill.for_each(|r| s.push(r)))?.send()?;
        }
        let mut own = Vec::new();
        let time_s = self.world.time_ns() as f64 * 1e-9;
        self.pool.command(time_s, states, |c| own.push(c)).expect("our own coordination fits our own state");
        if (BRAKE_FROM..BRAKE_TO).contains(&step) {
            // Whoever is about to become a leader in the controller's zone brakes as hard as it can.
            own.iter_mut().for_each(|c| c.u_mps2 = -4.0);
        }
        self.world.command(0, &own).expect("the built-in pool answers as it should");
        Ok(sent)
    }

    fn header(&self, role: Role, step: u64) -> FrameHeader {
        FrameHeader {
            run_id: self.run_id,
            schema_hash: frames::schema_hash(),
            step,
            time_ns: self.world.time_ns(),
            sender_role: role as u16,
            ..FrameHeader::default()
        }
    }

    /// What the kit puts in for the controller: accelerations of 0.
    fn substitute(&self, states: &[VehicleState]) -> Vec<VehicleCommand> {
        let drivers = self.world.drivers();
        let is_own = |s: &&VehicleState| {
            s.zone != frames::NO_ZONE
                && s.flags & frames::STATE_LEFT == 0
                && drivers.of(s.zone, s.path) == INDEX
        };
        let own = states.iter().filter(is_own);
        own.map(|s| VehicleCommand { vehicle: s.vehicle, zone: s.zone, ..VehicleCommand::default() })
            .collect()
    }

    /// Waits for the controller's answer, and takes it. `false` when there is no point in going on.
    fn answer(&mut self, states: &[VehicleState], sent: Instant) -> Result<bool, ProcessError> {
        let step = self.world.step();
        let substitute = self.substitute(states);
        let rule = match (step, substitute.is_empty()) {
            (PAUSE_AT, _) => Rule::Pause,
            (BRAKE_FROM..BRAKE_TO, _) => Rule::HardBraking,
            (_, true) => Rule::EmptyZone,
            _ => Rule::Alive,
        };
        let frame = loop {
            if let Some(frame) = self.commands.receive()? {
                break frame;
            }
            let waited = sent.elapsed();
            if waited >= PATIENCE {
                self.breach(rule, format!("no answer within {} s", PATIENCE.as_secs()));
                return Ok(false);
            }
            if waited.as_millis() >= 2 {
                if let Some(how) = self.ended() {
                    self.breach(Rule::Alive, how);
                    return Ok(false);
                }
                std::thread::sleep(Duration::from_micros(50));
            } else {
                std::thread::yield_now();
            }
        };
        let took = sent.elapsed();
        let _ = self.latency_ns.record(took.as_nanos() as u64);
        self.answered += 1;
        if took > self.deadline {
            let ms = |d: Duration| d.as_secs_f64() * 1e3;
            self.breach(
                Rule::Deadline,
                format!("took {:.1} ms, allowed are {:.1}", ms(took), ms(self.deadline)),
            );
        }
        self.take(frame, states)?;
        Ok(true)
    }

    /// Takes the controller's answer, or replaces it.
    fn take(&mut self, frame: IoxFrame<VehicleCommand>, states: &[VehicleState]) -> Result<(), ProcessError> {
        let step = self.world.step();
        let substitute = self.substitute(states);
        let generation = self.reception.generation(INDEX as usize);
        let index = INDEX as u16;
        let expected =
            ExpectedHeader { run_id: self.run_id, role: Role::Controller, index, generation, step };
        let header = expected.check(frame.header(), frame.records().len());
        let mut records = frame.records().to_vec();
        drop(frame);
        // A second frame would be taken for the answer to the next step.
        std::thread::yield_now();
        while let Some(extra) = self.commands.receive()? {
            let step = extra.header().step;
            drop(extra);
            self.breach(Rule::OncePerStep, format!("a second frame, with step {step} in its header"));
        }
        if let Err(fault) = header {
            let rule = match fault {
                HeaderFault::OtherSchema { .. } => Rule::Schema,
                HeaderFault::OtherRun { .. } => Rule::Run,
                HeaderFault::OtherSender { .. } => Rule::Sender,
                HeaderFault::OldGeneration { .. } | HeaderFault::UnknownGeneration { .. } => Rule::Generation,
                HeaderFault::OtherStep { .. } => Rule::Step,
                HeaderFault::OtherCount { .. } => Rule::Count,
            };
            self.breach(rule, fault.to_string());
            records.clone_from(&substitute);
        }
        if let Err(fault) = self.world.command(INDEX, &records) {
            let rule = match fault {
                CommandFault::UnknownVehicle { .. } | CommandFault::ForeignVehicle { .. } => {
                    Rule::OwnVehicles
                }
                CommandFault::Duplicate { .. } => Rule::NoDuplicates,
                CommandFault::MissingVehicle { .. } => Rule::AllVehicles,
                CommandFault::OtherZone { .. } => Rule::Zone,
                CommandFault::NotFinite { .. } | CommandFault::BadIntent { .. } => Rule::Finite,
                CommandFault::OutOfLimits { .. } => Rule::Limits,
                CommandFault::BadVerdict { .. } => Rule::Verdict,
            };
            self.breach(rule, fault.to_string());
            self.world.forget_commands();
            let mut all = substitute;
            std::mem::swap(&mut records, &mut all);
            // The built-in pool's commands were forgotten with the bad ones.
            let mut own = Vec::new();
            let time_s = self.world.time_ns() as f64 * 1e-9;
            self.pool.command(time_s, states, |c| own.push(c)).expect("it has answered this step before");
            self.world.command(0, &own).expect("the built-in pool answers as it should");
            self.world.command(INDEX, &records).expect("the substitute is as it should be");
        }
        self.world.advance().expect("all vehicles have been commanded");
        Ok(())
    }

    /// Says that the run is over, and waits for the controller to end.
    fn finish(&mut self) -> Result<(), ProcessError> {
        let header = FrameHeader { flags: FLAG_END_OF_RUN, ..self.header(Role::World, self.world.step()) };
        self.state.loan(header, 0, |_| {})?.send()?;
        let deadline = Instant::now() + JOIN;
        loop {
            let status = self.child.as_mut().and_then(|c| c.try_wait().ok().flatten());
            match status {
                Some(status) if status.success() => return Ok(()),
                Some(status) => {
                    self.breach(Rule::End, format!("it ended with {status}"));
                    return Ok(());
                }
                None if Instant::now() >= deadline => {
                    self.breach(Rule::End, format!("still there after {} s", JOIN.as_secs()));
                    return Ok(());
                }
                None => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }
}
