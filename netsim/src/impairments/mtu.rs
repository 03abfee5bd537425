//! MTU: larger packets are dropped, as with fragmentation forbidden.

use crate::checks::{LinkSettingsError, MAX_PAYLOAD, within};
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::rule::Rule;
use crate::verdict::{DropCause, Verdict};

#[derive(Clone, Copy, Debug)]
struct Mtu {
    max_bytes: usize,
}

pub(crate) fn build(
    settings: &LinkSettings,
    _: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let Some(max_bytes) = settings.mtu else { return Ok(None) };
    within("mtu", max_bytes as f64, 1.0, MAX_PAYLOAD as f64)?;
    Ok(Some(Box::new(Mtu { max_bytes })))
}

impl Rule for Mtu {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(packet.size > self.max_bytes, DropCause::Mtu, at_ns)
    }
}
