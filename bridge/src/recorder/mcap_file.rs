//! An MCAP file with one channel, whose messages are JSON.

use std::{
    collections::BTreeMap,
    io::Write,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use mcap::{WriteOptions, Writer, records::MessageHeader, records::Metadata, write::NoSeek};

use super::{
    Recorded, SecurityMark,
    disk::{Refusal, Sink},
    fields::{schema, write_json},
};

/// Name of the metadata that say what the file is.
const METADATA: &str = "haptether";

/// A file that is being written.
pub(super) struct McapFile<W: Write> {
    writer: Option<Writer<NoSeek<Sink<W>>>>,
    refusal: Refusal,
    channel: u16,
    security: SecurityMark,
    /// Wall-clock time in ns at which the file was begun, for the log times.
    begun_ns: u64,
    sequence: u32,
    message: Vec<u8>,
}

impl<W: Write> McapFile<W> {
    /// Writes the head: what the file is, the schema of its messages, their channel.
    pub(super) fn begin<R: Recorded>(out: W, security: SecurityMark) -> Self {
        let (sink, refusal) = Sink::new(out);
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
        let begun_ns = u64::try_from(since_epoch.as_nanos()).unwrap_or(0);
        let mut file = Self {
            writer: None,
            refusal,
            channel: 0,
            security,
            begun_ns,
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
                ("side".to_owned(), R::SIDE.to_owned()),
                ("security".to_owned(), security.name().to_owned()),
            ]);
            let _ =
                writer.write_metadata(&Metadata { name: METADATA.to_owned(), metadata: metadata.clone() });
            let name = format!("haptether.{}", R::SIDE);
            file.channel = writer
                .add_schema(&name, "jsonschema", schema::<R>().as_bytes())
                .and_then(|id| writer.add_channel(id, &format!("/{}", R::SIDE), "json", &metadata))
                .unwrap_or(0);
        }
        file
    }

    /// Adds a record to the chunk.
    pub(super) fn write(&mut self, record: &impl Recorded) {
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

    /// Ends the chunk and hands it to the system; gives the number of the error if it was refused.
    pub(super) fn flush(&mut self) -> Option<i32> {
        let is_done = self.writer.as_mut().is_some_and(|writer| writer.flush().is_ok());
        self.outcome(is_done)
    }

    /// Writes the index and the end; gives the number of the error if that was refused.
    pub(super) fn finish(mut self) -> Option<i32> {
        let is_done = self.writer.as_mut().is_some_and(|writer| writer.finish().is_ok());
        self.outcome(is_done)
    }

    fn outcome(&self, is_done: bool) -> Option<i32> {
        let unknown = (!is_done).then_some(rustix::io::Errno::IO.raw_os_error());
        self.refusal.number().or(unknown)
    }
}
