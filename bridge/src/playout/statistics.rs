//! What the way did to the packets.

use std::fmt;

use super::bursts::{Bursts, Seen, Sequences};
use super::jitter::Jitter;
use super::reorder::{Extents, Reordering};

/// Counts what arrives, in bounded memory.
///
/// Losses are final when 2048 later sequences have been seen; a packet that comes late before that is no loss.
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
    /// Nothing has arrived.
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

    /// Forgets all: for a new session, whose sequences begin anew.
    pub fn restart(&mut self) {
        *self.sequences = Sequences::new();
        *self.extents = Extents::new();
        self.jitter = Jitter::default();
        (self.received, self.duplicate, self.too_late) = (0, 0, 0);
        (self.first_ns, self.last_ns, self.worst_gap_ns) = (None, 0, 0);
    }

    /// Takes a packet that arrived at `now_ns` and was sent at `sent_ns` on the sender's clock. Times of arrival do not
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

    /// What is known at `now_ns`; a silence up to then counts as a gap.
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

/// What the way did to the packets up to a time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct PathStatistics {
    /// Different sequences that arrived while they counted.
    pub received: u64,
    /// Packets that had arrived before.
    pub duplicate: u64,
    /// Packets that came from before the first, or so late that they are counted as lost.
    pub too_late: u64,
    /// Sequences from the first to the newest.
    pub expected: u64,
    /// Sequences that did not arrive.
    pub losses: Bursts,
    /// Packets out of order.
    pub reordering: Reordering,
    /// Interarrival jitter in ns (RFC 3550).
    pub jitter_ns: u64,
    /// Mean rate of arrival in Hz.
    pub rate_hz: f64,
    /// Longest time in ns without a packet.
    pub worst_gap_ns: u64,
}

impl PathStatistics {
    /// Share of the expected sequences that did not arrive; 0 before the first.
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
