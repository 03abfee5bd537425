//! Interarrival jitter.

use crate::clock::difference;

/// Mean deviation of the spacing of packets: `J += (|D| - J) / 16`, where `D` is by how much two packets came further
/// apart than they were sent.
///
/// It sees how the delay changes from packet to packet. A delay that wanders slowly over many packets has little of
/// that jitter.
///
/// Source: RFC 3550, section 6.4.1 and appendix A.8 (integers, `J` scaled by 16).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Jitter {
    scaled: u64,
    last_transit_ns: Option<i64>,
}

impl Jitter {
    /// Takes a packet in the order of arrival; the clocks of both times may differ.
    pub fn arrived(&mut self, sent_ns: u64, now_ns: u64) {
        let transit = difference(now_ns, sent_ns);
        if let Some(last) = self.last_transit_ns.replace(transit) {
            let deviation = transit.abs_diff(last).min(u64::MAX >> 8);
            self.scaled = self.scaled + deviation - ((self.scaled + 8) >> 4);
        }
    }

    /// The jitter in ns.
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
    fn two_delays_in_turn_end_at_their_difference() {
        let mut jitter = Jitter::default();
        for n in 0..400u64 {
            // The sender's clock is far ahead of ours.
            jitter.arrived(1 << 60, n % 2 * 3_000_000);
        }
        assert!(jitter.jitter_ns().abs_diff(3_000_000) <= 1);
    }
}
