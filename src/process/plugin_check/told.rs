//! What the controller is told of its answers: what the shield finds of them, what is refused of them, and, for a while,
//! everything that could be said, whether there is reason to or not.

use super::{INDEX, Kit, TELL_FROM, TELL_TO};
use crate::lockstep::Refusal;
use crate::process::ProcessError;
use crate::transport::{Loan, Outbox};
use crate::world::CommandFault;
use ipc_schemas::{self as frames, Feedback, HeaderFault, Role, VehicleCommand, VehicleState};

/// The rows of the shield, with the kind of duty that each is about.
const ROWS: [(u16, Option<u16>); 5] = [
    (frames::ROW_SPEED, None),
    (frames::ROW_REAR_END, Some(frames::CONSTRAINT_REAR_END)),
    (frames::ROW_MERGE, Some(frames::CONSTRAINT_MERGE)),
    (frames::ROW_CROSS, Some(frames::CONSTRAINT_CROSS)),
    (frames::ROW_LIMITS, None),
];

impl Kit<'_> {
    /// Says what bounded the commands of the step before, ahead of the state of this one.
    pub(super) fn tell_bounds(&mut self, states: &[VehicleState]) -> Result<(), ProcessError> {
        let step = self.world.step();
        let told = if (TELL_FROM..TELL_TO).contains(&step) {
            self.every_row(step, states)
        } else {
            let own = |f: &&Feedback| u32::from(f.controller) == INDEX;
            self.world.feedback().iter().filter(own).copied().collect()
        };
        self.tell(&told)
    }

    /// Says why an answer was not taken, at once.
    pub(super) fn tell_refusal(&mut self, refusal: &Refusal) -> Result<(), ProcessError> {
        let told = refusal.feedback(self.world.step(), INDEX as u16);
        self.tell(told.as_slice())
    }

    /// Another refusal in each of these steps, of an answer that was taken.
    pub(super) fn tell_some_refusal(&mut self, records: &[VehicleCommand]) -> Result<(), ProcessError> {
        let step = self.world.step();
        if !(TELL_FROM..TELL_TO).contains(&step) {
            return Ok(());
        }
        let refusals = every_refusal(step, records.first().copied().unwrap_or_default());
        self.tell_refusal(&refusals[(step - TELL_FROM) as usize % refusals.len()])
    }

    /// Of each vehicle that was commanded in the step before another row, all of them in turn.
    fn every_row(&self, step: u64, states: &[VehicleState]) -> Vec<Feedback> {
        let all = self.commanded.iter().zip(step..);
        let rows = all.map(|(command, turn)| {
            let (row, kind) = ROWS[turn as usize % ROWS.len()];
            let mut duties = self.in_force[command.zone as usize].iter();
            let partner = duties.find(|a| a.vehicle == command.vehicle && Some(a.kind) == kind);
            let anybody = || states.iter().find(|s| s.vehicle != command.vehicle).map(|s| s.vehicle);
            let toward = kind.and_then(|_| partner.map(|a| a.partner).or_else(anybody));
            Feedback {
                value: command.u_mps2,
                least: -4.0,
                greatest: command.u_mps2 - 0.5,
                step: step - 1,
                vehicle: command.vehicle,
                zone: command.zone,
                toward: toward.unwrap_or(frames::NO_VEHICLE),
                controller: INDEX as u16,
                row,
                ..Feedback::default()
            }
        });
        rows.collect()
    }

    fn tell(&mut self, told: &[Feedback]) -> Result<(), ProcessError> {
        if !told.is_empty() {
            let header = self.header(Role::World, self.world.step());
            self.feedback.loan(header, told.len(), |s| told.iter().for_each(|r| s.push(*r)))?.send()?;
        }
        Ok(())
    }
}

/// Everything for which the world refuses an answer to this step that begins with this command.
fn every_refusal(step: u64, command: VehicleCommand) -> Vec<Refusal> {
    let VehicleCommand { vehicle, zone, .. } = command;
    let record = 0;
    let faults = [
        CommandFault::OutOfLimits { record, vehicle, u_mps2: 9.0, min_mps2: -4.0, max_mps2: 4.0 },
        CommandFault::NotFinite { record, vehicle, u_mps2: f64::NAN },
        CommandFault::BadIntent { record, vehicle, is_speed: false, value: f64::INFINITY },
        CommandFault::BadIntent { record, vehicle, is_speed: true, value: f64::NAN },
        CommandFault::BadVerdict { record, vehicle, verdict: 5 },
        CommandFault::OtherZone { record, vehicle, zone: zone + 1, expected: zone },
        CommandFault::UnknownVehicle { record, vehicle: 4_000_000 },
        CommandFault::ForeignVehicle { record, vehicle, driver: 0 },
        CommandFault::Duplicate { record: 1, vehicle },
        CommandFault::MissingVehicle { record, vehicle, zone },
    ];
    let headers = [
        HeaderFault::OtherSchema { expected: 1, found: 2 },
        HeaderFault::OtherRun { expected: 1, found: 2 },
        HeaderFault::OtherSender {
            expected_role: Role::Controller,
            expected_index: INDEX as u16,
            found_role: 0,
            found_index: 0,
        },
        HeaderFault::OldGeneration { expected: 1, found: 0 },
        HeaderFault::OtherStep { expected: step, found: step - 1 },
        HeaderFault::OtherCount { announced: 2, found: 1 },
    ];
    let mut all: Vec<Refusal> = headers.into_iter().map(Refusal::Header).collect();
    all.extend(faults.into_iter().map(|fault| Refusal::Command { step, fault }));
    all.push(Refusal::Unexpected { step: step - 1 });
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_rule_and_every_field_is_told() {
        let all = every_refusal(TELL_FROM, VehicleCommand::default());
        assert!((all.len() as u64) < TELL_TO - TELL_FROM);
        let told: Vec<Feedback> = all.iter().filter_map(|r| r.feedback(TELL_FROM, 1)).collect();
        let rules: BTreeSet<u16> = told.iter().map(|f| f.rule).collect();
        assert_eq!(rules, (frames::RULE_LIMITS..=frames::RULE_UNASKED).collect());
        let fields: BTreeSet<u16> = told.iter().map(|f| f.field).collect();
        assert_eq!(fields, (frames::FIELD_U_MPS2..=frames::FIELD_SENDER).collect());
    }
}
