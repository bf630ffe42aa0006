//! A process that means harm sends what it should not, and the run goes on to the same result.

use crate::common::{TestRun, files, unique_name, wait_until, wait_until_stepping};
use control_zones::record::Step;
use control_zones::transport::iox::{BlockInbox, IoxOutbox, RunName, RunSpace};
use control_zones::transport::{Loan, Outbox, Slots};
use ipc_schemas::{
    ANY_INDEX, ATTACH_BAD_PHASE, ATTACH_JOIN, ATTACH_NO_CONTROLLER, ATTACH_NO_ROOM, ATTACH_READY, Assignment,
    AttachRequest, FrameHeader, Member, Record, Role, SERVICE_COMMAND, SERVICE_COORDINATION,
    SERVICE_COORDINATOR_STATE_PREFIX, SERVICE_MEMBERS, SERVICE_OBSERVER, SERVICE_STATE,
    SERVICE_SUMMARY_PREFIX, VehicleCommand, VehicleState, ZoneSummary, schema_hash,
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
    let expected = crate::common::hash(&TestRun::new("u").summary(&[&long[..], &["--in-process"]].concat()));
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
        wait_until_stepping(world.id());
        // A world that waits sleeps, and nobody wakes it for frames that nobody announces.
        let rope = space.bells().unwrap().rope(Role::World, 0);
        let mut stopped = false;
        while sent < FRAMES {
            let (header, commands) = forged(sent, RUN_ID, reached_step);
            let count = commands.len();
            let loan =
                outbox.loan(header, count, |slots| commands.iter().for_each(|c| slots.push(*c))).unwrap();
            // What finds no room has not been sent.
            let reached = loan.send().unwrap();
            rope.ring();
            if reached == 1 {
                sent += 1;
                reached_step += sent % 2;
            } else {
                assert!(crate::common::is_alive(world.id()), "the run was over after {sent} frames");
                std::thread::yield_now();
            }
            if !stopped && sent > 1000 {
                // Stepping in spite of the flood so far; from now on the world waits for its controller.
                crate::common::hold(controller.id());
                stopped = true;
            }
        }
        crate::common::send(controller.id(), Signal::CONT);
    }
    let output = world.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(crate::common::hash(&summary), expected, "{summary}");
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
        let parts = crate::common::children(supervisor.id());
        controller =
            parts.iter().find(|(_, line)| line.get(1).is_some_and(|p| p == "ctrl")).map(|(id, _)| *id);
        controller.is_some()
    });
    let controller = controller.unwrap();
    crate::common::hold(controller);
    mislead(&name, || crate::common::send(controller, Signal::CONT), &mut supervisor);
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
    let start = |program: &str, more: &[&str]| {
        let mut command = Command::new(program);
        command.args(["--run", &name]).args(more).stdin(Stdio::null()).stdout(Stdio::piped());
        command.spawn().unwrap()
    };
    let world = start(env!("CARGO_BIN_EXE_cz-world"), &["paper"]);
    let run: RunName = name.parse().unwrap();
    {
        let space = RunSpace::enter(&run).unwrap();
        let line = crate::common::attach_line(&space);
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
                assert!(crate::common::is_alive(world.id()), "{request:?} has ended the world");
                let reply = line.next_reply().unwrap();
                reply.is_some_and(|frame| {
                    assert_eq!((frame.reply().instance, frame.reply().status), (i, status));
                    !frame.scenario().is_empty()
                })
            });
        }
    }
    let mut parts =
        [env!("CARGO_BIN_EXE_cz-coord"), env!("CARGO_BIN_EXE_cz-ctrl")].map(|program| start(program, &[]));
    let output = world.wait_with_output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("b56ea7e351b4a6a2"), "{said}");
    assert!(parts.iter_mut().all(|part| part.wait().unwrap().success()));
}

/// Whoever looks on a run, and so knows which step it is in.
struct Onlooker {
    blocks: BlockInbox,
    seen: Option<u64>,
}

impl Onlooker {
    fn look(&mut self) -> bool {
        let mut came = false;
        while let Some(block) = self.blocks.receive().unwrap() {
            self.seen = Step::number_in(block.bytes());
            came = true;
        }
        came
    }

    /// The step in which the run stands still.
    fn standstill(&mut self) -> u64 {
        let mut quiet = 0;
        wait_until("the run to stand still", || {
            quiet = if self.look() { 0 } else { quiet + 1 };
            quiet >= 20
        });
        self.seen.map_or(0, |step| step + 1)
    }
}

/// Sends a frame in somebody's name; returns how many it reached.
fn forge<R: Record>(outbox: &mut IoxOutbox<R>, index: u16, step: u64, records: &[R]) -> usize {
    let header = FrameHeader {
        run_id: RUN_ID,
        schema_hash: schema_hash(),
        step,
        sender_role: Role::Coordinator as u16,
        sender_index: index,
        ..FrameHeader::default()
    };
    let fill = |slots: &mut Slots<'_, R>| records.iter().for_each(|r| slots.push(*r));
    outbox.loan(header, records.len(), fill).unwrap().send().unwrap()
}

