//! Non-blocking UDP to one peer. Answers follow a moving peer, not a copier of its frames, and leave from the address
//! that the peer used.

use std::{
    io,
    net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket},
};

use haptether_netsim::{ReplyAddress, ReplySocket};

use super::{
    strangers::{Stranger, StrangerReport, Strangers},
    system,
};
use crate::session::MAX_DATAGRAM;

/// Datagrams between two reads of the clock.
const ROUND: usize = 32;
/// Maximum number of datagrams taken at once.
const MAX_DATAGRAMS: usize = 4096;

/// Source of the peer's address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PeerAddress {
    /// Send to this address from the start.
    Known(SocketAddr),
    /// Answer to the address of the last valid frame.
    Learned,
}

/// Local address from which the system sends to `peer`, with any free port. On loopback, unreachable from other
/// machines, for a peer on this machine.
pub fn local_address(peer: SocketAddr) -> io::Result<SocketAddr> {
    let any: SocketAddr = match peer {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let route = UdpSocket::bind(any)?;
    // Sends nothing; the system chooses the route.
    route.connect(peer)?;
    let mut local = route.local_addr()?;
    local.set_port(0);
    Ok(local)
}

/// A non-blocking UDP socket and its peer. If the peer has several addresses, each gets datagrams in turn until one
/// answers.
#[derive(Debug)]
pub struct PeerSocket {
    /// Several if the peer's addresses need them.
    sockets: Vec<ReplySocket>,
    /// Socket index and route of each address of the peer.
    routes: Vec<(usize, Route)>,
    /// Index of the next address.
    current: usize,
    /// True if the peer has answered or has only one address.
    is_found: bool,
    /// Address that answered, until reported.
    found: Option<SocketAddr>,
    strangers: Strangers,
    /// Frames that the system refused to send: nobody listens there, or the buffer was full.
    pub unsent: u64,
}

impl PeerSocket {
    /// Binds to `local`.
    pub fn bind(local: SocketAddr, peer: PeerAddress) -> io::Result<Self> {
        let route = match peer {
            PeerAddress::Known(address) => return Self::bind_each(&[(local, address)]),
            PeerAddress::Learned => Route::learned(),
        };
        Ok(Self::new(vec![open(local)?], vec![(0, route)]))
    }

    /// Binds for a peer with several addresses, each paired with its local address.
    ///
    /// # Errors
    ///
    /// The error of the last address, if no socket can be bound.
    pub fn bind_each(ends: &[(SocketAddr, SocketAddr)]) -> io::Result<Self> {
        let mut sockets: Vec<(SocketAddr, ReplySocket)> = Vec::new();
        let (mut routes, mut refused) = (Vec::new(), io::ErrorKind::AddrNotAvailable.into());
        for &(local, peer) in ends {
            let known = sockets.iter().position(|(bound, _)| *bound == local);
            let index = known.map_or_else(
                || open(local).map(|socket| sockets.push((local, socket))).map(|()| sockets.len() - 1),
                Ok,
            );
            match index {
                Ok(index) => routes.push((index, Route::known(peer))),
                Err(error) => refused = error,
            }
        }
        if routes.is_empty() {
            return Err(refused);
        }
        Ok(Self::new(sockets.into_iter().map(|(_, socket)| socket).collect(), routes))
    }

    fn new(sockets: Vec<ReplySocket>, routes: Vec<(usize, Route)>) -> Self {
        let is_found = routes.len() == 1;
        Self {
            sockets,
            routes,
            current: 0,
            is_found,
            found: None,
            strangers: Strangers::default(),
            unsent: 0,
        }
    }

    /// Local address of the socket in use.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.sockets[self.routes[self.current].0].socket().local_addr()
    }

    /// Take the address that answered, of several; once.
    pub(super) fn take_found(&mut self) -> Option<SocketAddr> {
        self.found.take()
    }

    pub(super) fn take_strangers(&mut self) -> Option<StrangerReport> {
        self.strangers.poll()
    }

    pub(super) fn elsewhere(&self) -> u64 {
        self.strangers.count_of(Stranger::Elsewhere)
    }

    /// Pass each waiting datagram to `take`, which classifies it, until the clock shows `until_ns`.
    ///
    /// Datagrams from other addresses than a known peer's are counted and ignored. At least [`ROUND`] are taken: a
    /// late loop must hear its peer, too.
    pub(super) fn drain(
        &mut self,
        now_ns: u64,
        until_ns: u64,
        mut take: impl FnMut(ReplyAddress, &mut [u8]) -> Received,
    ) {
        for index in 0..self.sockets.len() {
            self.drain_one(index, now_ns, until_ns, &mut take);
        }
    }

    fn drain_one(
        &mut self,
        index: usize,
        now_ns: u64,
        until_ns: u64,
        take: &mut impl FnMut(ReplyAddress, &mut [u8]) -> Received,
    ) {
        // One byte more, to detect a too long datagram.
        let mut buffer = [0; MAX_DATAGRAM + 1];
        for taken in 0..MAX_DATAGRAMS {
            if taken > 0 && taken % ROUND == 0 && system::now_ns() >= until_ns {
                return;
            }
            match self.sockets[index].receive(&mut buffer) {
                Ok((length, reply_address)) => {
                    let Some(known) = self.admitting(index, reply_address.from) else {
                        self.strangers.count(Stranger::Elsewhere, reply_address.from);
                        continue;
                    };
                    let received = take(reply_address, &mut buffer[..length]);
                    self.routes[known].1.take(now_ns, reply_address, received);
                    match received {
                        // A frame of the peer may be damaged on its way.
                        Received::Stranger(_)
                            if self.routes[known].1.lives_at(now_ns, reply_address.from) => {}
                        Received::Stranger(stranger) => self.strangers.count(stranger, reply_address.from),
                        Received::Fresh { .. } | Received::Repeat if !self.is_found => {
                            (self.is_found, self.current, self.found) =
                                (true, known, Some(reply_address.from));
                        }
                        _ => {}
                    }
                }
                // Nobody listens there yet; a later frame may succeed.
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return,
            }
        }
    }

    /// Index of the peer's address that sent a datagram, if any.
    fn admitting(&self, socket: usize, from: SocketAddr) -> Option<usize> {
        let admits = |(of, route): &(usize, Route)| *of == socket && route.admits(from);
        if self.is_found {
            return admits(&self.routes[self.current]).then_some(self.current);
        }
        self.routes.iter().position(admits)
    }

    /// Discard waiting datagrams as outdated, until `until_ns`, so that a flood cannot hold the loop.
    pub fn discard(&mut self, until_ns: u64) {
        let mut buffer = [0; 1];
        for socket in &self.sockets {
            for thrown in 1..=MAX_DATAGRAMS {
                if thrown % ROUND == 0 && system::now_ns() >= until_ns {
                    return;
                }
                if let Err(error) = socket.socket().recv_from(&mut buffer)
                    && error.kind() == io::ErrorKind::WouldBlock
                {
                    break;
                }
            }
        }
    }

    /// Sends to `to` if given, else to the peer if known.
    pub fn send(&mut self, to: Option<ReplyAddress>, datagram: &[u8]) {
        if !self.is_found {
            let is_of = |(_, route): &(usize, Route)| to.is_some_and(|to| route.admits(to.from));
            let next = (self.current + 1) % self.routes.len();
            self.current = self.routes.iter().position(is_of).unwrap_or(next);
        }
        let (socket, route) = &mut self.routes[self.current];
        let to = if to.is_some() { [to, None] } else { route.next() };
        for to in to.into_iter().flatten() {
            self.unsent += u64::from(self.sockets[*socket].send(datagram, to).is_err());
        }
    }
}

