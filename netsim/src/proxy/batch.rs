//! Datagrams in memory reserved once: batches per `recvmmsg` or `sendmmsg` call, and fixed cells for
//! datagrams in flight.

use super::statistics::count;
use crate::reply::{self, ReplyAddress, reply_address};
use arrayvec::ArrayVec;
use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, MultiHeaders, SockaddrStorage, recvmmsg};
use std::array;
use std::io::{self, IoSlice, IoSliceMut};
use std::net::IpAddr;
use std::os::fd::{AsRawFd, BorrowedFd};
use std::sync::atomic::AtomicU64;

/// Maximum payload in bytes: above any Ethernet frame. Larger datagrams are counted and dropped.
pub const MAX_DATAGRAM: usize = 2048;
/// Maximum number of datagrams received per call.
const MAX_RECEIVED: usize = 64;
/// Maximum number of datagrams sent per call: small, so that the last is not much later than the first.
pub(super) const MAX_SENT: usize = 32;
/// One extra byte reveals a datagram that is too large.
const CELL: usize = MAX_DATAGRAM + 1;

/// Receives from sockets of equal address and report sizes: the kernel overwrites the buffer lengths, which
/// then limit the next call.
pub(super) struct Receiver {
    headers: MultiHeaders<SockaddrStorage>,
    bytes: Vec<u8>,
    /// Length and sender of each datagram of the last call.
    arrived: ArrayVec<(usize, Option<ReplyAddress>), MAX_RECEIVED>,
}

impl Receiver {
    /// For sockets whose report per datagram has the size of `report`.
    pub(super) fn new(report: Option<Vec<u8>>) -> Self {
        Self {
            headers: MultiHeaders::preallocate(MAX_RECEIVED, report),
            bytes: vec![0; MAX_RECEIVED * CELL],
            arrived: ArrayVec::new(),
        }
    }

    /// Receives one batch; reports of an absent peer are counted and skipped.
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
                        self.arrived.push((message.bytes, reply_address(&message, message.address.as_ref())));
                    }
                    return Ok(());
                }
                Err(Errno::EAGAIN) => return Ok(()),
                Err(Errno::EINTR) => {}
                // An invalid call is a permanent error.
                Err(
                    error @ (Errno::EBADF | Errno::EFAULT | Errno::EINVAL | Errno::ENOTSOCK | Errno::ENOMEM),
                ) => {
                    return Err(error.into());
                }
                // Other errors are network reports about an earlier datagram, by ICMP, which anybody can
                // send.
                Err(_) => count(unreachable),
            }
        }
    }

    pub(super) fn datagrams(&self) -> impl Iterator<Item = (&[u8], Option<ReplyAddress>)> {
        let cells = self.bytes.chunks_exact(CELL);
        cells.zip(&self.arrived).map(|(cell, &(length, sender))| (&cell[..length.min(CELL)], sender))
    }
}

pub(super) struct Sender {
    headers: reply::Outgoing,
}

/// Datagrams for one call.
pub(super) type Outgoing<'a> = ArrayVec<[IoSlice<'a>; 1], MAX_SENT>;
/// Destinations; `None` if the socket is connected.
pub(super) type Destinations = ArrayVec<Option<SockaddrStorage>, MAX_SENT>;

impl Sender {
    pub(super) fn new() -> Self {
        Self { headers: reply::Outgoing::with_capacity(MAX_SENT) }
    }

