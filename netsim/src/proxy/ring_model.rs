//! Model check of the ring between a loop and its writer thread, under every interleaving and every value
//! that the memory model allows.
//!
//! The ring is that of `rtrb`, with its orderings, in loom's atomics; the code that uses it is ours. A slot
//! is an atomic without an ordering of its own, beside a loom cell that detects unordered accesses. Each
//! relevant ordering and protocol step is also tested by omitting it: the model must detect that.
//!
//! Source: `rtrb` 0.4.1, `Producer::push`, `Consumer::pop`, `ArcRingBuffer::drop`.

use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::sync::atomic::{
    AtomicU8, AtomicU64, AtomicUsize,
    Ordering::{self, Acquire, Relaxed, Release},
};
use loom::thread;

use super::log::{Waiting, take_while_open};

const CAPACITY: usize = 2;
const RECORDS: u64 = 3;

/// Ordering omitted from a ring.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Without {
    Nothing,
    /// Order between a slot and the index that publishes it.
    Publication,
    /// Order between the last records and the end mark.
    Farewell,
    /// Order between reading a slot and freeing it.
    Return,
}

#[derive(Default)]
struct Slot {
    record: AtomicU64,
    access: UnsafeCell<()>,
}

struct Ring {
    slots: [Slot; CAPACITY],
    /// Records taken and pushed so far.
    head: AtomicUsize,
    tail: AtomicUsize,
    abandoned: AtomicU8,
    without: Without,
}

impl Ring {
    fn ends(without: Without) -> (Producer, Consumer) {
        let ring = Arc::new(Self {
            slots: std::array::from_fn(|_| Slot::default()),
            head: AtomicUsize::new(0),
            tail: AtomicUsize::new(0),
            abandoned: AtomicU8::new(0),
            without,
        });
        (
            Producer { ring: Arc::clone(&ring), tail: 0, seen_head: 0 },
            Consumer { ring, head: 0, seen_tail: 0 },
        )
    }

    fn order(&self, without: Without, order: Ordering) -> Ordering {
        if self.without == without { Relaxed } else { order }
    }
}

struct Producer {
    ring: Arc<Ring>,
    tail: usize,
    seen_head: usize,
}

impl Producer {
    fn push(&mut self, record: u64) -> Result<(), u64> {
        let ring = &self.ring;
        if self.tail - self.seen_head == CAPACITY {
            self.seen_head = ring.head.load(ring.order(Without::Return, Acquire));
            if self.tail - self.seen_head == CAPACITY {
                return Err(record);
            }
        }
        let slot = &ring.slots[self.tail % CAPACITY];
        slot.access.with_mut(|_| ());
        slot.record.store(record, Relaxed);
        self.tail += 1;
        ring.tail.store(self.tail, ring.order(Without::Publication, Release));
        Ok(())
    }
}

impl Drop for Producer {
    fn drop(&mut self) {
        self.ring.abandoned.fetch_or(1, self.ring.order(Without::Farewell, Release));
    }
}

struct Consumer {
    ring: Arc<Ring>,
    head: usize,
    seen_tail: usize,
}

impl Waiting<u64> for Consumer {
    fn is_abandoned(&self) -> bool {
        self.ring.abandoned.load(Acquire) != 0
    }

    fn take(&mut self) -> Option<u64> {
        let ring = &self.ring;
        if self.head == self.seen_tail {
            self.seen_tail = ring.tail.load(Acquire);
            if self.head == self.seen_tail {
                return None;
            }
        }
        let slot = &ring.slots[self.head % CAPACITY];
        slot.access.with(|_| ());
        let record = slot.record.load(Relaxed);
        self.head += 1;
        ring.head.store(self.head, ring.order(Without::Return, Release));
        Some(record)
    }
}

/// Loop that pushes all records and ends; it counts failed pushes, as [`super::log::Log::push`] does.
fn push_all(mut records: Producer, lost: &AtomicU64) {
    for record in 1..=RECORDS {
        if records.push(record).is_err() {
            lost.fetch_add(1, Relaxed);
        }
    }
}

/// Run a loop concurrently with `write`, which returns the records it received.
fn each_is_written_or_counted(without: Without, write: fn(Consumer) -> Vec<u64>) {
    loom::model(move || {
        let (producer, consumer) = Ring::ends(without);
        let lost = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&lost);
        let pushing = thread::spawn(move || push_all(producer, &counted));
        let written = write(consumer);
        pushing.join().unwrap();
        assert!(written.iter().all(|record| (1..=RECORDS).contains(record)), "written {written:?}");
        assert!(written.is_sorted_by(|one, next| one < next), "written {written:?}");
        assert_eq!(written.len() as u64 + lost.load(Relaxed), RECORDS, "written {written:?}");
    });
}

fn writer(mut records: Consumer) -> Vec<u64> {
    let mut written = Vec::new();
    let write = |record| {
        written.push(record);
        Ok(())
    };
    take_while_open(&mut records, write, thread::yield_now).unwrap();
    written
}

/// Checks for the end only after it finds no record.
fn writer_that_looks_too_late(mut records: Consumer) -> Vec<u64> {
    let mut written = Vec::new();
    loop {
        while let Some(record) = records.take() {
            written.push(record);
        }
        if records.is_abandoned() {
            return written;
        }
        thread::yield_now();
    }
}

#[test]
fn each_record_is_written_once_in_order_or_counted_as_lost() {
    each_is_written_or_counted(Without::Nothing, writer);
}

#[test]
#[should_panic(expected = "violation")]
fn a_record_published_without_order_is_noticed() {
    each_is_written_or_counted(Without::Publication, writer);
}

#[test]
#[should_panic(expected = "written")]
fn an_end_without_order_is_noticed() {
    each_is_written_or_counted(Without::Farewell, writer);
}

#[test]
#[should_panic(expected = "written")]
fn an_end_looked_for_too_late_is_noticed() {
    each_is_written_or_counted(Without::Nothing, writer_that_looks_too_late);
}

#[test]
#[should_panic(expected = "violation")]
fn a_slot_returned_without_order_is_noticed() {
    each_is_written_or_counted(Without::Return, writer);
}

/// Live run: the reader drains while the loop runs, waits for its end, and drains the rest.
#[test]
fn records_left_after_the_loop_are_drained() {
    loom::model(|| {
        let (producer, mut consumer) = Ring::ends(Without::Nothing);
        let lost = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&lost);
        let pushing = thread::spawn(move || push_all(producer, &counted));
        let mut written: Vec<u64> = std::iter::from_fn(|| consumer.take()).collect();
        pushing.join().unwrap();
        written.extend(std::iter::from_fn(|| consumer.take()));
        assert!(written.is_sorted_by(|one, next| one < next), "written {written:?}");
        assert_eq!(written.len() as u64 + lost.load(Relaxed), RECORDS, "written {written:?}");
    });
}
