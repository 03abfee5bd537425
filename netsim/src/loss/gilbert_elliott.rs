//! Gilbert-Elliott loss: a good and a bad state, each with its own probability of loss.
//!
//! With p the probability of turning bad and r that of turning good, the share of lost packets is
//! `(r (1 - k) + p (1 - h)) / (p + r)`.
//!
//! Source: E. O. Elliott, Bell Syst. Tech. J. 42, 1963.

use super::chain::Chain;
use crate::random::{Chance, Impairment, Stream};
use crate::rule::{Rule, Streams};
use crate::settings::{GilbertElliott, LinkError, probability};
use crate::verdict::{DropCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(super) struct GilbertElliottLoss {
    /// 0 good, 1 bad.
    state: Chain<2>,
    loss: [Chance; 2],
    stream: Stream,
}

impl GilbertElliottLoss {
    pub(super) fn new(settings: &GilbertElliott, streams: &Streams) -> Result<Self, LinkError> {
        let &GilbertElliott { to_bad, to_good, loss_good, loss_bad } = settings;
        probability("gilbert_elliott.to_bad", to_bad)?;
        probability("gilbert_elliott.to_good", to_good)?;
        probability("gilbert_elliott.loss_good", loss_good)?;
        probability("gilbert_elliott.loss_bad", loss_bad)?;
        let turns = to_bad + to_good;
        if turns == 0.0 {
            return Err(LinkError::contradiction(
                "gilbert_elliott.to_good",
                "is 0, and so is to_bad: no state is ever left, so that nothing says in which the link is; \
                 give `loss` instead",
            ));
        }
        let rows = [[1.0 - to_bad, to_bad], [to_good, 1.0 - to_good]];
        let stationary = [to_good / turns, to_bad / turns];
        Ok(Self {
            state: Chain::new(stationary, rows, streams.of(Impairment::LossState)),
            loss: [Chance::new(loss_good), Chance::new(loss_bad)],
            stream: streams.of(Impairment::Loss),
        })
    }
}

impl Rule for GilbertElliottLoss {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let chance = self.loss[self.state.state(packet.index)];
        Verdict::unless(chance.takes(self.stream.bits(packet.index)), DropCause::Loss, at_ns)
    }
}
