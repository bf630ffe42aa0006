//! The actuation gateway: every command passes here on its way to a vehicle.
//!
//! A frame is validated as it comes (known vehicles, the sender's own, each once, in order; finite, within
//! limits). Once all have come, the shield looks at them front first: zones downstream before zones
//! upstream, within a zone in passing order. So the motion of every partner is settled before the vehicles
//! that depend on it, and the result does not depend on the order in which frames came.

use super::car::{Car, Guard};
use super::faults::Limits;
use super::link::{Link, LinkCar};
use super::metrics::{ShieldRow, ShieldSummary};
use super::role::World;
use crate::lanes::AHEAD;
use crate::scenario::{Drivers, Exit, Scenario, ShieldMode, ZoneId};
use crate::shield::{Duty, Partner, RESERVE_M, Row, Shield};
use crate::vehicle::Held;
use ipc_schemas::{self as frames, VehicleCommand};
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
    #[error("record {record}, field planned_exit_time_s or planned_exit_speed_mps: not finite")]
    BadIntent {
        /// Place in the frame.
        record: usize,
    },
}

/// A vehicle that leaves the network more slowly speeds up to this outside, m/s.
const LEAST_EXIT_MPS: f64 = 5.0;
/// How it does, m/s^2.
const EXIT_MPS2: f64 = 2.0;

/// The gateway's configuration and what it has counted.
#[derive(Debug)]
pub(super) struct Gateway {
    mode: ShieldMode,
    shield: Shield,
    drivers: Drivers,
    rows: Vec<ShieldRow>,
    /// Motion over the step of each zone's members, in passing order; kept for its allocation.
    partners: Vec<Partner>,
    /// Whether a command of this step is to be shielded whatever the mode.
    falls_back: bool,
}

