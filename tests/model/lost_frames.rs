//! Frames that go with their senders: coordinators and controllers are killed and replaced at seeded instants of
//! seeded schedules, over the in-memory transport, which loses frames as the other one does.

use control_zones::control::ControllerPool;
use control_zones::coordination::Coordinator;
use control_zones::lockstep::in_process::{ControllerSide, CoordinatorSide, InProcess, WorldSide};
use control_zones::lockstep::{
    ControllerDriver, ControllerPorts, CoordinatorDriver, CoordinatorPorts, Handover, Identity, Members,
    Progress, Seat, WorldDriver, WorldPorts,
};
use control_zones::scenario::share::{neighbour_coordinators, zones_of};
use control_zones::scenario::{Override, Scenario, load};
use control_zones::transport::memory::{MemoryOutbox, MemoryService};
use control_zones::transport::{Backlog, Loan, Outbox, Slots};
use control_zones::world::World;
use ipc_schemas::{Assignment, Member, Role, VehicleCommand, VehicleState, ZoneSummary};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;

const COORDINATORS: u32 = 3;
const CONTROLLERS: u32 = 2;
const RUN_ID: u64 = 7;
const WORLD: u32 = 1;

#[derive(Debug)]
enum Driver {
    Coordinator(Box<CoordinatorSide>),
    Controller(Box<ControllerSide>),
}

impl Driver {
    fn advance(&mut self) -> Progress {
        match self {
            Driver::Coordinator(driver) => driver.advance().unwrap(),
            Driver::Controller(driver) => driver.advance().unwrap(),
        }
    }

    fn take_over(&mut self, handover: Handover) {
        match self {
            Driver::Coordinator(driver) => driver.take_over(handover),
            Driver::Controller(driver) => driver.take_over(handover),
        }
    }
}

/// What stands at a place.
#[derive(Debug)]
enum Place {
    Present(Driver),
    /// Ready, and waiting for what it needs.
    Waiting(Driver),
    Killed,
    Left,
}

/// How a run differs from one that does all it should.
#[derive(Clone, Copy, Default)]
struct Omission {
    /// The world leaves as soon as it has sent the end.
    no_farewell: bool,
    /// Whoever takes a coordinator's place does not send again what its predecessor has sent.
    not_again: bool,
}

/// Who is killed, and how often at most.
struct Kills {
    most: u32,
    /// One place only; the others live.
    only: Option<usize>,
}

impl Kills {
    const NONE: Kills = Kills { most: 0, only: None };
}

struct Services {
    scenario: Arc<Scenario>,
    state: MemoryService<VehicleState>,
    coordinator_states: Vec<MemoryService<VehicleState>>,
    coordination: MemoryService<Assignment>,
    summaries: Vec<MemoryService<ZoneSummary>>,
    command: MemoryService<VehicleCommand>,
    members: MemoryService<Member>,
}

impl Services {
    fn new(scenario: &Arc<Scenario>) -> Services {
        let each = 0..COORDINATORS;
        Services {
            scenario: scenario.clone(),
            state: MemoryService::new(),
            coordinator_states: each.clone().map(|_| MemoryService::new()).collect(),
            coordination: MemoryService::new(),
            summaries: each.map(|_| MemoryService::holding(Backlog::Bounded(4))).collect(),
            command: MemoryService::new(),
            members: MemoryService::holding(Backlog::Last),
        }
    }

    fn zones(&self) -> u32 {
        self.scenario.network.zones.len() as u32
    }

    fn driver(&self, role: Role, index: u32, generation: u32, id: u32) -> Driver {
        let identity = Identity { run_id: RUN_ID, role, index: index as u16, generation };
        let members = Members::told_by(WORLD, self.members.inbox_of(id));
        let own = |count| zones_of(self.zones(), index, count);
        if role == Role::Controller {
            let ports = ControllerPorts {
                state: self.state.inbox_of(id),
                coordination: self.coordination.inbox_of(id),
                command: self.command.outbox_of(id),
                members,
            };
            let pool = ControllerPool::new(self.scenario.clone(), own(CONTROLLERS));
            return Driver::Controller(Box::new(ControllerDriver::new(pool, ports, identity, 0)));
        }
        let mask = neighbour_coordinators(&self.scenario.network, COORDINATORS)[index as usize];
        let to = |n: u32| {
            (n as u16, zones_of(self.zones(), n, COORDINATORS), self.summaries[n as usize].outbox_of(id))
        };
        let ports = CoordinatorPorts {
            state: self.coordinator_states[index as usize].inbox_of(id),
            summaries: self.summaries[index as usize].inbox_of(id),
            neighbours: (0..COORDINATORS).filter(|n| mask >> n & 1 == 1).map(to).collect(),
            coordination: self.coordination.outbox_of(id),
            members,
        };
        let coordinator = Coordinator::new(self.scenario.clone(), own(COORDINATORS));
        Driver::Coordinator(Box::new(CoordinatorDriver::new(coordinator, ports, identity)))
    }

