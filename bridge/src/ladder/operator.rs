//! Control of the clutch: a device's button, operator commands, or a simulated operator.

use super::table::LadderState;

/// Mode of control of the clutch.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Clutch {
    /// Pressed at the start and held throughout. After a hold, only [`ClutchOperator::press_again`] couples
    /// again.
    #[default]
    Once,
    /// A simulated operator. It presses at the start and releases after a hold or an unanswered press. It
    /// presses again once both sides have been ready for `reaction_ns`.
    Auto {
        /// Reaction time in ns.
        reaction_ns: u64,
    },
    /// Pressed between the two times of each pair, in ns since the start.
    Schedule(Vec<(u64, u64)>),
}

/// Invalid times of a clutch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ClutchError {
    /// A release not after its press, or a press not after the previous release.
    #[error("clutch {0}: presses and releases must follow one another in time")]
    Order(usize),
    /// Reaction time out of range.
    #[error("clutch reaction = {0} ns: must be between 50000000 and 60000000000")]
    Reaction(u64),
}

/// Time in ns for which [`ClutchOperator::press_again`] opens the clutch: enough frames for the other side to
/// see it.
const OPEN_NS: u64 = 100_000_000;

/// Timeout in ns of [`ClutchOperator::press_again`]: a loop that slept meanwhile drops the press.
const LATEST_NS: u64 = 2 * OPEN_NS;

/// Time in ns for which a press counts: handshake, first frames and one retry of each at 500 ms one-way
/// delay. The start counts as a press only if the first tick is within this time.
pub const PRESS_NS: u64 = 5_000_000_000;

/// Operator of the clutch of a side without a button, by [`Clutch`] and operator commands. It is a pure
/// function of time and of the ladder's state.
#[allow(clippy::struct_excessive_bools)] // actions and observations so far
#[derive(Clone, Debug, PartialEq)]
pub struct ClutchOperator {
    clutch: Clutch,
    start_ns: u64,
    pressed: bool,
    /// Time in ns of the last press or release.
    since_ns: u64,
    /// Time in ns since which both sides have been ready.
    ready_ns: Option<u64>,
    /// True if the side had a fault since the last press. The operator who acknowledges it decides when to
    /// press.
    has_faulted: bool,
    requested: bool,
    has_begun: bool,
    /// Time in ns at which a new press was commanded.
    requested_ns: Option<u64>,
}

impl ClutchOperator {
    /// Build an operator that has not begun.
    pub fn new(clutch: Clutch) -> Result<Self, ClutchError> {
        match &clutch {
            Clutch::Auto { reaction_ns } if !(50_000_000..=60_000_000_000).contains(reaction_ns) => {
                return Err(ClutchError::Reaction(*reaction_ns));
            }
            Clutch::Schedule(times) => {
                let mut last = None;
                for (index, (press, release)) in times.iter().enumerate() {
                    if press >= release || last.is_some_and(|last| *press <= last) {
                        return Err(ClutchError::Order(index));
                    }
                    last = Some(*release);
                }
            }
            _ => {}
        }
        Ok(Self {
            clutch,
            start_ns: 0,
            pressed: true,
            since_ns: 0,
            ready_ns: None,
            has_faulted: false,
            requested: false,
            has_begun: false,
            requested_ns: None,
        })
    }

    /// Start the time at `now_ns`.
    pub fn begin(&mut self, now_ns: u64) {
        (self.start_ns, self.since_ns) = (now_ns, now_ns);
    }

    /// Release for a moment and press again.
    pub fn press_again(&mut self) {
        self.requested = true;
    }

    /// Drop a requested press: the loop was late, or the device has a button.
    pub fn reset(&mut self) {
        (self.requested, self.requested_ns) = (false, None);
    }

    /// Release the clutch, by command or because the start was too long ago to be a press. Return true if the start alone
    /// held it. A simulated operator waits for its reaction time again.
    pub fn release_clutch(&mut self) -> bool {
        self.ready_ns = None;
        std::mem::replace(&mut self.pressed, false) && matches!(self.clutch, Clutch::Once)
    }

    /// Return whether the clutch is pressed at `now_ns`, given the state of the ladder and whether a press
    /// would count.
    #[inline]
    pub fn at(&mut self, now_ns: u64, state: LadderState, ready: bool) -> bool {
        let is_asked = self.requested || self.requested_ns.is_some();
        let stays = self.pressed && self.has_begun && state.is_coupled() && !is_asked;
        if stays && !matches!(self.clutch, Clutch::Schedule(_)) {
            // Common tick: keep holding.
            self.ready_ns = if ready { self.ready_ns.or(Some(now_ns)) } else { None };
            return true;
        }
        self.decide(now_ns, state, ready)
    }

