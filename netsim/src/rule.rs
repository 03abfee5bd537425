//! The contract of an impairment.

use std::fmt::Debug;

use crate::verdict::{Packet, Verdict};

/// One impairment of one direction.
///
/// A link applies its rules in order: each is handed the arrival that the rules before it settled, and moves
/// it or drops the packet, which ends the matter. A rule may keep state over the packets it has seen, but
/// draws only from its own stream, at the packet's index; so a rule that comes or goes shifts no draw of
/// another.
pub(crate) trait Rule: Debug + Send {
    /// Decides on a packet that would arrive at `at_ns`.
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict;
}
