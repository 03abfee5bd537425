//! Packets that wait for their time.

use super::settings::{PlayoutError, PlayoutPolicy, PlayoutSettings};
use super::timeline::{Placed, Timeline};

/// What became of a packet that arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// It waits.
    Queued,
    /// It waits, and the play-out begins anew with it: the path or a clock changed.
    Anew,
    /// Its time, or a later packet, has been played: it is not used.
    Late,
    /// It waits already.
    Duplicate,
    /// A time that no monotonic clock shows: it is not used.
    Refused,
}

/// A packet whose time has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Played<T> {
    /// Its sequence.
    pub sequence: u64,
    /// When it was sent, on the sender's clock, in ns.
    pub sent_ns: u64,
    /// When it was due, on our clock, in ns; not after the time at which it is taken.
    pub play_ns: u64,
    /// How many sequences between it and the one played before are missing.
    pub gap: u64,
    /// What it carries.
    pub payload: T,
}

/// What became of the packets so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PlayoutCounts {
    /// Packets played.
    pub played: u64,
    /// Packets that came after their time, or after a later one was played.
    pub late: u64,
    /// Packets that waited already.
    pub duplicate: u64,
    /// Sequences passed over because they were not there in time.
    pub missing: u64,
    /// Packets passed over because a newer one was there, or that waited when the play-out began anew.
    pub superseded: u64,
    /// Packets passed over because more came than the capacity holds.
    pub overflowed: u64,
    /// How often the play-out began anew.
    pub anew: u64,
    /// Packets with impossible times.
    pub refused: u64,
}

#[derive(Clone, Copy, Debug)]
struct Slot<T> {
    sequence: u64,
    sent_ns: u64,
    arrived_ns: u64,
    payload: T,
}

/// Holds packets until their time and hands them out in order.
///
/// [`Self::arrived`] puts packets in, [`Self::next_due`] takes out one that is due; call it until none is left. Times of
/// successive calls do not decrease. What is handed out only ever goes forward in sequence, and nothing is allocated
/// after construction.
#[derive(Clone, Debug)]
pub struct Playout<T> {
    newest_only: bool,
    timeline: Timeline,
    /// At the place of the sequence modulo the length.
    slots: Box<[Option<Slot<T>>]>,
    /// The first sequence not yet passed; none before the first packet.
    next: Option<u64>,
    newest: u64,
    missing_since_played: u64,
    last_play_ns: u64,
    counts: PlayoutCounts,
}

impl<T: Copy> Playout<T> {
    /// Of settings.
    pub fn new(settings: PlayoutSettings) -> Result<Self, PlayoutError> {
        settings.check()?;
        Ok(Self {
            newest_only: settings.policy == PlayoutPolicy::Newest,
            timeline: Timeline::new(settings),
            slots: vec![None; settings.capacity].into_boxed_slice(),
            next: None,
            newest: 0,
            missing_since_played: 0,
            last_play_ns: 0,
            counts: PlayoutCounts::default(),
        })
    }

    /// Takes a packet that arrived at `now_ns` and was sent at `sent_ns` on the sender's clock.
    pub fn arrived(&mut self, sequence: u64, sent_ns: u64, now_ns: u64, payload: T) -> Arrival {
        if sequence == u64::MAX || sent_ns.max(now_ns) > i64::MAX.cast_unsigned() {
            self.counts.refused += 1;
            return Arrival::Refused;
        }
        if self.next.is_some_and(|next| sequence < next) {
            self.counts.late += 1;
            return Arrival::Late;
        }
        if self.waits(sequence) {
            self.counts.duplicate += 1;
            return Arrival::Duplicate;
        }
        let placed = if self.newest_only { Placed::InTime } else { self.timeline.arrived(sent_ns, now_ns) };
        if placed == Placed::Late {
            self.counts.late += 1;
            return Arrival::Late;
        }
        if placed == Placed::Anew {
            self.clear_waiting();
        }
        self.make_room(sequence);
        let slot = self.slot(sequence);
        self.slots[slot] = Some(Slot { sequence, sent_ns, arrived_ns: now_ns, payload });
        self.newest = self.newest.max(sequence);
        if placed == Placed::Anew {
            self.counts.anew += 1;
            return Arrival::Anew;
        }
        Arrival::Queued
    }

