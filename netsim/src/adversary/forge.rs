//! An attack that sends made-up bytes behind a genuine beginning.

use crate::damage::{Damage, bytes};
use crate::random::Stream;
use crate::rule::{Ending, Extras, add_extra};
use crate::settings::{LinkError, MAX_PAYLOAD, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct Forge {
    keep_bytes: usize,
    stream: Stream,
}

pub(super) fn build(key: &str, keep_bytes: usize, stream: Stream) -> Result<Box<dyn Ending>, LinkError> {
    within(&format!("{key}.keep_bytes"), keep_bytes as f64, 0.0, MAX_PAYLOAD as f64)?;
    Ok(Box::new(Forge { keep_bytes, stream }))
}

impl Ending for Forge {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        let forged = Some((bytes(self.keep_bytes), self.stream));
        let damage = Damage { forged, index: packet.index, ..*damage };
        add_extra(extras, at_ns, ExtraCause::Forge, damage);
        Verdict::Deliver { at_ns }
    }
}
