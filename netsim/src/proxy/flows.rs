//! Whom the proxy serves: each client has its own socket towards the peer, so that answers find the way back.

use std::net::{SocketAddr, UdpSocket};

/// Most clients served at a time.
pub const MAX_FLOWS: usize = 64;
/// A flow that has been silent for as long is closed.
const EXPIRY_NS: u64 = 60_000_000_000;
/// A flow that has been silent for as long makes room for another where there is none.
const YIELD_NS: u64 = 1_000_000_000;

/// One client.
#[derive(Debug)]
pub(super) struct Flow {
    pub(super) client: SocketAddr,
    /// Connected to the peer, so that the kernel refuses other sources and reports an absent peer.
    pub(super) upstream: UdpSocket,
    generation: u32,
    heard_ns: u64,
}

/// A flow, and which of those that had its place one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FlowId {
    place: usize,
    generation: u32,
}

/// All clients.
#[derive(Debug, Default)]
pub(super) struct Flows {
    places: Vec<Option<Flow>>,
    /// Where the last datagram came from, which is where the next one comes from.
    last: usize,
    generation: u32,
}

impl Flows {
    /// The flow of a client that is served, who has been heard now.
    pub(super) fn find(&mut self, client: SocketAddr, now_ns: u64) -> Option<FlowId> {
        let is_of = |flow: &Option<Flow>| flow.as_ref().is_some_and(|flow| flow.client == client);
        let place = if self.places.get(self.last).is_some_and(is_of) {
            self.last
        } else {
            self.places.iter().position(is_of)?
        };
        self.last = place;
        self.heard(place, now_ns)
    }

    /// The flow at a place, which has been heard now from either side.
    pub(super) fn heard(&mut self, place: usize, now_ns: u64) -> Option<FlowId> {
        let flow = self.places.get_mut(place)?.as_mut()?;
        flow.heard_ns = now_ns;
        Some(FlowId { place, generation: flow.generation })
    }

    /// Whether another client may come, who takes the place of the one that has been silent longest if need be.
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

    /// Takes a client in, after room was made.
    pub(super) fn open(&mut self, client: SocketAddr, upstream: UdpSocket, now_ns: u64) -> FlowId {
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

    /// Where the next client will be.
    pub(super) fn free_place(&self) -> usize {
        self.places.iter().position(Option::is_none).unwrap_or(self.places.len())
    }

    /// Closes what has long been silent.
    pub(super) fn expire(&mut self, now_ns: u64) {
        for place in &mut self.places {
            place.take_if(|flow| now_ns.saturating_sub(flow.heard_ns) >= EXPIRY_NS);
        }
    }

    /// The flow, if it is still open.
    pub(super) fn get(&self, id: FlowId) -> Option<&Flow> {
        self.at(id.place).filter(|flow| flow.generation == id.generation)
    }

    /// Whatever flow is at a place.
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

    fn client(number: usize) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, 1], u16::try_from(1000 + number).unwrap()))
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
        assert!(flows.get(second).is_none(), "the place is taken, the flow is not that one");
        assert_eq!(flows.get(third).unwrap().client, client(2));
    }

    #[test]
    fn where_all_places_are_taken_the_longest_silent_makes_room() {
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
