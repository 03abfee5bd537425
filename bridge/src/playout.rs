//! Play-out buffer: makes the packets' delay constant, for couplings that need it.

mod frames;

use crate::path::{BILLION, difference, share_up};

pub(crate) use frames::PlayOut;

/// Settings of a play-out. Only the delay usually needs a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlayoutSettings {
    /// Wait in ns of a packet with the smallest delay: the jitter that is removed.
    pub delay_ns: u64,
    /// True if the wait follows the largest jitter in the window, with a quarter and 1 ms more, up to `delay_ns`. It then
    /// grows at ten times the rate at which it shrinks.
    pub adapts: bool,
    /// Maximum number of waiting sequences, missing ones included: above delay times rate.
    pub capacity: usize,
    /// Window in ns of the minimum delay.
    pub window_ns: u64,
    /// Time in ns after the first packet in which the play-out follows the minimum at once.
    pub warm_up_ns: u64,
    /// Smallest shift in ns that is followed.
    pub tolerance_ns: u64,
    /// Rate of a shift in parts per billion; below 1e9, so that time never runs backwards.
    pub slew_ppb: u64,
    /// Time in ns of only late packets after which the play-out restarts, since path or clock changed. A packet that
    /// would wait longer than this beyond its delay restarts it at once.
    pub relearn_ns: u64,
}

impl PlayoutSettings {
    /// Defaults: 1024 sequences, window 10 s, warm-up 1 s, moves of 0.5 percent beyond 0.5 ms, restart after 200 ms
    /// of late packets.
    pub const fn new(delay_ns: u64) -> Self {
        Self {
            delay_ns,
            adapts: false,
            capacity: 1024,
            window_ns: 10_000_000_000,
            warm_up_ns: 1_000_000_000,
            tolerance_ns: 500_000,
            slew_ppb: 5_000_000,
            relearn_ns: 200_000_000,
        }
    }

    fn check(&self) -> Result<(), PlayoutError> {
        if !(1..=1 << 20).contains(&self.capacity) {
            return Err(PlayoutError::Capacity(self.capacity));
        }
        if self.slew_ppb >= BILLION {
            return Err(PlayoutError::Slew(self.slew_ppb));
        }
        Ok(())
    }
}

/// Wait in ns beyond the jitter that a play-out has measured.
const ADAPTED_MARGIN_NS: i64 = 1_000_000;

/// Invalid settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlayoutError {
    /// Capacity out of range.
    #[error("capacity = {0}: must be from 1 to 1048576 sequences")]
    Capacity(usize),
    /// Time would run backwards.
    #[error("slew_ppb = {0}: must be below 1000000000, or time runs backwards")]
    Slew(u64),
}

/// Result of an arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// The packet waits.
    Queued,
    /// The packet waits and restarts the play-out: path or clock changed.
    Anew,
    /// Not used: its time has passed, or a later packet was played.
    Late,
    /// The packet waits already.
    Duplicate,
    /// Not used: invalid for a monotonic clock.
    Refused,
}

/// A packet that is due.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Played<T> {
    /// Sequence.
    pub sequence: u64,
    /// Send time on the sender's clock in ns.
    pub sent_ns: u64,
    /// Due time on this clock in ns; not in the future.
    pub play_ns: u64,
    /// Missing sequences since the packet played before.
    pub gap: u64,
    /// Payload.
    pub payload: T,
}

/// Counts of packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PlayoutCounts {
    /// Packets played.
    pub played: u64,
    /// Packets that arrived after their time or after a later one was played.
    pub late: u64,
    /// Packets that waited already.
    pub duplicate: u64,
    /// Sequences that had not arrived in time.
    pub missing: u64,
    /// Packets skipped for a newer one, or by a restart.
    pub superseded: u64,
    /// Packets skipped for lack of capacity.
    pub overflowed: u64,
    /// Number of restarts.
    pub anew: u64,
    /// Packets with invalid times.
    pub refused: u64,
}

#[derive(Clone, Copy, Debug)]
struct Slot<T> {
    sequence: u64,
    sent_ns: u64,
    payload: T,
}

/// Holds packets until their time and returns them in order.
///
/// [`Self::arrived`] adds packets; [`Self::next_due`] takes due ones, until none is left. Call times must not
/// decrease; sequences returned only increase. Nothing is allocated after construction.
#[derive(Clone, Debug)]
pub struct Playout<T> {
    timeline: Timeline,
    /// Indexed by sequence modulo length.
    slots: Box<[Option<Slot<T>>]>,
    /// First sequence not passed yet.
    next: Option<u64>,
    newest: u64,
    missing_since_played: u64,
    last_play_ns: u64,
    counts: PlayoutCounts,
}

impl<T: Copy> Playout<T> {
    /// Create an empty play-out.
    pub fn new(settings: PlayoutSettings) -> Result<Self, PlayoutError> {
        settings.check()?;
        Ok(Self {
            timeline: Timeline::new(settings),
            slots: vec![None; settings.capacity].into_boxed_slice(),
            next: None,
            newest: 0,
            missing_since_played: 0,
            last_play_ns: 0,
            counts: PlayoutCounts::default(),
        })
    }

