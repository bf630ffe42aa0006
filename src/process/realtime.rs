//! What a process asks of the scheduler and of memory when it is to be in time, and what it got.
//!
//! A process under SCHED_FIFO gives way to nobody of lower priority, not even by yielding. So a process that
//! waits busily may only be under it while there is a core for each such process; it sleeps where it would
//! yield otherwise, and now and then in any case ([`Breather`]); and a limit on the time between two sleeps
//! ends it should it never sleep again.

use super::placement::{begin_apart, cores, number_of_cores};
use super::{Placement, WaitMode, place};
use ipc_schemas::Role;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, Rlimit, getpriority_process, getrlimit, setpriority_process, setrlimit};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};
use thread_priority::{
    NormalThreadSchedulePolicy, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy,
};

/// Priority of world and controllers: above whatever is not real-time, below interrupt threads (50).
const PRIORITY: u8 = 20;
/// Priority of coordinators. They sleep from event to event and work briefly; with a higher priority they do
/// so at once on a core where a controller waits for them.
const COORDINATOR_PRIORITY: u8 = 21;
/// Processor time without a sleep after which the kernel ends the process (SIGXCPU).
const LONGEST_WITHOUT_SLEEP: Duration = Duration::from_secs(5);

/// How a process is to be settled on the machine before its run begins.
#[derive(Clone, Copy)]
pub struct Settling<'a> {
    /// On which cores.
    pub pin: Placement,
    /// Whether it asks for real-time scheduling and locked memory.
    pub realtime: bool,
    /// Is told what it got.
    pub report: &'a dyn Fn(&Settled),
}

/// What a process got.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settled {
    /// Role and index.
    pub process: String,
    /// Cores it may use.
    pub cores: Vec<usize>,
    /// Its scheduling, e.g. `SCHED_FIFO 20`, or what it has instead and why.
    pub scheduling: String,
    /// Whether its memory is locked.
    pub memory_locked: bool,
    /// What is to be said about its memory beyond that.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub memory_note: Option<String>,
}

impl std::fmt::Display for Settled {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let cores: Vec<_> = self.cores.iter().map(usize::to_string).collect();
        let memory = if self.memory_locked { "memory locked" } else { "memory not locked" };
        write!(f, "{}: core {}, {}, {memory}", self.process, cores.join(" "), self.scheduling)?;
        self.memory_note.as_ref().map_or(Ok(()), |note| write!(f, " ({note})"))
    }
}

impl Settling<'_> {
    /// Settles the calling process, in a run of that many processes that wait busily (world and
    /// controllers; all of them when everybody spins). Never fails: what is refused is reported.
    pub fn settle(&self, role: Role, index: u32, wait: WaitMode, hot_processes: usize) -> Held {
        if place(self.pin, role, index).is_none() {
            begin_apart(role, index);
        }
        let process = if role == Role::World { role.to_string() } else { format!("{role} {index}") };
        let (mut memory_locked, mut memory_note) = (false, None);
        if self.realtime {
            (memory_locked, memory_note) = lock_memory();
        }
        let refusal = if self.realtime { ask_for_fifo(role, wait, hot_processes).err() } else { None };
        let yields = matches!(wait, WaitMode::Adaptive | WaitMode::Hybrid);
        let is_with_controllers = self.pin == Placement::Auto && yields;
        if !self.realtime && role == Role::Coordinator && is_with_controllers {
            // A controller that waits for it yields. So its waking need not interrupt the core, which takes longer
            // than the next yield is away. On any other core it would wait for whoever is there.
            put_under(NormalThreadSchedulePolicy::Batch);
        }
        let scheduling = match refusal {
            Some(why) => format!("{} ({why})", scheduling()),
            None => scheduling(),
        };
        let cores = cores();
        (self.report)(&Settled { process, cores, scheduling, memory_locked, memory_note });
        Held(())
    }
}

/// Real-time scheduling, for as long as it is held, where it was granted.
///
/// It must be let go before the run's space is: clean-up is the file system's work, where processes wait for
/// each other inside the kernel, and one that gives way to nobody there can wait for ever for another on its
/// core (seen: two processes of equal priority removing one directory).
#[derive(Debug)]
#[must_use]
pub struct Held(());

impl Drop for Held {
    fn drop(&mut self) {
        if is_fifo() {
            put_under(NormalThreadSchedulePolicy::Other);
        }
    }
}

/// Puts the calling thread under a policy that is not real-time, which is always allowed, as nice as it is.
fn put_under(policy: NormalThreadSchedulePolicy) {
    let niceness = getpriority_process(None);
    // The library always sets niceness too, and makes 0 of 49 of 99: the way back from there is open to all but
    // who was not nice at all.
    let ordinary = ThreadPriority::Crossplatform(49.try_into().expect("priorities are below 100"));
    let _ =
        set_thread_priority_and_policy(thread_native_id(), ordinary, ThreadSchedulePolicy::Normal(policy));
    if let Ok(niceness) = niceness {
        let _ = setpriority_process(None, niceness);
    }
}

