//! Where datagrams come in and go out: the sockets, and the clients behind them.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use nix::sys::socket::SockaddrStorage;
use rustix::event::epoll::{self, CreateFlags, Event, EventData, EventFlags};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::flows::{FlowId, Flows, MAX_FLOWS};
use super::settings::{ProxyError, ProxySettings, Source};
use super::socket::{granted, is_own, open_listening, open_upstream};

const NO_TIME: Timespec = Timespec { tv_sec: 0, tv_nsec: 0 };

/// The way out of a datagram.
#[derive(Clone, Copy, Debug)]
pub(super) enum Exit {
    /// To the peer, as from its client.
    Peer(FlowId),
    /// To the peer, from a source that is no client's.
    PeerBeside,
    /// To a client.
    Client(SocketAddr),
    /// To a client, from a source that is not the peer's.
    ClientBeside(SocketAddr),
}

/// The ways out that a datagram may take.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exits {
    pub(super) on: Exit,
    pub(super) back: Exit,
    pub(super) beside: Exit,
}

/// The socket of a way out: what goes by the same one can go with one call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Door {
    Listen,
    ListenBeside,
    Upstream(FlowId),
    UpstreamBeside,
}

/// Where datagrams came in.
#[derive(Clone, Copy, Debug)]
pub(super) enum Entrance {
    Listen,
    Upstream(usize),
}

impl Entrance {
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

/// Room for the answer of a look at all entrances.
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
        let ProxySettings { listen: asked, forward, .. } = *settings;
        if forward.port() == 0 {
            return Err(ProxyError::NoPort { forward });
        }
        let refuse = |key, address| move |source| ProxyError::Socket { key, address, source };
        let (listen, listen_address) = open_listening(asked).map_err(refuse("listen", asked))?;
        let (upstream_beside, peer) = open_upstream(forward).map_err(refuse("forward", forward))?;
        if is_own(listen_address, peer) {
            return Err(ProxyError::Loop { forward });
        }
        let beside = SocketAddr::new(listen_address.ip(), 0);
        let (listen_beside, _) = open_listening(beside).map_err(refuse("listen", beside))?;
        let waiting = epoll::create(CreateFlags::CLOEXEC)
            .and_then(|waiting| watch(&waiting, &listen, Entrance::Listen).map(|()| waiting))
            .map_err(io::Error::from)
            .map_err(refuse("listen", asked))?;
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

    /// Bytes that the kernel grants for datagrams that wait: received, and to be sent.
    pub(super) fn granted(&self) -> (u64, u64) {
        granted(&self.listen)
    }

    /// The flow of a client, who is served if it is of this machine or allowed; a new one gets its own socket.
    pub(super) fn admit(&mut self, client: SocketAddr, now_ns: u64) -> Option<FlowId> {
        if let Some(known) = self.flows.find(client, now_ns) {
            return Some(known);
        }
        let is_local = client.ip().to_canonical().is_loopback();
        if !(is_local || self.allow.iter().any(|allowed| allowed.covers(client))) {
            return None;
        }
        if !self.flows.make_room(now_ns) {
            return None;
        }
        let (upstream, _) = open_upstream(self.peer).ok()?;
        watch(&self.waiting, &upstream, Entrance::Upstream(self.flows.free_place())).ok()?;
        Some(self.flows.open(client, upstream, now_ns))
    }

    /// The client that an answer is for, unless it is none: the kernel lets through what came between binding and
    /// connecting.
    pub(super) fn client_of(
        &mut self,
        place: usize,
        source: SocketAddr,
        now_ns: u64,
    ) -> Option<(FlowId, SocketAddr)> {
        if source != self.peer {
            return None;
        }
        let flow = self.flows.heard(place, now_ns)?;
        Some((flow, self.flows.get(flow)?.client))
    }

    /// Waits until something comes, at most for `timeout`.
    pub(super) fn wait(&self, timeout: &Timespec) -> io::Result<()> {
        match poll(&mut [PollFd::new(&self.waiting, PollFlags::IN)], Some(timeout)) {
            // A signal is as good a reason to wake as any.
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Where datagrams have come, without waiting.
    pub(super) fn look<'a>(
        &self,
        ready: &'a mut Ready,
    ) -> io::Result<impl Iterator<Item = Entrance> + use<'a>> {
        let found = match epoll::wait(&self.waiting, &mut ready.0[..], Some(&NO_TIME)) {
            Ok(found) => found,
            Err(rustix::io::Errno::INTR) => 0,
            Err(error) => return Err(error.into()),
        };
        Ok(ready.0[..found].iter().map(|event| Entrance::of(event.data.u64())))
    }

    /// The socket of an entrance, if its client is still there.
    pub(super) fn entrance_socket(&self, entrance: Entrance) -> Option<BorrowedFd<'_>> {
        match entrance {
            Entrance::Listen => Some(self.listen.as_fd()),
            Entrance::Upstream(place) => Some(self.flows.at(place)?.upstream.as_fd()),
        }
    }

    /// The socket of a door, if its client is still there.
    pub(super) fn door_socket(&self, door: Door) -> Option<BorrowedFd<'_>> {
        match door {
            Door::Listen => Some(self.listen.as_fd()),
            Door::ListenBeside => Some(self.listen_beside.as_fd()),
            Door::Upstream(flow) => Some(self.flows.get(flow)?.upstream.as_fd()),
            Door::UpstreamBeside => Some(self.upstream_beside.as_fd()),
        }
    }
}

impl Exit {
    /// Through which socket, and where to if the socket does not know.
    pub(super) fn door(self) -> (Door, Option<SockaddrStorage>) {
        match self {
            Self::Peer(flow) => (Door::Upstream(flow), None),
            Self::PeerBeside => (Door::UpstreamBeside, None),
            Self::Client(client) => (Door::Listen, Some(client.into())),
            Self::ClientBeside(client) => (Door::ListenBeside, Some(client.into())),
        }
    }
}

fn watch(waiting: &OwnedFd, socket: &UdpSocket, entrance: Entrance) -> rustix::io::Result<()> {
    epoll::add(waiting, socket, EventData::new_u64(entrance.number()), EventFlags::IN)
}
