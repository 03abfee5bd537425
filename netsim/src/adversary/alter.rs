//! An attack that changes numbers in a packet and repairs its checksum: what nothing but a key keeps out.
//!
//! Source: T. Bonaci et al., "To make a robot secure: an experimental analysis of cyber security threats against
//! teleoperated surgical robotics", arXiv 1504.04339, intent manipulation and hijacking.

use crate::alteration::{Alteration, MAX_EDITS, NUMBER_BYTES, offset};
use crate::damage::Damage;
use crate::rule::{Ending, Extras, add_extra};
use crate::settings::{Checksum, Edit, LinkError, MAX_PAYLOAD, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

/// Largest number that an edit names: what a unit slipped by a million still fits in.
const MAX_VALUE: f64 = 1e12;

#[derive(Clone, Copy, Debug)]
struct Alter {
    alteration: Alteration,
    inject: bool,
}

pub(super) fn build(
    key: &str,
    edits: &[Edit],
    checksum: Option<Checksum>,
    inject: bool,
) -> Result<Box<dyn Ending>, LinkError> {
    within(&format!("{key}.edits"), edits.len() as f64, 0.0, MAX_EDITS as f64)?;
    if edits.is_empty() && checksum.is_none() {
        return Err(LinkError::contradiction(
            format!("{key}.edits"),
            "is empty, and no checksum is put right: nothing would be altered",
        ));
    }
    let mut alteration = Alteration { checksum, ..Alteration::NONE };
    for (position, (slot, edit)) in alteration.edits.iter_mut().zip(edits).enumerate() {
        let key = format!("{key}.edits.{position}");
        let most = MAX_PAYLOAD - NUMBER_BYTES;
        within(&format!("{key}.offset"), offset(edit) as f64, 0.0, most as f64)?;
        if let Edit::F64 { value, .. } = *edit {
            within(&format!("{key}.value"), value, -MAX_VALUE, MAX_VALUE)?;
        }
        *slot = Some(*edit);
    }
    Ok(Box::new(Alter { alteration, inject }))
}

impl Ending for Alter {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // From a packet that is too short nothing is taken, and no copy is made.
        let size = packet.size.min(damage.truncates_to().unwrap_or(usize::MAX));
        if size >= self.alteration.least_bytes() {
            if self.inject {
                let damage = Damage { altered: self.alteration, ..*damage };
                add_extra(extras, at_ns, ExtraCause::Alter, damage);
            } else {
                let duplicates = extras.iter_mut().filter(|extra| extra.cause == ExtraCause::Duplicate);
                for damage in std::iter::once(damage).chain(duplicates.map(|extra| &mut extra.damage)) {
                    damage.altered = self.alteration;
                }
            }
        }
        Verdict::Deliver { at_ns }
    }
}
