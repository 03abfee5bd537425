//! One direction of the network: settings and the rules built from them, in a fixed order.

use crate::checks::LinkSettingsError;
use crate::damage::Damage;
use crate::impairments::{ARRIVAL_RULES, LinkSettings, PATH_RULES, REORDER_RULE, Streams};
use crate::rule::{ArrivalRule, Extras, Rule};

use crate::packet::{Direction, Packet};
use crate::verdict::{Judgement, Verdict};

/// Counters of a link's verdicts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct LinkCounters {
    /// Packets judged.
    pub sent: u64,
    /// Packets dropped.
    pub dropped: u64,
    /// Packets to be delivered.
    pub delivered: u64,
    /// Additional packets.
    pub extras: u64,
    /// Delivered packets due before an earlier one: each overtakes at least one packet. RFC 4737 counts the
    /// overtaken packets instead, which are known only on arrival.
    pub overtaking: u64,
}

/// Checked rules built from settings, ready for a link to adopt.
#[derive(Clone, Debug)]
pub struct Rules {
    direction: Direction,
    path: Vec<Box<dyn Rule>>,
    /// Applied after order is enforced.
    reorder: Option<Box<dyn Rule>>,
    on_arrival: Vec<Box<dyn ArrivalRule>>,
    keeps_order: bool,
}

impl Rules {
    /// Build the rules of the settings; an absent impairment costs nothing.
    pub fn build(
        direction: Direction,
        seed: u64,
        settings: &LinkSettings,
    ) -> Result<Self, LinkSettingsError> {
        let streams = Streams { seed, direction };
        let mut path = Vec::new();
        for build in PATH_RULES {
            path.extend(build(settings, &streams)?);
        }
        let mut on_arrival = Vec::new();
        for build in ARRIVAL_RULES {
            on_arrival.extend(build(settings, &streams)?);
        }
        let reorder = REORDER_RULE(settings, &streams)?;
        Ok(Self {
            direction,
            path,
            reorder,
            on_arrival,
            keeps_order: settings.keep_order && settings.netem.is_none(),
        })
    }

    #[cfg(test)]
    pub(crate) fn with_arrival_rule(mut self, rule: impl ArrivalRule + 'static) -> Self {
        self.on_arrival.push(Box::new(rule));
        self
    }
}

/// One direction of the network.
///
/// A verdict depends only on settings, seed and the packets so far. Packets are judged in index order, with
/// sending times that do not decrease.
#[derive(Clone, Debug)]
pub struct Link {
    seed: u64,
    rules: Rules,
    counters: LinkCounters,
    latest_due_ns: u64,
    /// Latest arrival, before reordering and the rules on arrival. If order is kept, no later packet arrives
    /// earlier.
    latest_in_turn_ns: u64,
    /// Damage and extras of the latest packet, if there are rules on arrival.
    damage: Damage,
    extras: Extras,
}

impl Link {
    /// Build a link from settings.
    pub fn new(direction: Direction, seed: u64, settings: &LinkSettings) -> Result<Self, LinkSettingsError> {
        Ok(Self {
            seed,
            rules: Rules::build(direction, seed, settings)?,
            counters: LinkCounters::default(),
            latest_due_ns: 0,
            latest_in_turn_ns: 0,
            damage: Damage::NONE,
            extras: Extras::new(),
        })
    }

    /// Apply new settings to later packets; see [`swap`](Self::swap).
    pub fn change(&mut self, settings: &LinkSettings) -> Result<(), LinkSettingsError> {
        let mut rules = Rules::build(self.rules.direction, self.seed, settings)?;
        self.swap(&mut rules);
        Ok(())
    }

    /// Apply new rules to later packets. Returns the old rules in `rules`, so that nothing is freed here.
    ///
    /// Counters continue. Draws continue for the same seed, but the state of a rule, such as a queue,
    /// restarts. If the new rules keep order, no packet overtakes an earlier one; packets delayed by `netem`,
    /// which keeps no order, are an exception.
    pub fn swap(&mut self, rules: &mut Rules) {
        debug_assert_eq!(rules.direction, self.rules.direction, "rules of the other direction");
        std::mem::swap(&mut self.rules, rules);
    }