/// Under SCHED_FIFO from here on, or why not.
fn ask_for_fifo(role: Role, wait: WaitMode, hot_processes: usize) -> Result<(), String> {
    let cores = number_of_cores();
    // All or none: a coordinator that none may interrupt could wait for one that does not get to run.
    if wait != WaitMode::Block && hot_processes > cores {
        return Err(format!(
            "SCHED_FIFO not asked for: {hot_processes} processes wait busily and there are {cores} cores"
        ));
    }
    // Before the scheduling, so that there is no moment without it.
    let limit = LONGEST_WITHOUT_SLEEP.as_micros() as u64;
    let before = getrlimit(Resource::Rttime);
    let lower = |old: Option<u64>, new: u64| Some(old.map_or(new, |old| old.min(new)));
    let after = Rlimit { current: lower(before.current, limit), maximum: before.maximum };
    setrlimit(Resource::Rttime, after)
        .map_err(|e| format!("SCHED_FIFO not asked for: no limit could be set on it, {}", name_of(e)))?;
    let priority = if role == Role::Coordinator { COORDINATOR_PRIORITY } else { PRIORITY };
    let priority = ThreadPriority::Crossplatform(priority.try_into().expect("priorities are below 100"));
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), priority, fifo).map_err(|error| match error {
        thread_priority::Error::OS(number) => {
            format!("SCHED_FIFO refused: {}", name_of(rustix::io::Errno::from_raw_os_error(number)))
        }
        other => format!("SCHED_FIFO refused: {other:?}"),
    })
}

/// Whether the calling thread is under SCHED_FIFO, whoever put it there.
pub(super) fn is_fifo() -> bool {
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    thread_schedule_policy().is_ok_and(|policy| policy == fifo)
}

/// The scheduling that the kernel says this process has.
fn scheduling() -> String {
    // See proc(5): fields 40 and 41 of stat; the third is the first after the name in parentheses.
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let field = |number: usize| fields.get(number - 3).copied().unwrap_or("?");
    match field(41) {
        "0" => "SCHED_OTHER".to_owned(),
        "1" => format!("SCHED_FIFO {}", field(40)),
        "2" => format!("SCHED_RR {}", field(40)),
        "3" => "SCHED_BATCH".to_owned(),
        "5" => "SCHED_IDLE".to_owned(),
        other => format!("scheduling policy {other}"),
    }
}

/// Locks this process's memory, also what is mapped later; returns whether it is locked, and a remark.
fn lock_memory() -> (bool, Option<String>) {
    let limit = getrlimit(Resource::Memlock).current;
    if limit.is_none() || may_lock_any_amount() {
        return match mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE) {
            Ok(()) => (true, None),
            Err(error) => (false, Some(name_of(error))),
        };
    }
    // Under a limit, locking what is to come would make a later allocation fail, and the run with it.
    let limit = limit.unwrap_or(0) >> 10;
    match mlockall(MlockAllFlags::CURRENT) {
        Ok(()) => (true, Some(format!("only what was mapped before the run; limit {limit} KiB"))),
        Err(error) => (false, Some(format!("{}; limit {limit} KiB", name_of(error)))),
    }
}

/// Whether the process has CAP_IPC_LOCK, which no limit binds.
fn may_lock_any_amount() -> bool {
    const CAP_IPC_LOCK: u64 = 1 << 14;
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    effective.is_some_and(|mask| u64::from_str_radix(mask.trim(), 16).is_ok_and(|m| m & CAP_IPC_LOCK != 0))
}

/// The name by which people look an error up, where it has one that is expected here.
fn name_of(error: rustix::io::Errno) -> String {
    use rustix::io::Errno;
    match error {
        Errno::PERM => "EPERM".to_owned(),
        Errno::NOMEM => "ENOMEM".to_owned(),
        Errno::AGAIN => "EAGAIN".to_owned(),
        Errno::INVAL => "EINVAL".to_owned(),
        other => other.to_string(),
    }
}

/// Makes a process under SCHED_FIFO that is never out of work sleep now and then.
#[derive(Debug)]
pub(super) struct Breather {
    last: Instant,
}

/// Longest time without a sleep, and the sleep: two hundredths are left to others.
const BREATHE_EVERY: Duration = Duration::from_millis(10);
const BREATH: Duration = Duration::from_micros(200);

impl Breather {
    /// One for the calling thread, where it needs one.
    pub(super) fn if_needed() -> Option<Breather> {
        is_fifo().then(|| Breather { last: Instant::now() })
    }

    /// Sleeps briefly when the last sleep is long ago.
    pub(super) fn breathe(&mut self) {
        if self.last.elapsed() >= BREATHE_EVERY {
            std::thread::sleep(BREATH);
            self.last = Instant::now();
        }
    }
}
