//! A packet as the network sees it.

use std::fmt;

/// Direction of travel.
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

/// Packet as a rule sees it: without its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet {
    /// Direction of travel.
    pub direction: Direction,
    /// Time of sending in ns since the link began.
    pub sent_ns: u64,
    /// Payload in bytes, without UDP and IP headers.
    pub size: usize,
    /// Index in its direction, from 0 in sending order; the key of all its random draws.
    pub index: u64,
}
