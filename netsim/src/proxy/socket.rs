//! The proxy's two sockets, and what their errors mean.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::atomic::AtomicU64;

use super::statistics::count;

/// A socket at `listen`, and its address with the port that was chosen.
pub(super) fn open_listening(listen: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let socket = UdpSocket::bind(listen)?;
    socket.set_nonblocking(true)?;
    let address = socket.local_addr()?;
    Ok((socket, address))
}

/// A socket connected to the peer, and the address the kernel took it for.
pub(super) fn open_upstream(forward: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let any: SocketAddr = match forward {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.set_nonblocking(true)?;
    socket.connect(forward)?;
    let peer = socket.peer_addr()?;
    Ok((socket, peer))
}

/// Whether the proxy would be its own peer.
pub(super) fn is_own(listen: SocketAddr, peer: SocketAddr) -> bool {
    let is_same_host = listen.ip() == peer.ip() || (listen.ip().is_unspecified() && peer.ip().is_loopback());
    is_same_host && listen.port() == peer.port()
}

/// The next datagram of a socket; `None` if there is none. An absent peer is counted and passed over.
pub(super) fn receive_from(
    socket: &UdpSocket,
    buffer: &mut [u8],
    unreachable: &AtomicU64,
) -> io::Result<Option<(usize, SocketAddr)>> {
    loop {
        let received = socket.recv_from(buffer);
        if is_unreachable(&received) {
            count(unreachable);
            continue;
        }
        match received {
            Ok(datagram) => return Ok(Some(datagram)),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

/// Whether the socket reports, by ICMP, that an earlier datagram found no peer: no reason to stop, it may
/// come up yet.
pub(super) fn is_unreachable<T>(result: &io::Result<T>) -> bool {
    use io::ErrorKind::{ConnectionRefused, HostUnreachable, NetworkDown, NetworkUnreachable};
    result.as_ref().is_err_and(|error| {
        matches!(error.kind(), ConnectionRefused | HostUnreachable | NetworkUnreachable | NetworkDown)
    })
}
