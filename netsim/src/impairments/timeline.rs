//! Mean delay that changes at given times, as a step or a ramp.
//!
//! The sending time of a packet determines its delay: `delay_s` before the first change, and a linear
//! interpolation from the previous to the new delay during a ramp.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::checks::{LinkSettingsError, MAX_DELAY_S, MAX_TIME_S, nanoseconds, within};
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::impairments::trace::between;
use crate::packet::Packet;
use crate::rule::Rule;
use crate::verdict::Verdict;

/// Change of the mean delay.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DelayChange {
    /// Start in s since the link began.
    pub at_s: f64,
    /// New mean delay in s.
    pub delay_s: f64,
    /// Duration of the linear ramp in s; 0 is a step.
    #[serde(default)]
    pub ramp_s: f64,
}

#[derive(Clone, Copy, Debug)]
#[expect(clippy::struct_field_names, reason = "all are times in ns, and say so")]
struct Change {
    at_ns: u64,
    ramp_ns: u64,
    delay_ns: u64,
}

#[derive(Clone, Debug)]
pub(crate) struct Timeline {
    first_ns: u64,
    changes: Vec<Change>,
}

pub(crate) fn build(
    settings: &LinkSettings,
    _: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let mut changes: Vec<Change> = Vec::new();
    for (position, requested) in settings.timeline.iter().enumerate() {
        within(&format!("timeline.{position}.at_s"), requested.at_s, 0.0, MAX_TIME_S)?;
        within(&format!("timeline.{position}.delay_s"), requested.delay_s, 0.0, MAX_DELAY_S)?;
        within(&format!("timeline.{position}.ramp_s"), requested.ramp_s, 0.0, MAX_TIME_S)?;
        let change = Change {
            at_ns: nanoseconds(requested.at_s),
            ramp_ns: nanoseconds(requested.ramp_s),
            delay_ns: nanoseconds(requested.delay_s),
        };
        if let Some(before) = changes.last()
            && (change.at_ns <= before.at_ns || change.at_ns < before.at_ns + before.ramp_ns)
        {
            let done_s = (before.at_ns + before.ramp_ns) as f64 / 1e9;
            return Err(LinkSettingsError::contradiction(
                format!("timeline.{position}.at_s"),
                format!(
                    "{} s; must come after the change before it, which is done at {done_s} s",
                    requested.at_s
                ),
            ));
        }
        changes.push(change);
    }
    let first_ns = nanoseconds(settings.delay_s);
    Ok((!changes.is_empty()).then(|| Box::new(Timeline { first_ns, changes }) as Box<dyn Rule>))
}

impl Timeline {
    fn at(&self, now_ns: u64) -> u64 {
        let begun = self.changes.partition_point(|change| change.at_ns <= now_ns);
        let (before, changes) = self.changes.split_at(begun.saturating_sub(1));
        let before_ns = before.last().map_or(self.first_ns, |change| change.delay_ns);
        match changes.first() {
            Some(change) if begun > 0 => {
                let passed_ns = now_ns - change.at_ns;
                if passed_ns < change.ramp_ns {
                    between(before_ns, change.delay_ns, passed_ns, change.ramp_ns)
                } else {
                    change.delay_ns
                }
            }
            _ => before_ns,
        }
    }
}

impl Rule for Timeline {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::Deliver { at_ns: at_ns.saturating_add(self.at(packet.sent_ns)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DelayChange, Direction, Link};

    const MS: u64 = 1_000_000;

    fn scripted(changes: &[(f64, f64, f64)]) -> LinkSettings {
        let change = |&(at_s, delay_s, ramp_s)| DelayChange { at_s, delay_s, ramp_s };
        let timeline = changes.iter().map(change).collect();
        LinkSettings { delay_s: 0.01, keep_order: false, timeline, ..LinkSettings::default() }
    }

    #[test]
    fn the_delay_steps_and_ramps_as_scripted() {
        let settings = scripted(&[(1.0, 0.03, 0.0), (2.0, 0.05, 0.5), (2.5, 0.0, 1.0)]);
        let mut link = Link::new(Direction::Forward, 0, &settings).unwrap();
        let cases = [
            (0, 10_000),
            (999, 10_000),
            (1000, 30_000),
            (2000, 30_000),
            (2125, 35_000),
            (2500, 50_000),
            (2750, 37_500),
            (3499, 50),
            (3500, 0),
            (u64::MAX / MS, 0),
        ];
        for (index, (sent_ms, delay_us)) in cases.into_iter().enumerate() {
            let sent_ns = sent_ms * MS;
            let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index: index as u64 };
            let expected = Verdict::Deliver { at_ns: sent_ns + delay_us * 1000 };
            assert_eq!(link.judge(&packet).verdict, expected, "{sent_ms} ms");
        }
    }

    #[test]
    fn changes_that_overlap_are_refused() {
        let cases = [
            (scripted(&[(1.0, 0.1, 0.0), (1.0, 0.2, 0.0)]), "timeline.1.at_s: 1 s; must come after"),
            (scripted(&[(1.0, 0.1, 0.5), (1.4, 0.2, 0.0)]), "timeline.1.at_s: 1.4 s; must come after"),
            (scripted(&[(1.0, -0.1, 0.0)]), "timeline.0.delay_s = -0.1"),
            (scripted(&[(f64::NAN, 0.1, 0.0)]), "timeline.0.at_s = NaN"),
            (scripted(&[(0.0, 0.1, -1.0)]), "timeline.0.ramp_s = -1"),
        ];
        for (settings, expected) in cases {
            let message = settings.validate().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
