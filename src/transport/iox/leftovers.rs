//! What crashed runs of this user have left, and its removal.
//!
//! A run's files are removed only when none of its processes lives any more, which only those can tell that
//! use the same runtime directory: files of a run elsewhere are left alone. So is whatever belongs to another
//! user, and what changed a moment ago: between the making of its directory and of its first node a run that
//! is starting looks like a dead one.

use super::space::{RunName, RunSpace, SpaceError, base_directory, config, prefix};
use iceoryx2::prelude::{CallbackProgression, LogLevel, Node, NodeState, set_log_level};
use iceoryx2::service::ipc;
use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// What was found of one run, or of one measurement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leftover {
    /// Run name, or what else it was.
    pub name: String,
    /// Its files and directories.
    pub files: Vec<PathBuf>,
    /// What it is, and so what became of it.
    pub condition: Condition,
}

/// Whether something may be removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Condition {
    /// Nobody uses it; it has been removed, unless that was not asked for.
    Dead,
    /// A process uses it, or nobody can tell.
    Alive,
    /// It changed so recently that somebody may be about to use it.
    Recent,
}

/// What changed within this time is left alone.
const RECENT: Duration = Duration::from_secs(1);

/// Finds everything that runs of this user in this runtime directory, and measurements of this user, have
/// put into files, and removes what nobody uses, unless `keep`.
pub fn clean(keep: bool) -> Result<Vec<Leftover>, SpaceError> {
    set_log_level(LogLevel::Fatal);
    let base = base_directory();
    let mut found = Vec::new();
    for run in runs(&base) {
        found.push(clean_run(&base, &run, keep)?);
    }
    let temporary = std::env::temp_dir();
    for (directory, before, after) in [
        (Path::new("/dev/shm"), "cz_bench_", ""),
        (&temporary, "cz-bench-", ".sock"),
        (&temporary, "cz-sumo-", ""),
    ] {
        for path in own_entries(directory) {
            let name = file_name(&path);
            let process = name.strip_prefix(before).and_then(|rest| rest.strip_suffix(after));
            let Some(process) = process.and_then(|digits| digits.parse::<u32>().ok()) else { continue };
            let condition = if Path::new(&format!("/proc/{process}")).exists() {
                Condition::Alive
            } else {
                Condition::Dead
            };
            if condition == Condition::Dead && !keep {
                let _ =
                    if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
            }
            found.push(Leftover { name: format!("measurement {process}"), files: vec![path], condition });
        }
    }
    Ok(found)
}

/// Names of runs that have a directory here, or shared memory that belongs to one here.
fn runs(base: &Path) -> Vec<RunName> {
    let own = format!("cz_{}_", rustix::process::getuid().as_raw());
    let mut names = BTreeSet::new();
    names.extend(own_entries(base).iter().map(|path| file_name(path)));
    for path in own_entries(Path::new("/dev/shm")) {
        // cz_<uid>_<run>_<place>_<whatever iceoryx2 calls it>; a run's name may hold underscores itself.
        let name = file_name(&path);
        let Some(rest) = name.strip_prefix(&own) else { continue };
        names.extend(rest.match_indices('_').map(|(end, _)| rest[..end].to_owned()));
    }
    names
        .iter()
        .filter_map(|name| name.parse().ok())
        .filter(|run: &RunName| {
            let directory = base.join(run.to_string());
            directory.is_dir() || !shared_memory(run, &directory).is_empty()
        })
        .collect()
}

fn clean_run(base: &Path, run: &RunName, keep: bool) -> Result<Leftover, SpaceError> {
    let directory = base.join(run.to_string());
    let mut files = shared_memory(run, &directory);
    below(&directory, &mut files);
    let condition = if is_alive(run, &directory)? {
        Condition::Alive
    } else if files.iter().any(|path| is_recent(path)) {
        Condition::Recent
    } else {
        Condition::Dead
    };
    if condition == Condition::Dead && !keep {
        RunSpace::sweep(run)?;
        // Without its directory nothing has been swept.
        for path in shared_memory(run, &directory) {
            let _ = std::fs::remove_file(path);
        }
    }
    Ok(Leftover { name: run.to_string(), files, condition })
}

/// Whether a process of the run lives, or may live for all we know.
fn is_alive(run: &RunName, directory: &Path) -> Result<bool, SpaceError> {
    if !directory.exists() {
        return Ok(false);
    }
    let mut alive = false;
    let listed = Node::<ipc::Service>::list(&config(run, directory)?, |state| {
        alive |= matches!(state, NodeState::Alive(_) | NodeState::Inaccessible(_));
        CallbackProgression::Continue
    });
    Ok(alive || listed.is_err())
}

/// The run's files in shared memory.
fn shared_memory(run: &RunName, directory: &Path) -> Vec<PathBuf> {
    let prefix = prefix(run, directory);
    own_entries(Path::new("/dev/shm"))
        .into_iter()
        .filter(|path| file_name(path).starts_with(&prefix))
        .collect()
}

/// The directory and everything in it.
fn below(directory: &Path, files: &mut Vec<PathBuf>) {
    if !directory.is_dir() {
        return;
    }
    for path in own_entries(directory) {
        if path.is_dir() { below(&path, files) } else { files.push(path) }
    }
    files.push(directory.to_owned());
}

/// What this user owns in a directory, in order.
fn own_entries(directory: &Path) -> Vec<PathBuf> {
    let user = rustix::process::getuid().as_raw();
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let own = |path: &PathBuf| std::fs::symlink_metadata(path).is_ok_and(|m| m.uid() == user);
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(own).collect();
    paths.sort();
    paths
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Whether a file came, or an entry of a directory came or went, a moment ago.
fn is_recent(path: &Path) -> bool {
    let changed = std::fs::symlink_metadata(path).ok().and_then(|m| {
        SystemTime::UNIX_EPOCH.checked_add(Duration::new(m.ctime() as u64, m.ctime_nsec() as u32))
    });
    // A time to come is a clock that was set back, and says nothing.
    changed.and_then(|changed| changed.elapsed().ok()).is_some_and(|age| age < RECENT)
}
