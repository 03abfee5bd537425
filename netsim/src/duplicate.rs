//! Duplication: a packet arrives a second time.

use crate::damage::Damage;
use crate::random::{Chance, Impairment, Stream};
use crate::rule::{Ending, Extras, Streams, add_extra};
use crate::settings::{LinkError, LinkSettings, MAX_DELAY_S, nanoseconds, probability, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct Duplicate {
    chance: Chance,
    gap_ns: u64,
    stream: Stream,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Ending>>, LinkError> {
    probability("duplicate", settings.duplicate)?;
    within("duplicate_gap_s", settings.duplicate_gap_s, 0.0, MAX_DELAY_S)?;
    if settings.duplicate == 0.0 {
        return Ok(None);
    }
    Ok(Some(Box::new(Duplicate {
        chance: Chance::new(settings.duplicate),
        gap_ns: nanoseconds(settings.duplicate_gap_s),
        stream: streams.of(Impairment::Duplicate),
    })))
}

impl Ending for Duplicate {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        if self.chance.takes(self.stream.bits(packet.index)) {
            let again_ns = at_ns.saturating_add(self.gap_ns);
            add_extra(extras, again_ns, ExtraCause::Duplicate, *damage);
        }
        Verdict::Deliver { at_ns }
    }
}
