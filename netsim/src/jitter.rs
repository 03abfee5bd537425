//! Independent uniform jitter: arrival + u, u uniform on the integers of `[-w, w]` ns.

use crate::random::{Impairment, Stream};
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, LinkSettings, MAX_DELAY_S, nanoseconds, within};
use crate::verdict::{Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Jitter {
    half_width_ns: u64,
    stream: Stream,
}

pub(crate) fn build(settings: &LinkSettings, streams: &Streams) -> Result<Option<Box<dyn Rule>>, LinkError> {
    within("jitter_s", settings.jitter_s, 0.0, MAX_DELAY_S)?;
    let half_width_ns = nanoseconds(settings.jitter_s * 3_f64.sqrt());
    let stream = streams.of(Impairment::Jitter);
    Ok((half_width_ns > 0).then(|| Box::new(Jitter { half_width_ns, stream }) as Box<dyn Rule>))
}

impl Rule for Jitter {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let w = self.half_width_ns;
        let shift = self.stream.up_to(2 * w, packet.index);
        Verdict::Deliver { at_ns: at_ns.saturating_add(shift).saturating_sub(w).max(packet.sent_ns) }
    }
}
