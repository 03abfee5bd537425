//! Two ends of a session and the wire between them, in virtual time.
#![allow(dead_code)] // each test file uses a part

use std::collections::BTreeMap;

use haptether_bridge::{
    session::{
        Arrival, Entropy, MAX_DATAGRAM, NoEntropy, PreSharedKey, Received, Rejection, SealError, SessionEnd,
        SessionSettings,
    },
    wire::Role,
};

pub(crate) const MS: u64 = 1_000_000;
pub(crate) const PAYLOAD: usize = 92;
/// Key shared by both sides.
pub(crate) fn key() -> PreSharedKey {
    PreSharedKey::new(b"the key that both ends share: 32").unwrap()
}

/// `SplitMix64`: random enough for tests, and reproducible.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) u64);

impl Numbers {
    pub(crate) fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
}

impl Entropy for Numbers {
    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), NoEntropy> {
        for chunk in bytes.chunks_mut(8) {
            let number = self.draw().to_le_bytes();
            chunk.copy_from_slice(&number[..chunk.len()]);
        }
        Ok(())
    }
}

pub(crate) fn settings(role: Role) -> SessionSettings {
    SessionSettings::new(role, PAYLOAD, MS)
}

pub(crate) fn end(settings: SessionSettings, key: PreSharedKey, seed: u64) -> SessionEnd {
    SessionEnd::secure(settings, key, &mut Numbers(seed)).unwrap()
}

/// Payload that contains its number.
pub(crate) fn payload(number: u64) -> [u8; PAYLOAD] {
    let mut bytes = [0; PAYLOAD];
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    bytes
}

pub(crate) fn number(payload: &[u8]) -> u64 {
    u64::from_le_bytes(payload[..8].try_into().unwrap())
}

/// Return the state of an end as text, without its counts of rejections.
pub(crate) fn state(end: &SessionEnd) -> String {
    let mut text = format!("{end:?}");
    for (start, stop) in [("rejections: Rejections([", "])"), ("forged: ", ",")] {
        let mut at = 0;
        while let Some(found) = text[at..].find(start) {
            let from = at + found + start.len();
            let to = from + text[from..].find(stop).unwrap();
            text.replace_range(from..to, "");
            at = from;
        }
    }
    text
}

/// Fate of a datagram on the wire: delays in ns, one for each copy that arrives.
pub(crate) type Fate = Box<dyn FnMut(u64, Role, &[u8]) -> Vec<u64>>;

pub(crate) struct Pair {
    pub(crate) master: SessionEnd,
    pub(crate) slave: SessionEnd,
    pub(crate) now_ns: u64,
    pub(crate) fate: Fate,
    /// Sent datagrams in order: time in ns, receiver, bytes.
    pub(crate) sent: Vec<(u64, Role, Vec<u8>)>,
    /// Accepted payloads: receiver, number, arrival.
    pub(crate) taken: Vec<(Role, u64, Arrival)>,
    pub(crate) rejected: Vec<(Role, Rejection)>,
    pub(crate) entropy: Numbers,
    under_way: BTreeMap<(u64, u64), (Role, Vec<u8>)>,
    count: u64,
}

impl Pair {
    pub(crate) fn new() -> Self {
        Self::with(settings(Role::Master), settings(Role::Slave))
    }

    pub(crate) fn with(master: SessionSettings, slave: SessionSettings) -> Self {
        Self {
            master: end(master, key(), 1),
            slave: end(slave, key(), 2),
            now_ns: 0,
            fate: Box::new(|_, _, _| vec![5 * MS]),
            sent: Vec::new(),
            taken: Vec::new(),
            rejected: Vec::new(),
            entropy: Numbers(3),
            under_way: BTreeMap::new(),
            count: 0,
        }
    }

    pub(crate) fn end(&mut self, role: Role) -> &mut SessionEnd {
        match role {
            Role::Master => &mut self.master,
            Role::Slave => &mut self.slave,
        }
    }

    pub(crate) fn carry(&mut self, to: Role, datagram: &[u8]) {
        self.sent.push((self.now_ns, to, datagram.to_vec()));
        for delay_ns in (self.fate)(self.now_ns, to, datagram) {
            self.count += 1;
            self.under_way.insert((self.now_ns + delay_ns, self.count), (to, datagram.to_vec()));
        }
    }

    pub(crate) fn send(&mut self, from: Role, number: u64) -> Result<(), SealError> {
        let mut buffer = [0; MAX_DATAGRAM];
        let now_ns = self.now_ns;
        let datagram = self.end(from).session.seal(now_ns, &payload(number), &mut buffer)?.to_vec();
        self.carry(peer(from), &datagram);
        Ok(())
    }

    pub(crate) fn deliver(&mut self, to: Role, mut datagram: Vec<u8>) {
        let now_ns = self.now_ns;
        let mut entropy = self.entropy.clone();
        let received = self.end(to).receive(now_ns, &mut datagram, &mut entropy);
        let reply = match received {
            Ok(Received::Payload { payload, arrival }) => {
                let number = number(payload);
                self.taken.push((to, number, arrival));
                None
            }
            Ok(Received::Reply(reply)) => Some(reply),
            Ok(Received::Nothing) => None,
            Err(rejection) => {
                self.rejected.push((to, rejection));
                None
            }
        };
        self.entropy = entropy;
        if let Some(reply) = reply {
            self.carry(peer(to), &reply);
        }
    }

    /// Tick by 1 ms: due datagrams arrive, and both sides poll and send.
    pub(crate) fn tick(&mut self, sends: bool) {
        self.now_ns += MS;
        while let Some(entry) = self.under_way.first_entry() {
            if entry.key().0 > self.now_ns {
                break;
            }
            let (to, datagram) = entry.remove();
            self.deliver(to, datagram);
        }
        for role in [Role::Master, Role::Slave] {
            let mut entropy = self.entropy.clone();
            let now_ns = self.now_ns;
            let message = self.end(role).poll(now_ns, &mut entropy).unwrap();
            self.entropy = entropy;
            if let Some(message) = message {
                self.carry(peer(role), &message);
            }
            if sends {
                let _ = self.send(role, now_ns);
            }
        }
    }

    pub(crate) fn run(&mut self, ticks: u64) {
        for _ in 0..ticks {
            self.tick(true);
        }
    }

    /// Return a pair with an open session, after the first payloads and with nothing in flight.
    pub(crate) fn opened() -> Self {
        let mut pair = Self::new();
        pair.run(40);
        for _ in 0..20 {
            pair.tick(false);
        }
        assert!(pair.master.session.is_open(pair.now_ns) && pair.slave.session.is_open(pair.now_ns));
        assert_eq!(pair.rejected, []);
        pair
    }

    pub(crate) fn taken_at(&self, role: Role) -> Vec<u64> {
        self.taken.iter().filter(|(at, ..)| *at == role).map(|(_, number, _)| *number).collect()
    }
}

pub(crate) fn peer(role: Role) -> Role {
    match role {
        Role::Master => Role::Slave,
        Role::Slave => Role::Master,
    }
}
