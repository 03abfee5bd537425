//! Scheduling of the proxy's thread.

use std::{
    fmt, io,
    num::NonZeroU64,
    thread::{self, ThreadId},
};

use rustix::{process::getpriority_process, thread::set_current_timer_slack};
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy_param,
};

/// Above ordinary real-time threads, below the kernel's interrupt threads (50).
const PRIORITY: u8 = 40;

/// Scheduling of the proxy's thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scheduling {
    /// As any thread.
    #[default]
    Normal,
    /// `SCHED_FIFO`: before every thread without a real-time priority.
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

/// Make timers of this thread exact, and requests real-time scheduling if `realtime` is set.
pub(crate) fn prepare_thread(realtime: bool) -> Scheduling {
    // By default a normal thread wakes up to 50 us late, batched with others. A refusal costs accuracy, which
    // is measured anyway.
    let _ = set_current_timer_slack(NonZeroU64::new(1));
    if realtime && schedule_fifo(PRIORITY).is_ok() { Scheduling::Fifo } else { Scheduling::Normal }
}

/// Set `SCHED_FIFO` with `priority`, 1 to 99, for this thread; return the priority that the kernel then
/// reports.
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

/// Scheduling of a thread before a real-time request; restored on drop, if dropped on that thread.
///
/// A caller continues on the same thread after its loop, and new threads inherit the scheduling. A program
/// that computes under `SCHED_FIFO` takes a processor from all others.
#[derive(Debug)]
pub struct ScheduleBefore {
    thread: ThreadId,
    policy: ThreadSchedulePolicy,
    priority: ThreadPriority,
}

impl ScheduleBefore {
    /// For the calling thread; `None` if the system does not report it.
    pub fn of_this_thread() -> Option<Self> {
        let (policy, parameters) = thread_schedule_policy_param(thread_native_id()).ok()?;
        let priority = match policy {
            ThreadSchedulePolicy::Realtime(_) => ThreadPriority::from_posix(parameters),
            // For non-real-time policies the library maps 0 to 99 to a niceness: find the value that yields
            // the current one.
            ThreadSchedulePolicy::Normal(_) => {
                let niceness = getpriority_process(None).ok()?;
                (0..=99_u8)
                    .filter_map(|part| ThreadPriorityValue::try_from(part).ok())
                    .map(ThreadPriority::Crossplatform)
                    .find(|priority| priority.to_posix(policy).ok() == Some(niceness))?
            }
        };
        Some(Self { thread: thread::current().id(), policy, priority })
    }
}

impl Drop for ScheduleBefore {
    fn drop(&mut self) {
        if self.thread == thread::current().id() {
            // Lowering the priority is always permitted.
            let _ = set_thread_priority_and_policy(thread_native_id(), self.priority, self.policy);
        }
    }
}

fn as_io(error: Error) -> io::Error {
    match error {
        Error::OS(number) => io::Error::from_raw_os_error(number),
        other => io::Error::other(format!("{other:?}")),
    }
}

#[cfg(test)]
mod tests {
    use rustix::process::setpriority_process;

    use super::*;

    #[test]
    fn a_thread_gets_back_the_schedule_that_it_had() {
        let seen = |niceness: i32| {
            thread::spawn(move || {
                let nice = setpriority_process(None, niceness).is_ok();
                let before = ScheduleBefore::of_this_thread().unwrap();
                let granted = schedule_fifo(3).is_ok();
                drop(before);
                let (policy, parameters) = thread_schedule_policy_param(thread_native_id()).unwrap();
                let now = (policy, parameters.sched_priority, getpriority_process(None).unwrap());
                (nice && granted, now)
            })
            .join()
            .unwrap()
        };
        for niceness in [0, 1, 7, 19, -5, -20] {
            let (granted, now) = seen(niceness);
            if granted {
                let policy = ThreadSchedulePolicy::Normal(thread_priority::NormalThreadSchedulePolicy::Other);
                assert_eq!(now, (policy, 0, niceness));
            }
        }
    }

    #[test]
    fn only_the_thread_itself_is_given_it_back() {
        let before = thread::spawn(|| ScheduleBefore::of_this_thread().unwrap()).join().unwrap();
        let here = thread::spawn(move || {
            let granted = schedule_fifo(3).is_ok();
            drop(before);
            let (policy, _) = thread_schedule_policy_param(thread_native_id()).unwrap();
            (granted, matches!(policy, ThreadSchedulePolicy::Realtime(_)))
        });
        let (granted, still) = here.join().unwrap();
        assert_eq!(granted, still);
    }
}
