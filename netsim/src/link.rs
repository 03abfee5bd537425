//! One direction of the network: settings, and the rules they stand for in a fixed order.

use crate::damage::Damage;
use crate::rule::{BuildEnding, BuildRule, Ending, Extras, Rule, Streams};
use crate::settings::{LinkError, LinkSettings};
use crate::verdict::{Direction, Judgement, Packet, Verdict};
use crate::{bernoulli, delay, jitter, netem, order, rate, slots, timeline, trace};

/// What a packet meets on its way, in this order: what is lost takes no place in the bottleneck, what waits there
/// is delayed afterwards, and what was delayed is put in order.
const WAY: &[BuildRule] = &[
    bernoulli::build,
    trace::build_loss,
    rate::build,
    delay::build,
    timeline::build,
    slots::build,
    trace::build_delay,
    jitter::build,
    order::build,
];

/// What happens at the end of the way, in this order.
const ENDINGS: &[BuildEnding] = &[netem::build];

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
    /// What arrives beside the packets.
    pub extras: u64,
    /// Delivered packets that are due before one judged earlier, so each overtakes at least one. RFC 4737
    /// counts the other side, the packets that are overtaken, which is known only on arrival.
    pub overtaking: u64,
}

/// One direction of the network.
///
/// The verdict on a packet depends on settings, seed and the packets up to it alone; packets are judged in the order
/// of their indices, with sending times that do not decrease.
#[derive(Debug)]
pub struct Link {
    direction: Direction,
    seed: u64,
    way: Vec<Box<dyn Rule>>,
    endings: Vec<Box<dyn Ending>>,
    counters: LinkCounters,
    latest_due_ns: u64,
    extras: Extras,
}

impl Link {
    /// Builds the rules that the settings ask for: an impairment that is absent costs nothing.
    pub fn new(direction: Direction, seed: u64, settings: &LinkSettings) -> Result<Self, LinkError> {
        let streams = Streams { seed, direction };
        let mut way = Vec::new();
        for build in WAY {
            way.extend(build(settings, &streams)?);
        }
        let mut endings = Vec::new();
        for build in ENDINGS {
            endings.extend(build(settings, &streams)?);
        }
        Ok(Self {
            direction,
            seed,
            way,
            endings,
            counters: LinkCounters::default(),
            latest_due_ns: 0,
            extras: Extras::new(),
        })
    }

    /// Takes other settings for the packets from now on. Counters go on, and so do the draws; what a rule remembers
    /// of earlier packets, such as a queue, begins anew.
    pub fn change(&mut self, settings: &LinkSettings) -> Result<(), LinkError> {
        let Self { way, endings, .. } = Self::new(self.direction, self.seed, settings)?;
        self.way = way;
        self.endings = endings;
        Ok(())
    }

    /// Decides what becomes of a packet of this link's direction.
    pub fn judge(&mut self, packet: &Packet) -> Judgement<'_> {
        debug_assert_eq!(packet.direction, self.direction, "packet on the wrong link");
        let mut damage = Damage::NONE;
        self.extras.clear();
        let verdict = self.pass(packet, &mut damage);
        self.count(verdict);
        Judgement { verdict, damage, extras: &self.extras }
    }

    fn pass(&mut self, packet: &Packet, damage: &mut Damage) -> Verdict {
        let mut at_ns = packet.sent_ns;
        for rule in &mut self.way {
            match rule.judge(packet, at_ns) {
                Verdict::Deliver { at_ns: later } => at_ns = later,
                drop @ Verdict::Drop { .. } => return drop,
            }
        }
        for ending in &mut self.endings {
            match ending.end(packet, at_ns, damage, &mut self.extras) {
                Verdict::Deliver { at_ns: later } => at_ns = later,
                drop @ Verdict::Drop { .. } => return drop,
            }
        }
        Verdict::Deliver { at_ns }
    }

    fn count(&mut self, verdict: Verdict) {
        let counters = &mut self.counters;
        counters.sent += 1;
        counters.extras += self.extras.len() as u64;
        match verdict {
            Verdict::Drop { .. } => counters.dropped += 1,
            Verdict::Deliver { at_ns } => {
                counters.delivered += 1;
                counters.overtaking += u64::from(at_ns < self.latest_due_ns);
                self.latest_due_ns = self.latest_due_ns.max(at_ns);
            }
        }
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

impl LinkSettings {
    /// Checks every number and what goes together, by building the rules.
    pub fn validate(&self) -> Result<(), LinkError> {
        Link::new(Direction::Forward, 0, self).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_key_what_was_seen_and_what_is_allowed() {
        let perfect = LinkSettings::default();
        let cases = [
            (
                LinkSettings { delay_s: -0.1, ..perfect.clone() },
                "delay_s = -0.1: must be a finite number from 0 to 3600",
            ),
            (
                LinkSettings { delay_s: f64::INFINITY, ..perfect.clone() },
                "delay_s = inf: must be a finite number from 0 to 3600",
            ),
            (
                LinkSettings { jitter_s: f64::NAN, ..perfect.clone() },
                "jitter_s = NaN: must be a finite number from 0 to 3600",
            ),
            (LinkSettings { loss: 1.5, ..perfect }, "loss = 1.5: must be a finite number from 0 to 1"),
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
        assert_eq!(link.judge(&packet).verdict, Verdict::Deliver { at_ns: 42 });
        assert!(link.way.is_empty() && link.endings.is_empty());
    }
}
