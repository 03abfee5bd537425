//! Tests of the whole crate through its public names.

mod adversary;
mod batches;
mod chains;
mod changes;
mod endings;
mod independence;
mod jitter;
mod live;
mod live_parity;
mod live_probe;
mod loss;
mod outage;
mod refusals;
mod reorder;
mod vectors;
mod verdicts;

use crate::{Direction, Link, LinkSettings, Packet, Verdict};

/// 50 ms +-5 ms, normal and in order, with 1 % loss.
fn rough() -> LinkSettings {
    LinkSettings { delay_s: 0.05, jitter_s: 0.005, loss: 0.01, ..LinkSettings::default() }
}

/// Same, with independent delays per packet, hence out of order.
fn scattered() -> LinkSettings {
    LinkSettings { keep_order: false, jitter_correlation_s: Some(0.0), ..rough() }
}

/// Delays in ns from the virtual driver for packets sent at 1 kHz; `None` if lost.
fn virtual_delays(
    direction: Direction,
    seed: u64,
    settings: &LinkSettings,
    packets: u64,
) -> Vec<Option<u64>> {
    let mut link = Link::new(direction, seed, settings).unwrap();
    (0..packets)
        .map(|index| {
            let sent_ns = index * 1_000_000;
            let packet = Packet { direction, sent_ns, size: 64, index };
            delay(&packet, link.judge(&packet).verdict)
        })
        .collect()
}

fn delay(packet: &Packet, verdict: Verdict) -> Option<u64> {
    match verdict {
        Verdict::Deliver { at_ns } => Some(at_ns - packet.sent_ns),
        Verdict::Drop { .. } => None,
    }
}
