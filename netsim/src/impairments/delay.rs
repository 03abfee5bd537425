//! Constant delay: arrival = sent + d. A timeline replaces it if the delay changes.

use crate::checks::{LinkSettingsError, MAX_DELAY_S, nanoseconds, within};
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::rule::Rule;
use crate::verdict::Verdict;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Delay {
    delay_ns: u64,
}

pub(crate) fn build(
    settings: &LinkSettings,
    _: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    within("delay_s", settings.delay_s, 0.0, MAX_DELAY_S)?;
    let delay_ns = nanoseconds(settings.delay_s);
    let constant = settings.timeline.is_empty();
    Ok((constant && delay_ns > 0).then(|| Box::new(Delay { delay_ns }) as Box<dyn Rule>))
}

impl Rule for Delay {
    fn judge(&mut self, _packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::Deliver { at_ns: at_ns.saturating_add(self.delay_ns) }
    }
}
