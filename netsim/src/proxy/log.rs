//! The ground truth: what became of every datagram, through a bounded ring to a thread that writes it down.

use std::io::{self, Write};
use std::sync::atomic::AtomicU64;
use std::thread::JoinHandle;

use super::statistics::count;
use super::writer::write_while_open;
use crate::verdict::Direction;

/// Datagrams whose records wait to be written; more are not recorded.
const MAX_WAITING: usize = 1 << 17;

/// First line of the log.
pub(super) const HEADER: &str = "direction,index,kind,t_in_ns,t_due_ns,t_out_ns,cause,error_ns,size";

/// What became of one datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Record {
    pub(super) direction: Direction,
    pub(super) index: u64,
    /// Empty for the packet itself, else why there is a copy.
    pub(super) kind: &'static str,
    pub(super) in_ns: u64,
    pub(super) due_ns: Option<u64>,
    pub(super) out_ns: Option<u64>,
    /// Why it did not leave; empty if it did.
    pub(super) cause: &'static str,
    /// Bytes that came.
    pub(super) size: usize,
}

impl Record {
    /// Writes a line; an empty cell is what there is not.
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

/// The proxy's end of the ring.
#[derive(Debug)]
pub(super) struct Log {
    records: rtrb::Producer<Record>,
    writer: JoinHandle<io::Result<()>>,
}

impl Log {
    /// Begins a log, and the thread that writes it.
    pub(super) fn begin(out: impl Write + Send + 'static) -> io::Result<Self> {
        let (records, waiting) = rtrb::RingBuffer::new(MAX_WAITING);
        let writer = std::thread::Builder::new()
            .name("haptether-log".into())
            .spawn(move || write_while_open(out, waiting))?;
        Ok(Self { records, writer })
    }

    /// Hands a record over, or counts it as lost where the writer is behind.
    pub(super) fn push(&mut self, record: Record, lost: &AtomicU64) {
        if self.records.push(record).is_err() {
            count(lost);
        }
    }

    /// Waits until all is written.
    pub(super) fn end(self) -> io::Result<()> {
        drop(self.records);
        self.writer.join().unwrap_or_else(|_| Err(io::Error::other("the log's writer panicked")))
    }
}
