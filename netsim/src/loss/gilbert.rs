//! Gilbert loss: packets are lost in bursts of geometric length.
//!
//! Given the share L of lost packets and the mean burst B in packets, a packet after a lost one is lost with
//! probability `stay = 1 - 1/B`, one after a delivered one with `start = L / (1 - L) / B`.
//!
//! Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; the parameters are those of WebRTC, `SimulatedNetwork`
//! (`loss_percent`, `avg_burst_loss_length`).

use super::chain::Chain;
use crate::random::Impairment;
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, within};
use crate::verdict::{DropCause, Packet, Verdict};

/// Longest mean burst, in packets.
const MAX_BURST: f64 = 1e9;
/// By how much the probability that a burst starts may pass 1 because its terms were rounded.
const ROUNDING: f64 = 1e-12;

#[derive(Clone, Copy, Debug)]
pub(super) struct Gilbert {
    lost: Chain<2>,
}

impl Gilbert {
    /// `None` where bursts have no meaning, since nothing or everything is lost.
    pub(super) fn new(loss: f64, mean_burst: f64, streams: &Streams) -> Result<Option<Self>, LinkError> {
        within("mean_burst", mean_burst, 1.0, MAX_BURST)?;
        if loss == 0.0 || loss == 1.0 {
            return Ok(None);
        }
        let least = loss / (1.0 - loss);
        let start = least / mean_burst;
        if start > 1.0 + ROUNDING {
            return Err(LinkError::contradiction(
                "mean_burst",
                format!(
                    "{mean_burst} is too short for loss = {loss}: between two bursts at least one packet passes, so \
                     that they last at least {least} packets on average; lengthen them, or lower loss to at most {}",
                    mean_burst / (1.0 + mean_burst)
                ),
            ));
        }
        let start = start.min(1.0);
        let stay = 1.0 - 1.0 / mean_burst;
        let rows = [[1.0 - start, start], [1.0 - stay, stay]];
        Ok(Some(Self { lost: Chain::new([1.0 - loss, loss], rows, streams.of(Impairment::LossState)) }))
    }
}

impl Rule for Gilbert {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.lost.state(packet.index) == 1, DropCause::Loss, at_ns)
    }
}
