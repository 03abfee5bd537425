//! Path statistics of arrivals: loss and bursts, reordering, jitter, rate and gaps.

use std::fmt;

use super::difference;

/// Sequences behind the newest that may arrive late, and arrivals searched for an extent: two seconds at 1 kHz.
const PLACES: usize = 2048;
const WINDOW: u64 = PLACES as u64;

/// Counts arrivals, in bounded memory.
///
/// A loss is final after 2048 later sequences; a packet that arrives before that is not lost.
#[derive(Clone, Debug)]
pub struct PathMeter {
    sequences: Box<Sequences>,
    extents: Box<Extents>,
    jitter: Jitter,
    received: u64,
    duplicate: u64,
    too_late: u64,
    first_ns: Option<u64>,
    last_ns: u64,
    worst_gap_ns: u64,
}

impl Default for PathMeter {
    fn default() -> Self {
        Self::new()
    }
}

impl PathMeter {
    /// Create a meter before the first packet.
    pub fn new() -> Self {
        Self {
            sequences: Box::new(Sequences::new()),
            extents: Box::new(Extents::new()),
            jitter: Jitter::default(),
            received: 0,
            duplicate: 0,
            too_late: 0,
            first_ns: None,
            last_ns: 0,
            worst_gap_ns: 0,
        }
    }

    /// Clear all, for a new session with new sequences.
    pub fn restart(&mut self) {
        *self.sequences = Sequences::new();
        *self.extents = Extents::new();
        self.jitter = Jitter::default();
        (self.received, self.duplicate, self.too_late) = (0, 0, 0);
        (self.first_ns, self.last_ns, self.worst_gap_ns) = (None, 0, 0);
    }

    /// Take a packet that arrived at `now_ns`, sent at `sent_ns` on the sender's clock. Arrival times must not
    /// decrease.
    pub fn arrived(&mut self, sequence: u64, sent_ns: u64, now_ns: u64) {
        match self.sequences.mark(sequence) {
            Seen::Duplicate => {
                self.duplicate += 1;
                return;
            }
            Seen::TooFar => self.too_late += 1,
            Seen::Newest | Seen::Behind => self.received += 1,
        }
        self.extents.arrived(sequence);
        self.jitter.arrived(sent_ns, now_ns);
        if self.first_ns.is_some() {
            self.worst_gap_ns = self.worst_gap_ns.max(now_ns.saturating_sub(self.last_ns));
        }
        self.first_ns.get_or_insert(now_ns);
        self.last_ns = now_ns;
    }

    /// Statistics as of `now_ns`; a silence up to then counts as a gap.
    pub fn statistics(&self, now_ns: u64) -> PathStatistics {
        let silence_ns = self.first_ns.map_or(0, |_| now_ns.saturating_sub(self.last_ns));
        let arrivals = self.received + self.too_late;
        let span_ns = self.last_ns.saturating_sub(self.first_ns.unwrap_or(self.last_ns));
        let rate_hz = if span_ns == 0 { 0.0 } else { (arrivals - 1) as f64 * 1e9 / span_ns as f64 };
        PathStatistics {
            received: self.received,
            duplicate: self.duplicate,
            too_late: self.too_late,
            expected: self.sequences.span(),
            losses: self.sequences.bursts(),
            reordering: self.extents.counts(),
            jitter_ns: self.jitter.jitter_ns(),
            rate_hz,
            worst_gap_ns: self.worst_gap_ns.max(silence_ns),
        }
    }
}

/// Counts of the packets of one direction up to a time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct PathStatistics {
    /// Different sequences that arrived in time.
    pub received: u64,
    /// Repeated packets.
    pub duplicate: u64,
    /// Packets from before the first, or so late that they are counted as lost.
    pub too_late: u64,
    /// Sequences from the first to the newest.
    pub expected: u64,
    /// Sequences that did not arrive.
    pub losses: Bursts,
    /// Packets out of order.
    pub reordering: Reordering,
    /// Interarrival jitter in ns (RFC 3550).
    pub jitter_ns: u64,
    /// Mean arrival rate in Hz.
    pub rate_hz: f64,
    /// Longest time in ns without a packet.
    pub worst_gap_ns: u64,
}

impl PathStatistics {
    /// Fraction of the expected sequences that did not arrive; 0 before the first.
    pub fn loss(&self) -> f64 {
        if self.expected == 0 { 0.0 } else { self.losses.lost as f64 / self.expected as f64 }
    }
}

