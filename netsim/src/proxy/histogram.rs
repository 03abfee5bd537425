//! The proxy's own scheduling error: from when a datagram was due until the call that sends it begins.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use super::statistics::count;

const BIN_NS: u64 = 1_000;
/// 1 us bins up to 10 ms; what is later still falls into one more bin.
const BINS: usize = 10_000;

/// How late datagrams left. Never negative: the proxy releases nothing early.
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
    /// Largest, exact, in ns.
    pub max_ns: u64,
}

/// Counts per bin: one writer, any number of readers, no allocation after the start.
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
            // Within the last, open bin only the maximum is known.
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
