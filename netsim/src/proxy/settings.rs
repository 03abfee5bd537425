//! Settings of a proxy, and their errors.

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

use crate::address::ip_and_zone;
use crate::checks::LinkSettingsError;
use crate::impairments::LinkSettings;
use crate::packet::Direction;

/// Addresses and links of a proxy.
#[derive(Clone, Debug, PartialEq)]
pub struct ProxySettings {
    /// Address the client (the master) sends to; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// Address of the peer (the slave): the only destination, and the only source of answers.
    pub forward: SocketAddr,
    /// Network from client to peer.
    pub forward_link: LinkSettings,
    /// Network from peer to client.
    pub backward_link: LinkSettings,
    /// Seed of all random draws.
    pub seed: u64,
    /// Permitted sources in addition to those of this machine, which are always permitted.
    pub allow: Vec<Source>,
    /// Requests real-time scheduling; the statistics report the scheduling granted.
    pub realtime: bool,
    /// Maximum p99 of the scheduling error in s for a valid run.
    pub max_error_s: f64,
    /// CSV file for the outcome of each datagram; an existing file is replaced.
    pub log: Option<PathBuf>,
}

impl ProxySettings {
    /// Perfect network to `forward` and back.
    pub fn new(listen: SocketAddr, forward: SocketAddr) -> Self {
        Self {
            listen,
            forward,
            forward_link: LinkSettings::default(),
            backward_link: LinkSettings::default(),
            seed: 0,
            allow: Vec::new(),
            realtime: true,
            max_error_s: 1e-3,
            log: None,
        }
    }
}

/// Permitted source of datagrams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Source {
    ip: IpAddr,
    /// Zone of a link-local address; 0 for all.
    zone: u32,
    /// Port of one socket; `None` for all of the machine.
    port: Option<u16>,
}

impl Source {
    pub(super) fn covers(self, source: SocketAddr) -> bool {
        let zone = match source {
            SocketAddr::V4(_) => 0,
            SocketAddr::V6(source) => source.scope_id(),
        };
        source.ip().to_canonical() == self.ip.to_canonical()
            && (self.zone == 0 || self.zone == zone)
            && self.port.is_none_or(|port| port == source.port())
    }
}

impl std::str::FromStr for Source {
    type Err = String;

    /// Parse an address with an optional port and an optional zone.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let socket = text.strip_prefix('[').and_then(|rest| rest.rsplit_once("]:"));
        let socket = socket.or_else(|| text.rsplit_once(':').filter(|(ip, _)| !ip.contains(':')));
        let (ip, port) = match socket {
            Some((ip, port)) => (ip, Some(port.parse().map_err(|_| "invalid port value".to_owned())?)),
            None => (text, None),
        };
        let (ip, zone) = ip_and_zone(ip)?;
        Ok(Self { ip, zone, port })
    }
}

/// Error in setting up a proxy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProxyError {
    /// The link settings of a direction are invalid.
    #[error("link.{direction}: {source}")]
    Link {
        /// Direction.
        direction: Direction,
        /// Cause.
        source: LinkSettingsError,
    },
    /// The peer's address has no port.
    #[error("forward = {forward}: must name a port from 1 to 65535")]
    NoPort {
        /// Address.
        forward: SocketAddr,
    },
    /// The proxy would forward to itself.
    #[error(
        "forward = {forward}: must not be the proxy's own listen address, or datagrams would go round for ever"
    )]
    Loop {
        /// Address.
        forward: SocketAddr,
    },
    /// The limit of the scheduling error is invalid.
    #[error("max_error_s = {seen}: must be a finite number above 0, at most 1")]
    MaxError {
        /// Limit given.
        seen: f64,
    },
    /// The log cannot be written.
    #[error("log = {path}: {source}")]
    Log {
        /// Path of the log.
        path: String,
        /// Error of the operating system.
        source: io::Error,
    },
    /// An address is unusable.
    #[error("{key} = {address}: {source}")]
    Socket {
        /// Name of the setting.
        key: &'static str,
        /// Value of the setting.
        address: SocketAddr,
        /// Error of the operating system.
        source: io::Error,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_a_machine_or_one_of_its_sockets() {
        for (allowed, source, is_covered) in [
            ("10.0.0.1", "10.0.0.1:7", true),
            ("10.0.0.1", "10.0.0.2:7", false),
            ("10.0.0.1", "[::ffff:10.0.0.1]:7", true),
            ("10.0.0.1:7", "10.0.0.1:7", true),
            ("10.0.0.1:7", "10.0.0.1:8", false),
            ("fe80::1", "[fe80::1]:7", true),
            ("[fe80::1]:7", "[fe80::1]:7", true),
            ("fe80::1", "[fe80::1%3]:7", true),
            ("fe80::1%3", "[fe80::1%3]:7", true),
            ("fe80::1%3", "[fe80::1%4]:7", false),
            ("[fe80::1%3]:7", "[fe80::1%3]:7", true),
            ("[fe80::1%3]:7", "[fe80::1%3]:8", false),
        ] {
            let allowed: Source = allowed.parse().unwrap();
            assert_eq!(allowed.covers(source.parse().unwrap()), is_covered, "{allowed:?} {source}");
        }
        for text in ["master", "10.0.0.1:", "10.0.0.1:70000", "[fe80::1]", "fe80::1%nowhere", "10.0.0.1%lo"] {
            assert!(text.parse::<Source>().is_err(), "{text}");
        }
    }
}