impl fmt::Display for PathStatistics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |ns: u64| ns as f64 * 1e-6;
        writeln!(f, "rate        {:.1} Hz, {} packets", self.rate_hz, self.received)?;
        writeln!(f, "worst gap   {:.3} ms", ms(self.worst_gap_ns))?;
        writeln!(f, "jitter      {:.3} ms", ms(self.jitter_ns))?;
        writeln!(
            f,
            "lost        {} of {} ({:.4} %), {} bursts, mean {:.2}, longest {}",
            self.losses.lost,
            self.expected,
            self.loss() * 100.0,
            self.losses.bursts,
            self.losses.mean(),
            self.losses.longest
        )?;
        writeln!(
            f,
            "reordered   {}, mean extent {:.2}, longest {}",
            self.reordering.reordered,
            self.reordering.mean_extent(),
            self.reordering.longest_extent
        )?;
        write!(f, "duplicate   {}, too late {}", self.duplicate, self.too_late)
    }
}

/// Bursts of sequences that never arrived.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Bursts {
    /// Missing sequences.
    pub lost: u64,
    /// Number of bursts.
    pub bursts: u64,
    /// Longest burst.
    pub longest: u64,
    /// Length of the present burst.
    run: u64,
}

impl Bursts {
    /// Mean length of a burst; 0 without any.
    pub fn mean(&self) -> f64 {
        if self.bursts == 0 { 0.0 } else { self.lost as f64 / self.bursts as f64 }
    }

    /// Take the next `count` sequences, all missing.
    fn miss(&mut self, count: u64) {
        if count > 0 {
            self.bursts += u64::from(self.run == 0);
            self.lost += count;
            self.run += count;
            self.longest = self.longest.max(self.run);
        }
    }

    fn take(&mut self, there: bool) {
        if there {
            self.run = 0;
        } else {
            self.miss(1);
        }
    }
}

/// Result of marking a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Seen {
    /// Greater than all before.
    Newest,
    /// Missing until now.
    Behind,
    /// Repeated.
    Duplicate,
    /// Too far behind to be known.
    TooFar,
}

/// Arrivals among the last [`WINDOW`] sequences; one that leaves the window unseen is lost.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sequences {
    there: [bool; PLACES],
    first: Option<u64>,
    newest: u64,
    settled: Bursts,
}

impl Sequences {
    pub(super) fn new() -> Self {
        Self { there: [false; PLACES], first: None, newest: 0, settled: Bursts::default() }
    }

    /// Mark a sequence. The first to arrive starts the count: those before it are not expected.
    pub(super) fn mark(&mut self, sequence: u64) -> Seen {
        // No link counts so far, and the sequence after it would overflow.
        if sequence == u64::MAX {
            return Seen::TooFar;
        }
        let Some(first) = self.first else {
            self.first = Some(sequence);
            self.newest = sequence;
            self.there[slot(sequence)] = true;
            return Seen::Newest;
        };
        if sequence > self.newest {
            self.advance(first, sequence);
            return Seen::Newest;
        }
        if sequence < first || self.newest - sequence >= WINDOW {
            return Seen::TooFar;
        }
        if std::mem::replace(&mut self.there[slot(sequence)], true) { Seen::Duplicate } else { Seen::Behind }
    }

    #[inline]
    fn advance(&mut self, first: u64, sequence: u64) {
        if sequence - self.newest == 1 {
            // Nearly all: one leaves the window, and one is new.
            let there = &mut self.there[slot(sequence)];
            if sequence - first >= WINDOW {
                self.settled.take(*there);
            }
            *there = true;
            self.newest = sequence;
        } else {
            self.skip(first, sequence);
        }
    }

    #[inline(never)]
    fn skip(&mut self, first: u64, sequence: u64) {
        // Each new slot is that of the sequence which leaves the window.
        for passed in (self.newest + 1..=sequence).take(self.there.len()) {
            if passed.checked_sub(WINDOW).is_some_and(|left| left >= first) {
                self.settled.take(self.there[slot(passed)]);
            }
            self.there[slot(passed)] = false;
        }
        // Sequences beyond the window neither arrived nor are in the window.
        let skipped = sequence - self.newest;
        self.settled.miss(skipped.saturating_sub(WINDOW));
        self.there[slot(sequence)] = true;
        self.newest = sequence;
    }

