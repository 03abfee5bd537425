//! The keys that a session holds at once: the newest, those before it, and those that a handshake offered.

use super::{
    header::Header,
    keys::{Chain, Epoch, EpochId},
    rejection::Rejection,
    settings::SessionSettings,
    window::{Arrival, ReplayWindow},
};
use crate::wire::Role;

/// Handshakes whose keys wait for their first sealed datagram. One would do between two honest sides; a recorded
/// first message, sent again to a slave without a session, must not push out the master's own.
const OFFERED: usize = 4;
/// How long the keys of a new session wait for their first sealed datagram.
const OFFER_NS: u64 = 15_000_000_000;

/// Whose keys open a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Slot {
    Current,
    Previous,
    Offered(usize),
}

/// What taking new keys into use means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Turn {
    /// A session begins.
    Began,
    /// A session goes on under new keys.
    Rekeyed(u32),
}

#[derive(Debug)]
pub(super) struct Epochs {
    pub(super) current: Option<Epoch>,
    /// With the time until which it opens what was under way.
    previous: Option<(Epoch, u64)>,
    /// Of the session whose keys grew too old: they open nothing, but bind its next handshake to its two ends.
    pub(super) lapsed: Option<(EpochId, Chain)>,
    offered: [Option<Epoch>; OFFERED],
    next_offer: usize,
    window: ReplayWindow,
    previous_window: ReplayWindow,
}

impl Epochs {
    pub(super) fn new(settings: &SessionSettings) -> Self {
        let window = ReplayWindow::new(settings.window());
        Self {
            current: None,
            previous: None,
            lapsed: None,
            offered: [const { None }; OFFERED],
            next_offer: 0,
            previous_window: window.clone(),
            window,
        }
    }

    fn has_session(&self, session: u64) -> bool {
        let offered = self.offered.iter().flatten();
        self.current.iter().chain(offered).any(|epoch| epoch.id.session == session)
    }

    /// Finds the keys of a datagram and judges its counter; changes nothing.
    pub(super) fn find(
        &self,
        now_ns: u64,
        header: &Header,
        settings: &SessionSettings,
    ) -> Result<(Slot, Arrival), Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let lives = |epoch: &Epoch| epoch.id == id && epoch.age_ns(now_ns) < settings.open_ns();
        let slot = if self.current.as_ref().is_some_and(lives) {
            Slot::Current
        } else if self.previous.as_ref().is_some_and(|(epoch, until_ns)| lives(epoch) && now_ns < *until_ns) {
            Slot::Previous
        } else if let Some(at) = self.offered.iter().position(|epoch| epoch.as_ref().is_some_and(lives)) {
            Slot::Offered(at)
        } else if self.has_session(id.session) {
            return Err(Rejection::Epoch);
        } else {
            return Err(Rejection::Session);
        };
        if header.counter >= settings.most_sealed {
            return Err(Rejection::Counter);
        }
        let arrival = match slot {
            Slot::Current => self.window.judge(header.counter),
            Slot::Previous => self.previous_window.judge(header.counter),
            Slot::Offered(_) => Arrival::Newer,
        };
        match arrival {
            Arrival::TooOld => Err(Rejection::TooOld),
            // Judged by its tag, first: an authentic one says that the peer is where it came from.
            Arrival::Duplicate => Ok((slot, arrival)),
            // Whatever was sealed before the newest keys is older than what these have opened.
            _ if slot == Slot::Previous => Ok((slot, Arrival::Late)),
            arrival => Ok((slot, arrival)),
        }
    }

    pub(super) fn get(&self, slot: Slot) -> Option<&Epoch> {
        match slot {
            Slot::Current => self.current.as_ref(),
            Slot::Previous => self.previous.as_ref().map(|(epoch, _)| epoch),
            Slot::Offered(at) => self.offered.get(at).and_then(Option::as_ref),
        }
    }

    /// Marks the counter of a datagram that has proved to be of the peer; offered keys are in use from here on.
    pub(super) fn mark(
        &mut self,
        now_ns: u64,
        slot: Slot,
        counter: u64,
        settings: &SessionSettings,
    ) -> Option<Turn> {
        let turn = match slot {
            Slot::Offered(at) => self
                .offered
                .get_mut(at)
                .and_then(Option::take)
                .map(|epoch| self.turn(now_ns, epoch, settings)),
            _ => None,
        };
        match slot {
            Slot::Previous => self.previous_window.mark(counter),
            _ => self.window.mark(counter),
        };
        turn
    }

    /// Takes the keys of a handshake: the master into use, the slave until the master has used them.
    pub(super) fn install(&mut self, now_ns: u64, epoch: Epoch, settings: &SessionSettings) -> Option<Turn> {
        match settings.role {
            Role::Master => Some(self.turn(now_ns, epoch, settings)),
            Role::Slave => {
                self.offered[self.next_offer] = Some(epoch);
                self.next_offer = (self.next_offer + 1) % OFFERED;
                None
            }
        }
    }

    fn turn(&mut self, now_ns: u64, epoch: Epoch, settings: &SessionSettings) -> Turn {
        let EpochId { session, epoch: number } = epoch.id;
        let before = self.current.replace(epoch).filter(|before| before.id.session == session);
        let lapsed = self.lapsed.take().is_some_and(|(lapsed, _)| lapsed.session == session);
        let goes_on = before.is_some() || lapsed;
        self.previous = before.map(|before| (before, now_ns.saturating_add(settings.overlap_ns)));
        std::mem::swap(&mut self.window, &mut self.previous_window);
        self.window.clear();
        for offered in &mut self.offered {
            offered.take_if(|offered| offered.id.session != session || offered.id.epoch <= number);
        }
        if goes_on { Turn::Rekeyed(number) } else { Turn::Began }
    }

    /// Drops what time has run out for; says whether the newest keys were among it.
    pub(super) fn advance(&mut self, now_ns: u64, settings: &SessionSettings) -> bool {
        let most_ns = settings.open_ns();
        self.previous.take_if(|(epoch, until_ns)| now_ns >= *until_ns || epoch.age_ns(now_ns) >= most_ns);
        let living = self.id().map(|id| id.session);
        for offered in &mut self.offered {
            offered.take_if(|epoch| {
                let most_ns = if living == Some(epoch.id.session) { most_ns } else { OFFER_NS };
                epoch.age_ns(now_ns) >= most_ns
            });
        }
        let over = self.current.as_ref().is_some_and(|epoch| epoch.age_ns(now_ns) >= most_ns);
        if over {
            let lapsed = self.current.as_ref().map(|epoch| (epoch.id, epoch.chain.copied()));
            self.clear();
            self.lapsed = lapsed;
        }
        over
    }

    /// The newest keys, or those that grew too old in a session whose ends may go on.
    pub(super) fn id(&self) -> Option<EpochId> {
        self.current.as_ref().map(|epoch| epoch.id).or(self.lapsed.as_ref().map(|(id, _)| *id))
    }

    /// Forgets all keys.
    pub(super) fn clear(&mut self) {
        self.current = None;
        self.previous = None;
        self.lapsed = None;
        self.offered = [const { None }; OFFERED];
    }
}
