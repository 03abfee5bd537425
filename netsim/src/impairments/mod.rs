//! The impairments of a link: which there are, in which order a packet meets them, and their settings.
//!
//! An impairment is one file: its equation, its settings and its rule. What is listed here beside it: its module, its
//! place in the order, its keys in [`LinkSettings`], the numbers of its random draws, and the longest delay it adds.

mod adversary;
mod corrupt;
mod delay;
mod duplicate;
mod jitter;
pub(crate) mod law;
mod loss;
mod mtu;
pub mod netem;
mod outage;
pub(crate) mod rate;
mod reorder;
mod slots;
mod timeline;
mod trace;
mod truncate;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::checks::{LinkSettingsError, MAX_PAYLOAD};
use crate::packet::Direction;
use crate::random::Stream;
use crate::rule::{ArrivalRule, Rule};

pub use adversary::{Action, Attack, ByteRange, Target};
pub use law::{DelayLaw, Distribution};
pub use loss::{FourState, GilbertElliott};
pub use outage::{Outage, OutageEffect, OutageTimes};
pub use rate::{CrossTraffic, Discipline, Opportunities};
pub use slots::Slots;
pub use timeline::DelayChange;
pub use trace::{
    DelayTrace, IrttDelay, IrttRecording, ParseError, parse_delay_csv, parse_dist, parse_irtt, parse_mahimahi,
};

/// What a packet meets on its path, in this order: what is lost takes no place in the bottleneck, and what waits there
/// is delayed afterwards. Then the link keeps the order, and reordering comes after that.
pub(crate) const PATH_RULES: &[BuildRule] = &[
    mtu::build,
    loss::build,
    outage::build_dropping,
    trace::build_loss,
    rate::build,
    delay::build,
    timeline::build,
    slots::build,
    trace::build_delay,
    jitter::build,
    outage::build_holding,
];

/// What lets a packet overtake others, after the link has kept the order.
pub(crate) const REORDER_RULE: BuildRule = reorder::build;

/// What happens to a packet on arrival, in this order.
pub(crate) const ARRIVAL_RULES: &[BuildArrivalRule] =
    &[netem::build, duplicate::build, corrupt::build, truncate::build, adversary::build];

/// What the network does to the packets of one direction. The default is a perfect network.
///
/// What is absent or zero is a rule that is not built. The rules of a link run in the order in which their keys
/// stand here: what a packet meets first comes first.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LinkSettings {
    /// Largest payload in bytes that passes; a larger one is dropped with the cause `mtu`.
    pub mtu: Option<usize>,

    /// Probability that a packet is lost, 0 to 1. Without a mean burst, packets are lost independently.
    pub loss: f64,
    /// Mean number of packets lost together, at least 1 (Gilbert).
    pub mean_burst: Option<f64>,
    /// The same as a time in s: the chain runs in time, not by packets.
    pub mean_burst_s: Option<f64>,
    /// Gilbert-Elliott, instead of `loss`.
    pub gilbert_elliott: Option<GilbertElliott>,
    /// Four-state Markov loss, instead of `loss`.
    pub four_state: Option<FourState>,
    /// Times at which nothing passes.
    pub outages: Vec<Outage>,

    /// Rate of the bottleneck in bit/s; packets wait in its queue and take their time on the wire.
    pub rate_bps: Option<f64>,
    /// Bytes of headers that each packet takes on the wire beside its payload: 28 of IPv4 and UDP.
    pub overhead_bytes: usize,
    /// Times at which the bottleneck may send, instead of `rate_bps` (mahimahi).
    pub opportunities: Option<Opportunities>,
    /// Most packets that wait; 1000 if none of the three bounds is given. What is on the line does not wait.
    pub queue_packets: Option<usize>,
    /// Most bytes that wait, headers included.
    pub queue_bytes: Option<usize>,
    /// Longest wait in ms.
    pub queue_ms: Option<f64>,
    /// What a queue that fills does.
    pub discipline: Discipline,
    /// Other traffic through the same bottleneck.
    pub cross_traffic: Option<CrossTraffic>,

    /// Mean one-way delay in s, from 0 to [`MAX_DELAY_S`], beside what the bottleneck takes.
    pub delay_s: f64,
    /// Standard deviation of the delay in s.
    pub jitter_s: f64,
    /// Law of the delay around its mean.
    pub distribution: Distribution,
    /// Shape of the law where it has one to choose: that of Pareto and of gamma.
    pub distribution_shape: Option<f64>,
    /// Time in s over which the delay forgets itself, by default 0.1: its autocorrelation is `exp(-t / tau)`. With
    /// `keep_order` it is at least four times `jitter_s`, as short as the order permits; 0 without it is independent
    /// from packet to packet.
    pub jitter_correlation_s: Option<f64>,
    /// Changes of the mean delay at given times.
    pub timeline: Vec<DelayChange>,
    /// Scheduling slots with spikes at their ends, as of satellites.
    pub slots: Option<Slots>,
    /// Recorded delays and losses, which take the place of `delay_s`.
    pub trace: Option<DelayTrace>,
    /// Whether packets arrive in the order in which they were sent, apart from `reorder`.
    pub keep_order: bool,

    /// Probability that a packet is reordered.
    pub reorder: f64,
    /// How many packets a reordered packet overtakes, from 1 to 1024: those that would arrive last of the packets
    /// under way when it is sent.
    pub reorder_depth: usize,
    /// Instead: how long in s a reordered packet is held while later ones pass.
    pub reorder_hold_s: Option<f64>,

    /// Probability that a packet arrives twice.
    pub duplicate: f64,
    /// How long in s after the first the second arrives.
    pub duplicate_gap_s: f64,
    /// Probability that bits of a packet are flipped.
    pub corrupt: f64,
    /// How many bits.
    pub corrupt_bits: u32,
    /// Probability that a packet is cut short.
    pub truncate: f64,
    /// To how many bytes.
    pub truncate_bytes: usize,

    /// What somebody on the path does.
    pub attacks: Vec<Attack>,
    /// Arguments of `tc netem`, reproduced with its quirks; nothing else may be given beside it.
    pub netem: Option<String>,
}