    /// Take a packet that arrived at `now_ns`, sent at `sent_ns` on the sender's clock.
    pub fn arrived(&mut self, sequence: u64, sent_ns: u64, now_ns: u64, payload: T) -> Arrival {
        if sequence == u64::MAX || sent_ns.max(now_ns) > i64::MAX.cast_unsigned() {
            self.counts.refused += 1;
            return Arrival::Refused;
        }
        if self.next.is_some_and(|next| sequence < next) {
            // The wait must learn from the slowest packets, too.
            self.timeline.learn(now_ns, difference(now_ns, sent_ns));
            self.counts.late += 1;
            return Arrival::Late;
        }
        if self.waits(sequence) {
            self.counts.duplicate += 1;
            return Arrival::Duplicate;
        }
        let placed = self.timeline.arrived(sent_ns, now_ns);
        if placed == Placed::Late {
            self.counts.late += 1;
            return Arrival::Late;
        }
        if placed == Placed::Anew {
            self.clear_waiting();
        }
        self.make_room(sequence);
        let slot = self.slot(sequence);
        self.slots[slot] = Some(Slot { sequence, sent_ns, payload });
        self.newest = self.newest.max(sequence);
        if placed == Placed::Anew {
            self.counts.anew += 1;
            return Arrival::Anew;
        }
        Arrival::Queued
    }

    /// Drop packets of a previous timeline.
    fn clear_waiting(&mut self) {
        let Some(next) = self.next else { return };
        let waiting = self.slots.iter_mut().filter(|slot| slot.is_some_and(|slot| slot.sequence >= next));
        for slot in waiting {
            *slot = None;
            self.counts.superseded += 1;
        }
    }

    /// Skip sequences beyond the capacity.
    fn make_room(&mut self, sequence: u64) {
        let capacity = self.slots.len() as u64;
        let next = *self.next.get_or_insert(sequence);
        let oldest = (sequence + 1).saturating_sub(capacity);
        if oldest > next {
            self.counts.overflowed += self.pass(next, oldest);
        }
    }

    /// Pass sequences up to `until`. Returns how many were present.
    fn pass(&mut self, next: u64, until: u64) -> u64 {
        let near = until.min(next.saturating_add(self.slots.len() as u64));
        let there = (next..near).filter(|&sequence| self.waits(sequence)).count() as u64;
        let missing = until - next - there;
        self.counts.missing += missing;
        self.missing_since_played += missing;
        self.next = Some(until);
        there
    }

    /// Remove the next packet that is due at `now_ns`.
    pub fn next_due(&mut self, now_ns: u64) -> Option<Played<T>> {
        let next = self.next?;
        let (position, shift) = self.timeline.advance(now_ns)?;
        let sequence = (next..=self.newest).find(|&sequence| self.waits(sequence))?;
        let Slot { sent_ns, payload, .. } = *self.at(sequence)?;
        let sent = sent_ns.cast_signed();
        if sent > position {
            return None;
        }
        let play_ns = u64::try_from(sent.saturating_add(shift)).unwrap_or(0).min(now_ns);
        let superseded = self.pass(next, sequence);
        self.counts.superseded += superseded;
        self.next = Some(sequence + 1);
        self.counts.played += 1;
        // A jump ahead in the warm-up plays at once what became due meanwhile.
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

    /// Present wait in ns of a packet with the minimum delay; `None` before the first packet.
    pub fn wait_ns(&self) -> Option<u64> {
        self.timeline.wait_ns()
    }

    /// Count so far.
    pub fn counts(&self) -> PlayoutCounts {
        self.counts
    }

    /// Clear packets, not counts, for a new run of the sender.
    pub fn restart(&mut self) {
        self.timeline = Timeline::new(self.timeline.settings);
        self.slots.fill(None);
        (self.next, self.newest, self.missing_since_played, self.last_play_ns) = (None, 0, 0, 0);
    }
}

/// Time of the sender that is due, as `now - shift`.
///
/// The shift is the minimum transit in a window plus the delay. A transit is a difference of unrelated clocks: only
/// its changes mean something. Near its target the shift rests, so that packets are played exactly as spaced when
/// sent. Otherwise it moves slowly.
#[derive(Clone, Debug, PartialEq)]
struct Timeline {
    settings: PlayoutSettings,
    least: WindowMinimum,
    /// Minimum of the negative transit.
    most: WindowMinimum,
    shift_ns: Option<i64>,
    began_ns: u64,
    moved_ns: u64,
    moving: bool,
    /// Start of a period of only late packets.
    late_since_ns: Option<u64>,
    /// Latest due time of the sender; does not decrease.
    position_ns: Option<i64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Placed {
    InTime,
    Late,
    /// It starts a new timeline.
    Anew,
}

impl Timeline {
    fn new(settings: PlayoutSettings) -> Self {
        Self {
            settings,
            least: WindowMinimum::new(settings.window_ns),
            most: WindowMinimum::new(settings.window_ns),
            shift_ns: None,
            began_ns: 0,
            moved_ns: 0,
            moving: false,
            late_since_ns: None,
            position_ns: None,
        }
    }

