//! Datagrams in memory that is reserved once: many with one call of `recvmmsg` or `sendmmsg`, and fixed cells for what
//! is in flight.

use super::statistics::count;
use crate::reply::{self, Asker, asker};
use arrayvec::ArrayVec;
use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, MultiHeaders, SockaddrStorage, recvmmsg};
use std::array;
use std::io::{self, IoSlice, IoSliceMut};
use std::net::IpAddr;
use std::os::fd::{AsRawFd, BorrowedFd};
use std::sync::atomic::AtomicU64;

/// Largest payload carried, in bytes: above any Ethernet frame. Larger datagrams are counted and dropped.
pub const MAX_DATAGRAM: usize = 2048;
/// Most datagrams taken with one call.
const MAX_RECEIVED: usize = 64;
/// Most datagrams sent with one call: few, so that the last is not much later than the first.
pub(super) const MAX_SENT: usize = 32;
/// One byte more than is carried, by which a datagram that is too large is recognised.
const CELL: usize = MAX_DATAGRAM + 1;

/// Takes datagrams from sockets that are alike: the kernel writes the length of an address, and of what it reports, over
/// the room that there is for the next.
pub(super) struct Receiver {
    headers: MultiHeaders<SockaddrStorage>,
    bytes: Vec<u8>,
    /// Length and sender of what the last call brought.
    arrived: ArrayVec<(usize, Option<Asker>), MAX_RECEIVED>,
}

impl Receiver {
    /// For sockets that report as many bytes with each datagram as `report` has.
    pub(super) fn new(report: Option<Vec<u8>>) -> Self {
        Self {
            headers: MultiHeaders::preallocate(MAX_RECEIVED, report),
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
                        self.arrived.push((message.bytes, asker(&message, message.address.as_ref())));
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
    pub(super) fn datagrams(&self) -> impl Iterator<Item = (&[u8], Option<Asker>)> {
        let cells = self.bytes.chunks_exact(CELL);
        cells.zip(&self.arrived).map(|(cell, &(length, sender))| (&cell[..length.min(CELL)], sender))
    }
}

/// Sends datagrams.
pub(super) struct Sender {
    headers: reply::Outgoing,
}

/// What is to be sent with one call.
pub(super) type Outgoing<'a> = ArrayVec<[IoSlice<'a>; 1], MAX_SENT>;
/// Where to; `None` where the socket is connected.
pub(super) type Destinations = ArrayVec<Option<SockaddrStorage>, MAX_SENT>;

impl Sender {
    pub(super) fn new() -> Self {
        Self { headers: reply::Outgoing::with_capacity(MAX_SENT) }
    }

    /// Sends all from the address `asked`, if there is one; bit n of the result says whether the n-th was taken.
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

/// A datagram kept in a [`BufferPool`].
#[derive(Debug)]
pub(super) struct Slot {
    cell: usize,
    length: usize,
}

/// `capacity` cells of [`MAX_DATAGRAM`] bytes, each with something that is known of its datagram.
#[derive(Debug)]
pub(super) struct BufferPool<T> {
    /// Zeroed, so the operating system maps a page only when a cell on it is first used.
    bytes: Vec<u8>,
    about: Vec<Option<T>>,
    /// Last in, first out: as few cells are touched as were ever in flight together.
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

    /// Copies a datagram of at most [`MAX_DATAGRAM`] bytes in, if a cell is free; `change` may alter the copy and says
    /// how much of it is kept.
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

    /// The datagram in a slot.
    pub(super) fn read(&self, slot: &Slot) -> &[u8] {
        let start = slot.cell * MAX_DATAGRAM;
        &self.bytes[start..start + slot.length]
    }

    /// What is known of the datagram in a slot.
    pub(super) fn about(&self, slot: &Slot) -> Option<&T> {
        self.about[slot.cell].as_ref()
    }

    /// Takes the cell back. A slot is consumed, so none is given back twice.
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
