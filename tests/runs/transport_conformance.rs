//! One suite for all transports: what a sender and its receivers may rely on.

use crate::common::unique_name;
use control_zones::transport::iox::{IoxInbox, IoxOutbox, RunName, RunSpace, Service, ServiceLimits};
use control_zones::transport::memory::{MemoryInbox, MemoryOutbox, MemoryService};
use control_zones::transport::{Backlog, Frame, Inbox, Loan, Outbox, TransportError};
use ipc_schemas::{FrameHeader, Role, VehicleCommand, schema_hash};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Frames are laid out for this many records at first.
const EXPECTED: usize = 4;
const SERVICE: &str = "cz/conformance";

/// A service with its ends.
trait Bench {
    type Out: Outbox<VehicleCommand>;
    type In: Inbox<VehicleCommand>;

    /// A new service with so many senders and receivers.
    fn open(senders: usize, receivers: usize) -> Self;
    /// The ends, to be taken by index.
    fn ends(&mut self) -> (&mut [Self::Out], &mut [Self::In]);
    /// Another sender.
    fn join(&mut self) -> Self::Out;
    /// Closes the last receiver.
    fn close_inbox(&mut self);
}

struct Memory(
    Vec<MemoryOutbox<VehicleCommand>>,
    Vec<MemoryInbox<VehicleCommand>>,
    MemoryService<VehicleCommand>,
);

impl Bench for Memory {
    type Out = MemoryOutbox<VehicleCommand>;
    type In = MemoryInbox<VehicleCommand>;

    fn open(senders: usize, receivers: usize) -> Memory {
        let service = MemoryService::new();
        let inboxes = (0..receivers).map(|_| service.inbox()).collect();
        Memory((0..senders).map(|_| service.outbox()).collect(), inboxes, service)
    }

    fn ends(&mut self) -> (&mut [Self::Out], &mut [Self::In]) {
        (&mut self.0, &mut self.1)
    }

    fn join(&mut self) -> Self::Out {
        self.2.outbox()
    }

    fn close_inbox(&mut self) {
        self.1.pop();
    }
}

/// Fields are dropped in order: the ends before the service, the service before the space.
struct Iceoryx2 {
    outboxes: Vec<IoxOutbox<VehicleCommand>>,
    inboxes: Vec<IoxInbox<VehicleCommand>>,
    service: Service<VehicleCommand>,
    _space: RunSpace,
}

impl Bench for Iceoryx2 {
    type Out = IoxOutbox<VehicleCommand>;
    type In = IoxInbox<VehicleCommand>;

    fn open(senders: usize, receivers: usize) -> Iceoryx2 {
        let run: RunName = unique_name("conf").parse().unwrap();
        let space = RunSpace::enter(&run).unwrap();
        let limits = ServiceLimits {
            publishers: senders + 1,
            subscribers: receivers,
            nodes: 1,
            backlog: Backlog::STEPS,
        };
        let service = space.create(SERVICE, limits).unwrap();
        Iceoryx2 {
            outboxes: (0..senders).map(|_| service.outbox(EXPECTED).unwrap()).collect(),
            inboxes: (0..receivers).map(|_| service.inbox().unwrap()).collect(),
            service,
            _space: space,
        }
    }

    fn ends(&mut self) -> (&mut [Self::Out], &mut [Self::In]) {
        (&mut self.outboxes, &mut self.inboxes)
    }

    fn join(&mut self) -> Self::Out {
        self.service.outbox(EXPECTED).unwrap()
    }

    fn close_inbox(&mut self) {
        self.inboxes.pop();
    }
}

/// A header of which every field is different, for a step.
fn header(step: u64) -> FrameHeader {
    FrameHeader {
        run_id: 0x1111 + step,
        schema_hash: schema_hash(),
        step,
        time_ns: 3 * step,
        coordinators_acting: 5 * step,
        coordinators_summarised: 7 * step,
        sender_role: 3,
        sender_index: 11,
        generation: 13,
        record_count: 9999, // set by the outbox
        flags: 17,
    }
}

/// A record that can be told from every other.
fn record(step: u64, i: usize) -> VehicleCommand {
    VehicleCommand { u_mps2: step as f64, vehicle: i as u32, ..VehicleCommand::default() }
}

fn write<O: Outbox<VehicleCommand>>(
    outbox: &mut O,
    step: u64,
    count: usize,
) -> Result<O::Loan<'_>, TransportError> {
    outbox.loan(header(step), count, |slots| (0..count).for_each(|i| slots.push(record(step, i))))
}

