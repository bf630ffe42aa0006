//! One run whose vehicles are driven from outside: the roles in turn, in this thread, with no frames between them.

use control_zones::conflict::DutyKind;
use control_zones::control::{ControllerPool, Partner, Situation, Terminal};
use control_zones::coordination::Coordinator;
use control_zones::scenario::{Scenario, ZoneId};
use control_zones::world::{Sheet, World};
use ipc_schemas::{VehicleCommand, VehicleState};
use std::sync::Arc;

/// What is told of each vehicle, in this order. Differences are "the other's minus its own"; what there is none of is 0.
pub const FEATURES: [&str; 22] = [
    "present",
    "path",
    "x_m",
    "v_mps",
    "u_mps2",
    "remaining_m",
    "in_zone_s",
    "has_terminal",
    "terminal_mps",
    "has_schedule",
    "scheduled_in_m",
    "scheduled_in_s",
    "has_ahead",
    "ahead_m",
    "ahead_mps",
    "ahead_mps2",
    "has_merge",
    "merge_m",
    "merge_mps",
    "merge_mps2",
    "merge_in_m",
    "law_mps2",
];

/// Why a run cannot go on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RunError {
    /// An action is no number.
    #[error("step {step}, zone {zone}: action {row} is {value}, expected a number")]
    Action {
        /// Step.
        step: u64,
        /// Name of the zone.
        zone: String,
        /// Place in the zone's row of actions.
        row: usize,
        /// What stands there.
        value: f64,
    },
    /// The roles contradict each other.
    #[error("step {step}: {fault}")]
    Roles {
        /// Step.
        step: u64,
        /// What is wrong.
        fault: String,
    },
}

/// The records of a state frame.
#[derive(Debug, Default)]
struct Page(Vec<VehicleState>);

impl Sheet for Page {
    fn push(&mut self, record: VehicleState) {
        self.0.push(record);
    }

    fn written(&self) -> &[VehicleState] {
        &self.0
    }
}

/// A run before a step: everybody has decided, and nobody has moved.
#[derive(Debug)]
pub struct Run {
    world: World,
    coordinator: Coordinator,
    pool: ControllerPool,
    /// Zones driven from outside, in the order of their rows.
    zones: Arc<[ZoneId]>,
    /// Vehicles of a zone that can be driven from outside; the law drives those behind.
    capacity: usize,
    states: Page,
    acting: Vec<VehicleState>,
    /// What the law decides, in frame order.
    commands: Vec<VehicleCommand>,
    /// By row of zones, where its commands begin and how many there are.
    places: Vec<(usize, usize)>,
    /// Zone by zone and row by row, `FEATURES` of each vehicle.
    features: Vec<f64>,
    /// What each zone has cost so far.
    cost: Vec<f64>,
    ended: bool,
}

impl Run {
    /// A run at its first step.
    ///
    /// # Errors
    /// When the roles contradict each other, which the protocol rules out.
    pub fn new(scenario: &Arc<Scenario>, zones: Arc<[ZoneId]>, capacity: usize) -> Result<Run, RunError> {
        let all = 0..scenario.network.zones.len() as ZoneId;
        let mut run = Run {
            world: World::new(scenario.clone(), 1),
            coordinator: Coordinator::new(scenario.clone(), all.clone()),
            pool: ControllerPool::new(scenario.clone(), all),
            features: vec![0.0; zones.len() * capacity * FEATURES.len()],
            places: vec![(0, 0); zones.len()],
            cost: vec![0.0; zones.len()],
            zones,
            capacity,
            states: Page::default(),
            acting: Vec::new(),
            commands: Vec::new(),
            ended: false,
        };
        run.decide()?;
        Ok(run)
    }

    /// The world as it stands.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Whether the run is over.
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// Whether it ended because its time was up, with vehicles on their way.
    pub fn is_out_of_time(&self) -> bool {
        let scenario = self.world.scenario();
        self.ended && scenario.time_s(self.world.step()) >= scenario.max_time_s
    }

    /// Zone by zone and row by row, [`FEATURES`] of each vehicle.
    pub fn features(&self) -> &[f64] {
        &self.features
    }

