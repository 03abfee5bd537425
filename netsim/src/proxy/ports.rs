//! Sockets of the proxy, and the clients behind them.

use super::settings::{ProxyError, ProxySettings, Source};
use crate::reply::{ReplyAddress, report_asked, report_room};
use nix::sys::socket::SockaddrStorage;
use rustix::event::epoll::{self, CreateFlags, Event, EventData, EventFlags};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::sockopt;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

const NO_TIME: Timespec = Timespec { tv_sec: 0, tv_nsec: 0 };

/// Destination of a datagram.
#[derive(Clone, Copy, Debug)]
pub(super) enum Egress {
    /// To the peer, from its client's socket.
    Peer(FlowId),
    /// To the peer, from a socket of no client.
    PeerBeside,
    /// To a client, from the address that it asked.
    Client(ReplyAddress),
    /// To a client, from another port of that address.
    ClientBeside(ReplyAddress),
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Routes {
    pub(super) on: Egress,
    pub(super) back: Egress,
    pub(super) beside: Egress,
}

/// Socket of an egress: datagrams for the same one can share a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum EgressSocket {
    /// From this address of the machine, if the socket has several.
    Listen(Option<IpAddr>),
    ListenBeside(Option<IpAddr>),
    Upstream(FlowId),
    UpstreamBeside,
}

impl EgressSocket {
    /// Source address, if the socket has several.
    pub(super) fn asked(self) -> Option<IpAddr> {
        match self {
            Self::Listen(asked) | Self::ListenBeside(asked) => asked,
            Self::Upstream(_) | Self::UpstreamBeside => None,
        }
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Ingress {
    Listen,
    Upstream(usize),
}

impl Ingress {
    fn number(self) -> u64 {
        match self {
            Self::Listen => 0,
            Self::Upstream(place) => 1 + place as u64,
        }
    }

    fn of(number: u64) -> Self {
        let place = number.checked_sub(1).and_then(|place| usize::try_from(place).ok());
        place.map_or(Self::Listen, Self::Upstream)
    }
}

pub(super) struct Ready([Event; MAX_FLOWS + 1]);

impl Ready {
    pub(super) fn new() -> Self {
        Self([Event { flags: EventFlags::empty(), data: EventData::new_u64(0) }; MAX_FLOWS + 1])
    }
}

#[derive(Debug)]
pub(super) struct Ports {
    listen: UdpSocket,
    pub(super) listen_address: SocketAddr,
    listen_beside: UdpSocket,
    upstream_beside: UdpSocket,
    peer: SocketAddr,
    allow: Vec<Source>,
    pub(super) flows: Flows,
    waiting: OwnedFd,
}

impl Ports {
    pub(super) fn open(settings: &ProxySettings) -> Result<Self, ProxyError> {
        let ProxySettings { listen: requested, forward, .. } = *settings;
        if forward.port() == 0 {
            return Err(ProxyError::NoPort { forward });
        }
        let refuse = |key, address| move |source| ProxyError::Socket { key, address, source };
        let (listen, listen_address) = open_listening(requested).map_err(refuse("listen", requested))?;
        let (upstream_beside, peer) = open_upstream(forward).map_err(refuse("forward", forward))?;
        if is_own(listen_address, peer) {
            return Err(ProxyError::Loop { forward });
        }
        let beside = SocketAddr::new(listen_address.ip(), 0);
        let (listen_beside, _) = open_listening(beside).map_err(refuse("listen", beside))?;
        let waiting = epoll::create(CreateFlags::CLOEXEC)
            .and_then(|waiting| watch(&waiting, &listen, Ingress::Listen).map(|()| waiting))
            .map_err(io::Error::from)
            .map_err(refuse("listen", requested))?;
        Ok(Self {
            listen,
            listen_address,
            listen_beside,
            upstream_beside,
            peer,
            allow: settings.allow.clone(),
            flows: Flows::default(),
            waiting,
        })
    }

    pub(super) fn report_room(&self) -> Option<Vec<u8>> {
        report_room(self.listen_address)
    }

    /// Receive and send buffer sizes in bytes granted by the kernel.
    pub(super) fn granted(&self) -> (u64, u64) {
        granted(&self.listen)
    }

    /// Flow of a client from this machine or an allowed source; `None` for others. A new client gets its own
    /// socket.
    pub(super) fn admit(&mut self, client: ReplyAddress, now_ns: u64) -> Option<FlowId> {
        if let Some(known) = self.flows.find(client, now_ns) {
            return Some(known);
        }
        let is_local = client.from.ip().to_canonical().is_loopback();
        if !(is_local || self.allow.iter().any(|allowed| allowed.covers(client.from))) {
            return None;
        }
        if !self.flows.make_room(now_ns) {
            return None;
        }
        let (upstream, _) = open_upstream(self.peer).ok()?;
        watch(&self.waiting, &upstream, Ingress::Upstream(self.flows.free_place())).ok()?;
        Some(self.flows.open(client, upstream, now_ns))
    }

    /// Client of an answer; `None` for datagrams from others, which the kernel accepts between binding and
    /// connecting.
    pub(super) fn client_of(
        &mut self,
        place: usize,
        source: SocketAddr,
        now_ns: u64,
    ) -> Option<(FlowId, ReplyAddress)> {
        if source != self.peer {
            return None;
        }
        let flow = self.flows.heard(place, now_ns)?;
        Some((flow, self.flows.get(flow)?.client))
    }

    pub(super) fn wait(&self, timeout: &Timespec) -> io::Result<()> {
        match poll(&mut [PollFd::new(&self.waiting, PollFlags::IN)], Some(timeout)) {
            // A signal ends the wait as well.
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Ingresses with datagrams, without waiting.
    pub(super) fn look<'a>(
        &self,
        ready: &'a mut Ready,
    ) -> io::Result<impl Iterator<Item = Ingress> + use<'a>> {
        let found = match epoll::wait(&self.waiting, &mut ready.0[..], Some(&NO_TIME)) {
            Ok(found) => found,
            Err(rustix::io::Errno::INTR) => 0,
            Err(error) => return Err(error.into()),
        };
        Ok(ready.0[..found].iter().map(|event| Ingress::of(event.data.u64())))
    }

    pub(super) fn ingress_socket(&self, ingress: Ingress) -> Option<BorrowedFd<'_>> {
        match ingress {
            Ingress::Listen => Some(self.listen.as_fd()),
            Ingress::Upstream(place) => Some(self.flows.at(place)?.upstream.as_fd()),
        }
    }

    /// Descriptor of an egress socket, if its client is still there.
    pub(super) fn egress_socket(&self, socket: EgressSocket) -> Option<BorrowedFd<'_>> {
        match socket {
            EgressSocket::Listen(_) => Some(self.listen.as_fd()),
            EgressSocket::ListenBeside(_) => Some(self.listen_beside.as_fd()),
            EgressSocket::Upstream(flow) => Some(self.flows.get(flow)?.upstream.as_fd()),
            EgressSocket::UpstreamBeside => Some(self.upstream_beside.as_fd()),
        }
    }
}

