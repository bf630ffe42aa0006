//! The controller's answers: waited for, judged, and replaced where they break a rule.

use super::{BRAKE_FROM, BRAKE_TO, INDEX, Kit, PATIENCE, PAUSE_AT, Rule, TELL_FROM, TELL_TO};
use crate::lockstep::Refusal;
use crate::process::ProcessError;
use crate::transport::iox::IoxFrame;
use crate::transport::{Frame, Inbox};
use crate::world::CommandFault;
use ipc_schemas::{ExpectedHeader, HeaderFault, Role, VehicleCommand, VehicleState};
use std::time::{Duration, Instant};

impl Kit<'_> {
    /// What the kit puts in for the controller: accelerations of 0.
    pub(super) fn substitute(&self, states: &[VehicleState]) -> Vec<VehicleCommand> {
        let drivers = self.world.drivers();
        let is_own = |s: &&VehicleState| s.is_commanded() && drivers.of(s.zone, s.path) == INDEX;
        let own = states.iter().filter(is_own);
        own.map(|s| VehicleCommand { vehicle: s.vehicle, zone: s.zone, ..VehicleCommand::default() })
            .collect()
    }

    /// Waits for the controller's answer, and takes it. `false` when there is no point in going on.
    pub(super) fn answer(&mut self, states: &[VehicleState], sent: Instant) -> Result<bool, ProcessError> {
        let step = self.world.step();
        let substitute = self.substitute(states);
        let rule = match (step, substitute.is_empty()) {
            (PAUSE_AT, _) => Rule::Pause,
            (BRAKE_FROM..BRAKE_TO, _) => Rule::HardBraking,
            (TELL_FROM..TELL_TO, _) => Rule::Feedback,
            (_, true) => Rule::EmptyZone,
            _ => Rule::Alive,
        };
        let frame = loop {
            if let Some(frame) = self.commands.receive()? {
                break frame;
            }
            let waited = sent.elapsed();
            if waited >= PATIENCE {
                self.breach(rule, format!("no answer within {} s", PATIENCE.as_secs()));
                return Ok(false);
            }
            if waited.as_millis() >= 2 {
                if let Some(how) = self.ended() {
                    let is_told = (TELL_FROM..TELL_TO).contains(&step);
                    self.breach(if is_told { Rule::Feedback } else { Rule::Alive }, how);
                    return Ok(false);
                }
                std::thread::sleep(Duration::from_micros(50));
            } else {
                std::thread::yield_now();
            }
        };
        let took = sent.elapsed();
        let _ = self.latency_ns.record(took.as_nanos() as u64);
        self.answered += 1;
        if took > self.deadline {
            let ms = |d: Duration| d.as_secs_f64() * 1e3;
            self.breach(
                Rule::Deadline,
                format!("took {:.1} ms, allowed are {:.1}", ms(took), ms(self.deadline)),
            );
        }
        self.take(frame, states)?;
        Ok(true)
    }

    /// Takes the controller's answer, or replaces it.
    pub(super) fn take(
        &mut self,
        frame: IoxFrame<VehicleCommand>,
        states: &[VehicleState],
    ) -> Result<(), ProcessError> {
        let step = self.world.step();
        let substitute = self.substitute(states);
        let generation = self.reception.generation(INDEX as usize);
        let index = INDEX as u16;
        let expected =
            ExpectedHeader { run_id: self.run_id, role: Role::Controller, index, generation, step };
        let header = expected.check(frame.header(), frame.records().len());
        let mut records = frame.records().to_vec();
        drop(frame);
        // A second frame would be taken for the answer to the next step.
        std::thread::yield_now();
        while let Some(extra) = self.commands.receive()? {
            let step = extra.header().step;
            drop(extra);
            self.breach(Rule::OncePerStep, format!("a second frame, with step {step} in its header"));
        }
        if let Err(fault) = header {
            let rule = match fault {
                HeaderFault::OtherSchema { .. } => Rule::Schema,
                HeaderFault::OtherRun { .. } => Rule::Run,
                HeaderFault::OtherSender { .. } => Rule::Sender,
                HeaderFault::OldGeneration { .. } | HeaderFault::UnknownGeneration { .. } => Rule::Generation,
                HeaderFault::OtherStep { .. } => Rule::Step,
                HeaderFault::OtherCount { .. } => Rule::Count,
            };
            self.breach(rule, fault.to_string());
            self.tell_refusal(&Refusal::Header(fault))?;
            records.clone_from(&substitute);
        }
        if let Err(fault) = self.world.command(INDEX, &records) {
            let rule = match fault {
                CommandFault::UnknownVehicle { .. } | CommandFault::ForeignVehicle { .. } => {
                    Rule::OwnVehicles
                }
                CommandFault::Duplicate { .. } => Rule::NoDuplicates,
                CommandFault::MissingVehicle { .. } => Rule::AllVehicles,
                CommandFault::OtherZone { .. } => Rule::Zone,
                CommandFault::NotFinite { .. } | CommandFault::BadIntent { .. } => Rule::Finite,
                CommandFault::OutOfLimits { .. } => Rule::Limits,
                CommandFault::BadVerdict { .. } => Rule::Verdict,
            };
            self.breach(rule, fault.to_string());
            self.tell_refusal(&Refusal::Command { step, fault })?;
            self.world.forget_commands();
            let mut all = substitute;
            std::mem::swap(&mut records, &mut all);
            // The built-in pool's commands were forgotten with the bad ones.
            let mut own = Vec::new();
            let time_s = self.world.time_ns() as f64 * 1e-9;
            self.pool.command(time_s, states, |c| own.push(c)).expect("it has answered this step before");
            self.world.command(0, &own).expect("the built-in pool answers as it should");
            self.world.command(INDEX, &records).expect("the substitute is as it should be");
        }
        self.tell_some_refusal(&records)?;
        self.commanded = records;
        self.world.advance().expect("all vehicles have been commanded");
        Ok(())
    }
}
