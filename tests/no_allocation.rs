//! The hot path allocates nothing: a steady step, all roles together, over both transports.
//!
//! iceoryx2 0.10 makes one small reference-counted handle of its own for each loan; over shared memory
//! that is all there may be.

#![allow(clippy::unwrap_used)] // a test fails by panicking

use control_zones::control::ControllerPool;
use control_zones::coordination::Coordinator;
use control_zones::lockstep::in_process::InProcess;
use control_zones::lockstep::{
    ControllerDriver, ControllerPorts, CoordinatorDriver, CoordinatorPorts, Identity, Members, Progress,
    Seat, WorldDriver, WorldPorts,
};
use control_zones::scenario::{Override, Scenario, load};
use control_zones::transport::iox::{IoxOutbox, RunSpace, ServiceLimits};
use control_zones::transport::{Backlog, Loan, Outbox, Slots};
use control_zones::world::World;
use ipc_schemas::{self as frames, Assignment, Member, Role, VehicleCommand, VehicleState, ZoneSummary};
use std::ops::Range;
use std::sync::Arc;

/// Light traffic, so that there are many steps without events.
fn scenario() -> Arc<Scenario> {
    let set: Vec<Override> = ["end.vehicles=400"].iter().map(|s| s.parse().unwrap()).collect();
    Arc::new(load(Some("varying-demand"), &set, Some(1)).unwrap())
}

/// Steps after which every buffer has grown to what the run needs.
const WARM_UP: u64 = 6_000;

/// The state frame and the command frame.
const LOANS_PER_STEP: u64 = 2;

/// Counts steady steps and asserts that they allocated nothing of ours.
///
/// A vehicle that arrives or crosses while a step is integrated makes an event of the next one; growing
/// the lists for it is part of that event. So a step is judged once it is known that neither it nor the
/// next has an event. One that arrives and has to wait outside makes no event, but the queue of its road may grow.
struct Judge {
    allowed: u64,
    last: Option<(u64, u64)>,
    steady: u32,
    /// Arrivals that have had to wait.
    held: u32,
}

impl Judge {
    fn new(allowed: u64) -> Judge {
        Judge { allowed, last: None, steady: 0, held: 0 }
    }

    fn step(&mut self, world: &World, step: u64, was_event: bool, allocations: u64) {
        let held = world.summary().held_arrivals;
        let came = std::mem::replace(&mut self.held, held) != held;
        if let (Some((step, allocations)), false) = (self.last, was_event) {
            self.steady += 1;
            assert_eq!(allocations, self.allowed, "allocations in steady step {step}");
        }
        self.last = (!was_event && !came && step > WARM_UP).then_some((step, allocations));
    }

    fn finish(&self) {
        assert!(self.steady >= 5_000, "only {} steady steps were seen", self.steady);
    }
}

#[test]
fn steady_steps_in_one_process_allocate_nothing() {
    in_one_process(&scenario());
}

/// Among humans.
#[test]
fn steady_steps_among_humans_allocate_nothing() {
    let human = "{name=\"human\",driver=\"human\",noise_mps2=0.3}";
    let sets = [
        "end.vehicles=400".to_owned(),
        format!("fleet=[{{name=\"automated\"}},{human}]"),
        "roads.*.automated=0.5".to_owned(),
    ];
    let sets: Vec<Override> = sets.iter().map(|s| s.parse().unwrap()).collect();
    in_one_process(&Arc::new(load(Some("varying-demand"), &sets, Some(1)).unwrap()));
}

fn in_one_process(scenario: &Arc<Scenario>) {
    let mut run = InProcess::new(scenario, 1, 1);
    let (mut judge, mut more) = (Judge::new(0), true);
    while more {
        let step = run.world().step();
        let measured = allocation_counter::measure(|| more = run.step().unwrap());
        judge.step(run.world(), step, run.was_event(), measured.count_total);
    }
    judge.finish();
}

