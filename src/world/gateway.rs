//! The actuation gateway: every command passes here on its way to a vehicle.
//!
//! A frame is validated as it comes (known vehicles, the sender's own, each once, in order; finite, within
//! limits). Once all have come, the shield looks at them front first: zones downstream before zones
//! upstream, within a zone in passing order. So the motion of every partner is settled before the vehicles
//! that depend on it, and the result does not depend on the order in which frames came.

use super::car::{Beyond, Car};
use super::faults::Limits;
use super::link::LinkCar;
use super::metrics::{ShieldRow, ShieldSummary};
use super::owed::Standing;
use super::role::World;
use crate::conflict::DutyKind;
use crate::lists::AHEAD;
use crate::scenario::{Drivers, Scenario, ShieldMode};
use crate::shield::{Partner, Row, Shield};
use crate::vehicle::Held;
use ipc_schemas::{self as frames, Feedback, VehicleCommand};
use std::collections::HashMap;

/// A command frame the world cannot take.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CommandFault {
    /// The vehicle is not a member of any zone: it never existed, is on a link, or has left.
    #[error("record {record}, field vehicle: vehicle {vehicle} is in no zone")]
    UnknownVehicle {
        /// Place in the frame.
        record: usize,
        /// Vehicle named.
        vehicle: u32,
    },
    /// Another controller drives the vehicle.
    #[error("record {record}, field vehicle: vehicle {vehicle} is driven by controller {driver}")]
    ForeignVehicle {
        /// Place in the frame.
        record: usize,
        /// Vehicle named.
        vehicle: u32,
        /// Index of the controller that drives it.
        driver: u32,
    },
    /// The frame commands the vehicle twice.
    #[error("record {record}, field vehicle: vehicle {vehicle} is commanded twice")]
    Duplicate {
        /// Place in the frame of the second.
        record: usize,
        /// Vehicle named.
        vehicle: u32,
    },
    /// A vehicle of the sender has no command where it should have one.
    #[error("record {record}, field vehicle: vehicle {vehicle} of zone {zone} has no command there")]
    MissingVehicle {
        /// Place in the frame at which it was expected.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Its zone.
        zone: u32,
    },
    /// The record names a zone the vehicle is not in.
    #[error("record {record}, field zone: vehicle {vehicle} is in zone {expected}, not {zone}")]
    OtherZone {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Zone named.
        zone: u32,
        /// Zone the vehicle is in.
        expected: u32,
    },
    /// The acceleration is not a number.
    #[error("record {record}, field u_mps2: vehicle {vehicle} is commanded {u_mps2}")]
    NotFinite {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Acceleration commanded.
        u_mps2: f64,
    },
    /// The acceleration is not within the vehicle's limits.
    #[error(
        "record {record}, field u_mps2: vehicle {vehicle} is commanded {u_mps2} m/s^2, which is not within \
         [{min_mps2}, {max_mps2}]"
    )]
    OutOfLimits {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Acceleration commanded.
        u_mps2: f64,
        /// Least allowed.
        min_mps2: f64,
        /// Greatest allowed.
        max_mps2: f64,
    },
    /// The verdict is one that only the world gives, or has no meaning.
    #[error(
        "record {record}, field verdict: vehicle {vehicle} has verdict {verdict}, expected 0 to {}",
        frames::VERDICT_INFEASIBLE
    )]
    BadVerdict {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Verdict claimed.
        verdict: u16,
    },
    /// The planned exit, which other vehicles may read, is not a number.
    #[error("record {record}, field {}: vehicle {vehicle} has {value}", if *is_speed { "planned_exit_speed_mps" } else { "planned_exit_time_s" })]
    BadIntent {
        /// Place in the frame.
        record: usize,
        /// The vehicle.
        vehicle: u32,
        /// Whether it is the speed, and not the instant.
        is_speed: bool,
        /// What was sent.
        value: f64,
    },
}

