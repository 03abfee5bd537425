//! Callback for each tick of the OpenHaptics scheduler: one frame of a device, without Python.
//!
//! The vendor owns the scheduler's thread. The callback exerts the newest force that the loop has written. It
//! exerts zero once that force is older than the watchdog time, for example when the loop or the interpreter
//! hangs.
//!
//! Source: order of the calls as in CHAI3D, extras/hdPhantom/hdPhantom.cpp; codes as in pyOpenHaptics 1.0.1,
//! `hd_define.py`.
#![allow(unsafe_code)] // calls into the vendor's library

use std::{
    ffi::c_void,
    sync::{
        Mutex,
        atomic::{
            AtomicBool, AtomicU64,
            Ordering::{AcqRel, Acquire, Relaxed, Release},
        },
    },
    thread::{self, Thread},
    time::{Duration, Instant},
};

use super::latest::Latest;

const CURRENT_BUTTONS: u32 = 0x2000;
const CURRENT_VELOCITY: u32 = 0x2051;
const CURRENT_TRANSFORM: u32 = 0x2052;
const CURRENT_FORCE: u32 = 0x2700;
const CALLBACK_DONE: u32 = 0;
const CALLBACK_CONTINUE: u32 = 1;
/// Ticks between two checks of the calibration.
const CALIBRATION_EVERY: u64 = 100;
/// Most errors taken off the vendor's stack in one tick.
const ERRORS: u32 = 8;
/// Words of a sample: tick, transform, velocity, buttons and calibration, error.
const SAMPLE: usize = 1 + 16 + 3 + 2;
/// Words of a command: time of the write, and force.
const COMMAND: usize = 1 + 3;

/// `HDErrorInfo` of hdDefines.h.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct HdErrorInfo {
    /// 0 for no error.
    pub code: u32,
    /// Code of the driver below.
    pub internal: i32,
    /// Device that was current.
    pub device: u32,
}

/// Functions of the vendor's library that a frame needs.
#[derive(Debug, Clone, Copy)]
pub struct HdFunctions {
    /// `hdMakeCurrentDevice`
    pub make_current_device: unsafe extern "C" fn(u32),
    /// `hdBeginFrame`
    pub begin_frame: unsafe extern "C" fn(u32),
    /// `hdEndFrame`
    pub end_frame: unsafe extern "C" fn(u32),
    /// `hdGetDoublev`
    pub get_doubles: unsafe extern "C" fn(u32, *mut f64),
    /// `hdGetIntegerv`
    pub get_integers: unsafe extern "C" fn(u32, *mut i32),
    /// `hdSetDoublev`
    pub set_doubles: unsafe extern "C" fn(u32, *const f64),
    /// `hdGetError`
    pub get_error: unsafe extern "C" fn() -> HdErrorInfo,
    /// `hdCheckCalibration`
    pub check_calibration: unsafe extern "C" fn() -> u32,
}

/// Measurements of a frame, in the vendor's units and frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HdSample {
    /// Frames since the start, including this one.
    pub tick: u64,
    /// Column-major transform, position in mm.
    pub transform: [f64; 16],
    /// Velocity in mm/s.
    pub velocity: [f64; 3],
    /// Bit n: button n + 1.
    pub buttons: u32,
    /// Last result of `hdCheckCalibration`.
    pub calibration: u32,
    /// First error since the last acknowledgement; 0 for none.
    pub error: u32,
    /// Internal code of that error.
    pub internal_error: i32,
}

/// One device on the vendor's scheduler. It is never freed: a stopped scheduler may still be in its last
/// call.
#[derive(Debug)]
pub struct HdCallback {
    functions: HdFunctions,
    device: u32,
    watchdog_ns: u64,
    max_force_n: f64,
    begun: Instant,
    command: Latest<COMMAND>,
    sample: Latest<SAMPLE>,
    ticks: AtomicU64,
    /// Ticks with zero force because the newest command was too old.
    starved: AtomicU64,
    calibration: AtomicU64,
    /// Code and internal code of the first error.
    error: AtomicU64,
    ending: AtomicBool,
    ended: AtomicBool,
    waiter: Mutex<Option<Thread>>,
}

