//! A packet as the network sees it, and what becomes of it.

use std::fmt;

/// Which way a packet travels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Direction {
    /// Master to slave.
    Forward,
    /// Slave to master.
    Backward,
}

impl fmt::Display for Direction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Forward => "forward",
            Self::Backward => "backward",
        })
    }
}

/// What a rule may know of a packet: never its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet {
    /// Which way it travels.
    pub direction: Direction,
    /// When it entered the network, monotonic ns.
    pub sent_ns: u64,
    /// Payload in bytes, without UDP and IP headers.
    pub size: usize,
    /// Position in its direction, counted from 0 in sending order; the key of all its random draws.
    pub index: u64,
}

/// What becomes of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It arrives.
    Deliver {
        /// Arrival, monotonic ns, never before the packet was sent.
        at_ns: u64,
    },
    /// It never arrives.
    Drop {
        /// Why.
        cause: DropCause,
    },
}

/// Why a packet never arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum DropCause {
    /// The loss rule took it.
    Loss,
    /// More packets were in flight than the queue holds.
    QueueFull,
}
