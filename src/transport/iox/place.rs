//! Where a run lives: its directory and its prefix in shared memory, whose they are, and whether anybody is in.
//!
//! Nothing is touched that is not ours. The directory of all runs and each run's own belong to this user and
//! are no links; a run's has a marker in it, a file that says which instance of the run this is. The instance
//! is part of the prefix, so two runs of one name that see the same shared memory and not each other's
//! directories (containers) do not see each other's files either.
//!
//! Who is in a run holds a shared lock on the marker, and on a file of its own in shared memory. Locks end
//! with their processes, however these end; so whether a run is dead is asked of the kernel, and nothing is
//! read that a hostile process may have written. Coming, going and sweeping happen under a lock on the
//! directory of all runs.

use super::error::{SHARED_MEMORY, SpaceError, failed};
use super::name::RunName;
use rustix::fs::{
    AtFlags, CWD, FileType, FlockOperation, Mode, OFlags, Stat, flock, fstat, mkdirat, openat, renameat,
    statat, unlinkat,
};
use rustix::io::Errno;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The file in a run's directory by which it is known, eight hexadecimal digits long: the instance.
const MARKER: &str = ".cz-run";
/// The instance of a run whose marker somebody has written over: it is ours to remove, and has no shared memory.
const DAMAGED: &str = "damaged";
/// A run's directory before its marker is in it; there is one at most, under the lock.
const BEGINNING: &str = ".cz-begins";
/// What the file in shared memory is called whose lock says that a run lives.
pub(super) const LOCK: &str = "lock";
/// Names that are tried for the directory of all runs while somebody else has taken those before.
const CANDIDATES: u32 = 10;
/// Longest wait for others that come or go, which takes each of them milliseconds of processor time; where tens of
/// others want to run, nine that begin a run together have been seen to take longer than 5 s over it.
const LOCK_PATIENCE: Duration = Duration::from_secs(20);

/// The directory of all runs, locked: nobody else comes, goes or sweeps.
#[derive(Debug)]
pub(super) struct Base {
    fd: OwnedFd,
    pub path: PathBuf,
}

/// A run's directory that is known to be one.
#[derive(Debug)]
pub(super) struct Place {
    pub directory: PathBuf,
    /// File-name prefix of the run's shared memory; the fixed length of the instance in it keeps a run `a`
    /// from matching the files of a run `a-b`.
    pub prefix: String,
    marker: OwnedFd,
}

/// What has the name of a run in the directory of all runs.
#[derive(Debug)]
pub(super) enum Found {
    Nothing,
    Run(Place),
    /// Something that is not ours, and why.
    Foreign(String),
}

/// That this process is in a run, until it is dropped.
#[derive(Debug)]
pub(super) struct Presence {
    _marker: OwnedFd,
    _shared_memory: OwnedFd,
}

/// Why the directory of all runs cannot be used.
fn unusable(path: &Path, problem: &str) -> SpaceError {
    SpaceError::NotOurs { path: path.to_owned(), problem: problem.to_owned() }
}

fn user() -> u32 {
    rustix::process::getuid().as_raw()
}

/// The first name of the directory of all runs: in the user's runtime directory where there is one.
fn first_candidate() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(runtime) if Path::new(&runtime).is_dir() => PathBuf::from(runtime).join("cz"),
        _ => std::env::temp_dir().join(format!("cz-{}", user())),
    }
}

/// All names it may have: in a temporary directory anybody may have taken the first ones.
fn candidates() -> impl Iterator<Item = PathBuf> {
    let first = first_candidate();
    (0..CANDIDATES).map(move |i| {
        let mut name = first.clone().into_os_string();
        if i > 0 {
            name.push(format!("-{i}"));
        }
        PathBuf::from(name)
    })
}

/// Why a file is not this user's alone to write, if it is not.
fn foreign(stat: &Stat, expected: FileType) -> Option<String> {
    let kind = FileType::from_raw_mode(stat.st_mode);
    let what = if expected == FileType::Directory { "a directory" } else { "a file" };
    if kind == FileType::Symlink {
        Some(format!("it is a link, expected {what}"))
    } else if kind != expected {
        Some(format!("expected {what}"))
    } else if stat.st_uid != user() {
        Some(format!("it belongs to user {}", stat.st_uid))
    } else if stat.st_mode & 0o022 != 0 {
        Some("others may write to it".to_owned())
    } else {
        None
    }
}

fn is_same(a: &Stat, b: &Stat) -> bool {
    (a.st_dev, a.st_ino) == (b.st_dev, b.st_ino)
}

const NO_LINK: OFlags = OFlags::NOFOLLOW.union(OFlags::CLOEXEC).union(OFlags::NONBLOCK);