#[test]
fn well_formed_frames_of_a_process_without_a_place_steer_nobody() {
    // Three coordinators in a row; the tree merges from both sides into the last.
    let scenario = ["tree", "--set", "end.time_s=300"];
    let expected =
        crate::common::hash(&TestRun::new("u").summary(&[&scenario[..], &["--in-process"]].concat()));
    let name = unique_name("forge");
    let start = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.args(["--run", &name]).args(arguments).stdin(Stdio::null());
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let share = ["--coord-procs", "3", "--ctrl-procs", "2", "--observed", "--run-id", "77", "--json", "-"];
    let world = start(env!("CARGO_BIN_EXE_cz-world"), &[&scenario[..], &share].concat());
    let run: RunName = name.parse().unwrap();
    let space = RunSpace::enter(&run).unwrap();
    let mut blocks = None;
    wait_until("the run to be looked on", || {
        blocks = space.open_blocks(SERVICE_OBSERVER).ok().flatten();
        blocks.is_some()
    });
    let mut onlooker = Onlooker { blocks: blocks.unwrap(), seen: None };
    // Nobody but the world sends states, or says who has which place, from before anybody can join.
    drop(crate::common::attach_line(&space));
    let own_state = format!("{SERVICE_COORDINATOR_STATE_PREFIX}0");
    for service in [SERVICE_STATE, &own_state] {
        let service = space.open::<VehicleState>(service).unwrap();
        assert!(service.outbox(1).is_err(), "there is room for another sender of states");
    }
    assert!(space.open::<Member>(SERVICE_MEMBERS).unwrap().outbox(1).is_err());
    let mut coordination = space.open::<Assignment>(SERVICE_COORDINATION).unwrap().outbox(8).unwrap();
    let mut summaries: Vec<_> = (0..3)
        .map(|i| space.open(&format!("{SERVICE_SUMMARY_PREFIX}{i}")).unwrap().outbox(8).unwrap())
        .collect();

    let indexed = |program, i: usize| start(program, &["--index", ["0", "1", "2"][i]]);
    let coordinators: Vec<Child> = (0..3).map(|i| indexed(env!("CARGO_BIN_EXE_cz-coord"), i)).collect();
    let controllers: Vec<Child> = (0..2).map(|i| indexed(env!("CARGO_BIN_EXE_cz-ctrl"), i)).collect();
    let mut forged = [0, 0];
    for round in 0..12 {
        // One coordinator is held at its next event, and somebody else is quicker.
        let victim = round % 3;
        crate::common::hold(coordinators[victim].id());
        let step = onlooker.standstill();
        // Empty, it would do for the true one; a controller that took it would know no partner.
        forged[0] += forge(&mut coordination, victim as u16, step, &[]);
        for (to, outbox) in summaries.iter_mut().enumerate().filter(|(to, _)| *to != victim) {
            let full = |zone| ZoneSummary {
                from_zone: zone,
                to_zone: to as u32,
                vehicles: 999,
                segment_vehicles: 999,
                ..ZoneSummary::default()
            };
            let full: Vec<ZoneSummary> = (0..7).map(full).collect();
            forged[1] += forge(outbox, victim as u16, step.saturating_sub(1), &full);
            forged[1] += forge(outbox, victim as u16, step, &full);
        }
        // Long enough to be taken by those who wait.
        std::thread::sleep(std::time::Duration::from_millis(50));
        crate::common::send(coordinators[victim].id(), Signal::CONT);
        let past = onlooker.seen;
        wait_until("the run to go on", || onlooker.look() && onlooker.seen > past);
    }
    drop((coordination, summaries));
    // The recorder's place is given up too, or the world would wait for it in vain.
    let output = {
        let mut world = world;
        wait_until("the world to end", || {
            onlooker.look();
            world.try_wait().unwrap().is_some()
        });
        world.wait_with_output().unwrap()
    };
    drop(onlooker);
    drop(space);
    assert!(output.status.success(), "{output:?}");
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(crate::common::hash(&summary), expected, "{summary}");
    assert!(forged[0] >= 12 && forged[1] > 0, "{forged:?} frames arrived");
    let own = format!("(process {})", std::process::id());
    let refused = summary["refused"].to_string();
    assert!(refused.contains(&own) && refused.contains("it claims to come from coordinator"), "{refused}");
    let said = |part: Child| {
        let output = part.wait_with_output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    for said in controllers.into_iter().map(said) {
        assert!(
            said.contains(" refused ") && said.contains(&own),
            "a controller has refused nothing: {said:?}"
        );
        assert!(said.contains("it claims to come from coordinator"), "{said}");
    }
    let said: String = coordinators.into_iter().map(said).collect();
    assert!(
        said.contains(" refused ") && said.contains(&own),
        "no coordinator has refused anything: {said:?}"
    );
    println!("{forged:?} forged frames of coordination and summaries; {refused}");
}