fn open(local: SocketAddr) -> io::Result<ReplySocket> {
    let socket = ReplySocket::bind(local)?;
    socket.socket().set_nonblocking(true)?;
    Ok(socket)
}

/// Silence in ns after which a peer may have moved, as after which the ladder holds.
const MOVES_AFTER_NS: u64 = 20_000_000;
/// Maximum number of answers owed to the second address.
const MAX_OWED: u32 = 4;

/// Evidence of a datagram about the peer's address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Received {
    /// A frame newer than all before.
    Fresh {
        /// True if the peer hears this side, so answers reach it.
        is_answered: bool,
    },
    /// A repeated or late frame of the peer.
    Repeat,
    /// A datagram of somebody else.
    Stranger(Stranger),
    /// No evidence.
    Nothing,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    reply_address: ReplyAddress,
    heard_ns: u64,
}

impl Place {
    fn is_silent(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.heard_ns) > MOVES_AFTER_NS
    }
}

/// Address of a peer.
///
/// The first copy of a frame to arrive is fresh, from any source. So a repeated frame is a sign of life, too. A peer
/// is followed elsewhere only after 20 ms without frames from its address: a faster copier does not attract the
/// answers.
///
/// If a copy is first, at the start or after a move, the peer reports that it hears nothing. Then a second address is
/// answered as well, one datagram for each received from it.
#[derive(Clone, Debug)]
struct Route {
    learns: bool,
    peer: Option<Place>,
    second: Option<Place>,
    owed: u32,
    /// Given by the newest frame.
    is_answered: bool,
}