impl Gateway {
    pub(super) fn new(scenario: &Scenario, controllers: u32) -> Gateway {
        let drivers = Drivers::new(scenario, controllers);
        let names = (0..drivers.pool())
            .map(|i| if drivers.pool() == 1 { "built-in".to_owned() } else { format!("built-in {i}") })
            .chain(scenario.plugins.iter().map(|p| p.name.clone()));
        Gateway {
            mode: scenario.shield,
            shield: Shield::new(&scenario.vehicle, scenario.dt_s()),
            rows: names.map(ShieldRow::new).collect(),
            drivers,
            partners: Vec::with_capacity(2),
            falls_back: false,
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
        let limits = self.scenario.vehicle;
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
            let first = self.sites[zone as usize].first();
            for car in &mut self.cars[zone as usize][first..] {
                if shared && drivers.of(zone, car.path) != sender {
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
                if !(command.planned_exit_time_s.is_finite() && command.planned_exit_speed_mps.is_finite()) {
                    return Err(CommandFault::BadIntent { record });
                }
                if command.verdict > greatest_verdict {
                    let verdict = command.verdict;
                    return Err(CommandFault::BadVerdict { record, vehicle, verdict });
                }
                let mut u = command.u_mps2;
                car.visit.beyond = false;
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
    /// vehicle holds the acceleration it had, as far as the speed limits allow, and keeps what its controller
    /// `remembered` of it in the step before. `verdict` says on which terms.
    pub fn substitute(
        &self,
        controller: u32,
        remembered: &[VehicleCommand],
        verdict: u16,
    ) -> Vec<VehicleCommand> {
        let limits = &self.scenario.vehicle;
        let dt_s = self.scenario.dt_s();
        let memories: HashMap<(u32, u32), &VehicleCommand> =
            remembered.iter().map(|c| ((c.zone, c.vehicle), c)).collect();
        let drivers = &self.gateway.drivers;
        let members = drivers
            .zones(controller)
            .flat_map(|zone| self.members(zone as usize).iter().map(move |car| (zone, car)));
        members
            .filter(|(zone, car)| drivers.of(*zone, car.path) == controller)
            .map(|(zone, car)| {
                let memory = memories.get(&(zone, car.vehicle)).map_or_else(VehicleCommand::default, |c| **c);
                let fastest_mps2 = (limits.v_max_mps - car.v_mps) / dt_s;
                // What it had is what the state frame says it did: a bad frame may have changed the command.
                let held_mps2 = memories.get(&(zone, car.vehicle)).map_or(0.0, |_| car.u_mps2);
                VehicleCommand {
                    u_mps2: held_mps2.min(fastest_mps2).clamp(limits.u_min_mps2, limits.u_max_mps2),
                    vehicle: car.vehicle,
                    zone,
                    binding_rows: 0,
                    verdict,
                    ..memory
                }
            })
            .collect()
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
        for zone in 0..self.sites.len() {
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
    /// and within a zone in passing order, so that whoever a vehicle depends on has been settled before.
    pub(super) fn hold_all(&mut self, scenario: &Scenario, dt_s: f64) {
        if let Some(faults) = self.faults.as_mut().filter(|faults| faults.has_channels()) {
            let time_s = scenario.time_s(self.step);
            let sites = &self.sites;
            faults.deliver(self.step, time_s, Limits::of(scenario), &mut self.cars, |z| sites[z].first());
        }
        for zone in (0..self.sites.len()).rev() {
            if self.on_links > 0 {
                self.drive_link(scenario, zone, dt_s);
            }
            if self.sites[zone].has_left {
                self.hold_left(scenario, zone);
            }
            if self.gateway.mode != ShieldMode::Off || self.gateway.falls_back {
                self.shield_zone(zone);
            }
        }
        self.gateway.falls_back = false;
    }

    /// Index 0 moves with the vehicle it stands for.
    pub(super) fn hold_left(&mut self, scenario: &Scenario, zone: usize) {
        let mut left_from = self.sites[zone].left_from;
        let u = self.left_mps2(scenario, zone, &mut left_from, &self.cars[zone][0]);
        self.sites[zone].left_from = left_from;
        self.cars[zone][0].command_mps2 = u;
    }

    /// What a vehicle that has left a zone holds over the step; `left_from` is the last zone it is known to
    /// have left.
    pub(super) fn left_mps2(
        &self,
        scenario: &Scenario,
        zone: usize,
        left_from: &mut ZoneId,
        car: &Car,
    ) -> f64 {
        let u = self.followed_mps2(left_from, car.vehicle);
        // Out of the network nobody drives it. Whoever left it creeping must not creep for ever: those behind
        // would have to leave more slowly each, down to a standstill.
        if self.sites[zone].exit == Exit::Out && car.v_mps < LEAST_EXIT_MPS {
            return EXIT_MPS2.min(scenario.vehicle.u_max_mps2);
        }
        u
    }

    /// What a vehicle holds over the step, wherever it is now; 0 once it has left the network.
    fn followed_mps2(&self, left_from: &mut ZoneId, vehicle: u32) -> f64 {
        loop {
            let from = *left_from as usize;
            if self.on_links > 0
                && let Some(on_link) = self.links[from].cars.iter().find(|c| c.car.vehicle == vehicle)
            {
                return on_link.held.u_mps2;
            }
            let Exit::Zone { zone: next, .. } = self.sites[from].exit else { return 0.0 };
            if let Some(car) = self.members(next as usize).iter().rev().find(|c| c.vehicle == vehicle) {
                return car.command_mps2;
            }
            *left_from = next;
        }
    }

    /// Projects the commands of a zone's members, in passing order.
    fn shield_zone(&mut self, zone: usize) {
        let lengths_m = &self.lengths_m[zone];
        let Gateway { mode, shield, drivers, rows, partners, .. } = &mut self.gateway;
        let cars = &mut self.cars[zone];
        for i in self.sites[zone].first()..cars.len() {
            let (before, rest) = cars.split_at_mut(i);
            let car = &mut rest[0];
            let falls_back = car.visit.verdict == frames::VERDICT_FALLBACK;
            if *mode == ShieldMode::Off && !falls_back {
                continue;
            }
            // The partners of `coordination::partners`, from the same order.
            let ahead = before.iter().rev().find(|c| c.path == car.path);
            let previous = before.last().filter(|c| c.path != car.path);
            let own_length_m = lengths_m[car.path as usize];
            let merge = Duty::Merge { conflict_m: own_length_m };
            partners.clear();
            for (duty, other) in [(Duty::RearEnd, ahead), (merge, previous)] {
                let Some(other) = other else { continue };
                let shift_m = own_length_m - lengths_m[other.path as usize];
                let motion = Held::new(other.x_m + shift_m, other.v_mps, other.command_mps2);
                let partner = Partner { duty, motion };
                let guard =
                    if duty == Duty::RearEnd { &mut car.visit.rear_end } else { &mut car.visit.merge };
                let row = &mut rows[drivers.of(zone as u32, car.path) as usize];
                // Judged when the vehicle comes to owe this partner something, and held to it from then on.
                if guard.partner != other.vehicle {
                    let safe = shield.state_slack_m(car.x_m, car.v_mps, &partner) >= RESERVE_M;
                    *guard = Guard { partner: other.vehicle, safe };
                    row.began_unsafe += u32::from(!safe);
                }
                partners.push(partner);
            }
            let row = &mut rows[drivers.of(zone as u32, car.path) as usize];
            row.commands += 1;
            let found = shield.project(car.x_m, car.v_mps, car.command_mps2, partners.iter().copied());
            row.bounded += u64::from(car.visit.beyond || found.row.is_some());
            match found.row {
                None => {}
                Some(Row::Speed) => row.speed += 1,
                Some(Row::RearEnd) => row.rear_end += 1,
                Some(Row::Merge) => row.merge += 1,
            }
            if *mode == ShieldMode::On || falls_back {
                car.command_mps2 = found.u_mps2;
            }
            let held = car.held();
            for partner in partners.iter() {
                let (guard, least) = if partner.duty == Duty::RearEnd {
                    (car.visit.rear_end, &mut row.min_rear_end_margin_m)
                } else {
                    (car.visit.merge, &mut row.min_merge_margin_m)
                };
                if guard.safe {
                    let margin = shield.least_margin_m(&held, partner);
                    if margin < least.unwrap_or(f64::INFINITY) {
                        *least = Some(margin);
                    }
                    row.lost += u32::from(shield.slack_after_m(&held, partner) < 0.0);
                }
            }
        }
    }

    /// Lets the vehicles on the link behind a zone choose, front first, so that each sees what its leader
    /// will do.
    fn drive_link(&mut self, scenario: &Scenario, zone: usize, dt_s: f64) {
        if self.links[zone].cars.is_empty() {
            return;
        }
        let Exit::Zone { zone: down, path, link_m, .. } = scenario.network.zones[zone].exit else { return };
        let last = self.members(down as usize).iter().rev().find(|c| c.path == path);
        let mut leader = last.map(|c| Held::new(c.x_m + link_m, c.v_mps, c.command_mps2));
        let Link { speed_mps, cars, .. } = &mut self.links[zone];
        for LinkCar { car, held } in cars {
            let k = scenario.control.k_rear_end_per_s;
            let mut u = super::link::drive(car, *speed_mps, leader.as_ref(), &scenario.vehicle, k, dt_s);
            if self.gateway.mode == ShieldMode::On {
                let partner = leader.map(|motion| Partner { duty: Duty::RearEnd, motion });
                u = self.gateway.shield.project(car.x_m, car.v_mps, u, partner.into_iter()).u_mps2;
            }
            *held = Held::new(car.x_m, car.v_mps, u);
            leader = Some(*held);
        }
    }
}