impl Egress {
    /// Socket to use, and the destination if the socket is not connected.
    pub(super) fn socket(self) -> (EgressSocket, Option<SockaddrStorage>) {
        match self {
            Self::Peer(flow) => (EgressSocket::Upstream(flow), None),
            Self::PeerBeside => (EgressSocket::UpstreamBeside, None),
            Self::Client(client) => (EgressSocket::Listen(client.asked), Some(client.from.into())),
            Self::ClientBeside(client) => {
                (EgressSocket::ListenBeside(client.asked), Some(client.from.into()))
            }
        }
    }
}

fn watch(waiting: &OwnedFd, socket: &UdpSocket, ingress: Ingress) -> rustix::io::Result<()> {
    epoll::add(waiting, socket, EventData::new_u64(ingress.number()), EventFlags::IN)
}

/// Requested buffer size: 100 ms at 50000 packets/s, at 800 bytes per packet including the kernel's overhead.
const BUFFER_BYTES: usize = 4 << 20;

/// Socket at `listen`, and its address with the actual port.
fn open_listening(listen: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let socket = open(listen)?;
    report_asked(&socket)?;
    let address = socket.local_addr()?;
    Ok((socket, address))
}

/// Socket connected to the peer, and the peer's address as seen by the kernel.
fn open_upstream(forward: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
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
    // The kernel exceeds its limit only for privileged processes; others get the limit.
    let _ = sockopt::set_socket_recv_buffer_size_force(&socket, BUFFER_BYTES)
        .or_else(|_| sockopt::set_socket_recv_buffer_size(&socket, BUFFER_BYTES));
    let _ = sockopt::set_socket_send_buffer_size_force(&socket, BUFFER_BYTES)
        .or_else(|_| sockopt::set_socket_send_buffer_size(&socket, BUFFER_BYTES));
    Ok(socket)
}

fn granted(socket: &UdpSocket) -> (u64, u64) {
    let receive = sockopt::socket_recv_buffer_size(socket).unwrap_or(0);
    let send = sockopt::socket_send_buffer_size(socket).unwrap_or(0);
    (receive as u64, send as u64)
}

/// Test if the proxy would be its own peer.
fn is_own(listen: SocketAddr, peer: SocketAddr) -> bool {
    // One address may be given as IPv4 and as IPv6.
    let (here, there) = (listen.ip().to_canonical(), peer.ip().to_canonical());
    let is_same_host = here == there || (here.is_unspecified() && there.is_loopback());
    is_same_host && listen.port() == peer.port()
}

/// Maximum number of clients at a time.
pub const MAX_FLOWS: usize = 64;
/// Silence in ns after which a flow is closed.
const EXPIRY_NS: u64 = 60_000_000_000;
/// Silence in ns after which a flow is replaced by a new client if all places are taken.
const YIELD_NS: u64 = 1_000_000_000;

#[derive(Debug)]
pub(super) struct Flow {
    pub(super) client: ReplyAddress,
    /// Connected to the peer, so that the kernel refuses other sources and reports an absent peer.
    pub(super) upstream: UdpSocket,
    generation: u32,
    heard_ns: u64,
}

