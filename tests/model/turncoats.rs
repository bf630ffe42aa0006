//! A sender that changes its frame after the world has judged it: what was judged is what is used.

use control_zones::lockstep::{Progress, WorldDriver, WorldPorts};
use control_zones::scenario::{Scenario, load};
use control_zones::transport::memory::MemoryService;
use control_zones::transport::{Frame, Inbox, TransportError};
use control_zones::world::World;
use ipc_schemas::{
    Assignment, FrameHeader, NO_ZONE, Role, STATE_LEFT, VERDICT_HELD, VehicleCommand, VehicleState,
    schema_hash,
};
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;

const RUN_ID: u64 = 5;

/// A frame that is another one whenever it is looked at anew, from the second look on.
#[derive(Debug)]
struct Turncoat<R> {
    headers: [FrameHeader; 2],
    records: [Vec<R>; 2],
    looked_at_header: Cell<bool>,
    looked_at_records: Cell<bool>,
}

impl<R: ipc_schemas::Record> Frame<R> for Turncoat<R> {
    fn header(&self) -> &FrameHeader {
        &self.headers[usize::from(self.looked_at_header.replace(true))]
    }

    fn records(&self) -> &[R] {
        &self.records[usize::from(self.looked_at_records.replace(true))]
    }
}

#[derive(Clone, Debug)]
struct Queue<R>(Rc<RefCell<VecDeque<Turncoat<R>>>>);

impl<R: ipc_schemas::Record> Inbox<R> for Queue<R> {
    type Frame = Turncoat<R>;

    fn receive(&mut self) -> Result<Option<Turncoat<R>>, TransportError> {
        Ok(self.0.borrow_mut().pop_front())
    }
}

impl<R: ipc_schemas::Record> Queue<R> {
    fn new() -> Queue<R> {
        Queue(Rc::default())
    }

    fn send(&self, role: Role, step: u64, good: Vec<R>, bad: Vec<R>) {
        let header = FrameHeader {
            run_id: RUN_ID,
            schema_hash: schema_hash(),
            step,
            record_count: good.len() as u32,
            sender_role: role as u16,
            ..FrameHeader::default()
        };
        let forged = FrameHeader { sender_index: u16::MAX, step: u64::MAX, ..header };
        self.0.borrow_mut().push_back(Turncoat {
            headers: [header, forged],
            records: [good, bad],
            looked_at_header: Cell::new(false),
            looked_at_records: Cell::new(false),
        });
    }
}

fn commands(world: &World, u_mps2: f64, planned_exit_time_s: f64) -> Vec<VehicleCommand> {
    let members = world.records().filter(|s| s.zone != NO_ZONE && s.flags & STATE_LEFT == 0);
    let command = |s: VehicleState| VehicleCommand {
        u_mps2,
        planned_exit_time_s,
        vehicle: s.vehicle,
        zone: s.zone,
        ..VehicleCommand::default()
    };
    members.map(command).collect()
}

fn scenario() -> Arc<Scenario> {
    Arc::new(load(Some("paper"), &["end.time_s=60".parse().unwrap()], None).unwrap())
}

/// Runs a world whose controller answers every step but each tenth, for which the world puts something in;
/// returns the state hash. What an honest controller and coordinator sent comes first; a second look would find
/// `lie`.
fn run(lie: impl Fn(&World) -> (Vec<VehicleCommand>, Vec<Assignment>)) -> (u64, Vec<VehicleCommand>) {
    let mut world = World::new(scenario(), 1);
    world.share_out(1);
    let (state, coordinator_state) = (MemoryService::new(), MemoryService::new());
    let (mut states, mut coordinator_states) = (state.tap(), coordinator_state.tap());
    let (command, coordination) = (Queue::<VehicleCommand>::new(), Queue::<Assignment>::new());
    let ports = WorldPorts {
        state: state.outbox(),
        coordinator_states: vec![coordinator_state.outbox()],
        command: command.clone(),
        coordination: Some(coordination.clone()),
    };
    let mut driver = WorldDriver::new(world, ports, RUN_ID, 1);
    let mut remembered = Vec::new();
    loop {
        match driver.advance().unwrap() {
            Progress::Finished => return (driver.world().state_hash(), remembered),
            Progress::Advanced if driver.is_between_steps() => continue,
            _ => {}
        }
        while states.receive().unwrap().is_some() || coordinator_states.receive().unwrap().is_some() {}
        let step = driver.world().step();
        let (bad_commands, bad_assignments) = lie(driver.world());
        if driver.was_event() {
            let good = vec![Assignment { zone: 1, ..Assignment::default() }];
            coordination.send(Role::Coordinator, step, good, bad_assignments);
        }
        let is_silent = step % 10 == 9;
        if !is_silent {
            let exit_time_s = step as f64;
            command.send(Role::Controller, step, commands(driver.world(), 0.5, exit_time_s), bad_commands);
        }
        while driver.world().step() == step {
            match driver.advance().unwrap() {
                Progress::Waiting(_) if is_silent => {
                    remembered = driver.handover(Role::Controller, 0).unwrap().commands;
                    assert!(driver.put_in(VERDICT_HELD).unwrap());
                }
                Progress::Finished => break,
                Progress::Waiting(awaited) => panic!("{awaited:?} at step {step}"),
                _ => {}
            }
        }
    }
}

/// Before, the world put in what it found in the frame of the step before, and a planned exit that had become
/// NaN by then was the end of it (`what the world puts in has each of the controller's vehicles once`).
#[test]
fn a_frame_that_changes_after_it_was_judged_changes_nothing() {
    let honest = run(|world| {
        (commands(world, 0.5, world.step() as f64), vec![Assignment { zone: 1, ..Assignment::default() }])
    });
    let false_zone = || vec![Assignment { zone: u32::MAX, ..Assignment::default() }];
    type Lie<'a> = &'a dyn Fn(&World) -> Vec<VehicleCommand>;
    let lies: [Lie<'_>; 4] = [
        &|world| commands(world, f64::NAN, f64::NAN),
        &|world| commands(world, 3.0, 1.0),
        &|_| Vec::new(),
        &|world| {
            let mut all = commands(world, 0.5, 0.0);
            all.iter_mut().for_each(|c| (c.vehicle, c.zone, c.verdict) = (u32::MAX, u32::MAX, u16::MAX));
            all
        },
    ];
    for lie in lies {
        assert_eq!(run(|world| (lie(world), false_zone())), honest);
    }
    assert!(!honest.1.is_empty());
}
