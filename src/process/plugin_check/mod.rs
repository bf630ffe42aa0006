//! The conformance kit: a stranger's controller against a scripted world.
//!
//! World, coordinator and the built-in pool run in this process; only the controller under test is another
//! one. The script: an empty zone at first, vehicles that come and go, a world that pauses, a leader that
//! brakes to a stop, all that a controller can be told of its answers, a restart in mid-run, steps that pass while the controller is stopped, and the end of the run. A bad frame is noted under the rule it
//! breaks and replaced, so that one fault does not hide the others.

mod answers;
mod child;
mod rules;
mod told;

pub use rules::{Breach, Report, Rule};

use super::attach::{Readiness, Reception};
use super::plugin_child::PluginChild;
use super::services::{MembersOutbox, create_feedback};
use super::{ProcessError, WaitMode};
use crate::control::ControllerPool;
use crate::coordination::Coordinator;
use crate::lockstep::Handover;
use crate::scenario::{Scenario, ScenarioError, load_given};
use crate::transport::iox::{IoxInbox, IoxOutbox, RunName, RunSpace, ServiceLimits};
use crate::transport::{Backlog, Frame, Inbox, Loan, Outbox};
use crate::world::World;
use hdrhistogram::Histogram;
use ipc_schemas::{
    self as frames, Assignment, FLAG_END_OF_RUN, Feedback, FrameHeader, Role, VehicleCommand, VehicleState,
};
use rustix::process::Signal;
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
/// Whatever can be said of answers is said meanwhile.
const TELL_FROM: u64 = 500;
const TELL_TO: u64 = 560;
const RESTART_AT: u64 = 600;
const STOP_AT: u64 = 750;
const GO_ON_AT: u64 = 780;
/// By this step it must have caught up.
const CAUGHT_UP_BY: u64 = 880;
/// How long each step waits for it meanwhile.
const CATCH_UP_STEP: Duration = Duration::from_millis(50);
const END_AT: u64 = 900;

/// Where the script plays: behind a merge a junction, which the controller drives, with merges, a crossing, lanes
/// that part, and several duties per vehicle.
pub fn scenario() -> Result<Scenario, ScenarioError> {
    let controllers = format!("controllers=[{{name=\"{CONTROLLER}\", zones=[\"junction\"]}}]");
    load_given(include_str!("junction.toml"), Vec::new(), &[controllers.parse()?], None)
}

/// Checks a command line in a scenario with one plug-in, called [`CONTROLLER`].
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
    let members = space.create(frames::SERVICE_MEMBERS, MembersOutbox::limits(3, 6))?;
    let feedback = create_feedback(&space, INDEX)?;
    let run_id = 0x636f_6e66_6f72_6d00 | u64::from(std::process::id() & 0xff);
    let mut world = World::new(scenario.clone(), 1);
    world.share_out(INDEX + 1);
    let zones = 0..scenario.network.zones.len() as u32;
    let mut kit = Kit {
        reception: Reception::open(&space, scenario, run_id, (1, INDEX + 1), WaitMode::Hybrid)?,
        state: state.outbox(256)?,
        coordination: coordination.outbox(512)?,
        commands: commands.inbox()?,
        feedback: feedback.outbox(16)?,
        members: MembersOutbox::open(&members, run_id)?,
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
        commanded: Vec::new(),
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
    feedback: IoxOutbox<Feedback>,
    members: MembersOutbox,
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
    /// The controller's commands of the step before, as they were taken.
    commanded: Vec<VehicleCommand>,
    command: &'a [String],
    run: &'a RunName,
    child: Option<PluginChild>,
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
            Rule::Feedback => step > TELL_TO,
            Rule::Restart => step > RESTART_AT,
            Rule::CatchUp => step > GO_ON_AT,
            Rule::End => step >= END_AT,
            _ => self.answered > 0,
        }
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
        self.start();
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
                self.start();
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
            self.commanded.clear();
            self.world.command(INDEX, &substitute).expect("the substitute is as it should be");
            self.world.advance().expect("all vehicles have been commanded");
        }
    }

    /// Plays world and coordinator for one step, and decides for the built-in pool.
    fn publish(&mut self, states: &[VehicleState]) -> Result<Instant, ProcessError> {
        let step = self.world.step();
        let masks = self.world.coordinator_masks();
        let header = self.header(Role::World, step);
        self.tell_bounds(states)?;
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

    /// Says that the run is over, and waits for the controller to end.
    fn finish(&mut self) -> Result<(), ProcessError> {
        let header = FrameHeader { flags: FLAG_END_OF_RUN, ..self.header(Role::World, self.world.step()) };
        self.state.loan(header, 0, |_| {})?.send()?;
        let deadline = Instant::now() + JOIN;
        loop {
            let status = self.child.as_mut().and_then(PluginChild::ended);
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::lockstep::in_process::InProcess;
    use std::collections::BTreeSet;

    #[test]
    fn a_vehicle_of_the_controller_has_duties_of_every_kind_at_several_points() {
        let scenario = Arc::new(scenario().unwrap());
        assert_eq!(scenario.plugins[0].paths.iter().map(|(zone, _)| *zone).collect::<Vec<_>>(), [1; 5]);
        let mut run = InProcess::observed(&scenario, 1, 1);
        let (mut busiest, mut kinds) = (0, BTreeSet::new());
        let mut is_empty = 0;
        for _ in 0..END_AT {
            assert!(run.step().unwrap());
            run.frames(|frames| {
                is_empty += u64::from(!frames.state.iter().any(|s| s.zone == 1));
                let own = frames.coordination.iter().flat_map(|part| part.iter()).filter(|a| a.zone == 1);
                let own: Vec<&Assignment> = own.collect();
                for duties in own.chunk_by(|a, b| a.vehicle == b.vehicle) {
                    let points: BTreeSet<u32> =
                        duties.iter().map(|a| a.point).filter(|point| *point != frames::NO_POINT).collect();
                    busiest = busiest.max(points.len());
                    kinds.extend(duties.iter().map(|a| a.kind));
                }
            })
            .unwrap();
        }
        println!("{busiest} points, kinds {kinds:?}, {is_empty} empty steps");
        assert!(busiest >= 3, "{busiest}");
        for kind in [frames::CONSTRAINT_REAR_END, frames::CONSTRAINT_MERGE, frames::CONSTRAINT_CROSS] {
            assert!(kinds.contains(&kind), "{kind}");
        }
        assert!(is_empty > 10, "{is_empty}");
    }
}
