//! Truncation: a packet is cut short. A packet and each copy of it are cut independently.

use crate::damage::Damage;
use crate::random::{Chance, Impairment, Stream};
use crate::rule::{Ending, Extras, Streams};
use crate::settings::{LinkError, LinkSettings, MAX_PAYLOAD, probability, within};
use crate::verdict::{Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct Truncate {
    chance: Chance,
    bytes: usize,
    stream: Stream,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Ending>>, LinkError> {
    probability("truncate", settings.truncate)?;
    within("truncate_bytes", settings.truncate_bytes as f64, 0.0, MAX_PAYLOAD as f64)?;
    if settings.truncate == 0.0 {
        return Ok(None);
    }
    Ok(Some(Box::new(Truncate {
        chance: Chance::new(settings.truncate),
        bytes: settings.truncate_bytes,
        stream: streams.of(Impairment::Truncate),
    })))
}

impl Truncate {
    fn cut(&self, stream: Stream, index: u64, damage: &mut Damage) {
        if self.chance.takes(stream.bits(index)) {
            damage.cut_to(self.bytes);
        }
    }
}

impl Ending for Truncate {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // What is short already stays whole.
        if packet.size > self.bytes {
            self.cut(self.stream, packet.index, damage);
            for (position, extra) in (1..).zip(extras.iter_mut()) {
                self.cut(self.stream.nth(position), packet.index, &mut extra.damage);
            }
        }
        Verdict::Deliver { at_ns }
    }
}
