//! Doorbells: how a sender wakes a receiver that sleeps.
//!
//! Each process of a run has one word in a file that all of them map. Who is about to sleep says so there,
//! looks once more whether anything has come, and sleeps on the word (a futex); who has sent something looks
//! at the word, and rings if somebody sleeps. So nothing is asked of the system while nobody sleeps, and one
//! call is made by each side when somebody does.
//!
//! No ring is lost: the sleeper writes its word and then looks at its inbox, the sender sends and then looks
//! at the word, each with a full fence between the two. At least one of them sees what the other has done.
//! What a stranger writes to a word can make a sleep end early, or last for as long as the sleeper allows
//! itself, and no more. One who may shorten the file may shorten the frames too, and end each process.

use crate::scenario::share::{MAX_CONTROLLERS, MAX_COORDINATORS};
use ipc_schemas::Role;
use memmap2::MmapRaw;
use rustix::thread::{futex, sched_getcpu};
use rustix::time::{ClockId, Timespec, clock_gettime};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::rc::Rc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};
use std::time::Duration;

/// The bells of a run, mapped by this process.
#[derive(Clone, Debug)]
pub struct Bells(Rc<MmapRaw>);

/// The ring that ended a sleep. Whoever may write to the file may have made it up.
#[derive(Clone, Copy, Debug)]
pub struct Ring {
    /// When, ns on the [monotonic clock](monotonic_ns).
    pub at_ns: u64,
    /// The core to go to, which whoever rang is about to give away.
    pub core: Option<usize>,
}

/// The sleeper's end.
#[derive(Debug)]
pub struct Bell(Cell);

/// A sender's end.
#[derive(Debug)]
pub struct BellRope(Cell);

/// One process's place in the file.
#[derive(Debug)]
struct Cell {
    map: Rc<MmapRaw>,
    offset: usize,
}

/// The sleeper's word: it is awake, or has been rung.
const AWAKE: u32 = 0;
/// The sleeper's word: it sleeps, or is about to.
const ASLEEP: u32 = 1;

/// Distance of two cells: two lines, as processors prefetch in pairs.
const CELL_BYTES: usize = 128;
/// Where in a cell the instant of the last ring is.
const RUNG_AT: usize = 8;
/// Where in a cell the core is that is given away to the sleeper, and one; or 0.
const GIVEN: usize = 16;
/// The world, and room for as many others as there may be.
const CELLS: usize = 1 + (MAX_COORDINATORS + MAX_CONTROLLERS) as usize;
/// Size of the file.
const BYTES: usize = CELLS * CELL_BYTES;

/// Nanoseconds on the clock that all processes of a machine share.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

impl Bells {
    /// Creates the file, which must not exist, and maps it.
    pub(super) fn create(path: &std::path::Path) -> std::io::Result<Bells> {
        let mut options = std::fs::OpenOptions::new();
        let file = options.read(true).write(true).create_new(true).mode(0o600).open(path)?;
        file.set_len(BYTES as u64)?;
        Bells::map(&file)
    }

    /// Maps a file that another process of the run has created.
    pub(super) fn open(path: &std::path::Path) -> std::io::Result<Bells> {
        let no_links = rustix::fs::OFlags::NOFOLLOW.bits() as i32;
        let file = std::fs::OpenOptions::new().read(true).write(true).custom_flags(no_links).open(path)?;
        Bells::map(&file)
    }

    fn map(file: &std::fs::File) -> std::io::Result<Bells> {
        let metadata = file.metadata()?;
        let is_ours = metadata.is_file() && metadata.uid() == rustix::process::geteuid().as_raw();
        if !is_ours || metadata.len() != BYTES as u64 {
            let expected = format!("expected a file of this user's of {BYTES} bytes");
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, expected));
        }
        Ok(Bells(Rc::new(MmapRaw::map_raw(file)?)))
    }

    fn cell(&self, role: Role, index: u32) -> Cell {
        let cell = match role {
            Role::World => 0,
            Role::Coordinator => 1 + index.min(MAX_COORDINATORS - 1),
            Role::Controller => 1 + MAX_COORDINATORS + index.min(MAX_CONTROLLERS - 1),
        };
        Cell { map: self.0.clone(), offset: cell as usize * CELL_BYTES }
    }

    /// The bell of this process.
    pub fn bell(&self, role: Role, index: u32) -> Bell {
        let bell = Bell(self.cell(role, index));
        // Whoever had this place before may have been killed in its sleep.
        bell.stay_awake();
        bell
    }

    /// Takes hold of another process's bell rope.
    pub fn rope(&self, role: Role, index: u32) -> BellRope {
        BellRope(self.cell(role, index))
    }
}

