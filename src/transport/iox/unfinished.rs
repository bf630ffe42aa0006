//! Files in shared memory that a process has left by being killed between creating them and giving them a length.
//! iceoryx2 waits for them to grow, without end, in whatever call comes upon one (`MappingSizeIsZero` in its
//! `posix_shared_memory`); without the file it goes on.

use super::place::{LOCK, shared_memory};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Files are without length for microseconds. This is for creators whom we cannot see, in another namespace of processes.
const YOUNG: Duration = Duration::from_millis(100);

/// Removes files under a prefix that have no length, are not young, and that no process but this one has open, so
/// that nobody is about to give them one. This one must not be creating any.
pub(super) fn remove_unfinished(prefix: &str) {
    let lock = format!("{prefix}{LOCK}");
    let mut files = shared_memory(prefix);
    files.retain(|path| !path.ends_with(&lock) && is_unfinished(path));
    if files.is_empty() {
        return;
    }
    let open = opened_by_others();
    // Who had it open before may have given it a length since.
    for path in files.iter().filter(|path| !open.contains(path) && is_unfinished(path)) {
        let _ = std::fs::remove_file(path);
    }
}

fn is_unfinished(path: &Path) -> bool {
    let now = SystemTime::now();
    std::fs::symlink_metadata(path).is_ok_and(|file| {
        let age = file.modified().ok().and_then(|then| now.duration_since(then).ok());
        file.is_file() && file.size() == 0 && age.is_some_and(|age| age >= YOUNG)
    })
}

/// What the processes that this one can look into have open, without its own.
fn opened_by_others() -> Vec<PathBuf> {
    let own = std::process::id().to_string();
    let entries = |path: &Path| std::fs::read_dir(path).into_iter().flatten().flatten();
    entries(Path::new("/proc"))
        .filter(|process| {
            process.file_name().to_str().is_some_and(|id| id.parse::<u32>().is_ok() && id != own)
        })
        .flat_map(|process| entries(&process.path().join("fd")).collect::<Vec<_>>())
        .filter_map(|fd| std::fs::read_link(fd.path()).ok())
        .collect()
}
