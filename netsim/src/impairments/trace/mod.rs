//! Replay of recorded delays and losses.
//!
//! A packet gets the recorded state at its sending time. The current record is the last one at or before that
//! time. If it is lost, so is the packet. Otherwise its delay applies; with `interpolate` the delay is
//! interpolated to the next record, if that was delivered.
//!
//! The link begins at the first record, whatever its time. After the last record, that record holds; with
//! `repeat` the recording restarts after its last time plus the last spacing. A single record holds forever.
//!
//! Loss precedes the bottleneck, and the recorded delay replaces `delay_s` behind it, so a recording can be
//! combined with a rate.

mod files;
mod irtt;

#[cfg(test)]
mod tests;

pub use files::{ParseError, parse_delay_csv, parse_dist, parse_mahimahi};
pub use irtt::{IrttDelay, IrttRecording, parse_irtt};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::checks::{LinkSettingsError, MAX_DELAY_S, MAX_TIME_S, nanoseconds, within};
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::rule::Rule;
use crate::verdict::{DropCause, Verdict};

const MAX_RECORDS: usize = 10_000_000;

/// Recorded delays and losses.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DelayTrace {
    /// Times in s, increasing, the first 0 or more: the link begins at the first.
    pub time_s: Vec<f64>,
    /// Delay in s of a packet sent then; `None` if lost.
    pub delay_s: Vec<Option<f64>>,
    /// Interpolates delays between records; otherwise the last record holds.
    #[serde(default = "yes")]
    pub interpolate: bool,
    /// Restarts after the end; otherwise the last record holds.
    #[serde(default = "yes")]
    pub repeat: bool,
}

fn yes() -> bool {
    true
}

/// Mapping of link time to recording time.
#[derive(Clone, Copy, Debug)]
struct Playback {
    /// Period of repetition; `None` without repetition.
    period_ns: Option<u64>,
}

impl Playback {
    /// Playback of a recording with these times, which start at 0.
    fn new(time_ns: &[u64], repeats: bool) -> Self {
        let &[.., before, last] = time_ns else {
            return Self { period_ns: None };
        };
        Self { period_ns: repeats.then_some(2 * last - before) }
    }

    fn position(&self, now_ns: u64) -> u64 {
        self.period_ns.map_or(now_ns, |period_ns| now_ns % period_ns)
    }
}

impl DelayTrace {
    /// Times in ns since the first.
    fn time_ns(&self) -> Vec<u64> {
        let first_ns = self.time_s.first().map_or(0, |&first_s| nanoseconds(first_s));
        self.time_s.iter().map(|&time_s| nanoseconds(time_s) - first_ns).collect()
    }
}

#[derive(Clone, Debug)]
pub(crate) struct TraceLoss {
    playback: Playback,
    starts_lost: bool,
    /// Alternating starts and ends of loss.
    edges_ns: Vec<u64>,
}

pub(crate) fn build_loss(
    settings: &LinkSettings,
    _: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let Some(trace) = &settings.trace else {
        return Ok(None);
    };
    check(settings, trace)?;
    let time_ns = trace.time_ns();
    let lost = |position: usize| trace.delay_s[position].is_none();
    let edges = (1..trace.delay_s.len()).filter(|&position| lost(position) != lost(position - 1));
    let edges_ns = edges.map(|position| time_ns[position]).collect();
    let playback = Playback::new(&time_ns, trace.repeat);
    let rule = TraceLoss { playback, starts_lost: lost(0), edges_ns };
    Ok((rule.starts_lost || !rule.edges_ns.is_empty()).then(|| Box::new(rule) as Box<dyn Rule>))
}

impl Rule for TraceLoss {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let now_ns = self.playback.position(packet.sent_ns);
        let edges = self.edges_ns.partition_point(|&edge_ns| edge_ns <= now_ns);
        if self.starts_lost ^ (edges % 2 == 1) {
            Verdict::Drop { cause: DropCause::Trace }
        } else {
            Verdict::Deliver { at_ns }
        }
    }
}