fn send<O: Outbox<VehicleCommand>>(outbox: &mut O, step: u64, count: usize) -> Result<usize, TransportError> {
    write(outbox, step, count)?.send()
}

fn receive<I: Inbox<VehicleCommand>>(inbox: &mut I) -> Option<I::Frame> {
    inbox.receive().unwrap()
}

/// Checks that a frame is exactly what was sent.
fn check<F: Frame<VehicleCommand>>(frame: &F, step: u64, count: usize) {
    assert_eq!(*frame.header(), FrameHeader { record_count: count as u32, ..header(step) });
    let expected: Vec<_> = (0..count).map(|i| record(step, i)).collect();
    assert_eq!(frame.records(), expected);
}

fn nothing_comes_before_anything_is_sent<B: Bench>() {
    let mut bench = B::open(1, 2);
    let (_, inboxes) = bench.ends();
    assert!(inboxes.iter_mut().all(|inbox| receive(inbox).is_none()));
}

fn every_receiver_gets_every_frame_in_order<B: Bench>() {
    let mut bench = B::open(1, 2);
    let (outboxes, inboxes) = bench.ends();
    for step in (0..200).step_by(2) {
        for step in [step, step + 1] {
            assert_eq!(send(&mut outboxes[0], step, 3), Ok(2), "the number of receivers");
        }
        for inbox in inboxes.iter_mut() {
            for step in [step, step + 1] {
                check(&receive(inbox).unwrap(), step, 3);
            }
            assert!(receive(inbox).is_none());
        }
    }
}

fn a_loan_shows_its_records_before_it_is_sent<B: Bench>() {
    let mut bench = B::open(1, 1);
    let (outboxes, inboxes) = bench.ends();
    let loan = write(&mut outboxes[0], 1, 3).unwrap();
    assert_eq!(loan.records(), [record(1, 0), record(1, 1), record(1, 2)]);
    assert!(receive(&mut inboxes[0]).is_none(), "it has not been sent");
    loan.send().unwrap();
    check(&receive(&mut inboxes[0]).unwrap(), 1, 3);
}

fn a_frame_may_be_empty_and_may_grow<B: Bench>() {
    let mut bench = B::open(1, 1);
    let (outboxes, inboxes) = bench.ends();
    // Far beyond what was expected, and back again.
    let counts = [0, 1, EXPECTED, EXPECTED + 1, 0, 100, 3, 5000, 4999, 20_000, 0, 1];
    for (step, count) in (0..).zip(counts) {
        send(&mut outboxes[0], step, count).unwrap();
        check(&receive(&mut inboxes[0]).unwrap(), step, count);
    }
}

fn frames_in_flight_survive_growth<B: Bench>() {
    let mut bench = B::open(1, 1);
    let (outboxes, inboxes) = bench.ends();
    send(&mut outboxes[0], 1, 2).unwrap();
    let held = receive(&mut inboxes[0]).unwrap();
    send(&mut outboxes[0], 2, 2).unwrap();
    // Memory is laid out anew while one frame is being read and another waits.
    send(&mut outboxes[0], 3, 10_000).unwrap();
    check(&held, 1, 2);
    check(&receive(&mut inboxes[0]).unwrap(), 2, 2);
    check(&receive(&mut inboxes[0]).unwrap(), 3, 10_000);
    check(&held, 1, 2);
}

fn a_receiver_that_does_not_take_its_frames_misses_some<B: Bench>() {
    let mut bench = B::open(1, 2);
    let (outboxes, inboxes) = bench.ends();
    let (lazy, diligent) = inboxes.split_at_mut(1);
    for step in 0..2 {
        send(&mut outboxes[0], step, 1).unwrap();
        check(&receive(&mut diligent[0]).unwrap(), step, 1);
    }
    assert_eq!(send(&mut outboxes[0], 2, 1), Ok(1), "only one has room");
    check(&receive(&mut diligent[0]).unwrap(), 2, 1);
    // Nothing it had has been overwritten.
    check(&receive(&mut lazy[0]).unwrap(), 0, 1);
    check(&receive(&mut lazy[0]).unwrap(), 1, 1);
    assert!(receive(&mut lazy[0]).is_none());
    assert_eq!(send(&mut outboxes[0], 3, 1), Ok(2), "there is room again");
    check(&receive(&mut lazy[0]).unwrap(), 3, 1);
}

