//! A recording read back, as far as it goes.

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

/// The longest record that is read; a scene and a schema have some 10 kB.
const MAX_RECORD: usize = 1 << 24;
/// The most signals of a record.
const MAX_COLUMNS: usize = 512;
/// Bytes read at once.
const PIECE: usize = 1 << 18;

/// What was read of a recording.
#[derive(Debug, Default)]
pub struct ReadRecording {
    /// What the file says of itself: side, security, version, scene. Empty of a file that is none of ours.
    pub about: BTreeMap<String, String>,
    /// Its signals, of one length.
    pub columns: Vec<Column>,
    /// How many ticks there are.
    pub ticks: usize,
    /// When the run began, in ns of the wall clock.
    pub begun_ns: i64,
    /// Why the two sides were not coupled, as JSON.
    pub causes: Vec<Vec<u8>>,
    /// Whether the file has its end.
    pub whole: bool,
    /// Records, of ticks or others, that are not valid and were left out.
    pub invalid: usize,
    /// True if reading ended at bytes that are no record, before the end of the file.
    pub damaged: bool,
}

/// Why a recording was not read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system refused.
    #[error(transparent)]
    Refused(#[from] io::Error),
    /// Somebody compressed it.
    #[error(
        "its chunks are compressed ({0}), must be as they were recorded: `mcap decompress` makes them so"
    )]
    Compressed(String),
}

/// Read what a recorder wrote, until the end or until bytes are no record. Records that are not valid are left out.
///
/// What it takes of memory is bounded by a multiple of the bytes that were read.
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
    /// What messages of a channel are; of one without a place here, nothing of ours.
    channels: BTreeMap<u16, Channel>,
    bytes: usize,
}

#[derive(Clone, Copy)]
enum Channel {
    Ticks,
    Causes,
}

impl Reading {
    /// True if it was read to its end.
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

    /// Take a record; whether it is one that a recorder may have written.
    fn take(&mut self, opcode: u8, data: &[u8]) -> bool {
        // Of the others, some parsers trust their lengths.
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
            // The index at the end has it once more.
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
        // A recorder names every signal in each message, which takes more bytes than this.
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

/// The signals that a schema names; none where it is not one.
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
