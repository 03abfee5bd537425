use std::cell::{Cell, RefCell};

use super::*;

// A single-threaded vendor library: the test is its scheduler.
thread_local! {
    static CALLS: RefCell<Vec<&'static str>> = const { RefCell::new(Vec::new()) };
    static EXERTED: Cell<[f64; 3]> = const { Cell::new([f64::NAN; 3]) };
    static ERRORS_LEFT: Cell<u32> = const { Cell::new(0) };
    static FAILS_IN: Cell<&'static str> = const { Cell::new("") };
}

fn called(name: &'static str) {
    CALLS.with_borrow_mut(|calls| calls.push(name));
    if FAILS_IN.get() == name {
        ERRORS_LEFT.set(ERRORS_LEFT.get() + 1);
    }
}

unsafe extern "C" fn make_current_device(_: u32) {
    called("make current");
}

unsafe extern "C" fn begin_frame(device: u32) {
    assert_eq!(device, 5);
    called("begin");
}

unsafe extern "C" fn end_frame(_: u32) {
    called("end");
}

unsafe extern "C" fn get_doubles(code: u32, to: *mut f64) {
    called(if code == CURRENT_TRANSFORM { "transform" } else { "velocity" });
    for index in 0..if code == CURRENT_TRANSFORM { 16_u8 } else { 3 } {
        unsafe { to.add(index.into()).write(f64::from(index) + 0.5) };
    }
}

unsafe extern "C" fn get_integers(code: u32, to: *mut i32) {
    assert_eq!(code, CURRENT_BUTTONS);
    called("buttons");
    unsafe { to.write(3) };
}

unsafe extern "C" fn set_doubles(code: u32, from: *const f64) {
    assert_eq!(code, CURRENT_FORCE);
    called("force");
    EXERTED.set(unsafe { from.cast::<[f64; 3]>().read() });
}

unsafe extern "C" fn get_error() -> HdErrorInfo {
    let left = ERRORS_LEFT.get();
    ERRORS_LEFT.set(left.saturating_sub(1));
    HdErrorInfo { code: if left > 0 { 0x302 } else { 0 }, internal: -7, device: 5 }
}

unsafe extern "C" fn check_calibration() -> u32 {
    called("calibration");
    0x5000
}

fn callback(watchdog: Duration) -> &'static HdCallback {
    let functions = HdFunctions {
        make_current_device,
        begin_frame,
        end_frame,
        get_doubles,
        get_integers,
        set_doubles,
        get_error,
        check_calibration,
    };
    unsafe { HdCallback::new(functions, 5, watchdog, 3.0) }
}

fn tick(of: &'static HdCallback) -> u32 {
    unsafe { HdCallback::address()(of.context().cast_mut().cast()) }
}

const LONG: Duration = Duration::from_secs(600);

#[test]
fn a_frame_reads_exerts_and_publishes_in_the_order_of_the_vendor() {
    let of = callback(LONG);
    assert_eq!(of.wait(0, Duration::ZERO), None);
    of.write([1.0, -2.0, 0.5]);
    assert_eq!(tick(of), CALLBACK_CONTINUE);
    assert_eq!(EXERTED.get(), [1.0, -2.0, 0.5]);
    CALLS.with_borrow(|calls| {
        assert_eq!(
            *calls,
            ["make current", "begin", "transform", "velocity", "buttons", "calibration", "force", "end"]
        );
    });
    let sample = of.wait(0, Duration::ZERO).unwrap();
    assert_eq!((sample.tick, sample.buttons, sample.calibration), (1, 3, 0x5000));
    assert_eq!((sample.transform[15], sample.velocity[2]), (15.5, 2.5));
    assert_eq!((sample.error, sample.internal_error), (0, 0));
    assert_eq!(of.wait(1, Duration::from_millis(2)), None);
}