impl CommandFault {
    /// The same as a controller is told it; step and controller are for the caller to fill in.
    pub fn feedback(&self) -> Feedback {
        let told = |record: usize, vehicle, rule, field| Feedback {
            record: record as u32,
            vehicle,
            rule,
            field,
            zone: frames::NO_ZONE,
            toward: frames::NO_VEHICLE,
            ..Feedback::default()
        };
        use CommandFault as Fault;
        match *self {
            Fault::UnknownVehicle { record, vehicle } => {
                told(record, vehicle, frames::RULE_UNKNOWN, frames::FIELD_VEHICLE)
            }
            Fault::ForeignVehicle { record, vehicle, .. } => {
                told(record, vehicle, frames::RULE_FOREIGN, frames::FIELD_VEHICLE)
            }
            Fault::Duplicate { record, vehicle } => {
                told(record, vehicle, frames::RULE_TWICE, frames::FIELD_VEHICLE)
            }
            Fault::MissingVehicle { record, vehicle, zone } => {
                Feedback { zone, ..told(record, vehicle, frames::RULE_MISSING, frames::FIELD_VEHICLE) }
            }
            Fault::OtherZone { record, vehicle, zone, expected } => Feedback {
                value: f64::from(zone),
                least: f64::from(expected),
                greatest: f64::from(expected),
                zone: expected,
                ..told(record, vehicle, frames::RULE_OTHER, frames::FIELD_ZONE)
            },
            Fault::NotFinite { record, vehicle, .. } => {
                told(record, vehicle, frames::RULE_NOT_FINITE, frames::FIELD_U_MPS2)
            }
            Fault::OutOfLimits { record, vehicle, u_mps2, min_mps2, max_mps2 } => Feedback {
                value: u_mps2,
                least: min_mps2,
                greatest: max_mps2,
                ..told(record, vehicle, frames::RULE_LIMITS, frames::FIELD_U_MPS2)
            },
            Fault::BadVerdict { record, vehicle, verdict } => Feedback {
                value: f64::from(verdict),
                greatest: f64::from(frames::VERDICT_INFEASIBLE),
                ..told(record, vehicle, frames::RULE_LIMITS, frames::FIELD_VERDICT)
            },
            Fault::BadIntent { record, vehicle, is_speed, .. } => {
                let fields = [frames::FIELD_PLANNED_EXIT_TIME_S, frames::FIELD_PLANNED_EXIT_SPEED_MPS];
                told(record, vehicle, frames::RULE_NOT_FINITE, fields[usize::from(is_speed)])
            }
        }
    }
}

/// A vehicle that leaves the network more slowly speeds up to this outside, m/s.
const LEAST_EXIT_MPS: f64 = 5.0;
/// How it does, m/s^2.
const EXIT_MPS2: f64 = 2.0;

/// What the world has vehicles do in place of their controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PutIn {
    /// Each holds the acceleration it had, as far as the speed limits allow, on the terms of this verdict.
    Held(u16),
    /// Each makes for its speed limit as far as the shield allows: holding on for ever, whoever has had to brake would
    /// stand for ever.
    ToLimit,
}

impl PutIn {
    fn verdict(self) -> u16 {
        match self {
            PutIn::Held(verdict) => verdict,
            PutIn::ToLimit => frames::VERDICT_FALLBACK,
        }
    }
}

/// A vehicle that makes for its speed limit comes nearer to it with this time constant, s.
const DRIVE_ON_S: f64 = 2.0;

/// The gateway's configuration and what it has counted.
#[derive(Debug)]
pub(super) struct Gateway {
    mode: ShieldMode,
    /// By kind of vehicle.
    pub(super) shields: Vec<Shield>,
    drivers: Drivers,
    rows: Vec<ShieldRow>,
    /// The partners of one vehicle, and which of its duties each belongs to; kept for its allocation.
    partners: Vec<(Partner, usize)>,
    /// Whether a command of this step is to be shielded whatever the mode.
    falls_back: bool,
    /// What the shield found of the commands of controllers written elsewhere, in the step just ended.
    feedback: Vec<Feedback>,
}

