//! Line behind the queue: of constant rate, or with given transmission opportunities.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::checks::{LinkSettingsError, within};

const SLOWEST_BPS: f64 = 1.0;
const FASTEST_BPS: f64 = 1e11;
/// Bytes per opportunity.
const OPPORTUNITY_BYTES: u64 = 1500;
/// Maximum time of an opportunity in ms, about thirty years.
const MAX_TIME_MS: u64 = 1_000_000_000_000;
pub(crate) const MAX_OPPORTUNITIES: usize = 10_000_000;
const NS_PER_MS: u64 = 1_000_000;

/// Times at which the bottleneck may send 1500 bytes each. The list repeats forever with its last time as the
/// period. A packet leaves with the opportunity that carries its last byte; unused opportunities are lost.
///
/// Source: mahimahi, `mm-link` traces.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Opportunities {
    /// Times in ms, not decreasing, the last above 0; the list then repeats.
    pub time_ms: Vec<u64>,
}

#[derive(Clone, Debug)]
pub(super) enum Server {
    Rate { rate_bps: f64, free_ns: u64 },
    Schedule(Schedule),
}

impl Server {
    pub(super) fn rate(rate_bps: f64) -> Result<Self, LinkSettingsError> {
        within("rate_bps", rate_bps, SLOWEST_BPS, FASTEST_BPS)?;
        Ok(Self::Rate { rate_bps, free_ns: 0 })
    }

    pub(super) fn opportunities(settings: &Opportunities) -> Result<Self, LinkSettingsError> {
        let Opportunities { time_ms } = settings;
        let key = "opportunities.time_ms";
        within(key, time_ms.len() as f64, 1.0, MAX_OPPORTUNITIES as f64).map_err(|_| {
            let seen = time_ms.len();
            LinkSettingsError::contradiction(
                key,
                format!("{seen} times; 1 to {MAX_OPPORTUNITIES} are allowed"),
            )
        })?;
        for (position, pair) in time_ms.windows(2).enumerate() {
            if pair[1] < pair[0] {
                let (later, earlier, at) = (pair[1], pair[0], position + 1);
                return Err(LinkSettingsError::contradiction(
                    format!("{key}.{at}"),
                    format!("{later} ms comes after {earlier} ms; times must not decrease"),
                ));
            }
        }
        let period_ms = time_ms.last().copied().unwrap_or_default();
        within(&format!("{key}.{}", time_ms.len() - 1), period_ms as f64, 1.0, MAX_TIME_MS as f64)?;
        let time_ns = time_ms.iter().map(|ms| ms * NS_PER_MS).collect();
        Ok(Self::Schedule(Schedule { time_ns, current: None }))
    }

    /// Transmission start of a packet that arrives now, behind all sent packets.
    pub(super) fn start(&self, arrival_ns: u64) -> u64 {
        match self {
            Self::Rate { free_ns, .. } => arrival_ns.max(*free_ns),
            Self::Schedule(schedule) => schedule.time_of(schedule.locate(arrival_ns)),
        }
    }

    /// Send a packet; return the departure of its last byte.
    pub(super) fn send(&mut self, arrival_ns: u64, wire_bytes: u64) -> u64 {
        match self {
            Self::Rate { rate_bps, free_ns } => {
                let start_ns = arrival_ns.max(*free_ns);
                *free_ns = start_ns.saturating_add(transmission_ns(wire_bytes, *rate_bps));
                *free_ns
            }
            Self::Schedule(schedule) => schedule.send(arrival_ns, wire_bytes),
        }
    }

    pub(super) fn mean_ns_per_byte(&self) -> f64 {
        match self {
            Self::Rate { rate_bps, .. } => 8e9 / rate_bps,
            Self::Schedule(schedule) => {
                let carried = schedule.time_ns.len() as u64 * OPPORTUNITY_BYTES;
                schedule.period_ns() as f64 / carried as f64
            }
        }
    }
}

/// Transmission time, rounded to ns once: bits times 1e9 is exact.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates; nothing is negative")]
fn transmission_ns(wire_bytes: u64, rate_bps: f64) -> u64 {
    (wire_bytes as f64 * 8e9 / rate_bps).round() as u64
}

/// Times at which up to 1500 bytes leave each, repeated with the last time as the period.
///
/// A packet leaves with the opportunity that carries its last byte. An opportunity may carry several small
/// packets, and a large packet may take several opportunities. The unused rest is lost if no packet waits. A
/// packet that arrives exactly at an opportunity misses it.
///
/// Source: R. Netravali et al., "Mahimahi: accurate record-and-replay for HTTP", USENIX ATC 2015;
/// `mm-link(1)`.
#[derive(Clone, Debug)]
pub(super) struct Schedule {
    /// Not decreasing, the last above 0.
    time_ns: Vec<u64>,
    current: Option<Use>,
}

/// Opportunity in use: the latest that carried bytes, or the next.
#[derive(Clone, Copy, Debug)]
struct Use {
    cycle: u64,
    position: usize,
    /// Remaining capacity in bytes.
    left: u64,
}

impl Schedule {
    fn period_ns(&self) -> u64 {
        self.time_ns.last().copied().unwrap_or(1)
    }

    fn time_of(&self, at: Use) -> u64 {
        at.cycle.saturating_mul(self.period_ns()).saturating_add(self.time_ns[at.position])
    }

    /// Opportunity that carries the first byte of a packet arriving now.
    fn locate(&self, arrival_ns: u64) -> Use {
        if let Some(current) = self.current
            && arrival_ns < self.time_of(current)
        {
            return if current.left > 0 { current } else { self.skip(current, 1) };
        }
        let cycle = arrival_ns / self.period_ns();
        let offset = arrival_ns % self.period_ns();
        // The offset is below the period, which is the last time, so an opportunity exists.
        let position = self.time_ns.partition_point(|&time_ns| time_ns <= offset);
        Use { cycle, position, left: OPPORTUNITY_BYTES }
    }

    /// Unused opportunity `count` later.
    fn skip(&self, from: Use, count: u64) -> Use {
        let length = self.time_ns.len() as u64;
        let reached = from.position as u64 + count;
        #[expect(clippy::cast_possible_truncation, reason = "below the length of the list")]
        let position = (reached % length) as usize;
        Use { cycle: from.cycle.saturating_add(reached / length), position, left: OPPORTUNITY_BYTES }
    }

    fn send(&mut self, arrival_ns: u64, wire_bytes: u64) -> u64 {
        let mut last = self.locate(arrival_ns);
        if wire_bytes <= last.left {
            last.left -= wire_bytes;
        } else {
            let rest = wire_bytes - last.left;
            let more = rest.div_ceil(OPPORTUNITY_BYTES);
            last = self.skip(last, more);
            last.left = more * OPPORTUNITY_BYTES - rest;
        }
        self.current = Some(last);
        self.time_of(last)
    }
}