    fn world(&self) -> WorldSide {
        let outbox = |service: &MemoryService<VehicleState>| service.outbox_of(WORLD);
        let ports = WorldPorts {
            state: outbox(&self.state),
            coordinator_states: self.coordinator_states.iter().map(outbox).collect(),
            command: self.command.inbox_of(WORLD),
            coordination: Some(self.coordination.inbox_of(WORLD)),
        };
        WorldDriver::new(World::new(self.scenario.clone(), COORDINATORS), ports, RUN_ID, CONTROLLERS)
    }
}

fn tell(outbox: &mut MemoryOutbox<Member>, world: &WorldSide) {
    let members: Vec<Member> = world.members().collect();
    let identity = Identity { run_id: RUN_ID, role: Role::World, index: 0, generation: 0 };
    let header = identity.header(world.world().step(), 0);
    let fill = |slots: &mut Slots<'_, Member>| members.iter().for_each(|m| slots.push(*m));
    outbox.loan(header, members.len(), fill).unwrap().send().unwrap();
}

/// Rounds without progress after which a run is stuck.
const STUCK: u32 = 4000;

/// Runs the scenario under a schedule; returns the state hash and the number of kills, or what it is stuck in.
fn run(scenario: &Arc<Scenario>, seed: u64, kills: &Kills, omission: Omission) -> Result<(u64, u32), String> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let services = Services::new(scenario);
    let place = |at: usize| match at as u32 {
        at if at < COORDINATORS => (Role::Coordinator, at),
        at => (Role::Controller, at - COORDINATORS),
    };
    let mut next_id = 100;
    let mut id = || {
        next_id += 1;
        next_id
    };
    let places = (COORDINATORS + CONTROLLERS) as usize;
    // Whoever opens its ends first.
    let world_first = rng.random_bool(0.5);
    let early = world_first.then(|| services.world());
    let ids: Vec<u32> = (0..places).map(|_| id()).collect();
    let mut there: Vec<Place> = (0..places)
        .map(|at| {
            let (role, index) = place(at);
            Place::Present(services.driver(role, index, 0, ids[at]))
        })
        .collect();
    let mut world = early.unwrap_or_else(|| services.world());
    let mut outbox = services.members.outbox_of(WORLD);
    let mut generations = vec![0; places];
    for (at, &id) in ids.iter().enumerate() {
        let (role, index) = place(at);
        world.seat(role, index, Seat::new(0, id));
    }
    tell(&mut outbox, &world);
    let mut world = Some((world, outbox));
    let (mut hash, mut killed, mut idle) = (None, 0, 0);
    while there.iter().any(|place| !matches!(place, Place::Left)) || world.is_some() {
        idle += 1;
        if idle > STUCK {
            return Err(format!("stuck with {there:?}"));
        }
        let at = rng.random_range(0..=places);
        if at == places {
            let Some((driver, _)) = &mut world else { continue };
            for _ in 0..rng.random_range(1..4) {
                match driver.advance().unwrap() {
                    Progress::Advanced => idle = 0,
                    Progress::Finished => {
                        hash = Some(driver.world().state_hash());
                        if omission.no_farewell || driver.receivers().is_empty() {
                            world = None;
                        }
                        break;
                    }
                    _ => break,
                }
            }
            continue;
        }
        let (role, index) = place(at);
        let ask = |world: &Option<(WorldSide, _)>| {
            let handover = world.as_ref().and_then(|(driver, _)| driver.handover(role, index))?;
            let summarised = if omission.not_again { 0 } else { handover.summarised };
            Some(Handover { summarised, ..handover })
        };
        match std::mem::replace(&mut there[at], Place::Killed) {
            Place::Left => there[at] = Place::Left,
            Place::Killed if hash.is_some() => there[at] = Place::Left,
            Place::Killed => {
                let Some((driver, outbox)) = &mut world else { continue };
                let id = id();
                generations[at] += 1;
                let newcomer = services.driver(role, index, generations[at], id);
                driver.seat(role, index, Seat::new(generations[at], id));
                tell(outbox, driver);
                there[at] = Place::Waiting(newcomer);
                idle = 0;
            }
            Place::Waiting(mut driver) => match ask(&world) {
                Some(handover) => {
                    driver.take_over(handover);
                    there[at] = Place::Present(driver);
                    idle = 0;
                }
                None if hash.is_some() => there[at] = Place::Left,
                None => there[at] = Place::Waiting(driver),
            },
            Place::Present(mut driver) => {
                let mut left = false;
                for _ in 0..rng.random_range(1..5) {
                    match driver.advance() {
                        Progress::Advanced => idle = 0,
                        Progress::Waiting(_) => break,
                        Progress::Behind => {
                            if let Some(handover) = ask(&world) {
                                driver.take_over(handover);
                                idle = 0;
                            }
                        }
                        Progress::Finished => {
                            left = true;
                            idle = 0;
                            break;
                        }
                    }
                }
                if left {
                    there[at] = Place::Left;
                } else if killed < kills.most
                    && kills.only.is_none_or(|only| only == at)
                    && rng.random_bool(0.03)
                {
                    // Dropped here, with all its ends.
                    killed += 1;
                } else {
                    there[at] = Place::Present(driver);
                }
            }
        }
    }
    Ok((hash.unwrap(), killed))
}

