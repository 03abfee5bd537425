//! Bounds that follow from the settings alone: how long a packet is under way, and when the last change is over.

use crate::law::DelayLaw;
use crate::rate::DEFAULT_QUEUE_PACKETS;
use crate::settings::{Action, Distribution, LinkSettings, MAX_PAYLOAD, Outage, OutageEffect, OutageTimes};

/// Standard deviations that a normal law stays within, with a probability of 1 - 1e-22.
const NORMAL_TAIL: f64 = 10.0;

/// The same of an exponential law, and of a normal one that is cut off near its mean: 1 - 1e-17.
const EXPONENTIAL_TAIL: f64 = 40.0;

impl LinkSettings {
    /// Time in s that no packet is under way for longer, nor a copy of it; infinite where nothing bounds it, as of a
    /// heavy-tailed law or a recorded line.
    pub fn longest_delay_s(&self) -> f64 {
        if self.netem.is_some() {
            return f64::INFINITY;
        }
        let attacks = self.attacks.iter().map(|attack| match attack.action {
            Action::Replay { after_s } => after_s,
            _ => 0.0,
        });
        self.own_delay_s()
            + self.waiting_s()
            + self.outages.iter().map(held_s).sum::<f64>()
            + self.reorder_hold_s.unwrap_or(0.0)
            + self.duplicate_gap_s
            + attacks.fold(0.0, f64::max)
    }

    /// Time in s since the link began after which nothing that is scheduled happens any more; infinite where something
    /// comes again and again.
    pub fn last_change_s(&self) -> f64 {
        let outages = self.outages.iter().map(|outage| match outage.times {
            OutageTimes::Once { at_s, duration_s } => at_s + duration_s,
            OutageTimes::Periodic { .. } | OutageTimes::Random { .. } => f64::INFINITY,
        });
        let attacks = self.attacks.iter().map(|attack| attack.target.until_s.unwrap_or(f64::INFINITY));
        let trace = self.trace.iter().map(|trace| match trace.time_s.last() {
            Some(last) if !trace.repeat => *last,
            _ => f64::INFINITY,
        });
        let endless = self.slots.is_some() || self.opportunities.is_some() || self.netem.is_some();
        self.timeline
            .iter()
            .map(|change| change.at_s + change.ramp_s)
            .chain(outages)
            .chain(attacks)
            .chain(trace)
            .chain(endless.then_some(f64::INFINITY))
            .fold(0.0, f64::max)
    }

    /// What the delay itself may come to.
    fn own_delay_s(&self) -> f64 {
        let scripted = self.timeline.iter().map(|change| change.delay_s);
        let recorded =
            self.trace.iter().flat_map(|trace| &trace.delay_s).copied().map(|delay_s| delay_s.unwrap_or(0.0));
        let mean = scripted.chain(recorded).fold(self.delay_s, f64::max);
        let slots = self.slots.map_or(0.0, |slots| {
            let spikes = slots.spike_delay_s > 0.0 && slots.start_spike_s + slots.end_spike_s > 0.0;
            NORMAL_TAIL * slots.level_s + if spikes { EXPONENTIAL_TAIL * slots.spike_delay_s } else { 0.0 }
        });
        if self.jitter_s == 0.0 {
            return mean + slots;
        }
        let deviations = match &self.distribution {
            Distribution::Normal if self.jitter_s <= self.delay_s / 4.0 => NORMAL_TAIL,
            Distribution::Normal | Distribution::Exponential => EXPONENTIAL_TAIL,
            // A uniform law of deviation 1 reaches to the root of 3.
            Distribution::Uniform => 1.74,
            Distribution::Table(_) => DelayLaw::new(self)
                .map_or(f64::INFINITY, |law| 1.001 * (law.quantile_s(1.0) - law.mean_s()) / law.sigma_s()),
            Distribution::Gamma | Distribution::Lognormal | Distribution::Pareto => f64::INFINITY,
        };
        mean + deviations * self.jitter_s + slots
    }

    /// What the bottleneck may add: the longest wait, and the packet itself on the wire.
    fn waiting_s(&self) -> f64 {
        if self.opportunities.is_some() {
            return f64::INFINITY;
        }
        let Some(rate_bps) = self.rate_bps else {
            return 0.0;
        };
        let packet_s = (MAX_PAYLOAD + self.overhead_bytes) as f64 * 8.0 / rate_bps;
        let bounds = [
            self.queue_ms.map(|wait_ms| wait_ms * 1e-3),
            self.queue_bytes.map(|bytes| bytes as f64 * 8.0 / rate_bps),
            self.queue_packets.map(|packets| packets as f64 * packet_s),
        ];
        let given = bounds.into_iter().flatten().reduce(f64::min);
        given.unwrap_or(DEFAULT_QUEUE_PACKETS as f64 * packet_s) + packet_s
    }
}

