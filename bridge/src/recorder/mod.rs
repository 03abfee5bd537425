//! Records of a live loop to a file, on a thread of its own behind a bounded ring.
//!
//! The loop never waits for it. What a slow disk does not take in time is dropped and counted; a disk that refuses, or
//! that has too little space left, ends the recording and nothing else. The file is MCAP with messages in JSON.

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

/// Whether frames are sealed; a recording of an unsealed run says so in every record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecurityMark {
    /// Encrypted and authenticated.
    Secure,
    /// In the clear, from anybody.
    Insecure,
}

impl SecurityMark {
    /// As it stands in a recording.
    pub fn name(self) -> &'static str {
        match self {
            Self::Secure => "secure",
            Self::Insecure => "insecure",
        }
    }
}

/// How a recording is made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecorderSettings {
    /// Its file, for its owner alone; an existing one is replaced, and a symbolic link is refused.
    pub path: PathBuf,
    /// Ends when fewer bytes than this are free on the disk; rosbag stops at 1e9, too.
    pub min_free_bytes: u64,
    /// What the run is marked as.
    pub security: SecurityMark,
    /// The scene as JSON, kept in the file's metadata: what was set is read beside what came of it. Empty: none.
    pub scene: String,
}

/// Why a recording ended before the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordingEnd {
    /// Too little space was left on the disk.
    LowSpace,
    /// The disk refused, with the number of the system's error.
    Refused(i32),
    /// The disk did not answer at the end of the run.
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

/// What became of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RecordingReport {
    /// Records that the system took.
    pub written: u64,
    /// Records of the loop that are not in the file; while it runs, those that wait are among them.
    pub dropped: u64,
    /// Why it ended early, if it did.
    pub end: Option<RecordingEnd>,
}

/// Records that wait for the disk: 16 s at 1 kHz.
const RING: usize = 1 << 14;

/// Diagnoses that wait for the disk.
const NOTES: usize = 16;

/// Why the two sides are not coupled, since when.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Note {
    /// Since the run began.
    pub(crate) time_ns: u64,
    pub(crate) diagnosis: Diagnosis,
}

/// How long the end of a run waits for the disk.
const PATIENCE: Duration = Duration::from_secs(2);

/// How far the recorder's thread is.
#[derive(Debug, Default)]
struct Progress {
    offered: AtomicU64,
    written: AtomicU64,
    end: AtomicU64,
    /// When the loop began, on its monotonic clock in ns; 0 before.
    started_ns: AtomicU64,
}

/// A disk's refusal, above its error's number.
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
        // The first reason is the one that counts.
        let _ = self.end.compare_exchange(0, code, Ordering::Relaxed, Ordering::Relaxed);
    }

    fn report(&self) -> RecordingReport {
        let written = self.written.load(Ordering::Relaxed);
        let end = match self.end.load(Ordering::Relaxed) {
            0 => None,
            LOW_SPACE => Some(RecordingEnd::LowSpace),
            STUCK => Some(RecordingEnd::Stuck),
            #[allow(clippy::cast_possible_truncation)] // put together above
            refused => Some(RecordingEnd::Refused((refused as u32).cast_signed())),
        };
        RecordingReport {
            written,
            dropped: self.offered.load(Ordering::Relaxed).saturating_sub(written),
            end,
        }
    }
}

/// How a recording stands, for whoever looks on.
#[derive(Clone, Debug)]
pub struct Recording(Arc<Progress>);

impl Recording {
    /// As it stands now.
    pub fn report(&self) -> RecordingReport {
        self.0.report()
    }
}

/// The loop's end of the ring.
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

/// The loop's ends of what leads to the thread that writes.
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
        // The head, too, is written there: not even that may keep a run waiting.
        let file = McapFile::begin(out, &*any, security, &scene);
        write_while_open(file, (&mut *waiting, noted), &seen, &|| free_bytes() < min_free_bytes);
        let _ = to_recorder.send(());
    })?;
    Ok((notes, progress, ended))
}

impl<R> Recorder<R> {
    /// The loop's time 0, on the monotonic clock: what is recorded is put on the wall clock by it.
    pub(crate) fn start(&self, now_ns: u64) {
        self.progress.started_ns.store(now_ns, Ordering::Relaxed);
    }

    /// Hand a record over, or drop it where the disk is slow: what is not written is counted.
    pub(crate) fn take(&mut self, record: R) {
        self.progress.offered.fetch_add(1, Ordering::Relaxed);
        let _ = self.records.push(record);
    }

    /// Hands over why the two sides are not coupled, `time_ns` after the run began; dropped where the disk is slow.
    pub(crate) fn note(&mut self, time_ns: u64, diagnosis: &Diagnosis) {
        let _ = self.notes.push(Note { time_ns, diagnosis: *diagnosis });
    }

    /// Somebody else's view of it.
    pub fn recording(&self) -> Recording {
        Recording(Arc::clone(&self.progress))
    }

    /// Waits until all is written, but not for a disk that does not answer.
    pub(crate) fn end(self) -> RecordingReport {
        let Self { records, notes, progress, ended } = self;
        drop(records);
        await_writer(notes, &progress, &ended)
    }
}

/// Close the last ring of a writer and waits for it; compiled once for all types of records.
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

/// How long an empty ring is left alone: a small part of the time in which it fills.
const PAUSE: Duration = Duration::from_millis(20);

/// Records of a chunk of the file, after which the disk is looked at; a run that is killed loses one.
const CHUNK: u64 = 256;

/// Chunks of one size; those that follow are twice as large, up to [`MAX_CHUNK`]. The index of the file is kept in
/// memory until its end, some 750 bytes a chunk: 3 MB in the first hour at 1 kHz, then 0.7 MB an hour.
const CHUNKS_OF_A_SIZE: u64 = 1024;
/// Records of the largest chunk, 4 s at 1 kHz.
const MAX_CHUNK: u64 = 4096;

/// Write records until the other end of the ring is gone and all are written, or the disk has had enough.
fn write_while_open(
    file: McapFile<impl io::Write>,
    (records, mut notes): (&mut dyn WaitingRecords, rtrb::Consumer<Note>),
    progress: &Progress,
    is_full: &dyn Fn() -> bool,
) {
    let mut file = Some(file);
    let (mut taken, mut chunks, mut chunk_end) = (0, 0, CHUNK);
    loop {
        // Looked at first: what was pushed before the end is seen below.
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

/// Has what was written so far taken by the system; closes the file where that fails or little space is left.
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
        // What is there becomes a whole file: the index at its end is small.
        let _ = file.take().map(McapFile::finish);
    }
}

#[cfg(test)]
mod tests;
