//! One bus for several threads, any of which may stop the servos at any time.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::{
    bus::{Bus, BusError},
    stops::Stops,
};

/// Bus for several threads: one call at a time, and stops before all waiting calls.
///
/// A call in progress ends within a few ms for a stop: with its answer, or [`BusError::Stopped`]. A packet in
/// transmission is completed.
#[derive(Debug)]
pub struct SharedBus {
    /// Held by a call from before it waits for the bus until its end, so that at most one call delays a stop.
    calls: Mutex<()>,
    /// Held by the next user of the bus.
    next: Mutex<()>,
    /// `None` once closed.
    bus: Mutex<Option<Bus>>,
    stops: Arc<Stops>,
}

impl SharedBus {
    /// Shares a bus that has no other user.
    pub fn new(mut bus: Bus) -> Self {
        let stops = Arc::new(Stops::default());
        bus.end_for(Arc::clone(&stops));
        Self { calls: Mutex::new(()), next: Mutex::new(()), bus: Mutex::new(Some(bus)), stops }
    }

    /// Run calls on the bus, after calls of other threads and all stops.
    pub fn call<T>(&self, run: impl FnOnce(&mut Bus) -> Result<T, BusError>) -> Result<T, BusError> {
        let _call = locked(&self.calls);
        run(self.bus().as_mut().ok_or(BusError::Closed)?)
    }

    /// Run [`Bus::stop`] from any thread: waits a few ms for another call, or for another stop.
    pub fn stop(&self, address: u16, length: u16, ids: &[u8], data: &[u8]) -> Result<(), BusError> {
        self.stops.begin();
        let mut bus = self.bus();
        self.stops.end();
        bus.as_mut().ok_or(BusError::Closed)?.stop(address, length, ids, data)
    }

    /// Close the port; later calls return [`BusError::Closed`].
    pub fn close(&self) {
        let _call = locked(&self.calls);
        self.bus().take();
    }

    fn bus(&self) -> MutexGuard<'_, Option<Bus>> {
        let _next = locked(&self.next);
        locked(&self.bus)
    }
}

/// Ignore poisoning: a stop must be sent even after a panic of another thread.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