impl HdCallback {
    /// A callback for an open device, with the largest force and the age at which a force ends.
    ///
    /// # Safety
    ///
    /// `functions` must be those of hd.h and stay loaded.
    pub unsafe fn new(
        functions: HdFunctions,
        device: u32,
        watchdog: Duration,
        max_force_n: f64,
    ) -> &'static Self {
        Box::leak(Box::new(Self {
            functions,
            device,
            watchdog_ns: u64::try_from(watchdog.as_nanos()).unwrap_or(0),
            max_force_n,
            begun: Instant::now(),
            command: Latest::new(),
            sample: Latest::new(),
            ticks: AtomicU64::new(0),
            starved: AtomicU64::new(0),
            calibration: AtomicU64::new(0),
            error: AtomicU64::new(0),
            ending: AtomicBool::new(false),
            ended: AtomicBool::new(false),
            waiter: Mutex::new(None),
        }))
    }

    /// Function for the scheduler to call with [`Self::context`].
    pub fn address() -> unsafe extern "C" fn(*mut c_void) -> u32 {
        on_tick
    }

    /// Argument of [`Self::address`].
    pub fn context(&'static self) -> *const Self {
        self
    }

    /// Set the force in N, in the vendor's frame, until the next write or the watchdog time. Only one thread
    /// may write.
    pub fn write(&self, force: [f64; 3]) {
        let [x, y, z] = force.map(f64::to_bits);
        self.command.write(&[self.now_ns(), x, y, z]);
    }

    /// Waits for a sample newer than `after`; none after `limit`.
    pub fn wait(&self, after: u64, limit: Duration) -> Option<HdSample> {
        let own = thread::current();
        if let Ok(mut waiter) = self.waiter.lock()
            && waiter.as_ref().is_none_or(|other| other.id() != own.id())
        {
            *waiter = Some(own);
        }
        let begun = Instant::now();
        loop {
            if let Some(sample) = self.sample.read().map(sampled)
                && sample.tick > after
            {
                return Some(sample);
            }
            thread::park_timeout(limit.checked_sub(begun.elapsed()).filter(|left| !left.is_zero())?);
        }
    }

    /// Clear the first error, so that the next one is recorded.
    pub fn acknowledge(&self) {
        self.error.store(0, Release);
    }

    /// End the callback with a last frame of zero force; return true if that happens within `limit`.
    pub fn end(&self, limit: Duration) -> bool {
        self.ending.store(true, Release);
        let begun = Instant::now();
        while !self.ended.load(Acquire) {
            if begun.elapsed() >= limit {
                return false;
            }
            thread::park_timeout(Duration::from_micros(200));
        }
        true
    }

    /// Ticks with zero force because the newest command was too old.
    pub fn starved(&self) -> u64 {
        self.starved.load(Relaxed)
    }

    fn now_ns(&self) -> u64 {
        u64::try_from(self.begun.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    fn frame(&self) -> u32 {
        let of = &self.functions;
        let tick = self.ticks.load(Relaxed) + 1;
        let mut transform = [f64::NAN; 16];
        let mut velocity = [f64::NAN; 3];
        let mut buttons = 0;
        // An error in these calls also leads to zero force.
        unsafe {
            (of.make_current_device)(self.device);
            (of.begin_frame)(self.device);
            (of.get_doubles)(CURRENT_TRANSFORM, transform.as_mut_ptr());
            (of.get_doubles)(CURRENT_VELOCITY, velocity.as_mut_ptr());
            (of.get_integers)(CURRENT_BUTTONS, &raw mut buttons);
            if tick % CALIBRATION_EVERY == 1 {
                self.calibration.store((of.check_calibration)().into(), Relaxed);
            }
        }
        self.take_errors();
        let ending = self.ending.load(Acquire);
        let force = if ending { [0.0; 3] } else { self.force() };
        unsafe {
            (of.set_doubles)(CURRENT_FORCE, force.as_ptr());
            (of.end_frame)(self.device);
        }
        self.take_errors();
        self.publish(tick, &transform, velocity, buttons);
        if ending {
            self.ended.store(true, Release);
            return CALLBACK_DONE;
        }
        CALLBACK_CONTINUE
    }

    /// The newest force, bounded; zero after an error, without a command, or with one too old.
    fn force(&self) -> [f64; 3] {
        if self.error.load(Acquire) != 0 {
            return [0.0; 3];
        }
        let Some([at_ns, x, y, z]) = self.command.read() else { return [0.0; 3] };
        let force = [x, y, z].map(f64::from_bits);
        if self.now_ns().saturating_sub(at_ns) > self.watchdog_ns {
            if force != [0.0; 3] {
                self.starved.fetch_add(1, Relaxed);
            }
            return [0.0; 3];
        }
        let norm = force.iter().map(|part| part * part).sum::<f64>().sqrt();
        if !norm.is_finite() {
            return [0.0; 3];
        }
        if norm > self.max_force_n { force.map(|part| part * (self.max_force_n / norm)) } else { force }
    }

    fn take_errors(&self) {
        for _ in 0..ERRORS {
            let HdErrorInfo { code, internal, .. } = unsafe { (self.functions.get_error)() };
            if code == 0 {
                return;
            }
            let both = u64::from(code) | u64::from(internal.cast_unsigned()) << 32;
            let _ = self.error.compare_exchange(0, both, AcqRel, Acquire);
        }
    }

    fn publish(&self, tick: u64, transform: &[f64; 16], velocity: [f64; 3], buttons: i32) {
        let mut words = [0; SAMPLE];
        words[0] = tick;
        for (word, part) in words[1..20].iter_mut().zip(transform.iter().chain(&velocity)) {
            *word = part.to_bits();
        }
        words[20] = u64::from(buttons.cast_unsigned()) | self.calibration.load(Relaxed) << 32;
        words[21] = self.error.load(Acquire);
        self.sample.write(&words);
        self.ticks.store(tick, Release);
        // A held lock means that the waiter is registering; it then checks for a sample itself.
        if let Ok(waiter) = self.waiter.try_lock()
            && let Some(thread) = waiter.as_ref()
        {
            thread.unpark();
        }
    }
}

#[allow(clippy::cast_possible_truncation)] // halves of a word
fn sampled(words: [u64; SAMPLE]) -> HdSample {
    HdSample {
        tick: words[0],
        transform: std::array::from_fn(|index| f64::from_bits(words[1 + index])),
        velocity: std::array::from_fn(|index| f64::from_bits(words[17 + index])),
        buttons: words[20] as u32,
        calibration: (words[20] >> 32) as u32,
        error: words[21] as u32,
        internal_error: ((words[21] >> 32) as u32).cast_signed(),
    }
}

unsafe extern "C" fn on_tick(context: *mut c_void) -> u32 {
    // `context` comes from `new`, which leaks it.
    let callback = unsafe { &*context.cast::<HdCallback>() };
    callback.frame()
}

#[cfg(test)]
mod tests;
