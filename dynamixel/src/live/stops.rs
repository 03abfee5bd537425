//! Stops that wait for the bus.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use super::port::now_ns;

/// Time in ns that a call may continue while a stop waits: an answer on the line can end, so the stop does
/// not collide.
const GRACE_NS: u64 = 2_000_000;

/// Stops that wait for the bus.
#[derive(Debug, Default)]
pub(super) struct Stops {
    waiting: AtomicU32,
    /// Time at which the first of them was requested, in ns.
    since_ns: AtomicU64,
}

impl Stops {
    /// Test if a call must end for a waiting stop.
    pub(super) fn cut(&self, now_ns: u64) -> bool {
        self.waiting.load(Ordering::Acquire) > 0
            && now_ns >= self.since_ns.load(Ordering::Relaxed).saturating_add(GRACE_NS)
    }

    pub(super) fn begin(&self) {
        // If two begin at once, the time of either is correct.
        if self.waiting.load(Ordering::Acquire) == 0 {
            self.since_ns.store(now_ns(), Ordering::Relaxed);
        }
        self.waiting.fetch_add(1, Ordering::Release);
    }

    pub(super) fn end(&self) {
        self.waiting.fetch_sub(1, Ordering::Release);
    }
}
