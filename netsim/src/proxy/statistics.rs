//! Statistics of the proxy, readable from other threads while it runs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

use super::realtime::Scheduling;
use crate::verdict::DropCause;

const BIN_NS: u64 = 1_000;
/// 1 us bins up to 10 ms; later values share one more bin.
const BINS: usize = 10_000;

const CAUSES: usize = DropCause::ALL.len();

/// Statistics of the datagrams of one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct DirectionStatistics {
    /// Datagrams accepted and judged.
    pub received: u64,
    /// Received datagrams dropped by the link's rules, for any cause.
    pub lost: u64,
    /// Received datagrams dropped because too many were in flight.
    pub queue_full: u64,
    /// Received datagrams sent on.
    pub released: u64,
    /// Received datagrams not sent when due, because the socket refused them or the client was gone.
    pub unsent: u64,
    /// Received datagrams with changed bytes, sent or to be sent.
    pub damaged: u64,
    /// Additional datagrams: copies and forgeries.
    pub extras: u64,
    /// Additional datagrams sent.
    pub extras_released: u64,
    /// Additional datagrams not sent: too many in flight, or refused by the socket.
    pub extras_lost: u64,
    /// Datagrams due before an earlier one: each overtakes at least one.
    pub overtaking: u64,
    /// Datagrams above [`MAX_DATAGRAM`](super::MAX_DATAGRAM) bytes, dropped before any rule.
    pub oversize: u64,
    /// Datagrams from a source that is not permitted, dropped before any rule. Forward: a source that is
    /// neither loopback nor allowed, or without room. Backward: a source other than the peer.
    pub refused: u64,
    causes: [u64; CAUSES],
}

impl DirectionStatistics {
    /// Accepted datagrams that have neither left nor been dropped.
    pub fn in_flight(&self) -> u64 {
        let gone = self.lost + self.queue_full + self.released + self.unsent;
        self.received.saturating_sub(gone)
    }

    /// Accepted datagrams dropped for this cause.
    pub fn dropped(&self, cause: DropCause) -> u64 {
        self.causes[cause as usize]
    }
}

/// Statistics of the proxy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct ProxyStatistics {
    /// Client to peer.
    pub forward: DirectionStatistics,
    /// Peer to client.
    pub backward: DirectionStatistics,
    /// Current number of clients.
    pub flows: u64,
    /// Number of network reports that the peer is unreachable, as before it starts.
    pub peer_unreachable: u64,
    /// Lateness of departures, both directions together.
    pub scheduling_error: SchedulingError,
    /// Datagrams that left before they were due: always 0.
    pub early: u64,
    /// Records missing from the log because its writer was behind.
    pub log_lost: u64,
    /// Set if the log could not be written completely, as on a full disk.
    pub log_failed: bool,
    /// Scheduling of the proxy's thread.
    pub scheduling: Scheduling,
    /// Receive buffer granted to the listening socket, in bytes as the kernel counts them.
    pub receive_buffer_bytes: u64,
    /// Send buffer granted to the listening socket, in bytes as the kernel counts them.
    pub send_buffer_bytes: u64,
    /// Set if the delays are those of the links: p99 of the scheduling error within its limit, nothing early,
    /// and no failed log.
    pub valid: bool,
}

/// Lateness of departures. Never negative: the proxy releases nothing early.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct SchedulingError {
    /// Datagrams measured.
    pub count: u64,
    /// Median, rounded up to a whole us, in ns.
    pub p50_ns: u64,
    /// 99th percentile, rounded up to a whole us, in ns.
    pub p99_ns: u64,
    /// 99.9th percentile, rounded up to a whole us, in ns.
    pub p999_ns: u64,
    /// Maximum, exact, in ns.
    pub max_ns: u64,
}

/// Handle by which any thread reads the statistics of a running proxy, without disturbing it.
#[derive(Clone, Debug)]
pub struct ProxyMonitor(pub(super) Arc<Recorder>);

impl ProxyMonitor {
    /// Statistics so far. Each number is exact; together they may be a few packets apart.
    pub fn snapshot(&self) -> ProxyStatistics {
        let Recorder { flows, peer_unreachable, early, log_lost, .. } = &*self.0;
        let scheduling_error = self.0.scheduling_error.summary();
        let (early, log_failed) = (early.load(Relaxed), self.0.log_failed.load(Relaxed));
        ProxyStatistics {
            forward: self.0.forward.snapshot(),
            backward: self.0.backward.snapshot(),
            flows: flows.load(Relaxed),
            peer_unreachable: peer_unreachable.load(Relaxed),
            scheduling_error,
            early,
            log_lost: log_lost.load(Relaxed),
            scheduling: if self.0.is_fifo.load(Relaxed) { Scheduling::Fifo } else { Scheduling::Normal },
            receive_buffer_bytes: self.0.receive_buffer_bytes,
            send_buffer_bytes: self.0.send_buffer_bytes,
            log_failed,
            valid: early == 0 && !log_failed && scheduling_error.p99_ns <= self.0.max_error_ns,
        }
    }
}

