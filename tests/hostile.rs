//! A process that means harm sends what it should not, and the run goes on to the same result.

#![allow(clippy::unwrap_used)] // in helpers as in the tests themselves

mod common;

use common::{Site, files, unique_name, wait_until};
use control_zones::transport::iox::{RunName, RunSpace};
use control_zones::transport::{Loan, Outbox};
use ipc_schemas::{
    ANY_INDEX, ATTACH_BAD_PHASE, ATTACH_JOIN, ATTACH_NO_CONTROLLER, ATTACH_NO_ROOM, ATTACH_READY, Assignment,
    AttachRequest, FrameHeader, Role, SERVICE_COMMAND, SERVICE_COORDINATION, VehicleCommand, schema_hash,
};
use rustix::process::Signal;
use std::process::{Child, Command, Stdio};

/// Frames the hostile process sends; the run lasts until all are.
const FRAMES: u64 = 1_000_000;
/// It knows the run's id, as every participant does.
const RUN_ID: u64 = 77;

/// Deceives in a different way each time: what the header says, or what the commands do.
fn forged(i: u64, run_id: u64, step: u64) -> (FrameHeader, Vec<VehicleCommand>) {
    let good = FrameHeader {
        run_id,
        schema_hash: schema_hash(),
        step,
        sender_role: Role::Controller as u16,
        ..FrameHeader::default()
    };
    let command = VehicleCommand { u_mps2: -4.0, vehicle: i as u32 % 7, ..VehicleCommand::default() };
    let header = match i % 8 {
        0 => FrameHeader { run_id: run_id ^ 1, ..good },
        1 => FrameHeader { schema_hash: i, ..good },
        2 => FrameHeader { sender_role: i as u16, ..good },
        3 => FrameHeader { sender_index: 63, ..good },
        4 => FrameHeader { generation: 9, ..good },
        5 => FrameHeader { step: step + 1 + i, ..good },
        // These two would be taken if it did not matter who sends them.
        6 => FrameHeader { step: step + 1, ..good },
        _ => good,
    };
    let commands = match i % 3 {
        0 => vec![],
        1 => vec![command],
        _ => vec![VehicleCommand { u_mps2: f64::NAN, zone: u32::MAX, ..command }; 3],
    };
    (header, commands)
}

#[test]
fn a_million_malformed_commands_change_nothing_and_are_all_counted() {
    let long = [
        "varying-demand",
        "--set",
        "end.time_s=30000",
        "--set",
        "roads.main1.demand.rates=[{until_s=30000.0,vehicles_per_hour=300.0}]",
    ];
    let expected = common::hash(&Site::new("u").summary(&[&long[..], &["--in-process"]].concat()));
    // In the runtime directory of this process, which enters the run's space itself.
    let name = unique_name("hostile");
    // So that it ends only when all has been sent: its controller comes late, and leaves the world waiting.
    let start = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(arguments).args(["--run", &name]).stdin(Stdio::null()).stdout(Stdio::piped());
        command.spawn().unwrap()
    };
    let world = start(
        env!("CARGO_BIN_EXE_cz-world"),
        &[&long[..], &["--json", "-", "--run-id", "77", "--attach-timeout", "600", "--peer-timeout", "600"]]
            .concat(),
    );
    let mut coordinator = start(env!("CARGO_BIN_EXE_cz-coord"), &[]);
    let mut controller = start(env!("CARGO_BIN_EXE_cz-ctrl"), &[]);
    let run: RunName = name.parse().unwrap();
    let (mut sent, mut reached_step) = (0, 0);
    {
        let space = RunSpace::enter(&run).unwrap();
        let mut service = None;
        wait_until("the command service", || {
            service = space.open::<VehicleCommand>(SERVICE_COMMAND).ok();
            service.is_some()
        });
        let mut outbox = service.unwrap().outbox(8).unwrap();
        wait_until("the run to be under way", || common::ticks(world.id()) >= 5);
        let mut stopped = false;
        while sent < FRAMES {
            let (header, commands) = forged(sent, RUN_ID, reached_step);
            let count = commands.len();
            let loan =
                outbox.loan(header, count, |slots| commands.iter().for_each(|c| slots.push(*c))).unwrap();
            // What finds no room has not been sent.
            if loan.send().unwrap() == 1 {
                sent += 1;
                reached_step += sent % 2;
            } else {
                assert!(common::is_alive(world.id()), "the run was over after {sent} frames");
                std::thread::yield_now();
            }
            if !stopped && sent > 1000 {
                // Stepping in spite of the flood so far; from now on the world waits for its controller.
                common::send(controller.id(), Signal::STOP);
                stopped = true;
            }
        }
        common::send(controller.id(), Signal::CONT);
    }
    let output = world.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(common::hash(&summary), expected, "{summary}");
    let refused = summary["refused"].as_array().unwrap();
    let counted: u64 = refused.iter().map(|r| r["frames"].as_u64().unwrap()).sum();
    assert_eq!(counted, FRAMES, "{refused:?}");
    let own = format!("process {}", std::process::id());
    assert!(refused.iter().all(|r| r["sender"].as_str().unwrap().contains(&own)), "{refused:?}");
    assert!(coordinator.wait().unwrap().success() && controller.wait().unwrap().success());
    assert!(RunSpace::sweep(&run).unwrap(), "somebody is still in the run");
    assert_eq!(files(None, &name), Vec::<std::path::PathBuf>::new());
    let mut kinds: Vec<_> = refused.iter().map(|r| r["last"].to_string()).collect();
    kinds.sort();
    println!("{counted} frames refused, of {} kinds of sender, e.g. {:?}", refused.len(), kinds.first());
}

