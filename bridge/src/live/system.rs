//! Operating system of a live loop: clock and sleep, exhausted memory, real-time scheduling.

use std::{
    fmt,
    fs::{File, OpenOptions},
    io::{self, Write},
    ops::Range,
    os::unix::fs::FileExt,
    ptr,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, ThreadId},
};

use haptether_netsim::{ScheduleBefore, schedule_fifo};
use rustix::{
    io::Errno,
    mm::{MlockAllFlags, mlock, mlockall, munlockall},
    param::page_size,
    process::{Resource, getrlimit},
    thread::{
        ClockId, CpuSet, clock_nanosleep_absolute, sched_getaffinity, sched_setaffinity,
        set_current_timer_slack,
    },
    time::{Timespec, clock_gettime},
};

const SECOND: u64 = 1_000_000_000;

/// Time of the system's monotonic clock in ns, used by live loops.
pub fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    #[allow(clippy::cast_sign_loss)] // the monotonic clock starts at boot
    let (seconds, nanoseconds) = (now.tv_sec as u64, now.tv_nsec as u64);
    seconds * SECOND + nanoseconds
}

/// Shortest sleep in ns between two ticks of a late loop.
const MIN_SLEEP_NS: u64 = 50_000;

/// Sleeps until the monotonic clock shows `deadline_ns`; for 50 us if it is past.
///
/// Under real-time scheduling a loop that never sleeps would starve all else on this processor.
pub(super) fn sleep_until(deadline_ns: u64) {
    let now_ns = now_ns();
    let deadline_ns = if deadline_ns > now_ns { deadline_ns } else { now_ns + MIN_SLEEP_NS };
    #[allow(clippy::cast_possible_wrap)] // 292 years
    let deadline = Timespec { tv_sec: (deadline_ns / SECOND) as i64, tv_nsec: (deadline_ns % SECOND) as i64 };
    // A signal ends the sleep early: sleep on.
    while clock_nanosleep_absolute(ClockId::Monotonic, &deadline) == Err(rustix::io::Errno::INTR) {}
}

/// Requests wake-ups without the kernel's default slack of 50 us. Optional.
fn request_prompt_wakeups() {
    let _ = set_current_timer_slack(std::num::NonZeroU64::new(1));
}

/// Per process, as memory is shared.
static EXHAUSTED: AtomicBool = AtomicBool::new(false);

/// End each loop of this process at its next tick: no force, no motion, peer notified.
pub fn end_for_lack_of_memory() {
    EXHAUSTED.store(true, Ordering::Relaxed);
}

/// Clear the flag, for later loops.
pub fn memory_is_back() {
    EXHAUSTED.store(false, Ordering::Relaxed);
}

/// Return whether memory is exhausted.
pub fn is_exhausted() -> bool {
    EXHAUSTED.load(Ordering::Relaxed)
}

/// How strictly to request real-time scheduling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RealtimeDemand {
    /// Request nothing.
    Off,
    /// Request, and go on with the grants.
    #[default]
    Auto,
    /// Request, and do not start with less.
    Require,
}

/// Requests to the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RealtimeSettings {
    /// How strictly to request.
    pub demand: RealtimeDemand,
    /// Priority under `SCHED_FIFO`, 1 to 99. The default exceeds those of interrupt threads (50) and netsim (40).
    pub priority: u8,
    /// Processor to pin the loop to, or `None`.
    pub cpu: Option<u16>,
}

impl Default for RealtimeSettings {
    fn default() -> Self {
        Self { demand: RealtimeDemand::Auto, priority: 80, cpu: None }
    }
}

/// Result of one request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Granted<T> {
    /// Not requested.
    #[default]
    NotRequested,
    /// Granted, as read back from the kernel.
    Yes(T),
    /// Refused, with the kernel's error number; 0 for a false success.
    Refused(i32),
}

impl<T> Granted<T> {
    fn from_result(result: io::Result<T>) -> Self {
        Self::from_errno(result.map_err(|error| error.raw_os_error()))
    }

    fn from_errno(result: Result<T, Option<i32>>) -> Self {
        match result {
            Ok(got) => Self::Yes(got),
            Err(number) => Self::Refused(number.unwrap_or(0)),
        }
    }