impl Cell {
    fn word(&self) -> &AtomicU32 {
        // SAFETY: `Bells` maps `BYTES` bytes, readable and writable, and `cell` keeps every cell within them; a
        // map begins at a page and a cell at a multiple of 128, so the word is aligned. The map lives as long
        // as `self`. All of its words are accessed through atomics alone, in every process of ours.
        unsafe { AtomicU32::from_ptr(self.map.as_mut_ptr().add(self.offset).cast()) }
    }

    fn given(&self) -> &AtomicU32 {
        // SAFETY: as for `word`; 16 bytes further on in the same cell.
        unsafe { AtomicU32::from_ptr(self.map.as_mut_ptr().add(self.offset + GIVEN).cast()) }
    }

    fn rung_at(&self) -> &AtomicU64 {
        // SAFETY: as for `word`; 8 bytes further on in the same cell, and aligned to 8.
        unsafe { AtomicU64::from_ptr(self.map.as_mut_ptr().add(self.offset + RUNG_AT).cast()) }
    }
}

impl Bell {
    /// Says that this process is about to sleep. After this it must look once more whether anything has come,
    /// and then either [`sleep`](Self::sleep) or [`stay_awake`](Self::stay_awake).
    pub fn lie_down(&self) {
        self.0.word().store(ASLEEP, Ordering::Relaxed);
        fence(Ordering::SeqCst);
    }

    /// Sleeps until the bell rings, or has rung since [`lie_down`](Self::lie_down), or the time is up. Returns
    /// the ring, if there was one.
    pub fn sleep(&self, at_most: Duration) -> Option<Ring> {
        let at_most =
            Timespec { tv_sec: at_most.as_secs() as i64, tv_nsec: i64::from(at_most.subsec_nanos()) };
        // However it ends, whoever called looks again.
        let _ = futex::wait(self.0.word(), futex::Flags::empty(), ASLEEP, Some(&at_most));
        let was_rung = self.0.word().swap(AWAKE, Ordering::Acquire) == AWAKE;
        was_rung.then(|| Ring {
            at_ns: self.0.rung_at().load(Ordering::Relaxed),
            core: self.0.given().load(Ordering::Relaxed).checked_sub(1).map(|core| core as usize),
        })
    }

    /// Takes [`lie_down`](Self::lie_down) back.
    pub fn stay_awake(&self) {
        self.0.word().store(AWAKE, Ordering::Relaxed);
    }
}

impl BellRope {
    /// Whether the sleeper sleeps, or is about to, as far as can be seen without a fence.
    pub fn is_asleep(&self) -> bool {
        self.0.word().load(Ordering::Relaxed) != AWAKE
    }

    /// Wakes the sleeper, if it sleeps, after something was sent to it. Several ropes are pulled faster by
    /// `ring_all`.
    pub fn ring(&self) {
        fence(Ordering::SeqCst);
        self.ring_after_fence(|| 0);
    }

    /// The same from one who is about to give its core away, and for it to the sleeper.
    pub fn ring_and_give_way(&self) {
        fence(Ordering::SeqCst);
        self.ring_after_fence(|| sched_getcpu() as u32 + 1);
    }

    fn ring_after_fence(&self, given: impl Fn() -> u32) {
        let word = self.0.word();
        if word.load(Ordering::Relaxed) == AWAKE {
            return;
        }
        self.0.rung_at().store(monotonic_ns(), Ordering::Relaxed);
        self.0.given().store(given(), Ordering::Relaxed);
        // Of several ringers one makes the call.
        if word.swap(AWAKE, Ordering::Release) != AWAKE {
            let _ = futex::wake(word, futex::Flags::empty(), 1);
        }
    }
}