/// Slot index plus generation counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FlowId {
    place: usize,
    generation: u32,
}

#[derive(Debug, Default)]
pub(super) struct Flows {
    places: Vec<Option<Flow>>,
    /// Slot of the last sender, which is usually that of the next datagram.
    last: usize,
    generation: u32,
}

impl Flows {
    /// Flow of a known client, marked as heard now. Answers leave from the address that it asked last.
    pub(super) fn find(&mut self, client: ReplyAddress, now_ns: u64) -> Option<FlowId> {
        let is_of = |flow: &Option<Flow>| flow.as_ref().is_some_and(|flow| flow.client.from == client.from);
        let place = if self.places.get(self.last).is_some_and(is_of) {
            self.last
        } else {
            self.places.iter().position(is_of)?
        };
        self.last = place;
        if let Some(flow) = self.places.get_mut(place).and_then(Option::as_mut) {
            flow.client = client;
        }
        self.heard(place, now_ns)
    }

    /// Flow in a slot, marked as heard now from either side.
    pub(super) fn heard(&mut self, place: usize, now_ns: u64) -> Option<FlowId> {
        let flow = self.places.get_mut(place)?.as_mut()?;
        flow.heard_ns = now_ns;
        Some(FlowId { place, generation: flow.generation })
    }

    /// Test if another client can be admitted; if needed, closes the flow that has been silent longest.
    pub(super) fn make_room(&mut self, now_ns: u64) -> bool {
        self.expire(now_ns);
        if self.len() < MAX_FLOWS {
            return true;
        }
        let heard_ns = |place: &Option<Flow>| place.as_ref().map_or(u64::MAX, |flow| flow.heard_ns);
        let longest_silent = self.places.iter_mut().min_by_key(|place| heard_ns(place));
        longest_silent.is_some_and(|place| {
            let yields = now_ns.saturating_sub(heard_ns(place)) >= YIELD_NS;
            if yields {
                *place = None;
            }
            yields
        })
    }

    /// Admits a client; requires that there is room.
    pub(super) fn open(&mut self, client: ReplyAddress, upstream: UdpSocket, now_ns: u64) -> FlowId {
        self.generation = self.generation.wrapping_add(1);
        let generation = self.generation;
        let flow = Some(Flow { client, upstream, generation, heard_ns: now_ns });
        let place = self.free_place();
        match self.places.get_mut(place) {
            Some(free) => *free = flow,
            None => self.places.push(flow),
        }
        FlowId { place, generation }
    }

    pub(super) fn free_place(&self) -> usize {
        self.places.iter().position(Option::is_none).unwrap_or(self.places.len())
    }

    pub(super) fn expire(&mut self, now_ns: u64) {
        for place in &mut self.places {
            place.take_if(|flow| now_ns.saturating_sub(flow.heard_ns) >= EXPIRY_NS);
        }
    }

    /// Flow, if it is still open.
    pub(super) fn get(&self, id: FlowId) -> Option<&Flow> {
        self.at(id.place).filter(|flow| flow.generation == id.generation)
    }

    /// Flow in a slot, of any generation.
    pub(super) fn at(&self, place: usize) -> Option<&Flow> {
        self.places.get(place)?.as_ref()
    }

    pub(super) fn len(&self) -> usize {
        self.places.iter().flatten().count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(number: usize) -> ReplyAddress {
        SocketAddr::from(([127, 0, 0, 1], u16::try_from(1000 + number).unwrap())).into()
    }

    fn open(flows: &mut Flows, number: usize, now_ns: u64) -> FlowId {
        flows.open(client(number), UdpSocket::bind("127.0.0.1:0").unwrap(), now_ns)
    }

    #[test]
    fn each_client_has_a_flow_until_it_is_silent_for_long() {
        let mut flows = Flows::default();
        let [first, second] = [0, 1].map(|number| open(&mut flows, number, 0));
        assert_eq!(flows.find(client(1), 5), Some(second));
        assert_eq!(flows.find(client(0), 9), Some(first));
        assert_eq!(flows.find(client(2), 9), None);
        flows.expire(EXPIRY_NS + 5);
        assert!(flows.get(second).is_none() && flows.get(first).is_some());
        let third = open(&mut flows, 2, EXPIRY_NS);
        assert_eq!(third.place, second.place);
        assert!(flows.get(second).is_none(), "the slot holds a flow of another generation");
        assert_eq!(flows.get(third).unwrap().client, client(2));
    }

    #[test]
    fn with_all_slots_taken_the_longest_silent_flow_is_closed() {
        let mut flows = Flows::default();
        for number in 0..MAX_FLOWS {
            assert!(flows.make_room(100));
            open(&mut flows, number, 100 + number as u64);
        }
        flows.find(client(0), 500);
        assert!(!flows.make_room(YIELD_NS + 100), "the longest silent one was heard 1 ns too late");
        assert!(flows.make_room(YIELD_NS + 101));
        assert_eq!(flows.len(), MAX_FLOWS - 1);
        assert_eq!(flows.find(client(1), 0), None);
        assert!(flows.find(client(0), YIELD_NS).is_some());
    }
}