    fn decide(&mut self, now_ns: u64, state: LadderState, ready: bool) -> bool {
        let reaction_ns = match &self.clutch {
            Clutch::Schedule(times) => {
                self.requested = false;
                let since_ns = now_ns.saturating_sub(self.start_ns);
                return times.iter().any(|(press, release)| (*press..*release).contains(&since_ns));
            }
            Clutch::Auto { reaction_ns } => Some(*reaction_ns),
            Clutch::Once => None,
        };
        if !std::mem::replace(&mut self.has_begun, true) {
            self.pressed &= now_ns.saturating_sub(self.start_ns) <= PRESS_NS;
        }
        if std::mem::take(&mut self.requested) {
            self.requested_ns = Some(now_ns);
        }
        self.requested_ns =
            self.requested_ns.filter(|requested| now_ns.saturating_sub(*requested) <= LATEST_NS);
        self.has_faulted |= state == LadderState::Fault;
        self.ready_ns = if ready { self.ready_ns.or(Some(now_ns)) } else { None };
        let spent_ns = now_ns.saturating_sub(self.since_ns);
        if self.pressed {
            // DISENGAGED a tick after the press means that the press was not accepted or not answered, or
            // that the peer has ended.
            let in_vain = matches!(state, LadderState::Hold | LadderState::Stop)
                || state == LadderState::Disengaged && spent_ns > 0 && !self.has_faulted;
            if self.requested_ns.is_some() || reaction_ns.is_some() && in_vain {
                (self.pressed, self.since_ns, self.ready_ns) = (false, now_ns, None);
            }
        } else {
            let ready_for_ns = self.ready_ns.map_or(0, |since| now_ns.saturating_sub(since));
            let presses = if self.requested_ns.is_some() {
                spent_ns >= OPEN_NS
            } else {
                !self.has_faulted
                    && reaction_ns.is_some_and(|reaction| ready_for_ns >= reaction && spent_ns >= reaction)
            };
            if presses {
                (self.pressed, self.since_ns, self.requested_ns) = (true, now_ns, None);
                self.has_faulted = false;
            }
        }
        self.pressed
    }
}

/// Longest contact bounce in ns.
const BOUNCE_NS: u64 = 20_000_000;

/// Debounced button of a device. A release counts at once. A press counts after 20 ms of release, and again
/// within 20 ms of a counted press. So a bounce during a long press is not a press.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Button {
    /// Last sample; none before the first sample with a button.
    pub(super) level: Option<bool>,
    pub(super) closed: bool,
    /// True if the button's level was unknown for a while; it must be seen open before a press counts.
    pub(super) unknown: bool,
    /// Times in ns of the last release and of the last counted press.
    pub(super) released_ns: u64,
    pub(super) pressed_ns: Option<u64>,
}

impl Button {
    /// Take a sample at `now_ns`. Returns whether the button is pressed; none for a device that has never
    /// shown a button. A button that is closed at the first sample counts as pressed.
    pub(crate) fn at(&mut self, now_ns: u64, sample: Option<bool>) -> Option<bool> {
        let before = self.level;
        let Some(level) = sample else {
            before?;
            (self.closed, self.unknown) = (false, true);
            return Some(false);
        };
        self.level = Some(level);
        if !level {
            if before != Some(false) || self.unknown {
                self.released_ns = now_ns;
            }
            (self.closed, self.unknown) = (false, false);
        } else if before != Some(true) && !self.unknown {
            let bounces = self.pressed_ns.is_some_and(|pressed| now_ns.saturating_sub(pressed) <= BOUNCE_NS);
            let released = before.is_none() || now_ns.saturating_sub(self.released_ns) >= BOUNCE_NS;
            self.closed = bounces || released;
            if released && !bounces {
                self.pressed_ns = Some(now_ns);
            }
        }
        Some(self.closed)
    }

    /// Time in ns of the last counted press.
    pub(crate) fn last_press_ns(&self) -> Option<u64> {
        self.pressed_ns
    }

    /// Return whether the device has ever shown a button.
    pub(crate) fn is_there(&self) -> bool {
        self.level.is_some()
    }

