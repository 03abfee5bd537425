//! What the proxy has done, readable from another thread while it runs.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use super::histogram::{Histogram, SchedulingError};

/// What happened to the datagrams of one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct DirectionStatistics {
    /// Datagrams accepted and judged.
    pub received: u64,
    /// Of these, taken by the link's rules.
    pub lost: u64,
    /// Of these, dropped because too many were in flight.
    pub queue_full: u64,
    /// Of these, sent on.
    pub released: u64,
    /// Of these, not sent on when due, because the socket refused them.
    pub unsent: u64,
    /// Datagrams due before one accepted earlier: each overtakes at least one.
    pub overtaking: u64,
    /// Datagrams above [`MAX_DATAGRAM`](super::MAX_DATAGRAM) bytes, dropped before any rule saw them.
    pub oversize: u64,
    /// Datagrams from a source that is not served, dropped before any rule saw them. Forward: another source
    /// than the client. Backward: another than the peer, or before there was a client.
    pub refused: u64,
}

impl DirectionStatistics {
    /// Datagrams accepted that have neither left nor been dropped.
    pub fn in_flight(&self) -> u64 {
        let gone = self.lost + self.queue_full + self.released + self.unsent;
        self.received.saturating_sub(gone)
    }
}

/// What the proxy has done so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct ProxyStatistics {
    /// Client to peer.
    pub forward: DirectionStatistics,
    /// Peer to client.
    pub backward: DirectionStatistics,
    /// Times the network reported that the peer cannot be reached, as when it is not up yet.
    pub peer_unreachable: u64,
    /// How late datagrams left, both directions together.
    pub scheduling_error: SchedulingError,
}

/// A handle by which any thread reads the statistics of a running proxy, without disturbing it.
#[derive(Clone, Debug)]
pub struct ProxyMonitor(pub(super) Arc<Recorder>);

impl ProxyMonitor {
    /// What the proxy has done so far. Each number is exact; taken together they may be a few packets apart.
    pub fn snapshot(&self) -> ProxyStatistics {
        ProxyStatistics {
            forward: self.0.forward.snapshot(),
            backward: self.0.backward.snapshot(),
            peer_unreachable: self.0.peer_unreachable.load(Relaxed),
            scheduling_error: self.0.scheduling_error.summary(),
        }
    }
}

/// The writing side. Relaxed throughout: the numbers guard no other memory.
#[derive(Debug, Default)]
pub(super) struct Recorder {
    pub(super) forward: DirectionRecorder,
    pub(super) backward: DirectionRecorder,
    pub(super) peer_unreachable: AtomicU64,
    pub(super) scheduling_error: Histogram,
}

#[derive(Debug, Default)]
pub(super) struct DirectionRecorder {
    pub(super) received: AtomicU64,
    pub(super) lost: AtomicU64,
    pub(super) queue_full: AtomicU64,
    pub(super) released: AtomicU64,
    pub(super) unsent: AtomicU64,
    pub(super) overtaking: AtomicU64,
    pub(super) oversize: AtomicU64,
    pub(super) refused: AtomicU64,
}

impl DirectionRecorder {
    fn snapshot(&self) -> DirectionStatistics {
        DirectionStatistics {
            received: self.received.load(Relaxed),
            lost: self.lost.load(Relaxed),
            queue_full: self.queue_full.load(Relaxed),
            released: self.released.load(Relaxed),
            unsent: self.unsent.load(Relaxed),
            overtaking: self.overtaking.load(Relaxed),
            oversize: self.oversize.load(Relaxed),
            refused: self.refused.load(Relaxed),
        }
    }
}

/// Adds one to a counter.
pub(super) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Relaxed);
}
