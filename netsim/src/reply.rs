//! Replies from the address that received the request, on a machine with several addresses.
//!
//! A socket bound to `0.0.0.0` or `[::]` sends from the address of its route. A client that asked another
//! address rejects such a reply. Therefore the kernel reports the destination address of each datagram, and
//! the reply uses it as source.
//!
//! Source: Linux, `ip(7)`, `IP_PKTINFO`; RFC 3542, section 6, `IPV6_RECVPKTINFO` and `IPV6_PKTINFO`.

use std::io::{self, IoSlice, IoSliceMut};
use std::net::{IpAddr, SocketAddr, SocketAddrV4, SocketAddrV6, UdpSocket};
use std::os::fd::{AsRawFd, BorrowedFd};

use nix::libc::{in_addr, in_pktinfo, in6_addr, in6_pktinfo};
use nix::sys::socket::sockopt::{Ipv4PacketInfo, Ipv6RecvPacketInfo};
use nix::sys::socket::{
    ControlMessage, ControlMessageOwned, MsgFlags, MultiHeaders, RecvMsg, SockaddrStorage, recvmsg, sendmmsg,
    setsockopt,
};

/// Size in bytes of the longer of the two kernel reports.
const REPORT: usize = 40;

/// Sender of a datagram, and the local address it was sent to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReplyAddress {
    /// Sender, to which replies go.
    pub from: SocketAddr,
    /// Source address of replies; `None` if the system chooses.
    pub asked: Option<IpAddr>,
}

impl From<SocketAddr> for ReplyAddress {
    /// Peer that receives from the address that the system chooses.
    fn from(from: SocketAddr) -> Self {
        Self { from, asked: None }
    }
}

/// Test if a socket at `local` listens on every address of the machine.
fn has_several(local: SocketAddr) -> bool {
    local.ip().to_canonical().is_unspecified()
}

/// Buffer of the exact control data size that a socket at `local` receives per datagram; `None` if it
/// receives none.
pub(crate) fn report_room(local: SocketAddr) -> Option<Vec<u8>> {
    has_several(local).then(|| match local {
        SocketAddr::V4(_) => nix::cmsg_space!(in_pktinfo),
        SocketAddr::V6(_) => nix::cmsg_space!(in6_pktinfo),
    })
}

/// Enables the report of the destination address on a socket bound to all addresses. Other sockets have one
/// address.
pub(crate) fn report_asked(socket: &UdpSocket) -> io::Result<()> {
    match socket.local_addr()? {
        local if !has_several(local) => {}
        SocketAddr::V4(_) => setsockopt(socket, Ipv4PacketInfo, &true)?,
        SocketAddr::V6(_) => setsockopt(socket, Ipv6RecvPacketInfo, &true)?,
    }
    Ok(())
}

/// Sender of a datagram, and its destination address if the socket reports it.
pub(crate) fn reply_address<S>(
    message: &RecvMsg<'_, '_, S>,
    seen: Option<&SockaddrStorage>,
) -> Option<ReplyAddress> {
    let seen = seen?;
    let v4 = seen.as_sockaddr_in().map(|seen| SocketAddrV4::from(*seen).into());
    let from = v4.or_else(|| seen.as_sockaddr_in6().map(|seen| SocketAddrV6::from(*seen).into()))?;
    let reports = message.cmsgs().into_iter().flatten();
    let mut asked = reports.filter_map(|report| match report {
        ControlMessageOwned::Ipv4PacketInfo(info) => {
            Some(IpAddr::from(info.ipi_spec_dst.s_addr.to_ne_bytes()))
        }
        ControlMessageOwned::Ipv6PacketInfo(info) => Some(IpAddr::from(info.ipi6_addr.s6_addr)),
        _ => None,
    });
    // A multicast address cannot be a source.
    let asked = asked.find(|ip| !ip.is_multicast() && !ip.is_unspecified());
    Some(ReplyAddress { from, asked })
}

/// Buffers for one `sendmmsg` call, reserved once.
pub(crate) struct Outgoing {
    plain: MultiHeaders<SockaddrStorage>,
    v4: MultiHeaders<SockaddrStorage>,
    v6: MultiHeaders<SockaddrStorage>,
}

// SAFETY: the pointers refer to memory it owns, or to memory of a call while the call lasts.
#[allow(unsafe_code)]
unsafe impl Send for Outgoing {}

impl std::fmt::Debug for Outgoing {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Outgoing")
    }
}

impl Outgoing {
    pub(crate) fn with_capacity(most: usize) -> Self {
        let reporting = |space| MultiHeaders::preallocate(most, Some(space));
        Self {
            plain: MultiHeaders::preallocate(most, None),
            v4: reporting(nix::cmsg_space!(in_pktinfo)),
            v6: reporting(nix::cmsg_space!(in6_pktinfo)),
        }
    }

