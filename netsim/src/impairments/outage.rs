//! Outages: times at which nothing passes. Packets sent during an outage are dropped, or held until it ends.
//!
//! The sending time decides, so the delay does not affect which packets meet an outage.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Impairment, LinkSettings, Streams};
use crate::checks::{LinkSettingsError, MAX_TIME_S, nanoseconds, within};
use crate::on_off::{MAX_MEAN_S, OnOff};
use crate::packet::Packet;
use crate::random::Stream;
use crate::rule::Rule;
use crate::verdict::{DropCause, Verdict};

/// Maximum number of outages: each has its own stream.
const MAX_OUTAGES: usize = 256;
/// Minimum duration in s: one clock tick of the model.
const MIN_S: f64 = 1e-9;
const MIN_MEAN_S: f64 = 1e-6;
/// Maximum ratio of mean down time to mean up time; the work of finding the end of an outage grows with it.
const MAX_DOWN_PER_UP: f64 = 1000.0;

/// Times at which nothing passes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Outage {
    /// Schedule.
    pub times: OutageTimes,
    /// Effect on packets.
    #[serde(default)]
    pub effect: OutageEffect,
}

/// Schedule of outages.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum OutageTimes {
    /// A single outage.
    Once {
        /// Start in s since the link began.
        at_s: f64,
        /// Duration in s.
        duration_s: f64,
    },
    /// Periodic outages.
    Periodic {
        /// Start of the first outage, in s since the link began.
        at_s: f64,
        /// Period from start to start, in s.
        period_s: f64,
        /// Duration of each in s.
        duration_s: f64,
    },
    /// Random outages; up and down times are exponentially distributed.
    Random {
        /// Mean time in s from an end to the next start.
        mean_up_s: f64,
        /// Mean duration in s, at most 1000 times `mean_up_s`.
        mean_down_s: f64,
    },
}

/// Effect on packets sent during an outage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum OutageEffect {
    /// They are dropped.
    #[default]
    Drop,
    /// They are held, and arrive together at its end.
    Hold,
}

/// Build the dropping outages, which precede the bottleneck: dropped packets take no place there.
pub(crate) fn build_dropping(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let schedules = schedules(settings, streams, OutageEffect::Drop)?;
    Ok((!schedules.is_empty()).then(|| Box::new(Dropping(schedules)) as Box<dyn Rule>))
}

/// Build the holding outages, which follow the delay: the delay elapses while a packet is held.
pub(crate) fn build_holding(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let schedules = schedules(settings, streams, OutageEffect::Hold)?;
    Ok((!schedules.is_empty()).then(|| Box::new(Holding(schedules)) as Box<dyn Rule>))
}

fn schedules(
    settings: &LinkSettings,
    streams: &Streams,
    effect: OutageEffect,
) -> Result<Vec<Schedule>, LinkSettingsError> {
    within("outages", settings.outages.len() as f64, 0.0, MAX_OUTAGES as f64)?;
    let stream = streams.of(Impairment::Outage);
    let mut schedules = Vec::new();
    for (position, outage) in (0..=u8::MAX).zip(&settings.outages) {
        let key = format!("outages.{position}.times");
        let schedule = Schedule::new(&key, &outage.times, stream.nth(position))?;
        if outage.effect == effect {
            schedules.push(schedule);
        }
    }
    Ok(schedules)
}

#[derive(Clone, Debug)]
struct Dropping(Vec<Schedule>);

impl Rule for Dropping {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let meets = self.0.iter_mut().any(|schedule| schedule.is_out(packet.sent_ns));
        Verdict::unless(meets, DropCause::Outage, at_ns)
    }
}

#[derive(Clone, Debug)]
struct Holding(Vec<Schedule>);

impl Rule for Holding {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        // Held packets are due together at the end of the outage; drivers release such packets in sending
        // order.
        let ends = self.0.iter_mut().filter_map(|schedule| schedule.out_until(packet.sent_ns));
        Verdict::Deliver { at_ns: ends.fold(at_ns, u64::max) }
    }
}

#[derive(Clone, Copy, Debug)]
enum Schedule {
    Once { from_ns: u64, until_ns: u64 },
    Periodic { from_ns: u64, period_ns: u64, duration_ns: u64 },
    Random(OnOff),
}

impl Schedule {
    fn new(key: &str, times: &OutageTimes, stream: Stream) -> Result<Self, LinkSettingsError> {
        let check = |name, seen, low, high| within(&format!("{key}.{name}"), seen, low, high);
        match *times {
            OutageTimes::Once { at_s, duration_s } => {
                check("at_s", at_s, 0.0, MAX_TIME_S)?;
                check("duration_s", duration_s, MIN_S, MAX_TIME_S)?;
                let from_ns = nanoseconds(at_s);
                Ok(Self::Once { from_ns, until_ns: from_ns + nanoseconds(duration_s) })
            }
            OutageTimes::Periodic { at_s, period_s, duration_s } => {
                check("at_s", at_s, 0.0, MAX_TIME_S)?;
                check("period_s", period_s, MIN_S, MAX_TIME_S)?;
                check("duration_s", duration_s, MIN_S, MAX_TIME_S)?;
                let [period_ns, duration_ns] = [period_s, duration_s].map(nanoseconds);
                if duration_ns >= period_ns {
                    return Err(LinkSettingsError::contradiction(
                        format!("{key}.duration_s"),
                        format!(
                            "{duration_s} is not below period_s = {period_s}: nothing would ever pass again"
                        ),
                    ));
                }
                Ok(Self::Periodic { from_ns: nanoseconds(at_s), period_ns, duration_ns })
            }
            OutageTimes::Random { mean_up_s, mean_down_s } => {
                check("mean_up_s", mean_up_s, MIN_MEAN_S, MAX_MEAN_S)?;
                let max_s = MAX_MEAN_S.min(mean_up_s * MAX_DOWN_PER_UP);
                check("mean_down_s", mean_down_s, MIN_MEAN_S, max_s)?;
                Ok(Self::Random(OnOff::by_means(mean_up_s, mean_down_s, stream)))
            }
        }
    }

    fn is_out(&mut self, at_ns: u64) -> bool {
        match self {
            // Finding the end is costly and not needed here.
            Self::Random(process) => process.is_off(at_ns),
            _ => self.out_until(at_ns).is_some(),
        }
    }

    fn out_until(&mut self, at_ns: u64) -> Option<u64> {
        match self {
            Self::Once { from_ns, until_ns } => (*from_ns..*until_ns).contains(&at_ns).then_some(*until_ns),
            Self::Periodic { from_ns, period_ns, duration_ns } => {
                let phase_ns = at_ns.checked_sub(*from_ns)? % *period_ns;
                (phase_ns < *duration_ns).then(|| (at_ns - phase_ns).saturating_add(*duration_ns))
            }
            Self::Random(process) => process.off_until(at_ns),
        }
    }
}
