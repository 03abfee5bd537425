//! The file of a recording: MCAP with JSON messages, on a disk that may refuse or be full.

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

/// Name of the metadata that say what the file is.
pub(super) const METADATA: &str = "haptether";

/// Of the channel that says why the two sides were not coupled.
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

/// A file that is being written.
pub(super) struct McapFile<W: Write> {
    writer: Option<Writer<NoSeek<Sink<W>>>>,
    refusal: Refusal,
    channel: u16,
    causes: u16,
    notes: u32,
    security: SecurityMark,
    /// Wall-clock time in ns at which the run began, for the log times; until that is known, the file.
    begun_ns: u64,
    sequence: u32,
    message: Vec<u8>,
}

impl<W: Write> McapFile<W> {
    /// Write the head: what the file is, the schema of its messages, their channel.
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
            // Chunks are ended by `flush`, and written in one go: a pipe cannot seek.
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

    /// The log times are those of the run itself: a run in virtual time has no wall clock.
    pub(super) fn begin_at_zero(&mut self) {
        self.begun_ns = 0;
    }

    /// Take the start of the run, in ns of the monotonic clock, for the log times; 0 is none.
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

    /// Add why the two sides are not coupled to the chunk.
    pub(super) fn note(&mut self, note: &Note) {
        let Some(writer) = &mut self.writer else { return };
        let cause = Cause { time_ns: note.time_ns, explanation: note.diagnosis.explain() };
        self.message.clear();
        // A vector takes all that is written, and JSON has all these values.
        let _ = serde_json::to_writer(&mut self.message, &cause);
        let log_time = self.begun_ns.saturating_add(note.time_ns);
        let header =
            MessageHeader { channel_id: self.causes, sequence: self.notes, log_time, publish_time: log_time };
        self.notes = self.notes.wrapping_add(1);
        let _ = writer.write_to_known_channel(&header, &self.message);
    }

    /// End the chunk and hand it to the system; return the number of the error if it was refused.
    pub(super) fn flush(&mut self) -> Option<i32> {
        let is_done = self.writer.as_mut().is_some_and(|writer| writer.flush().is_ok());
        self.outcome(is_done)
    }

    /// Write the index and the end; return the number of the error if that was refused.
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

/// The disk that a file lies on.
#[derive(Debug)]
pub(super) struct FreeSpace(File);

impl FreeSpace {
    /// Of the disk that a file at `path` lies on, whether it is there or not.
    pub(super) fn beside(path: &Path) -> io::Result<Self> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        Ok(Self(File::open(folder.unwrap_or(Path::new(".")))?))
    }

    /// Bytes that an ordinary user may still write; of a disk that does not say, all there are.
    pub(super) fn bytes(&self) -> u64 {
        fstatvfs(&self.0).map_or(u64::MAX, |disk| disk.f_bavail.saturating_mul(disk.f_frsize))
    }
}

/// Open a file for its owner alone, from its begin.
///
/// A link is not followed: in a folder that others may write to, it would have this process write where they say. A pipe
/// needs its reader: to wait for one would hold up every signal.
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
    // Once the file is open, writes may block: they have a thread of their own.
    fcntl_setfl(&file, fcntl_getfl(&file)? - OFlags::NONBLOCK)?;
    // One that was there has the rights that it had; a pipe or a device is somebody else's.
    if file.metadata()?.is_file() {
        file.set_permissions(Permissions::from_mode(0o600))?;
    }
    Ok(file)
}

/// A sink whose first error ends it: what comes after is thrown away, and the error is kept.
///
/// MCAP's writer goes on writing when it is dropped; on a disk that refuses, that must do nothing.
#[derive(Debug)]
pub(super) struct Sink<W> {
    out: W,
    refusal: Refusal,
}

/// The number of a sink's first error, once there was one.
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
