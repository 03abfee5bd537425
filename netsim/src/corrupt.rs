//! Corruption: bits of a packet are flipped, all different, anywhere in its payload.
//!
//! A packet and each copy of it are corrupted independently.

use crate::damage::{Damage, Flips, MOST_FLIPS};
use crate::random::{Chance, Impairment, Stream};
use crate::rule::{Ending, Extras, Streams};
use crate::settings::{LinkError, LinkSettings, probability, within};
use crate::verdict::{Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct Corrupt {
    chance: Chance,
    bits: u32,
    stream: Stream,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Ending>>, LinkError> {
    probability("corrupt", settings.corrupt)?;
    within("corrupt_bits", f64::from(settings.corrupt_bits), 1.0, f64::from(MOST_FLIPS))?;
    if settings.corrupt == 0.0 {
        return Ok(None);
    }
    Ok(Some(Box::new(Corrupt {
        chance: Chance::new(settings.corrupt),
        bits: settings.corrupt_bits,
        stream: streams.of(Impairment::Corrupt),
    })))
}

impl Corrupt {
    fn flip(&self, stream: Stream, index: u64, damage: &mut Damage) {
        if self.chance.takes(stream.bits(index)) {
            damage.index = index;
            damage.corrupted = Flips { bits: self.bits, stream, ..Flips::NONE };
        }
    }
}

impl Ending for Corrupt {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // There is no bit to flip in an empty packet.
        if packet.size > 0 {
            self.flip(self.stream, packet.index, damage);
            for (position, extra) in (1..).zip(extras.iter_mut()) {
                self.flip(self.stream.nth(position), packet.index, &mut extra.damage);
            }
        }
        Verdict::Deliver { at_ns }
    }
}
