//! A UDP socket that talks to one peer and never blocks.

use std::{
    io,
    net::{SocketAddr, UdpSocket},
};

use super::clock;
use crate::session::MAX_DATAGRAM;

/// Datagrams between two looks at the clock.
const ROUND: usize = 32;
/// Datagrams taken at once, however fast they are.
const MOST_DATAGRAMS: usize = 4096;

/// How the peer is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PeerAddress {
    /// Sends there from the start.
    Known(SocketAddr),
    /// Answers where the last good frame came from.
    Learned,
}

/// A non-blocking UDP socket and its peer.
#[derive(Debug)]
pub struct PeerSocket {
    socket: UdpSocket,
    peer: Option<SocketAddr>,
    learns: bool,
    /// Frames that the system refused to send: nobody listens there, or its buffer was full.
    pub unsent: u64,
}

impl PeerSocket {
    /// Binds to `local`.
    pub fn bind(local: SocketAddr, peer: PeerAddress) -> io::Result<Self> {
        let socket = UdpSocket::bind(local)?;
        socket.set_nonblocking(true)?;
        let (peer, learns) = match peer {
            PeerAddress::Known(address) => (Some(address), false),
            PeerAddress::Learned => (None, true),
        };
        Ok(Self { socket, peer, learns, unsent: 0 })
    }

    /// Where it listens.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Gives each datagram that waits to `take`, which says whether it was good, until the clock shows `until_ns`.
    ///
    /// A datagram from elsewhere than a known peer is not looked at. At least [`ROUND`] are taken: a loop that woke
    /// late must hear its peer, too.
    pub fn drain(&mut self, until_ns: u64, mut take: impl FnMut(SocketAddr, &mut [u8]) -> bool) {
        // One byte more than the longest datagram, so that a longer one is seen to be too long.
        let mut buffer = [0; MAX_DATAGRAM + 1];
        for taken in 0..MOST_DATAGRAMS {
            if taken % ROUND == ROUND - 1 && clock::now_ns() >= until_ns {
                return;
            }
            match self.socket.recv_from(&mut buffer) {
                Ok((length, from)) => {
                    if !self.learns && self.peer != Some(from) {
                        continue;
                    }
                    if take(from, &mut buffer[..length]) && self.learns {
                        self.peer = Some(from);
                    }
                }
                // Nobody listens there (yet): a later frame may find somebody.
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return,
            }
        }
    }

    /// Throws away what waits: it is old.
    pub fn discard(&mut self) {
        let mut buffer = [0; 1];
        // A bound, because a flood could otherwise hold the loop here; a buffer holds far less.
        for _ in 0..100_000 {
            if let Err(error) = self.socket.recv_from(&mut buffer)
                && error.kind() == io::ErrorKind::WouldBlock
            {
                return;
            }
        }
    }

    /// Sends to `to` or, without it, to the peer, if there is one.
    pub fn send(&mut self, to: Option<SocketAddr>, datagram: &[u8]) {
        if let Some(to) = to.or(self.peer)
            && self.socket.send_to(datagram, to).is_err()
        {
            self.unsent += 1;
        }
    }
}
