//! Telemetry of a live loop: samples and events over a Unix socket, to any number of readers.
//!
//! The loop writes records to a bounded ring and never waits. A thread decimates them to frames of 1/60 s. A frame
//! has minimum, maximum and last value of each signal, so that a spike of one tick survives. It has every change of a
//! name, flag or set of bits, too. A slow reader loses samples, which are reported to it, and affects no others.
//! Lines of JSON; see docs/telemetry.md.

mod frame;
mod readers;

use std::{
    io,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU8, AtomicU16, AtomicU64, Ordering},
        mpsc,
    },
    thread,
    time::{Duration, Instant},
};

use frame::Frame;
use readers::Readers;

use crate::{
    LinkStatistics,
    ladder::Diagnosis,
    recorder::{Recorded, SecurityMark, WaitingRecords},
    ring::ring,
};

/// Settings of telemetry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TelemetrySettings {
    /// Unix socket, for the owner only. Replaces a stale socket, and refuses anything else.
    pub path: PathBuf,
    /// Security mark of the run.
    pub security: SecurityMark,
    /// Scene as JSON, sent first to each reader. Empty for none.
    pub scene: String,
}

/// Ring of records to the thread: 0.5 s at 8 kHz, 4 s at 1 kHz.
const RING: usize = 1 << 12;
/// Ring of diagnoses, and ends of them, to the thread.
const NOTES: usize = 16;
/// Period of frames.
const FRAME: Duration = Duration::from_nanos(1_000_000_000 / 60);
/// Maximum wait of the end of a run for the thread.
const PATIENCE: Duration = Duration::from_millis(500);
/// Maximum wait of the thread for readers at the end.
const LAST: Duration = Duration::from_millis(200);

/// State of the loop.
const RUNNING: u8 = 0;
const ENDED: u8 = 1;
/// It panicked, or never began.
const FAILED: u8 = 2;

/// Time after the start in ns, and reason why the sides are not coupled; `None` ends it.
type Note = (u64, Option<Diagnosis>);

/// Counts of the loop. Each is exact, but they may be from different ticks.
#[derive(Debug, Default)]
struct Counts {
    /// Records dropped because the ring was full.
    dropped: AtomicU64,
    /// From [`LinkStatistics`].
    sent: AtomicU64,
    fresh: AtomicU64,
    late: AtomicU64,
    missing: AtomicU64,
    /// Code of the coupling.
    coupling: AtomicU16,
}

impl Counts {
    fn count_link(&self, link: &LinkStatistics) {
        let counts = [
            (&self.sent, link.sent),
            (&self.fresh, link.fresh),
            (&self.late, link.late),
            (&self.missing, link.missing),
        ];
        for (count, now) in counts {
            count.store(now, Ordering::Relaxed);
        }
        self.coupling.store(link.coupling.code(), Ordering::Relaxed);
    }
}

/// The loop's end of the rings.
#[derive(Debug)]
pub struct Telemetry<R> {
    records: rtrb::Producer<R>,
    notes: rtrb::Producer<Note>,
    counts: Arc<Counts>,
    state: Arc<AtomicU8>,
    sent: mpsc::Receiver<()>,
}

impl<R: Recorded> Telemetry<R> {
    /// Listens, and starts the thread that sends.
    pub fn begin(settings: &TelemetrySettings) -> io::Result<Self> {
        let any = R::any();
        let readers =
            Readers::listen(&settings.path, frame::hello(&any, settings.security, &settings.scene))?;
        let (records, waiting) = ring::<R>(RING);
        let (notes, counts, state, sent) = spawn_sender(readers, Frame::of(&any), Box::new(waiting))?;
        Ok(Self { records, notes, counts, state, sent })
    }
}

type Sender = (rtrb::Producer<Note>, Arc<Counts>, Arc<AtomicU8>, mpsc::Receiver<()>);

/// Start the sending thread; compiled once for all record types.
fn spawn_sender(readers: Readers, frame: Frame, mut waiting: Box<dyn WaitingRecords>) -> io::Result<Sender> {
    let (notes, noted) = ring(NOTES);
    let counts = Arc::<Counts>::default();
    let state = Arc::new(AtomicU8::new(RUNNING));
    let (to_loop, sent) = mpsc::sync_channel(1);
    let seen = (Arc::clone(&counts), Arc::clone(&state));
    thread::Builder::new().name("haptether-telemetry".into()).spawn(move || {
        send_while_running(frame, readers, (&mut *waiting, noted), (&seen.0, &seen.1));
        let _ = to_loop.send(());
    })?;
    Ok((notes, counts, state, sent))
}

impl<R> Telemetry<R> {
    /// Pass a record on, or count it as dropped if the thread is behind.
    #[inline]
    pub(crate) fn take(&mut self, record: R) {
        if self.records.push(record).is_err() {
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Update the counts of the link.
    #[inline]
    pub(crate) fn count_link(&self, link: &LinkStatistics) {
        self.counts.count_link(link);
    }

    /// Passes on why the sides are not coupled, at `time_ns` after the start; `None` ends it.
    pub(crate) fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>) {
        let _ = self.notes.push((time_ns, diagnosis.copied()));
    }

    /// End telemetry in good order; a drop without it sends no end line.
    pub(crate) fn end(self) {
        self.state.store(ENDED, Ordering::Release);
    }
}

impl<R> Drop for Telemetry<R> {
    /// Waits until all is sent, but not for readers that stall.
    fn drop(&mut self) {
        await_sender(&self.state, &self.sent);
    }
}

/// Waits for the thread; compiled once for all record types.
fn await_sender(state: &AtomicU8, sent: &mpsc::Receiver<()>) {
    let _ = state.compare_exchange(RUNNING, FAILED, Ordering::Release, Ordering::Relaxed);
    let _ = sent.recv_timeout(PATIENCE);
}

/// Send a frame every 1/60 s until the loop is over and all is sent.
fn send_while_running(
    mut frame: Frame,
    mut readers: Readers,
    (records, mut notes): (&mut dyn WaitingRecords, rtrb::Consumer<Note>),
    (counts, state): (&Counts, &AtomicU8),
) {
    let mut due = Instant::now();
    loop {
        // Loaded first, so that all records pushed before the end are taken below.
        let state = state.load(Ordering::Acquire);
        readers.accept();
        // Later records wait for the next frame: a faster loop cannot hold the thread.
        records.take(records.waiting(), &mut |record| frame.take(record));
        while let Ok((time_ns, diagnosis)) = notes.pop() {
            match diagnosis {
                Some(diagnosis) => readers.cause(frame::cause(time_ns, &diagnosis)),
                None => readers.cleared(&frame::cleared(time_ns)),
            }
        }
        frame.events(|lines| readers.events(lines));
        if let Some((sample, ticks)) = frame.sample(counts) {
            readers.sample(sample, ticks);
        }
        if state != RUNNING {
            let last = if state == ENDED { frame.end_line() } else { Vec::new() };
            readers.end(&last, LAST);
            return;
        }
        readers.flush();
        due = (due + FRAME).max(Instant::now());
        thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

#[cfg(test)]
mod tests;