/// Writing side. Relaxed throughout: the numbers guard no other memory.
#[derive(Debug, Default)]
pub(super) struct Recorder {
    pub(super) forward: DirectionRecorder,
    pub(super) backward: DirectionRecorder,
    pub(super) flows: AtomicU64,
    pub(super) peer_unreachable: AtomicU64,
    pub(super) scheduling_error: Histogram,
    pub(super) early: AtomicU64,
    pub(super) log_lost: AtomicU64,
    pub(super) log_failed: AtomicBool,
    pub(super) is_fifo: AtomicBool,
    pub(super) receive_buffer_bytes: u64,
    pub(super) send_buffer_bytes: u64,
    pub(super) max_error_ns: u64,
}

#[derive(Debug, Default)]
pub(super) struct DirectionRecorder {
    pub(super) received: AtomicU64,
    pub(super) released: AtomicU64,
    pub(super) unsent: AtomicU64,
    pub(super) damaged: AtomicU64,
    pub(super) extras: AtomicU64,
    pub(super) extras_released: AtomicU64,
    pub(super) extras_lost: AtomicU64,
    pub(super) overtaking: AtomicU64,
    pub(super) oversize: AtomicU64,
    pub(super) refused: AtomicU64,
    pub(super) causes: [AtomicU64; CAUSES],
}

impl DirectionRecorder {
    pub(super) fn dropped(&self, cause: DropCause) {
        count(&self.causes[cause as usize]);
    }

    fn snapshot(&self) -> DirectionStatistics {
        let causes = self.causes.each_ref().map(|cause| cause.load(Relaxed));
        let queue_full = causes[DropCause::InFlight as usize];
        DirectionStatistics {
            received: self.received.load(Relaxed),
            lost: causes.iter().sum::<u64>() - queue_full,
            queue_full,
            released: self.released.load(Relaxed),
            unsent: self.unsent.load(Relaxed),
            damaged: self.damaged.load(Relaxed),
            extras: self.extras.load(Relaxed),
            extras_released: self.extras_released.load(Relaxed),
            extras_lost: self.extras_lost.load(Relaxed),
            overtaking: self.overtaking.load(Relaxed),
            oversize: self.oversize.load(Relaxed),
            refused: self.refused.load(Relaxed),
            causes,
        }
    }
}

/// Histogram: one writer, any number of readers, no allocation after the start.
#[derive(Debug)]
pub(super) struct Histogram {
    bins: Vec<AtomicU64>,
    max_ns: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { bins: (0..=BINS).map(|_| AtomicU64::new(0)).collect(), max_ns: AtomicU64::new(0) }
    }
}

impl Histogram {
    pub(super) fn record(&self, error_ns: u64) {
        let bin = usize::try_from(error_ns / BIN_NS).map_or(BINS, |bin| bin.min(BINS));
        count(&self.bins[bin]);
        self.max_ns.fetch_max(error_ns, Relaxed);
    }

    pub(super) fn summary(&self) -> SchedulingError {
        let count: u64 = self.bins.iter().map(|bin| bin.load(Relaxed)).sum();
        let max_ns = self.max_ns.load(Relaxed);
        let quantile = |per_mille: u64| {
            let rank = (count * per_mille).div_ceil(1000);
            let mut below = 0;
            for (upper_ns, bin) in (1..).map(|bin| bin * BIN_NS).zip(&self.bins[..BINS]) {
                below += bin.load(Relaxed);
                if below >= rank {
                    return upper_ns.min(max_ns);
                }
            }
            // In the last, open bin only the maximum is known.
            max_ns
        };
        SchedulingError {
            count,
            p50_ns: quantile(500),
            p99_ns: quantile(990),
            p999_ns: quantile(999),
            max_ns,
        }
    }
}

/// Increments a counter that only this thread writes, without locking the bus.
pub(super) fn count(counter: &AtomicU64) {
    counter.store(counter.load(Relaxed) + 1, Relaxed);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_the_upper_edges_of_their_bins() {
        let histogram = Histogram::default();
        assert_eq!(histogram.summary(), SchedulingError::default());
        for error_us in 0..1000 {
            histogram.record(error_us * 1000 + 500);
        }
        let summary = histogram.summary();
        assert_eq!(summary.count, 1000);
        assert_eq!((summary.p50_ns, summary.p99_ns, summary.p999_ns), (500_000, 990_000, 999_000));
        assert_eq!(summary.max_ns, 999_500);
    }

    #[test]
    fn an_error_beyond_the_bins_is_reported_as_the_maximum() {
        let histogram = Histogram::default();
        histogram.record(u64::MAX);
        assert_eq!(histogram.summary().p50_ns, u64::MAX);
    }
}
