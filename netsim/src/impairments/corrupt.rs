//! Corruption: distinct random bits of the payload are flipped.
//!
//! A packet and its copies are corrupted independently.

use crate::checks::{LinkSettingsError, probability, within};
use crate::damage::{Damage, Flips, MAX_FLIPS};
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::random::Event;
use crate::rule::{ArrivalRule, Extras};
use crate::verdict::Verdict;

#[derive(Clone, Copy, Debug)]
struct Corrupt {
    corrupted: Event,
    bits: u32,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError> {
    probability("corrupt", settings.corrupt)?;
    within("corrupt_bits", f64::from(settings.corrupt_bits), 1.0, f64::from(MAX_FLIPS))?;
    if settings.corrupt == 0.0 {
        return Ok(None);
    }
    Ok(Some(Box::new(Corrupt {
        corrupted: Event::new(settings.corrupt, streams.of(Impairment::Corrupt)),
        bits: settings.corrupt_bits,
    })))
}

impl ArrivalRule for Corrupt {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // An empty packet has no bits to flip.
        if packet.size > 0 {
            let bits = self.bits;
            let copies = extras.iter_mut().map(|extra| &mut extra.damage);
            self.corrupted.strike(packet.index, damage, copies, |damage, stream| {
                damage.index = packet.index;
                damage.corrupted = Flips { bits, stream, ..Flips::NONE };
            });
        }
        Verdict::Deliver { at_ns }
    }
}