    /// Count the button as open until a release and a press. Reasons: the start is too long ago to be a
    /// press, or a command releases the clutch.
    pub(crate) fn must_be_released(&mut self) {
        (self.closed, self.unknown) = (false, true);
    }

    /// Record that the loop was late: the time of the next change is unknown.
    pub(crate) fn stalled(&mut self) {
        self.unknown |= !self.closed;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use LadderState::{Aligning, Engaged, Hold};
    use proptest::prelude::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn simulated_operator_presses_again_after_an_end_but_not_after_a_fault() {
        use LadderState::{Disengaged, Fault};
        for faulted in [false, true] {
            let mut operator = ClutchOperator::new(Clutch::Auto { reaction_ns: 500 * MS }).unwrap();
            operator.begin(0);
            assert!(operator.at(0, Disengaged, false));
            for now in 1..1000 {
                assert!(operator.at(now * MS, Engaged, true));
            }
            if faulted {
                assert!(operator.at(1000 * MS, Fault, false));
            }
            // The other side is back after one second.
            let pressed: Vec<u64> =
                (1001..3000).filter(|now| operator.at(now * MS, Disengaged, *now >= 2000)).collect();
            if faulted {
                assert_eq!(pressed.len(), 1999, "an acknowledged fault couples nothing");
            } else {
                assert_eq!(pressed[0], 2500);
            }
        }
    }

    #[test]
    fn a_schedule_is_followed() {
        let mut operator = ClutchOperator::new(Clutch::Schedule(vec![(0, 5), (8, 9)])).unwrap();
        operator.begin(100);
        let pressed: Vec<_> = (100..112).filter(|now| operator.at(*now, Engaged, true)).collect();
        assert_eq!(pressed, [100, 101, 102, 103, 104, 108]);
        for times in [vec![(5, 5)], vec![(0, 5), (5, 6)], vec![(3, 4), (1, 2)]] {
            let error = ClutchOperator::new(Clutch::Schedule(times)).unwrap_err();
            assert!(error.to_string().ends_with("must follow one another in time"), "{error}");
        }
    }

    #[test]
    fn a_simulated_operator_lets_go_and_presses_once_both_are_ready() {
        let mut operator = ClutchOperator::new(Clutch::Auto { reaction_ns: 500 * MS }).unwrap();
        operator.begin(0);
        assert!(operator.at(0, Aligning, false));
        assert!(operator.at(MS, Engaged, true));
        // The link is dead until 1 s, so an earlier press would be void.
        let pressed: Vec<_> = (2..2000).filter(|now| operator.at(now * MS, Hold, *now >= 1000)).collect();
        assert_eq!(pressed.first(), Some(&1500));
        // The press is held in HOLD, so it did not count; the next follows 0.5 s later.
        assert_eq!(pressed, [1500]);
        let pressed: Vec<_> = (2000..2500).filter(|now| operator.at(now * MS, Hold, true)).collect();
        assert_eq!(pressed.first(), Some(&2002));
        assert!(ClutchOperator::new(Clutch::Auto { reaction_ns: 1 }).is_err());
    }

    proptest! {
        /// The fast path of a held clutch decides like the full one.
        #[test]
        fn held_clutch_fast_path_equals_full_decision(
            kind in 0_u8..3,
            ticks in prop::collection::vec((0_u8..14, any::<bool>(), 0_u8..40, 1_u64..300), 1..200),
        ) {
            let mut operator = ClutchOperator::new(match kind {
                0 => Clutch::Auto { reaction_ns: 500 * MS },
                1 => Clutch::Once,
                _ => Clutch::Schedule(vec![(0, 900 * MS), (2000 * MS, 9000 * MS)]),
            }).unwrap();
            operator.begin(0);
            let mut now = 0;
            for (state, ready, act, wait) in ticks {
                now += wait * MS;
                match act {
                    0 => operator.press_again(),
                    1 => operator.reset(),
                    2 => _ = operator.release_clutch(),
                    _ => {}
                }
                let state = LadderState::from_code(state).unwrap_or(Engaged);
                let mut decided = operator.clone();
                let pressed = decided.decide(now, state, ready);
                prop_assert_eq!(operator.at(now, state, ready), pressed);
                prop_assert_eq!(&operator, &decided);
            }
        }
    }

    #[test]
    fn once_presses_again_when_requested() {
        let mut operator = ClutchOperator::new(Clutch::Once).unwrap();
        operator.begin(0);
        assert!((0..1000).all(|now| operator.at(now * MS, Hold, true)));
        operator.press_again();
        let open = (1000..2000).filter(|now| !operator.at(now * MS, Hold, true)).count();
        assert_eq!(open, 100);
    }

    /// Step every ms from 0 without the ms in `asleep`, with requests at `requested`; return the ms of the
    /// presses.
    fn presses(requested: &[u64], asleep: std::ops::Range<u64>, resets: bool) -> Vec<u64> {
        let mut operator = ClutchOperator::new(Clutch::Once).unwrap();
        operator.begin(0);
        let (mut was, mut pressed) = (operator.at(0, Hold, true), Vec::new());
        for now in (1..60_000).filter(|now| !asleep.contains(now)) {
            if requested.contains(&now) {
                operator.press_again();
            }
            if now == asleep.end && resets {
                operator.reset();
            }
            let is = operator.at(now * MS, Hold, true);
            if is && !was {
                pressed.push(now);
            }
            was = is;
        }
        pressed
    }

    #[test]
    fn a_requested_press_is_made_after_the_release_or_dropped() {
        assert_eq!(presses(&[1000], 0..0, false), [1100]);
        // Two requests at once are one press; a later request is another press.
        assert_eq!(presses(&[1000, 1001, 1050], 0..0, false), [1100]);
        assert_eq!(presses(&[1000, 1150], 0..0, false), [1100, 1250]);
        // Asleep between release and press: the press is dropped, and the clutch stays open until the next
        // request.
        assert!(presses(&[1000], 1050..31_000, false).is_empty());
        assert_eq!(presses(&[1000, 40_000], 1050..31_000, false), [40_000]);
        assert_eq!(presses(&[1000], 1050..1150, false), [1150]);
        assert!(presses(&[1000], 1050..1150, true).is_empty());
    }

    #[test]
    fn simulated_operator_retries_after_unanswered_press() {
        let mut operator = ClutchOperator::new(Clutch::Auto { reaction_ns: 500 * MS }).unwrap();
        operator.begin(0);
        assert!(operator.at(0, LadderState::Disengaged, false), "the start is a press");
        assert!((1..5000).all(|now| operator.at(now * MS, Aligning, false)));
        assert!(!operator.at(5000 * MS, LadderState::Disengaged, false));
        let pressed = |now: &u64| operator.at(now * MS, LadderState::Disengaged, *now >= 9000);
        assert_eq!((5001..9501).filter(pressed).collect::<Vec<_>>(), [9500]);
    }

    #[test]
    fn a_start_is_a_press_for_five_seconds() {
        for (first_ms, presses) in [(0, true), (5000, true), (5001, false)] {
            let mut operator = ClutchOperator::new(Clutch::Once).unwrap();
            operator.begin(7 * MS);
            assert_eq!(
                operator.at((7 + first_ms) * MS, LadderState::Disengaged, false),
                presses,
                "{first_ms}"
            );
        }
    }

    #[test]
    fn old_start_is_released_once() {
        for (clutch, was_pressed) in [
            (Clutch::Once, true),
            (Clutch::Auto { reaction_ns: 500 * MS }, false),
            (Clutch::Schedule(vec![(0, 10)]), false),
        ] {
            let mut operator = ClutchOperator::new(clutch).unwrap();
            operator.begin(0);
            assert_eq!((operator.release_clutch(), operator.release_clutch()), (was_pressed, false));
        }
    }

    #[test]
    fn a_simulated_operator_does_not_press_after_a_fault_until_requested() {
        let mut operator = ClutchOperator::new(Clutch::Auto { reaction_ns: 500 * MS }).unwrap();
        operator.begin(0);
        assert!(operator.at(0, Aligning, false));
        assert!(!operator.at(MS, Hold, true), "the clutch is released");
        assert!(!operator.at(2 * MS, LadderState::Fault, true));
        assert!((3..3000).all(|now| !operator.at(now * MS, LadderState::Disengaged, true)));
        operator.press_again();
        assert!(operator.at(3000 * MS, LadderState::Disengaged, true));
        assert!(operator.at(3001 * MS, Engaged, true));
    }

    #[test]
    fn released_operator_presses_only_when_requested() {
        let mut operator = ClutchOperator::new(Clutch::Once).unwrap();
        operator.begin(0);
        operator.release_clutch();
        assert!((0..1000).all(|now| !operator.at(now * MS, LadderState::Disengaged, true)));
        operator.press_again();
        assert!(operator.at(1000 * MS, LadderState::Disengaged, true));
    }
}

#[cfg(test)]
mod button_tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Spans in ms in which the button counts as pressed, for levels that each begin at a time in ms.
    fn pressed(samples: &[(u64, Option<bool>)], stall_ms: Option<u64>, end_ms: u64) -> Vec<(u64, u64)> {
        let (mut button, mut spans) = (Button::default(), Vec::<(u64, u64)>::new());
        for now in 0..end_ms {
            let sample = samples.iter().rev().find(|(from, _)| *from <= now).and_then(|(_, level)| *level);
            if stall_ms == Some(now) {
                button.stalled();
            }
            if button.at(now * MS, sample) == Some(true) {
                match spans.last_mut() {
                    Some((_, until)) if *until == now => *until = now + 1,
                    _ => spans.push((now, now + 1)),
                }
            }
        }
        spans
    }

