//! Scheduling slots of satellites: a delay level per slot, and spikes at both ends.
//!
//! A packet sent in slot k has, in addition to the delay of the path, the level `max(N(0, level_s), -delay)`
//! of the slot. Here `delay` is the lowest mean delay. During a spike it also has an exponentially
//! distributed extra with mean `spike_delay_s`. Level and spikes are drawn once per slot, so all packets of a
//! spike have the same extra.
//!
//! Source: arXiv 2601.08439.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::checks::{LinkSettingsError, MAX_DELAY_S, nanoseconds, probability, within};
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::random::{Chance, Stream, unit};
use crate::rule::Rule;
use crate::verdict::{DropCause, Verdict};

const MIN_PERIOD_S: f64 = 1e-3;
const MAX_PERIOD_S: f64 = 1e6;

/// Scheduling slots: a delay level drawn per slot, and spikes at both ends.
///
/// Source: arXiv 2601.08439 (Starlink: 15 s; about 140 ms at the start, 75 ms at the end).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Slots {
    /// Length of a slot in s.
    pub period_s: f64,
    /// Duration of the spike at the start of a slot, in s.
    #[serde(default)]
    pub start_spike_s: f64,
    /// Duration of the spike at the end of a slot, in s.
    #[serde(default)]
    pub end_spike_s: f64,
    /// Mean extra delay of a spike in s; exponentially distributed over spikes.
    #[serde(default)]
    pub spike_delay_s: f64,
    /// Standard deviation in s of the level over slots, added to `delay_s`; the total delay stays at or above
    /// zero.
    #[serde(default)]
    pub level_s: f64,
    /// Probability that a packet is lost during a spike.
    #[serde(default)]
    pub spike_loss: f64,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Slotted {
    period_ns: u64,
    start_spike_ns: u64,
    end_spike_ns: u64,
    spike_delay_ns: f64,
    level_ns: f64,
    /// Lowest mean delay.
    floor_ns: f64,
    spike_loss: Chance,
    stream: Stream,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let Some(slots) = &settings.slots else {
        return Ok(None);
    };
    within("slots.period_s", slots.period_s, MIN_PERIOD_S, MAX_PERIOD_S)?;
    within("slots.start_spike_s", slots.start_spike_s, 0.0, slots.period_s)?;
    within("slots.end_spike_s", slots.end_spike_s, 0.0, slots.period_s)?;
    within("slots.spike_delay_s", slots.spike_delay_s, 0.0, MAX_DELAY_S)?;
    within("slots.level_s", slots.level_s, 0.0, MAX_DELAY_S)?;
    probability("slots.spike_loss", slots.spike_loss)?;
    let spikes_s = slots.start_spike_s + slots.end_spike_s;
    if spikes_s > slots.period_s {
        return Err(LinkSettingsError::contradiction(
            "slots.end_spike_s",
            format!("both spikes take {spikes_s} s of a slot of {} s", slots.period_s),
        ));
    }
    if spikes_s == 0.0 && (slots.spike_delay_s > 0.0 || slots.spike_loss > 0.0) {
        let key = if slots.spike_delay_s > 0.0 { "slots.spike_delay_s" } else { "slots.spike_loss" };
        return Err(LinkSettingsError::contradiction(key, "given without start_spike_s or end_spike_s"));
    }
    let min_s = settings.timeline.iter().map(|change| change.delay_s).fold(settings.delay_s, f64::min);
    Ok(Some(Box::new(Slotted {
        period_ns: nanoseconds(slots.period_s),
        start_spike_ns: nanoseconds(slots.start_spike_s),
        end_spike_ns: nanoseconds(slots.end_spike_s),
        spike_delay_ns: slots.spike_delay_s * 1e9,
        level_ns: slots.level_s * 1e9,
        floor_ns: min_s * 1e9,
        spike_loss: Chance::new(slots.spike_loss),
        stream: streams.of(Impairment::Slots),
    })))
}

const LEVEL: u8 = 0;
const START_SPIKE: u8 = 1;
const END_SPIKE: u8 = 2;
const LOSS: u8 = 3;

impl Rule for Slotted {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let slot = packet.sent_ns / self.period_ns;
        let offset_ns = packet.sent_ns % self.period_ns;
        let mut extra_ns = 0.0;
        if self.level_ns > 0.0 {
            extra_ns += (self.level_ns * normal(self.stream.nth(LEVEL).pair(slot))).max(-self.floor_ns);
        }
        let spike = if offset_ns < self.start_spike_ns {
            Some(START_SPIKE)
        } else if offset_ns >= self.period_ns - self.end_spike_ns {
            Some(END_SPIKE)
        } else {
            None
        };
        if let Some(spike) = spike {
            if self.spike_loss.takes(self.stream.nth(LOSS).bits(packet.index)) {
                return Verdict::Drop { cause: DropCause::Loss };
            }
            extra_ns -= self.spike_delay_ns * libm::log(self.stream.nth(spike).unit(slot));
        }
        Verdict::Deliver { at_ns: shifted(at_ns, extra_ns).max(packet.sent_ns) }
    }
}