impl Gateway {
    pub(super) fn new(scenario: &Scenario, controllers: u32) -> Gateway {
        let drivers = Drivers::new(scenario, controllers);
        let names = (0..drivers.pool())
            .map(|i| if drivers.pool() == 1 { "built-in".to_owned() } else { format!("built-in {i}") })
            .chain(scenario.plugins.iter().map(|p| p.name.clone()));
        Gateway {
            mode: scenario.shield,
            shields: scenario.fleet.iter().map(|kind| Shield::new(&kind.vehicle, scenario.dt_s())).collect(),
            rows: names.map(ShieldRow::new).collect(),
            drivers,
            partners: Vec::with_capacity(16),
            falls_back: false,
            feedback: Vec::new(),
        }
    }

    /// Whether the commands of this step are applied as they are.
    pub(super) fn is_off(&self) -> bool {
        self.mode == ShieldMode::Off && !self.falls_back
    }

    pub(super) fn summary(&self) -> ShieldSummary {
        ShieldSummary { mode: self.mode, controllers: self.rows.clone() }
    }
}

impl World {
    /// Shares the approaches out over the built-in pool and the plug-ins, `controllers` processes in all.
    /// Without it, one process drives everything that no plug-in drives.
    pub fn share_out(&mut self, controllers: u32) {
        // A world that goes on from a recording keeps what it has counted.
        if self.gateway.drivers.count() != controllers {
            self.rebuild_gateway(controllers);
        }
    }

    pub(super) fn rebuild_gateway(&mut self, controllers: u32) {
        self.gateway = Gateway::new(&self.scenario, controllers);
    }

    /// Which controller drives what.
    pub fn drivers(&self) -> &Drivers {
        &self.gateway.drivers
    }

    /// Takes one controller's commands for the present step, as they came from it.
    ///
    /// With the shield on, an acceleration that is no number becomes `u_min` and one beyond the limits the
    /// limit, and both are counted; otherwise they are faults.
    ///
    /// # Errors
    /// What is wrong with the first bad record. The frame does not count then; another must come before the
    /// step can be integrated.
    pub fn command(&mut self, sender: u32, commands: &[VehicleCommand]) -> Result<(), CommandFault> {
        self.take(sender, commands, frames::VERDICT_INFEASIBLE)
    }

    /// The same for what the world puts in a controller's place (see [`substitute`](Self::substitute)): only
    /// then may a verdict say so. Such commands have no way to go, so no fault on the way reaches them.
    ///
    /// # Errors
    /// As above.
    pub fn put_in(&mut self, controller: u32, commands: &[VehicleCommand]) -> Result<(), CommandFault> {
        self.take(controller, commands, frames::VERDICT_FALLBACK)
    }