    fn is_refused(&self) -> bool {
        matches!(self, Self::Refused(_))
    }
}

/// Grants to the loop's thread, as read back from the kernel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RealtimeReport {
    /// Priority under `SCHED_FIFO`.
    pub fifo: Granted<u8>,
    /// Bytes of the process that cannot be paged out.
    pub locked: Granted<u64>,
    /// Processor that the loop is pinned to.
    pub cpu: Granted<u16>,
    /// No deep sleep of processors, which delays wake-ups. Root only, of little effect, and never required.
    pub wakeful: Granted<()>,
}

impl RealtimeReport {
    /// Return whether all requests were granted, except deep sleep.
    pub fn is_complete(&self) -> bool {
        !(self.fifo.is_refused() || self.locked.is_refused() || self.cpu.is_refused())
    }

    /// Fail if full grants are required and missing.
    pub(super) fn check(&self, demand: RealtimeDemand) -> io::Result<()> {
        if demand == RealtimeDemand::Require && !self.is_complete() {
            let text = format!("real time is required: {self}");
            return Err(io::Error::new(io::ErrorKind::PermissionDenied, text));
        }
        Ok(())
    }

    /// Refused requests, each with the right that it needs.
    fn refusals(&self) -> Vec<String> {
        let mut refusals = Vec::new();
        let mut add = |what: &str, number: i32, needs: &str| {
            // A number unknown to the kernel is no `Errno` either.
            let rights = [Errno::PERM, Errno::NOMEM, Errno::AGAIN].map(Errno::raw_os_error);
            refusals.push(match number {
                0 => format!("{what} was granted and not given"),
                _ if rights.contains(&number) => format!("{what} needs {needs}"),
                _ => format!("{what}: {}", io::Error::from_raw_os_error(number)),
            });
        };
        if let Granted::Refused(number) = self.fifo {
            add("SCHED_FIFO", number, "CAP_SYS_NICE or a larger RLIMIT_RTPRIO");
        }
        if let Granted::Refused(number) = self.locked {
            add("locked memory", number, "CAP_IPC_LOCK or a larger RLIMIT_MEMLOCK");
        }
        if let Granted::Refused(number) = self.cpu {
            add("the processor", number, "a processor that this process may use");
        }
        refusals
    }
}

impl fmt::Display for RealtimeReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == Self::default() {
            return f.write_str("off: ordinary scheduling");
        }
        let refusals = self.refusals();
        let mut parts = vec![match self.fifo {
            Granted::Yes(priority) => format!("SCHED_FIFO {priority}"),
            _ => "ordinary scheduling".to_owned(),
        }];
        if let Granted::Yes(bytes) = self.locked {
            parts.push(format!("memory locked ({} MiB)", bytes >> 20));
        }
        if let Granted::Yes(cpu) = self.cpu {
            parts.push(format!("processor {cpu}"));
        }
        if self.wakeful == Granted::Yes(()) {
            parts.push("no deep sleep of processors".to_owned());
        }
        if !refusals.is_empty() {
            write!(f, "refused ({}): ", refusals.join("; "))?;
        }
        f.write_str(&parts.join(", "))
    }
}

/// Make all requests for this thread, granted as long as [`RealtimeGrants`] lives.
pub(super) fn prepare(settings: RealtimeSettings, later: LaterMemory) -> (RealtimeReport, RealtimeGrants) {
    request_prompt_wakeups();
    if settings.demand == RealtimeDemand::Off {
        return (RealtimeReport::default(), RealtimeGrants::default());
    }
    let schedule = ScheduleBefore::of_this_thread();
    let processors = settings.cpu.and_then(|_| ProcessorsBefore::of_this_thread());
    let memory = LockedMemory::new(later);
    let awake = keep_awake();
    let report = RealtimeReport {
        locked: Granted::from_errno(
            memory.as_ref().map(|memory| memory.bytes).map_err(io::Error::raw_os_error),
        ),
        cpu: settings.cpu.map_or(Granted::NotRequested, |cpu| Granted::from_result(stay_on(cpu))),
        fifo: Granted::from_result(schedule_fifo(settings.priority)),
        wakeful: Granted::from_errno(awake.as_ref().map(|_| ()).map_err(io::Error::raw_os_error)),
    };
    if memory.is_err() {
        touch_stack(32);
    }
    (report, RealtimeGrants { memory: memory.ok(), awake: awake.ok(), schedule, processors })
}

