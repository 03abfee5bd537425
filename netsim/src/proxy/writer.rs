//! The thread that writes the log: it may wait for a disk, the proxy may not.

use std::io::{self, BufWriter, Write};
use std::thread;
use std::time::Duration;

use super::log::{HEADER, Record};

/// How long an empty ring is left alone: a small part of the time in which it fills.
const PAUSE: Duration = Duration::from_millis(5);

/// The reading end of a ring.
pub(super) trait Waiting<R> {
    /// Whether the writing end is gone.
    fn is_abandoned(&self) -> bool;

    /// Takes the oldest record.
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

/// Writes records until the other end of the ring is gone and all are written.
pub(super) fn write_while_open(out: impl Write, mut records: rtrb::Consumer<Record>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 16, out);
    writeln!(out, "{HEADER}")?;
    take_while_open(&mut records, |record| record.write(&mut out), || thread::sleep(PAUSE))?;
    out.flush()
}

/// Gives each record to `write` until the other end of the ring is gone and all are given; rests when there is none.
pub(super) fn take_while_open<R>(
    records: &mut impl Waiting<R>,
    mut write: impl FnMut(R) -> io::Result<()>,
    rest: impl Fn(),
) -> io::Result<()> {
    loop {
        // Looked at first: what was pushed before the end is seen below.
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
    use crate::verdict::Direction;

    #[test]
    fn a_line_has_empty_cells_for_what_there_is_not() {
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
