//! Gilbert loss in time: the channel is bad for exponentially distributed times, and what is sent then is lost.
//!
//! Given the share L of the time that is bad and its mean length B in s, good times last `B (1 - L) / L` on
//! average. Unlike [`gilbert`](super::gilbert), what is lost does not depend on how often packets are sent.

use crate::on_off::{MAX_MEAN_S, MIN_GAP_S, OnOff};
use crate::random::Impairment;
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, within};
use crate::verdict::{DropCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(super) struct GilbertInTime {
    good: OnOff,
}

impl GilbertInTime {
    /// `None` where bursts have no meaning, since nothing or everything is lost.
    pub(super) fn new(loss: f64, mean_burst_s: f64, streams: &Streams) -> Result<Option<Self>, LinkError> {
        within("mean_burst_s", mean_burst_s, MIN_GAP_S, MAX_MEAN_S)?;
        if loss == 0.0 || loss == 1.0 {
            return Ok(None);
        }
        let mean_gap_s = mean_burst_s * (1.0 - loss);
        if mean_gap_s < MIN_GAP_S {
            return Err(LinkError::contradiction(
                "mean_burst_s",
                format!(
                    "{mean_burst_s} is too short for loss = {loss}: give at least {}, so that the times between \
                     bursts can be told apart",
                    MIN_GAP_S / (1.0 - loss)
                ),
            ));
        }
        Ok(Some(Self { good: OnOff::new(mean_gap_s, loss, streams.of(Impairment::LossState)) }))
    }
}

impl Rule for GilbertInTime {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.good.is_off(packet.sent_ns), DropCause::Loss, at_ns)
    }
}
