//! Many datagrams with one call: `recvmmsg` and `sendmmsg`, in memory that is reserved once.

use std::array;
use std::io::{self, IoSlice, IoSliceMut};
use std::net::{SocketAddr, SocketAddrV4, SocketAddrV6};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::sync::atomic::AtomicU64;

use arrayvec::ArrayVec;
use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, MultiHeaders, SockaddrStorage, recvmmsg, sendmmsg};

use super::buffers::MAX_DATAGRAM;
use super::statistics::count;

/// Most datagrams taken with one call.
const MAX_RECEIVED: usize = 64;
/// Most datagrams sent with one call: few, so that the last is not much later than the first.
pub(super) const MAX_SENT: usize = 32;
/// One byte more than is carried, which tells a datagram that is too large.
const CELL: usize = MAX_DATAGRAM + 1;

/// Takes datagrams from sockets of one address family: the kernel writes the length of an address over the room that
/// there is for the next.
pub(super) struct Receiver {
    headers: MultiHeaders<SockaddrStorage>,
    bytes: Vec<u8>,
    /// Length and source of what the last call brought.
    arrived: ArrayVec<(usize, Option<SocketAddr>), MAX_RECEIVED>,
}

impl Receiver {
    pub(super) fn new() -> Self {
        Self {
            headers: MultiHeaders::preallocate(MAX_RECEIVED, None),
            bytes: vec![0; MAX_RECEIVED * CELL],
            arrived: ArrayVec::new(),
        }
    }

    /// Takes what has come, up to a bound; an absent peer is counted and passed over.
    pub(super) fn receive(&mut self, socket: BorrowedFd<'_>, unreachable: &AtomicU64) -> io::Result<()> {
        self.arrived.clear();
        loop {
            let mut bytes = self.bytes.chunks_exact_mut(CELL);
            let mut cells: [_; MAX_RECEIVED] =
                array::from_fn(|_| [IoSliceMut::new(bytes.next().unwrap_or_default())]);
            let received =
                recvmmsg(socket.as_raw_fd(), &mut self.headers, &mut cells, MsgFlags::MSG_DONTWAIT, None);
            match received {
                Ok(messages) => {
                    for message in messages {
                        self.arrived.push((message.bytes, message.address.as_ref().and_then(address)));
                    }
                    return Ok(());
                }
                Err(Errno::EAGAIN) => return Ok(()),
                Err(Errno::EINTR) => {}
                // A call that is wrong in itself would be wrong for ever.
                Err(
                    error @ (Errno::EBADF | Errno::EFAULT | Errno::EINVAL | Errno::ENOTSOCK | Errno::ENOMEM),
                ) => {
                    return Err(error.into());
                }
                // All else the network reports of an earlier datagram, by ICMP, which anybody can send.
                Err(_) => count(unreachable),
            }
        }
    }

    /// What the last call brought.
    pub(super) fn datagrams(&self) -> impl Iterator<Item = (&[u8], Option<SocketAddr>)> {
        let cells = self.bytes.chunks_exact(CELL);
        cells.zip(&self.arrived).map(|(cell, &(length, source))| (&cell[..length.min(CELL)], source))
    }
}

/// Sends datagrams.
pub(super) struct Sender {
    headers: MultiHeaders<SockaddrStorage>,
}

/// What is to be sent with one call.
pub(super) type Outgoing<'a> = ArrayVec<[IoSlice<'a>; 1], MAX_SENT>;
/// Where to; `None` where the socket is connected.
pub(super) type Destinations = ArrayVec<Option<SockaddrStorage>, MAX_SENT>;

impl Sender {
    pub(super) fn new() -> Self {
        Self { headers: MultiHeaders::preallocate(MAX_SENT, None) }
    }

    /// Sends all; bit n of the result says whether the n-th was taken.
    pub(super) fn send(
        &mut self,
        socket: BorrowedFd<'_>,
        outgoing: &Outgoing<'_>,
        destinations: &Destinations,
        unreachable: &AtomicU64,
    ) -> u32 {
        let mut taken = 0;
        let mut next = 0;
        let mut is_repeated = false;
        while next < outgoing.len() {
            let sent = sendmmsg(
                socket.as_raw_fd(),
                &mut self.headers,
                &outgoing[next..],
                &destinations[next..],
                [],
                MsgFlags::MSG_DONTWAIT,
            );
            match sent {
                Ok(messages) => {
                    for _ in messages {
                        taken |= 1 << next;
                        next += 1;
                    }
                    is_repeated = false;
                    continue;
                }
                Err(Errno::EINTR) => continue,
                // The socket reports what became of an earlier datagram and keeps this one back: send it again.
                Err(error) if is_unreachable(error) => {
                    count(unreachable);
                    if !is_repeated {
                        is_repeated = true;
                        continue;
                    }
                }
                Err(_) => {}
            }
            is_repeated = false;
            next += 1;
        }
        taken
    }
}

/// Whether the socket reports, by ICMP, that an earlier datagram found no peer: no reason to stop, it may come up
/// yet.
fn is_unreachable(error: Errno) -> bool {
    matches!(error, Errno::ECONNREFUSED | Errno::EHOSTUNREACH | Errno::ENETDOWN | Errno::ENETUNREACH)
}

fn address(seen: &SockaddrStorage) -> Option<SocketAddr> {
    let v4 = seen.as_sockaddr_in().map(|seen| SocketAddrV4::from(*seen).into());
    v4.or_else(|| seen.as_sockaddr_in6().map(|seen| SocketAddrV6::from(*seen).into()))
}
