//! Cross traffic through the bottleneck: packets at random times, with optional pauses.
//!
//! Arrivals are a Poisson process, drawn by time bins, so that they depend only on seed and time. Pauses
//! remove arrivals.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::checks::{LinkSettingsError, within};
use crate::random::Stream;

const MIN_RATE_BPS: f64 = 1.0;
const MAX_RATE_BPS: f64 = 1e11;
/// Maximum packets per second: a gap in the link's own packets costs about a second of them.
const MAX_PER_S: f64 = 1e6;
const MAX_PACKET_BYTES: usize = 65_535;
/// Mean number of packets per bin.
const PER_BIN: f64 = 16.0;
/// Maximum number of packets drawn to settle the queue after a silence.
const MAX_TO_SETTLE: f64 = 2e6;
/// Mean number of on-off cycles per bin of pauses.
const PAUSES_PER_BIN: f64 = 256.0;
const MIN_MEAN_S: f64 = 1e-6;
const MAX_MEAN_S: f64 = 1e6;

/// Cross traffic through the same bottleneck: packets at random times (Poisson).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CrossTraffic {
    /// Mean rate in bit/s while sending, headers included.
    pub rate_bps: f64,
    /// Packet size in bytes, headers included.
    #[serde(default = "full_size")]
    pub packet_bytes: usize,
    /// Mean sending time in s between pauses; exponentially distributed. If absent, it never pauses.
    #[serde(default)]
    pub mean_on_s: Option<f64>,
    /// Mean pause in s.
    #[serde(default)]
    pub mean_off_s: Option<f64>,
}

