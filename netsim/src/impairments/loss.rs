//! Packet loss. A link has at most one loss model.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Impairment, LinkSettings, Streams};
use crate::checks::{LinkSettingsError, probability, within};
use crate::on_off::{MAX_MEAN_S, MIN_GAP_S, OnOff};
use crate::packet::Packet;
use crate::random::{Chance, Event, InTurn, Stream};
use crate::rule::Rule;
use crate::verdict::{DropCause, Verdict};

/// Gilbert-Elliott: two states, each with its own loss probability.
///
/// Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; E. O. Elliott, Bell Syst. Tech. J. 42, 1963.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GilbertElliott {
    /// p: probability of good to bad, per packet.
    pub to_bad: f64,
    /// r: probability of bad to good, per packet.
    pub to_good: f64,
    /// 1 - k: loss probability in the good state.
    #[serde(default)]
    pub loss_good: f64,
    /// 1 - h: loss probability in the bad state.
    #[serde(default = "one")]
    pub loss_bad: f64,
}

/// Four states: 1 good, 2 good within a burst, 3 lost within a burst, 4 lost alone. `pij` leads from i to j.
///
/// Source: S. Salsano, F. Ludovici, A. Ordine, D. Giannuzzi, "Definition of a general and intuitive loss
/// model for packet networks and its implementation in the Netem module in the Linux kernel", 2012 (GI
/// model).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FourState {
    /// A burst begins.
    pub p13: f64,
    /// A burst ends.
    pub p31: f64,
    /// Packets pass within a burst.
    #[serde(default)]
    pub p32: f64,
    /// Losses resume within a burst.
    #[serde(default = "one")]
    pub p23: f64,
    /// A packet is lost alone.
    #[serde(default)]
    pub p14: f64,
}

fn one() -> f64 {
    1.0
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let loss = settings.loss;
    probability("loss", loss)?;
    refuse_two_models(settings)?;
    if let Some(model) = &settings.gilbert_elliott {
        return Ok(Some(Box::new(GilbertElliottLoss::new(model, streams)?)));
    }
    if let Some(model) = &settings.four_state {
        return Ok(Some(Box::new(FourStateLoss::new(model, streams)?)));
    }
    let bursts: Option<Box<dyn Rule>> = match (settings.mean_burst, settings.mean_burst_s) {
        (Some(mean_burst), _) => Gilbert::new(loss, mean_burst, streams)?.map(|rule| Box::new(rule) as _),
        (_, Some(mean_burst_s)) => {
            GilbertInTime::new(loss, mean_burst_s, streams)?.map(|rule| Box::new(rule) as _)
        }
        (None, None) => None,
    };
    if bursts.is_some() || loss == 0.0 {
        return Ok(bursts);
    }
    Ok(Some(Box::new(Bernoulli::new(loss, streams.of(Impairment::Loss)))))
}

/// Reject two loss models; the error names the first two.
fn refuse_two_models(settings: &LinkSettings) -> Result<(), LinkSettingsError> {
    let models = [
        ("gilbert_elliott", settings.gilbert_elliott.is_some()),
        ("four_state", settings.four_state.is_some()),
        ("mean_burst", settings.mean_burst.is_some()),
        ("mean_burst_s", settings.mean_burst_s.is_some()),
        // With a mean burst, `loss` is a parameter; without one it is a model.
        ("loss", settings.loss > 0.0 && settings.mean_burst.is_none() && settings.mean_burst_s.is_none()),
    ];
    let mut given = models.iter().filter_map(|&(key, given)| given.then_some(key));
    match (given.next(), given.next()) {
        (Some(first), Some(second)) => Err(LinkSettingsError::contradiction(
            first,
            format!("is a model of loss, and so is {second}: give one of them"),
        )),
        _ => Ok(()),
    }
}

/// Bernoulli loss: each packet is lost with probability p, independently.
#[derive(Clone, Copy, Debug)]
struct Bernoulli {
    chance: Chance,
    draws: InTurn,
}

impl Bernoulli {
    fn new(probability: f64, stream: Stream) -> Self {
        Self { chance: Chance::new(probability), draws: InTurn::new(stream) }
    }
}

impl Rule for Bernoulli {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.chance.takes(self.draws.bits(packet.index)), DropCause::Loss, at_ns)
    }
}

/// Maximum mean burst, in packets.
const MAX_BURST: f64 = 1e9;
/// Tolerance for rounding of the burst start probability above 1.
const ROUNDING: f64 = 1e-12;

