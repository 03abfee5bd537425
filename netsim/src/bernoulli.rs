//! Bernoulli loss: each packet is lost with probability p, whatever happened to the others.
//!
//!
use crate::random::{Chance, Impairment, Stream};
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, LinkSettings, probability};
use crate::verdict::{DropCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Bernoulli {
    chance: Chance,
    stream: Stream,
}

pub(crate) fn build(settings: &LinkSettings, streams: &Streams) -> Result<Option<Box<dyn Rule>>, LinkError> {
    probability("loss", settings.loss)?;
    if settings.loss == 0.0 {
        return Ok(None);
    }
    let chance = Chance::new(settings.loss);
    Ok(Some(Box::new(Bernoulli { chance, stream: streams.of(Impairment::Loss) })))
}

impl Rule for Bernoulli {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        if self.chance.takes(self.stream.bits(packet.index)) {
            Verdict::Drop { cause: DropCause::Loss }
        } else {
            Verdict::Deliver { at_ns }
        }
    }
}