impl Base {
    /// Opens and locks it: the first of its names that leads to a directory of this user, or, to begin a run,
    /// the first that leads nowhere. `None` where there is no such directory and none is to be made.
    pub fn open(create: bool) -> Result<Option<Base>, SpaceError> {
        let deadline = Instant::now() + LOCK_PATIENCE;
        loop {
            let Some(path) = Base::choose(create)? else { return Ok(None) };
            if create {
                match mkdirat(CWD, &path, Mode::RWXU) {
                    Ok(()) | Err(Errno::EXIST) => {}
                    Err(error) => return Err(failed(&format!("create {}", path.display()), &error)),
                }
            }
            let flags = OFlags::DIRECTORY | OFlags::RDONLY | NO_LINK;
            let opened = openat(CWD, &path, flags, Mode::empty());
            // Gone, or another, since it was chosen: chosen again.
            if let Ok(fd) = opened
                && lock(&fd, FlockOperation::NonBlockingLockExclusive, deadline, &path)?
                && let (Ok(own), Ok(there)) = (fstat(&fd), statat(CWD, &path, AtFlags::SYMLINK_NOFOLLOW))
                && is_same(&own, &there)
                && foreign(&own, FileType::Directory).is_none()
            {
                return Ok(Some(Base { fd, path }));
            }
            if Instant::now() >= deadline {
                return Err(unusable(&path, "it comes and goes"));
            }
        }
    }

    fn choose(create: bool) -> Result<Option<PathBuf>, SpaceError> {
        let mut free = None;
        let mut problem = None;
        for path in candidates() {
            match statat(CWD, &path, AtFlags::SYMLINK_NOFOLLOW) {
                Ok(stat) => match foreign(&stat, FileType::Directory) {
                    None => return Ok(Some(path)),
                    Some(why) => problem = problem.or(Some((path, why))),
                },
                Err(Errno::NOENT) => free = free.or(Some(path)),
                Err(error) => problem = problem.or(Some((path, error.to_string()))),
            }
        }
        match (free, problem) {
            _ if !create => Ok(None),
            (Some(path), _) => Ok(Some(path)),
            (None, Some((path, why))) => {
                Err(unusable(&path, &format!("{why}; set XDG_RUNTIME_DIR to a directory of your own")))
            }
            (None, None) => unreachable!("each candidate is free, ours, or a problem"),
        }
    }

    /// What has a run's name here.
    pub fn find(&self, run: &RunName) -> Found {
        let name = run.to_string();
        let directory = self.path.join(&name);
        let flags = OFlags::DIRECTORY | OFlags::RDONLY | NO_LINK;
        let own = match openat(&self.fd, name.as_str(), flags, Mode::empty()) {
            Ok(own) => own,
            Err(Errno::NOENT) => return Found::Nothing,
            Err(Errno::LOOP) => return Found::Foreign("it is a link, expected a directory".to_owned()),
            Err(Errno::NOTDIR) => return Found::Foreign("expected a directory".to_owned()),
            Err(error) => return Found::Foreign(error.to_string()),
        };
        match fstat(&own).map(|stat| foreign(&stat, FileType::Directory)) {
            Ok(None) => {}
            Ok(Some(why)) => return Found::Foreign(why),
            Err(error) => return Found::Foreign(error.to_string()),
        }
        match marker(&own) {
            Some((marker, instance)) => {
                Found::Run(Place { directory, prefix: format!("cz_{}_{run}_{instance}_", user()), marker })
            }
            None => Found::Foreign(format!("it has no {MARKER} of a run in it")),
        }
    }

    /// Makes the directory of a run that is not there.
    pub fn begin(&self, run: &RunName) -> Result<Place, SpaceError> {
        let directory = self.path.join(run.to_string());
        let wrong = |error: Errno| failed(&format!("create {}", directory.display()), &error);
        self.forget_beginning();
        mkdirat(&self.fd, BEGINNING, Mode::RWXU).map_err(wrong)?;
        let flags = OFlags::DIRECTORY | OFlags::RDONLY | NO_LINK;
        let own = openat(&self.fd, BEGINNING, flags, Mode::empty()).map_err(wrong)?;
        let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | NO_LINK;
        let marker = openat(&own, MARKER, flags, Mode::RUSR | Mode::WUSR).map_err(wrong)?;
        let mut random = [0; 4];
        rustix::rand::getrandom(&mut random, rustix::rand::GetRandomFlags::empty()).map_err(wrong)?;
        write!(File::from(marker), "{:08x}", u32::from_le_bytes(random))
            .map_err(|error| failed(&format!("create {}", directory.display()), &error))?;
        // Complete when it appears under its name, for those who look without the lock.
        renameat(&self.fd, BEGINNING, &self.fd, run.to_string()).map_err(wrong)?;
        match self.find(run) {
            Found::Run(place) => Ok(place),
            Found::Nothing => Err(unusable(&directory, "it has been removed")),
            Found::Foreign(why) => Err(unusable(&directory, &why)),
        }
    }