/// Gilbert loss: packets are lost in bursts of geometric length.
///
/// Let L be the fraction of lost packets and B the mean burst in packets. After a lost packet the loss
/// probability is `stay = 1 - 1/B`, after a delivered one `start = L / (1 - L) / B`.
///
/// Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; the parameters are those of WebRTC,
/// `SimulatedNetwork` (`loss_percent`, `avg_burst_loss_length`).
#[derive(Clone, Copy, Debug)]
struct Gilbert {
    lost: MarkovChain<2>,
}

impl Gilbert {
    /// Return `None` if nothing or everything is lost, where bursts have no meaning.
    fn new(loss: f64, mean_burst: f64, streams: &Streams) -> Result<Option<Self>, LinkSettingsError> {
        within("mean_burst", mean_burst, 1.0, MAX_BURST)?;
        if loss == 0.0 || loss == 1.0 {
            return Ok(None);
        }
        let min_burst = loss / (1.0 - loss);
        let start = min_burst / mean_burst;
        if start > 1.0 + ROUNDING {
            return Err(LinkSettingsError::contradiction(
                "mean_burst",
                format!(
                    "{mean_burst} is too short for loss = {loss}: between two bursts at least one packet passes, so \
                     that they last at least {min_burst} packets on average; lengthen them, or lower loss to at most {}",
                    mean_burst / (1.0 + mean_burst)
                ),
            ));
        }
        let start = start.min(1.0);
        let stay = 1.0 - 1.0 / mean_burst;
        let rows = [[1.0 - start, start], [1.0 - stay, stay]];
        Ok(Some(Self { lost: MarkovChain::new([1.0 - loss, loss], rows, streams.of(Impairment::LossState)) }))
    }
}

impl Rule for Gilbert {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.lost.state(packet.index) == 1, DropCause::Loss, at_ns)
    }
}

/// Gilbert loss in time: the channel is bad for exponentially distributed times and loses all packets sent
/// then.
///
/// Let L be the fraction of bad time and B its mean length in s; good times last `B (1 - L) / L` on average.
/// Unlike [`Gilbert`], the loss times do not depend on the packet rate.
#[derive(Clone, Copy, Debug)]
struct GilbertInTime {
    good: OnOff,
}

