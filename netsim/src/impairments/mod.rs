//! Impairments of a link: list, order and settings.
//!
//! Each impairment is one file with its equation, settings and rule. This file lists its module, its position
//! in the order, its keys in [`LinkSettings`], the ids of its random streams, and its longest delay.

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

/// Rules on the path, in this order. Lost packets take no place in the bottleneck; packets leaving the
/// bottleneck are then delayed. After these rules the link enforces order, and then applies reordering.
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

/// Rule that lets a packet overtake others, applied after the link enforces order.
pub(crate) const REORDER_RULE: BuildRule = reorder::build;

/// Rules on arrival, in this order.
pub(crate) const ARRIVAL_RULES: &[BuildArrivalRule] =
    &[netem::build, duplicate::build, corrupt::build, truncate::build, adversary::build];

/// Impairments of one direction. The default is a perfect network.
///
/// Absent or zero keys build no rule. The rules run in the order of their keys here.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LinkSettings {
    /// Largest payload in bytes that passes; a larger one is dropped with the cause `mtu`.
    pub mtu: Option<usize>,

    /// Probability that a packet is lost, 0 to 1. Without a mean burst, losses are independent.
    pub loss: f64,
    /// Mean number of packets lost together, at least 1 (Gilbert).
    pub mean_burst: Option<f64>,
    /// Mean burst as a time in s: the chain runs in time, not by packets.
    pub mean_burst_s: Option<f64>,
    /// Gilbert-Elliott, instead of `loss`.
    pub gilbert_elliott: Option<GilbertElliott>,
    /// Four-state Markov loss, instead of `loss`.
    pub four_state: Option<FourState>,
    /// Times at which nothing passes.
    pub outages: Vec<Outage>,

    /// Rate of the bottleneck in bit/s. Packets wait in its queue and take their transmission time.
    pub rate_bps: Option<f64>,
    /// Header bytes per packet on the wire, added to its payload: 28 for IPv4 and UDP.
    pub overhead_bytes: usize,
    /// Times at which the bottleneck may send, instead of `rate_bps` (mahimahi).
    pub opportunities: Option<Opportunities>,
    /// Maximum queue length in packets; 1000 if no bound is given. The packet in transmission does not count.
    pub queue_packets: Option<usize>,
    /// Maximum queue length in bytes, headers included.
    pub queue_bytes: Option<usize>,
    /// Maximum wait in ms.
    pub queue_ms: Option<f64>,
    /// Queue discipline.
    pub discipline: Discipline,
    /// Other traffic through the same bottleneck.
    pub cross_traffic: Option<CrossTraffic>,

    /// Mean one-way delay in s, from 0 to [`MAX_DELAY_S`], excluding the bottleneck.
    pub delay_s: f64,
    /// Standard deviation of the delay in s.
    pub jitter_s: f64,
    /// Distribution of the delay around its mean.
    pub distribution: Distribution,
    /// Shape parameter of the Pareto and gamma distributions.
    pub distribution_shape: Option<f64>,
    /// Correlation time tau of the delay in s, by default 0.1: its autocorrelation is `exp(-t / tau)`. With
    /// `keep_order` tau is at least four times `jitter_s`, the shortest that the order permits. Without
    /// `keep_order`, 0 makes packets independent.
    pub jitter_correlation_s: Option<f64>,
    /// Changes of the mean delay at given times.
    pub timeline: Vec<DelayChange>,
    /// Scheduling slots with spikes at their ends, as of satellites.
    pub slots: Option<Slots>,
    /// Recorded delays and losses, which replace `delay_s`.
    pub trace: Option<DelayTrace>,
    /// Keeps packets in sending order, apart from `reorder`.
    pub keep_order: bool,

    /// Probability that a packet is reordered.
    pub reorder: f64,
    /// Number of packets that a reordered packet overtakes, from 1 to 1024: those under way at its sending
    /// with the latest arrivals.
    pub reorder_depth: usize,
    /// Alternative to `reorder_depth`: time in s that a reordered packet is held while later ones pass.
    pub reorder_hold_s: Option<f64>,

    /// Probability that a packet arrives twice.
    pub duplicate: f64,
    /// Delay in s between the first and the second arrival.
    pub duplicate_gap_s: f64,
    /// Probability that bits of a packet are flipped.
    pub corrupt: f64,
    /// Number of flipped bits.
    pub corrupt_bits: u32,
    /// Probability that a packet is truncated.
    pub truncate: f64,
    /// Length in bytes after truncation.
    pub truncate_bytes: usize,

    /// Actions of an attacker on the path.
    pub attacks: Vec<Attack>,
    /// Arguments of `tc netem`, reproduced with its quirks; excludes all other keys.
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

/// Use of a random stream.
///
/// The ids are part of recorded results: a new impairment takes a new id, an old one keeps its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub(crate) enum Impairment {
    Loss = 1,
    /// Delay by packet index.
    Jitter = 2,
    /// Delay by time bin.
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

#[derive(Clone, Copy, Debug)]
pub(crate) struct Streams {
    pub(crate) seed: u64,
    pub(crate) direction: Direction,
}

impl Streams {
    pub(crate) fn of(&self, impairment: Impairment) -> Stream {
        Stream::new(self.seed, self.direction, impairment as u16)
    }
}

/// Builds the rule of the settings; `None` if they describe none.
pub(crate) type BuildRule = fn(&LinkSettings, &Streams) -> Result<Option<Box<dyn Rule>>, LinkSettingsError>;

pub(crate) type BuildArrivalRule =
    fn(&LinkSettings, &Streams) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError>;

/// Bound of a normal distribution in standard deviations, exceeded with a probability of 1e-22.
const NORMAL_TAIL: f64 = 10.0;

/// Same for an exponential distribution, and for a normal one truncated near its mean: 1e-17.
const EXPONENTIAL_TAIL: f64 = 40.0;

impl LinkSettings {
    /// Upper bound in s on the time a packet or its copy is under way. Infinite if unbounded, as for a
    /// heavy-tailed distribution or a recorded line.
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

    /// Time in s since the link began of the last scheduled change; infinite if changes recur.
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

    /// Test if a packet can still be under way when the next one is sent.
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

    /// Upper bound of the delay itself.
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
            // A uniform distribution of standard deviation 1 ends at sqrt(3).
            Distribution::Uniform => 1.74,
            Distribution::Table(_) => DelayLaw::new(self)
                .map_or(f64::INFINITY, |law| 1.001 * (law.quantile_s(1.0) - law.mean_s()) / law.sigma_s()),
            Distribution::Gamma | Distribution::Lognormal | Distribution::Pareto => f64::INFINITY,
        };
        mean + deviations * self.jitter_s + slots
    }

    /// Upper bound of the bottleneck: maximum wait plus the packet's own transmission.
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

/// Maximum time an outage holds a packet.
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
    fn longest_delay_is_the_sum_of_all_upper_bounds() {
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
                    // Half the mass at the ends, half spread between: a variance of 2/3.
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
