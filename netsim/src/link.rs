//! One direction of the network: settings, and the rules they stand for in a fixed order.

use crate::delay::Delay;
use crate::jitter::Jitter;
use crate::loss::Loss;
use crate::random::{Impairment, Stream};
use crate::rule::Rule;
use crate::verdict::{Direction, Packet, Verdict};

/// Longest delay a link accepts, in s; Mars is within it, a slip of units is not.
pub const MAX_DELAY_S: f64 = 3600.0;

/// What the network does to the packets of one direction. The default is a perfect network.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkSettings {
    /// Constant one-way delay in s, from 0 to [`MAX_DELAY_S`].
    pub delay_s: f64,
    /// Half-width of uniform jitter around the delay in s, from 0 to `delay_s`. Drawn per packet, so packets
    /// overtake.
    pub jitter_s: f64,
    /// Probability that a packet is lost, from 0 to 1.
    pub loss: f64,
}

impl LinkSettings {
    /// Checks that every number is finite and in range.
    pub fn validate(&self) -> Result<(), LinkError> {
        let ranges = [
            ("delay_s", self.delay_s, MAX_DELAY_S),
            ("jitter_s", self.jitter_s, MAX_DELAY_S),
            ("loss", self.loss, 1.0),
        ];
        for (key, seen, maximum) in ranges {
            // NaN lies in no range, so one test covers it, infinity and the sign.
            if !(0.0..=maximum).contains(&seen) {
                return Err(LinkError::OutOfRange { key, seen, maximum });
            }
        }
        if self.jitter_s > self.delay_s {
            return Err(LinkError::JitterAboveDelay { jitter_s: self.jitter_s, delay_s: self.delay_s });
        }
        Ok(())
    }
}

/// Settings that describe no link.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// A number is not finite or not in its range.
    #[error("{key} = {seen}: must be a finite number from 0 to {maximum}")]
    OutOfRange {
        /// Name of the setting.
        key: &'static str,
        /// Its value.
        seen: f64,
        /// The largest value allowed.
        maximum: f64,
    },
    /// The jitter would deliver packets before they are sent.
    #[error(
        "jitter_s = {jitter_s}: must be at most delay_s = {delay_s}, or packets would arrive before they are sent"
    )]
    JitterAboveDelay {
        /// Half-width asked for, in s.
        jitter_s: f64,
        /// Delay asked for, in s.
        delay_s: f64,
    },
}

/// What a link has decided so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct LinkCounters {
    /// Packets judged.
    pub sent: u64,
    /// Packets dropped.
    pub dropped: u64,
    /// Packets to be delivered.
    pub delivered: u64,
    /// Delivered packets that are due before one judged earlier, so each overtakes at least one. RFC 4737
    /// counts the other side, the packets that are overtaken, which is known only on arrival.
    pub overtaking: u64,
}

/// One direction of the network.
///
/// The verdict on a packet depends on settings, seed and packet alone; packets are judged in the order of
/// their indices.
#[derive(Debug)]
pub struct Link {
    direction: Direction,
    rules: Vec<Box<dyn Rule>>,
    counters: LinkCounters,
    latest_due_ns: u64,
}

impl Link {
    /// Builds the rules that the settings ask for: an impairment of zero costs nothing.
    pub fn new(direction: Direction, seed: u64, settings: &LinkSettings) -> Result<Self, LinkError> {
        settings.validate()?;
        let stream = |impairment| Stream::new(seed, direction, impairment);
        let mut rules: Vec<Box<dyn Rule>> = Vec::new();
        // Loss first: a lost packet needs no arrival. Jitter after delay: it is centred on it.
        if settings.loss > 0.0 {
            rules.push(Box::new(Loss::new(settings.loss, stream(Impairment::Loss))));
        }
        if settings.delay_s > 0.0 {
            rules.push(Box::new(Delay::new(nanoseconds(settings.delay_s))));
        }
        if settings.jitter_s > 0.0 {
            let half_width_ns = nanoseconds(settings.jitter_s);
            rules.push(Box::new(Jitter::new(half_width_ns, stream(Impairment::Jitter))));
        }
        Ok(Self { direction, rules, counters: LinkCounters::default(), latest_due_ns: 0 })
    }

    /// Decides what becomes of a packet of this link's direction.
    pub fn judge(&mut self, packet: &Packet) -> Verdict {
        debug_assert_eq!(packet.direction, self.direction, "packet on the wrong link");
        self.counters.sent += 1;
        let mut due_ns = packet.sent_ns;
        for rule in &mut self.rules {
            match rule.judge(packet, due_ns) {
                Verdict::Deliver { at_ns } => due_ns = at_ns,
                drop @ Verdict::Drop { .. } => {
                    self.counters.dropped += 1;
                    return drop;
                }
            }
        }
        self.counters.delivered += 1;
        if due_ns < self.latest_due_ns {
            self.counters.overtaking += 1;
        }
        self.latest_due_ns = self.latest_due_ns.max(due_ns);
        Verdict::Deliver { at_ns: due_ns }
    }

    /// The direction this link carries.
    pub fn direction(&self) -> Direction {
        self.direction
    }

    /// What was decided so far.
    pub fn counters(&self) -> LinkCounters {
        self.counters
    }
}

/// Rounds a validated duration to ns. Multiplication and rounding are exact in IEEE 754, hence alike
/// everywhere.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "0 <= seconds <= MAX_DELAY_S, far below 2^64 ns"
)]
fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_key_what_was_seen_and_what_is_allowed() {
        let perfect = LinkSettings::default();
        let cases = [
            (
                LinkSettings { delay_s: -0.1, ..perfect },
                "delay_s = -0.1: must be a finite number from 0 to 3600",
            ),
            (
                LinkSettings { delay_s: f64::INFINITY, ..perfect },
                "delay_s = inf: must be a finite number from 0 to 3600",
            ),
            (
                LinkSettings { jitter_s: f64::NAN, ..perfect },
                "jitter_s = NaN: must be a finite number from 0 to 3600",
            ),
            (LinkSettings { loss: 1.5, ..perfect }, "loss = 1.5: must be a finite number from 0 to 1"),
            (
                LinkSettings { delay_s: 0.01, jitter_s: 0.02, ..perfect },
                "jitter_s = 0.02: must be at most delay_s = 0.01, or packets would arrive before they are sent",
            ),
        ];
        for (settings, message) in cases {
            let error = Link::new(Direction::Forward, 0, &settings).unwrap_err();
            assert_eq!(error.to_string(), message);
        }
    }

    #[test]
    fn a_perfect_link_delivers_at_once() {
        let mut link = Link::new(Direction::Backward, 0, &LinkSettings::default()).unwrap();
        let packet = Packet { direction: Direction::Backward, sent_ns: 42, size: 64, index: 0 };
        assert_eq!(link.judge(&packet), Verdict::Deliver { at_ns: 42 });
        assert!(link.rules.is_empty());
    }
}