impl Route {
    /// Route to one fixed address.
    fn known(address: SocketAddr) -> Self {
        Self {
            learns: false,
            peer: Some(Place { reply_address: address.into(), heard_ns: 0 }),
            ..Self::learned()
        }
    }

    fn learned() -> Self {
        Self { learns: true, peer: None, second: None, owed: 0, is_answered: false }
    }

    /// Return whether frames of the peer arrive from this address.
    fn lives_at(&self, now_ns: u64, from: SocketAddr) -> bool {
        self.peer.is_some_and(|peer| peer.reply_address.from == from && !peer.is_silent(now_ns))
    }

    fn admits(&self, from: SocketAddr) -> bool {
        self.learns || self.peer.is_some_and(|peer| peer.reply_address.from == from)
    }

    /// Update the addresses from a datagram of `reply_address` that arrived at `now_ns`.
    fn take(&mut self, now_ns: u64, reply_address: ReplyAddress, received: Received) {
        match received {
            Received::Fresh { is_answered } => self.is_answered = is_answered,
            Received::Repeat => {}
            Received::Stranger(_) | Received::Nothing => return,
        }
        if let (false, Some(peer)) = (self.learns, &mut self.peer) {
            peer.heard_ns = now_ns;
            return;
        }
        let here = Place { reply_address, heard_ns: now_ns };
        let is_at =
            |place: &Option<Place>| place.is_some_and(|place| place.reply_address.from == reply_address.from);
        let is_free = |place: &Option<Place>| place.is_none_or(|place| place.is_silent(now_ns));
        if is_at(&self.peer) {
            self.peer = Some(here);
        } else if matches!(received, Received::Fresh { .. }) && is_free(&self.peer) {
            self.second = self.peer.replace(here);
            self.owed = 0;
        } else if is_at(&self.second) || (!self.is_answered && is_free(&self.second)) {
            self.second = Some(here);
            self.owed = (self.owed + 1).min(MAX_OWED);
        }
    }

