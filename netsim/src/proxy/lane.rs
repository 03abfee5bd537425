//! One direction of the proxy: a link, what is in flight on it, and its record.

use std::net::SocketAddr;
use std::sync::atomic::Ordering::Relaxed;

use super::buffers::{BufferPool, MAX_DATAGRAM, Slot};
use super::statistics::{DirectionRecorder, count};
use crate::in_flight::{DEFAULT_CAPACITY, InFlight};
use crate::link::Link;
use crate::settings::{LinkError, LinkSettings};
use crate::verdict::{Direction, DropCause, Packet, Verdict};

/// A datagram on its way.
#[derive(Debug)]
struct Datagram {
    slot: Slot,
    /// Settled on arrival, so that an answer to a client that has since been replaced does not reach the new
    /// one.
    destination: SocketAddr,
}

#[derive(Debug)]
pub(super) struct Lane {
    link: Link,
    queue: InFlight<Datagram>,
    buffers: BufferPool,
    next_index: u64,
}

impl Lane {
    pub(super) fn new(direction: Direction, seed: u64, settings: &LinkSettings) -> Result<Self, LinkError> {
        Ok(Self {
            link: Link::new(direction, seed, settings)?,
            queue: InFlight::with_capacity(DEFAULT_CAPACITY),
            buffers: BufferPool::with_capacity(DEFAULT_CAPACITY),
            next_index: 0,
        })
    }

    pub(super) fn next_due(&self) -> Option<u64> {
        self.queue.next_due()
    }

    /// Judges a datagram that came at `now_ns` and keeps it until it is due.
    pub(super) fn accept(
        &mut self,
        now_ns: u64,
        datagram: &[u8],
        destination: SocketAddr,
        record: &DirectionRecorder,
        mut observe: impl FnMut(&Packet, Verdict),
    ) {
        if datagram.len() > MAX_DATAGRAM {
            count(&record.oversize);
            return;
        }
        let packet = Packet {
            direction: self.link.direction(),
            sent_ns: now_ns,
            size: datagram.len(),
            index: self.next_index,
        };
        self.next_index += 1;
        count(&record.received);
        let verdict = match self.link.judge(&packet).verdict {
            Verdict::Deliver { at_ns } => match self.enqueue(at_ns, datagram, destination) {
                Ok(()) => Verdict::Deliver { at_ns },
                Err(cause) => {
                    count(&record.queue_full);
                    Verdict::Drop { cause }
                }
            },
            lost @ Verdict::Drop { .. } => {
                count(&record.lost);
                lost
            }
        };
        let overtaking = self.link.counters().overtaking;
        record.overtaking.store(overtaking, Relaxed);
        observe(&packet, verdict);
    }

    fn enqueue(&mut self, due_ns: u64, datagram: &[u8], destination: SocketAddr) -> Result<(), DropCause> {
        // Pool and queue have the same capacity: a slot in hand means room in the queue, so none is lost
        // below.
        let slot = self.buffers.store(datagram).ok_or(DropCause::InFlight)?;
        self.queue.push(due_ns, Datagram { slot, destination })
    }

    /// Hands the next datagram due by `now_ns` to `send` with its due time; whether there was one.
    pub(super) fn release(
        &mut self,
        now_ns: u64,
        record: &DirectionRecorder,
        send: impl FnOnce(&[u8], SocketAddr, u64) -> bool,
    ) -> bool {
        let Some((due_ns, datagram)) = self.queue.pop_due(now_ns) else {
            return false;
        };
        let Datagram { slot, destination } = datagram;
        let sent = send(self.buffers.read(&slot), destination, due_ns);
        count(if sent { &record.released } else { &record.unsent });
        self.buffers.release(slot);
        true
    }
}
