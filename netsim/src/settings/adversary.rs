//! Settings of what somebody on the path does.

use serde::{Deserialize, Serialize};

/// Something done to packets on purpose, where they arrive: what was lost before is out of its reach.
///
/// Attacks act in the order of their list. What changes or takes a packet does so to the copies that the network
/// made of it too; what adds one acts once. Of several attacks that flip bits of the same packet the last one does, and
/// of several that alter it.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Attack {
    /// What is done.
    pub action: Action,
    /// To which packets.
    #[serde(default)]
    pub target: Target,
}

/// What is done to packets on purpose.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Action {
    /// A copy arrives `after_s` later.
    Replay {
        /// How much later, in s.
        after_s: f64,
    },
    /// A packet of the same size arrives beside it, with random bytes from `keep_bytes` on.
    Forge {
        /// How many bytes at its start are those of the packet seen.
        #[serde(default)]
        keep_bytes: usize,
    },
    /// Bits of its header are flipped.
    BitFlip {
        /// How many.
        bits: u32,
        /// Within which bytes.
        within: ByteRange,
    },
    /// A copy arrives beside it whose sequence, a little-endian u64, is ahead.
    SequenceLead {
        /// By how much.
        lead: u64,
        /// First byte of the sequence.
        offset: usize,
    },
    /// Numbers in it are changed by somebody who knows where they stand.
    Alter {
        /// Which numbers and how, one after the other: at most 4.
        #[serde(default)]
        edits: Vec<Edit>,
        /// What is put right afterwards.
        #[serde(default)]
        checksum: Option<Checksum>,
        /// Whether an altered copy arrives beside the packet, which itself stays as it is.
        #[serde(default)]
        inject: bool,
    },
    /// It is held back.
    HoldBack {
        /// For how long, in s.
        by_s: f64,
    },
    /// It does not arrive.
    Drop,
    /// A copy goes back to its sender.
    Mirror,
    /// A copy arrives from another source address; in virtual time, which has no addresses, it is a duplicate.
    SecondSource,
}

/// A change of one little-endian number.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "type", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Edit {
    /// Of a binary64.
    F64 {
        /// Its first byte.
        offset: usize,
        /// What is done.
        operation: Operation,
        /// With which number, from -1e12 to 1e12; others, NaN among them, are set as the bits of a u64.
        value: f64,
    },
    /// Of a u64, modulo 2^64.
    U64 {
        /// Its first byte.
        offset: usize,
        /// What is done.
        operation: Operation,
        /// With which number.
        value: u64,
    },
}

/// What is done to a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Operation {
    /// It is replaced.
    Set,
    /// Something is added.
    Add,
    /// It is multiplied.
    Multiply,
}

/// What somebody who knows the format puts right at the end of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Checksum {
    /// CRC-32 (IEEE 802.3) of all bytes but the last four, little-endian in those.
    Crc32,
}

/// Bytes from `start` up to but not including `end`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ByteRange {
    /// First byte.
    pub start: usize,
    /// First byte after it.
    pub end: usize,
}

/// Which packets: those sent at the given times, every n-th of them, each with a probability.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Target {
    /// From when on, in s since the link began.
    pub from_s: f64,
    /// Until when, in s; without it, for ever.
    pub until_s: Option<f64>,
    /// Only packets whose index is a multiple of it.
    pub every: u64,
    /// Smallest payload in bytes.
    pub least_bytes: usize,
    /// Largest payload in bytes.
    pub most_bytes: Option<usize>,
    /// With which probability.
    pub probability: f64,
}

impl Default for Target {
    fn default() -> Self {
        Self { from_s: 0.0, until_s: None, every: 1, least_bytes: 0, most_bytes: None, probability: 1.0 }
    }
}
