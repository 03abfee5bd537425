//! Ground truth: the outcome of every datagram, through a bounded ring to a writer thread.

use std::io::{self, BufWriter, Write};
use std::sync::atomic::AtomicU64;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use super::statistics::count;
use crate::packet::Direction;

/// Capacity of the ring in records; further ones are lost.
const MAX_WAITING: usize = 1 << 17;

const HEADER: &str = "direction,index,kind,t_in_ns,t_due_ns,t_out_ns,cause,error_ns,size";

/// Outcome of one datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Record {
    pub(super) direction: Direction,
    pub(super) index: u64,
    /// Empty for the packet itself; otherwise the cause of the copy.
    pub(super) kind: &'static str,
    pub(super) in_ns: u64,
    pub(super) due_ns: Option<u64>,
    pub(super) out_ns: Option<u64>,
    /// Reason for not leaving; empty if it left.
    pub(super) cause: &'static str,
    /// Size on arrival in bytes.
    pub(super) size: usize,
}

impl Record {
    /// Write a line; absent values are empty cells.
    pub(super) fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let Self { direction, index, kind, in_ns, due_ns, out_ns, cause, size } = self;
        write!(out, "{direction},{index},{kind},{in_ns},")?;
        let error_ns = out_ns.zip(*due_ns).map(|(out_ns, due_ns)| out_ns.saturating_sub(due_ns));
        let mut cell = |ns: Option<u64>| match ns {
            Some(ns) => write!(out, "{ns},"),
            None => out.write_all(b","),
        };
        cell(*due_ns)?;
        cell(*out_ns)?;
        write!(out, "{cause},")?;
        match error_ns {
            Some(ns) => writeln!(out, "{ns},{size}"),
            None => writeln!(out, ",{size}"),
        }
    }
}

#[derive(Debug)]
pub(super) struct Log {
    records: rtrb::Producer<Record>,
    writer: JoinHandle<io::Result<()>>,
}

impl Log {
    pub(super) fn begin(out: impl Write + Send + 'static) -> io::Result<Self> {
        let (records, waiting) = rtrb::RingBuffer::new(MAX_WAITING);
        let writer = thread::Builder::new()
            .name("haptether-log".into())
            .spawn(move || write_while_open(out, waiting))?;
        Ok(Self { records, writer })
    }

    /// Enqueues a record, or counts it as lost if the ring is full.
    pub(super) fn push(&mut self, record: Record, lost: &AtomicU64) {
        if self.records.push(record).is_err() {
            count(lost);
        }
    }

    pub(super) fn end(self) -> io::Result<()> {
        drop(self.records);
        self.writer.join().unwrap_or_else(|_| Err(io::Error::other("the log's writer panicked")))
    }
}

/// Pause of the writer at an empty ring: a small part of the time in which it fills.
const PAUSE: Duration = Duration::from_millis(5);

pub(super) trait Waiting<R> {
    fn is_abandoned(&self) -> bool;

    fn take(&mut self) -> Option<R>;
}

impl<R> Waiting<R> for rtrb::Consumer<R> {
    fn is_abandoned(&self) -> bool {
        self.is_abandoned()
    }

    fn take(&mut self) -> Option<R> {
        self.pop().ok()
    }
}

/// Body of the writer thread, which may wait for a disk; the proxy may not. It writes records until the
/// producer is gone and the ring is empty.
fn write_while_open(out: impl Write, mut records: rtrb::Consumer<Record>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 16, out);
    writeln!(out, "{HEADER}")?;
    take_while_open(&mut records, |record| record.write(&mut out), || thread::sleep(PAUSE))?;
    out.flush()
}

/// Pass records to `write` until the producer is gone and the ring is empty; calls `rest` when it is empty.
pub(super) fn take_while_open<R>(
    records: &mut impl Waiting<R>,
    mut write: impl FnMut(R) -> io::Result<()>,
    rest: impl Fn(),
) -> io::Result<()> {
    loop {
        // Checked first: the loop below then sees all records pushed before the end.
        let is_last = records.is_abandoned();
        while let Some(record) = records.take() {
            write(record)?;
        }
        if is_last {
            return Ok(());
        }
        rest();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packet::Direction;

    #[test]
    fn absent_values_are_empty_cells() {
        let left = Record {
            direction: Direction::Forward,
            index: 7,
            kind: "",
            in_ns: 10,
            due_ns: Some(30),
            out_ns: Some(34),
            cause: "",
            size: 64,
        };
        let lost = Record { kind: "replay", due_ns: None, out_ns: None, cause: "in-flight", ..left };
        let (mut ring, records) = rtrb::RingBuffer::new(2);
        ring.push(left).unwrap();
        ring.push(Record { direction: Direction::Backward, ..lost }).unwrap();
        drop(ring);
        let mut out = Vec::new();
        write_while_open(&mut out, records).unwrap();
        assert_eq!(
            String::from_utf8(out).unwrap(),
            format!("{HEADER}\nforward,7,,10,30,34,,4,64\nbackward,7,replay,10,,,in-flight,,64\n")
        );
    }
}