/// Grants, released when dropped.
#[derive(Debug, Default)]
#[allow(dead_code)] // held, not read
pub(super) struct RealtimeGrants {
    memory: Option<LockedMemory>,
    awake: Option<File>,
    /// Restored at the end, since the thread may serve others.
    schedule: Option<ScheduleBefore>,
    processors: Option<ProcessorsBefore>,
}

/// Processors allowed before the loop; restored if dropped on that thread.
#[derive(Debug)]
struct ProcessorsBefore {
    thread: ThreadId,
    processors: CpuSet,
}

impl ProcessorsBefore {
    fn of_this_thread() -> Option<Self> {
        Some(Self { thread: thread::current().id(), processors: sched_getaffinity(None).ok()? })
    }
}

impl Drop for ProcessorsBefore {
    fn drop(&mut self) {
        if self.thread == thread::current().id() {
            let _ = sched_setaffinity(None, &self.processors);
        }
    }
}

/// Keep processors out of deep sleep while the file is open, as cyclictest does.
fn keep_awake() -> io::Result<File> {
    let mut latency = OpenOptions::new().write(true).open("/dev/cpu_dma_latency")?;
    latency.write_all(&0_i32.to_ne_bytes())?;
    Ok(latency)
}

/// Pin this thread to one processor.
fn stay_on(cpu: u16) -> io::Result<u16> {
    if usize::from(cpu) >= CpuSet::MAX_CPU {
        return Err(Errno::INVAL.into());
    }
    let mut only = CpuSet::new();
    only.set(usize::from(cpu));
    sched_setaffinity(None, &only)?;
    if sched_getaffinity(None)? == only { Ok(cpu) } else { Err(io::Error::other("another set")) }
}

/// Touches the stack pages of a tick beforehand, if they cannot be locked.
#[inline(never)]
fn touch_stack(pages: u32) -> u8 {
    let page = std::hint::black_box([0_u8; 4096]);
    let below = if pages == 0 { 0 } else { touch_stack(pages - 1) };
    std::hint::black_box(page[0]) | below
}

/// Number of loops with locked memory: the kernel locks whole processes, not threads.
static LOCKING: Mutex<usize> = Mutex::new(0);

/// Memory mapped after a loop has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LaterMemory {
    /// Pageable: the loop's thread maps none.
    Free,
    /// Locked on use: a driver in Python allocates during a tick.
    Locked,
}

/// Keeps the memory in use in RAM.
#[derive(Debug)]
pub(super) struct LockedMemory {
    /// As the kernel reports.
    bytes: u64,
}

impl LockedMemory {
    fn new(later: LaterMemory) -> io::Result<Self> {
        let mut locking = LOCKING.lock().unwrap_or_else(PoisonError::into_inner);
        // Beyond a limit the kernel refuses later memory, which would end the process.
        let is_bounded = getrlimit(Resource::Memlock).current.is_some() && !may_lock_all();
        let mut locked = lock_used(is_bounded);
        if locked.is_ok() && !is_bounded && later == LaterMemory::Locked {
            locked = mlockall(MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT).map_err(io::Error::from);
        }
        if let Err(error) = locked {
            if *locking == 0 {
                let _ = munlockall();
            }
            return Err(error);
        }
        *locking += 1;
        Ok(Self { bytes: locked_bytes().unwrap_or(0) })
    }
}

/// Bytes of stack to lock above and below this frame.
const STACK: usize = 256 << 10;

/// Longest unused stretch between used pages that is locked with them. `malloc` writes around a block, and a tick may
/// write in between first. The end-of-run reserve is in larger blocks.
const GAP: usize = 64 << 10;

/// Name prefixes of libraries that a tick calls.
const CALLED: [&str; 4] = ["libc.", "libc-", "libm.", "libm-"];

