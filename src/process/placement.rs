//! On which cores the processes of a run are.

use ipc_schemas::Role;
use rustix::thread::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};
use std::io::Read;
use std::sync::OnceLock;

/// Where processes go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Placement {
    /// Wherever the system puts them.
    #[default]
    None,
    /// The world on the first core; controllers on the others in turn, then on the first too; coordinators
    /// with the controllers, where a hand-over costs no wake-up of an idle core.
    Auto,
}

/// Runs `spawn` with the affinity the calling thread had before it was placed, which a child inherits.
pub fn unplaced<T>(original: Option<&Affinity>, spawn: impl FnOnce() -> T) -> T {
    let Some(Affinity(original)) = original else { return spawn() };
    let placed = sched_getaffinity(None);
    let _ = sched_setaffinity(None, original);
    let result = spawn();
    if let Ok(placed) = placed {
        let _ = sched_setaffinity(None, &placed);
    }
    result
}

/// The cores a thread may use.
#[derive(Debug)]
pub struct Affinity(CpuSet);

impl Affinity {
    /// Of the calling thread.
    pub fn current() -> Option<Affinity> {
        sched_getaffinity(None).ok().map(Affinity)
    }

    /// Gives them back to the calling thread.
    pub fn restore(&self) {
        let _ = sched_setaffinity(None, &self.0);
    }
}

/// Pins the calling thread, and what it starts from then on, by its role; returns its core, or `None` when it
/// was left where it is.
pub fn place(placement: Placement, role: Role, index: u32) -> Option<usize> {
    if placement == Placement::None {
        return None;
    }
    // Counted once and remembered: afterwards this process has but one.
    number_of_cores();
    move_to(core_of(role, index)?)
}

/// Puts the calling thread where [`place`] would pin it, and leaves it free to go: the system would find a good
/// place for it too, after as long as a short run takes.
pub(super) fn begin_apart(role: Role, index: u32) {
    if let Some(core) = core_of(role, index) {
        go_to(core);
    }
}

/// Takes the calling thread to a core, if it may use it, and leaves it free to go; does nothing when it is there.
pub(super) fn go_to(core: usize) {
    if sched_getcpu() == core {
        return;
    }
    let Some(free) = Affinity::current() else { return };
    if core < CpuSet::MAX_CPU && free.0.is_set(core) && move_to(core).is_some() {
        free.restore();
    }
}

/// The core of such a process.
pub(super) fn core_of(role: Role, index: u32) -> Option<usize> {
    match (role, &cores()[..]) {
        (_, []) => None,
        (Role::World, [first, ..]) | (_, [first]) => Some(*first),
        // Controllers in excess share the world's core too: it has nothing to do while they work.
        (Role::Controller, all) => Some(all[(index as usize + 1) % all.len()]),
        (_, [_, others @ ..]) => Some(others[index as usize % others.len()]),
    }
}

fn move_to(core: usize) -> Option<usize> {
    let mut set = CpuSet::new();
    set.set(core);
    sched_setaffinity(None, &set).ok()?;
    Some(core)
}

/// Number of cores this process had to choose from before it was placed on one of them. That is how many the
/// processes of a run have among them.
pub(super) fn number_of_cores() -> usize {
    static CORES: OnceLock<usize> = OnceLock::new();
    *CORES.get_or_init(|| std::thread::available_parallelism().map_or(1, usize::from))
}

/// Number of cores of the machine, whoever may use them.
pub(super) fn cores_online() -> usize {
    static CORES: OnceLock<usize> = OnceLock::new();
    // "0-3,8": ranges and single cores.
    let count = |list: String| {
        let bounds = |range: &str| -> Option<usize> {
            let (first, last) = range.split_once('-').unwrap_or((range, range));
            Some(last.parse::<usize>().ok()? + 1 - first.parse::<usize>().ok()?)
        };
        list.trim().split(',').map(bounds).sum::<Option<usize>>()
    };
    *CORES.get_or_init(|| {
        let list = std::fs::read_to_string("/sys/devices/system/cpu/online").ok();
        list.and_then(count).unwrap_or_else(number_of_cores)
    })
}

/// How long the cores the calling thread may use have been idle so far, in all, ns; 0 where the system does not tell.
/// Allocates nothing.
pub(super) fn idle_ns() -> u64 {
    let Ok(allowed) = sched_getaffinity(None) else { return 0 };
    let mut text = [0; IDLE_TIMES];
    let length = std::fs::File::open("/proc/stat").and_then(|mut file| file.read(&mut text)).unwrap_or(0);
    let text = std::str::from_utf8(&text[..length]).unwrap_or_default();
    // See proc(5): after "cpuN" the times as user, nice, system, idle, ..., in hundredths of a second.
    let idle = |line: &str| -> Option<u64> {
        let mut fields = line.strip_prefix("cpu")?.split_ascii_whitespace();
        let core: usize = fields.next()?.parse().ok()?;
        let idle = fields.nth(3)?.parse().ok()?;
        (core < CpuSet::MAX_CPU && allowed.is_set(core)).then_some(idle)
    };
    text.lines().filter_map(idle).sum::<u64>() * 10_000_000
}

/// Room for the lines of some 300 cores, B; those of others do not count.
const IDLE_TIMES: usize = 32 << 10;

/// The cores the calling thread may use.
pub(super) fn cores() -> Vec<usize> {
    let Ok(allowed) = sched_getaffinity(None) else { return Vec::new() };
    (0..CpuSet::MAX_CPU).filter(|&core| allowed.is_set(core)).collect()
}