fn full_size() -> usize {
    1500
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Cross {
    packet_bytes: u64,
    mean_gap_ns: f64,
    bin_ns: u64,
    /// Minimum time before a packet from which traffic is drawn, so that the queue forgets its initial state.
    settle_ns: u64,
    stream: Stream,
    pauses: Option<Pauses>,
    bin: u64,
    position: usize,
    /// Arrival of the next packet, from the start of the bin.
    offset_ns: f64,
    judged_ns: u64,
}

impl Cross {
    /// `drain_ns` is the time in which a full queue drains.
    pub(super) fn new(
        settings: &CrossTraffic,
        drain_ns: f64,
        stream: Stream,
    ) -> Result<Self, LinkSettingsError> {
        within("cross_traffic.rate_bps", settings.rate_bps, MIN_RATE_BPS, MAX_RATE_BPS)?;
        within("cross_traffic.packet_bytes", settings.packet_bytes as f64, 1.0, MAX_PACKET_BYTES as f64)?;
        let packet_bits = settings.packet_bytes as f64 * 8.0;
        let per_s = settings.rate_bps / packet_bits;
        if per_s > MAX_PER_S {
            return Err(LinkSettingsError::contradiction(
                "cross_traffic",
                format!("{per_s} packets/s; at most {MAX_PER_S} are allowed: ask for larger packets"),
            ));
        }
        let pauses = Pauses::new(settings, stream.nth(1))?;
        let mean_gap_ns = 1e9 / per_s;
        let settle_ns = (1e9 + 2.0 * drain_ns).min(MAX_TO_SETTLE * mean_gap_ns);
        let mut cross = Self {
            packet_bytes: settings.packet_bytes as u64,
            mean_gap_ns,
            bin_ns: truncated_ns(PER_BIN * mean_gap_ns).max(1),
            settle_ns: truncated_ns(settle_ns),
            stream,
            pauses,
            bin: 0,
            position: 0,
            offset_ns: 0.0,
            judged_ns: 0,
        };
        cross.draw();
        Ok(cross)
    }

    pub(super) fn packet_bytes(&self) -> u64 {
        self.packet_bytes
    }

    /// Skip traffic that the queue has forgotten by `now_ns`, which bounds the cost of a silence.
    pub(super) fn skip_silence(&mut self, now_ns: u64) {
        let silence_ns = now_ns.saturating_sub(self.judged_ns);
        self.judged_ns = now_ns;
        if silence_ns > self.settle_ns {
            let bin = (now_ns - self.settle_ns) / self.bin_ns;
            if bin > self.bin {
                self.begin(bin);
                self.draw();
            }
        }
    }

    /// Next arrival before `now_ns`, if any.
    pub(super) fn next_before(&mut self, now_ns: u64) -> Option<u64> {
        loop {
            let begin_ns = self.bin.saturating_mul(self.bin_ns);
            let arrival_ns = begin_ns.saturating_add(truncated_ns(self.offset_ns));
            if arrival_ns >= now_ns {
                return None;
            }
            self.draw();
            if self.pauses.as_mut().is_none_or(|pauses| pauses.sends_at(arrival_ns)) {
                return Some(arrival_ns);
            }
        }
    }

    fn begin(&mut self, bin: u64) {
        self.bin = bin;
        self.position = 0;
        self.offset_ns = 0.0;
    }

    /// Exponential gaps are memoryless, so restarting in each bin leaves the process unchanged.
    fn draw(&mut self) {
        loop {
            let gap = exponential(self.stream.at(self.bin, self.position));
            self.offset_ns += gap * self.mean_gap_ns;
            self.position += 1;
            if self.offset_ns < self.bin_ns as f64 {
                return;
            }
            self.begin(self.bin.saturating_add(1));
        }
    }
}

/// Alternating times of sending and pausing, each exponentially distributed.
///
/// Each time bin starts in a newly drawn state, weighted by the mean times. This shortens or extends about
/// one period in 500.
#[derive(Clone, Copy, Debug)]
struct Pauses {
    mean_on_ns: f64,
    mean_off_ns: f64,
    bin_ns: u64,
    stream: Stream,
    bin: u64,
    period: usize,
    sends: bool,
    until_ns: f64,
}

impl Pauses {
    fn new(settings: &CrossTraffic, stream: Stream) -> Result<Option<Self>, LinkSettingsError> {
        let (on_s, off_s) = match (settings.mean_on_s, settings.mean_off_s) {
            (None, None) => return Ok(None),
            (Some(on_s), Some(off_s)) => (on_s, off_s),
            _ => {
                return Err(LinkSettingsError::contradiction(
                    "cross_traffic",
                    "mean_on_s and mean_off_s belong together: give both or neither",
                ));
            }
        };
        within("cross_traffic.mean_on_s", on_s, MIN_MEAN_S, MAX_MEAN_S)?;
        within("cross_traffic.mean_off_s", off_s, MIN_MEAN_S, MAX_MEAN_S)?;
        let (mean_on_ns, mean_off_ns) = (on_s * 1e9, off_s * 1e9);
        let bin_ns = truncated_ns(PAUSES_PER_BIN * (mean_on_ns + mean_off_ns));
        let mut pauses =
            Self { mean_on_ns, mean_off_ns, bin_ns, stream, bin: 0, period: 0, sends: false, until_ns: 0.0 };
        pauses.begin(0);
        Ok(Some(pauses))
    }

    fn begin(&mut self, bin: u64) {
        self.bin = bin;
        self.period = 0;
        let share = self.mean_on_ns / (self.mean_on_ns + self.mean_off_ns);
        self.sends = self.stream.unit(bin) < share;
        self.until_ns = 0.0;
        self.prolong();
    }

    fn prolong(&mut self) {
        let mean_ns = if self.sends { self.mean_on_ns } else { self.mean_off_ns };
        self.until_ns += mean_ns * exponential(self.stream.at(self.bin, self.period));
        self.period += 1;
    }

    /// Require times that do not go back.
    fn sends_at(&mut self, now_ns: u64) -> bool {
        let bin = now_ns / self.bin_ns;
        if bin != self.bin {
            self.begin(bin);
        }
        let offset_ns = (now_ns % self.bin_ns) as f64;
        while self.until_ns <= offset_ns {
            self.sends = !self.sends;
            self.prolong();
        }
        self.sends
    }
}

/// Exponential variate of mean 1.
fn exponential(bits: u64) -> f64 {
    -libm::log(crate::random::unit(bits))
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates; nothing is negative")]
fn truncated_ns(ns: f64) -> u64 {
    ns as u64
}
