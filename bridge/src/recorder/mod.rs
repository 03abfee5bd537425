//! Recording of a live loop to a file, on a separate thread behind a bounded ring.
//!
//! The loop never waits for the recorder. Records that a slow disk cannot take in time are dropped and counted. A disk
//! that fails or is nearly full ends only the recording. The file is MCAP with messages in JSON.

mod fields;
mod file;
mod queue;
mod read;
mod waiting;

use std::{
    io,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

pub use fields::{Field, Recorded, Value};
use file::{FreeSpace, McapFile};
pub(crate) use queue::WaitingRecords;
pub use read::{Column, ReadError, ReadRecording, Values, read_recording};
pub(crate) use waiting::WaitingRecorder;

use crate::{ladder::Diagnosis, ring::ring};

/// Mark of sealed or unsealed frames, written in every record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecurityMark {
    /// Frames are encrypted and authenticated.
    Secure,
    /// Frames are not encrypted, and their sender is not authenticated.
    Insecure,
}

impl SecurityMark {
    /// Return the name used in recordings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Secure => "secure",
            Self::Insecure => "insecure",
        }
    }
}

/// Settings of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecorderSettings {
    /// File, with access for its owner only. An existing file is replaced; a symbolic link is refused.
    pub path: PathBuf,
    /// Number of free bytes on the disk below which the recording ends; rosbag also stops at 1e9.
    pub min_free_bytes: u64,
    /// Security mark of the run.
    pub security: SecurityMark,
    /// Scene as JSON, stored in the metadata of the file next to its results. Empty for no scene.
    pub scene: String,
}

/// Reason why a recording ended before the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordingEnd {
    /// Too little space is left on the disk.
    LowSpace,
    /// The disk failed with this error number of the system.
    Refused(i32),
    /// The disk did not respond at the end of the run.
    Stuck,
}

impl std::fmt::Display for RecordingEnd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::LowSpace => f.write_str("too little space is left on the disk"),
            Self::Refused(number) => write!(f, "{}", io::Error::from_raw_os_error(*number)),
            Self::Stuck => write!(f, "the disk did not take the rest within {} s", PATIENCE.as_secs()),
        }
    }
}

/// Result of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RecordingReport {
    /// Records accepted by the system.
    pub written: u64,
    /// Records of the loop that are not in the file; during the run, waiting records are included.
    pub dropped: u64,
    /// Reason of an early end, if any.
    pub end: Option<RecordingEnd>,
}

/// Capacity for records that wait for the disk: 16 s at 1 kHz.
const RING: usize = 1 << 14;

/// Capacity for diagnoses that wait for the disk.
const NOTES: usize = 16;

/// Diagnosis of a decoupling, with its time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Note {
    /// Time since the run began.
    pub(crate) time_ns: u64,
    pub(crate) diagnosis: Diagnosis,
}

/// Longest wait for the disk at the end of a run.
const PATIENCE: Duration = Duration::from_secs(2);

/// Progress of the recorder's thread.
#[derive(Debug, Default)]
struct Progress {
    offered: AtomicU64,
    written: AtomicU64,
    end: AtomicU64,
    /// Start of the loop on its monotonic clock in ns; 0 before.
    started_ns: AtomicU64,
}

/// Flag of a disk error, above its error number.
const REFUSED: u64 = 1 << 32;
const LOW_SPACE: u64 = 1;
const STUCK: u64 = 2;

impl Progress {
    fn set_end(&self, end: RecordingEnd) {
        let code = match end {
            RecordingEnd::LowSpace => LOW_SPACE,
            RecordingEnd::Stuck => STUCK,
            RecordingEnd::Refused(number) => REFUSED | u64::from(number.unsigned_abs()),
        };
        // Only the first reason is kept.
        let _ = self.end.compare_exchange(0, code, Ordering::Relaxed, Ordering::Relaxed);
    }

