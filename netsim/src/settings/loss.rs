//! Settings of loss and outages.

use serde::{Deserialize, Serialize};

/// Gilbert-Elliott: two states, each with its own probability of loss.
///
/// Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; E. O. Elliott, Bell Syst. Tech. J. 42, 1963.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct GilbertElliott {
    /// p: probability that the good state turns bad, per packet.
    pub to_bad: f64,
    /// r: probability that the bad state turns good, per packet.
    pub to_good: f64,
    /// 1 - k: probability of loss in the good state.
    #[serde(default)]
    pub loss_good: f64,
    /// 1 - h: probability of loss in the bad state.
    #[serde(default = "one")]
    pub loss_bad: f64,
}

/// Four states: 1 good, 2 good within a burst, 3 lost within a burst, 4 lost alone. `pij` leads from i to j.
///
/// Source: S. Salsano, F. Ludovici, A. Ordine, D. Giannuzzi, "Definition of a general and intuitive loss model for
/// packet networks and its implementation in the Netem module in the Linux kernel", 2012 (GI model).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct FourState {
    /// A burst begins.
    pub p13: f64,
    /// A burst ends.
    pub p31: f64,
    /// Packets pass within a burst.
    #[serde(default)]
    pub p32: f64,
    /// Packets are lost again within a burst.
    #[serde(default = "one")]
    pub p23: f64,
    /// A packet is lost alone.
    #[serde(default)]
    pub p14: f64,
}

fn one() -> f64 {
    1.0
}

/// Times at which nothing passes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Outage {
    /// When.
    pub times: OutageTimes,
    /// What becomes of the packets.
    #[serde(default)]
    pub effect: OutageEffect,
}

/// When nothing passes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum OutageTimes {
    /// Once.
    Once {
        /// When it begins, in s since the link began.
        at_s: f64,
        /// How long it lasts in s.
        duration_s: f64,
    },
    /// Again and again.
    Periodic {
        /// When the first one begins, in s since the link began.
        at_s: f64,
        /// From one beginning to the next, in s.
        period_s: f64,
        /// How long each lasts in s.
        duration_s: f64,
    },
    /// At random: both times are exponentially distributed.
    Random {
        /// Mean time in s between an end and the next beginning.
        mean_up_s: f64,
        /// Mean time in s that one lasts, at most 1000 times `mean_up_s`.
        mean_down_s: f64,
    },
}

/// What becomes of packets that are sent during an outage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum OutageEffect {
    /// They are dropped.
    #[default]
    Drop,
    /// They are held, and arrive together once it is over.
    Hold,
}
