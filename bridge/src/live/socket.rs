//! A UDP socket that talks to one peer and never blocks.

use std::{
    io,
    net::{SocketAddr, UdpSocket},
};

use super::clock;
use crate::session::MAX_DATAGRAM;

/// Datagrams between two looks at the clock.
const ROUND: usize = 32;
/// Silence in ns after which a peer may be elsewhere: that after which the ladder holds.
const MOVES_AFTER_NS: u64 = 20_000_000;
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
    /// When the peer was last heard where it is, in ns.
    heard_ns: u64,
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
        Ok(Self { socket, peer, learns, heard_ns: 0, unsent: 0 })
    }

    /// Where it listens.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Gives each datagram that waits to `take`, which says whether it was good, until the clock shows `until_ns`.
    ///
    /// A datagram from elsewhere than a known peer is not looked at. A peer that was learned is followed elsewhere only
    /// once it has been silent for [`MOVES_AFTER_NS`] where it was: who copies its frames, and is faster, does not draw
    /// the answers away from it. At least [`ROUND`] are taken: a loop that woke late must hear its peer, too.
    pub fn drain(&mut self, now_ns: u64, until_ns: u64, mut take: impl FnMut(SocketAddr, &mut [u8]) -> bool) {
        // One byte more than the longest datagram, so that a longer one is seen to be too long.
        let mut buffer = [0; MAX_DATAGRAM + 1];
        for taken in 0..MOST_DATAGRAMS {
            if taken > 0 && taken % ROUND == 0 && clock::now_ns() >= until_ns {
                return;
            }
            match self.socket.recv_from(&mut buffer) {
                Ok((length, from)) => {
                    if !self.learns && self.peer != Some(from) {
                        continue;
                    }
                    let stays = self.peer == Some(from);
                    let may_move = self.learns && now_ns.saturating_sub(self.heard_ns) > MOVES_AFTER_NS;
                    if take(from, &mut buffer[..length]) && (stays || may_move) {
                        (self.peer, self.heard_ns) = (Some(from), now_ns);
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
        for thrown in 1..=MOST_DATAGRAMS {
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
        if let Some(to) = to.or(self.peer)
            && self.socket.send_to(datagram, to).is_err()
        {
            self.unsent += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const MS: u64 = 1_000_000;

    fn client(to: SocketAddr) -> UdpSocket {
        let client = UdpSocket::bind("127.0.0.1:0").unwrap();
        client.connect(to).unwrap();
        client.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        client
    }

    /// Takes one datagram of which the session says `good`, at `now_ns`.
    fn hears(socket: &mut PeerSocket, from: &UdpSocket, now_ns: u64, good: bool) {
        from.send(&[1; 8]).unwrap();
        let mut heard = 0;
        // Loopback has it there at once, but nothing says when.
        for _ in 0..5000 {
            socket.drain(now_ns, u64::MAX, |_, datagram| {
                heard += datagram.len();
                good
            });
            if heard > 0 {
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        panic!("nothing arrived");
    }

    fn answers(socket: &mut PeerSocket, at: &UdpSocket, said: u8) -> bool {
        socket.send(None, &[said]);
        let mut buffer = [0; 2];
        at.recv(&mut buffer).is_ok_and(|length| buffer[..length] == [said])
    }

    #[test]
    fn a_learned_peer_is_followed_only_once_it_is_silent() {
        let mut socket = PeerSocket::bind("127.0.0.1:0".parse().unwrap(), PeerAddress::Learned).unwrap();
        let here = socket.local_address().unwrap();
        let (peer, other) = (client(here), client(here));
        // What is not good teaches nothing.
        hears(&mut socket, &other, 1000 * MS, false);
        socket.send(None, &[9]);
        hears(&mut socket, &peer, 1000 * MS, true);
        assert!(answers(&mut socket, &peer, 1));
        // A copy of the peer's frame that was faster than the peer.
        hears(&mut socket, &other, 1020 * MS, true);
        assert!(answers(&mut socket, &peer, 2), "20 ms are no silence");
        hears(&mut socket, &peer, 1021 * MS, true);
        hears(&mut socket, &other, 1041 * MS, true);
        assert!(answers(&mut socket, &peer, 3), "the peer was heard since");
        hears(&mut socket, &other, 1042 * MS, false);
        assert!(answers(&mut socket, &peer, 4));
        hears(&mut socket, &other, 1042 * MS, true);
        assert!(answers(&mut socket, &other, 5), "21 ms are");
    }
}
