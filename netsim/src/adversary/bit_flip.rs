//! An attack that flips bits at a chosen place, such as the header.

use crate::damage::{Damage, Flips, MAX_FLIPS, bytes};
use crate::random::Stream;
use crate::rule::{Ending, Extras};
use crate::settings::{ByteRange, LinkError, MAX_PAYLOAD, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct BitFlip(Flips);

pub(super) fn build(
    key: &str,
    bits: u32,
    range: ByteRange,
    stream: Stream,
) -> Result<Box<dyn Ending>, LinkError> {
    let ByteRange { start, end } = range;
    within(&format!("{key}.within.end"), end as f64, 0.0, MAX_PAYLOAD as f64)?;
    if start >= end {
        return Err(LinkError::contradiction(
            format!("{key}.within.start"),
            format!("{start} is not below end = {end}: there is no byte in between"),
        ));
    }
    let most = (8 * (end - start)).min(MAX_FLIPS as usize);
    within(&format!("{key}.bits"), f64::from(bits), 1.0, most as f64)?;
    Ok(Box::new(BitFlip(Flips { bits, start: bytes(start), end: bytes(end), stream })))
}

impl Ending for BitFlip {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // A packet that is too short has no such bytes.
        if packet.size > self.0.start as usize {
            let duplicates = extras.iter_mut().filter(|extra| extra.cause == ExtraCause::Duplicate);
            for damage in std::iter::once(damage).chain(duplicates.map(|extra| &mut extra.damage)) {
                damage.attacked = self.0;
                damage.index = packet.index;
            }
        }
        Verdict::Deliver { at_ns }
    }
}
