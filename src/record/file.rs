//! The file of a recording: made beside an older one, which it replaces when the first step has been written.
//!
//! Whoever writes a recording holds a lock on it, by which others know that it still grows.

use super::format::{FILE_MAGIC, Metadata, padded};
use super::recorder::{Output, RecordError};
use crate::encoding::MAX_KEPT_BYTES;
use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::io::Errno;
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// Longest wait for another recorder that is about to put its file in its place.
const PATIENCE: Duration = Duration::from_secs(5);

/// Numbers the files that this process makes.
static NEXT: AtomicU32 = AtomicU32::new(0);

/// A recording's file.
#[derive(Debug)]
pub(super) struct RecordingFile {
    file: File,
    path: PathBuf,
    /// Its name until the first step has been written.
    beside: Option<PathBuf>,
}

/// Refuses what cannot become a recording: a file that is none or that grows, a place where nothing can be
/// written, a scenario nobody could read again.
pub(super) fn probe(path: &Path, metadata: &Metadata) -> Result<(), RecordError> {
    let failed = |source| RecordError::Create { path: path.to_owned(), source };
    let head = padded(metadata);
    if head.len() > MAX_KEPT_BYTES {
        return Err(RecordError::TooLarge {
            path: path.to_owned(),
            found: head.len(),
            limit: MAX_KEPT_BYTES,
        });
    }
    if !is_replaceable(path).map_err(failed)? {
        return Err(RecordError::Occupied(path.to_owned()));
    }
    if is_growing(path).map_err(failed)? {
        return Err(RecordError::Busy(path.to_owned()));
    }
    // Dropped, it is gone again.
    let mut file = RecordingFile::begin(path.to_owned()).map_err(failed)?;
    file.write_all(&head).map_err(failed)
}

/// Whether a run records into this file at present.
pub fn is_growing(path: &Path) -> io::Result<bool> {
    match OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path) {
        Ok(file) => Ok(flock(&file, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Whether there is nothing, a recording, or an empty file.
fn is_replaceable(path: &Path) -> io::Result<bool> {
    match std::fs::metadata(path) {
        Ok(found) if !found.is_file() => return Ok(false),
        Ok(_) => {}
        // A link to nothing is not ours to replace.
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(path.symlink_metadata().is_err()),
        Err(error) => return Err(error),
    }
    let mut head = Vec::new();
    File::open(path)?.take(FILE_MAGIC.len() as u64).read_to_end(&mut head)?;
    Ok(head.is_empty() || head == FILE_MAGIC)
}

fn directory_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

impl RecordingFile {
    /// A new file beside `path`, for its owner alone.
    pub fn begin(path: PathBuf) -> io::Result<RecordingFile> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
        let mut hidden = OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed)));
        let beside = directory_of(&path).join(hidden);
        let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&beside)?;
        // Fails only where files have no locks; then nobody is told.
        let _ = flock(&file, FlockOperation::NonBlockingLockExclusive);
        Ok(RecordingFile { file, path, beside: Some(beside) })
    }
}

impl Write for RecordingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Output for RecordingFile {
    fn sync(&mut self) -> io::Result<()> {
        self.file.sync_all()
    }

    fn appear(&mut self) -> io::Result<()> {
        let Some(beside) = self.beside.clone() else { return Ok(()) };
        // One after the other, so that of two runs that begin together the later one notices.
        let directory = File::open(directory_of(&self.path))?;
        let deadline = Instant::now() + PATIENCE;
        while flock(&directory, FlockOperation::NonBlockingLockExclusive) == Err(Errno::WOULDBLOCK)
            && Instant::now() < deadline
        {
            std::thread::sleep(Duration::from_millis(1));
        }
        let path = self.path.display();
        if is_growing(&self.path)? {
            return Err(io::Error::other(format!("another run is recording into {path}")));
        }
        if !is_replaceable(&self.path)? {
            return Err(io::Error::other(format!("{path} is a file by now, and not a recording")));
        }
        std::fs::rename(&beside, &self.path)?;
        self.beside = None;
        Ok(())
    }

    fn check(&mut self) -> io::Result<()> {
        let own = self.file.metadata()?;
        match std::fs::symlink_metadata(&self.path) {
            Ok(there) if (there.dev(), there.ino()) == (own.dev(), own.ino()) => Ok(()),
            Ok(_) => Err(io::Error::other(format!("{} has been replaced", self.path.display()))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(io::Error::other(format!("{} has been removed", self.path.display())))
            }
            // Cannot be told at present.
            Err(_) => Ok(()),
        }
    }
}

impl Drop for RecordingFile {
    fn drop(&mut self) {
        if let Some(beside) = &self.beside {
            let _ = std::fs::remove_file(beside);
        }
    }
}
