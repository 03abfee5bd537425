//! The live loop's clock and sleep.

use rustix::{
    thread::{ClockId, clock_nanosleep_absolute, set_current_timer_slack},
    time::{Timespec, clock_gettime},
};

const SECOND: u64 = 1_000_000_000;

/// Time of the system's monotonic clock in ns, which live loops go by.
pub fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    #[allow(clippy::cast_sign_loss)] // the monotonic clock starts at boot
    let (seconds, nanoseconds) = (now.tv_sec as u64, now.tv_nsec as u64);
    seconds * SECOND + nanoseconds
}

/// Least time asleep between two ticks of a loop that is behind.
const REST_NS: u64 = 50_000;

/// Sleeps until the monotonic clock shows `deadline_ns`, and for 50 us if it already does.
///
/// With real-time scheduling nobody else would run on this processor while a loop that cannot keep up never sleeps.
pub(super) fn sleep_until(deadline_ns: u64) {
    let now_ns = now_ns();
    let deadline_ns = if deadline_ns > now_ns { deadline_ns } else { now_ns + REST_NS };
    #[allow(clippy::cast_possible_wrap)] // 292 years
    let deadline = Timespec { tv_sec: (deadline_ns / SECOND) as i64, tv_nsec: (deadline_ns % SECOND) as i64 };
    // A signal ends the sleep early: sleep on.
    while clock_nanosleep_absolute(ClockId::Monotonic, &deadline) == Err(rustix::io::Errno::INTR) {}
}

/// Asks the kernel not to delay this thread's wake-ups by its usual 50 us; without the wish granted it works too.
pub(super) fn ask_for_prompt_wakeups() {
    let _ = set_current_timer_slack(std::num::NonZeroU64::new(1));
}
