//! Frames from other processes through the checks their receivers make: a frame that is refused changes
//! nothing that decides where vehicles drive, one that is accepted leaves finite numbers.

#![no_main]

mod common;

use common::{Bytes, RUN, reader};
use control_zones::control::ControllerPool;
use control_zones::record::replay_world;
use control_zones::scenario::share::zones_of;
use ipc_schemas::{ExpectedHeader, FrameHeader, Role, bytes_of};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut input = Bytes(bytes);
    match input.byte() % 3 {
        0 => header(&mut input),
        1 => command(&mut input),
        _ => coordination(&mut input),
    }
});

fn header(input: &mut Bytes<'_>) {
    let step = &RUN.1[10];
    let mut headers = vec![FrameHeader { sender_role: Role::Controller as u16, ..step.header }];
    while !input.is_empty() && headers.len() == 1 {
        let fields = input.0.len();
        if fields < 4 {
            break;
        }
        input.spoil(&mut headers);
    }
    let expected = ExpectedHeader {
        run_id: step.header.run_id,
        role: Role::Controller,
        index: 0,
        generation: 0,
        step: step.header.step,
    };
    for header in headers {
        let records = header.record_count as usize;
        if expected.check(&header, records).is_ok() {
            assert_eq!((header.run_id, header.step), (expected.run_id, expected.step));
            assert_eq!((header.sender_role, header.sender_index), (Role::Controller as u16, 0));
            assert_eq!((header.schema_hash, header.generation), (ipc_schemas::schema_hash(), 0));
        }
        assert!(expected.check(&header, records.wrapping_add(1)).is_err());
    }
}

fn command(input: &mut Bytes<'_>) {
    let at = input.index(RUN.1.len() - 1);
    let (step, next) = (&RUN.1[at], &RUN.1[at + 1]);
    let mut world = replay_world(&reader(), at as u64).expect("our own recording replays");
    world.coordinator_masks();
    let sender = input.index(2);
    let mut commands = step.commands[sender].records.clone();
    while !input.is_empty() {
        input.spoil(&mut commands);
    }
    let result = world.command(sender as u32, &commands);
    let states: Vec<_> = world.records().collect();
    // Only what vehicles say of their plans may have been taken over by then.
    for (now, then) in states.iter().zip(&step.state) {
        assert_eq!(
            (now.x_m, now.v_mps, now.vehicle, now.zone),
            (then.x_m, then.v_mps, then.vehicle, then.zone)
        );
    }
    if result.is_err() {
        // Refused: with the right commands the world goes where it went.
        world.forget_commands();
        world.command(sender as u32, &step.commands[sender].records).expect("the recorded commands are good");
    }
    let other = 1 - sender;
    world.command(other as u32, &step.commands[other].records).expect("the recorded commands are good");
    world.advance().expect("all vehicles have a command");
    world.coordinator_masks();
    let after: Vec<_> = world.records().collect();
    if result.is_err() {
        assert_eq!(bytes_of(&after), bytes_of(&next.state), "a refused frame left its mark");
    }
    assert!(after.iter().all(|s| s.x_m.is_finite() && s.v_mps.is_finite() && s.v_mps >= 0.0));
}

fn coordination(input: &mut Bytes<'_>) {
    let at = input.index(RUN.1.len() - 1);
    let scenario = reader().scenario().clone();
    let zones = scenario.network.zones.len() as u32;
    let mut pool = ControllerPool::new(scenario, zones_of(zones, 0, 1));
    for step in &RUN.1[..at] {
        pool.coordinate(&step.state, &step.coordination).expect("the recorded assignments are good");
        pool.command(step.header.time_ns as f64 * 1e-9, &step.state, |_| {}).expect("all are assigned");
    }
    let step = &RUN.1[at];
    let mut assignments = step.coordination.clone();
    while !input.is_empty() {
        input.spoil(&mut assignments);
    }
    if pool.coordinate(&step.state, &assignments).is_ok() {
        let time_s = step.header.time_ns as f64 * 1e-9;
        let _ = pool.command(time_s, &step.state, |command| {
            assert!((-4.0..=4.0).contains(&command.u_mps2), "{command:?}");
        });
    }
}
