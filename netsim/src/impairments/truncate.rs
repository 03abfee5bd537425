//! Truncation of packets. A packet and its copies are truncated independently.

use crate::checks::{LinkSettingsError, MAX_PAYLOAD, probability, within};
use crate::damage::Damage;
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::random::Event;
use crate::rule::{ArrivalRule, Extras};
use crate::verdict::Verdict;

#[derive(Clone, Copy, Debug)]
struct Truncate {
    cut: Event,
    bytes: usize,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError> {
    probability("truncate", settings.truncate)?;
    within("truncate_bytes", settings.truncate_bytes as f64, 0.0, MAX_PAYLOAD as f64)?;
    if settings.truncate == 0.0 {
        return Ok(None);
    }
    Ok(Some(Box::new(Truncate {
        cut: Event::new(settings.truncate, streams.of(Impairment::Truncate)),
        bytes: settings.truncate_bytes,
    })))
}

impl ArrivalRule for Truncate {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        if packet.size > self.bytes {
            let copies = extras.iter_mut().map(|extra| &mut extra.damage);
            self.cut.strike(packet.index, damage, copies, |damage, _| damage.cut_to(self.bytes));
        }
        Verdict::Deliver { at_ns }
    }
}
