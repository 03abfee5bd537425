//! Reordering: a packet jumps ahead of earlier ones, or is held while later ones pass.
//!
//! A jumping packet arrives 1 ns before the k-th last packet under way. It overtakes k packets and those due
//! together with them, or all if fewer are under way. This is known at sending time: the arrivals of other
//! packets stay unchanged.

use std::collections::VecDeque;

use crate::checks::{LinkSettingsError, MAX_DELAY_S, nanoseconds, probability, within};
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::random::Event;
use crate::rule::Rule;
use crate::verdict::Verdict;

const MAX_DEPTH: usize = 1024;

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let depth = settings.reorder_depth;
    probability("reorder", settings.reorder)?;
    within("reorder_depth", depth as f64, 1.0, MAX_DEPTH as f64)?;
    if let Some(hold_s) = settings.reorder_hold_s {
        within("reorder_hold_s", hold_s, 1e-9, MAX_DELAY_S)?;
        if depth != 1 {
            return Err(LinkSettingsError::contradiction(
                "reorder_depth",
                "a packet that is held overtakes none: give reorder_depth or reorder_hold_s",
            ));
        }
    }
    if settings.reorder == 0.0 {
        return Ok(None);
    }
    let chosen = Event::new(settings.reorder, streams.of(Impairment::Reorder));
    if let Some(hold_s) = settings.reorder_hold_s {
        return Ok(Some(Box::new(Held { chosen, hold_ns: nanoseconds(hold_s) })));
    }
    if !settings.delays() {
        return Err(LinkSettingsError::contradiction(
            "reorder",
            "without a delay no packet is ever under way to be overtaken: give delay_s, or reorder_hold_s",
        ));
    }
    Ok(Some(Box::new(Jumping { chosen, depth, latest: VecDeque::with_capacity(depth) })))
}

#[derive(Clone, Copy, Debug)]
struct Held {
    chosen: Event,
    hold_ns: u64,
}

impl Rule for Held {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let hold_ns = if self.chosen.occurs(packet.index) { self.hold_ns } else { 0 };
        Verdict::Deliver { at_ns: at_ns.saturating_add(hold_ns) }
    }
}

#[derive(Clone, Debug)]
struct Jumping {
    chosen: Event,
    depth: usize,
    /// The `depth` latest arrivals so far, in order.
    latest: VecDeque<u64>,
}

impl Jumping {
    /// Arrival ahead of the latest packets under way at `sent_ns`; `None` if none is under way.
    fn ahead_of_latest(&self, sent_ns: u64) -> Option<u64> {
        let arrived = self.latest.partition_point(|&due_ns| due_ns <= sent_ns);
        self.latest.get(arrived).map(|due_ns| due_ns - 1)
    }

    fn remember(&mut self, due_ns: u64) {
        // Most packets arrive last; jumping packets arrive first among these.
        let position = self.latest.partition_point(|&other_ns| other_ns <= due_ns);
        if self.latest.len() < self.depth {
            self.latest.insert(position, due_ns);
        } else if position > 0 {
            self.latest.pop_front();
            self.latest.insert(position - 1, due_ns);
        }
    }
}

impl Rule for Jumping {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let ahead_ns =
            self.chosen.occurs(packet.index).then(|| self.ahead_of_latest(packet.sent_ns)).flatten();
        let at_ns = ahead_ns.map_or(at_ns, |ahead_ns| ahead_ns.min(at_ns));
        self.remember(at_ns);
        Verdict::Deliver { at_ns }
    }
}