fn the_room_is_per_sender<B: Bench>() {
    const SENDERS: usize = 5;
    let mut bench = B::open(SENDERS, 1);
    let (outboxes, inboxes) = bench.ends();
    for step in 0..2 {
        for (i, outbox) in outboxes.iter_mut().enumerate() {
            send(outbox, step, i).unwrap();
        }
    }
    assert_eq!(send(&mut outboxes[0], 2, 0), Ok(0));
    // From each sender in order; between senders there is no order.
    let mut next = [0; SENDERS];
    while let Some(frame) = receive(&mut inboxes[0]) {
        let sender = frame.records().len();
        check(&frame, next[sender], sender);
        next[sender] += 1;
    }
    assert_eq!(next, [2; SENDERS]);
}

fn a_loan_dropped_is_never_seen<B: Bench>() {
    let mut bench = B::open(1, 1);
    let (outboxes, inboxes) = bench.ends();
    // Often enough to use up every loan if one were lost.
    for step in 0..50 {
        drop(write(&mut outboxes[0], 1000 + step, 2).unwrap());
        assert!(receive(&mut inboxes[0]).is_none());
        send(&mut outboxes[0], step, 2).unwrap();
        check(&receive(&mut inboxes[0]).unwrap(), step, 2);
    }
}

fn a_frame_half_written_is_never_seen<B: Bench>() {
    let mut bench = B::open(1, 1);
    let (outboxes, inboxes) = bench.ends();
    for written in [0, 1, 3] {
        let result = catch_unwind(AssertUnwindSafe(|| {
            let loan = outboxes[0].loan(header(1), 2, |slots| {
                (0..written).for_each(|i| slots.push(record(1, i)));
            });
            loan.map(drop)
        }));
        assert!(result.is_err(), "{written} records of 2 are a mistake in the program");
        assert!(receive(&mut inboxes[0]).is_none());
    }
    send(&mut outboxes[0], 2, 2).unwrap();
    check(&receive(&mut inboxes[0]).unwrap(), 2, 2);
}

fn frames_stay_as_they_are_while_held<B: Bench>() {
    let mut bench = B::open(1, 2);
    let (outboxes, inboxes) = bench.ends();
    let (holder, passer) = inboxes.split_at_mut(1);
    send(&mut outboxes[0], 0, 3).unwrap();
    let mut held = receive(&mut holder[0]).unwrap();
    drop(receive(&mut passer[0]));
    for step in 1..100 {
        send(&mut outboxes[0], step, 3).unwrap();
        drop(receive(&mut passer[0]));
        check(&held, step - 1, 3);
        let next = receive(&mut holder[0]).unwrap();
        check(&next, step, 3);
        check(&held, step - 1, 3);
        held = next;
    }
}

fn what_a_sender_has_left_comes_to_those_who_had_taken_from_it<B: Bench>() {
    let mut bench = B::open(0, 3);
    let mut sender = bench.join();
    let (_, inboxes) = bench.ends();
    assert_eq!(send(&mut sender, 1, 2), Ok(3));
    check(&receive(&mut inboxes[0]).unwrap(), 1, 2);
    assert_eq!(send(&mut sender, 2, 1), Ok(3));
    drop(sender);
    check(&receive(&mut inboxes[0]).unwrap(), 2, 1);
    assert!(receive(&mut inboxes[0]).is_none());
    assert!(receive(&mut inboxes[1]).is_none(), "it went with its sender");
}

fn having_looked_for_a_frame_is_not_having_taken_one<B: Bench>() {
    let mut bench = B::open(0, 1);
    let mut sender = bench.join();
    let (_, inboxes) = bench.ends();
    assert!(receive(&mut inboxes[0]).is_none());
    assert_eq!(send(&mut sender, 1, 2), Ok(1));
    drop(sender);
    assert!(receive(&mut inboxes[0]).is_none(), "it went with its sender");
}

fn receivers_are_counted_until_they_leave<B: Bench>() {
    let mut bench = B::open(1, 3);
    let count = |bench: &mut B| {
        let mut count = 0;
        bench.ends().0[0].receivers(&mut |process| {
            assert!(process.is_none_or(|id| id == std::process::id()));
            count += 1;
        });
        count
    };
    assert_eq!(count(&mut bench), 3);
    bench.close_inbox();
    assert_eq!(count(&mut bench), 2);
    let (outboxes, inboxes) = bench.ends();
    assert_eq!(send(&mut outboxes[0], 1, 1), Ok(2));
    // Taken or not: a receiver is there until it leaves.
    receive(&mut inboxes[0]);
    assert_eq!(count(&mut bench), 2);
}

