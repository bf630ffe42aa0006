//! A bound on calls of iceoryx2 that have none of their own: it waits for ever for files of other processes that are
//! empty, which may be about to grow, or may have been cut short.

use super::unfinished::remove_unfinished;
use crate::own_time::Bound;
use crossbeam::channel::{RecvTimeoutError, bounded};
use std::io::Write;
use std::thread::Builder;
use std::time::Duration;

/// Longest time a call may take. Those that are well take well below a millisecond.
const LIMIT: Duration = Duration::from_secs(5);
/// Time between two looks at the clock.
const LOOK: Duration = Duration::from_millis(100);

/// Does the work in the space with that prefix. When it takes long, files that nobody will finish are taken out of its
/// way; when it takes too long, this process ends with a message: there is no other way out of a call that does not
/// return.
pub(super) fn within_bounds<T>(prefix: &str, what: &str, work: impl FnOnce() -> T) -> T {
    let (working, done) = bounded::<()>(0);
    let (prefix, what) = (prefix.to_owned(), what.to_owned());
    let watch = move || {
        let mut bound = Bound::of(LIMIT);
        while done.recv_timeout(LOOK) == Err(RecvTimeoutError::Timeout) {
            if bound.is_over() {
                let why = "files of the run in shared memory may have been cut short by another process";
                let _ =
                    writeln!(std::io::stderr(), "cz: {what} took longer than {} s; {why}", LIMIT.as_secs());
                std::process::exit(1);
            }
            remove_unfinished(&prefix);
        }
    };
    // Without a thread there is nobody to watch, and nothing else to be done about it.
    let _watcher = Builder::new().name("watchdog".to_owned()).stack_size(64 << 10).spawn(watch);
    let result = work();
    drop(working);
    result
}
