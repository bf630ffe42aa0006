//! Independent pieces of work on all cores.

use crossbeam::channel;

/// Does `work` on every item with at most `jobs` threads. Results are handed to `done`, on the calling thread, as
/// they come; the first failure ends it.
///
/// # Panics
/// When `work` does.
pub fn each<T: Sync, R: Send, E: Send>(
    jobs: usize,
    items: &[T],
    work: impl Fn(&T) -> Result<R, E> + Sync,
    mut done: impl FnMut(&T, R),
) -> Result<(), E> {
    let (give, take) = channel::unbounded::<&T>();
    let (report, results) = channel::unbounded();
    for item in items {
        give.send(item).expect("the receiving end is in scope");
    }
    drop(give);
    crossbeam::thread::scope(|scope| {
        for _ in 0..jobs.min(items.len()) {
            let (take, report, work) = (take.clone(), report.clone(), &work);
            scope.spawn(move |_| {
                for item in take {
                    // Nobody listens any more once one has failed.
                    if report.send((item, work(item))).is_err() {
                        return;
                    }
                }
            });
        }
        drop(report);
        for (item, result) in results {
            done(item, result?);
        }
        Ok(())
    })
    .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}
