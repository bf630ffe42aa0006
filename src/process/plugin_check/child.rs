//! The controller's process: started, let in, stopped.

use super::{CONTROLLER, INDEX, JOIN, Kit, Rule};
use crate::process::ProcessError;
use crate::process::plugin_child::PluginChild;
use ipc_schemas::{Member, ROLE_COORDINATOR};
use rustix::process::Signal;
use std::time::{Duration, Instant};

impl Kit<'_> {
    pub(super) fn start(&mut self) {
        match PluginChild::start(self.command, self.run, CONTROLLER, false) {
            Ok(child) => self.child = Some(child),
            Err(error) => self.breach(Rule::Attach, format!("cannot be started: {error}")),
        }
    }

    /// Ends the controller, and whatever it started.
    pub(super) fn stop(&mut self) {
        self.child = None;
    }

    /// How the controller has ended, if it has.
    pub(super) fn ended(&mut self) -> Option<String> {
        let status = self.child.as_mut()?.ended()?;
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
        self.child.iter().for_each(|child| child.signal(signal));
    }
}
