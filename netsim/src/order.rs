//! Order: a packet arrives no earlier than those sent before it, as through a queue that is served in turn.
//!
//! With delays that are correlated in time it hardly ever acts; it is what makes the order certain.

use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, LinkSettings};
use crate::verdict::{Packet, Verdict};

#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Order {
    latest_ns: u64,
}

#[allow(clippy::unnecessary_wraps)] // as all rules are built
pub(crate) fn build(settings: &LinkSettings, _: &Streams) -> Result<Option<Box<dyn Rule>>, LinkError> {
    // A constant delay keeps the order by itself.
    let varies = settings.jitter_s > 0.0
        || !settings.timeline.is_empty()
        || settings.slots.is_some()
        || settings.trace.is_some()
        || !settings.outages.is_empty();
    Ok((settings.keep_order && varies).then(|| Box::new(Order::default()) as Box<dyn Rule>))
}

impl Rule for Order {
    fn judge(&mut self, _: &Packet, at_ns: u64) -> Verdict {
        self.latest_ns = self.latest_ns.max(at_ns);
        Verdict::Deliver { at_ns: self.latest_ns }
    }
}
