//! Requests to attach from anybody: whoever is refused changes nothing, whoever is seated has a place of what
//! was asked for, and nobody loses a place while living in it.
//!
//! First byte: the numbers of processes; then one event after the other: a request, a death, the beginning of
//! the run, a controller that is put out.

#![no_main]

mod common;

use common::Bytes;
use control_zones::process::seating::{Judgement, Place, Seating};
use ipc_schemas::{
    ANY_INDEX, ANY_SCENARIO, ATTACH_BAD_PHASE, ATTACH_JOIN, ATTACH_READY, ATTACH_RESTORE, AttachRequest,
    BUILT_IN, Role, schema_hash,
};
use libfuzzer_sys::fuzz_target;
use std::collections::BTreeSet;

const SCENARIO: u64 = 0x5ce4;
/// Processes there are; requests may name others too.
const PROCESSES: u32 = 8;

fuzz_target!(|bytes: &[u8]| {
    let mut input = Bytes(bytes);
    let sizes = input.byte();
    let (coordinators, pool, plugins) = (sizes % 4, sizes / 4 % 4, sizes / 16 % 4);
    let names: Vec<u64> = (1..=u64::from(plugins)).collect();
    let controllers = usize::from(pool + plugins);
    let mut seating = Seating::new(SCENARIO, usize::from(coordinators), controllers, names);
    let mut dead = BTreeSet::new();
    let mut has_begun = false;
    while !input.is_empty() {
        match input.byte() % 8 {
            0 => _ = dead.insert(input.byte() as u32 % PROCESSES),
            1 => (has_begun, _) = (true, seating.begin()),
            2 if controllers > 0 => seating.vacate(input.index(controllers)),
            _ => ask(&mut seating, request(&mut input), has_begun, &dead),
        }
    }
});

/// A request as a participant would send it, or with any of its fields spoiled.
fn request(input: &mut Bytes<'_>) -> AttachRequest {
    let process = input.byte();
    let what = input.byte();
    let mut requests = vec![AttachRequest {
        instance: u64::from(process / 16),
        schema_hash: schema_hash(),
        scenario_hash: if what & 1 == 0 { ANY_SCENARIO } else { SCENARIO },
        controller: if what & 2 == 0 { BUILT_IN } else { u64::from(what >> 6) + 1 },
        process_id: u32::from(process) % PROCESSES,
        role: if what & 4 == 0 { Role::Controller } else { Role::Coordinator } as u16,
        wanted_index: if what & 8 == 0 { ANY_INDEX } else { u16::from(what >> 6) },
        phase: [ATTACH_JOIN, ATTACH_JOIN, ATTACH_READY, ATTACH_RESTORE][usize::from(what >> 4 & 3)],
        index: 0,
    }];
    if input.byte() % 4 == 0 {
        input.spoil(&mut requests);
    }
    // Spoiling may also leave none.
    requests.first().copied().unwrap_or_default()
}

fn ask(seating: &mut Seating, request: AttachRequest, has_begun: bool, dead: &BTreeSet<u32>) {
    let before = seating.clone();
    let lives = |process: u32| process < PROCESSES && !dead.contains(&process);
    let judged = seating.judge(&request, lives);
    let Judgement::Seated { role, index, generation, plugin } = judged else {
        let Judgement::Refused(status) = judged else { unreachable!("there are two judgements") };
        assert!((1..=ATTACH_BAD_PHASE).contains(&status), "{request:?}: {status}");
        assert!(*seating == before, "{request:?} was refused and left its mark");
        return;
    };
    assert_eq!((request.schema_hash, request.role), (schema_hash(), role as u16));
    assert!([ANY_SCENARIO, SCENARIO].contains(&request.scenario_hash));
    let index = index as usize;
    // What it asked for is what it is.
    match plugin {
        None => {
            assert_eq!(request.controller, BUILT_IN);
            assert!(role == Role::Coordinator || index < seating.pool());
        }
        Some(plugin) => {
            assert_eq!((role, index), (Role::Controller, seating.pool() + plugin));
            assert_eq!(request.controller, plugin as u64 + 1);
        }
    }
    let place = seating.places(role)[index];
    let occupant = place.occupant.expect("whoever is seated has a place");
    assert_eq!((occupant.instance, occupant.process_id), (request.instance, request.process_id));
    assert_eq!(place.generation, generation);
    let earlier = before.places(role)[index];
    let is_own = |place: &Place| {
        place.occupant.is_some_and(|o| (o.instance, o.process_id) == (request.instance, request.process_id))
    };
    if is_own(&earlier) {
        assert_eq!(earlier.generation, generation);
        let was_ready = earlier.occupant.is_some_and(|o| o.ready);
        assert_eq!(occupant.ready, was_ready || request.phase != ATTACH_JOIN);
    } else {
        // Nobody is put out who lives, and nobody is let in who does not ask to be.
        assert!(earlier.occupant.is_none_or(|o| !lives(o.process_id)), "{request:?} took {earlier:?}");
        assert!(request.phase == ATTACH_JOIN && !occupant.ready);
        assert_eq!(generation, earlier.generation + u32::from(has_begun));
        assert!([ANY_INDEX, index as u16].contains(&request.wanted_index));
    }
    // All others sit as they did.
    for role in [Role::Coordinator, Role::Controller] {
        let pairs = before.places(role).iter().zip(seating.places(role)).enumerate();
        let changed = pairs.filter(|(_, (a, b))| a != b).map(|(i, _)| (role, i));
        assert!(changed.into_iter().all(|at| at == (Role::from_code(request.role).unwrap(), index)));
    }
}