    /// Removes what somebody left who was killed while a run began or ended: a directory with nothing but a
    /// marker in it.
    fn forget_beginning(&self) {
        let _ = unlinkat(&self.fd, Path::new(BEGINNING).join(MARKER), AtFlags::empty());
        let _ = unlinkat(&self.fd, BEGINNING, AtFlags::REMOVEDIR);
    }

    /// Removes a run in which nobody is. The marker goes last, and the lock after it: who is killed in between
    /// leaves what can still be known for ours.
    pub fn remove(&self, place: &Place) {
        let lock = place.lock_path();
        let files = shared_memory(&place.prefix).into_iter().filter(|path| *path != lock);
        files.for_each(|path| drop(std::fs::remove_file(path)));
        for path in entries(&place.directory).into_iter().filter(|path| file_name(path) != MARKER) {
            // Follows no links, and nobody else can enter the directory.
            let _ = if is_directory(&path) {
                std::fs::remove_dir_all(&path)
            } else {
                std::fs::remove_file(&path)
            };
        }
        self.forget_beginning();
        if let Some(name) = place.directory.file_name() {
            let _ = renameat(&self.fd, name, &self.fd, BEGINNING);
        }
        self.forget_beginning();
        let _ = std::fs::remove_file(lock);
    }

    /// Removes the directory of all runs unless there is anything in it.
    pub fn remove_if_empty(self) {
        self.forget_beginning();
        let _ = unlinkat(CWD, &self.path, AtFlags::REMOVEDIR);
    }
}

/// Takes a lock. Whoever has it needs it for milliseconds.
fn lock(fd: &OwnedFd, how: FlockOperation, deadline: Instant, path: &Path) -> Result<bool, SpaceError> {
    loop {
        match flock(fd, how) {
            Ok(()) => return Ok(true),
            Err(Errno::WOULDBLOCK | Errno::INTR) if Instant::now() < deadline => {
                std::thread::sleep(Duration::from_micros(500));
            }
            Err(Errno::WOULDBLOCK) => {
                let (who, seconds) = (holder(fd), LOCK_PATIENCE.as_secs());
                let who = who.unwrap_or_else(|| "another process".to_owned());
                return Err(unusable(path, &format!("{who} has had it locked for {seconds} s")));
            }
            Err(error) => return Err(failed(&format!("lock {}", path.display()), &error)),
        }
    }
}

/// Who has a lock that cannot be had, as far as the kernel tells: not across namespaces of processes, and not on
/// every file system.
fn holder(fd: &OwnedFd) -> Option<String> {
    let stat = fstat(fd).ok()?;
    let (major, minor) = (rustix::fs::major(stat.st_dev), rustix::fs::minor(stat.st_dev));
    let file = format!("{major:02x}:{minor:02x}:{}", stat.st_ino);
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    // Number, kind, whether it is advisory, whether it is shared, process, file; who waits has an arrow before the kind.
    let held = locks.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let process: u32 = held
        .filter(|lock| lock.get(1) == Some(&"FLOCK") && lock.get(5) == Some(&file.as_str()))
        .find_map(|lock| lock.get(4)?.parse().ok())?;
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    // The state follows the name, which is in parentheses and may hold any character.
    let is_stopped = stat.rsplit(')').next().is_some_and(|fields| fields.trim_start().starts_with('T'));
    Some(format!("process {process}{}", if is_stopped { ", which is stopped," } else { "" }))
}

/// The marker in a run's directory, and the instance in it, if they are ours and as they should be.
fn marker(directory: &OwnedFd) -> Option<(OwnedFd, String)> {
    let marker = openat(directory, MARKER, OFlags::RDONLY | NO_LINK, Mode::empty()).ok()?;
    let stat = fstat(&marker).ok()?;
    if foreign(&stat, FileType::RegularFile).is_some() {
        return None;
    }
    let mut instance = String::new();
    let mut file = File::from(marker);
    (&mut file).take(9).read_to_string(&mut instance).ok()?;
    let instance = if is_instance(&instance) { instance } else { DAMAGED.to_owned() };
    Some((file.into(), instance))
}

