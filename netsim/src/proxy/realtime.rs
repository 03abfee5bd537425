//! What the proxy's thread asks of the scheduler.

use std::num::NonZeroU64;
use std::{fmt, io};

use rustix::thread::set_current_timer_slack;
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy_param,
};

/// Above ordinary real-time threads, below those of the kernel's interrupts (50).
const PRIORITY: u8 = 40;

/// How the proxy's thread is scheduled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scheduling {
    /// As any thread.
    #[default]
    Normal,
    /// `SCHED_FIFO`: before every thread that has no real-time priority.
    Fifo,
}

impl fmt::Display for Scheduling {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Normal => "normal",
            Self::Fifo => "fifo",
        })
    }
}

/// Lets timers of this thread be exact, and puts it before others if that is wanted and allowed.
pub(crate) fn prepare_thread(realtime: bool) -> Scheduling {
    // Without it a normal thread is woken up to 50 us late, to be woken together with others. A kernel that refuses
    // costs accuracy, which is measured anyway.
    let _ = set_current_timer_slack(NonZeroU64::new(1));
    if realtime && schedule_fifo(PRIORITY).is_ok() { Scheduling::Fifo } else { Scheduling::Normal }
}

/// Puts this thread under `SCHED_FIFO` with `priority`, 1 to 99, and gives the priority that the kernel then says it has.
pub fn schedule_fifo(priority: u8) -> io::Result<u8> {
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let wanted = ThreadPriorityValue::try_from(priority).map_err(io::Error::other)?;
    let thread = thread_native_id();
    set_thread_priority_and_policy(thread, ThreadPriority::Crossplatform(wanted), fifo).map_err(as_io)?;
    match thread_schedule_policy_param(thread).map_err(as_io)? {
        (policy, got) if policy == fifo => u8::try_from(got.sched_priority).map_err(io::Error::other),
        (policy, _) => Err(io::Error::other(format!("the kernel says {policy:?}"))),
    }
}

fn as_io(error: Error) -> io::Error {
    match error {
        Error::OS(number) => io::Error::from_raw_os_error(number),
        other => io::Error::other(format!("{other:?}")),
    }
}
