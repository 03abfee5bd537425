//! Signals to a command that runs loops: a thread that waits for nothing else forwards them.
//!
//! Python runs a handler only between its own steps; a thread blocked on a terminal write runs none. Its C
//! handler, however, writes the number of each signal to the descriptor of `signal.set_wakeup_fd` at once.

use std::{
    io::{self, Read},
    os::{
        fd::{AsRawFd, RawFd},
        unix::net::UnixStream,
    },
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use haptether_bridge::live::{LiveHandle, is_exhausted};
use pyo3::{
    exceptions::{PyMemoryError, PyTypeError},
    prelude::*,
};

use crate::{
    bridge_live::{LiveMaster, LiveSlave},
    device_loop::{MasterLoop, SlaveLoop},
    reserve,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<SignalRelay>()
}

/// Period at which the remaining memory is checked.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// Longest wait of a second Ctrl-C for the loops to come to rest.
const MAX_REST: Duration = Duration::from_millis(300);
/// Exit status of a command ended by Ctrl-C.
const INTERRUPTED: i32 = 130;
/// Largest age of an acknowledgement when it is taken; it refers to what the operator saw then.
const MAX_ACKNOWLEDGEMENT: Duration = Duration::from_millis(500);

/// Effect of SIGUSR1 on a side.
#[derive(Clone, Copy)]
enum Button {
    Clutch,
    Takeover,
}

#[derive(Default)]
struct Requests {
    stop: AtomicBool,
    loops: Mutex<Vec<(LiveHandle, Button)>>,
    acknowledged: Mutex<Option<Instant>>,
}

impl Requests {
    fn each(&self, command: impl Fn(&LiveHandle, Button)) {
        for (handle, button) in self.loops.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            command(handle, *button);
        }
    }

    fn stop_all(&self) {
        self.stop.store(true, Ordering::SeqCst);
        self.each(|handle, _| handle.stop());
    }

    /// Executes the requests of the signals, stops first: a stop overrides a press.
    fn take(&self, signals: &[u8]) {
        let count = |number: i32| signals.iter().filter(|signal| i32::from(**signal) == number).count();
        let interrupts = count(libc::SIGINT);
        let was_stopped = self.stop.load(Ordering::SeqCst);
        if interrupts + count(libc::SIGTERM) + count(libc::SIGHUP) > 0 {
            self.stop_all();
        }
        if interrupts > usize::from(!was_stopped) {
            self.exit();
        }
        if self.stop.load(Ordering::SeqCst) {
            return;
        }
        if count(libc::SIGUSR1) > 0 {
            self.each(|handle, button| match button {
                Button::Clutch => handle.press_clutch(),
                Button::Takeover => handle.allow_takeover(),
            });
        }
        if count(libc::SIGUSR2) > 0 {
            *self.acknowledged.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        }
    }

    /// End the process, whatever its other threads wait for; its loops get a moment to come to rest.
    #[allow(unsafe_code)] // a call that cannot fail
    fn exit(&self) -> ! {
        let end = Instant::now() + MAX_REST;
        let at_rest = || {
            let loops = self.loops.lock().unwrap_or_else(PoisonError::into_inner);
            loops.iter().all(|(handle, _)| handle.is_at_rest())
        };
        while !at_rest() && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(1));
        }
        // SAFETY: `_exit` has no preconditions.
        unsafe { libc::_exit(INTERRUPTED) }
    }
}

/// Forwards signals until the other end closes.
fn relay(mut from: UnixStream, requests: &Requests) {
    let mut signals = [0; 64];
    loop {
        match from.read(&mut signals) {
            Ok(0) => return,
            Ok(count) => requests.take(&signals[..count]),
            // A read timeout is also an error.
            Err(_) => (),
        }
        reserve::probe();
    }
}

#[documented]
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SignalRelay {
    to: UnixStream,
    requests: Arc<Requests>,
}

#[documented]
#[pymethods]
impl SignalRelay {
    #[new]
    fn new() -> PyResult<Self> {
        if !reserve::fill() {
            return Err(PyMemoryError::new_err("no memory can be set aside for the end of a run"));
        }
        let (to, from) = UnixStream::pair()?;
        to.set_nonblocking(true)?;
        from.set_read_timeout(Some(LOOK_EVERY))?;
        let requests = Arc::new(Requests::default());
        let theirs = Arc::clone(&requests);
        std::thread::Builder::new().name("haptether-signals".into()).spawn(move || relay(from, &theirs))?;
        Ok(Self { to, requests })
    }

    fn fileno(&self) -> RawFd {
        self.to.as_raw_fd()
    }

    fn attach(&self, of: &Bound<'_, PyAny>) -> PyResult<()> {
        let attached = if let Ok(of) = of.cast::<LiveMaster>() {
            (of.get().watched.handle.clone(), Button::Clutch)
        } else if let Ok(of) = of.cast::<MasterLoop>() {
            (of.get().watched.handle.clone(), Button::Clutch)
        } else if let Ok(of) = of.cast::<LiveSlave>() {
            (of.get().watched.handle.clone(), Button::Takeover)
        } else if let Ok(of) = of.cast::<SlaveLoop>() {
            (of.get().watched.handle.clone(), Button::Takeover)
        } else {
            return Err(PyTypeError::new_err(format!("{}: is no live loop", of.get_type())));
        };
        self.requests.loops.lock().unwrap_or_else(PoisonError::into_inner).push(attached);
        if self.stopped() {
            self.requests.stop_all();
        }
        Ok(())
    }

    fn stop(&self) {
        self.requests.stop_all();
    }

    #[getter]
    fn stopped(&self) -> bool {
        self.requests.stop.load(Ordering::SeqCst)
    }

    #[getter]
    #[allow(clippy::unused_self)] // state of the process, which owns the loops
    fn out_of_memory(&self) -> bool {
        is_exhausted()
    }

    #[allow(clippy::unused_self)] // as above
    fn spend_reserve(&self) {
        reserve::spend();
    }

    fn take_acknowledgement(&self) -> bool {
        let taken = self.requests.acknowledged.lock().unwrap_or_else(PoisonError::into_inner).take();
        taken.is_some_and(|at| at.elapsed() < MAX_ACKNOWLEDGEMENT)
    }

    fn close(&self) -> io::Result<()> {
        self.to.shutdown(std::net::Shutdown::Both)
    }
}