impl GilbertInTime {
    /// Return `None` if nothing or everything is lost, where bursts have no meaning.
    fn new(loss: f64, mean_burst_s: f64, streams: &Streams) -> Result<Option<Self>, LinkSettingsError> {
        within("mean_burst_s", mean_burst_s, MIN_GAP_S, MAX_MEAN_S)?;
        if loss == 0.0 || loss == 1.0 {
            return Ok(None);
        }
        let mean_gap_s = mean_burst_s * (1.0 - loss);
        if mean_gap_s < MIN_GAP_S {
            return Err(LinkSettingsError::contradiction(
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

/// Gilbert-Elliott loss: a good and a bad state, each with its own loss probability.
///
/// Let p be the probability of good to bad and r that of bad to good. The fraction of lost packets is
/// `(r (1 - k) + p (1 - h)) / (p + r)`.
///
/// Source: E. O. Elliott, Bell Syst. Tech. J. 42, 1963.
#[derive(Clone, Copy, Debug)]
struct GilbertElliottLoss {
    /// 0 good, 1 bad.
    state: MarkovChain<2>,
    loss: [Event; 2],
}

impl GilbertElliottLoss {
    fn new(settings: &GilbertElliott, streams: &Streams) -> Result<Self, LinkSettingsError> {
        let &GilbertElliott { to_bad, to_good, loss_good, loss_bad } = settings;
        probability("gilbert_elliott.to_bad", to_bad)?;
        probability("gilbert_elliott.to_good", to_good)?;
        probability("gilbert_elliott.loss_good", loss_good)?;
        probability("gilbert_elliott.loss_bad", loss_bad)?;
        let changes = to_bad + to_good;
        if changes == 0.0 {
            return Err(LinkSettingsError::contradiction(
                "gilbert_elliott.to_good",
                "is 0, and so is to_bad: no state is ever left, so that nothing says in which the link is; \
                 give `loss` instead",
            ));
        }
        let rows = [[1.0 - to_bad, to_bad], [to_good, 1.0 - to_good]];
        let stationary = [to_good / changes, to_bad / changes];
        Ok(Self {
            state: MarkovChain::new(stationary, rows, streams.of(Impairment::LossState)),
            loss: [loss_good, loss_bad].map(|loss| Event::new(loss, streams.of(Impairment::Loss))),
        })
    }
}

impl Rule for GilbertElliottLoss {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let loss = self.loss[self.state.state(packet.index)];
        Verdict::unless(loss.occurs(packet.index), DropCause::Loss, at_ns)
    }
}

/// Four-state Markov loss: bursts with gaps inside them, and single losses outside.
///
/// States 1 (good) and 2 (good within a burst) deliver the packet at which they are entered; 3 (lost within a
/// burst) and 4 (lost alone) lose it. The stationary probabilities are as
/// `p31 p23 : p13 p32 : p13 p23 : p14 p31 p23`. The fraction of lost packets is the sum of states 3 and 4.
///
/// Source: S. Salsano, F. Ludovici, A. Ordine, D. Giannuzzi, "Definition of a general and intuitive loss
/// model for packet networks and its implementation in the Netem module in the Linux kernel", 2012.
#[derive(Clone, Copy, Debug)]
struct FourStateLoss {
    state: MarkovChain<4>,
}

impl FourStateLoss {
    fn new(settings: &FourState, streams: &Streams) -> Result<Self, LinkSettingsError> {
        let &FourState { p13, p31, p32, p23, p14 } = settings;
        for (key, seen) in [("p13", p13), ("p31", p31), ("p32", p32), ("p23", p23), ("p14", p14)] {
            probability(&format!("four_state.{key}"), seen)?;
        }
        for (first, second, sum) in [("p13", "p14", p13 + p14), ("p31", "p32", p31 + p32)] {
            if sum > 1.0 {
                return Err(LinkSettingsError::contradiction(
                    format!("four_state.{first}"),
                    format!("{first} + {second} = {sum}: must be at most 1, since both leave the same state"),
                ));
            }
        }
        // With p32 = 0, state 2 is never entered and p23 is irrelevant.
        let p23_if_entered = if p32 == 0.0 { 1.0 } else { p23 };
        let weights = [p31 * p23_if_entered, p13 * p32, p13 * p23_if_entered, p14 * p31 * p23_if_entered];
        let sum: f64 = weights.iter().sum();
        if sum == 0.0 {
            return Err(LinkSettingsError::contradiction(
                "four_state.p31",
                "what the link settles in depends on where it starts: a burst must end, \
                 so give p31 above 0, and with p32 also p23 above 0",
            ));
        }
        let rows = [
            [1.0 - p13 - p14, 0.0, p13, p14],
            [0.0, 1.0 - p23, p23, 0.0],
            [p31, p32, 1.0 - p31 - p32, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ];
        let stationary = weights.map(|weight| weight / sum);
        Ok(Self { state: MarkovChain::new(stationary, rows, streams.of(Impairment::LossState)) })
    }
}

impl Rule for FourStateLoss {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.state.state(packet.index) >= 2, DropCause::Loss, at_ns)
    }
}

/// Maximum number of steps over skipped packets, which an earlier rule dropped. Beyond it the chain restarts
/// from its stationary distribution, which bounds the cost per packet.
const MAX_STEPS: u64 = 10_000;

/// Distribution over the states `0..N`, as cumulative probabilities.
#[derive(Clone, Copy, Debug)]
struct Law<const N: usize> {
    up_to: [Chance; N],
}

impl<const N: usize> Law<N> {
    /// Require probabilities that sum to 1 up to rounding.
    fn new(probabilities: [f64; N]) -> Self {
        let mut sum = 0.0;
        Self {
            up_to: probabilities.map(|probability| {
                sum += probability;
                Chance::new(sum.clamp(0.0, 1.0))
            }),
        }
    }

    fn pick(&self, bits: u64) -> usize {
        // The last state takes the remainder that rounding leaves below 1.
        self.up_to.iter().position(|chance| chance.takes(bits)).unwrap_or(N - 1)
    }
}

/// Markov chain over the states `0..N`: the state at packet n follows from that at n - 1 and one draw.
#[derive(Clone, Copy, Debug)]
struct MarkovChain<const N: usize> {
    stationary: Law<N>,
    rows: [Law<N>; N],
    draws: InTurn,
    /// Index of the last packet and its state.
    last: Option<(u64, usize)>,
}

impl<const N: usize> MarkovChain<N> {
    /// Starts in the stationary distribution; `rows` holds the transition probabilities.
    fn new(stationary: [f64; N], rows: [[f64; N]; N], stream: Stream) -> Self {
        Self {
            stationary: Law::new(stationary),
            rows: rows.map(Law::new),
            draws: InTurn::new(stream),
            last: None,
        }
    }

    /// State at a packet. The chain also steps for packets that an earlier rule dropped, so that earlier
    /// rules do not change the states.
    fn state(&mut self, index: u64) -> usize {
        let state = match self.last {
            Some((last, state)) if last <= index && index - last <= MAX_STEPS => {
                (last + 1..=index).fold(state, |state, index| self.rows[state].pick(self.draws.bits(index)))
            }
            _ => self.stationary.pick(self.draws.bits(index)),
        };
        self.last = Some((index, state));
        state
    }
}