fn scenario(end_s: &str) -> Arc<Scenario> {
    let sets: Vec<Override> = vec![format!("end.time_s={end_s}").parse().unwrap()];
    Arc::new(load(Some("tree"), &sets, None).unwrap())
}

fn undisturbed(scenario: &Arc<Scenario>) -> u64 {
    let mut run = InProcess::new(scenario, 1, 1);
    run.run().unwrap();
    run.world().state_hash()
}

#[test]
fn no_frame_is_lost_with_whoever_is_killed_whatever_the_schedule() {
    let scenario = scenario("40");
    let expected = undisturbed(&scenario);
    let mut killed = 0;
    for seed in 0..90 {
        // Everybody, or one coordinator again and again, whose neighbours must live with what it has left.
        let only = (seed % 2 == 1).then_some(seed as usize / 2 % COORDINATORS as usize);
        let kills = Kills { most: 300, only };
        let ended = run(&scenario, seed, &kills, Omission::default());
        let (hash, kills) = ended.unwrap_or_else(|how| panic!("seed {seed}: {how}"));
        assert_eq!(hash, expected, "seed {seed}");
        killed += kills;
    }
    assert!(killed > 5000, "only {killed} were killed");
}

#[test]
fn summaries_that_nobody_sends_again_are_missed() {
    // What the test above would see without what it tests.
    let scenario = scenario("40");
    let omission = Omission { not_again: true, ..Omission::default() };
    let stuck = |seed: &u64| {
        let kills = Kills { most: 100, only: Some(*seed as usize % COORDINATORS as usize) };
        run(&scenario, *seed, &kills, omission).is_err()
    };
    let stuck = (0..30).filter(stuck).count();
    assert!(stuck > 0, "no schedule lost a summary");
    println!("{stuck} of 30 schedules were stuck");
}

#[test]
fn a_short_run_ends_for_everybody() {
    for end_s in ["0.1", "0.5"] {
        let scenario = scenario(end_s);
        let expected = undisturbed(&scenario);
        for seed in 0..200 {
            let ended = run(&scenario, seed, &Kills::NONE, Omission::default());
            assert_eq!(ended, Ok((expected, 0)), "seed {seed}");
        }
    }
}

#[test]
fn a_world_that_does_not_wait_takes_the_end_with_it() {
    let scenario = scenario("0.5");
    let omission = Omission { no_farewell: true, ..Omission::default() };
    let stuck = (0..200).filter(|&seed| run(&scenario, seed, &Kills::NONE, omission).is_err()).count();
    assert!(stuck > 0, "nobody missed the end");
    println!("{stuck} of 200 short runs lost their end");
}
