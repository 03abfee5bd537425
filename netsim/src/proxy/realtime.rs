//! What the proxy's thread asks of the scheduler.

use std::fmt;
use std::num::NonZeroU64;

use rustix::thread::set_current_timer_slack;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
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
    let priority = ThreadPriorityValue::try_from(PRIORITY).map(ThreadPriority::Crossplatform);
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    match priority {
        Ok(priority)
            if realtime && set_thread_priority_and_policy(thread_native_id(), priority, fifo).is_ok() =>
        {
            Scheduling::Fifo
        }
        _ => Scheduling::Normal,
    }
}
