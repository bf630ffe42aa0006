//! Whether the other processes of a run are still alive.

use crate::scenario::ControllerNames;
use crate::transport::iox::RunName;
use ipc_schemas::Role;

/// Another process of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peer {
    /// Its role.
    pub role: Role,
    /// Its index among the processes of the role.
    pub index: u32,
    /// Its process id.
    pub process_id: u32,
}

impl std::fmt::Display for Peer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.role {
            Role::World => f.write_str("the world"),
            role => write!(f, "{role} {}", self.index),
        }
    }
}

impl Peer {
    /// What to call it, where controllers have names.
    pub fn name(&self, names: &ControllerNames) -> String {
        match self.role {
            Role::Controller => names.of(self.index),
            _ => self.to_string(),
        }
    }

    /// Whether it is still there.
    pub(super) fn is_alive(&self) -> bool {
        is_alive(self.process_id)
    }
}

/// The processes somebody depends on.
#[derive(Clone, Debug, Default)]
pub struct Peers(pub Vec<Peer>);

impl Peers {
    /// The first peer that is no longer alive.
    pub fn first_gone(&self) -> Option<Peer> {
        self.0.iter().copied().find(|peer| !peer.is_alive())
    }
}

/// Whether a process exists and is not merely waiting to be reaped. Its first thread may be a zombie while others run,
/// or have yet to let go of what it has locked.
pub(super) fn is_alive(process_id: u32) -> bool {
    // The id may come from anybody; what no process can have means a group elsewhere.
    let Some(id) = i32::try_from(process_id).ok().filter(|id| *id > 0) else { return false };
    match std::fs::read_to_string(format!("/proc/{process_id}/stat")) {
        // The state follows the command name, which is in parentheses and may hold any character.
        Ok(stat) => {
            let threads = || std::fs::read_dir(format!("/proc/{process_id}/task")).map_or(0, Iterator::count);
            let runs = |rest: &str| !rest.trim_start().starts_with(['Z', 'X']);
            stat.rsplit(')').next().is_some_and(runs) || threads() > 1
        }
        Err(_) => rustix::process::Pid::from_raw(id)
            .is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok()),
    }
}

/// The fields of /proc/PID/stat behind the command name, which is in parentheses and may hold any character.
fn stat(process_id: u32) -> Option<String> {
    let stat = std::fs::read_to_string(format!("/proc/{process_id}/stat")).ok()?;
    stat.rsplit(')').next().map(|rest| rest.trim_start().to_owned())
}

/// Whether a process is stopped, by a signal or by a debugger.
pub fn is_stopped(process_id: u32) -> bool {
    stat(process_id).is_some_and(|fields| fields.starts_with(['T', 't']))
}

/// The processes whose parent a process is, whether they run or are waiting to be reaped.
pub fn children_of(process_id: u32) -> Vec<u32> {
    let parent = process_id.to_string();
    let ids = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    ids.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .filter(|id| stat(*id).is_some_and(|fields| fields.split_whitespace().nth(1) == Some(&parent)))
        .collect()
}

/// Whether a part of a run is there whose supervisor has died: it is on its way out.
pub fn is_orphaned(run: &RunName) -> bool {
    let run = run.to_string();
    let ids = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    ids.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).any(|id: u32| {
        let line = std::fs::read_to_string(format!("/proc/{id}/cmdline")).unwrap_or_default();
        let value = |option| line.split('\0').skip_while(|word| *word != option).nth(1);
        let supervisor = value("--supervised").and_then(|id| id.parse().ok());
        value("--run") == Some(&run) && supervisor.is_some_and(|supervisor| !is_alive(supervisor))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_killed_child_is_gone_even_before_it_is_reaped() {
        let mut child = std::process::Command::new("sleep").arg("60").spawn().expect("sleep exists");
        assert!(is_alive(child.id()));
        child.kill().expect("the child is ours");
        while is_alive(child.id()) {
            std::thread::yield_now();
        }
        child.wait().expect("the child can be reaped");
        assert!(!is_alive(child.id()));
    }

    #[test]
    fn a_process_whose_first_thread_has_ended_is_there_while_another_runs() {
        let program = "import ctypes, threading, time
threading.Thread(target=time.sleep, args=(600,)).start()
ctypes.CDLL(None).pthread_exit(None)";
        let mut child =
            std::process::Command::new("python3").args(["-c", program]).spawn().expect("there is Python");
        let id = child.id();
        while !stat(id).expect("it has not been reaped").starts_with('Z') {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        assert!(is_alive(id));
        child.kill().expect("the child is ours");
        child.wait().expect("the child can be reaped");
        assert!(!is_alive(id));
    }
}