    /// Losses up to the newest, including those that may still arrive.
    pub(super) fn bursts(&self) -> Bursts {
        let mut bursts = self.settled;
        if let Some(first) = self.first {
            let begin = first.max((self.newest + 1).saturating_sub(WINDOW));
            for sequence in begin..=self.newest {
                bursts.take(self.there[slot(sequence)]);
            }
        }
        bursts
    }

    /// Number of sequences from the first to the newest, inclusive.
    pub(super) fn span(&self) -> u64 {
        self.first.map_or(0, |first| self.newest - first + 1)
    }
}

fn slot(sequence: u64) -> usize {
    usize::try_from(sequence % WINDOW).unwrap_or(0)
}

/// Number of reordered packets, and their lateness.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Reordering {
    /// Packets that arrived after one of a greater sequence.
    pub reordered: u64,
    /// Sum of their extents: arrivals since the first of a greater sequence.
    pub extent_sum: u64,
    /// Largest extent; at most 2048 is measured.
    pub longest_extent: u64,
}

impl Reordering {
    /// Mean extent; 0 without any.
    pub fn mean_extent(&self) -> f64 {
        if self.reordered == 0 { 0.0 } else { self.extent_sum as f64 / self.reordered as f64 }
    }
}

/// Measures the reordering extent `e = i - j` of arrival `i`, where `j` is the first arrival with a greater sequence.
///
/// The running maximum first exceeds the sequence at `j`, so a binary search finds it.
///
/// Source: RFC 4737, section 3.3 (reordered), section 4.2.2 (extent).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Extents {
    /// Running maximum of the sequences at each of the last arrivals, in a ring.
    greatest: [u64; PLACES],
    arrivals: u64,
    counts: Reordering,
}

impl Extents {
    pub(super) fn new() -> Self {
        Self { greatest: [0; PLACES], arrivals: 0, counts: Reordering::default() }
    }

    /// Take a sequence in order of arrival, without duplicates.
    pub(super) fn arrived(&mut self, sequence: u64) {
        let arrival = self.arrivals;
        let before = arrival.checked_sub(1).map_or(sequence, |last| self.greatest[slot(last)]);
        if before > sequence {
            let (mut low, mut high) = (arrival.saturating_sub(WINDOW), arrival - 1);
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

/// Mean deviation of packet spacing: `J += (|D| - J) / 16`, where `D` is the spacing at arrival minus that at
/// sending.
///
/// A delay that varies slowly over many packets has little jitter.
///
/// Source: RFC 3550, section 6.4.1 and appendix A.8 (integers, `J` scaled by 16).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Jitter {
    scaled: u64,
    last_transit_ns: Option<i64>,
}

impl Jitter {
    /// Take a packet in order of arrival. The two times may be of different clocks.
    pub fn arrived(&mut self, sent_ns: u64, now_ns: u64) {
        let transit = difference(now_ns, sent_ns);
        if let Some(last) = self.last_transit_ns.replace(transit) {
            let deviation = transit.abs_diff(last).min(u64::MAX >> 8);
            self.scaled = self.scaled + deviation - ((self.scaled + 8) >> 4);
        }
    }

    /// Jitter in ns.
    pub fn jitter_ns(&self) -> u64 {
        self.scaled >> 4
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_the_recursion_of_the_standard() {
        let mut jitter = Jitter::default();
        let mut wanted = 0.0_f64;
        let mut last: Option<i64> = None;
        for n in 0..2000u64 {
            let transit = 10_000_000 + (n * n * 7919 % 3_000_000);
            jitter.arrived(n * 1_000_000, n * 1_000_000 + transit);
            let transit = transit.cast_signed();
            if let Some(last) = last {
                wanted += ((transit - last).abs() as f64 - wanted) / 16.0;
            }
            last = Some(transit);
            // The rounding of each step decays like the rest: 16 steps of half a sixteenth at most.
            assert!((jitter.jitter_ns() as f64 - wanted).abs() <= 2.0);
        }
    }

    #[test]
    fn two_alternating_delays_converge_to_their_difference() {
        let mut jitter = Jitter::default();
        for n in 0..400u64 {
            // The sender's clock is far ahead of ours.
            jitter.arrived(1 << 60, n % 2 * 3_000_000);
        }
        assert!(jitter.jitter_ns().abs_diff(3_000_000) <= 1);
    }
}
