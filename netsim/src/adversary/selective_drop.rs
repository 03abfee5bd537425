//! An attack that takes chosen packets, with the copies that the network made of them.

use crate::damage::Damage;
use crate::rule::{Ending, Extras};
use crate::verdict::{DropCause, ExtraCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
struct SelectiveDrop;

pub(super) fn build() -> Box<dyn Ending> {
    Box::new(SelectiveDrop)
}

impl Ending for SelectiveDrop {
    fn end(&mut self, _: &Packet, _: u64, _: &mut Damage, extras: &mut Extras) -> Verdict {
        // What the adversary recorded before stays in its hands: with a replay before it, a drop is a delay.
        extras.retain(|extra| extra.cause != ExtraCause::Duplicate);
        Verdict::Drop { cause: DropCause::Attack }
    }
}
