//! Watch for a blocked driver: a thread steps the loop, so that both sides report why.

use std::{
    io,
    sync::{
        Arc, Mutex, TryLockError, Weak,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use super::{run::DriverLoop, system};
use crate::fault_text::FaultText;

/// Polling interval.
const LOOK: Duration = Duration::from_millis(50);
/// Consecutive polls in one call after which a driver is blocked. A suspended process does not poll.
const LOOKS: u32 = 10;
/// The same for the first `read`, which may give an arm its torque.
const FIRST_LOOKS: u32 = 20;

/// Bytes of the locked stack: a tick takes a few tens of KiB.
const STACK: usize = 1 << 19;
/// Wait in ns for a loop that another thread holds.
const MAX_TURN_NS: u64 = 10_000_000;

/// Present call of the driver's thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriverCall {
    /// In the loop, or at rest.
    None = 0,
    /// In `read`.
    Read = 1,
    /// In `write` or in other work after a tick.
    Write = 2,
}

/// Calls of a driver: its thread writes them, [`watch_driver`] reads them.
#[derive(Debug, Default)]
pub struct DriverCalls {
    /// Number of calls times 4, plus the newest [`DriverCall`].
    newest: AtomicU64,
    /// The call that was found blocked.
    blocked: AtomicU64,
}

impl DriverCalls {
    /// Mark the start of a call, on the driver's thread only.
    pub fn enter(&self, call: DriverCall) {
        let before = self.newest.load(Ordering::Relaxed) | 3;
        self.newest.store(before.wrapping_add(1) | call as u64, Ordering::Relaxed);
    }

    /// Return whether the newest call is blocked, as the watch has told both sides.
    pub fn is_blocked(&self) -> bool {
        let newest = self.newest();
        newest != 0 && newest == self.blocked.load(Ordering::Relaxed)
    }

    fn newest(&self) -> u64 {
        self.newest.load(Ordering::Relaxed)
    }
}

/// Start the thread that watches the driver `name` of a loop; it ends with the loop.
///
/// After 0.5 s in one call the side goes to FAULT with a text that names the call. The thread steps the loop until
/// the driver returns: frames, records and telemetry go on. At a stop it announces the end to the peer.
///
/// # Errors
///
/// The system cannot create a thread.
pub fn watch_driver<L>(paced: &Arc<Mutex<Box<L>>>, calls: &Arc<DriverCalls>, name: String) -> io::Result<()>
where
    L: DriverLoop + Send + ?Sized + 'static,
{
    let (paced, calls) = (Arc::downgrade(paced), Arc::clone(calls));
    let builder = thread::Builder::new().name("haptether-watch".into()).stack_size(STACK);
    builder.spawn(move || watch(&paced, &calls, &name))?;
    Ok(())
}

fn watch<L: DriverLoop + ?Sized>(paced: &Weak<Mutex<Box<L>>>, calls: &DriverCalls, name: &str) {
    let (mut seen, mut looks) = (0, 0);
    loop {
        thread::sleep(LOOK);
        let Some(paced) = paced.upgrade() else { return };
        let newest = calls.newest();
        looks = if newest == seen { looks + 1 } else { 0 };
        seen = newest;
        let call = match newest & 3 {
            1 => "read",
            2 => "write",
            _ => continue,
        };
        let allowed = if newest >> 2 == 1 { FIRST_LOOKS } else { LOOKS };
        if looks < allowed {
            continue;
        }
        calls.blocked.store(seen, Ordering::Relaxed);
        let blocked_s = (LOOK * allowed).as_secs_f64();
        let text = format!(
            "{name}: KEEPS ITS LAST COMMAND, switch it off: {call} has not returned for {blocked_s:.1} s"
        );
        let text = FaultText::new(&text);
        while calls.newest() == seen {
            let next_ns = match paced.try_lock() {
                Ok(mut paced) => match paced.turn_blocked(&text) {
                    Some(next_ns) => next_ns,
                    None => return,
                },
                // The thread that ends the loop holds it.
                Err(TryLockError::WouldBlock) => system::now_ns() + MAX_TURN_NS,
                Err(TryLockError::Poisoned(_)) => return,
            };
            system::sleep_until(next_ns);
        }
    }
}
