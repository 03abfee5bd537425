//! Settings of the bottleneck.

use serde::{Deserialize, Serialize};

/// What a queue that fills does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Discipline {
    /// It drops what comes while it is full.
    #[default]
    TailDrop,
    /// Besides, it drops when packets have waited too long for a while: target 5 ms, interval 100 ms. What waits is
    /// counted when a packet enters, not when it leaves.
    ///
    /// Source: RFC 8289.
    Codel,
}

/// Other traffic through the same bottleneck: packets at random times (Poisson).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CrossTraffic {
    /// Mean rate in bit/s while it sends, headers included.
    pub rate_bps: f64,
    /// Size of its packets in bytes, headers included.
    #[serde(default = "full_size")]
    pub packet_bytes: usize,
    /// Mean time in s that it sends before it pauses; exponentially distributed. Without it, it never pauses.
    #[serde(default)]
    pub mean_on_s: Option<f64>,
    /// Mean time in s that it pauses.
    #[serde(default)]
    pub mean_off_s: Option<f64>,
}

fn full_size() -> usize {
    1500
}

/// Times at which the bottleneck may send 1500 bytes each, repeated for ever with the last time as the period. A packet
/// leaves with the opportunity that carries its last byte; what nothing waits for is lost.
///
/// Source: mahimahi, `mm-link` traces.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Opportunities {
    /// Times in ms, not decreasing, the last above 0: after it the list begins anew.
    pub time_ms: Vec<u64>,
}
