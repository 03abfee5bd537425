//! Packets that come after a later one.

/// Arrivals over which the extent of a reordered packet is sought.
const PLACES: usize = 2048;
const KEPT: u64 = PLACES as u64;

/// Reordered packets and how far they came too late.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Reordering {
    /// Packets that arrived after one of a greater sequence.
    pub reordered: u64,
    /// Sum of their extents: arrivals since the first of a greater sequence.
    pub extent_sum: u64,
    /// The greatest extent; no more than 2048 can be told.
    pub longest_extent: u64,
}

impl Reordering {
    /// Mean extent; 0 without any.
    pub fn mean_extent(&self) -> f64 {
        if self.reordered == 0 { 0.0 } else { self.extent_sum as f64 / self.reordered as f64 }
    }
}

/// Measures the reordering extent `e = i - j` of the arrival `i`, where `j` is the first arrival with a greater
/// sequence.
///
/// The first greater sequence is also the first time that the greatest so far was greater, and the greatest so far
/// only rises, so it is found by halving.
///
/// Source: RFC 4737, section 3.3 (reordered), section 4.2.2 (extent).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Extents {
    /// The greatest sequence up to each of the last arrivals, in a ring.
    greatest: [u64; PLACES],
    arrivals: u64,
    counts: Reordering,
}

impl Extents {
    pub(super) fn new() -> Self {
        Self { greatest: [0; PLACES], arrivals: 0, counts: Reordering::default() }
    }

    /// Takes a sequence in the order of arrival; no duplicates.
    pub(super) fn arrived(&mut self, sequence: u64) {
        let arrival = self.arrivals;
        let before = arrival.checked_sub(1).map_or(sequence, |last| self.greatest[slot(last)]);
        if before > sequence {
            let (mut low, mut high) = (arrival.saturating_sub(KEPT), arrival - 1);
            while low < high {
                let middle = low.midpoint(high);
                if self.greatest[slot(middle)] > sequence { high = middle } else { low = middle + 1 }
            }
            let extent = arrival - low;
            self.counts.reordered += 1;
            self.counts.extent_sum += extent;
            self.counts.longest_extent = self.counts.longest_extent.max(extent);
        }
        self.greatest[slot(arrival)] = before.max(sequence);
        self.arrivals += 1;
    }

    pub(super) fn counts(&self) -> Reordering {
        self.counts
    }
}

fn slot(arrival: u64) -> usize {
    usize::try_from(arrival % KEPT).unwrap_or(0)
}
