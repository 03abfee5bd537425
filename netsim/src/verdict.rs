//! What becomes of a packet.

use crate::damage::Damage;

/// What becomes of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It arrives.
    Deliver {
        /// Arrival in ns since the link began, never before the packet was sent.
        at_ns: u64,
    },
    /// It never arrives.
    Drop {
        /// Why.
        cause: DropCause,
    },
}

impl Verdict {
    /// Drops a packet with a cause if something takes it; else it arrives at `at_ns`.
    pub(crate) const fn unless(taken: bool, cause: DropCause, at_ns: u64) -> Self {
        if taken { Self::Drop { cause } } else { Self::Deliver { at_ns } }
    }
}

/// Why a packet never arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum DropCause {
    /// The loss rule took it.
    Loss,
    /// It was sent during an outage.
    Outage,
    /// It is larger than the path carries.
    Mtu,
    /// The queue of the bottleneck was full.
    Queue,
    /// `CoDel` took it from the queue.
    Codel,
    /// The recording that is replayed lost it.
    Trace,
    /// Somebody on the path took it.
    Attack,
    /// More packets were in flight than the driver holds.
    InFlight,
}

impl DropCause {
    /// All of them, in the order of their numbers.
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

    /// Its name in logs and tables.
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

/// Something that arrives beside a packet and because of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extra {
    /// Arrival in ns since the link began, never before the packet was sent.
    pub at_ns: u64,
    /// Why there is one.
    pub cause: ExtraCause,
    /// How its bytes differ from those of the packet.
    pub damage: Damage,
}

/// Why something arrives beside a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ExtraCause {
    /// The network delivers the packet twice.
    Duplicate,
    /// Somebody sends what was seen again.
    Replay,
    /// Somebody sends made-up bytes.
    Forge,
    /// Somebody sends a sequence that is ahead.
    SequenceLead,
    /// Somebody sends it back: it goes to the sender.
    Mirror,
    /// Somebody sends it on from another address.
    SecondSource,
    /// Somebody sends it with other numbers in it.
    Alter,
}

impl ExtraCause {
    /// All of them, in the order of their numbers.
    pub const ALL: [Self; 7] = [
        Self::Duplicate,
        Self::Replay,
        Self::Forge,
        Self::SequenceLead,
        Self::Mirror,
        Self::SecondSource,
        Self::Alter,
    ];

    /// Its name in logs and tables.
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

/// All that becomes of a packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judgement<'a> {
    /// What becomes of the packet itself.
    pub verdict: Verdict,
    /// How its bytes change in transit.
    pub damage: &'a Damage,
    /// What arrives beside it; a packet that somebody took may leave copies behind.
    pub extras: &'a [Extra],
}