fn is_instance(text: &str) -> bool {
    text.len() == 8 && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

impl Place {
    /// Comes in.
    pub fn enter(&self) -> Result<Presence, SpaceError> {
        let path = self.lock_path();
        let wrong = |error: Errno| failed(&format!("lock {}", path.display()), &error);
        let deadline = Instant::now() + LOCK_PATIENCE;
        let shared = FlockOperation::NonBlockingLockShared;
        let marker = self.marker.try_clone().map_err(|e| failed("copy a file descriptor", &e))?;
        lock(&marker, shared, deadline, &self.directory)?;
        loop {
            let flags = OFlags::RDONLY | OFlags::CREATE | NO_LINK;
            let file = openat(CWD, &path, flags, Mode::RUSR | Mode::WUSR).map_err(wrong)?;
            let own = fstat(&file).map_err(wrong)?;
            if let Some(why) = foreign(&own, FileType::RegularFile) {
                return Err(unusable(&path, &why));
            }
            lock(&file, shared, deadline, &path)?;
            // Somebody may have found it without us a moment ago, and removed it.
            if statat(CWD, &path, AtFlags::SYMLINK_NOFOLLOW).is_ok_and(|there| is_same(&own, &there)) {
                return Ok(Presence { _marker: marker, _shared_memory: file });
            }
        }
    }

    fn lock_path(&self) -> PathBuf {
        Path::new(SHARED_MEMORY).join(format!("{}{LOCK}", self.prefix))
    }

    /// Whether nobody is in. Who asks must not be in by this place, but by another.
    pub fn is_dead(&self) -> bool {
        flock(&self.marker, FlockOperation::NonBlockingLockExclusive).is_ok()
            && is_unlocked(&self.lock_path())
    }
}

/// Whether nobody holds the lock of this file, which may be gone.
fn is_unlocked(path: &Path) -> bool {
    match openat(CWD, path, OFlags::RDONLY | NO_LINK, Mode::empty()) {
        Ok(lock) => flock(&lock, FlockOperation::NonBlockingLockExclusive).is_ok(),
        Err(error) => error == Errno::NOENT,
    }
}

/// This user's files in shared memory under a prefix, in order.
pub(super) fn shared_memory(prefix: &str) -> Vec<PathBuf> {
    let mut files = own_entries(Path::new(SHARED_MEMORY));
    files.retain(|path| file_name(path).starts_with(prefix));
    files
}

/// Runs that have shared memory here: name and prefix. Whether they have a directory, and where, is not known.
pub(super) fn prefixes_in_shared_memory() -> Vec<(RunName, String)> {
    let own = format!("cz_{}_", user());
    let run_of = |name: &str| {
        let prefix = name.strip_suffix(LOCK)?;
        let (run, instance) = prefix.strip_prefix(&own)?.strip_suffix('_')?.rsplit_once('_')?;
        Some((run.parse().ok()?, is_instance(instance).then(|| prefix.to_owned())?))
    };
    own_entries(Path::new(SHARED_MEMORY)).iter().filter_map(|path| run_of(&file_name(path))).collect()
}

/// Whether nobody is in a run whose directory is not known.
pub(super) fn is_abandoned(prefix: &str) -> bool {
    is_unlocked(&Path::new(SHARED_MEMORY).join(format!("{prefix}{LOCK}")))
}

fn entries(directory: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
}

/// What this user owns in a directory, in order; links are not followed.
pub(super) fn own_entries(directory: &Path) -> Vec<PathBuf> {
    use std::os::unix::fs::MetadataExt;
    let mut paths = entries(directory);
    paths.retain(|path| std::fs::symlink_metadata(path).is_ok_and(|m| m.uid() == user()));
    paths.sort();
    paths
}

/// Whether it is a directory, and not a link to one.
pub(super) fn is_directory(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|m| m.is_dir())
}

pub(super) fn file_name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(path: &Path) -> OwnedFd {
        openat(CWD, path, OFlags::DIRECTORY | OFlags::RDONLY | NO_LINK, Mode::empty()).unwrap()
    }

    #[test]
    fn whoever_holds_a_lock_for_too_long_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path();
        let (ours, theirs) = (open(path), open(path));
        let take = |fd: &OwnedFd| {
            let exclusive = FlockOperation::NonBlockingLockExclusive;
            lock(fd, exclusive, Instant::now(), path).map_err(|e| e.to_string())
        };
        assert_eq!(take(&ours), Ok(true));
        let said = take(&theirs).unwrap_err();
        let us = std::process::id();
        assert!(said.contains(&format!(": process {us} has had it locked for 20 s")), "{said}");

        drop(ours);
        let mut child = std::process::Command::new("flock");
        let mut child = child.arg(path).args(["sh", "-c", "kill -STOP $PPID"]).spawn().unwrap();
        let stat = format!("/proc/{}/stat", child.id());
        while !std::fs::read_to_string(&stat).unwrap().contains(") T ") {
            std::thread::sleep(Duration::from_millis(1));
        }
        let said = take(&theirs).unwrap_err();
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(said.contains(&format!(": process {}, which is stopped, has had it", child.id())), "{said}");
    }
}