/// Standard normal variate.
///
/// Source: G. E. P. Box, M. E. Muller, "A note on the generation of random normal deviates", Ann. Math.
/// Statist. 29(2), 1958.
fn normal([radius, angle]: [u64; 2]) -> f64 {
    (-2.0 * libm::log(unit(radius))).sqrt() * libm::cos(2.0 * std::f64::consts::PI * unit(angle))
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "saturates; the sign is taken off"
)]
fn shifted(at_ns: u64, by_ns: f64) -> u64 {
    let distance_ns = by_ns.abs().round() as u64;
    if by_ns < 0.0 { at_ns.saturating_sub(distance_ns) } else { at_ns.saturating_add(distance_ns) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Direction, Link, Slots};

    const MS: u64 = 1_000_000;

    fn starlink() -> Slots {
        Slots {
            period_s: 15.0,
            start_spike_s: 0.14,
            end_spike_s: 0.075,
            spike_delay_s: 0.03,
            level_s: 0.003,
            spike_loss: 0.0,
        }
    }

    fn link(slots: Slots) -> Link {
        let slots = Some(slots);
        let settings = LinkSettings { delay_s: 0.02, keep_order: false, slots, ..LinkSettings::default() };
        Link::new(Direction::Forward, 5, &settings).unwrap()
    }

    fn delay_ms(link: &mut Link, sent_ns: u64, index: u64) -> Option<f64> {
        let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index };
        match link.judge(&packet).verdict {
            Verdict::Deliver { at_ns } => Some((at_ns - sent_ns) as f64 / 1e6),
            Verdict::Drop { .. } => None,
        }
    }

    #[test]
    fn a_slot_is_level_between_its_spikes() {
        let mut link = link(starlink());
        for slot in 0..50 {
            let begin = slot * 15_000 * MS;
            let mut at = |ms: u64| delay_ms(&mut link, begin + ms * MS, 0).unwrap();
            let level = at(140);
            assert_eq!((at(5000), at(14_924)), (level, level));
            assert!(at(0) > level && at(0) == at(139), "start spike");
            assert!(at(14_925) > level && at(14_925) == at(14_999), "end spike");
            assert_ne!(at(0), at(14_925));
        }
    }

    /// First two moments of both distributions over many slots, within 4 standard errors.
    #[test]
    fn levels_and_spikes_match_their_distributions() {
        const SLOTS: u64 = 100_000;
        let count = SLOTS as f64;
        let mut link = link(Slots { level_s: 0.002, ..starlink() });
        let (mut level, mut level_2, mut spike, mut spike_2) = (0.0, 0.0, 0.0, 0.0);
        for slot in 0..SLOTS {
            let begin = slot * 15_000 * MS;
            let quiet = delay_ms(&mut link, begin + 1000 * MS, 0).unwrap();
            let raised = delay_ms(&mut link, begin, 0).unwrap() - quiet;
            level += (quiet - 20.0) / count;
            level_2 += (quiet - 20.0).powi(2) / count;
            spike += raised / count;
            spike_2 += raised.powi(2) / count;
        }
        assert!(level.abs() < 4.0 * 2.0 / count.sqrt(), "{level}");
        assert!((level_2 / 4.0 - 1.0).abs() < 4.0 * (2.0 / count).sqrt(), "{level_2}");
        assert!((spike / 30.0 - 1.0).abs() < 4.0 / count.sqrt(), "{spike}");
        // E x^4 = 24 m^4 for the exponential distribution.
        assert!((spike_2 / 1800.0 - 1.0).abs() < 4.0 * (20.0 / 4.0 / count).sqrt(), "{spike_2}");
    }

    #[test]
    fn a_level_never_takes_more_than_the_delay() {
        let mut link = link(Slots { level_s: 0.1, start_spike_s: 0.0, ..starlink() });
        let delays: Vec<f64> =
            (0..1000).map(|slot| delay_ms(&mut link, slot * 15_000 * MS + MS, 0).unwrap()).collect();
        assert!(delays.iter().all(|&delay| delay >= 0.0));
        let none = delays.iter().filter(|&&delay| delay == 0.0).count();
        // P(N < -0.2) = 0.4207.
        assert!((none as f64 - 420.7).abs() < 4.0 * (1000.0 * 0.4207 * 0.5793_f64).sqrt(), "{none}");
    }

    #[test]
    fn packets_are_lost_only_in_spikes() {
        const COUNT: u64 = 100_000;
        let mut link = link(Slots { spike_loss: 0.3, ..starlink() });
        let lost = |link: &mut Link, ms: u64| {
            (0..COUNT).filter(|&index| delay_ms(link, ms * MS, index).is_none()).count() as f64
        };
        assert_eq!(lost(&mut link, 200), 0.0);
        let in_spike = lost(&mut link, 100);
        assert!((in_spike - 3e4).abs() < 4.0 * (COUNT as f64 * 0.21).sqrt(), "{in_spike}");
    }

    #[test]
    fn delays_are_the_same_on_every_platform() {
        let mut link = link(starlink());
        let mut delay_ns = |sent_ns: u64| {
            let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index: 0 };
            match link.judge(&packet).verdict {
                Verdict::Deliver { at_ns } => at_ns - sent_ns,
                Verdict::Drop { .. } => 0,
            }
        };
        let seen = [0, 1000, 14_999, 15_000, 16_000].map(|ms| delay_ns(ms * MS));
        assert_eq!(seen, [102_029_684, 21_298_829, 34_315_899, 63_674_437, 19_756_270]);
    }

    #[test]
    fn invalid_slots_are_refused() {
        let cases = [
            (Slots { period_s: 0.0, ..starlink() }, "slots.period_s = 0"),
            (Slots { start_spike_s: 16.0, ..starlink() }, "slots.start_spike_s = 16"),
            (Slots { start_spike_s: 10.0, end_spike_s: 10.0, ..starlink() }, "slots.end_spike_s: both"),
            (
                Slots { start_spike_s: 0.0, end_spike_s: 0.0, ..starlink() },
                "slots.spike_delay_s: given without",
            ),
            (Slots { level_s: f64::NAN, ..starlink() }, "slots.level_s = NaN"),
            (Slots { spike_loss: 2.0, ..starlink() }, "slots.spike_loss = 2"),
        ];
        for (slots, expected) in cases {
            let settings = LinkSettings { slots: Some(slots), ..LinkSettings::default() };
            let message = settings.validate().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
