//! Keys that a session holds at the same time (newest, previous, offered by a handshake), and their replay
//! windows.

use super::{
    keys::{Chain, Epoch, EpochId},
    settings::SessionSettings,
    wire::{Header, Rejection},
};
use crate::wire::Role;

/// Capacity in offered keys that wait for their first sealed datagram. Two honest sides need one. An attacker
/// may replay a recorded first message to a slave without a session; that must not displace the master's own
/// offer.
const OFFERED: usize = 4;
/// Time in ns that the keys of a new session wait for their first sealed datagram.
const OFFER_NS: u64 = 15_000_000_000;

/// Keys that open a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Slot {
    Current,
    Previous,
    Offered(usize),
}

/// Effect of taking new keys into use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum KeyChange {
    /// A session begins.
    Began,
    /// The session continues with new keys; the number is their epoch.
    Rekeyed(u32),
}

#[derive(Debug)]
pub(super) struct Epochs {
    pub(super) current: Option<Epoch>,
    /// Keys before the newest, and the time in ns until which they open datagrams that were in flight.
    previous: Option<(Epoch, u64)>,
    /// Id and chain of expired keys. They open nothing, but they bind the session's next handshake to its two
    /// ends.
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

    /// Find the keys of a datagram and judge its counter, without a change of state.
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
        if header.counter >= settings.max_sealed {
            return Err(Rejection::Counter);
        }
        let arrival = match slot {
            Slot::Current => self.window.judge(header.counter),
            Slot::Previous => self.previous_window.judge(header.counter),
            Slot::Offered(_) => Arrival::Newer,
        };
        match arrival {
            Arrival::TooOld => Err(Rejection::TooOld),
            // The tag is checked first: an authentic duplicate still shows that the peer is at the sender's
            // address.
            Arrival::Duplicate => Ok((slot, arrival)),
            // Datagrams sealed with the previous keys are older than any sealed with the newest.
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

    /// Mark the counter of an authentic datagram. Offered keys come into use with their first one.
    pub(super) fn mark(
        &mut self,
        now_ns: u64,
        slot: Slot,
        counter: u64,
        settings: &SessionSettings,
    ) -> Option<KeyChange> {
        let change = match slot {
            Slot::Offered(at) => self
                .offered
                .get_mut(at)
                .and_then(Option::take)
                .map(|epoch| self.take_into_use(now_ns, epoch, settings)),
            _ => None,
        };
        match slot {
            Slot::Previous => self.previous_window.mark(counter),
            _ => self.window.mark(counter),
        };
        change
    }

    /// Install the keys of a handshake. The master uses them at once; the slave once the master has used
    /// them.
    pub(super) fn install(
        &mut self,
        now_ns: u64,
        epoch: Epoch,
        settings: &SessionSettings,
    ) -> Option<KeyChange> {
        match settings.role {
            Role::Master => Some(self.take_into_use(now_ns, epoch, settings)),
            Role::Slave => {
                self.offered[self.next_offer] = Some(epoch);
                self.next_offer = (self.next_offer + 1) % OFFERED;
                None
            }
        }
    }

    fn take_into_use(&mut self, now_ns: u64, epoch: Epoch, settings: &SessionSettings) -> KeyChange {
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
        if goes_on { KeyChange::Rekeyed(number) } else { KeyChange::Began }
    }

    /// Drop expired keys; return whether the newest keys were among them.
    pub(super) fn advance(&mut self, now_ns: u64, settings: &SessionSettings) -> bool {
        let max_ns = settings.open_ns();
        self.previous.take_if(|(epoch, until_ns)| now_ns >= *until_ns || epoch.age_ns(now_ns) >= max_ns);
        let living = self.id().map(|id| id.session);
        for offered in &mut self.offered {
            offered.take_if(|epoch| {
                let max_ns = if living == Some(epoch.id.session) { max_ns } else { OFFER_NS };
                epoch.age_ns(now_ns) >= max_ns
            });
        }
        let over = self.current.as_ref().is_some_and(|epoch| epoch.age_ns(now_ns) >= max_ns);
        if over {
            let lapsed = self.current.as_ref().map(|epoch| (epoch.id, epoch.chain.copied()));
            self.clear();
            self.lapsed = lapsed;
        }
        over
    }

    /// Id of the newest keys, or of the expired keys of a session whose ends may continue.
    pub(super) fn id(&self) -> Option<EpochId> {
        self.current.as_ref().map(|epoch| epoch.id).or(self.lapsed.as_ref().map(|(id, _)| *id))
    }

    pub(super) fn clear(&mut self) {
        self.current = None;
        self.previous = None;
        self.lapsed = None;
        self.offered = [const { None }; OFFERED];
    }
}

/// Position of a counter relative to those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// Above all earlier counters.
    Newer,
    /// Below the newest counter, and not seen before.
    Late,
    /// Seen before.
    Duplicate,
    /// Too far below the newest counter to know whether it was seen before.
    TooOld,
}

