//! The proxy's sockets: how they are opened, and how much they hold.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};

use rustix::net::sockopt;

/// Asked of the kernel for datagrams that wait: 100 ms at 50000 packets/s, at 800 bytes each with what the kernel
/// keeps beside them.
const BUFFER_BYTES: usize = 4 << 20;

/// A socket at `listen`, and its address with the port that was chosen.
pub(super) fn open_listening(listen: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let socket = open(listen)?;
    let address = socket.local_addr()?;
    Ok((socket, address))
}

/// A socket connected to the peer, and the address the kernel took it for.
pub(super) fn open_upstream(forward: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let any: SocketAddr = match forward {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = open(any)?;
    socket.connect(forward)?;
    let peer = socket.peer_addr()?;
    Ok((socket, peer))
}

fn open(address: SocketAddr) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    // Beyond its limit the kernel grants more to the privileged, and its limit to others.
    let _ = sockopt::set_socket_recv_buffer_size_force(&socket, BUFFER_BYTES)
        .or_else(|_| sockopt::set_socket_recv_buffer_size(&socket, BUFFER_BYTES));
    let _ = sockopt::set_socket_send_buffer_size_force(&socket, BUFFER_BYTES)
        .or_else(|_| sockopt::set_socket_send_buffer_size(&socket, BUFFER_BYTES));
    Ok(socket)
}

/// Bytes granted for receiving and for sending.
pub(super) fn granted(socket: &UdpSocket) -> (u64, u64) {
    let receive = sockopt::socket_recv_buffer_size(socket).unwrap_or(0);
    let send = sockopt::socket_send_buffer_size(socket).unwrap_or(0);
    (receive as u64, send as u64)
}

/// Whether the proxy would be its own peer.
pub(super) fn is_own(listen: SocketAddr, peer: SocketAddr) -> bool {
    // One address may be written as IPv4 and as IPv6.
    let (here, there) = (listen.ip().to_canonical(), peer.ip().to_canonical());
    let is_same_host = here == there || (here.is_unspecified() && there.is_loopback());
    is_same_host && listen.port() == peer.port()
}