    fn take(
        &mut self,
        sender: u32,
        commands: &[VehicleCommand],
        greatest_verdict: u16,
    ) -> Result<(), CommandFault> {
        let kinds = &self.kinds;
        let Gateway { mode, drivers, rows, falls_back, .. } = &mut self.gateway;
        let (mut beyond, mut not_finite) = (0, 0);
        let mut next = 0;
        let mut fault = None;
        'zones: for zone in drivers.zones(sender) {
            // Drivers are asked about each vehicle only where there are several.
            let shared = match drivers.of_zone(zone) {
                Some(driver) if driver != sender => continue,
                driver => driver.is_none(),
            };
            self.cars.fetch(zone as usize + AHEAD);
            let first = self.zones[zone as usize].first();
            for car in &mut self.cars[zone as usize][first..] {
                if shared && drivers.of(zone, car.path) != sender {
                    continue;
                }
                if !car.is_commanded {
                    continue;
                }
                let record = next;
                let Some(command) = commands.get(record).filter(|c| c.vehicle == car.vehicle) else {
                    fault = Some((record, car.vehicle, zone));
                    break 'zones;
                };
                let vehicle = command.vehicle;
                if command.zone != zone {
                    return Err(CommandFault::OtherZone {
                        record,
                        vehicle,
                        zone: command.zone,
                        expected: zone,
                    });
                }
                let intent = [command.planned_exit_time_s, command.planned_exit_speed_mps];
                if let Some(at) = intent.iter().position(|value| !value.is_finite()) {
                    let (is_speed, value) = (at == 1, intent[at]);
                    return Err(CommandFault::BadIntent { record, vehicle, is_speed, value });
                }
                if command.verdict > greatest_verdict {
                    let verdict = command.verdict;
                    return Err(CommandFault::BadVerdict { record, vehicle, verdict });
                }
                let mut u = command.u_mps2;
                car.visit.beyond = false;
                let limits = &kinds[usize::from(car.kind)];
                let (min_mps2, max_mps2) = (limits.u_min_mps2, limits.u_max_mps2);
                // Written so that NaN is no exception.
                if !(u >= min_mps2 && u <= max_mps2) {
                    match *mode {
                        ShieldMode::On if u.is_finite() => {
                            car.visit.beyond = true;
                            beyond += 1;
                            u = u.clamp(min_mps2, max_mps2);
                        }
                        ShieldMode::On => {
                            car.visit.beyond = true;
                            not_finite += 1;
                            u = min_mps2;
                        }
                        _ if u.is_finite() => {
                            let u_mps2 = u;
                            let fault =
                                CommandFault::OutOfLimits { record, vehicle, u_mps2, min_mps2, max_mps2 };
                            return Err(fault);
                        }
                        _ => return Err(CommandFault::NotFinite { record, vehicle, u_mps2: u }),
                    }
                }
                car.command_mps2 = u;
                car.planned_exit_time_s = command.planned_exit_time_s;
                car.planned_exit_speed_mps = command.planned_exit_speed_mps;
                car.visit.verdict = command.verdict;
                *falls_back |= command.verdict == frames::VERDICT_FALLBACK;
                next += 1;
            }
        }
        if fault.is_none() && next == commands.len() {
            let row = &mut rows[sender as usize];
            row.limits += beyond;
            row.not_finite += not_finite;
            self.commanded += next as u32;
            return Ok(());
        }
        match fault {
            Some((record, vehicle, zone)) => {
                Err(self.mismatch(sender, commands, record, Some((vehicle, zone))))
            }
            None => Err(self.mismatch(sender, commands, next, None)),
        }
    }

    /// What to command in place of a controller that has not answered, in the order of its frames: each
    /// vehicle does as `put_in` says, and keeps what its controller `remembered` of it in the step before.
    pub fn substitute(
        &self,
        controller: u32,
        remembered: &[VehicleCommand],
        put_in: PutIn,
    ) -> Vec<VehicleCommand> {
        let dt_s = self.scenario.dt_s();
        let memories: HashMap<(u32, u32), &VehicleCommand> =
            remembered.iter().map(|c| ((c.zone, c.vehicle), c)).collect();
        let drivers = &self.gateway.drivers;
        let members = drivers
            .zones(controller)
            .flat_map(|zone| self.members(zone as usize).iter().map(move |car| (zone, car)));
        members
            .filter(|(zone, car)| drivers.of(*zone, car.path) == controller && car.is_commanded)
            .map(|(zone, car)| {
                let memory = memories.get(&(zone, car.vehicle)).map_or_else(VehicleCommand::default, |c| **c);
                let limits = &self.kinds[usize::from(car.kind)];
                let fastest_mps2 = (limits.v_max_mps - car.v_mps) / dt_s;
                // What it had is what the state frame says it did: a bad frame may have changed the command.
                let held_mps2 = memories.get(&(zone, car.vehicle)).map_or(0.0, |_| car.u_mps2);
                let wish_mps2 = match put_in {
                    PutIn::Held(_) => held_mps2.min(fastest_mps2),
                    PutIn::ToLimit => (limits.v_max_mps - car.v_mps) / DRIVE_ON_S,
                };
                VehicleCommand {
                    u_mps2: wish_mps2.clamp(limits.u_min_mps2, limits.u_max_mps2),
                    vehicle: car.vehicle,
                    zone,
                    binding_rows: 0,
                    verdict: put_in.verdict(),
                    ..memory
                }
            })
            .collect()
    }

    /// What the shield found of the commands that controllers written elsewhere gave for the step just ended, as far as it
    /// had to bound them: by zones, the last first.
    pub fn feedback(&self) -> &[Feedback] {
        &self.gateway.feedback
    }

    /// Forgets the commands taken for this step, so that all can be given again.
    pub fn forget_commands(&mut self) {
        self.commanded = 0;
    }

    /// What is wrong with a frame whose record is not the one expected there (vehicle and zone; `None` at
    /// the end of the frame).
    fn mismatch(
        &self,
        sender: u32,
        commands: &[VehicleCommand],
        record: usize,
        expected: Option<(u32, u32)>,
    ) -> CommandFault {
        let missing = |(vehicle, zone)| CommandFault::MissingVehicle { record, vehicle, zone };
        let (Some(found), expected) = (commands.get(record), expected) else {
            return missing(
                expected.expect("a frame longer or shorter than asked for has a record at fault"),
            );
        };
        let vehicle = found.vehicle;
        if commands[..record].iter().any(|c| c.vehicle == vehicle) {
            return CommandFault::Duplicate { record, vehicle };
        }
        let mut driver = None;
        for zone in 0..self.zones.len() {
            if let Some(car) = self.members(zone).iter().find(|c| c.vehicle == vehicle) {
                driver = Some(self.gateway.drivers.of(zone as u32, car.path));
            }
        }
        match (driver, expected) {
            (None, _) => CommandFault::UnknownVehicle { record, vehicle },
            (Some(driver), _) if driver != sender => CommandFault::ForeignVehicle { record, vehicle, driver },
            (Some(_), Some(expected)) => missing(expected),
            (Some(_), None) => CommandFault::Duplicate { record, vehicle },
        }
    }

    /// Settles what every vehicle holds over the step: what has reached it, shielded. Zones downstream first,
    /// and within a zone in passing order, so that whoever a vehicle depends on has been settled before. Where the
    /// network closes a circle somebody comes first: for the vehicles it depends on that are not settled yet, it
    /// reckons with full braking.
    pub(super) fn hold_all(&mut self, scenario: &Scenario, dt_s: f64) {
        if let Some(faults) = self.faults.as_mut().filter(|faults| faults.has_channels()) {
            let time_s = scenario.time_s(self.step);
            let zones = &self.zones;
            let first = |z: usize| zones[z].first();
            faults.deliver(self.step, time_s, Limits::of(scenario), &mut self.cars, first);
        }
        let shields = self.gateway.mode != ShieldMode::Off || self.gateway.falls_back;
        self.gateway.feedback.clear();
        for zone in (0..self.zones.len()).rev() {
            if self.links.cars > 0 {
                self.links.range(zone as u32).for_each(|link| self.drive_link(scenario, zone, link, dt_s));
            }
            self.hold_left(scenario, zone, shields);
            if shields {
                self.shield_zone(zone);
            }
        }
        // What was assumed of vehicles that had left is replaced by what they do.
        while let Some((zone, at)) = self.scratch.assumed.pop() {
            self.cars[zone as usize][at].command_mps2 = self.followed(scenario, zone as usize, at).u_mps2;
        }
        self.gateway.falls_back = false;
    }

    /// Those that have left a zone move with the vehicles they stand for. With `settling`, what is not settled yet
    /// is taken for full braking until it is.
    pub(super) fn hold_left(&mut self, scenario: &Scenario, zone: usize, settling: bool) {
        for at in 0..self.zones[zone].first() {
            let Followed { u_mps2, is_settled } = self.followed(scenario, zone, at);
            let car = &mut self.cars[zone][at];
            car.command_mps2 = u_mps2;
            if settling && !is_settled {
                car.command_mps2 = self.kinds[usize::from(car.kind)].u_min_mps2;
                self.scratch.assumed.push((zone as u32, at));
            }
        }
    }

    /// What a vehicle that left a zone holds over the step, wherever it is now.
    fn followed(&mut self, scenario: &Scenario, zone: usize, at: usize) -> Followed {
        let mut car = self.cars[zone][at];
        let followed = self.follow(scenario, zone, &mut car);
        self.cars[zone][at].beyond = car.beyond;
        followed
    }

    /// The same, of a vehicle that need not be among the zone's; it is told how far it has come.
    pub(super) fn follow(&self, scenario: &Scenario, zone: usize, car: &mut Car) -> Followed {
        let Car { vehicle, v_mps, kind, mut beyond, .. } = *car;
        let found = loop {
            if self.links.cars > 0
                && let Some(link) = self.links.behind(beyond.zone, beyond.exit)
                && let Some(on_link) = self.links.all[link].cars.iter().find(|c| c.car.vehicle == vehicle)
            {
                break Some((on_link.held.u_mps2, beyond.zone as usize >= zone));
            }
            let exit = &scenario.network.zones[beyond.zone as usize].exits[beyond.exit as usize];
            let Some(to) = exit.to else { break None };
            if let Some(car) = self.members(to.zone as usize).iter().rev().find(|c| c.vehicle == vehicle) {
                beyond.next_exit = self.conflicts[to.zone as usize].exit(car.path);
                break Some((car.command_mps2, to.zone as usize > zone));
            }
            beyond = Beyond { zone: to.zone, exit: beyond.next_exit, next_exit: 0 };
        };
        car.beyond = beyond;
        match found {
            Some((u_mps2, is_settled)) => Followed { u_mps2, is_settled },
            // Out of the network nobody drives it. Whoever left it creeping must not creep for ever: those behind
            // would have to leave more slowly each, down to a standstill.
            None if v_mps < LEAST_EXIT_MPS => {
                let u_max_mps2 = self.kinds[usize::from(kind)].u_max_mps2;
                Followed { u_mps2: EXIT_MPS2.min(u_max_mps2), is_settled: true }
            }
            None => Followed { u_mps2: 0.0, is_settled: true },
        }
    }

    /// Projects the commands of a zone's members, in passing order.
    fn shield_zone(&mut self, zone: usize) {
        let Gateway { mode, shields, drivers, rows, partners, feedback, .. } = &mut self.gateway;
        let cars = &mut self.cars[zone];
        let owed = &mut self.owed[zone];
        for &at in &self.order[zone] {
            let car = cars[at as usize];
            let falls_back = car.visit.verdict == frames::VERDICT_FALLBACK;
            if (*mode == ShieldMode::Off && !falls_back) || !car.is_commanded {
                continue;
            }
            let shield = &shields[usize::from(car.kind)];
            let driver = drivers.of(zone as u32, car.path);
            let row = &mut rows[driver as usize];
            partners.clear();
            for (at, owed) in owed[car.owed.0 as usize..car.owed.1 as usize].iter_mut().enumerate() {
                let other = &cars[owed.duty.partner as usize];
                let Some(partner) = owed.partner(&car, other, &self.kinds) else {
                    continue;
                };
                // Judged when the vehicle comes to owe this partner something, and held to it from then on.
                if owed.standing == Standing::Unknown {
                    row.began_unsafe += u32::from(owed.judge(shield, &car, other, &self.kinds));
                }
                partners.push((partner, at));
            }
            row.commands += 1;
            let all = partners.iter().map(|(partner, _)| *partner);
            let found = shield.project(car.x_m, car.v_mps, car.command_mps2, all);
            let is_bounded = car.visit.beyond || found.row.is_some();
            row.bounded += u64::from(is_bounded);
            if is_bounded && driver >= drivers.pool() {
                let toward = found.toward.map(|at| owed[car.owed.0 as usize + partners[at].1].duty.partner);
                feedback.push(Feedback {
                    value: car.command_mps2,
                    least: self.kinds[usize::from(car.kind)].u_min_mps2,
                    greatest: found.u_mps2,
                    step: self.step,
                    vehicle: car.vehicle,
                    zone: zone as u32,
                    toward: toward.map_or(frames::NO_VEHICLE, |at| cars[at as usize].vehicle),
                    controller: driver as u16,
                    row: match found.row {
                        None => frames::ROW_LIMITS,
                        Some(Row::Speed) => frames::ROW_SPEED,
                        Some(Row::RearEnd) => frames::ROW_REAR_END,
                        Some(Row::Merge) => frames::ROW_MERGE,
                        Some(Row::Cross) => frames::ROW_CROSS,
                    },
                    ..Feedback::default()
                });
            }
            match found.row {
                None => {}
                Some(Row::Speed) => row.speed += 1,
                Some(Row::RearEnd) => row.rear_end += 1,
                Some(Row::Merge) => row.merge += 1,
                Some(Row::Cross) => row.cross += 1,
            }
            if *mode == ShieldMode::On || falls_back {
                cars[at as usize].command_mps2 = found.u_mps2;
            }
            let held = cars[at as usize].held();
            for (partner, at) in partners.iter() {
                if owed[car.owed.0 as usize + at].standing != Standing::Safe {
                    continue;
                }
                let least = match partner.kind {
                    DutyKind::RearEnd => &mut row.min_rear_end_margin_m,
                    DutyKind::Merge => &mut row.min_merge_margin_m,
                    DutyKind::Cross => &mut row.min_cross_margin_m,
                };
                let margin = shield.least_margin_m(&held, partner);
                if margin < least.unwrap_or(f64::INFINITY) {
                    *least = Some(margin);
                }
                row.lost += u32::from(shield.slack_after_m(&held, partner) < 0.0);
            }
        }
    }

    /// Lets the vehicles on a link choose, front first, so that each sees what its leader will do.
    fn drive_link(&mut self, scenario: &Scenario, zone: usize, link: usize, dt_s: f64) {
        if self.links.all[link].cars.is_empty() {
            return;
        }
        let to = self.links.all[link].to;
        let there = &scenario.network.zones[to.zone as usize];
        let enters = |path: u32| there.paths[path as usize].segments[0] == to.segment;
        let last = self.members(to.zone as usize).iter().rev().find(|c| enters(c.path));
        // In a network that closes a circle the zone there may not be settled yet.
        let is_settled = to.zone as usize > zone;
        let mut leader = last.map(|c| {
            let u_mps2 = if is_settled && c.is_commanded {
                c.command_mps2
            } else {
                self.kinds[usize::from(c.kind)].u_min_mps2
            };
            (Held::new(c.x_m + to.link_m, c.v_mps, u_mps2), c.kind)
        });
        let Gateway { mode, shields, .. } = &self.gateway;
        for LinkCar { car, held } in &mut self.links.all[link].cars {
            let k = scenario.control.k_rear_end_per_s;
            let own = &self.kinds[usize::from(car.kind)];
            let gap_m = |other: u16| {
                let extra_m = self.kinds[usize::from(other)].length_m - scenario.vehicle.length_m;
                own.standstill_gap_m + extra_m.max(0.0)
            };
            let ahead = leader.map(|(motion, kind)| (motion, gap_m(kind)));
            let mut u = super::link::drive(car, to.link_speed_mps, ahead, own, k, dt_s);
            if *mode == ShieldMode::On {
                let partner = leader.map(|(motion, kind)| Partner {
                    kind: DutyKind::RearEnd,
                    at_m: 0.0,
                    gap_m: gap_m(kind),
                    braking_mps2: -self.kinds[usize::from(kind)].u_min_mps2,
                    motion,
                });
                let shield = &shields[usize::from(car.kind)];
                u = shield.project(car.x_m, car.v_mps, u, partner.into_iter()).u_mps2;
            }
            *held = Held::new(car.x_m, car.v_mps, u);
            leader = Some((*held, car.kind));
        }
    }
}

/// What a vehicle that left a zone holds over the step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Followed {
    pub u_mps2: f64,
    /// Whether that is settled when the zone it left is about to be.
    is_settled: bool,
}
