//! Attacks that send what they saw once more: later, back to its sender, or from another address.

use crate::damage::Damage;
use crate::rule::{Ending, Extras, add_extra};
use crate::settings::{LinkError, MAX_DELAY_S, nanoseconds, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct Copying {
    after_ns: u64,
    cause: ExtraCause,
}

/// A replay some time after the packet arrived.
pub(super) fn replay(key: &str, after_s: f64) -> Result<Box<dyn Ending>, LinkError> {
    within(&format!("{key}.after_s"), after_s, 0.0, MAX_DELAY_S)?;
    Ok(Box::new(Copying { after_ns: nanoseconds(after_s), cause: ExtraCause::Replay }))
}

/// A copy at the time the packet arrives.
pub(super) fn at_once(cause: ExtraCause) -> Box<dyn Ending> {
    Box::new(Copying { after_ns: 0, cause })
}

impl Ending for Copying {
    fn end(&mut self, _: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        add_extra(extras, at_ns.saturating_add(self.after_ns), self.cause, *damage);
        Verdict::Deliver { at_ns }
    }
}