/// How long an outage holds a packet.
fn held_s(outage: &Outage) -> f64 {
    match (outage.effect, outage.times) {
        (OutageEffect::Drop, _) => 0.0,
        (
            OutageEffect::Hold,
            OutageTimes::Once { duration_s, .. } | OutageTimes::Periodic { duration_s, .. },
        ) => duration_s,
        (OutageEffect::Hold, OutageTimes::Random { mean_down_s, .. }) => EXPONENTIAL_TAIL * mean_down_s,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{Attack, DelayChange, DelayTrace, Slots, Target};

    fn close(seen: f64, expected: f64) -> bool {
        seen == expected || (seen - expected).abs() < 1e-12
    }

    #[test]
    fn the_longest_delay_is_the_sum_of_what_may_come_together() {
        let delayed = LinkSettings { delay_s: 0.05, ..LinkSettings::default() };
        let once = OutageTimes::Once { at_s: 1.0, duration_s: 0.5 };
        let random = OutageTimes::Random { mean_up_s: 1.0, mean_down_s: 0.1 };
        let cases = [
            (LinkSettings::default(), 0.0),
            (delayed.clone(), 0.05),
            (LinkSettings { jitter_s: 0.01, ..delayed.clone() }, 0.15),
            (LinkSettings { jitter_s: 0.04, ..delayed.clone() }, 1.65),
            (LinkSettings { jitter_s: 0.01, distribution: Distribution::Uniform, ..delayed.clone() }, 0.0674),
            (
                LinkSettings {
                    jitter_s: 0.01,
                    // Half at each end, half spread between: a variance of 2/3.
                    distribution: Distribution::Table(vec![-1, 1]),
                    ..delayed.clone()
                },
                0.05 + 0.01 * 1.001 * 1.5_f64.sqrt(),
            ),
            (
                LinkSettings { jitter_s: 0.01, distribution: Distribution::Pareto, ..delayed.clone() },
                f64::INFINITY,
            ),
            (LinkSettings { rate_bps: Some(8.0 * 65_563.0), ..delayed.clone() }, 1001.05),
            (
                LinkSettings { rate_bps: Some(8.0 * 65_563.0), queue_ms: Some(20.0), ..delayed.clone() },
                0.05 + 0.02 + 1.0,
            ),
            (
                LinkSettings {
                    outages: vec![Outage { times: once, effect: OutageEffect::Hold }],
                    ..delayed.clone()
                },
                0.55,
            ),
            (
                LinkSettings {
                    outages: vec![Outage { times: random, effect: OutageEffect::Drop }],
                    ..delayed.clone()
                },
                0.05,
            ),
            (
                LinkSettings {
                    outages: vec![Outage { times: random, effect: OutageEffect::Hold }],
                    ..delayed.clone()
                },
                4.05,
            ),
            (
                LinkSettings {
                    timeline: vec![DelayChange { at_s: 1.0, delay_s: 0.2, ramp_s: 0.0 }],
                    duplicate_gap_s: 0.1,
                    attacks: vec![Attack {
                        action: Action::Replay { after_s: 3.0 },
                        target: Target::default(),
                    }],
                    ..delayed
                },
                3.3,
            ),
        ];
        for (settings, expected) in cases {
            assert!(close(settings.longest_delay_s(), expected), "{settings:?}");
        }
    }

    #[test]
    fn the_last_change_is_that_of_the_latest_schedule() {
        let perfect = LinkSettings::default();
        let once = OutageTimes::Once { at_s: 1.0, duration_s: 0.5 };
        let periodic = OutageTimes::Periodic { at_s: 1.0, period_s: 2.0, duration_s: 0.5 };
        let recorded = |repeat| DelayTrace {
            time_s: vec![0.0, 7.0],
            delay_s: vec![Some(0.1), None],
            interpolate: true,
            repeat,
        };
        let slots = Slots {
            period_s: 15.0,
            start_spike_s: 0.0,
            end_spike_s: 0.0,
            spike_delay_s: 0.0,
            level_s: 0.0,
            spike_loss: 0.0,
        };
        let drop_until =
            |until_s| Attack { action: Action::Drop, target: Target { until_s, ..Target::default() } };
        let cases = [
            (LinkSettings { delay_s: 1.0, jitter_s: 0.1, loss: 0.5, ..perfect.clone() }, 0.0),
            (
                LinkSettings {
                    timeline: vec![DelayChange { at_s: 1.0, delay_s: 0.2, ramp_s: 3.0 }],
                    outages: vec![Outage { times: once, effect: OutageEffect::Drop }],
                    ..perfect.clone()
                },
                4.0,
            ),
            (
                LinkSettings {
                    outages: vec![Outage { times: periodic, effect: OutageEffect::Drop }],
                    ..perfect.clone()
                },
                f64::INFINITY,
            ),
            (LinkSettings { trace: Some(recorded(false)), ..perfect.clone() }, 7.0),
            (LinkSettings { trace: Some(recorded(true)), ..perfect.clone() }, f64::INFINITY),
            (LinkSettings { slots: Some(slots), ..perfect.clone() }, f64::INFINITY),
            (LinkSettings { attacks: vec![drop_until(Some(2.0))], ..perfect.clone() }, 2.0),
            (LinkSettings { attacks: vec![drop_until(None)], ..perfect }, f64::INFINITY),
        ];
        for (settings, expected) in cases {
            assert!(close(settings.last_change_s(), expected), "{settings:?}");
        }
    }
}