    fn next(&mut self) -> [Option<ReplyAddress>; 2] {
        let second = self.second.filter(|_| self.owed > 0);
        self.owed = self.owed.saturating_sub(1);
        [self.peer, second].map(|place| place.map(|place| place.reply_address))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use super::*;

    const MS: u64 = 1_000_000;
    const DELAY_NS: u64 = 60 * MS;

    /// A sender of the master's frames, and the ticks at which it sends.
    struct Sender {
        address: SocketAddr,
        faster_ns: u64,
        sends: fn(u64) -> bool,
    }

    fn at(port: u16) -> SocketAddr {
        SocketAddr::from(([10, 0, 0, 1], port))
    }

    /// Longest time in ns without an answer to the master, from `from_ns` on over `ticks` of 1 ms, and answers per
    /// address. The master is at `lives(tick)`.
    fn silence(
        ticks: u64,
        from_ns: u64,
        senders: &[Sender],
        lives: fn(u64) -> SocketAddr,
    ) -> (u64, BTreeMap<SocketAddr, u64>) {
        let mut route = Route::learned();
        let mut arrivals: Vec<(u64, SocketAddr, u64)> = Vec::new();
        for tick in 0..ticks {
            for sender in senders.iter().filter(|sender| (sender.sends)(tick)) {
                arrivals.push((tick * MS + DELAY_NS - sender.faster_ns, sender.address, tick));
            }
        }
        arrivals.sort_unstable();
        let (mut seen, mut newest, mut answers) = (BTreeSet::new(), None, BTreeMap::new());
        // Newest answer to the master, by send time.
        let mut answered_ns = vec![0; usize::try_from(ticks).unwrap()];
        let (mut last_ns, mut longest_ns, mut next) = (0, 0, 0);
        for now_ms in 0..ticks {
            let now_ns = now_ms * MS;
            while arrivals.get(next).is_some_and(|arrival| arrival.0 <= now_ns) {
                let (_, from, sequence) = arrivals[next];
                let is_answered = sequence * MS < answered_ns[usize::try_from(sequence).unwrap()] + 20 * MS
                    && answered_ns[usize::try_from(sequence).unwrap()] > 0;
                let is_news = seen.insert(sequence) && newest.is_none_or(|newest| sequence > newest);
                newest = newest.max(Some(sequence));
                let received = if is_news { Received::Fresh { is_answered } } else { Received::Repeat };
                route.take(now_ns, from.into(), received);
                next += 1;
            }
            for to in route.next().into_iter().flatten().map(|to| to.from) {
                *answers.entry(to).or_default() += 1;
                if to == lives(now_ms) {
                    last_ns = now_ns;
                    // It arrives one way later.
                    if let Some(slot) = answered_ns.get_mut(usize::try_from(now_ms + 60).unwrap()) {
                        *slot = now_ns + DELAY_NS;
                    }
                }
            }
            let here = usize::try_from(now_ms).unwrap();
            if here > 0 && answered_ns[here] == 0 {
                answered_ns[here] = answered_ns[here - 1];
            }
            if now_ns >= from_ns {
                longest_ns = longest_ns.max(now_ns - last_ns);
            }
        }
        (longest_ns, answers)
    }

    /// 1 to 50 ms faster, all frames or some, in mid-session.
    #[test]
    fn faster_copy_of_living_peer_gets_no_answer() {
        for faster_ms in [1, 2, 4, 10, 25, 50] {
            for sends in [
                (|tick| tick > 500) as fn(u64) -> bool,
                |tick| tick > 500 && tick % 2 == 0,
                |tick| tick > 500 && tick % 7 < 3,
                |tick| tick > 500 && tick / 100 % 2 == 0,
            ] {
                let senders = [
                    Sender { address: at(1), faster_ns: 0, sends: |_| true },
                    Sender { address: at(2), faster_ns: faster_ms * MS, sends },
                ];
                let (longest_ns, answers) = silence(3000, 200 * MS, &senders, |_| at(1));
                assert_eq!(longest_ns, 0, "{faster_ms} ms");
                assert_eq!(answers.get(&at(2)), None, "{faster_ms} ms");
            }
        }
    }

    /// The slave learns the copier's address before the peer's.
    #[test]
    fn copy_from_first_frame_leaves_answers_to_peer() {
        for faster_ms in [1, 4, 50] {
            let senders = [
                Sender { address: at(1), faster_ns: 0, sends: |_| true },
                Sender { address: at(2), faster_ns: faster_ms * MS, sends: |_| true },
            ];
            let (longest_ns, _) = silence(3000, 400 * MS, &senders, |_| at(1));
            assert!(longest_ns <= 20 * MS, "{faster_ms} ms: {longest_ns}");
        }
    }

    /// The peer's frames stall, the copies do not: the slave moves but still serves the peer.
    #[test]
    fn stalled_peer_is_not_lost_to_copier() {
        let senders = [
            Sender { address: at(1), faster_ns: 0, sends: |tick| !(1000..1060).contains(&tick) },
            Sender { address: at(2), faster_ns: 4 * MS, sends: |tick| tick > 500 },
        ];
        let (longest_ns, _) = silence(4000, 1300 * MS, &senders, |_| at(1));
        assert!(longest_ns <= 20 * MS, "{longest_ns}");
    }

    /// Only the relay's frames arrive, and they are answered.
    #[test]
    fn relay_that_replaces_peer_is_followed() {
        let senders = [
            Sender { address: at(1), faster_ns: 0, sends: |tick| tick < 1000 },
            Sender { address: at(2), faster_ns: 4 * MS, sends: |tick| tick > 500 },
        ];
        let (longest_ns, _) =
            silence(3000, 200 * MS, &senders, |tick| if tick < 1060 { at(1) } else { at(2) });
        assert!(longest_ns <= 25 * MS, "{longest_ns}");
    }

    /// An address translator gives the peer another address.
    #[test]
    fn moved_peer_is_followed_within_21_ms() {
        let senders = [
            Sender { address: at(1), faster_ns: 0, sends: |tick| tick < 1000 },
            Sender { address: at(3), faster_ns: 0, sends: |tick| tick >= 1000 },
        ];
        let (longest_ns, answers) =
            silence(3000, 200 * MS, &senders, |tick| if tick < 1060 { at(1) } else { at(3) });
        assert!(longest_ns <= 21 * MS, "{longest_ns}");
        assert!(answers[&at(3)] > 1900);
    }

    /// The peer moves while a faster copier is active.
    #[test]
    fn moved_peer_is_found_beside_copier() {
        let senders = [
            Sender { address: at(1), faster_ns: 0, sends: |tick| tick < 1000 },
            Sender { address: at(2), faster_ns: 4 * MS, sends: |tick| tick > 500 },
            Sender { address: at(3), faster_ns: 0, sends: |tick| tick >= 1000 },
        ];
        let (longest_ns, _) =
            silence(4000, 1400 * MS, &senders, |tick| if tick < 1060 { at(1) } else { at(3) });
        assert!(longest_ns <= 20 * MS, "{longest_ns}");
    }

    #[test]
    fn peer_on_this_machine_is_reached_from_loopback() {
        for peer in ["127.0.0.1:9000", "127.0.0.9:9000", "[::1]:9000", "[::ffff:127.0.0.1]:9000"] {
            let peer: SocketAddr = peer.parse().unwrap();
            // Not every machine has IPv6.
            if UdpSocket::bind((peer.ip(), 0)).is_err() {
                continue;
            }
            let local = local_address(peer).unwrap();
            assert!(local.ip().to_canonical().is_loopback(), "{peer}: {local}");
            assert_eq!(local.is_ipv6(), peer.is_ipv6());
            let mut socket = PeerSocket::bind(local, PeerAddress::Known(peer)).unwrap();
            assert_ne!(socket.local_address().unwrap().port(), 0);
            socket.send(None, &[0]);
            assert_eq!(socket.unsent, 0, "{peer}");
        }
    }

    /// The socket keeps the address that answers, and ignores the others.
    #[test]
    fn each_address_of_a_peer_is_tried_until_one_answers() {
        let any: SocketAddr = "127.0.0.1:0".parse().unwrap();
        let fresh = Received::Fresh { is_answered: true };
        for place in 0..3 {
            let ends: Vec<UdpSocket> = (0..3).map(|_| UdpSocket::bind(any).unwrap()).collect();
            let addresses: Vec<_> = ends.iter().map(|end| end.local_addr().unwrap()).collect();
            let locals: Vec<_> = addresses.iter().map(|&peer| (local_address(peer).unwrap(), peer)).collect();
            let mut socket = PeerSocket::bind_each(&locals).unwrap();
            for _ in 0..6 {
                socket.send(None, &[1]);
            }
            let mut buffer = [0; 8];
            let mut asked_from = Vec::new();
            for end in &ends {
                end.set_nonblocking(true).unwrap();
                let (mut count, mut from) = (0, None);
                while let Ok((_, sender)) = end.recv_from(&mut buffer) {
                    (count, from) = (count + 1, Some(sender));
                }
                assert_eq!(count, 2, "each in turn");
                asked_from.push(from.unwrap());
            }
            ends[place].send_to(&[2], asked_from[place]).unwrap();
            socket.drain(0, u64::MAX, |_, _| fresh);
            assert_eq!(socket.take_found(), Some(addresses[place]));
            assert_eq!(socket.take_found(), None);
            for _ in 0..6 {
                socket.send(None, &[1]);
            }
            for (index, end) in ends.iter().enumerate() {
                let count = std::iter::from_fn(|| end.recv_from(&mut buffer).ok()).count();
                assert_eq!(count, if index == place { 6 } else { 0 });
            }
            // The discarded address counts as a stranger's.
            ends[(place + 1) % 3].send_to(&[2], asked_from[place]).unwrap();
            socket.drain(0, u64::MAX, |_, _| fresh);
            assert_eq!(socket.elsewhere(), 1);
        }
    }

    /// Damage makes a frame look like one of another version.
    #[test]
    fn heard_peer_is_no_stranger() {
        for peer in [Some(at(1)), None] {
            let mut route = peer.map_or_else(Route::learned, Route::known);
            assert!(!route.lives_at(500 * MS, at(1)), "nothing was heard");
            route.take(500 * MS, at(1).into(), Received::Fresh { is_answered: false });
            assert!(route.lives_at(520 * MS, at(1)) && !route.lives_at(520 * MS, at(2)));
            route.take(521 * MS, at(1).into(), Received::Stranger(Stranger::Version));
            assert!(!route.lives_at(521 * MS, at(1)), "it is silent");
        }
    }

    #[test]
    fn known_peer_keeps_its_address() {
        let mut route = Route::known(at(1));
        assert!(route.admits(at(1)) && !route.admits(at(2)));
        route.take(100 * MS, at(1).into(), Received::Fresh { is_answered: false });
        assert_eq!(route.next(), [Some(at(1).into()), None]);
    }

    /// A copier of a few frames cannot redirect a stream.
    #[test]
    fn second_address_gets_one_answer_per_datagram() {
        let mut route = Route::learned();
        route.take(0, at(1).into(), Received::Fresh { is_answered: false });
        let mut to_second = 0;
        for tick in 0..1000 {
            route.take(tick * MS, at(1).into(), Received::Fresh { is_answered: false });
            if tick % 10 == 0 {
                route.take(tick * MS, at(2).into(), Received::Repeat);
            }
            to_second += u64::from(route.next()[1].is_some());
        }
        assert_eq!(to_second, 100);
    }

    #[test]
    fn invalid_datagrams_do_not_change_the_route() {
        let mut route = Route::learned();
        route.take(0, at(1).into(), Received::Nothing);
        assert_eq!(route.next(), [None, None]);
    }
}
