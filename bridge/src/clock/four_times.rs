//! The four times of an exchange.

use super::{ClockFault, difference, share_up};

/// The times of a packet there and one back, in ns: the outer two on our clock, the inner two on the peer's.
///
/// A frame with an echo holds three of them: what we wrote as its sending time, the peer's sending time less how long
/// the peer held our packet, and the peer's sending time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FourTimes {
    /// `t1`: our packet left.
    pub sent_ns: u64,
    /// `t2`: it arrived there.
    pub peer_received_ns: u64,
    /// `t3`: the answer left there.
    pub peer_sent_ns: u64,
    /// `t4`: it arrived here.
    pub received_ns: u64,
}

impl FourTimes {
    /// Whether each clock by itself shows possible times, and both durations fit clocks that part by at most
    /// `max_drift_ppb`.
    pub fn check(&self, max_drift_ppb: u64) -> Result<(), ClockFault> {
        let times = [self.sent_ns, self.peer_received_ns, self.peer_sent_ns, self.received_ns];
        if let Some(&seen_ns) = times.iter().find(|&&time| time > i64::MAX.cast_unsigned()) {
            return Err(ClockFault::OutOfRange { seen_ns });
        }
        for (side, first, second) in
            [("own", self.sent_ns, self.received_ns), ("peer", self.peer_received_ns, self.peer_sent_ns)]
        {
            if second < first {
                return Err(ClockFault::Backwards { side, by_ns: first - second });
            }
        }
        let (took, held) = (self.took_ns(), self.held_ns());
        // Four readings in whole ns.
        if held > took.saturating_add(share_up(took, max_drift_ppb)).saturating_add(4) {
            return Err(ClockFault::NegativeRoundTrip { by_ns: held - took });
        }
        Ok(())
    }

    /// How long the peer held the packet: `t3 - t2`, on its clock.
    pub fn held_ns(&self) -> u64 {
        self.peer_sent_ns.saturating_sub(self.peer_received_ns)
    }

    /// From sending to the answer: `t4 - t1`, on our clock.
    pub fn took_ns(&self) -> u64 {
        self.received_ns.saturating_sub(self.sent_ns)
    }

    /// Time on the way: `delta = (t4 - t1) - (t3 - t2)`, 0 if it would be negative.
    ///
    /// Source: RFC 5905, section 8.
    pub fn round_trip_ns(&self) -> u64 {
        self.took_ns().saturating_sub(self.held_ns())
    }

    /// The peer's clock less ours: `theta = ((t2 - t1) + (t3 - t4)) / 2`, rounded to zero.
    ///
    /// It is wrong by half of what the ways differ, `(forward - backward) / 2`, so by at most half the round trip, and by
    /// what the clocks part meanwhile.
    ///
    /// Source: RFC 5905, section 8.
    pub fn offset_ns(&self) -> i64 {
        difference(self.peer_received_ns, self.sent_ns)
            .midpoint(difference(self.peer_sent_ns, self.received_ns))
    }

    /// The time on our clock at which [`Self::offset_ns`] holds if the clocks drift apart: `(t1 + t4) / 2`.
    pub fn middle_ns(&self) -> u64 {
        self.sent_ns.midpoint(self.received_ns)
    }
}
