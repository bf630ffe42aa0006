//! On which cores the processes of a run are.

use ipc_schemas::Role;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Where processes go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Placement {
    /// Wherever the system puts them.
    #[default]
    None,
    /// The world on the first core; controllers on the others in turn; coordinators with the controllers,
    /// where a hand-over costs no wake-up of an idle core.
    Auto,
}

/// Pins the calling process by its role; returns its core, or `None` when it was left where it is.
pub fn place(placement: Placement, role: Role, index: u32) -> Option<usize> {
    if placement == Placement::None {
        return None;
    }
    let allowed = sched_getaffinity(None).ok()?;
    let cores: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|&core| allowed.is_set(core)).collect();
    let core = match (role, &cores[..]) {
        (_, []) => return None,
        (Role::World, [first, ..]) | (_, [first]) => *first,
        (_, [_, others @ ..]) => others[index as usize % others.len()],
    };
    let mut set = CpuSet::new();
    set.set(core);
    sched_setaffinity(None, &set).ok()?;
    Some(core)
}
