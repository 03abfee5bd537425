//! The button of a device: which of its levels are a press.

/// Longest bounce of a contact, in ns.
const BOUNCE_NS: u64 = 20_000_000;

/// The button of a device as the ladder sees it. A release counts at once. A press counts after 20 ms of release, and
/// again within 20 ms of a press that counted: a contact that bounces while it is held must not press.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Button {
    /// As read last; none before the first sample with a button.
    pub(super) level: Option<bool>,
    pub(super) closed: bool,
    /// It must be seen open before it can be pressed: what it did meanwhile is not known.
    pub(super) unknown: bool,
    /// When it was released, and when it was last pressed so that it counted, in ns.
    pub(super) released_ns: u64,
    pub(super) pressed_ns: Option<u64>,
}

impl Button {
    /// Takes a sample at `now_ns`; whether it is pressed, or none of a device that has never shown a button. One that is
    /// closed at the first sample is pressed by the start.
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

    /// Whether the device has ever shown it.
    pub(crate) fn is_there(&self) -> bool {
        self.level.is_some()
    }

    /// Closed, it must be seen open before it can be pressed: the start was too long ago to be a press.
    pub(crate) fn must_be_released(&mut self) {
        self.unknown = true;
    }

    /// The loop was late: nobody knows when what it shows next was done.
    pub(crate) fn stalled(&mut self) {
        self.unknown |= !self.closed;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Levels from when on, in ms, and at which ticks the button counts as pressed.
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
    fn a_button_is_there_once_it_was_seen() {
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
    fn a_button_that_is_held_long_after_the_start_is_no_press() {
        let mut button = Button::default();
        button.must_be_released();
        assert!((0..50).all(|now| button.at(now * MS, Some(true)) == Some(false)));
        assert!((50..80).all(|now| button.at(now * MS, Some(false)) == Some(false)));
        assert_eq!(button.at(80 * MS, Some(true)), Some(true));
    }

    #[test]
    fn what_a_contact_does_while_it_is_held_is_no_press() {
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
