//! Bernoulli loss: each packet is lost with probability p, whatever happened to the others.

use crate::random::{Chance, Stream};
use crate::rule::Rule;
use crate::verdict::{DropCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(super) struct Bernoulli {
    chance: Chance,
    stream: Stream,
}

impl Bernoulli {
    /// With a probability that was checked.
    pub(super) fn new(probability: f64, stream: Stream) -> Self {
        Self { chance: Chance::new(probability), stream }
    }
}

impl Rule for Bernoulli {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.chance.takes(self.stream.bits(packet.index)), DropCause::Loss, at_ns)
    }
}
