//! What crashed runs of this user have left, and its removal.
//!
//! Whether a run is dead is told by its locks, so that what is removed is not looked into: files that were
//! cut short or written over hold nobody up. What is not known for ours is left alone.

use super::error::{SHARED_MEMORY, SpaceError};
use super::place::{
    Base, Found, file_name, is_abandoned, is_directory, own_entries, prefixes_in_shared_memory, shared_memory,
};
use std::path::{Path, PathBuf};

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
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Condition {
    /// Nobody uses it; it has been removed, unless that was not asked for.
    Dead,
    /// A process uses it.
    Alive,
    /// It is not ours, and why.
    Foreign(String),
}

/// Finds everything that runs of this user in this runtime directory, and measurements of this user, have
/// put into files, and removes what nobody uses, unless `keep`.
pub fn clean(keep: bool) -> Result<Vec<Leftover>, SpaceError> {
    let (mut found, prefixes): (Vec<_>, Vec<_>) = runs(keep)?.into_iter().unzip();
    let known: Vec<String> = prefixes.into_iter().flatten().collect();
    found.extend(lost_shared_memory(&known, keep));
    found.extend(measurements(keep));
    Ok(found)
}

/// Removes what runs of this user in this runtime directory have left in which nobody lives any more. Takes
/// well below a millisecond where there are none. What cannot be removed is left for the next who looks.
pub fn sweep_dead_runs() {
    let _ = runs(false);
}

/// What has the name of a run in the directory of all runs, with the prefixes of those that are runs.
fn runs(keep: bool) -> Result<Vec<(Leftover, Option<String>)>, SpaceError> {
    let mut found = Vec::new();
    let Some(base) = Base::open(false)? else { return Ok(found) };
    for path in own_entries(&base.path) {
        let name = file_name(&path);
        let Ok(run) = name.parse() else { continue };
        match base.find(&run) {
            Found::Nothing => {}
            Found::Foreign(why) => {
                found.push((Leftover { name, files: vec![path], condition: Condition::Foreign(why) }, None));
            }
            Found::Run(place) => {
                let mut files = shared_memory(&place.prefix);
                below(&place.directory, &mut files);
                let condition = if place.is_dead() { Condition::Dead } else { Condition::Alive };
                if condition == Condition::Dead && !keep {
                    base.remove(&place);
                }
                found.push((Leftover { name, files, condition }, Some(place.prefix)));
            }
        }
    }
    if !keep {
        base.remove_if_empty();
    }
    Ok(found)
}

/// Shared memory whose directory is lost, or elsewhere, and in which nobody is.
fn lost_shared_memory(known: &[String], keep: bool) -> Vec<Leftover> {
    let mut found = Vec::new();
    for (run, prefix) in prefixes_in_shared_memory() {
        if known.contains(&prefix) || !is_abandoned(&prefix) {
            continue;
        }
        let mut files = shared_memory(&prefix);
        // The lock last, by which the others are known.
        files.sort_by_key(|path| file_name(path).len() == prefix.len() + "lock".len());
        if !keep {
            files.iter().for_each(|path| drop(std::fs::remove_file(path)));
        }
        found.push(Leftover { name: run.to_string(), files, condition: Condition::Dead });
    }
    found
}

/// What measurements have put into files that say whose they are.
fn measurements(keep: bool) -> Vec<Leftover> {
    let temporary = std::env::temp_dir();
    let mut found = Vec::new();
    for (directory, before, after) in [
        (Path::new(SHARED_MEMORY), "cz_bench_", ""),
        (&temporary, "cz-bench-", ".sock"),
        (&temporary, "cz-sumo-", ""),
    ] {
        for path in own_entries(directory) {
            let name = file_name(&path);
            let process = name.strip_prefix(before).and_then(|rest| rest.strip_suffix(after));
            let Some(process) = process.and_then(|digits| digits.parse::<u32>().ok()) else { continue };
            let condition = match Path::new(&format!("/proc/{process}")).exists() {
                true => Condition::Alive,
                false => Condition::Dead,
            };
            if condition == Condition::Dead && !keep {
                let _ = match is_directory(&path) {
                    true => std::fs::remove_dir_all(&path),
                    false => std::fs::remove_file(&path),
                };
            }
            found.push(Leftover { name: format!("measurement {process}"), files: vec![path], condition });
        }
    }
    found
}

/// The directory and everything in it.
fn below(directory: &Path, files: &mut Vec<PathBuf>) {
    for path in own_entries(directory) {
        if is_directory(&path) { below(&path, files) } else { files.push(path) }
    }
    files.push(directory.to_owned());
}
