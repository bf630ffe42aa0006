//! The controller's process: started, let in, stopped.

use super::{CONTROLLER, INDEX, JOIN, Kit, Rule};
use crate::process::ProcessError;
use ipc_schemas::{Member, ROLE_COORDINATOR};
use rustix::process::{Pid, Signal, kill_process_group};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

impl Kit<'_> {
    pub(super) fn start(&mut self) -> Result<(), ProcessError> {
        let child = Command::new(&self.command[0])
            .args(&self.command[1..])
            .env("CZ_RUN", self.run.to_string())
            .env("CZ_CONTROLLER", CONTROLLER)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .process_group(0)
            .spawn();
        match child {
            Ok(child) => self.child = Some(child),
            Err(error) => self.breach(Rule::Attach, format!("cannot be started: {error}")),
        }
        Ok(())
    }

    /// Ends the controller, and whatever it started.
    pub(super) fn stop(&mut self) {
        if let Some(mut child) = self.child.take() {
            if let Some(group) = Pid::from_raw(child.id() as i32) {
                let _ = kill_process_group(group, Signal::KILL);
            }
            let _ = child.wait();
        }
    }

    /// How the controller has ended, if it has.
    pub(super) fn ended(&mut self) -> Option<String> {
        let status = self.child.as_mut()?.try_wait().ok()??;
        Some(format!("it ended: {status}"))
    }

    /// Waits for the controller to join and say ready.
    pub(super) fn admit(&mut self, rule: Rule) -> Result<bool, ProcessError> {
        let deadline = Instant::now() + JOIN;
        while !self.reception.is_ready(INDEX as usize) {
            self.hand_over(None)?;
            if let Some(reason) = self.reception.last_refusal.take() {
                let rule = if reason.contains("schema") { Rule::Schema } else { rule };
                self.breach(rule, format!("attach request refused: {reason}"));
                return Ok(false);
            }
            let late = (Instant::now() >= deadline).then(|| format!("not ready after {} s", JOIN.as_secs()));
            if let Some(how) = self.ended().or(late) {
                self.breach(rule, how);
                return Ok(false);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        // The coordinator is in this process, and so is its sending end.
        let own = Member { process_id: std::process::id(), role: ROLE_COORDINATOR, ..Member::default() };
        self.members.tell(self.world.step(), [own].into_iter())?;
        Ok(true)
    }

    /// Stops the controller, and whatever it started, or lets them go on.
    pub(super) fn signal(&self, signal: Signal) {
        let id = self.child.as_ref().and_then(|child| Pid::from_raw(child.id() as i32));
        if let Some(group) = id {
            // If it has ended, that is noticed soon enough.
            let _ = kill_process_group(group, signal);
        }
    }
}
