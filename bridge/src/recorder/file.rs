//! File of a recording: MCAP with JSON messages, on a disk that may fail or be full.

use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions, Permissions},
    io::{self, Write},
    os::unix::fs::{OpenOptionsExt, PermissionsExt},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicI32, Ordering},
    },
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use mcap::{WriteOptions, Writer, records::MessageHeader, records::Metadata, write::NoSeek};
use rustix::{
    fs::{OFlags, fcntl_getfl, fcntl_setfl, fstatvfs},
    io::Errno,
};

use super::{
    Note, Recorded, SecurityMark,
    fields::{schema, write_json},
};
use crate::{ladder::Explanation, live::now_ns};

/// Name of the metadata that describe the file.
pub(super) const METADATA: &str = "haptether";

/// Schema of the channel with the reasons why the sides were not coupled.
const CAUSE_SCHEMA: &str = r#"{"title": "haptether.cause", "type": "object", "properties": {
"time_ns": {"type": "integer", "description": "time since the run began, in ns"},
"state": {"type": "string", "description": "state of the ladder"},
"at": {"type": "string", "description": "where it happened: master, slave or link"},
"text": {"type": "string", "description": "what happened, in the driver's own words where there are any"},
"steps": {"type": "array", "description": "what to do, in this order", "items": {"type": "object", "properties": {
"at": {"type": "string"}, "remedy": {"type": "string"}, "text": {"type": "string"}}}}}}"#;

#[derive(serde::Serialize)]
struct Cause {
    time_ns: u64,
    #[serde(flatten)]
    explanation: Explanation,
}

/// MCAP file while it is written.
pub(super) struct McapFile<W: Write> {
    writer: Option<Writer<NoSeek<Sink<W>>>>,
    refusal: Refusal,
    channel: u16,
    causes: u16,
    notes: u32,
    security: SecurityMark,
    /// Wall-clock time in ns at which the run began, for the log times; before `set_start`, that of the file.
    begun_ns: u64,
    sequence: u32,
    message: Vec<u8>,
}