/// Lets a run go on once it is there to be misled, then sends assignments of another run to whoever listens,
/// until the process has ended.
fn mislead(name: &str, go_on: impl FnOnce(), until: &mut Child) {
    let run: RunName = name.parse().unwrap();
    let space = RunSpace::enter(&run).unwrap();
    let mut service = None;
    wait_until("the coordination service", || {
        service = space.open::<Assignment>(SERVICE_COORDINATION).ok();
        service.is_some()
    });
    let mut outbox = service.unwrap().outbox(1).unwrap();
    go_on();
    let header = FrameHeader {
        run_id: !RUN_ID,
        schema_hash: schema_hash(),
        sender_role: Role::Coordinator as u16,
        ..FrameHeader::default()
    };
    while until.try_wait().unwrap().is_none() {
        outbox.loan(header, 0, |_| {}).unwrap().send().unwrap();
        std::thread::sleep(std::time::Duration::from_micros(100));
    }
}

#[test]
fn what_a_controller_refuses_is_in_the_summary_and_by_hand_on_stderr() {
    const LONG: [&str; 3] = ["--set", "end.time_s=2000", "varying-demand"];
    let start = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.spawn().unwrap()
    };
    let own = format!("coordinator 0 (process {})", std::process::id());
    let name = unique_name("mislead");
    let arguments = [&["run", "--run", &name, "--json", "-"], &LONG[..]].concat();
    let mut supervisor = start(env!("CARGO_BIN_EXE_cz"), &arguments);
    // Held, so that the run does not end before anybody misleads it.
    let mut controller = None;
    wait_until("the controller", || {
        let parts = common::children(supervisor.id());
        controller =
            parts.iter().find(|(_, line)| line.get(1).is_some_and(|p| p == "ctrl")).map(|(id, _)| *id);
        controller.is_some()
    });
    let controller = controller.unwrap();
    common::send(controller, Signal::STOP);
    mislead(&name, || common::send(controller, Signal::CONT), &mut supervisor);
    let output = supervisor.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let refused = summary["refused"].as_array().unwrap();
    for receiver in ["the world", "controller 0"] {
        let is_ours = |r: &&serde_json::Value| r["receiver"] == receiver && r["sender"] == own;
        let account = refused.iter().find(is_ours).unwrap_or_else(|| panic!("{receiver}: {summary}"));
        assert!(account["frames"].as_u64().unwrap() > 0, "{summary}");
        assert!(account["last"].as_str().unwrap().contains("belongs to run"), "{summary}");
    }

    let name = unique_name("mislead");
    let mut world = start(env!("CARGO_BIN_EXE_cz-world"), &[&["--run", &name], &LONG[..]].concat());
    let coordinator = start(env!("CARGO_BIN_EXE_cz-coord"), &["--run", &name]);
    let mut controller = None;
    let go_on = || controller = Some(start(env!("CARGO_BIN_EXE_cz-ctrl"), &["--run", &name]));
    mislead(&name, go_on, &mut world);
    let [coordinator, controller] =
        [coordinator, controller.unwrap()].map(|part| part.wait_with_output().unwrap());
    assert!(coordinator.status.success() && coordinator.stderr.is_empty(), "{coordinator:?}");
    let said = String::from_utf8(controller.stderr).unwrap();
    assert!(said.starts_with("controller 0 refused ") && said.contains(&own), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(world.wait_with_output().unwrap().status.success());
}

#[test]
fn attach_requests_that_contradict_themselves_are_refused_and_end_nothing() {
    let name = unique_name("attach");
    let start = |program: &str| {
        let mut command = Command::new(program);
        command.args(["--run", &name]).stdin(Stdio::null()).stdout(Stdio::piped());
        command.spawn().unwrap()
    };
    let world = start(env!("CARGO_BIN_EXE_cz-world"));
    let run: RunName = name.parse().unwrap();
    {
        let space = RunSpace::enter(&run).unwrap();
        let mut line = None;
        wait_until("the attach desk", || {
            line = space.open_attach_line().ok();
            line.is_some()
        });
        let line = line.unwrap();
        let good = AttachRequest {
            instance: 1,
            schema_hash: schema_hash(),
            process_id: std::process::id(),
            role: Role::Coordinator as u16,
            wanted_index: ANY_INDEX,
            phase: ATTACH_JOIN,
            ..AttachRequest::default()
        };
        let cases = [
            // A coordinator that gives a controller's name.
            (AttachRequest { controller: 123, ..good }, ATTACH_NO_CONTROLLER),
            (AttachRequest { phase: 9, ..good }, ATTACH_BAD_PHASE),
            // Ready without having joined.
            (AttachRequest { phase: ATTACH_READY, ..good }, ATTACH_NO_ROOM),
        ];
        for (i, (request, status)) in (10..).zip(cases) {
            let request = AttachRequest { instance: i, ..request };
            line.request(request).unwrap();
            wait_until("the reply", || {
                assert!(common::is_alive(world.id()), "{request:?} has ended the world");
                let reply = line.next_reply().unwrap();
                reply.is_some_and(|frame| {
                    assert_eq!((frame.reply().instance, frame.reply().status), (i, status));
                    !frame.scenario().is_empty()
                })
            });
        }
    }
    let mut parts = [env!("CARGO_BIN_EXE_cz-coord"), env!("CARGO_BIN_EXE_cz-ctrl")].map(start);
    let output = world.wait_with_output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("4bd61fbe17f858e7"), "{said}");
    assert!(parts.iter_mut().all(|part| part.wait().unwrap().success()));
}
