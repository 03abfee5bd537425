//! Outages: times at which nothing passes. What is sent during one is dropped, or held until it is over.
//!
//! Whether a packet meets an outage is settled by when it was sent, so that the delay changes nothing of it.

mod schedule;

use crate::random::Impairment;
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, LinkSettings, OutageEffect, within};
use crate::verdict::{DropCause, Packet, Verdict};

use schedule::Schedule;

/// Most outages of a link: each has a stream of its own.
const MOST: usize = 256;

/// Builds those that drop: they come before the bottleneck, since what is dropped takes no place there.
pub(crate) fn build_dropping(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkError> {
    let schedules = schedules(settings, streams, OutageEffect::Drop)?;
    Ok((!schedules.is_empty()).then(|| Box::new(Dropping(schedules)) as Box<dyn Rule>))
}

/// Builds those that hold: they come after the delay, which passes while a packet is held.
pub(crate) fn build_holding(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkError> {
    let schedules = schedules(settings, streams, OutageEffect::Hold)?;
    Ok((!schedules.is_empty()).then(|| Box::new(Holding(schedules)) as Box<dyn Rule>))
}

fn schedules(
    settings: &LinkSettings,
    streams: &Streams,
    effect: OutageEffect,
) -> Result<Vec<Schedule>, LinkError> {
    within("outages", settings.outages.len() as f64, 0.0, MOST as f64)?;
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
        // Those sent during an outage come together at its end, as they were sent: drivers release packets that
        // are due together in that order.
        let ends = self.0.iter_mut().filter_map(|schedule| schedule.out_until(packet.sent_ns));
        Verdict::Deliver { at_ns: ends.fold(at_ns, u64::max) }
    }
}
