//! What a live loop shows of itself while it runs: samples and events over a Unix socket, to any number of readers.
//!
//! The loop hands each record to a bounded ring and never waits. A thread of its own decimates them: of each frame of
//! 1/60 s the smallest, the largest and the last value of each signal, so that a spike of one tick survives, and every
//! change of what is a name, a flag or a set of bits. A reader that is slow loses samples, which are counted to it, and
//! none of the others notices. Lines of JSON; see docs/telemetry.md.

mod frame;
mod readers;

use std::{
    io,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU8, AtomicU64, Ordering},
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
    recorder::{Recorded, SecurityMark},
    ring::{WaitingRecords, ring},
};

/// How telemetry is sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TelemetrySettings {
    /// Its Unix socket, for its owner alone. A socket that nobody listens at is replaced, anything else is refused.
    pub path: PathBuf,
    /// What the run is marked as.
    pub security: SecurityMark,
    /// The scene as JSON, which each reader gets first. Empty: none.
    pub scene: String,
}

/// Records that wait for the thread: 0.5 s at 8 kHz, 4 s at 1 kHz.
const RING: usize = 1 << 12;
/// Diagnoses, and ends of them, that wait for the thread.
const NOTES: usize = 16;
/// From one frame to the next.
const FRAME: Duration = Duration::from_nanos(1_000_000_000 / 60);
/// How long the end of a run waits for the thread.
const PATIENCE: Duration = Duration::from_millis(500);
/// How long the thread then waits for readers that have not taken all yet.
const LAST: Duration = Duration::from_millis(200);

/// How the loop stands.
const RUNNING: u8 = 0;
const ENDED: u8 = 1;
/// It panicked, or never began.
const FAILED: u8 = 2;

/// Why the two sides are not coupled, so long after the run began; none where that is over.
type Note = (u64, Option<Diagnosis>);

/// What the loop counts since its run began, as the thread reads it: each count is true, all together are not of one tick.
#[derive(Debug, Default)]
struct Counts {
    /// Records that found the ring full.
    dropped: AtomicU64,
    /// Of [`LinkStatistics`].
    sent: AtomicU64,
    fresh: AtomicU64,
    late: AtomicU64,
    missing: AtomicU64,
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
    }
}

/// The loop's end of the ring.
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

/// The loop's ends of what leads to the thread that sends.
type Sender = (rtrb::Producer<Note>, Arc<Counts>, Arc<AtomicU8>, mpsc::Receiver<()>);

/// Starts the thread that sends; compiled once for all types of records.
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
    /// Hands a record over, or drops and counts it where the thread does not keep up.
    #[inline]
    pub(crate) fn take(&mut self, record: R) {
        if self.records.push(record).is_err() {
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Takes what the link has counted.
    #[inline]
    pub(crate) fn count_link(&self, link: &LinkStatistics) {
        self.counts.count_link(link);
    }

    /// Hands over why the two sides are not coupled, `time_ns` after the run began; none where that is over.
    pub(crate) fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>) {
        let _ = self.notes.push((time_ns, diagnosis.copied()));
    }

    /// The loop has ended in good order; what is dropped without it closes its readers without that line.
    pub(crate) fn end(self) {
        self.state.store(ENDED, Ordering::Release);
    }
}

impl<R> Drop for Telemetry<R> {
    /// Waits until all was sent, but not for readers that do not take it.
    fn drop(&mut self) {
        await_sender(&self.state, &self.sent);
    }
}

/// Waits for a sender; compiled once for all types of records.
fn await_sender(state: &AtomicU8, sent: &mpsc::Receiver<()>) {
    let _ = state.compare_exchange(RUNNING, FAILED, Ordering::Release, Ordering::Relaxed);
    let _ = sent.recv_timeout(PATIENCE);
}

/// Sends a frame every 1/60 s until the loop is over and all was sent.
fn send_while_running(
    mut frame: Frame,
    mut readers: Readers,
    (records, mut notes): (&mut dyn WaitingRecords, rtrb::Consumer<Note>),
    (counts, state): (&Counts, &AtomicU8),
) {
    let mut due = Instant::now();
    loop {
        // Looked at first: what was pushed before the end is seen below.
        let state = state.load(Ordering::Acquire);
        readers.accept();
        // What comes while it is taken waits for the next frame: a loop that is faster does not hold it here.
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