    /// Send datagrams, from the address `asked` if given; return how many the kernel accepted.
    ///
    /// The route chooses the interface: replies to a link-local address carry its zone.
    pub(crate) fn send(
        &mut self,
        socket: BorrowedFd<'_>,
        datagrams: &[[IoSlice<'_>; 1]],
        to: &[Option<SockaddrStorage>],
        asked: Option<IpAddr>,
        flags: MsgFlags,
    ) -> nix::Result<usize> {
        let socket = socket.as_raw_fd();
        match asked {
            None => sendmmsg(socket, &mut self.plain, datagrams, to, [], flags).map(Iterator::count),
            Some(IpAddr::V4(ip)) => {
                let source = in_addr { s_addr: u32::from_ne_bytes(ip.octets()) };
                let info = in_pktinfo { ipi_ifindex: 0, ipi_spec_dst: source, ipi_addr: source };
                let report = [ControlMessage::Ipv4PacketInfo(&info)];
                sendmmsg(socket, &mut self.v4, datagrams, to, report, flags).map(Iterator::count)
            }
            Some(IpAddr::V6(ip)) => {
                let info = in6_pktinfo { ipi6_addr: in6_addr { s6_addr: ip.octets() }, ipi6_ifindex: 0 };
                let report = [ControlMessage::Ipv6PacketInfo(&info)];
                sendmmsg(socket, &mut self.v6, datagrams, to, report, flags).map(Iterator::count)
            }
        }
    }
}

/// Buffer for the kernel's report, with the alignment of the kernel.
#[repr(align(8))]
struct Report([u8; REPORT]);

/// UDP socket that replies from the address that received the request. Sending and receiving allocate
/// nothing.
#[derive(Debug)]
pub struct ReplySocket {
    socket: UdpSocket,
    outgoing: Outgoing,
}

impl ReplySocket {
    /// Binds to `local`, which may be unspecified: `0.0.0.0` or `[::]`.
    ///
    /// # Errors
    ///
    /// Errors of the system.
    pub fn bind(local: SocketAddr) -> io::Result<Self> {
        let socket = UdpSocket::bind(local)?;
        report_asked(&socket)?;
        Ok(Self { socket, outgoing: Outgoing::with_capacity(1) })
    }

    /// Underlying socket, for its settings and address.
    pub fn socket(&self) -> &UdpSocket {
        &self.socket
    }

    /// Receives a datagram, truncated to `buffer`; returns its length and its sender.
    ///
    /// # Errors
    ///
    /// Errors of [`UdpSocket::recv_from`].
    pub fn receive(&self, buffer: &mut [u8]) -> io::Result<(usize, ReplyAddress)> {
        let mut report = Report([0; REPORT]);
        let mut parts = [IoSliceMut::new(buffer)];
        let message = recvmsg::<SockaddrStorage>(
            self.socket.as_raw_fd(),
            &mut parts,
            Some(&mut report.0),
            MsgFlags::empty(),
        )?;
        let reply_address = reply_address(&message, message.address.as_ref());
        reply_address
            .map(|reply_address| (message.bytes, reply_address))
            .ok_or_else(|| io::ErrorKind::InvalidData.into())
    }

    /// Send a datagram to `to.from`, from the local address `to.asked` if it is known.
    ///
    /// # Errors
    ///
    /// Errors of [`UdpSocket::send_to`].
    pub fn send(&mut self, datagram: &[u8], to: ReplyAddress) -> io::Result<()> {
        use std::os::fd::AsFd;

        let parts = [[IoSlice::new(datagram)]];
        let address = [Some(SockaddrStorage::from(to.from))];
        let sent = self.outgoing.send(self.socket.as_fd(), &parts, &address, to.asked, MsgFlags::empty())?;
        if sent == 1 { Ok(()) } else { Err(io::ErrorKind::WouldBlock.into()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each loopback address replies as itself; a socket with one address reports none.
    #[test]
    fn the_answer_comes_from_the_address_that_was_asked() {
        for (bound, asked, reported) in [
            ("0.0.0.0:0", "127.0.0.1", Some("127.0.0.1")),
            ("0.0.0.0:0", "127.0.0.77", Some("127.0.0.77")),
            ("127.0.0.5:0", "127.0.0.5", None),
            ("[::]:0", "::1", Some("::1")),
            ("[::]:0", "127.0.0.9", Some("::ffff:127.0.0.9")),
            ("[::1]:0", "::1", None),
        ] {
            let Ok(mut socket) = ReplySocket::bind(bound.parse().unwrap()) else {
                assert!(bound.starts_with('['), "every machine has IPv4");
                continue;
            };
            let ip: IpAddr = asked.parse().unwrap();
            let port = socket.socket().local_addr().unwrap().port();
            let client = UdpSocket::bind((if ip.is_ipv4() { "127.0.0.1" } else { "::1" }, 0)).unwrap();
            // Connected, so that the kernel rejects replies from other addresses.
            client.connect((ip, port)).unwrap();
            client.set_read_timeout(Some(std::time::Duration::from_secs(5))).unwrap();
            client.send(b"question").unwrap();
            let mut buffer = [0; 16];
            let (length, reply_address) = socket.receive(&mut buffer).unwrap();
            assert_eq!(&buffer[..length], b"question");
            assert_eq!(reply_address.asked, reported.map(|text| text.parse().unwrap()), "{bound} {asked}");
            for round in 0..3 {
                socket.send(b"answer", reply_address).unwrap();
                assert_eq!(client.recv(&mut buffer).unwrap(), 6, "{bound} {asked} {round}");
            }
        }
    }
}
