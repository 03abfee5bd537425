//! The last transitions, in a fixed room.

use super::{state::LadderState, table::Reason};

/// One step on the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transition {
    /// When, in ns.
    pub time_ns: u64,
    /// From where.
    pub from: LadderState,
    /// To where.
    pub to: LadderState,
    /// Why.
    pub reason: Reason,
}

/// How many transitions are kept.
const KEPT: usize = 32;

/// The last transitions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct History {
    ring: [Option<Transition>; KEPT],
    count: usize,
}

impl Default for History {
    fn default() -> Self {
        Self { ring: [None; KEPT], count: 0 }
    }
}

impl History {
    /// Keeps one more, in place of the oldest.
    pub(super) fn push(&mut self, transition: Transition) {
        self.ring[self.count % KEPT] = Some(transition);
        self.count += 1;
    }

    /// How many there were.
    pub fn count(&self) -> usize {
        self.count
    }

    /// The newest.
    pub fn last(&self) -> Option<Transition> {
        self.ring[self.count.checked_sub(1)? % KEPT]
    }

    /// Why it stands where it does: of a hold that became a stop, why it first held.
    pub fn cause(&self) -> Option<Reason> {
        let last = self.last()?;
        if !matches!(last.to, LadderState::Hold | LadderState::Stop) {
            return Some(last.reason);
        }
        let kept = self.count.saturating_sub(KEPT)..self.count;
        let newest_first = kept.rev().filter_map(|index| self.ring[index % KEPT]);
        newest_first.into_iter().find(|step| !step.from.is_held()).or(Some(last)).map(|step| step.reason)
    }

    /// Those that are kept, the oldest first.
    pub fn iter(&self) -> impl Iterator<Item = Transition> + '_ {
        (self.count.saturating_sub(KEPT)..self.count).filter_map(|index| self.ring[index % KEPT])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_is_caused_by_what_led_to_its_hold() {
        use LadderState::{Aligning, Disengaged, Engaged, Fault, Hold, Stop};
        let mut history = History::default();
        assert_eq!(history.cause(), None);
        for (from, to, reason, cause) in [
            (Disengaged, Aligning, Reason::ClutchPressed, Reason::ClutchPressed),
            (Engaged, Hold, Reason::PeerFaulted, Reason::PeerFaulted),
            (Hold, Stop, Reason::SilentTooLong, Reason::PeerFaulted),
            (Stop, Aligning, Reason::ClutchPressed, Reason::ClutchPressed),
            (Engaged, Hold, Reason::OwnDelay, Reason::OwnDelay),
            (Hold, Fault, Reason::BadNumber, Reason::BadNumber),
        ] {
            history.push(Transition { time_ns: 0, from, to, reason });
            assert_eq!(history.cause(), Some(cause));
        }
    }

    #[test]
    fn the_last_ones_are_kept_in_order() {
        let mut history = History::default();
        assert_eq!((history.last(), history.iter().count()), (None, 0));
        for time_ns in 0..100 {
            let (from, to) = (LadderState::Engaged, LadderState::Stale);
            history.push(Transition { time_ns, from, to, reason: Reason::FramesLate });
        }
        let times: Vec<_> = history.iter().map(|one| one.time_ns).collect();
        assert_eq!(times, (68..100).collect::<Vec<_>>());
        assert_eq!((history.count(), history.last().unwrap().time_ns), (100, 99));
    }
}