/// Lock each used page, all of this library and those it calls, and the stack around this frame.
///
/// `mlockall` fills whole mappings instead: 8 MiB per stack, 32 MiB per thread of `OpenBLAS`, 64 MiB per arena of
/// `malloc` in the kernel's count, and all libraries.
#[allow(unsafe_code)] // locks pages, and neither reads nor writes them
fn lock_used(is_bounded: bool) -> io::Result<()> {
    let maps = std::fs::read("/proc/self/maps")?;
    let maps = String::from_utf8_lossy(&maps);
    let mappings: Vec<_> = maps.lines().filter_map(Mapping::of_line).collect();
    let (code, frame) = (lock_used as *const () as usize, (&raw const maps).addr());
    let library = mappings.iter().find(|mapping| mapping.addresses.contains(&code)).map(|found| found.file);
    let page = page_size();
    // A process that may not be dumped can read pagemap only as root: lock everything.
    let Ok(pagemap) = File::open("/proc/self/pagemap") else {
        return mlockall(MlockAllFlags::CURRENT).map_err(io::Error::from);
    };
    // Without a limit the kernel refuses only pages unmapped meanwhile by another thread.
    let mut entries = Vec::new();
    for Mapping { addresses, file, name } in &mappings {
        // 8 bytes a page. The highest two bits: in memory, paged out.
        entries.resize(addresses.len() / page, [0_u8; 8]);
        let offset = (addresses.start / page * 8) as u64;
        if pagemap.read_exact_at(entries.as_flattened_mut(), offset).is_err() {
            // A kernel mapping, beyond those of the process.
            continue;
        }
        let is_library = library == Some(*file) || CALLED.iter().any(|called| name.starts_with(called));
        let gap = if *file == ["00:00", "0"] { GAP / page } else { 0 };
        let is_locked = |number: usize| {
            is_library
                || entries[number][7] >> 6 != 0
                || (addresses.start + number * page).abs_diff(frame) < STACK
        };
        for pages in runs(entries.len(), gap, is_locked) {
            let address = ptr::without_provenance_mut(addresses.start + pages.start * page);
            // SAFETY: the kernel refuses unmapped pages.
            let locked = unsafe { mlock(address, pages.len() * page) };
            if is_bounded {
                locked?;
            }
        }
    }
    Ok(())
}

/// A readable mapping.
struct Mapping<'a> {
    addresses: Range<usize>,
    /// Device and inode; zeros without a file.
    file: [&'a str; 2],
    name: &'a str,
}

impl<'a> Mapping<'a> {
    /// Parse a line of `/proc/self/maps`; `None` if not readable.
    fn of_line(line: &'a str) -> Option<Self> {
        let mut fields = line.split_ascii_whitespace();
        let (start, end) = fields.next()?.split_once('-')?;
        let [start, end] = [start, end].map(|address| usize::from_str_radix(address, 16).ok());
        let is_readable = fields.next()?.starts_with('r');
        let file = [fields.nth(1)?, fields.next()?];
        let name = line.rsplit('/').next()?;
        is_readable.then_some(Self { addresses: start?..end?, file, name })
    }
}

/// Ranges below `count` where `within` holds, bridging gaps of up to `gap`.
fn runs(count: usize, gap: usize, within: impl Fn(usize) -> bool) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for number in (0..count).filter(|number| within(*number)) {
        match runs.last_mut() {
            Some(last) if number - last.end <= gap => last.end = number + 1,
            _ => runs.push(number..number + 1),
        }
    }
    runs
}

impl Drop for LockedMemory {
    fn drop(&mut self) {
        let mut locking = LOCKING.lock().unwrap_or_else(PoisonError::into_inner);
        *locking -= 1;
        if *locking == 0 {
            let _ = munlockall();
        }
    }
}

/// Return whether this thread has `CAP_IPC_LOCK` (bit 14, effective), and so no limit.
fn may_lock_all() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    effective
        .and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok())
        .is_some_and(|bits| bits >> 14 & 1 == 1)
}

