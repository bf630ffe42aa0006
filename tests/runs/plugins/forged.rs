//! Coordination by somebody who has no business sending it.

use super::{compiled, python, root, rust};
use crate::common::{Ended, hold, send, unique_name, wait_until};
use control_zones::transport::iox::{RunName, RunSpace};
use control_zones::transport::{Frame, Inbox, Loan, Outbox, Slots};
use ipc_schemas::{
    ANY_INDEX, ASSIGNMENT_FREE_TERMINAL, ATTACH_JOIN, ATTACH_READY, Assignment, AttachRequest,
    FLAG_END_OF_RUN, FrameHeader, NO_VEHICLE, Role, SERVICE_COMMAND, SERVICE_COORDINATION, SERVICE_STATE,
    STATE_LEFT, VehicleCommand, VehicleState, name_hash, schema_hash,
};
use rustix::process::Signal;
use serde_json::Value;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// A frame on `cz/coordination`.
type Coordination = (FrameHeader, Vec<Assignment>);

/// Two coordination frames that are to mislead, the `turn`th of their kind: as well formed as can be, and wrong in
/// one way each, or in none but that somebody else sends them.
fn forged(turn: usize, state: &FrameHeader) -> [Coordination; 2] {
    let good = FrameHeader {
        run_id: state.run_id,
        schema_hash: schema_hash(),
        step: state.step,
        sender_role: Role::Coordinator as u16,
        ..FrameHeader::default()
    };
    // Nobody yields to anybody.
    let free = |vehicle| Assignment {
        vehicle,
        partner: NO_VEHICLE,
        zone: 1,
        flags: ASSIGNMENT_FREE_TERMINAL,
        ..Assignment::default()
    };
    let all: Vec<_> = (0..120).map(free).collect();
    let foreign = vec![Assignment { zone: 7, ..free(0) }, Assignment { zone: u32::MAX, ..free(1) }];
    let wrong = [
        (FrameHeader { run_id: !state.run_id, ..good }, all.clone()),
        (FrameHeader { schema_hash: 1, ..good }, all.clone()),
        (FrameHeader { sender_role: Role::World as u16, ..good }, all.clone()),
        (FrameHeader { sender_role: 99, ..good }, all.clone()),
        (FrameHeader { sender_index: 63, ..good }, all.clone()),
        (FrameHeader { sender_index: u16::MAX, ..good }, all.clone()),
        (FrameHeader { step: u64::MAX, ..good }, all.clone()),
        (FrameHeader { generation: 1, ..good }, all.clone()),
        (good, foreign),
    ];
    [wrong[turn % wrong.len()].clone(), (good, all)]
}

/// Long enough for a controller that polls to take what has come.
const TAKEN: Duration = Duration::from_millis(20);

