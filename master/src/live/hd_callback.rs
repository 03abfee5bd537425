//! What the scheduler of OpenHaptics calls at each of its ticks: one frame of a device, without Python.
//!
//! The scheduler's thread is the vendor's. It takes the newest force that the loop has written, and zero where that is
//! older than the watchdog's time: a loop that hangs, or an interpreter that does not come to it, ends the force here.
//!
//! Source: order of the calls as in CHAI3D, extras/hdPhantom/hdPhantom.cpp; codes as in pyOpenHaptics 1.0.1, `hd_define.py`.
#![allow(unsafe_code)] // the functions of the vendor's library

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
/// Each so many ticks the calibration is looked at.
const CALIBRATION_EVERY: u64 = 100;
/// So many errors of one tick are taken off the vendor's stack.
const ERRORS: u32 = 8;
/// Words of a sample: tick, transform, velocity, buttons and calibration, error.
const SAMPLE: usize = 1 + 16 + 3 + 2;
/// Words of a command: when it was written, and the force.
const COMMAND: usize = 1 + 3;

/// `HDErrorInfo` of hdDefines.h.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct HdErrorInfo {
    /// 0 where there is none.
    pub code: u32,
    /// That of the driver below.
    pub internal: i32,
    /// The device that was current.
    pub device: u32,
}

/// The functions of the vendor's library that a frame needs.
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

/// What a frame has measured, in the units and the frame of the vendor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HdSample {
    /// Frames since the begin, this one included.
    pub tick: u64,
    /// Column by column, position in mm.
    pub transform: [f64; 16],
    /// In mm/s.
    pub velocity: [f64; 3],
    /// Bit n: button n + 1.
    pub buttons: u32,
    /// As `hdCheckCalibration` said it last.
    pub calibration: u32,
    /// The first error since the last acknowledgement; 0 where there is none.
    pub error: u32,
    /// Its internal code.
    pub internal_error: i32,
}

/// One device on the vendor's scheduler. It lives for ever: a scheduler that was stopped may still be in a last call.
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
    /// Ticks whose force was zero because the newest command was too old.
    starved: AtomicU64,
    calibration: AtomicU64,
    /// Code and internal code of the first error.
    error: AtomicU64,
    ending: AtomicBool,
    ended: AtomicBool,
    waiter: Mutex<Option<Thread>>,
}

impl HdCallback {
    /// For a device that is open, with a bound of the force and the age at which a force ends.
    ///
    /// # Safety
    ///
    /// The functions must be those of hd.h, and stay loaded.
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

    /// What the scheduler calls, with [`Self::context`].
    pub fn address() -> unsafe extern "C" fn(*mut c_void) -> u32 {
        on_tick
    }

    /// What [`Self::address`] is called with.
    pub fn context(&'static self) -> *const Self {
        self
    }

    /// The force in N, in the vendor's frame, until the next one or the watchdog's time; one thread at a time.
    pub fn write(&self, force: [f64; 3]) {
        let [x, y, z] = force.map(f64::to_bits);
        self.command.write(&[self.now_ns(), x, y, z]);
    }

    /// The newest sample after a tick, as soon as there is one; none within the time.
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

    /// Forgets the first error; another one is the first again.
    pub fn acknowledge(&self) {
        self.error.store(0, Release);
    }

    /// Ends the callback with a last frame of zero force; whether that was within the time.
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

    /// How many ticks had zero force because the newest command was too old.
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
        // Of an error of these, too, nothing is exerted.
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

    /// The newest force, bounded; zero where nothing is certain.
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
        // Whoever holds it changes it: it looks for itself then.
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
    // Made by `new`, which leaks it.
    let callback = unsafe { &*context.cast::<HdCallback>() };
    callback.frame()
}

#[cfg(test)]
mod tests;