/// Wakes all of these who sleep, after something was sent to them.
pub fn ring_all(ropes: &[BellRope]) {
    if !ropes.is_empty() {
        fence(Ordering::SeqCst);
        ropes.iter().for_each(|rope| rope.ring_after_fence(|| 0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    /// Bells of two mappings of one file, as two processes have them.
    fn two_maps() -> (Bells, Bells, tempfile::TempDir) {
        let site = tempfile::tempdir().expect("there is a temporary directory");
        let path = site.path().join("bells");
        let ours = Bells::create(&path).expect("the file can be created");
        (ours, Bells::open(&path).expect("the file can be mapped again"), site)
    }

    const LONG: Duration = Duration::from_secs(600);

    #[test]
    fn a_ring_before_a_sleep_or_during_it_ends_it_and_no_ring_does_not() {
        let (ours, theirs, _site) = two_maps();
        let (bell, rope) = (ours.bell(Role::Coordinator, 63), theirs.rope(Role::Coordinator, 63));
        let other = theirs.rope(Role::Controller, 0);
        bell.lie_down();
        other.ring();
        assert!(bell.sleep(Duration::from_millis(1)).is_none(), "it was another's bell");
        bell.lie_down();
        let before = monotonic_ns();
        rope.ring();
        let ring = bell.sleep(LONG).expect("it was rung before it slept");
        assert!((before..=monotonic_ns()).contains(&ring.at_ns));
        assert_eq!(ring.core, None);
        bell.lie_down();
        rope.ring_and_give_way();
        let core = bell.sleep(LONG).and_then(|ring| ring.core).expect("a core was given away");
        assert!(rustix::thread::sched_getaffinity(None).expect("the system tells").is_set(core));
        // A ring nobody sleeps through leaves nothing behind.
        rope.ring();
        bell.lie_down();
        assert!(bell.sleep(Duration::from_millis(1)).is_none());
    }

    /// A ball goes to and fro between two sleepers who never spin. Would a single ring be lost, it would lie
    /// for ten minutes.
    #[test]
    fn no_ring_is_lost() {
        const ROUNDS: u64 = 100_000;
        let (ours, theirs, _site) = two_maps();
        let path = _site.path().join("bells");
        drop(theirs);
        let ball = std::sync::Arc::new(AtomicU64::new(0));
        let play = move |bells: &Bells, ball: &AtomicU64, own: u32| {
            let (bell, rope) = (bells.bell(Role::Controller, own), bells.rope(Role::Controller, 1 - own));
            let mut longest = Duration::ZERO;
            for round in 0..ROUNDS {
                let mine = 2 * round + u64::from(own);
                loop {
                    if ball.load(Ordering::Relaxed) == mine {
                        break;
                    }
                    bell.lie_down();
                    if ball.load(Ordering::Relaxed) == mine {
                        bell.stay_awake();
                        break;
                    }
                    let start = Instant::now();
                    bell.sleep(LONG);
                    longest = longest.max(start.elapsed());
                }
                ball.store(mine + 1, Ordering::Relaxed);
                rope.ring();
            }
            longest
        };
        let theirs = ball.clone();
        let other = std::thread::spawn(move || {
            play(&Bells::open(&path).expect("the file can be mapped"), &theirs, 1)
        });
        let longest = play(&ours, &ball, 0).max(other.join().expect("the other player gets to the end"));
        assert_eq!(ball.load(Ordering::Relaxed), 2 * ROUNDS);
        assert!(longest < LONG, "a ring was lost");
    }

    #[test]
    fn a_file_of_another_size_is_not_mapped() {
        let site = tempfile::tempdir().expect("there is a temporary directory");
        let path = site.path().join("bells");
        std::fs::write(&path, [0; 64]).expect("the file can be written");
        let error = Bells::open(&path).expect_err("it is too short");
        assert!(error.to_string().contains(&BYTES.to_string()), "{error}");
    }
}