/// `VmLck` of this process.
fn locked_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:"))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn report_names_grants_and_refusals() {
        let (not_requested, perm) = (Granted::NotRequested, Errno::PERM.raw_os_error());
        for (fifo, locked, cpu, said) in [
            (not_requested, Granted::NotRequested, Granted::NotRequested, "off: ordinary scheduling"),
            (
                Granted::Yes(80),
                Granted::Yes(12 << 20),
                Granted::NotRequested,
                "SCHED_FIFO 80, memory locked (12 MiB)",
            ),
            (
                Granted::Yes(80),
                Granted::Yes(12 << 20),
                Granted::Yes(1),
                "SCHED_FIFO 80, memory locked (12 MiB), processor 1",
            ),
            (
                Granted::Refused(perm),
                Granted::Yes(1 << 20),
                Granted::NotRequested,
                "refused (SCHED_FIFO needs CAP_SYS_NICE or a larger RLIMIT_RTPRIO): ordinary scheduling, memory \
                 locked (1 MiB)",
            ),
            (
                Granted::Refused(0),
                Granted::Yes(1 << 20),
                Granted::NotRequested,
                "refused (SCHED_FIFO was granted and not given): ordinary scheduling, memory locked (1 MiB)",
            ),
        ] {
            let report = RealtimeReport { fifo, locked, cpu, wakeful: Granted::NotRequested };
            assert_eq!(report.to_string(), said);
            assert_eq!(report.is_complete(), !said.contains("refused"));
        }
    }

    #[test]
    fn missing_processor_is_refused_alone() {
        for cpu in [u16::MAX, 1023] {
            let settings = RealtimeSettings { cpu: Some(cpu), ..RealtimeSettings::default() };
            let (report, _kept) =
                std::thread::spawn(move || prepare(settings, LaterMemory::Free)).join().unwrap();
            assert!(report.cpu.is_refused());
            assert!(!report.is_complete());
        }
    }

    #[test]
    fn report_equals_kernel_state() {
        let settings = RealtimeSettings { priority: 3, ..RealtimeSettings::default() };
        let (report, grants) =
            std::thread::spawn(move || prepare(settings, LaterMemory::Free)).join().unwrap();
        // The grant depends on the machine; the report must be true.
        match report.fifo {
            Granted::Yes(priority) => assert_eq!(priority, 3),
            Granted::Refused(number) => assert_ne!(number, 0),
            Granted::NotRequested => panic!("it was requested"),
        }
        match (report.locked, &grants.memory) {
            (Granted::Yes(bytes), Some(_)) => assert!(bytes > 0 && locked_bytes() >= Some(1)),
            (Granted::Refused(number), None) => assert_ne!(number, 0),
            other => panic!("{other:?}"),
        }
        assert_eq!(report.wakeful == Granted::Yes(()), grants.awake.is_some());
        drop(grants);
    }

    #[test]
    fn runs_are_maximal() {
        for (used, gap, expected) in [
            ("", 1, vec![]),
            ("...", 3, vec![]),
            ("#..", 2, vec![(0, 1)]),
            ("..#", 2, vec![(2, 3)]),
            ("###", 0, vec![(0, 3)]),
            ("#.##..#", 0, vec![(0, 1), (2, 4), (6, 7)]),
            ("#.##..#", 1, vec![(0, 4), (6, 7)]),
            ("#.##..#", 2, vec![(0, 7)]),
        ] {
            let found = runs(used.len(), gap, |number| used.as_bytes()[number] == b'#');
            let found: Vec<_> = found.into_iter().map(|run| (run.start, run.end)).collect();
            assert_eq!(found, expected, "{used} {gap}");
        }
    }

    #[test]
    fn used_memory_is_locked() {
        const UNUSED: usize = 4 << 30;
        const USED: usize = 8 << 20;
        let (unused, used) = (Vec::<u8>::with_capacity(UNUSED), vec![1_u8; USED]);
        let Ok(memory) = LockedMemory::new(LaterMemory::Free) else { return };
        assert!((USED as u64..UNUSED as u64).contains(&memory.bytes), "{}", memory.bytes);
        drop((memory, unused, used));
    }

    #[test]
    fn demand_off_requests_nothing() {
        let settings = RealtimeSettings { demand: RealtimeDemand::Off, ..RealtimeSettings::default() };
        let (report, grants) =
            std::thread::spawn(move || prepare(settings, LaterMemory::Free)).join().unwrap();
        assert_eq!(report, RealtimeReport::default());
        assert!(grants.memory.is_none() && grants.awake.is_none());
    }
}
