//! A UDP socket that talks to one peer and never blocks.

use std::{
    io,
    net::{SocketAddr, UdpSocket},
};

use super::{
    clock,
    route::{Heard, Route},
};
use crate::session::MAX_DATAGRAM;

/// Datagrams between two looks at the clock.
const ROUND: usize = 32;
/// Datagrams taken at once, however fast they are.
const MAX_DATAGRAMS: usize = 4096;

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
    route: Route,
    /// Frames that the system refused to send: nobody listens there, or its buffer was full.
    pub unsent: u64,
}

impl PeerSocket {
    /// Binds to `local`.
    pub fn bind(local: SocketAddr, peer: PeerAddress) -> io::Result<Self> {
        let socket = UdpSocket::bind(local)?;
        socket.set_nonblocking(true)?;
        let route = match peer {
            PeerAddress::Known(address) => Route::known(address),
            PeerAddress::Learned => Route::learned(),
        };
        Ok(Self { socket, route, unsent: 0 })
    }

    /// Where it listens.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Gives each datagram that waits to `take`, which says what it was, until the clock shows `until_ns`.
    ///
    /// A datagram from elsewhere than a known peer is not looked at. At least [`ROUND`] are taken: a loop that woke late
    /// must hear its peer, too.
    pub(super) fn drain(
        &mut self,
        now_ns: u64,
        until_ns: u64,
        mut take: impl FnMut(SocketAddr, &mut [u8]) -> Heard,
    ) {
        // One byte more than the longest datagram, so that a longer one is seen to be too long.
        let mut buffer = [0; MAX_DATAGRAM + 1];
        for taken in 0..MAX_DATAGRAMS {
            if taken > 0 && taken % ROUND == 0 && clock::now_ns() >= until_ns {
                return;
            }
            match self.socket.recv_from(&mut buffer) {
                Ok((length, from)) => {
                    if self.route.admits(from) {
                        let heard = take(from, &mut buffer[..length]);
                        self.route.heard(now_ns, from, heard);
                    }
                }
                // Nobody listens there (yet): a later frame may find somebody.
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return,
            }
        }
    }

    /// Throws away what waits: it is old. Until the clock shows `until_ns`: a flood must not hold the loop here.
    pub fn discard(&mut self, until_ns: u64) {
        let mut buffer = [0; 1];
        for thrown in 1..=MAX_DATAGRAMS {
            if thrown % ROUND == 0 && clock::now_ns() >= until_ns {
                return;
            }
            if let Err(error) = self.socket.recv_from(&mut buffer)
                && error.kind() == io::ErrorKind::WouldBlock
            {
                return;
            }
        }
    }

    /// Sends to `to` or, without it, to the peer, if there is one.
    pub fn send(&mut self, to: Option<SocketAddr>, datagram: &[u8]) {
        let to = if to.is_some() { [to, None] } else { self.route.next() };
        for to in to.into_iter().flatten() {
            self.unsent += u64::from(self.socket.send_to(datagram, to).is_err());
        }
    }
}