fn each_sending_end_has_an_origin_of_its_own<B: Bench>() {
    let mut bench = B::open(2, 1);
    let (outboxes, inboxes) = bench.ends();
    let mut origins = Vec::new();
    for (step, sender) in [0, 1, 0, 1].into_iter().enumerate() {
        send(&mut outboxes[sender], step as u64, 1).unwrap();
        origins.push(receive(&mut inboxes[0]).unwrap().origin());
    }
    assert_eq!(origins[..2], origins[2..]);
    assert_ne!(origins[0], origins[1]);
    assert!(inboxes[0].process_of(origins[0]).is_none_or(|id| id == std::process::id()));
}

macro_rules! conformance {
    ($($test:ident),* $(,)?) => {
        mod memory {
            $(#[test] fn $test() { super::$test::<super::Memory>() })*
        }
        mod iceoryx2 {
            $(#[test] fn $test() { super::$test::<super::Iceoryx2>() })*
        }
    };
}

conformance!(
    nothing_comes_before_anything_is_sent,
    every_receiver_gets_every_frame_in_order,
    a_loan_shows_its_records_before_it_is_sent,
    a_frame_may_be_empty_and_may_grow,
    frames_in_flight_survive_growth,
    a_receiver_that_does_not_take_its_frames_misses_some,
    the_room_is_per_sender,
    a_loan_dropped_is_never_seen,
    a_frame_half_written_is_never_seen,
    frames_stay_as_they_are_while_held,
    what_a_sender_has_left_comes_to_those_who_had_taken_from_it,
    having_looked_for_a_frame_is_not_having_taken_one,
    receivers_are_counted_until_they_leave,
    each_sending_end_has_an_origin_of_its_own,
);

#[test]
fn the_space_of_the_last_to_leave_is_empty() {
    let name = unique_name("space");
    let run: RunName = name.parse().unwrap();
    let space = RunSpace::enter(&run).unwrap();
    let limits = ServiceLimits { publishers: 1, subscribers: 1, nodes: 2, backlog: Backlog::STEPS };
    let service = space.create::<VehicleCommand>(SERVICE, limits).unwrap();
    let other = RunSpace::enter(&run).unwrap();
    let opened = other.open::<VehicleCommand>(SERVICE).unwrap();
    let (mut outbox, mut inbox) = (opened.outbox(EXPECTED).unwrap(), service.inbox().unwrap());
    send(&mut outbox, 1, 1).unwrap();
    check(&receive(&mut inbox).unwrap(), 1, 1);
    assert!(!RunSpace::sweep(&run).unwrap(), "a run that is alive is left alone");
    send(&mut outbox, 2, 1).unwrap();
    check(&receive(&mut inbox).unwrap(), 2, 1);
    drop((inbox, service, space));
    assert_ne!(crate::common::files(None, &name), Vec::<std::path::PathBuf>::new());
    drop((outbox, opened, other));
    assert_eq!(crate::common::files(None, &name), Vec::<std::path::PathBuf>::new());
    assert!(RunSpace::sweep(&run).unwrap());
}

#[test]
fn ringing_is_left_to_others_while_any_of_them_is_awake() {
    let run: RunName = unique_name("deputies").parse().unwrap();
    let space = RunSpace::enter(&run).unwrap();
    let limits = ServiceLimits { publishers: 1, subscribers: 1, nodes: 1, backlog: Backlog::STEPS };
    let service = space.create::<VehicleCommand>(SERVICE, limits).unwrap();
    let bells = space.create_bells().unwrap();
    let receiver = bells.bell(Role::Coordinator, 0);
    let deputies = [0, 1].map(|i| bells.bell(Role::Controller, i));
    let mut outbox = service
        .outbox(EXPECTED)
        .unwrap()
        .ringing([bells.rope(Role::Coordinator, 0)])
        .leaving_it_to([0, 1].map(|i| bells.rope(Role::Controller, i)));
    let mut is_rung = |step| {
        receiver.lie_down();
        send(&mut outbox, step, 1).unwrap();
        receiver.sleep(std::time::Duration::from_millis(1)).is_some()
    };
    assert!(!is_rung(1));
    deputies[0].lie_down();
    assert!(!is_rung(2));
    deputies[1].lie_down();
    assert!(is_rung(3));
    deputies[0].stay_awake();
    assert!(!is_rung(4));
}