    fn report(&self) -> RecordingReport {
        let written = self.written.load(Ordering::Relaxed);
        let end = match self.end.load(Ordering::Relaxed) {
            0 => None,
            LOW_SPACE => Some(RecordingEnd::LowSpace),
            STUCK => Some(RecordingEnd::Stuck),
            #[allow(clippy::cast_possible_truncation)] // composed above
            refused => Some(RecordingEnd::Refused((refused as u32).cast_signed())),
        };
        RecordingReport {
            written,
            dropped: self.offered.load(Ordering::Relaxed).saturating_sub(written),
            end,
        }
    }
}

/// View of a recording's progress for other threads.
#[derive(Clone, Debug)]
pub struct Recording(Arc<Progress>);

impl Recording {
    /// Return the present state of the recording.
    pub fn report(&self) -> RecordingReport {
        self.0.report()
    }
}

/// Producer of the ring, in the loop.
#[derive(Debug)]
pub struct Recorder<R> {
    records: rtrb::Producer<R>,
    notes: rtrb::Producer<Note>,
    progress: Arc<Progress>,
    ended: mpsc::Receiver<()>,
}

impl<R: Recorded> Recorder<R> {
    /// Open the file, write its head, and start the thread that writes the rest.
    pub fn begin(settings: &RecorderSettings) -> io::Result<Self> {
        let free = FreeSpace::beside(&settings.path)?;
        if free.bytes() < settings.min_free_bytes {
            let (free, min) = (free.bytes(), settings.min_free_bytes);
            return Err(io::Error::new(
                io::ErrorKind::StorageFull,
                format!("{free} bytes are free on the disk, must be at least {min}"),
            ));
        }
        let file = file::create(&settings.path)?;
        Self::write_to(file, move || free.bytes(), settings)
    }

    fn write_to(
        out: impl io::Write + Send + 'static,
        free_bytes: impl Fn() -> u64 + Send + 'static,
        settings: &RecorderSettings,
    ) -> io::Result<Self> {
        let (records, waiting) = ring::<R>(RING);
        let (notes, progress, ended) =
            spawn_writer(out, free_bytes, Box::new(waiting), Box::new(R::any()), settings)?;
        Ok(Self { records, notes, progress, ended })
    }
}

/// The loop's connections to the writing thread: notes, progress and end.
type Writer = (rtrb::Producer<Note>, Arc<Progress>, mpsc::Receiver<()>);

/// Start the thread that writes; compiled once for all types of records.
fn spawn_writer(
    out: impl io::Write + Send + 'static,
    free_bytes: impl Fn() -> u64 + Send + 'static,
    mut waiting: Box<dyn WaitingRecords>,
    any: Box<dyn Recorded>,
    settings: &RecorderSettings,
) -> io::Result<Writer> {
    let (notes, noted) = ring(NOTES);
    let progress = Arc::new(Progress::default());
    let (to_recorder, ended) = mpsc::sync_channel(1);
    let (seen, min_free_bytes) = (Arc::clone(&progress), settings.min_free_bytes);
    let (security, scene) = (settings.security, settings.scene.clone());
    thread::Builder::new().name("haptether-recorder".into()).spawn(move || {
        // The head is also written on the thread, so that a slow disk does not delay the run.
        let file = McapFile::begin(out, &*any, security, &scene);
        write_while_open(file, (&mut *waiting, noted), &seen, &|| free_bytes() < min_free_bytes);
        let _ = to_recorder.send(());
    })?;
    Ok((notes, progress, ended))
}

impl<R> Recorder<R> {
    /// Set time 0 of the loop on the monotonic clock, from which wall-clock log times are computed.
    pub(crate) fn start(&self, now_ns: u64) {
        self.progress.started_ns.store(now_ns, Ordering::Relaxed);
    }

    /// Pass on a record, or drop it if the ring is full; records that are not written are counted.
    pub(crate) fn take(&mut self, record: R) {
        self.progress.offered.fetch_add(1, Ordering::Relaxed);
        let _ = self.records.push(record);
    }