/// Runs zone 2 with a controller, while this process drives zone 1 and, where `lies`, sends forged coordination in
/// every step that has some, while the coordinator is stopped; how the run ended.
fn beside_a_liar(command: &str, lies: bool) -> Ended {
    // In the runtime directory of this process, which enters the run's space itself.
    let name = unique_name("liar");
    let toml = |text: &str| Value::String(text.to_owned()).to_string();
    let controllers = format!(
        "controllers=[{{name=\"victim\", zones=[\"merge-2\"], command={}}}, {{name=\"liar\", zones=[\"merge-1\"]}}]",
        toml(command)
    );
    let mut supervisor = Command::new(env!("CARGO_BIN_EXE_cz"));
    supervisor.args(["run", "--run", &name, "--json", "-", "--set", "end.time_s=60", "--set", &controllers]);
    let supervisor =
        supervisor.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let run: RunName = name.parse().unwrap();
    // It claims the run before it starts anybody.
    wait_until("the world", || !crate::common::children(supervisor.id()).is_empty());
    {
        let space = RunSpace::enter(&run).unwrap();
        let line = crate::common::attach_line(&space);
        let join = AttachRequest {
            instance: 1,
            schema_hash: schema_hash(),
            controller: name_hash("liar"),
            process_id: std::process::id(),
            role: Role::Controller as u16,
            wanted_index: ANY_INDEX,
            phase: ATTACH_JOIN,
            ..AttachRequest::default()
        };
        let ask = |request: AttachRequest| {
            line.request(request).unwrap();
            let mut own = None;
            wait_until("the reply", || {
                own = line.next_reply().unwrap().map(|frame| *frame.reply()).filter(|r| r.instance == 1);
                own.is_some()
            });
            own.unwrap()
        };
        let reply = ask(join);
        assert_eq!(reply.status, 0);
        let mut states = space.open::<VehicleState>(SERVICE_STATE).unwrap().inbox().unwrap();
        let mut commands = space.open::<VehicleCommand>(SERVICE_COMMAND).unwrap().outbox(64).unwrap();
        let mut coordination = space.open::<Assignment>(SERVICE_COORDINATION).unwrap().outbox(120).unwrap();
        ask(AttachRequest { phase: ATTACH_READY, index: reply.index, ..join });
        let mut coordinator = None;
        wait_until("the coordinator", || {
            let parts = crate::common::children(supervisor.id()).into_iter();
            coordinator =
                parts.filter(|(_, line)| line.get(1).is_some_and(|p| p == "coord")).map(|p| p.0).next();
            coordinator.is_some()
        });
        let coordinator = coordinator.unwrap();
        let mut held = None;
        let mut turn = 0;
        loop {
            let start = Instant::now();
            let state = loop {
                if let Some(state) = states.receive().unwrap() {
                    break state;
                }
                assert!(start.elapsed() < crate::common::LONG, "waited for a state");
                std::thread::yield_now();
            };
            if state.header().flags & FLAG_END_OF_RUN != 0 {
                held.into_iter().for_each(|id| send(id, Signal::CONT));
                break;
            }
            if state.header().coordinators_acting == 0 {
                // Between two events it has nothing to do, and nobody waits for it.
                if lies && held.is_none() {
                    hold(coordinator);
                    held = Some(coordinator);
                }
            } else if let Some(id) = held.take() {
                // As many as a controller keeps of one sender.
                for (header, assignments) in forged(turn, state.header()) {
                    let fill =
                        |slots: &mut Slots<'_, Assignment>| assignments.iter().for_each(|a| slots.push(*a));
                    coordination.loan(header, assignments.len(), fill).unwrap().send().unwrap();
                }
                turn += 1;
                std::thread::sleep(TAKEN);
                send(id, Signal::CONT);
            }
            let own = || state.records().iter().filter(|s| s.zone == 0 && s.flags & STATE_LEFT == 0);
            let command = |s: &VehicleState| {
                let u_mps2 = (15.0 - s.v_mps).clamp(-4.0, 4.0);
                VehicleCommand { u_mps2, vehicle: s.vehicle, zone: s.zone, ..VehicleCommand::default() }
            };
            let header = FrameHeader {
                run_id: reply.run_id,
                schema_hash: schema_hash(),
                step: state.header().step,
                time_ns: state.header().time_ns,
                sender_role: Role::Controller as u16,
                sender_index: reply.index as u16,
                generation: reply.generation,
                ..FrameHeader::default()
            };
            let fill = |slots: &mut Slots<'_, VehicleCommand>| own().for_each(|s| slots.push(command(s)));
            commands.loan(header, own().count(), fill).unwrap().send().unwrap();
        }
    }
    let output = supervisor.wait_with_output().unwrap();
    RunSpace::sweep(&run).unwrap();
    assert_eq!(crate::common::files(None, &name), Vec::<PathBuf>::new());
    let text = |bytes| String::from_utf8(bytes).unwrap();
    Ended {
        what: command.to_owned(),
        status: output.status,
        out: text(output.stdout),
        err: text(output.stderr),
    }
}

#[test]
fn forged_coordination_changes_nothing_for_controllers_written_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let mut all = vec![
        ("Rust", rust("pauses")),
        ("C++", compiled(&root().join("examples/cpp/idm.cpp"), folder.path())),
    ];
    all.extend(python().map(|python| {
        let example = root().join("examples/python/ocbf.py");
        ("Python", format!("{python} {}", example.display()))
    }));
    for (language, command) in all {
        let expected = beside_a_liar(&command, false).hash();
        let ended = beside_a_liar(&command, true);
        assert_eq!(ended.hash(), expected, "{language}: {}", ended.err);
        let own = format!("(process {})", std::process::id());
        let refused: Vec<_> =
            ended.err.lines().filter(|l| l.contains("] refused ") && l.contains(&own)).collect();
        // Among them, and the last of that name, one that is wrong in nothing but who sends it.
        let stranger = refused.iter().find(|line| line.contains(" coordinator 0 (process "));
        assert!(
            stranger.is_some_and(|line| line.contains("; the last: it was sent by ")),
            "{language}: {}",
            ended.err
        );
        // What it was shown is what follows from the zone's order, where the controller looks at that.
        assert!(
            !ended.err.contains("answered ") || ended.err.contains(", wrong 0"),
            "{language}: {}",
            ended.err
        );
        println!("{language}: {}", refused.join("\n"));
    }
}
