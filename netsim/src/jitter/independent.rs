//! A delay drawn for each packet by itself.

use super::{Cells, shifted, whole};
use crate::law::gaussian;
use crate::random::Stream;
use crate::rule::Rule;
use crate::verdict::{Packet, Verdict};

#[derive(Debug)]
pub(super) struct Independent {
    cells: Cells,
    mean_ns: u64,
    stream: Stream,
}

impl Independent {
    pub(super) fn new(cells: Cells, mean_ns: u64, stream: Stream) -> Self {
        Self { cells, mean_ns, stream }
    }
}

impl Rule for Independent {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let z = gaussian::quantile(self.stream.unit(packet.index));
        let delay_ns = whole(self.cells.delay_ns(z));
        Verdict::Deliver { at_ns: shifted(at_ns, delay_ns, self.mean_ns, packet.sent_ns) }
    }
}
