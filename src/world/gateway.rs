//! The actuation gateway: every command passes here on its way to a vehicle.
//!
//! A frame is validated as it comes (known vehicles, the sender's own, each once, in order; finite, within
//! limits). Once all have come, the shield looks at them front first: zones downstream before zones
//! upstream, within a zone in passing order. So the motion of every partner is settled before the vehicles
//! that depend on it, and the result does not depend on the order in which frames came.

use super::command_fault::CommandFault;
use super::faults::Limits;
use super::metrics::{ShieldRow, ShieldSummary};
use super::owed::Standing;
use super::role::World;
use crate::conflict::DutyKind;
use crate::lists::AHEAD;
use crate::scenario::{Drivers, Scenario, ShieldMode};
use crate::shield::{Partner, Row, Shield};
use ipc_schemas::{self as frames, Feedback, VehicleCommand};
use std::collections::HashMap;

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

    /// The shields of vehicles on links, by kind, if these are shielded.
    pub(super) fn shields_of_links(&self) -> Option<&[Shield]> {
        (self.mode == ShieldMode::On).then_some(&self.shields)
    }

    pub(super) fn summary(&self) -> ShieldSummary {
        ShieldSummary { mode: self.mode, controllers: self.rows.clone() }
    }
}

impl World {
    /// Shares the paths out over the built-in pool and the plug-ins, `controllers` processes in all.
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
}
