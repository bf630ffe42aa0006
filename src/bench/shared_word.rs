//! The physical floor: one word of shared memory that two processes write in turn.

use super::{BenchError, io};
use memmap2::MmapMut;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A page two processes share, with one word per direction, each on a cache line of its own.
#[derive(Debug)]
pub(super) struct SharedWords {
    map: MmapMut,
}

/// Distance of the second word: two lines, as processors prefetch in pairs.
const SECOND: usize = 128;
/// How long a missing answer is waited for.
const PATIENCE: Duration = Duration::from_secs(5);

impl SharedWords {
    /// Maps the file, which must be at least a page long.
    pub(super) fn open(path: &Path) -> Result<SharedWords, BenchError> {
        let file = std::fs::OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(path)
            .map_err(io("open the shared word"))?;
        file.set_len(4096).map_err(io("size the shared word"))?;
        // SAFETY: the file belongs to this measurement alone; both processes access the words only
        // through atomics, and nobody shortens the file while it is mapped.
        let map = unsafe { MmapMut::map_mut(&file) }.map_err(io("map the shared word"))?;
        Ok(SharedWords { map })
    }

    fn word(&self, offset: usize) -> &AtomicU64 {
        let start = self.map.as_ptr().wrapping_add(offset);
        // SAFETY: the mapping is a page long and page-aligned, so the word lies within it and is aligned;
        // it lives as long as `self`; all accesses, in both processes, are atomic.
        unsafe { AtomicU64::from_ptr(start.cast_mut().cast::<u64>()) }
    }

    /// Sends `value` one way and waits until it comes back the other.
    pub(super) fn round_trip(&self, value: u64) -> Result<(), BenchError> {
        self.word(0).store(value, Ordering::Release);
        wait_for(self.word(SECOND), value)
    }

    /// Answers until `last` has come.
    pub(super) fn echo(&self, last: u64) -> Result<(), BenchError> {
        for value in 1..=last {
            wait_for(self.word(0), value)?;
            self.word(SECOND).store(value, Ordering::Release);
        }
        Ok(())
    }
}

fn wait_for(word: &AtomicU64, value: u64) -> Result<(), BenchError> {
    let mut polls = 0u32;
    let mut since = None;
    while word.load(Ordering::Acquire) != value {
        std::hint::spin_loop();
        polls = polls.wrapping_add(1);
        if polls.is_multiple_of(1 << 20) && since.get_or_insert_with(Instant::now).elapsed() > PATIENCE {
            return Err(BenchError::Peer);
        }
    }
    Ok(())
}
