//! Independent uniform jitter: arrival + u, u uniform on the integers of `[-w, w]` ns.
//!
//! Every packet draws its own u, so with sending periods below 2 w packets overtake one another. This is how
//! `tc netem` behaves without `rate`; a path that keeps the order needs jitter correlated in time instead.
//!
//! Source: tc-netem(8), `delay TIME JITTER distribution uniform`.

use crate::random::Stream;
use crate::rule::Rule;
use crate::verdict::{Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Jitter {
    half_width_ns: u64,
    stream: Stream,
}

impl Jitter {
    /// The link has checked that the half-width is at most the delay.
    pub(crate) fn new(half_width_ns: u64, stream: Stream) -> Self {
        Self { half_width_ns, stream }
    }
}

impl Rule for Jitter {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let w = self.half_width_ns;
        let shift = self.stream.up_to(2 * w, packet.index);
        Verdict::Deliver {
            // The floor is never reached behind a delay of at least w; it keeps the rule causal by itself.
            at_ns: at_ns.saturating_add(shift).saturating_sub(w).max(packet.sent_ns),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Impairment;
    use crate::verdict::Direction;

    #[test]
    fn without_a_delay_no_packet_arrives_before_it_was_sent() {
        let stream = Stream::new(3, Direction::Forward, Impairment::Jitter);
        let mut jitter = Jitter::new(1_000_000, stream);
        for index in 0..1000 {
            let packet = Packet { direction: Direction::Forward, sent_ns: 500, size: 64, index };
            let Verdict::Deliver { at_ns } = jitter.judge(&packet, 500) else {
                panic!("jitter drops nothing");
            };
            assert!((500..=1_000_500).contains(&at_ns));
        }
    }
}
