//! Which packets an attack is aimed at.

use std::ops::RangeInclusive;

use crate::random::{Chance, Stream};
use crate::settings::{LinkError, MAX_TIME_S, Target, nanoseconds, probability, within};
use crate::verdict::Packet;

/// A checked [`Target`].
///
/// The time that counts is that of sending, so that what the network adds to it changes no attack.
#[derive(Clone, Debug)]
pub(super) struct Aim {
    from_ns: u64,
    until_ns: u64,
    every: u64,
    bytes: RangeInclusive<usize>,
    chance: Chance,
    stream: Stream,
}

impl Aim {
    /// Checks the target found under a key.
    pub(super) fn new(key: &str, target: &Target, stream: Stream) -> Result<Self, LinkError> {
        let at = |name| format!("{key}.{name}");
        within(&at("from_s"), target.from_s, 0.0, MAX_TIME_S)?;
        if let Some(until_s) = target.until_s {
            within(&at("until_s"), until_s, 0.0, MAX_TIME_S)?;
            if until_s <= target.from_s {
                return Err(LinkError::contradiction(
                    at("until_s"),
                    format!("{until_s} is not after from_s = {}: no packet would be met", target.from_s),
                ));
            }
        }
        within(&at("every"), target.every as f64, 1.0, u64::MAX as f64)?;
        if let Some(most) = target.most_bytes
            && most < target.least_bytes
        {
            return Err(LinkError::contradiction(
                at("most_bytes"),
                format!("{most} is below least_bytes = {}: no packet would be met", target.least_bytes),
            ));
        }
        probability(&at("probability"), target.probability)?;
        Ok(Self {
            from_ns: nanoseconds(target.from_s),
            until_ns: target.until_s.map_or(u64::MAX, nanoseconds),
            every: target.every,
            bytes: target.least_bytes..=target.most_bytes.unwrap_or(usize::MAX),
            chance: Chance::new(target.probability),
            stream,
        })
    }

    /// Whether a packet is met.
    pub(super) fn takes(&self, packet: &Packet) -> bool {
        self.from_ns <= packet.sent_ns
            && packet.sent_ns < self.until_ns
            && packet.index.is_multiple_of(self.every)
            && self.bytes.contains(&packet.size)
            && self.chance.takes(self.stream.bits(packet.index))
    }
}
