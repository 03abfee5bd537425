//! An attack that holds chosen packets back, with the copies that the network made of them.
//!
//! Packets that are not met pass those that are: aimed at each n-th packet, it reorders.

use crate::damage::Damage;
use crate::rule::{Ending, Extras};
use crate::settings::{LinkError, MAX_DELAY_S, nanoseconds, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct HoldBack {
    by_ns: u64,
}

pub(super) fn build(key: &str, by_s: f64) -> Result<Box<dyn Ending>, LinkError> {
    within(&format!("{key}.by_s"), by_s, 0.0, MAX_DELAY_S)?;
    Ok(Box::new(HoldBack { by_ns: nanoseconds(by_s) }))
}

impl Ending for HoldBack {
    fn end(&mut self, _: &Packet, at_ns: u64, _: &mut Damage, extras: &mut Extras) -> Verdict {
        for extra in extras.iter_mut().filter(|extra| extra.cause == ExtraCause::Duplicate) {
            extra.at_ns = extra.at_ns.saturating_add(self.by_ns);
        }
        Verdict::Deliver { at_ns: at_ns.saturating_add(self.by_ns) }
    }
}