    /// Send all, from the address `asked` if given; bit n of the result is set if datagram n was accepted.
    pub(super) fn send(
        &mut self,
        socket: BorrowedFd<'_>,
        outgoing: &Outgoing<'_>,
        destinations: &Destinations,
        asked: Option<IpAddr>,
        unreachable: &AtomicU64,
    ) -> u32 {
        let mut taken = 0;
        let mut next = 0;
        let mut is_repeated = false;
        while next < outgoing.len() {
            let (outgoing, destinations) = (&outgoing[next..], &destinations[next..]);
            match self.headers.send(socket, outgoing, destinations, asked, MsgFlags::MSG_DONTWAIT) {
                Ok(sent) => {
                    for _ in 0..sent {
                        taken |= 1 << next;
                        next += 1;
                    }
                    is_repeated = false;
                    continue;
                }
                Err(Errno::EINTR) => continue,
                // The error concerns an earlier datagram, and this one was not sent: retry once.
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

/// Tests for an ICMP report that an earlier datagram found no peer. This is not fatal: the peer may start
/// later.
fn is_unreachable(error: Errno) -> bool {
    matches!(error, Errno::ECONNREFUSED | Errno::EHOSTUNREACH | Errno::ENETDOWN | Errno::ENETUNREACH)
}

/// Datagram in a [`BufferPool`].
#[derive(Debug)]
pub(super) struct Slot {
    cell: usize,
    length: usize,
}

/// Pool of `capacity` cells of [`MAX_DATAGRAM`] bytes, each with metadata of its datagram.
#[derive(Debug)]
pub(super) struct BufferPool<T> {
    /// Zeroed, so the operating system maps a page only when a cell on it is first used.
    bytes: Vec<u8>,
    about: Vec<Option<T>>,
    /// Last in, first out: only as many cells are touched as were ever in flight together.
    free: Vec<usize>,
}

impl<T> BufferPool<T> {
    pub(super) fn with_capacity(capacity: usize) -> Self {
        Self {
            bytes: vec![0; capacity * MAX_DATAGRAM],
            about: (0..capacity).map(|_| None).collect(),
            free: (0..capacity).rev().collect(),
        }
    }

    /// Copy a datagram of at most [`MAX_DATAGRAM`] bytes into a free cell; `None` if there is none.
    /// `change` may edit the copy, and returns the length to keep.
    pub(super) fn store(
        &mut self,
        datagram: &[u8],
        about: T,
        change: impl FnOnce(&mut [u8]) -> usize,
    ) -> Option<Slot> {
        let cell = self.free.pop()?;
        let start = cell * MAX_DATAGRAM;
        let copy = &mut self.bytes[start..start + datagram.len()];
        copy.copy_from_slice(datagram);
        let length = change(copy).min(datagram.len());
        self.about[cell] = Some(about);
        Some(Slot { cell, length })
    }

    pub(super) fn read(&self, slot: &Slot) -> &[u8] {
        let start = slot.cell * MAX_DATAGRAM;
        &self.bytes[start..start + slot.length]
    }

    pub(super) fn about(&self, slot: &Slot) -> Option<&T> {
        self.about[slot.cell].as_ref()
    }

    /// Free the cell. A slot is consumed, so none is freed twice.
    pub(super) fn release(&mut self, Slot { cell, .. }: Slot) {
        self.free.push(cell);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_keep_their_datagrams_apart_and_are_reused() {
        let whole = |bytes: &mut [u8]| bytes.len();
        let mut pool = BufferPool::with_capacity(2);
        let a = pool.store(b"first", 'a', whole).unwrap();
        let b = pool.store(&[7; MAX_DATAGRAM], 'b', whole).unwrap();
        assert!(pool.store(b"third", 'c', whole).is_none());
        assert_eq!((pool.read(&a), pool.about(&a)), (&b"first"[..], Some(&'a')));
        assert_eq!(pool.read(&b), [7; MAX_DATAGRAM]);
        pool.release(a);
        let cut = |bytes: &mut [u8]| {
            bytes[0] = b'T';
            3
        };
        let c = pool.store(b"third", 'c', cut).unwrap();
        assert_eq!((pool.read(&c), pool.about(&c)), (&b"Thi"[..], Some(&'c')));
        assert_eq!((pool.read(&b), pool.about(&b)), (&[7; MAX_DATAGRAM][..], Some(&'b')));
    }
}
