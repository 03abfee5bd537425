//! The contract of an impairment.

use std::fmt::Debug;

use arrayvec::ArrayVec;
use dyn_clone::{DynClone, clone_trait_object};

use crate::damage::Damage;
use crate::packet::Packet;
use crate::verdict::{Extra, ExtraCause, Verdict};

/// What happens to a packet on its path.
///
/// A link applies its rules in order: each is handed the arrival that the rules before it settled, and moves it
/// or drops the packet, which ends the matter. A rule may keep state over the packets it has seen, but draws only
/// from its own stream, at the packet's index or a bin of time; so a rule that comes or goes shifts no draw of
/// another.
pub(crate) trait Rule: Debug + DynClone + Send {
    /// Decides on a packet that would arrive at `at_ns`, which is never before it was sent.
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict;

    /// Decides on several in turn, of each as far as the rules before have let it come: one call for all of them.
    fn judge_all(&mut self, packets: &[Packet], verdicts: &mut [Verdict]) {
        for (packet, verdict) in packets.iter().zip(verdicts) {
            if let Verdict::Deliver { at_ns } = *verdict {
                *verdict = self.judge(packet, at_ns);
            }
        }
    }
}

/// Most that arrives beside one packet.
pub(crate) const MAX_EXTRAS: usize = 8;

/// What arrives beside a packet.
pub(crate) type Extras = ArrayVec<Extra, MAX_EXTRAS>;

/// Lets something more arrive beside a packet.
pub(crate) fn add_extra(extras: &mut Extras, at_ns: u64, cause: ExtraCause, damage: Damage) {
    // There is room: rules that could add more are refused when they are built.
    let _ = extras.try_push(Extra { at_ns, cause, damage });
}

/// What happens to a packet on arrival: its bytes change, it is copied, an attacker takes it.
pub(crate) trait ArrivalRule: Debug + DynClone + Send {
    /// Changes what becomes of a packet that arrives at `at_ns`, and of what arrives beside it.
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict;
}

// A link that is copied goes on as the first, with the state of its rules.
clone_trait_object!(Rule);
clone_trait_object!(ArrivalRule);
