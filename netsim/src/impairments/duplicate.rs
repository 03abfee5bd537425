//! Duplication: a packet arrives a second time.

use crate::checks::{LinkSettingsError, MAX_DELAY_S, nanoseconds, probability, within};
use crate::damage::Damage;
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::random::Event;
use crate::rule::{ArrivalRule, Extras, add_extra};
use crate::verdict::{ExtraCause, Verdict};

#[derive(Clone, Copy, Debug)]
struct Duplicate {
    doubled: Event,
    gap_ns: u64,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError> {
    probability("duplicate", settings.duplicate)?;
    within("duplicate_gap_s", settings.duplicate_gap_s, 0.0, MAX_DELAY_S)?;
    if settings.duplicate == 0.0 {
        return Ok(None);
    }
    Ok(Some(Box::new(Duplicate {
        doubled: Event::new(settings.duplicate, streams.of(Impairment::Duplicate)),
        gap_ns: nanoseconds(settings.duplicate_gap_s),
    })))
}

impl ArrivalRule for Duplicate {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        if self.doubled.occurs(packet.index) {
            let again_ns = at_ns.saturating_add(self.gap_ns);
            add_extra(extras, again_ns, ExtraCause::Duplicate, *damage);
        }
        Verdict::Deliver { at_ns }
    }
}