impl Default for LinkSettings {
    fn default() -> Self {
        Self {
            mtu: None,
            loss: 0.0,
            mean_burst: None,
            mean_burst_s: None,
            gilbert_elliott: None,
            four_state: None,
            outages: Vec::new(),
            rate_bps: None,
            overhead_bytes: 28,
            opportunities: None,
            queue_packets: None,
            queue_bytes: None,
            queue_ms: None,
            discipline: Discipline::TailDrop,
            cross_traffic: None,
            delay_s: 0.0,
            jitter_s: 0.0,
            distribution: Distribution::Normal,
            distribution_shape: None,
            jitter_correlation_s: None,
            timeline: Vec::new(),
            slots: None,
            trace: None,
            keep_order: true,
            reorder: 0.0,
            reorder_depth: 1,
            reorder_hold_s: None,
            duplicate: 0.0,
            duplicate_gap_s: 0.0,
            corrupt: 0.0,
            corrupt_bits: 1,
            truncate: 0.0,
            truncate_bytes: 0,
            attacks: Vec::new(),
            netem: None,
        }
    }
}

/// What a stream of draws is used for.
///
/// The numbers are part of the recorded results: a new impairment takes a new number, an old one keeps its
/// own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub(crate) enum Impairment {
    Loss = 1,
    /// Delay by packet index.
    Jitter = 2,
    /// Delay by bin of time.
    Wander = 3,
    /// State of a Markov chain of losses.
    LossState = 4,
    Outage = 5,
    CrossTraffic = 6,
    Reorder = 7,
    Duplicate = 8,
    Corrupt = 9,
    Truncate = 10,
    Slots = 11,
    Attack = 12,
    Netem = 13,
}

/// Where a rule takes its randomness from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Streams {
    pub(crate) seed: u64,
    pub(crate) direction: Direction,
}

impl Streams {
    /// The draws of one impairment.
    pub(crate) fn of(&self, impairment: Impairment) -> Stream {
        Stream::new(self.seed, self.direction, impairment as u16)
    }
}

/// Builds the rule that the settings describe, if they do, or reports what is wrong with them.
pub(crate) type BuildRule = fn(&LinkSettings, &Streams) -> Result<Option<Box<dyn Rule>>, LinkSettingsError>;

/// As [`BuildRule`].
pub(crate) type BuildArrivalRule =
    fn(&LinkSettings, &Streams) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError>;

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
        let trace = self.trace.iter().map(|trace| match trace.time_s.as_slice() {
            [first, .., last] if !trace.repeat => last - first,
            [_] => 0.0,
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

    /// Whether a packet can be under way at all when the next is sent.
    fn delays(&self) -> bool {
        self.delay_s > 0.0
            || self.jitter_s > 0.0
            || self.rate_bps.is_some()
            || self.opportunities.is_some()
            || !self.timeline.is_empty()
            || self.slots.is_some()
            || self.trace.is_some()
            || self.outages.iter().any(|outage| outage.effect == OutageEffect::Hold)
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
        given.unwrap_or(rate::DEFAULT_QUEUE_PACKETS as f64 * packet_s) + packet_s
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