    /// Pass on why the sides are not coupled, `time_ns` after the run began; dropped if the ring is full.
    pub(crate) fn note(&mut self, time_ns: u64, diagnosis: &Diagnosis) {
        let _ = self.notes.push(Note { time_ns, diagnosis: *diagnosis });
    }

    /// Return a view of the recording for other threads.
    pub fn recording(&self) -> Recording {
        Recording(Arc::clone(&self.progress))
    }

    /// Wait until all records are written, at most [`PATIENCE`].
    pub(crate) fn end(self) -> RecordingReport {
        let Self { records, notes, progress, ended } = self;
        drop(records);
        await_writer(notes, &progress, &ended)
    }
}

/// Close the last ring of a writer and wait for its end; compiled once for all types of records.
fn await_writer(
    notes: rtrb::Producer<Note>,
    progress: &Progress,
    ended: &mpsc::Receiver<()>,
) -> RecordingReport {
    drop(notes);
    if ended.recv_timeout(PATIENCE).is_err() {
        progress.set_end(RecordingEnd::Stuck);
    }
    progress.report()
}

/// Pause after an empty ring: a small part of the time in which the ring fills.
const PAUSE: Duration = Duration::from_millis(20);

/// Records of a chunk of the file, after which the disk is checked. A killed run loses one chunk.
const CHUNK: u64 = 256;

/// Chunks of one size; the next ones are twice as large, up to [`MAX_CHUNK`]. The index of the file stays in memory
/// until its end, about 750 bytes a chunk: 3 MB in the first hour at 1 kHz, then 0.7 MB an hour.
const CHUNKS_OF_A_SIZE: u64 = 1024;
/// Records of the largest chunk: 4 s at 1 kHz.
const MAX_CHUNK: u64 = 4096;

/// Write records until the producer is gone and the ring is empty, or until the disk fails.
fn write_while_open(
    file: McapFile<impl io::Write>,
    (records, mut notes): (&mut dyn WaitingRecords, rtrb::Consumer<Note>),
    progress: &Progress,
    is_full: &dyn Fn() -> bool,
) {
    let mut file = Some(file);
    let (mut taken, mut chunks, mut chunk_end) = (0, 0, CHUNK);
    loop {
        // Checked first, so that records pushed before the end are still taken below.
        let is_last = records.is_abandoned();
        records.take(usize::MAX, &mut |record| {
            if let Some(open) = &mut file {
                if taken == 0 {
                    open.set_start(progress.started_ns.load(Ordering::Relaxed));
                }
                open.write(record);
                taken += 1;
                if taken == chunk_end {
                    look_at_disk(&mut file, taken, progress, is_full);
                    chunks += 1;
                    chunk_end += (CHUNK << (chunks / CHUNKS_OF_A_SIZE).min(8)).min(MAX_CHUNK);
                }
            }
        });
        while let Ok(note) = notes.pop() {
            if let Some(open) = &mut file {
                open.note(&note);
            }
        }
        if is_last {
            look_at_disk(&mut file, taken, progress, is_full);
            break;
        }
        thread::sleep(PAUSE);
    }
    if let Some(open) = file {
        match open.finish() {
            Some(number) => progress.set_end(RecordingEnd::Refused(number)),
            None => progress.written.store(taken, Ordering::Relaxed),
        }
    }
}

/// Flush the written records to the system. Closes the file if that fails or little space is left.
fn look_at_disk(
    file: &mut Option<McapFile<impl io::Write>>,
    taken: u64,
    progress: &Progress,
    is_full: &dyn Fn() -> bool,
) {
    if taken == progress.written.load(Ordering::Relaxed) {
        return;
    }
    let Some(open) = file else { return };
    if let Some(number) = open.flush() {
        progress.set_end(RecordingEnd::Refused(number));
        *file = None;
        return;
    }
    progress.written.store(taken, Ordering::Relaxed);
    if is_full() {
        progress.set_end(RecordingEnd::LowSpace);
        // Finish the file, so that it can be read; the index at its end is small.
        let _ = file.take().map(McapFile::finish);
    }
}

#[cfg(test)]
mod tests;
