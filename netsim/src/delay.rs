//! Constant delay: arrival = sent + d.

use crate::rule::Rule;
use crate::verdict::{Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Delay {
    delay_ns: u64,
}

impl Delay {
    pub(crate) fn new(delay_ns: u64) -> Self {
        Self { delay_ns }
    }
}

impl Rule for Delay {
    fn judge(&mut self, _packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::Deliver { at_ns: at_ns.saturating_add(self.delay_ns) }
    }
}