    /// Decides on a packet of this link's direction.
    #[inline]
    pub fn judge(&mut self, packet: &Packet) -> Judgement<'_> {
        debug_assert_eq!(packet.direction, self.rules.direction, "packet on the wrong link");
        let verdict = self.travel(packet);
        if !self.rules.on_arrival.is_empty() {
            return self.arrive(packet, verdict);
        }
        self.count(verdict, 0);
        Judgement { verdict, damage: &Damage::NONE, extras: &[] }
    }

    /// Decides on packets in order, as [`judge`](Self::judge) does, and writes the result to `verdicts`.
    ///
    /// Requires a link that does not [change packets](Self::changes_packets). Works rule by rule, so that the
    /// code of each is fetched once per batch.
    ///
    /// # Panics
    ///
    /// If the link changes packets: a list of verdicts has no place for extras.
    pub fn judge_all(&mut self, packets: &[Packet], verdicts: &mut Vec<Verdict>) {
        assert!(!self.changes_packets(), "a link that changes packets judges them one by one");
        debug_assert!(
            packets.iter().all(|packet| packet.direction == self.rules.direction),
            "packet on the wrong link"
        );
        verdicts.clear();
        verdicts.extend(packets.iter().map(|packet| Verdict::Deliver { at_ns: packet.sent_ns }));
        for rule in &mut self.rules.path {
            rule.judge_all(packets, verdicts);
        }
        for (packet, verdict) in packets.iter().zip(verdicts) {
            if let Verdict::Deliver { at_ns } = verdict {
                *at_ns = self.in_order(*at_ns);
                if let Some(reorder) = &mut self.rules.reorder {
                    *verdict = reorder.judge(packet, *at_ns);
                }
            }
            self.count(*verdict, 0);
        }
    }

    /// Decides on a packet up to its arrival.
    fn travel(&mut self, packet: &Packet) -> Verdict {
        let mut at_ns = packet.sent_ns;
        for rule in &mut self.rules.path {
            match rule.judge(packet, at_ns) {
                Verdict::Deliver { at_ns: later } => at_ns = later,
                drop @ Verdict::Drop { .. } => return drop,
            }
        }
        let at_ns = self.in_order(at_ns);
        match &mut self.rules.reorder {
            Some(reorder) => reorder.judge(packet, at_ns),
            None => Verdict::Deliver { at_ns },
        }
    }

    /// Arrival no earlier than that of previous packets, if order is kept.
    #[inline]
    fn in_order(&mut self, at_ns: u64) -> u64 {
        self.latest_in_turn_ns = self.latest_in_turn_ns.max(at_ns);
        if self.rules.keeps_order { self.latest_in_turn_ns } else { at_ns }
    }

    fn arrive(&mut self, packet: &Packet, mut verdict: Verdict) -> Judgement<'_> {
        self.damage = Damage::NONE;
        self.extras.clear();
        for rule in &mut self.rules.on_arrival {
            let Verdict::Deliver { at_ns } = verdict else { break };
            verdict = rule.end(packet, at_ns, &mut self.damage, &mut self.extras);
        }
        self.count(verdict, self.extras.len());
        Judgement { verdict, damage: &self.damage, extras: &self.extras }
    }

    fn count(&mut self, verdict: Verdict, extras: usize) {
        let counters = &mut self.counters;
        counters.sent += 1;
        counters.extras += extras as u64;
        match verdict {
            Verdict::Drop { .. } => counters.dropped += 1,
            Verdict::Deliver { at_ns } => {
                counters.delivered += 1;
                counters.overtaking += u64::from(at_ns < self.latest_due_ns);
                self.latest_due_ns = self.latest_due_ns.max(at_ns);
            }
        }
    }

    /// Direction of the link.
    pub fn direction(&self) -> Direction {
        self.rules.direction
    }

    /// Lower bound on the arrival of all later packets, in ns since the link began. 0 if order is not kept or
    /// extra packets may arrive.
    pub fn earliest_later_ns(&self) -> u64 {
        let Rules { reorder, on_arrival, keeps_order, .. } = &self.rules;
        if *keeps_order && reorder.is_none() && on_arrival.is_empty() { self.latest_in_turn_ns } else { 0 }
    }

    /// Test if packets may arrive changed, or with extra packets.
    pub fn changes_packets(&self) -> bool {
        !self.rules.on_arrival.is_empty()
    }

    /// Counters so far.
    pub fn counters(&self) -> LinkCounters {
        self.counters
    }
}

impl LinkSettings {
    /// Check all values and combinations by building the rules.
    pub fn validate(&self) -> Result<(), LinkSettingsError> {
        Rules::build(Direction::Forward, 0, self).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_names_key_value_and_range() {
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
        assert!(
            link.rules.path.is_empty() && link.rules.reorder.is_none() && link.rules.on_arrival.is_empty()
        );
    }

    #[test]
    fn a_change_holds_for_later_packets_and_keeps_the_order() {
        let slow = LinkSettings { delay_s: 0.05, ..LinkSettings::default() };
        let fast = LinkSettings { delay_s: 0.01, ..LinkSettings::default() };
        let free = LinkSettings { keep_order: false, ..fast.clone() };
        for (changed, expected_ms) in [(&fast, [50, 52, 52, 61]), (&free, [50, 52, 13, 61])] {
            let mut link = Link::new(Direction::Forward, 0, &slow).unwrap();
            let mut dues_ms = Vec::new();
            for (index, sent_ms) in [0, 2, 3, 51].into_iter().enumerate() {
                if index == 2 {
                    assert!(link.change(&LinkSettings { loss: 2.0, ..fast.clone() }).is_err());
                    link.change(changed).unwrap();
                }
                let sent_ns = sent_ms * 1_000_000;
                let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index: index as u64 };
                let Verdict::Deliver { at_ns } = link.judge(&packet).verdict else { panic!("lost") };
                dues_ms.push(at_ns / 1_000_000);
            }
            assert_eq!(dues_ms, expected_ms);
            assert_eq!(link.counters().sent, 4);
        }
    }
}