#[test]
fn steady_steps_over_shared_memory_allocate_nothing() {
    let scenario = scenario();
    let run = format!("alloc-{}", std::process::id()).parse().unwrap();
    let space = RunSpace::enter(&run).unwrap();
    let limits = ServiceLimits { publishers: 1, subscribers: 1, nodes: 1, backlog: Backlog::STEPS };
    let state = space.create::<VehicleState>(frames::SERVICE_STATE, limits).unwrap();
    let coordinator_state = space.create::<VehicleState>("cz/coordinator-state/0", limits).unwrap();
    let both = ServiceLimits { subscribers: 2, ..limits };
    let coordination = space.create::<Assignment>(frames::SERVICE_COORDINATION, both).unwrap();
    let summaries = space.create::<ZoneSummary>("cz/summary/0", limits).unwrap();
    let command = space.create::<VehicleCommand>(frames::SERVICE_COMMAND, limits).unwrap();
    // Everybody's word is checked, as in a run of several processes.
    let told = ServiceLimits { backlog: Backlog::Last, ..both };
    let members = space.create::<Member>(frames::SERVICE_MEMBERS, told).unwrap();
    let own = std::process::id();
    let zones = 0..scenario.network.zones.len() as u32;
    let identity = |role| Identity { run_id: 7, role, index: 0, generation: 0 };
    let neighbours: Vec<(u16, Range<u32>, IoxOutbox<ZoneSummary>)> = Vec::new();
    let mut coordinator = CoordinatorDriver::new(
        Coordinator::new(scenario.clone(), zones.clone()),
        CoordinatorPorts {
            state: coordinator_state.inbox().unwrap(),
            summaries: summaries.inbox().unwrap(),
            neighbours,
            coordination: coordination.outbox(256).unwrap(),
            members: Members::told_by(own, members.inbox().unwrap()),
        },
        identity(Role::Coordinator),
    );
    let mut controller = ControllerDriver::new(
        ControllerPool::new(scenario.clone(), zones),
        ControllerPorts {
            state: state.inbox().unwrap(),
            coordination: coordination.inbox().unwrap(),
            command: command.outbox(256).unwrap(),
            members: Members::told_by(own, members.inbox().unwrap()),
        },
        identity(Role::Controller),
        0,
    );
    let ports = WorldPorts {
        state: state.outbox(256).unwrap(),
        coordinator_states: vec![coordinator_state.outbox(256).unwrap()],
        command: command.inbox().unwrap(),
        // As in a run in which processes may be replaced.
        coordination: Some(coordination.inbox().unwrap()),
    };
    let mut world = WorldDriver::new(World::new(scenario.clone(), 1), ports, 7, 1);
    world.seat(Role::Coordinator, 0, Seat::new(0, own));
    world.seat(Role::Controller, 0, Seat::new(0, own));
    let mut outbox = members.outbox(2).unwrap();
    let told: Vec<Member> = world.members().collect();
    let header = Identity { index: 0, ..identity(Role::World) }.header(0, 0);
    let fill = |slots: &mut Slots<'_, Member>| told.iter().for_each(|m| slots.push(*m));
    outbox.loan(header, told.len(), fill).unwrap().send().unwrap();
    let (mut judge, mut finished) = (Judge::new(LOANS_PER_STEP), false);
    while !finished {
        let step = world.world().step();
        let measured = allocation_counter::measure(|| {
            while world.world().step() == step && !finished {
                finished = world.advance().unwrap() == Progress::Finished;
                while coordinator.advance().unwrap() == Progress::Advanced {}
                while controller.advance().unwrap() == Progress::Advanced {}
            }
        });
        judge.step(world.world(), step, world.was_event(), measured.count_total);
    }
    judge.finish();
    assert_eq!(world.world().state_hash(), {
        let mut same = InProcess::new(&scenario, 1, 1);
        same.run().unwrap();
        same.world().state_hash()
    });
}