    /// Drops what waits for times of a timeline that has ended.
    fn clear_waiting(&mut self) {
        let Some(next) = self.next else { return };
        let waiting = self.slots.iter_mut().filter(|slot| slot.is_some_and(|slot| slot.sequence >= next));
        for slot in waiting {
            *slot = None;
            self.counts.superseded += 1;
        }
    }

    /// Passes over what is too far behind a sequence to be held beside it.
    fn make_room(&mut self, sequence: u64) {
        let capacity = self.slots.len() as u64;
        let next = *self.next.get_or_insert(sequence);
        let oldest = (sequence + 1).saturating_sub(capacity);
        if oldest > next {
            self.counts.overflowed += self.pass(next, oldest);
        }
    }

    /// Passes the sequences from `next` up to `until`; how many of them were there. The others are missing.
    fn pass(&mut self, next: u64, until: u64) -> u64 {
        let near = until.min(next.saturating_add(self.slots.len() as u64));
        let there = (next..near).filter(|&sequence| self.waits(sequence)).count() as u64;
        let missing = until - next - there;
        self.counts.missing += missing;
        self.missing_since_played += missing;
        self.next = Some(until);
        there
    }

    /// The next packet that is due at `now_ns`.
    pub fn next_due(&mut self, now_ns: u64) -> Option<Played<T>> {
        let next = self.next?;
        let (sequence, play_ns) = if self.newest_only {
            let slot = self.at(self.newest)?;
            (self.newest, slot.arrived_ns)
        } else {
            let (position, shift) = self.timeline.advance(now_ns)?;
            let sequence = (next..=self.newest).find(|&sequence| self.waits(sequence))?;
            let sent = self.at(sequence)?.sent_ns.cast_signed();
            if sent > position {
                return None;
            }
            (sequence, u64::try_from(sent.saturating_add(shift)).unwrap_or(0).min(now_ns))
        };
        let superseded = self.pass(next, sequence);
        self.counts.superseded += superseded;
        let Slot { sent_ns, payload, .. } = *self.at(sequence)?;
        self.next = Some(sequence + 1);
        self.counts.played += 1;
        // A play-out that jumps ahead in its warm-up hands out at once what was due meanwhile.
        self.last_play_ns = play_ns.max(self.last_play_ns);
        let gap = std::mem::take(&mut self.missing_since_played);
        Some(Played { sequence, sent_ns, play_ns: self.last_play_ns, gap, payload })
    }

    fn slot(&self, sequence: u64) -> usize {
        usize::try_from(sequence % self.slots.len() as u64).unwrap_or(0)
    }

    fn at(&self, sequence: u64) -> Option<&Slot<T>> {
        let next = self.next?;
        self.slots[self.slot(sequence)].as_ref().filter(|slot| slot.sequence == sequence && sequence >= next)
    }

    fn waits(&self, sequence: u64) -> bool {
        self.at(sequence).is_some()
    }

    /// How long in ns a packet of least delay waits now; none for [`PlayoutPolicy::Newest`] and before the first.
    pub fn wait_ns(&self) -> Option<u64> {
        self.timeline.wait_ns()
    }

    /// What became of the packets so far.
    pub fn counts(&self) -> PlayoutCounts {
        self.counts
    }

    /// Forgets all packets, not the counts: for a new session, whose sequences begin anew.
    pub fn restart(&mut self, settings: PlayoutSettings) -> Result<(), PlayoutError> {
        let counts = self.counts;
        *self = Self::new(settings)?;
        self.counts = counts;
        Ok(())
    }
}
