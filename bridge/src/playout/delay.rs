//! How long a packet of least delay is to wait.

use super::{Jitter, PlayoutPolicy};

/// Share of a new packet in the mean: 1/512, near the `1 - 0.998002` of the paper.
const MEMORY: i64 = 512;

/// The wait that a policy asks for.
///
/// The jitter of RFC 3550 sees the change from one packet to the next only. At 1 kHz the delay of a real path changes
/// little in a millisecond and much in a second, so that this alone waits far too short. Therefore the greater of two
/// waits is taken: `k J`, and that which reaches `k` mean deviations above the mean delay.
///
/// Source: RFC 3550, section 6.4.1; R. Ramjee, J. Kurose, D. Towsley, H. Schulzrinne (1994), Adaptive playout
/// mechanisms for packetized audio applications in wide-area networks, algorithm 1.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Wait {
    jitter: Jitter,
    /// Mean and mean deviation of the transit after `origin_ns`, scaled by [`MEMORY`].
    mean_scaled: i64,
    deviation_scaled: i64,
    origin_ns: Option<i64>,
    /// Packets taken, up to [`MEMORY`]: the first ones weigh alike.
    count: i64,
}

impl Wait {
    pub(super) fn new() -> Self {
        Self { jitter: Jitter::default(), mean_scaled: 0, deviation_scaled: 0, origin_ns: None, count: 0 }
    }

    /// Takes a packet of transit `now_ns - sent_ns`.
    pub(super) fn arrived(&mut self, sent_ns: u64, now_ns: u64, transit_ns: i64) {
        self.jitter.arrived(sent_ns, now_ns);
        let origin = *self.origin_ns.get_or_insert(transit_ns);
        let limit = i64::MAX / (4 * MEMORY);
        let transit = transit_ns.saturating_sub(origin).clamp(-limit, limit);
        self.count = (self.count + 1).min(MEMORY);
        self.mean_scaled += (transit * MEMORY - self.mean_scaled) / self.count;
        let deviation = (transit * MEMORY - self.mean_scaled).abs();
        self.deviation_scaled += (deviation - self.deviation_scaled) / self.count;
    }

    /// The wait in ns of a packet whose transit is the least one.
    pub(super) fn wait_ns(&self, policy: PlayoutPolicy, least_transit_ns: i64) -> i64 {
        let wait = match policy {
            PlayoutPolicy::Newest => 0,
            PlayoutPolicy::Constant { delay_ns } => delay_ns,
            PlayoutPolicy::Adaptive { factor, least_ns, most_ns } => {
                let factor = u64::from(factor);
                let by_jitter = factor.saturating_mul(self.jitter.jitter_ns());
                let origin = self.origin_ns.unwrap_or(least_transit_ns);
                let mean = origin.saturating_add(self.mean_scaled / MEMORY);
                let above = u64::try_from(mean.saturating_sub(least_transit_ns)).unwrap_or(0);
                let deviation = (self.deviation_scaled / MEMORY).unsigned_abs();
                let by_spread = above.saturating_add(factor.saturating_mul(deviation));
                by_jitter.max(by_spread).clamp(least_ns, most_ns)
            }
        };
        i64::try_from(wait).unwrap_or(i64::MAX)
    }
}