    #[test]
    fn button_exists_once_seen() {
        let mut button = Button::default();
        assert!(!button.is_there());
        assert_eq!(button.at(0, None), None);
        assert!(!button.is_there());
        button.at(MS, Some(false));
        assert!(button.is_there());
        button.at(2 * MS, None);
        assert!(button.is_there());
    }

    #[test]
    fn late_first_press_does_not_count() {
        let mut button = Button::default();
        button.must_be_released();
        assert!((0..50).all(|now| button.at(now * MS, Some(true)) == Some(false)));
        assert!((50..80).all(|now| button.at(now * MS, Some(false)) == Some(false)));
        assert_eq!(button.at(80 * MS, Some(true)), Some(true));
    }

    #[test]
    fn button_released_by_command_stays_open_while_held() {
        let mut button = Button::default();
        assert!((0..50).all(|now| button.at(now * MS, Some(now >= 30)) == Some(now >= 30)));
        button.must_be_released();
        assert!((50..80).all(|now| button.at(now * MS, Some(true)) == Some(false)));
        assert!((80..110).all(|now| button.at(now * MS, Some(false)) == Some(false)));
        assert_eq!(button.at(110 * MS, Some(true)), Some(true));
    }

    #[test]
    fn contact_bounce_is_not_a_press() {
        let (open, closed) = (Some(false), Some(true));
        for (name, samples, stall_ms, expected) in [
            ("no button", vec![(0, None)], None, vec![]),
            ("held at the start", vec![(0, closed)], None, vec![(0, 300)]),
            ("pressed", vec![(0, open), (50, closed), (100, open)], None, vec![(50, 100)]),
            (
                "bounces when it is pressed",
                vec![(0, open), (50, closed), (51, open), (55, closed), (56, open), (60, closed)],
                None,
                vec![(50, 51), (55, 56), (60, 300)],
            ),
            (
                "bounces when it is released",
                vec![
                    (0, open),
                    (50, closed),
                    (100, open),
                    (101, closed),
                    (103, open),
                    (104, closed),
                    (105, open),
                ],
                None,
                vec![(50, 100)],
            ),
            (
                "opens for 3 ms while it is held: released until it is released in earnest",
                vec![(0, open), (50, closed), (100, open), (103, closed), (200, open), (220, closed)],
                None,
                vec![(50, 100), (220, 300)],
            ),
            (
                "released for 19 ms, then for 20",
                vec![(0, open), (50, closed), (100, open), (119, closed), (150, open), (170, closed)],
                None,
                vec![(50, 100), (170, 300)],
            ),
            (
                "vanishes while it is held: released until it is seen open",
                vec![(0, open), (50, closed), (100, None), (150, closed), (200, open), (230, closed)],
                None,
                vec![(50, 100), (230, 300)],
            ),
            ("vanishes while it is open", vec![(0, open), (50, None), (90, closed)], None, vec![]),
            ("pressed while the loop slept", vec![(0, open), (50, closed)], Some(50), vec![]),
            (
                "pressed while the loop slept, and again",
                vec![(0, open), (50, closed), (100, open), (120, closed)],
                Some(50),
                vec![(120, 300)],
            ),
            ("held when a loop that slept at its start wakes", vec![(0, closed)], Some(0), vec![]),
            ("held while the loop slept", vec![(0, open), (50, closed)], Some(100), vec![(50, 300)]),
        ] {
            assert_eq!(pressed(&samples, stall_ms, 300), expected, "{name}");
        }
    }
}