/// Bitmap of the newest `reach` counters. It is not shifted, and its memory is reserved once.
///
/// Words form a ring; a newer counter clears the words between. The ring has one word more than the reach
/// needs, so that the oldest counters within reach never share a word with the newest.
///
/// Source: RFC 6479; RFC 4303, section 3.4.3 (judged before the tag is checked, marked after).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReplayWindow {
    words: Box<[u64]>,
    reach: u64,
    newest: Option<u64>,
}

impl ReplayWindow {
    /// Build a window over the newest `reach` counters; 1 at least.
    pub fn new(reach: u32) -> Self {
        let reach = reach.max(1);
        let words = (reach.div_ceil(64) as usize + 1).next_power_of_two();
        Self { words: vec![0; words].into_boxed_slice(), reach: u64::from(reach), newest: None }
    }

    /// Return word and bit of a counter.
    fn place(&self, counter: u64) -> (usize, u64) {
        #[allow(clippy::cast_possible_truncation)] // masked to the slice length, a power of two
        let word = ((counter / 64) & (self.words.len() as u64 - 1)) as usize;
        (word, 1 << (counter % 64))
    }

    /// Judge a counter without a change of state.
    pub fn judge(&self, counter: u64) -> Arrival {
        match self.newest {
            Some(newest) if counter <= newest => {
                if newest - counter >= self.reach {
                    return Arrival::TooOld;
                }
                let (word, bit) = self.place(counter);
                if self.words[word] & bit == 0 { Arrival::Late } else { Arrival::Duplicate }
            }
            _ => Arrival::Newer,
        }
    }

    /// Mark a counter as seen and return its earlier position; a counter that is too old is not marked.
    #[inline]
    pub fn mark(&mut self, counter: u64) -> Arrival {
        let is_next = self.newest.is_some_and(|newest| newest.wrapping_add(1) == counter);
        if is_next && !counter.is_multiple_of(64) {
            // Common case: the next counter, in a word that is already cleared.
            let (word, bit) = self.place(counter);
            self.words[word] |= bit;
            self.newest = Some(counter);
            return Arrival::Newer;
        }
        self.mark_any(counter)
    }

    fn mark_any(&mut self, counter: u64) -> Arrival {
        let arrival = self.judge(counter);
        if arrival == Arrival::Newer {
            if let Some(newest) = self.newest {
                let passed = (counter / 64 - newest / 64).min(self.words.len() as u64);
                for step in 0..passed {
                    let (word, _) = self.place(counter - 64 * step);
                    self.words[word] = 0;
                }
            }
            self.newest = Some(counter);
        }
        if arrival != Arrival::TooOld {
            let (word, bit) = self.place(counter);
            self.words[word] |= bit;
        }
        arrival
    }

    /// Clear all counters.
    pub fn clear(&mut self) {
        self.words.fill(0);
        self.newest = None;
    }

    /// Highest marked counter.
    pub fn newest(&self) -> Option<u64> {
        self.newest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    /// Reference: judge by the definition, with a set of all earlier counters.
    fn judged(seen: &BTreeSet<u64>, reach: u64, counter: u64) -> Arrival {
        match seen.last() {
            Some(newest) if counter <= *newest => {
                if newest - counter >= reach {
                    Arrival::TooOld
                } else if seen.contains(&counter) {
                    Arrival::Duplicate
                } else {
                    Arrival::Late
                }
            }
            _ => Arrival::Newer,
        }
    }

    #[test]
    fn counter_limits_are_handled() {
        let mut window = ReplayWindow::new(64);
        assert_eq!(window.mark(u64::MAX - 1), Arrival::Newer);
        assert_eq!(window.mark(u64::MAX), Arrival::Newer);
        assert_eq!(window.mark(u64::MAX - 63), Arrival::Late);
        assert_eq!(window.mark(u64::MAX - 64), Arrival::TooOld);
        assert_eq!(window.mark(0), Arrival::TooOld);
        window.clear();
        assert_eq!(window.mark(0), Arrival::Newer);
        assert_eq!(window.mark(0), Arrival::Duplicate);
    }

    proptest! {
        #[test]
        fn it_agrees_with_a_set(
            reach in 1u32..400,
            start in prop_oneof![Just(0u64), Just(u64::MAX - 100_000), any::<u64>().prop_map(|n| n / 2)],
            steps in prop::collection::vec(prop_oneof![8 => Just(1i64), 8 => -500i64..100, 1 => 0i64..2000], 1..400),
        ) {
            let (mut window, mut seen, mut at) = (ReplayWindow::new(reach), BTreeSet::new(), start);
            for step in steps {
                let counter = at.saturating_add_signed(step);
                let expected = judged(&seen, u64::from(reach), counter);
                prop_assert_eq!(window.judge(counter), expected);
                let mut by_any = window.clone();
                prop_assert_eq!(by_any.mark_any(counter), expected);
                prop_assert_eq!(window.mark(counter), expected);
                prop_assert_eq!((&window.words, window.newest), (&by_any.words, by_any.newest));
                seen.insert(counter);
                at = *seen.last().unwrap();
                prop_assert_eq!(window.newest(), Some(at));
            }
        }
    }
}
