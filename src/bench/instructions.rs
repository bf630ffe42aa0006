//! How many instructions something takes, where kernel and machine let us count.

use perf_event::events::Hardware;
use perf_event::{Builder, Counter};

/// The processor's counter of instructions retired in user space by this thread.
#[derive(Debug)]
pub(super) struct Instructions(Counter);

impl Instructions {
    /// `None` where there is no counter (many virtual machines) or none for us
    /// (`kernel.perf_event_paranoid`).
    pub(super) fn counter() -> Option<Instructions> {
        let counter = Builder::new().kind(Hardware::INSTRUCTIONS).build().ok()?;
        // Some virtual machines have a counter that always says zero.
        let mut probe = Instructions(counter);
        probe.count(|| ()).filter(|&count| count > 0).map(|_| probe)
    }

    /// Instructions that `work` takes, with some tens for switching the counter on and off.
    pub(super) fn count(&mut self, work: impl FnOnce()) -> Option<u64> {
        self.0.reset().ok()?;
        self.0.enable().ok()?;
        work();
        self.0.disable().ok()?;
        self.0.read().ok()
    }
}
