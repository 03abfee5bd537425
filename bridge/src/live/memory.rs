//! Whether this process has memory left: a loop that meets none ends while it still can.

use std::sync::atomic::{AtomicBool, Ordering};

/// Of the process, as memory is.
static EXHAUSTED: AtomicBool = AtomicBool::new(false);

/// Ends each loop of this process at its next tick: no force, no motion, and the peer is sent the end.
pub fn end_for_lack_of_memory() {
    EXHAUSTED.store(true, Ordering::Relaxed);
}

/// There is memory again, for loops that begin from now on.
pub fn memory_is_back() {
    EXHAUSTED.store(false, Ordering::Relaxed);
}

/// Whether none was left.
pub fn is_exhausted() -> bool {
    EXHAUSTED.load(Ordering::Relaxed)
}