    /// The ids of the vehicles in the rows; [`ipc_schemas::NO_VEHICLE`] in rows of nobody.
    pub fn vehicles(&self) -> impl Iterator<Item = u32> + '_ {
        self.places.iter().flat_map(move |&(from, count)| {
            let own = self.commands[from..from + count].iter().map(|command| command.vehicle);
            own.chain(std::iter::repeat(ipc_schemas::NO_VEHICLE)).take(self.capacity)
        })
    }

    /// Vehicles behind the last row of their zone, which the law drives.
    pub fn unseen(&self) -> usize {
        self.places.iter().map(|&(_, count)| count.saturating_sub(self.capacity)).sum()
    }

    /// Moves everybody by one step: those in the rows as the actions say, within their limits, the others as the law
    /// decides. What the step has cost each zone, negative, goes to `rewards`. A vehicle that is told what the law
    /// decides keeps the plan that the law broadcasts for it; others have none.
    ///
    /// # Errors
    /// When an action is no number; then nobody has moved.
    pub fn step(&mut self, actions: &[f64], rewards: &mut [f64]) -> Result<(), RunError> {
        rewards.fill(0.0);
        if self.ended {
            return Ok(());
        }
        self.take(actions)?;
        let step = self.world.step();
        let failed = |fault: String| RunError::Roles { step, fault };
        self.world.command(0, &self.commands).map_err(|fault| failed(fault.to_string()))?;
        self.world.advance().map_err(|error| failed(error.to_string()))?;
        for ((zone, cost), reward) in self.zones.iter().zip(&mut self.cost).zip(rewards) {
            let now = self.world.zone_cost(*zone);
            *reward = *cost - now;
            *cost = now;
        }
        self.decide()
    }

    /// Writes the actions into the commands.
    fn take(&mut self, actions: &[f64]) -> Result<(), RunError> {
        let scenario = self.world.scenario();
        let rows = || self.places.iter().zip(actions.chunks(self.capacity)).enumerate();
        for (lane, (&(_, count), actions)) in rows() {
            if let Some(row) = actions.iter().take(count).position(|action| !action.is_finite()) {
                let zone = scenario.network.zones[self.zones[lane] as usize].name.clone();
                return Err(RunError::Action { step: self.world.step(), zone, row, value: actions[row] });
            }
        }
        for (&(from, count), actions) in self.places.iter().zip(actions.chunks(self.capacity)) {
            for (command, &action) in self.commands[from..from + count].iter_mut().zip(actions) {
                let kind = match scenario.fleet.len() {
                    1 => 0,
                    _ => self.states.0.iter().find(|s| s.vehicle == command.vehicle).map_or(0, |s| s.kind),
                };
                let limits = &scenario.fleet[usize::from(kind)].vehicle;
                if action != command.u_mps2 {
                    let u_mps2 = action.clamp(limits.u_min_mps2, limits.u_max_mps2);
                    let VehicleCommand { vehicle, zone, .. } = *command;
                    *command = VehicleCommand { u_mps2, vehicle, zone, ..VehicleCommand::default() };
                }
            }
        }
        Ok(())
    }

    /// Publishes the state and lets coordinator and law decide, unless the run is over.
    fn decide(&mut self) -> Result<(), RunError> {
        self.ended = self.world.is_finished();
        let masks = self.world.coordinator_masks();
        self.acting.clear();
        self.acting.extend(self.world.coordinator_records(0));
        self.states.0.clear();
        self.world.publish(&mut self.states);
        self.commands.clear();
        self.places.fill((0, 0));
        self.features.fill(0.0);
        if self.ended {
            return Ok(());
        }
        let (step, time_ns) = (self.world.step(), self.world.time_ns());
        let states = &self.states.0;
        let failed = |fault: control_zones::control::pool::PoolError| RunError::Roles {
            step,
            fault: fault.to_string(),
        };
        if masks.acting != 0 {
            self.coordinator.act(step, &self.acting);
            let assignments = self.coordinator.assignments();
            self.pool.coordinate(states, assignments).map_err(failed)?;
            // Who owes what to whom, by which the shield judges, the world knows from coordinators alone.
            self.world.coordinate(assignments);
        }
        let time_s = time_ns as f64 * 1e-9;
        let commands = &mut self.commands;
        self.pool.command(time_s, states, |command| commands.push(command)).map_err(failed)?;
        for (place, &zone) in self.places.iter_mut().zip(&*self.zones) {
            let from = commands.partition_point(|command| command.zone < zone);
            *place = (from, commands[from..].partition_point(|command| command.zone == zone));
        }
        let Run { zones, places, features, capacity, .. } = self;
        let mut at = 0;
        self.pool
            .survey(time_s, states, |state, situation, partners| {
                let law_mps2 = commands[at].u_mps2;
                if let Some(lane) = zones.iter().position(|&zone| zone == state.zone) {
                    let row = at - places[lane].0;
                    if row < *capacity {
                        let from = (lane * *capacity + row) * FEATURES.len();
                        tell(
                            &mut features[from..from + FEATURES.len()],
                            state,
                            situation,
                            partners,
                            law_mps2,
                        );
                    }
                }
                at += 1;
            })
            .map_err(failed)
    }
}

/// Writes what is told of a vehicle.
fn tell(
    features: &mut [f64],
    state: &VehicleState,
    situation: &Situation,
    partners: &mut dyn Iterator<Item = Partner>,
    law_mps2: f64,
) {
    let (mut ahead, mut merge) = (None::<Partner>, None::<Partner>);
    for partner in partners {
        if partner.kind == DutyKind::RearEnd {
            if ahead.is_none_or(|known| partner.x_m < known.x_m) {
                ahead = Some(partner);
            }
        } else if merge.is_none_or(|known| partner.conflict_m < known.conflict_m) {
            merge = Some(partner);
        }
    }
    let (x_m, v_mps) = (situation.x_m, situation.v_mps);
    let terminal = match situation.terminal {
        Terminal::Free => [0.0, 0.0],
        Terminal::Speed(speed_mps) => [1.0, speed_mps],
    };
    let schedule = situation
        .schedule
        .map_or([0.0; 3], |schedule| [1.0, schedule.at_m - x_m, schedule.time_s - situation.time_s]);
    let seen = |partner: Option<Partner>| {
        partner.map_or([0.0; 4], |p| [1.0, p.x_m - x_m, p.v_mps - v_mps, p.u_mps2])
    };
    let own = [
        1.0,
        f64::from(state.path),
        x_m,
        v_mps,
        state.u_mps2,
        situation.length_m - x_m,
        situation.time_s - situation.entry_time_s,
    ];
    let (ahead, met) = (seen(ahead), seen(merge));
    let last = [merge.map_or(0.0, |merge| merge.conflict_m - x_m), law_mps2];
    let all = [&own[..], &terminal, &schedule, &ahead, &met, &last];
    features.iter_mut().zip(all.into_iter().flatten()).for_each(|(feature, value)| *feature = *value);
}
