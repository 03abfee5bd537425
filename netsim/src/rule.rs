//! The contract of an impairment.

use std::fmt::Debug;

use arrayvec::ArrayVec;
use dyn_clone::{DynClone, clone_trait_object};

use crate::damage::Damage;
use crate::packet::Packet;
use crate::verdict::{Extra, ExtraCause, Verdict};

/// Impairment on the path of a packet.
///
/// A link applies its rules in order. Each rule gets the arrival time set by the rules before it, and moves
/// or drops the packet; a drop is final. A rule may keep state over the packets it has seen. It draws only
/// from its own stream, by packet index or time bin, so adding or removing a rule shifts no draw of another.
pub(crate) trait Rule: Debug + DynClone + Send {
    /// Decides on a packet that would arrive at `at_ns`, which is never before it was sent.
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict;

    /// Decides on several packets in order, skipping those already dropped.
    fn judge_all(&mut self, packets: &[Packet], verdicts: &mut [Verdict]) {
        for (packet, verdict) in packets.iter().zip(verdicts) {
            if let Verdict::Deliver { at_ns } = *verdict {
                *verdict = self.judge(packet, at_ns);
            }
        }
    }
}

/// Maximum number of extras per packet.
pub(crate) const MAX_EXTRAS: usize = 8;

pub(crate) type Extras = ArrayVec<Extra, MAX_EXTRAS>;

pub(crate) fn add_extra(extras: &mut Extras, at_ns: u64, cause: ExtraCause, damage: Damage) {
    // Never full: building rejects settings that could add more than `MAX_EXTRAS`.
    let _ = extras.try_push(Extra { at_ns, cause, damage });
}

/// Impairment on arrival: corrupts, duplicates or attacks a packet.
pub(crate) trait ArrivalRule: Debug + DynClone + Send {
    /// Decides on a packet that arrives at `at_ns`, and edits its damage and its extras.
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict;
}

// A cloned link continues with the state of its rules.
clone_trait_object!(Rule);
clone_trait_object!(ArrivalRule);
