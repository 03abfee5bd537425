//! Reader of recordings, also of incomplete ones.

mod column;
mod row;

use std::{
    collections::BTreeMap,
    io::{self, Read},
};

pub use column::{Column, Values};
use mcap::{
    McapError, parse_record,
    records::{Record, op},
    sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions},
};
use row::{TIME, Table};

use super::file::METADATA;

/// Longest record in bytes that is read; a scene and a schema have about 10 kB.
const MAX_RECORD: usize = 1 << 24;
/// Largest number of signals of a record.
const MAX_COLUMNS: usize = 512;
/// Bytes read at once.
const PIECE: usize = 1 << 18;

/// Content of a recording.
#[derive(Debug, Default)]
pub struct ReadRecording {
    /// Metadata of the file: side, security, version, scene. Empty if the file is not from a recorder.
    pub about: BTreeMap<String, String>,
    /// Signals, all of the same length.
    pub columns: Vec<Column>,
    /// Number of ticks.
    pub ticks: usize,
    /// Start of the run in ns of the wall clock.
    pub begun_ns: i64,
    /// Reasons why the sides were not coupled, as JSON.
    pub causes: Vec<Vec<u8>>,
    /// True if the file is complete.
    pub whole: bool,
    /// Number of invalid records, of ticks or others, which were left out.
    pub invalid: usize,
    /// True if reading ended at bytes that are no record, before the end of the file.
    pub damaged: bool,
}

/// Reason why a recording could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system failed to read the file.
    #[error(transparent)]
    Refused(#[from] io::Error),
    /// The chunks are compressed; a recorder never compresses them.
    #[error(
        "its chunks are compressed ({0}), must be as they were recorded: `mcap decompress` makes them so"
    )]
    Compressed(String),
}

/// Read a recording to its end, or to the first bytes that are not a record. Invalid records are left out.
///
/// Memory use is bounded by a multiple of the bytes read.
pub fn read_recording(from: impl Read) -> Result<ReadRecording, ReadError> {
    let mut reading = Reading::default();
    let is_read = reading.read(from)?;
    let Reading { mut recording, table, .. } = reading;
    recording.whole &= is_read;
    recording.ticks = table.ticks;
    recording.columns = table.columns;
    Ok(recording)
}

#[derive(Default)]
struct Reading {
    recording: ReadRecording,
    table: Table,
    has_schema: bool,
    /// Contents of each known channel; messages of other channels are ignored.
    channels: BTreeMap<u16, Channel>,
    bytes: usize,
}

#[derive(Clone, Copy)]
enum Channel {
    Ticks,
    Causes,
}

impl Reading {
    /// Read the file; return true if its end was reached.
    fn read(&mut self, mut from: impl Read) -> Result<bool, ReadError> {
        let options = LinearReaderOptions::default().with_record_length_limit(MAX_RECORD);
        let mut reader = LinearReader::new_with_options(options);
        let mut need = 0;
        loop {
            if need > 0 {
                let read = match from.read(reader.insert(need.max(PIECE))) {
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                    read => read?,
                };
                reader.notify_read(read);
                self.bytes += read;
                need = 0;
            }
            match reader.next_event() {
                None => return Ok(true),
                Some(Ok(LinearReadEvent::ReadRequest(bytes))) => need = bytes,
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    self.recording.invalid += usize::from(!self.take(opcode, data));
                    if opcode == op::FOOTER {
                        self.recording.whole = true;
                    }
                }
                Some(Err(McapError::UnsupportedCompression(name))) if self.is_ours() => {
                    return Err(ReadError::Compressed(name.escape_default().take(20).collect()));
                }
                Some(Err(error)) => {
                    self.recording.damaged = !matches!(error, McapError::UnexpectedEof);
                    return Ok(false);
                }
            }
        }
    }

    fn is_ours(&self) -> bool {
        self.recording.about.contains_key("schema")
    }

    /// Take a record; return true unless it is invalid.
    fn take(&mut self, opcode: u8, data: &[u8]) -> bool {
        // Other records are not parsed, because some of their parsers trust the stored lengths.
        if !matches!(opcode, op::METADATA | op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return true;
        }
        match parse_record(opcode, data) {
            Ok(Record::Metadata(about)) => {
                if about.name == METADATA {
                    self.recording.about = about.metadata;
                }
                true
            }
            // The index at the end of the file repeats the schema.
            Ok(Record::Schema { header, data }) if !self.has_schema => {
                if !matches!(header.name.as_str(), "haptether.master" | "haptether.slave") {
                    return true;
                }
                let columns = columns(&data);
                self.has_schema = columns.is_some();
                self.table = Table::new(columns.unwrap_or_default());
                self.has_schema
            }
            Ok(Record::Channel(channel)) => {
                if channel.message_encoding == "json" {
                    let is_cause = channel.topic.ends_with("/cause");
                    let of = if is_cause { Channel::Causes } else { Channel::Ticks };
                    self.channels.entry(channel.id).or_insert(of);
                }
                true
            }
            Ok(Record::Message { header, data }) => match self.channels.get(&header.channel_id) {
                Some(Channel::Ticks) => self.tick(header.log_time, &data),
                Some(Channel::Causes) => {
                    self.recording.causes.push(data.into_owned());
                    true
                }
                None => true,
            },
            Ok(_) => true,
            Err(_) => false,
        }
    }

    fn tick(&mut self, log_time: u64, message: &[u8]) -> bool {
        // A recorder names every signal in each message, so a valid message has more bytes than signals.
        let has_room = (self.table.ticks + 1).saturating_mul(self.table.columns.len()) <= self.bytes;
        if !has_room || !self.table.push(message) {
            return false;
        }
        if self.table.ticks == 1 {
            let Some(column) = self.table.columns.iter().find(|column| column.name == TIME) else {
                return false;
            };
            let Values::Counts(times) = &column.values else { return false };
            let begun_ns = i128::from(log_time) - i128::from(times[0]);
            self.recording.begun_ns = i64::try_from(begun_ns).unwrap_or(i64::MAX);
        }
        true
    }
}

/// Return the signals of a schema; none if the schema is invalid.
fn columns(schema: &[u8]) -> Option<Vec<Column>> {
    let schema: serde_json::Value = serde_json::from_slice(schema).ok()?;
    let properties = schema.get("properties")?.as_object()?;
    if properties.len() > MAX_COLUMNS {
        return None;
    }
    let meaning = |field: &serde_json::Value| field.get("description")?.as_str().map(str::to_owned);
    let columns =
        properties.iter().map(|(name, field)| Column::new(name.clone(), meaning(field).unwrap_or_default()));
    Some(columns.collect())
}

#[cfg(test)]
mod tests;
