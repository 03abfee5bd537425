//! One bus for several threads, of which any may stop the servos at any time.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicU32, AtomicU64, Ordering},
};

use super::{
    bus::{Bus, BusError},
    port::now_ns,
};

/// So long a call may go on that a stop waits for: an answer on the line then ends, and the stop does not collide with it.
const GRACE_NS: u64 = 2_000_000;

/// The stops that wait for the bus.
#[derive(Debug, Default)]
pub(super) struct Stops {
    waiting: AtomicU32,
    /// When the first of them was requested.
    since_ns: AtomicU64,
}

impl Stops {
    /// Whether a call has to end for them.
    pub(super) fn cut(&self, now_ns: u64) -> bool {
        self.waiting.load(Ordering::Acquire) > 0
            && now_ns >= self.since_ns.load(Ordering::Relaxed).saturating_add(GRACE_NS)
    }

    fn begin(&self) {
        // Of two at once either's time will do.
        if self.waiting.load(Ordering::Acquire) == 0 {
            self.since_ns.store(now_ns(), Ordering::Relaxed);
        }
        self.waiting.fetch_add(1, Ordering::Release);
    }

    fn end(&self) {
        self.waiting.fetch_sub(1, Ordering::Release);
    }
}

/// A bus that several threads have: one call after the other, and a stop before all that wait.
///
/// A call in progress ends within a few ms for a stop: with its answer, or [`BusError::Stopped`]. A packet that is being
/// sent is sent whole.
#[derive(Debug)]
pub struct SharedBus {
    /// Had by a call from before it waits for the bus until its end: at most one call is in a stop's way.
    calls: Mutex<()>,
    /// Had by whoever has the bus next.
    next: Mutex<()>,
    /// None once it is closed.
    bus: Mutex<Option<Bus>>,
    stops: Arc<Stops>,
}

impl SharedBus {
    /// Of a bus that nobody else has.
    pub fn new(mut bus: Bus) -> Self {
        let stops = Arc::new(Stops::default());
        bus.end_for(Arc::clone(&stops));
        Self { calls: Mutex::new(()), next: Mutex::new(()), bus: Mutex::new(Some(bus)), stops }
    }

    /// Runs calls on the bus, once those of other threads and all stops are over.
    pub fn call<T>(&self, run: impl FnOnce(&mut Bus) -> Result<T, BusError>) -> Result<T, BusError> {
        let _call = locked(&self.calls);
        run(self.bus().as_mut().ok_or(BusError::Closed)?)
    }

    /// [`Bus::stop`], from any thread: it waits for a few ms of another call, or for another stop.
    pub fn stop(&self, address: u16, length: u16, ids: &[u8], data: &[u8]) -> Result<(), BusError> {
        self.stops.begin();
        let mut bus = self.bus();
        self.stops.end();
        bus.as_mut().ok_or(BusError::Closed)?.stop(address, length, ids, data)
    }

    /// Gives the port back; any other call is [`BusError::Closed`] then.
    pub fn close(&self) {
        let _call = locked(&self.calls);
        self.bus().take();
    }

    fn bus(&self) -> MutexGuard<'_, Option<Bus>> {
        let _next = locked(&self.next);
        locked(&self.bus)
    }
}

/// After a panic of another thread, too: a stop is sent nevertheless.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