    fn arrived(&mut self, sent_ns: u64, now_ns: u64) -> Placed {
        if self.shift_ns.is_none() {
            self.begin(sent_ns, now_ns);
            return Placed::InTime;
        }
        let transit = difference(now_ns, sent_ns);
        let earlier = self.least.least().map_or(0, |least| least.saturating_sub(transit));
        if !self.is_warming(now_ns) && earlier > self.settings.relearn_ns.cast_signed() {
            self.begin(sent_ns, now_ns);
            return Placed::Anew;
        }
        self.learn(now_ns, transit);
        if self.position_ns.is_none_or(|position| sent_ns.cast_signed() > position) {
            self.late_since_ns = None;
            return Placed::InTime;
        }
        let since = *self.late_since_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(since) >= self.settings.relearn_ns {
            self.begin(sent_ns, now_ns);
            return Placed::Anew;
        }
        Placed::Late
    }

    fn begin(&mut self, sent_ns: u64, now_ns: u64) {
        *self = Self::new(self.settings);
        self.began_ns = now_ns;
        self.moved_ns = now_ns;
        self.learn(now_ns, difference(now_ns, sent_ns));
    }

    fn learn(&mut self, now_ns: u64, transit: i64) {
        self.least.add(now_ns, transit);
        self.most.add(now_ns, transit.saturating_neg());
        if self.shift_ns.is_none() || self.is_warming(now_ns) {
            self.shift_ns = self.target_ns();
        }
    }

    fn is_warming(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.began_ns) < self.settings.warm_up_ns
    }

    fn target_ns(&self) -> Option<i64> {
        let least = self.least.least()?;
        let delay = i64::try_from(self.settings.delay_ns).unwrap_or(i64::MAX);
        let jitter = self.most.least().map_or(0, |most| most.saturating_neg().saturating_sub(least));
        let wait = jitter.saturating_add(jitter / 4).saturating_add(ADAPTED_MARGIN_NS);
        Some(least.saturating_add(if self.settings.adapts { wait.min(delay) } else { delay }))
    }

    /// Advances to `now_ns`. Returns the sender's time that is due, and the shift.
    fn advance(&mut self, now_ns: u64) -> Option<(i64, i64)> {
        let (mut shift, target) = (self.shift_ns?, self.target_ns()?);
        let elapsed = now_ns.saturating_sub(self.moved_ns);
        self.moved_ns = self.moved_ns.max(now_ns);
        let away = target.saturating_sub(shift);
        self.moving = away != 0 && (self.moving || away.unsigned_abs() > self.settings.tolerance_ns);
        if self.moving {
            // Rounded up, so that ticks of any length move; 1 ns does not reverse a longer tick.
            let factor = if self.settings.adapts && away > 0 { 10 } else { 1 };
            let most = share_up(elapsed, self.settings.slew_ppb * factor).min(elapsed).cast_signed();
            shift += away.clamp(-most, most);
            self.shift_ns = Some(shift);
        }
        let due = now_ns.cast_signed().saturating_sub(shift);
        let position = self.position_ns.map_or(due, |before| before.max(due));
        self.position_ns = Some(position);
        Some((position, shift))
    }

    fn wait_ns(&self) -> Option<u64> {
        let wait = self.shift_ns?.saturating_sub(self.least.least()?);
        Some(u64::try_from(wait).unwrap_or(0))
    }
}

const BLOCKS: usize = 8;

/// Minimum over a window of time, in bounded memory.
///
/// Eight blocks keep a minimum each: seven to eight eighths of the window.
#[derive(Clone, Debug, PartialEq)]
struct WindowMinimum {
    block_ns: u64,
    newest: u64,
    blocks: [Option<i64>; BLOCKS],
    least: Option<i64>,
}

impl WindowMinimum {
    fn new(window_ns: u64) -> Self {
        Self { block_ns: (window_ns / BLOCKS as u64).max(1), newest: 0, blocks: [None; BLOCKS], least: None }
    }

    fn add(&mut self, now_ns: u64, key: i64) {
        let block = (now_ns / self.block_ns).max(self.newest);
        if block > self.newest {
            for passed in (self.newest + 1..=block).take(self.blocks.len()) {
                self.blocks[Self::slot(passed)] = None;
            }
            self.newest = block;
            self.least = self.blocks.iter().flatten().min().copied();
        }
        let slot = &mut self.blocks[Self::slot(block)];
        for kept in [slot, &mut self.least] {
            if kept.is_none_or(|kept| key <= kept) {
                *kept = Some(key);
            }
        }
    }

    fn least(&self) -> Option<i64> {
        self.least
    }

    fn slot(block: u64) -> usize {
        usize::try_from(block % BLOCKS as u64).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests;
