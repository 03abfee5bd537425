//! Answers leave from the address that was asked, on a machine with several.
//!
//! A socket that is bound to `0.0.0.0` or `[::]` sends from the address of its route. Who asked another address does not
//! take that for an answer. So the kernel reports with each datagram to which address it was sent, and the answer names
//! this address as its source.
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

/// Bytes of the longer of both reports.
const REPORT: usize = 40;

/// Who sent a datagram, and which address of this machine was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Asker {
    /// The sender, to which answers go.
    pub from: SocketAddr,
    /// Source address of answers; None if the system chooses.
    pub asked: Option<IpAddr>,
}

impl From<SocketAddr> for Asker {
    /// A peer that is sent to from the address that the system chooses.
    fn from(from: SocketAddr) -> Self {
        Self { from, asked: None }
    }
}

/// Return whether a socket at `local` has every address of the machine.
fn has_several(local: SocketAddr) -> bool {
    local.ip().to_canonical().is_unspecified()
}

/// Exact size of the control data that a socket at `local` receives with each datagram; None if it receives none.
pub(crate) fn report_room(local: SocketAddr) -> Option<Vec<u8>> {
    has_several(local).then(|| match local {
        SocketAddr::V4(_) => nix::cmsg_space!(in_pktinfo),
        SocketAddr::V6(_) => nix::cmsg_space!(in6_pktinfo),
    })
}

/// Has a socket that is bound to no address report which one was asked. Others have one address.
pub(crate) fn report_asked(socket: &UdpSocket) -> io::Result<()> {
    match socket.local_addr()? {
        local if !has_several(local) => {}
        SocketAddr::V4(_) => setsockopt(socket, Ipv4PacketInfo, &true)?,
        SocketAddr::V6(_) => setsockopt(socket, Ipv6RecvPacketInfo, &true)?,
    }
    Ok(())
}

/// The sender of a datagram, and the address that it asked where the socket reports it.
pub(crate) fn asker<S>(message: &RecvMsg<'_, '_, S>, seen: Option<&SockaddrStorage>) -> Option<Asker> {
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
    // From a group nobody answers.
    let asked = asked.find(|ip| !ip.is_multicast() && !ip.is_unspecified());
    Some(Asker { from, asked })
}

/// Buffers of one call of `sendmmsg`, reserved once.
pub(crate) struct Outgoing {
    plain: MultiHeaders<SockaddrStorage>,
    v4: MultiHeaders<SockaddrStorage>,
    v6: MultiHeaders<SockaddrStorage>,
}

// SAFETY: the pointers in it are to memory of its own, and to that of a call while the call lasts.
#[allow(unsafe_code)]
unsafe impl Send for Outgoing {}

impl std::fmt::Debug for Outgoing {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Outgoing")
    }
}

impl Outgoing {
    /// Room for `most` datagrams a call.
    pub(crate) fn with_capacity(most: usize) -> Self {
        let reporting = |space| MultiHeaders::preallocate(most, Some(space));
        Self {
            plain: MultiHeaders::preallocate(most, None),
            v4: reporting(nix::cmsg_space!(in_pktinfo)),
            v6: reporting(nix::cmsg_space!(in6_pktinfo)),
        }
    }

    /// Sends datagrams from the address `asked`, if there is one; returns how many the kernel took.
    ///
    /// The route chooses the interface: answers to a link-local address have its zone.
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

/// Room for what the kernel reports with a datagram, as it aligns it.
#[repr(align(8))]
struct Report([u8; REPORT]);

/// A UDP socket that answers from the address that was asked. Sending and receiving allocate nothing.
#[derive(Debug)]
pub struct ReplySocket {
    socket: UdpSocket,
    outgoing: Outgoing,
}

impl ReplySocket {
    /// Binds to `local`, which may be no address: `0.0.0.0` or `[::]`.
    ///
    /// # Errors
    ///
    /// Errors of the system.
    pub fn bind(local: SocketAddr) -> io::Result<Self> {
        let socket = UdpSocket::bind(local)?;
        report_asked(&socket)?;
        Ok(Self { socket, outgoing: Outgoing::with_capacity(1) })
    }

    /// The socket itself, for its settings and its address.
    pub fn socket(&self) -> &UdpSocket {
        &self.socket
    }

    /// Takes a datagram, as far as `buffer` has room for it; returns its length and who sent it.
    ///
    /// # Errors
    ///
    /// Errors of [`UdpSocket::recv_from`].
    pub fn receive(&self, buffer: &mut [u8]) -> io::Result<(usize, Asker)> {
        let mut report = Report([0; REPORT]);
        let mut parts = [IoSliceMut::new(buffer)];
        let message = recvmsg::<SockaddrStorage>(
            self.socket.as_raw_fd(),
            &mut parts,
            Some(&mut report.0),
            MsgFlags::empty(),
        )?;
        let asker = asker(&message, message.address.as_ref());
        asker.map(|asker| (message.bytes, asker)).ok_or_else(|| io::ErrorKind::InvalidData.into())
    }

    /// Sends a datagram to who asked, from the address that it asked.
    ///
    /// # Errors
    ///
    /// Errors of [`UdpSocket::send_to`].
    pub fn send(&mut self, datagram: &[u8], to: Asker) -> io::Result<()> {
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

    /// Each of a machine's loopback addresses answers as itself; a socket with one address reports none.
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
            // Connected: the kernel takes answers of no other address.
            client.connect((ip, port)).unwrap();
            client.set_read_timeout(Some(std::time::Duration::from_secs(5))).unwrap();
            client.send(b"question").unwrap();
            let mut buffer = [0; 16];
            let (length, asker) = socket.receive(&mut buffer).unwrap();
            assert_eq!(&buffer[..length], b"question");
            assert_eq!(asker.asked, reported.map(|text| text.parse().unwrap()), "{bound} {asked}");
            for round in 0..3 {
                socket.send(b"answer", asker).unwrap();
                assert_eq!(client.recv(&mut buffer).unwrap(), 6, "{bound} {asked} {round}");
            }
        }
    }
}