#[derive(Clone, Debug)]
pub(crate) struct TraceDelay {
    playback: Playback,
    time_ns: Vec<u64>,
    /// `None` if lost.
    delay_ns: Vec<Option<u64>>,
    interpolate: bool,
}

pub(crate) fn build_delay(
    settings: &LinkSettings,
    _: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let Some(trace) = &settings.trace else {
        return Ok(None);
    };
    check(settings, trace)?;
    let time_ns = trace.time_ns();
    Ok(Some(Box::new(TraceDelay {
        playback: Playback::new(&time_ns, trace.repeat),
        time_ns,
        delay_ns: trace.delay_s.iter().map(|delay_s| delay_s.map(nanoseconds)).collect(),
        interpolate: trace.interpolate,
    })))
}

impl TraceDelay {
    fn at(&self, now_ns: u64) -> u64 {
        let after = self.time_ns.partition_point(|&time_ns| time_ns <= now_ns);
        let holding = after.saturating_sub(1);
        // Lost packets were dropped before the bottleneck.
        let from_ns = self.delay_ns[holding].unwrap_or_default();
        match self.delay_ns.get(after) {
            Some(&Some(to_ns)) if self.interpolate && after > 0 => {
                let (start_ns, end_ns) = (self.time_ns[holding], self.time_ns[after]);
                between(from_ns, to_ns, now_ns - start_ns, end_ns - start_ns)
            }
            _ => from_ns,
        }
    }
}

impl Rule for TraceDelay {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let delay_ns = self.at(self.playback.position(packet.sent_ns));
        Verdict::Deliver { at_ns: at_ns.saturating_add(delay_ns) }
    }
}

/// Linear interpolation between two values, rounded towards `from`.
pub(crate) fn between(from: u64, to: u64, passed: u64, whole: u64) -> u64 {
    let change = u128::from(from.abs_diff(to)) * u128::from(passed) / u128::from(whole);
    #[expect(clippy::cast_possible_truncation, reason = "at most the difference of both")]
    let change = change as u64;
    if to >= from { from + change } else { from - change }
}

fn check(settings: &LinkSettings, trace: &DelayTrace) -> Result<(), LinkSettingsError> {
    let beside = [
        ("delay_s", settings.delay_s != 0.0),
        ("jitter_s", settings.jitter_s != 0.0),
        ("timeline", !settings.timeline.is_empty()),
        ("slots", settings.slots.is_some()),
    ];
    if let Some((key, _)) = beside.into_iter().find(|(_, is_given)| *is_given) {
        return Err(LinkSettingsError::contradiction(
            "trace",
            format!("given beside {key}; it takes its place"),
        ));
    }
    let (times, delays) = (trace.time_s.len(), trace.delay_s.len());
    if times != delays || times == 0 || times > MAX_RECORDS {
        return Err(LinkSettingsError::contradiction(
            "trace",
            format!("{times} times and {delays} delays; as many of each, 1 to {MAX_RECORDS}, are needed"),
        ));
    }
    let mut before_ns = None;
    for (position, &time_s) in trace.time_s.iter().enumerate() {
        if !(0.0..=MAX_TIME_S).contains(&time_s) {
            within(&format!("trace.time_s.{position}"), time_s, 0.0, MAX_TIME_S)?;
        }
        let time_ns = nanoseconds(time_s);
        if before_ns.is_some_and(|before_ns| time_ns <= before_ns) {
            return Err(LinkSettingsError::contradiction(
                format!("trace.time_s.{position}"),
                format!("{time_s} s; times must increase by 1 ns at least"),
            ));
        }
        before_ns = Some(time_ns);
    }
    for (position, delay_s) in trace.delay_s.iter().enumerate() {
        if let Some(delay_s) = *delay_s
            && !(0.0..=MAX_DELAY_S).contains(&delay_s)
        {
            within(&format!("trace.delay_s.{position}"), delay_s, 0.0, MAX_DELAY_S)?;
        }
    }
    Ok(())
}
