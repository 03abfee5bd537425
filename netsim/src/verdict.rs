//! Verdict on a packet.

use crate::damage::Damage;

/// Verdict on a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The packet arrives.
    Deliver {
        /// Arrival in ns since the link began, never before the packet was sent.
        at_ns: u64,
    },
    /// The packet never arrives.
    Drop {
        /// Cause.
        cause: DropCause,
    },
}

impl Verdict {
    /// Drop the packet with `cause` if `taken`; otherwise delivers it at `at_ns`.
    pub(crate) const fn unless(taken: bool, cause: DropCause, at_ns: u64) -> Self {
        if taken { Self::Drop { cause } } else { Self::Deliver { at_ns } }
    }
}

/// Why a packet never arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum DropCause {
    /// Dropped by the loss rule.
    Loss,
    /// Sent during an outage.
    Outage,
    /// Larger than the MTU.
    Mtu,
    /// The bottleneck's queue was full.
    Queue,
    /// Dropped from the queue by `CoDel`.
    Codel,
    /// Lost in the replayed recording.
    Trace,
    /// Dropped by an attacker on the path.
    Attack,
    /// More packets were in flight than the driver holds.
    InFlight,
}

impl DropCause {
    /// All causes, in numeric order.
    pub const ALL: [Self; 8] = [
        Self::Loss,
        Self::Outage,
        Self::Mtu,
        Self::Queue,
        Self::Codel,
        Self::Trace,
        Self::Attack,
        Self::InFlight,
    ];

    /// Name in logs and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Loss => "loss",
            Self::Outage => "outage",
            Self::Mtu => "mtu",
            Self::Queue => "queue",
            Self::Codel => "codel",
            Self::Trace => "trace",
            Self::Attack => "attack",
            Self::InFlight => "in-flight",
        }
    }
}

/// Additional packet that arrives because of another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extra {
    /// Arrival in ns since the link began, never before the packet was sent.
    pub at_ns: u64,
    /// Cause.
    pub cause: ExtraCause,
    /// Difference of its bytes from those of the packet.
    pub damage: Damage,
}

/// Why an additional packet arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ExtraCause {
    /// The network delivers the packet twice.
    Duplicate,
    /// An attacker replays a packet it has seen.
    Replay,
    /// An attacker sends forged bytes.
    Forge,
    /// An attacker sends a copy with an advanced sequence.
    SequenceLead,
    /// An attacker reflects the packet to its sender.
    Mirror,
    /// An attacker forwards the packet from another address.
    SecondSource,
    /// An attacker sends the packet with altered numbers.
    Alter,
}

impl ExtraCause {
    /// All causes, in numeric order.
    pub const ALL: [Self; 7] = [
        Self::Duplicate,
        Self::Replay,
        Self::Forge,
        Self::SequenceLead,
        Self::Mirror,
        Self::SecondSource,
        Self::Alter,
    ];

    /// Name in logs and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Duplicate => "duplicate",
            Self::Replay => "replay",
            Self::Forge => "forge",
            Self::SequenceLead => "sequence-lead",
            Self::Mirror => "mirror",
            Self::SecondSource => "second-source",
            Self::Alter => "alter",
        }
    }
}

/// Complete result for a packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judgement<'a> {
    /// Verdict on the packet itself.
    pub verdict: Verdict,
    /// Changes of its bytes in transit.
    pub damage: &'a Damage,
    /// Additional packets; a dropped packet may leave copies behind.
    pub extras: &'a [Extra],
}
