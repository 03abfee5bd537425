//! An attack that sends a copy whose sequence is ahead, so that what is genuine would look old.

use crate::damage::{Damage, bytes};
use crate::rule::{Ending, Extras, add_extra};
use crate::settings::{LinkError, MAX_PAYLOAD, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

/// Bytes of a sequence.
const SEQUENCE_BYTES: usize = 8;

#[derive(Clone, Copy, Debug)]
struct SequenceLead {
    lead: u64,
    offset: usize,
}

pub(super) fn build(key: &str, lead: u64, offset: usize) -> Result<Box<dyn Ending>, LinkError> {
    within(&format!("{key}.lead"), lead as f64, 1.0, u64::MAX as f64)?;
    within(&format!("{key}.offset"), offset as f64, 0.0, (MAX_PAYLOAD - SEQUENCE_BYTES) as f64)?;
    Ok(Box::new(SequenceLead { lead, offset }))
}

impl Ending for SequenceLead {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // A packet that is too short has no sequence to change.
        if packet.size >= self.offset + SEQUENCE_BYTES {
            let damage = Damage { lead: Some((bytes(self.offset), self.lead)), ..*damage };
            add_extra(extras, at_ns, ExtraCause::SequenceLead, damage);
        }
        Verdict::Deliver { at_ns }
    }
}