#[test]
fn calibration_is_checked_periodically() {
    let of = callback(LONG);
    for _ in 0..201 {
        tick(of);
    }
    CALLS.with_borrow(|calls| assert_eq!(calls.iter().filter(|name| **name == "calibration").count(), 3));
}

#[test]
fn a_force_is_zero_before_the_first_command_and_once_the_newest_is_too_old() {
    let of = callback(Duration::from_millis(3));
    tick(of);
    assert_eq!((EXERTED.get(), of.starved()), ([0.0; 3], 0));
    of.write([1.0, 0.0, 0.0]);
    thread::sleep(Duration::from_millis(8));
    tick(of);
    assert_eq!((EXERTED.get(), of.starved()), ([0.0; 3], 1));
    // A stale zero force does not count as starved.
    of.write([0.0; 3]);
    thread::sleep(Duration::from_millis(8));
    tick(of);
    assert_eq!(of.starved(), 1);
}

#[test]
fn force_is_bounded_and_nan_is_zero() {
    let of = callback(LONG);
    for (written, exerted) in [
        ([0.0, 30.0, 40.0], [0.0, 1.8, 2.4]),
        ([f64::NAN, 0.0, 0.0], [0.0; 3]),
        ([0.0, f64::INFINITY, 0.0], [0.0; 3]),
        ([1e200, 1e200, 0.0], [0.0; 3]),
    ] {
        of.write(written);
        tick(of);
        for (seen, wanted) in EXERTED.get().iter().zip(exerted) {
            assert!((seen - wanted).abs() < 1e-12, "{written:?}: {:?}", EXERTED.get());
        }
    }
}

#[test]
fn an_error_ends_the_force_in_its_own_frame_until_it_is_acknowledged() {
    for fails_in in ["begin", "transform", "calibration"] {
        let of = callback(LONG);
        of.write([1.0, 0.0, 0.0]);
        FAILS_IN.set(fails_in);
        tick(of);
        FAILS_IN.set("");
        assert_eq!(EXERTED.get(), [0.0; 3], "{fails_in}");
        tick(of);
        assert_eq!(EXERTED.get(), [0.0; 3], "{fails_in}");
        let sample = of.wait(1, Duration::ZERO).unwrap();
        assert_eq!((sample.error, sample.internal_error), (0x302, -7));
        of.acknowledge();
        tick(of);
        assert_eq!(EXERTED.get(), [1.0, 0.0, 0.0]);
        assert_eq!(of.wait(2, Duration::ZERO).unwrap().error, 0);
    }
    // An error at the end of a frame counts in the next frame.
    let of = callback(LONG);
    of.write([1.0, 0.0, 0.0]);
    FAILS_IN.set("end");
    tick(of);
    FAILS_IN.set("");
    tick(of);
    assert_eq!(EXERTED.get(), [0.0; 3]);
}

#[test]
fn an_error_at_each_tick_does_not_hold_the_scheduler() {
    let of = callback(LONG);
    ERRORS_LEFT.set(u32::MAX);
    assert_eq!(tick(of), CALLBACK_CONTINUE);
    ERRORS_LEFT.set(0);
}

#[test]
fn last_frame_has_zero_force() {
    let of = callback(LONG);
    of.write([1.0, 0.0, 0.0]);
    assert!(!of.end(Duration::from_millis(1)));
    assert_eq!(tick(of), CALLBACK_DONE);
    assert_eq!(EXERTED.get(), [0.0; 3]);
    assert!(of.end(Duration::ZERO));
}

#[test]
fn frame_wakes_the_waiter() {
    let of = callback(LONG);
    std::thread::scope(|scope| {
        let begun = Instant::now();
        let waiting = scope.spawn(|| of.wait(0, Duration::from_secs(60)));
        thread::sleep(Duration::from_millis(50));
        tick(of);
        assert_eq!(waiting.join().unwrap().map(|sample| sample.tick), Some(1));
        assert!(begun.elapsed() < Duration::from_secs(30));
    });
}
