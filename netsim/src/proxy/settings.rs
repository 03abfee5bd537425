//! What a proxy is asked to be, and why it may be refused.

use std::io;
use std::net::SocketAddr;

use crate::settings::{LinkError, LinkSettings};
use crate::verdict::Direction;

/// Where a proxy stands and what it does to the datagrams that pass.
#[derive(Clone, Debug, PartialEq)]
pub struct ProxySettings {
    /// Address the client (the master) sends to; port 0 lets the system choose one.
    pub listen: SocketAddr,
    /// Address of the peer (the slave): the only destination, and the only source of answers.
    pub forward: SocketAddr,
    /// Network from client to peer.
    pub forward_link: LinkSettings,
    /// Network from peer to client.
    pub backward_link: LinkSettings,
    /// Key of all random draws.
    pub seed: u64,
}

/// A proxy that cannot be set up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProxyError {
    /// A direction's settings describe no link.
    #[error("link.{direction}: {source}")]
    Link {
        /// Which direction.
        direction: Direction,
        /// What is wrong with it.
        source: LinkError,
    },
    /// The peer's address names no port.
    #[error("forward = {forward}: must name a port from 1 to 65535")]
    NoPort {
        /// The address.
        forward: SocketAddr,
    },
    /// The proxy would forward to itself.
    #[error(
        "forward = {forward}: must not be the proxy's own listen address, or datagrams would go round for ever"
    )]
    Loop {
        /// The address.
        forward: SocketAddr,
    },
    /// An address cannot be used.
    #[error("{key} = {address}: {source}")]
    Socket {
        /// Name of the setting.
        key: &'static str,
        /// Its value.
        address: SocketAddr,
        /// What the operating system says.
        source: io::Error,
    },
}