impl<W: Write> McapFile<W> {
    /// Write the head: metadata, schema of the messages, and channels.
    pub(super) fn begin(out: W, any: &dyn Recorded, security: SecurityMark, scene: &str) -> Self {
        let (sink, refusal) = Sink::new(out);
        let mut file = Self {
            writer: None,
            refusal,
            channel: 0,
            causes: 0,
            notes: 0,
            security,
            begun_ns: wall_clock_ns(),
            sequence: 0,
            message: Vec::with_capacity(2048),
        };
        file.writer = WriteOptions::new()
            .profile("haptether")
            .library(concat!("haptether ", env!("CARGO_PKG_VERSION")))
            // A chunk is ended by `flush` and written as a whole, because a pipe cannot seek.
            .chunk_size(None)
            .disable_seeking(true)
            .create(NoSeek::new(sink))
            .ok();
        if let Some(writer) = &mut file.writer {
            let metadata = BTreeMap::from([
                ("schema".to_owned(), "1".to_owned()),
                ("side".to_owned(), any.side().to_owned()),
                ("security".to_owned(), security.name().to_owned()),
            ]);
            let mut about = metadata.clone();
            about.insert("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned());
            if !scene.is_empty() {
                about.insert("scene".to_owned(), scene.to_owned());
            }
            let _ = writer.write_metadata(&Metadata { name: METADATA.to_owned(), metadata: about });
            let name = format!("haptether.{}", any.side());
            file.channel = writer
                .add_schema(&name, "jsonschema", schema(any).as_bytes())
                .and_then(|id| writer.add_channel(id, &format!("/{}", any.side()), "json", &metadata))
                .unwrap_or(0);
            file.causes = writer
                .add_schema("haptether.cause", "jsonschema", CAUSE_SCHEMA.as_bytes())
                .and_then(|id| writer.add_channel(id, &format!("/{}/cause", any.side()), "json", &metadata))
                .unwrap_or(0);
        }
        file
    }

    /// Use the times of the run as log times, because a run in virtual time has no wall clock.
    pub(super) fn begin_at_zero(&mut self) {
        self.begun_ns = 0;
    }

    /// Set the start of the run for the log times, in ns of the monotonic clock; 0 means unknown.
    pub(super) fn set_start(&mut self, started_ns: u64) {
        if started_ns != 0 {
            self.begun_ns = wall_clock_ns().saturating_sub(now_ns().saturating_sub(started_ns));
        }
    }

    /// Add a record to the chunk.
    pub(super) fn write(&mut self, record: &dyn Recorded) {
        let Some(writer) = &mut self.writer else { return };
        self.message.clear();
        write_json(record, self.security, &mut self.message);
        let log_time = self.begun_ns.saturating_add(record.time_ns());
        let header = MessageHeader {
            channel_id: self.channel,
            sequence: self.sequence,
            log_time,
            publish_time: log_time,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let _ = writer.write_to_known_channel(&header, &self.message);
    }

    /// Add a diagnosis of a decoupling to the chunk.
    pub(super) fn note(&mut self, note: &Note) {
        let Some(writer) = &mut self.writer else { return };
        let cause = Cause { time_ns: note.time_ns, explanation: note.diagnosis.explain() };
        self.message.clear();
        // A write to a vector never fails, and JSON can represent all these values.
        let _ = serde_json::to_writer(&mut self.message, &cause);
        let log_time = self.begun_ns.saturating_add(note.time_ns);
        let header =
            MessageHeader { channel_id: self.causes, sequence: self.notes, log_time, publish_time: log_time };
        self.notes = self.notes.wrapping_add(1);
        let _ = writer.write_to_known_channel(&header, &self.message);
    }

    /// End the chunk and pass it to the system; return the error number of a failure.
    pub(super) fn flush(&mut self) -> Option<i32> {
        let is_done = self.writer.as_mut().is_some_and(|writer| writer.flush().is_ok());
        self.outcome(is_done)
    }

    /// Write the index and the end; return the error number of a failure.
    pub(super) fn finish(mut self) -> Option<i32> {
        let is_done = self.writer.as_mut().is_some_and(|writer| writer.finish().is_ok());
        self.outcome(is_done)
    }

    fn outcome(&self, is_done: bool) -> Option<i32> {
        let unknown = (!is_done).then_some(Errno::IO.raw_os_error());
        self.refusal.number().or(unknown)
    }
}

fn wall_clock_ns() -> u64 {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    u64::try_from(since_epoch.as_nanos()).unwrap_or(0)
}

/// Free space of the disk of a file.
#[derive(Debug)]
pub(super) struct FreeSpace(File);

impl FreeSpace {
    /// Open the disk of the file at `path`, which need not exist.
    pub(super) fn beside(path: &Path) -> io::Result<Self> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        Ok(Self(File::open(folder.unwrap_or(Path::new(".")))?))
    }

    /// Return the bytes that an ordinary user may still write; `u64::MAX` if the disk does not report them.
    pub(super) fn bytes(&self) -> u64 {
        fstatvfs(&self.0).map_or(u64::MAX, |disk| disk.f_bavail.saturating_mul(disk.f_frsize))
    }
}

/// Open an empty file with access for its owner only.
///
/// A symbolic link is refused, because in a folder that others can write to it could redirect the output. A pipe
/// without a reader is refused, because waiting for one would block signals.
pub(super) fn create(path: &Path) -> io::Result<File> {
    let flags = i32::try_from((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits()).unwrap_or(0);
    let mut options = OpenOptions::new();
    let opened = options.write(true).create(true).truncate(true).mode(0o600).custom_flags(flags).open(path);
    let file = opened.map_err(|error| match error.raw_os_error().map(Errno::from_raw_os_error) {
        Some(Errno::LOOP) => io::Error::new(
            io::ErrorKind::InvalidInput,
            "is a symbolic link, must be a file: a recording follows none",
        ),
        Some(Errno::NXIO) => io::Error::new(
            io::ErrorKind::InvalidInput,
            "is a pipe or device that nobody reads: start its reader first",
        ),
        _ => error,
    })?;
    // After opening, writes may block, because they run on a separate thread.
    fcntl_setfl(&file, fcntl_getfl(&file)? - OFlags::NONBLOCK)?;
    // An existing file keeps its permissions, so they are set here; those of a pipe or device are not changed.
    if file.metadata()?.is_file() {
        file.set_permissions(Permissions::from_mode(0o600))?;
    }
    Ok(file)
}

/// Writer that ignores all output after its first error, and keeps the error.
///
/// The MCAP writer also writes when it is dropped; after a disk error that must have no effect.
#[derive(Debug)]
pub(super) struct Sink<W> {
    out: W,
    refusal: Refusal,
}

/// Error number of the first failure of a sink, if any.
#[derive(Clone, Debug, Default)]
pub(super) struct Refusal(Arc<AtomicI32>);

impl Refusal {
    pub(super) fn number(&self) -> Option<i32> {
        let number = self.0.load(Ordering::Relaxed);
        (number != 0).then_some(number)
    }
}

impl<W: Write> Sink<W> {
    pub(super) fn new(out: W) -> (Self, Refusal) {
        let refusal = Refusal::default();
        (Self { out, refusal: refusal.clone() }, refusal)
    }

    fn try_to<T>(&mut self, instead: T, write: impl FnOnce(&mut W) -> io::Result<T>) -> io::Result<T> {
        if self.refusal.number().is_some() {
            return Ok(instead);
        }
        match write(&mut self.out) {
            Err(error) if error.kind() != io::ErrorKind::Interrupted => {
                let number = error.raw_os_error().unwrap_or(Errno::IO.raw_os_error());
                self.refusal.0.store(number, Ordering::Relaxed);
                Ok(instead)
            }
            result => result,
        }
    }
}

impl<W: Write> Write for Sink<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.try_to(bytes.len(), |out| match out.write(bytes)? {
            0 if !bytes.is_empty() => Err(Errno::NOSPC.into()),
            taken => Ok(taken),
        })
    }

    fn flush(&mut self) -> io::Result<()> {
        self.try_to((), Write::flush)
    }
}
