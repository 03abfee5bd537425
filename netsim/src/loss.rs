//! Bernoulli loss: each packet is lost with probability p, whatever happened to the others.
//!
//! Lost if r < p 2^64 with r uniform on `0..2^64`. Both sides are integers: p 2^64 is exact in binary
//! floating point up to its last fractional bit, and the comparison is the same everywhere.

use crate::random::Stream;
use crate::rule::Rule;
use crate::verdict::{DropCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Loss {
    /// p 2^64; wider than a draw, so that p = 1 loses every packet.
    threshold: u128,
    stream: Stream,
}

impl Loss {
    /// The link has checked that the probability is in `[0, 1]`.
    pub(crate) fn new(probability: f64, stream: Stream) -> Self {
        const TWO_POW_64: f64 = 18_446_744_073_709_551_616.0;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "0 <= probability <= 1; what is cut off is below 2^-64"
        )]
        let threshold = (probability * TWO_POW_64) as u128;
        Self { threshold, stream }
    }
}

impl Rule for Loss {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        if u128::from(self.stream.bits(packet.index)) < self.threshold {
            Verdict::Drop { cause: DropCause::Loss }
        } else {
            Verdict::Deliver { at_ns }
        }
    }
}
