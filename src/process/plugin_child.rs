//! The process of a controller written elsewhere that is driven by this one.

use crate::transport::iox::RunName;
use rustix::process::{Pid, Signal, kill_process_group};
use std::io::Error;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

/// Its process and whatever that has started; ended when dropped.
#[derive(Debug)]
pub(super) struct PluginChild {
    child: Child,
    /// Whether it shares the terminal of this process, and so its group.
    has_terminal: bool,
}

impl PluginChild {
    /// Starts a command that attaches to a run under a name; with the terminal, it may be debugged there.
    pub fn start(
        command: &[String],
        run: &RunName,
        controller: &str,
        has_terminal: bool,
    ) -> Result<PluginChild, Error> {
        let (program, arguments) =
            command.split_first().ok_or_else(|| Error::other("there is no command"))?;
        let mut command = Command::new(program);
        command.args(arguments).env("CZ_RUN", run.to_string()).env("CZ_CONTROLLER", controller);
        if !has_terminal {
            command.stdin(Stdio::null()).stdout(Stdio::null()).process_group(0);
        }
        Ok(PluginChild { child: command.spawn()?, has_terminal })
    }

    /// How it has ended, if it has.
    pub fn ended(&mut self) -> Option<std::process::ExitStatus> {
        self.child.try_wait().ok().flatten()
    }

    /// Sends a signal to it, and to whatever it started.
    pub fn signal(&self, signal: Signal) {
        let Some(id) = Pid::from_raw(self.child.id() as i32) else { return };
        // If it has ended, that is noticed soon enough.
        let _ = match self.has_terminal {
            true => rustix::process::kill_process(id, signal),
            false => kill_process_group(id, signal),
        };
    }
}

impl Drop for PluginChild {
    fn drop(&mut self) {
        if self.has_terminal && self.ended().is_some() {
            return;
        }
        self.signal(Signal::KILL);
        let _ = self.child.wait();
    }
}
