//! Buttons of a device: clutch, engage and gripper, as a scene maps them.

use schemars::JsonSchema;
use serde::Deserialize;

use crate::ladder::{Button, LadderState, PRESS_NS};

/// Button per function, by bit from 0 to 31, if mapped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ButtonSettings {
    /// Clutch: closed while the button is held.
    pub clutch: Option<u8>,
    /// Clutch as a switch: a press closes it, the next one opens it.
    pub engage: Option<u8>,
    /// Gripper: a press closes it, the next one opens it.
    pub gripper: Option<u8>,
}

/// Invalid mapping.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ButtonError {
    /// Invalid bit.
    #[error("master.buttons.{name} = {seen}: must be 0 to 31")]
    Bit {
        /// Function.
        name: &'static str,
        /// Bit.
        seen: u8,
    },
    /// Two functions on one button, or the clutch on two.
    #[error("master.buttons: must be a button of its own for each, and one of clutch and engage")]
    Shared,
}

impl ButtonSettings {
    /// Check the mapping.
    pub fn check(&self) -> Result<(), ButtonError> {
        let Self { clutch, engage, gripper } = *self;
        for (name, bit) in [("clutch", clutch), ("engage", engage), ("gripper", gripper)] {
            if let Some(seen) = bit.filter(|bit| *bit > 31) {
                return Err(ButtonError::Bit { name, seen });
            }
        }
        let shared = gripper.is_some() && (gripper == clutch || gripper == engage);
        if shared || clutch.is_some() && engage.is_some() { Err(ButtonError::Shared) } else { Ok(()) }
    }
}

/// Buttons as read: bit n is set while button n is pressed. `None` if unknown, which is no release.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ButtonWord(pub Option<u32>);

impl ButtonWord {
    /// Unknown state.
    pub const UNKNOWN: Self = Self(None);
}

/// Evaluates the buttons tick by tick.
///
/// A bouncing contact presses once. A button closed at the first sample, or after a gap, must open before it can be
/// pressed. The clutch switch opens when the sides part or its press was not accepted, so that only a press closes it
/// again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Buttons {
    settings: ButtonSettings,
    engage: Switch,
    gripper: Switch,
    /// True if the last clutch press was accepted at the last tick.
    was_aligned: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Switch {
    button: Button,
    is_known: bool,
    on: bool,
}

impl Switch {
    fn at(&mut self, now_ns: u64, level: bool) -> bool {
        let before = self.button.last_press_ns();
        let _ = self.button.at(now_ns, Some(level));
        // Nobody pressed a button that is closed at the first sample.
        let counts = std::mem::replace(&mut self.is_known, true) && self.button.last_press_ns() != before;
        self.on ^= counts;
        self.on
    }
}

impl Buttons {
    pub(crate) fn new(settings: ButtonSettings) -> Result<Self, ButtonError> {
        settings.check()?;
        let (engage, gripper) = (Switch::default(), Switch::default());
        Ok(Self { settings, engage, gripper, was_aligned: false })
    }

    /// Return whether a button works the clutch.
    pub(crate) fn has_clutch(&self) -> bool {
        self.settings.clutch.is_some() || self.settings.engage.is_some()
    }

    /// Take the word of a tick.
    ///
    /// Returns the clutch, true if closed, and the trigger, 0 open or 1 closed; `None` if not mapped, or the clutch
    /// unknown.
    pub(crate) fn at(&mut self, now_ns: u64, word: ButtonWord) -> (Option<bool>, Option<f64>) {
        let Some(word) = word.0 else {
            self.stalled();
            return (None, self.settings.gripper.map(|_| f64::from(u8::from(self.gripper.on))));
        };
        let level = |bit: u8| word >> bit & 1 == 1;
        let ButtonSettings { clutch, engage, gripper } = self.settings;
        let engaged = engage.map(|bit| self.engage.at(now_ns, level(bit)));
        let closed = gripper.map(|bit| f64::from(u8::from(self.gripper.at(now_ns, level(bit)))));
        (clutch.map(level).or(engaged), closed)
    }

    /// Open the clutch switch.
    pub(crate) fn open(&mut self) {
        self.engage.on = false;
    }

    /// Open the clutch switch after a gap. Each button must open before it can be pressed.
    pub(crate) fn stalled(&mut self) {
        self.open();
        for switch in [&mut self.engage, &mut self.gripper] {
            switch.button.must_be_released();
        }
    }

    /// Open the clutch switch if the ladder no longer accepts its press.
    pub(crate) fn follow(&mut self, now_ns: u64, state: LadderState) {
        let was_aligned = std::mem::replace(&mut self.was_aligned, state.is_aligned());
        let pressed_ns = self.engage.button.last_press_ns().unwrap_or(0);
        let is_old = now_ns.saturating_sub(pressed_ns) > PRESS_NS;
        if !state.is_aligned() && (was_aligned || is_old) {
            self.open();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn known(word: u32) -> ButtonWord {
        ButtonWord(Some(word))
    }

    #[test]
    fn unknown_word_is_no_release_and_no_press() {
        let mut engage = buttons(None, Some(0), Some(1));
        let mut now = 0;
        let mut at = |engage: &mut Buttons, word: ButtonWord, ticks: u64| {
            let mut last = (None, None);
            for _ in 0..ticks {
                last = engage.at(now * MS, word);
                now += 1;
            }
            last
        };
        at(&mut engage, known(0), 30);
        assert_eq!(at(&mut engage, known(3), 30), (Some(true), Some(1.0)));
        assert_eq!(at(&mut engage, ButtonWord::UNKNOWN, 30), (None, Some(1.0)), "unknown keeps the grip");
        // Unknown: still held, or pressed meanwhile.
        assert_eq!(at(&mut engage, known(3), 30), (Some(false), Some(1.0)));
        at(&mut engage, known(0), 30);
        assert_eq!(at(&mut engage, known(3), 30), (Some(true), Some(0.0)));
    }

    #[test]
    fn press_during_unknown_words_switches_nothing() {
        for gap in [1, 5, 30, 300] {
            let mut switched = buttons(None, Some(0), Some(1));
            let words =
                [(known(0), 30), (ButtonWord::UNKNOWN, gap), (known(3), 60), (known(0), 30), (known(3), 1)];
            let ticks = words.iter().flat_map(|&(word, ticks)| std::iter::repeat_n(word, ticks));
            let said: Vec<_> = ticks.zip(0..).map(|(word, n)| switched.at(n * MS, word)).collect();
            let (last, before) = said.split_last().unwrap();
            assert!(before.iter().all(|said| said.0 != Some(true) && said.1 == Some(0.0)), "{gap}");
            assert_eq!(*last, (Some(true), Some(1.0)), "{gap}: seen open, it is pressed again");
        }
    }

    #[test]
    fn unaccepted_press_expires() {
        let mut engage = buttons(None, Some(0), None);
        for now in 0..6000 {
            engage.follow(now * MS, LadderState::Disengaged);
            let on = engage.at(now * MS, known(u32::from((30..60).contains(&now)))).0;
            assert_eq!(on, Some((30..5031).contains(&now)), "{now}");
        }
    }

    fn buttons(clutch: Option<u8>, engage: Option<u8>, gripper: Option<u8>) -> Buttons {
        Buttons::new(ButtonSettings { clutch, engage, gripper }).unwrap()
    }

    #[test]
    fn a_press_switches_and_the_clutch_is_held() {
        let mut held = buttons(Some(3), None, None);
        for (n, word) in [(0, 0), (1, 8), (2, 8), (3, 0xFFFF_FFF7), (4, u32::MAX)] {
            assert_eq!(held.at(n * MS, known(word)), (Some(word & 8 != 0), None));
        }
        let mut switched = buttons(None, Some(0), Some(31));
        let mut now = 0;
        let mut press = |switched: &mut Buttons, word: u32| {
            let mut last = (None, None);
            for (level, ticks) in [(0, 30), (word, 50), (0, 30)] {
                for _ in 0..ticks {
                    last = switched.at(now * MS, known(level));
                    now += 1;
                }
            }
            last
        };
        assert_eq!(press(&mut switched, 0), (Some(false), Some(0.0)));
        assert_eq!(press(&mut switched, 1), (Some(true), Some(0.0)));
        assert_eq!(press(&mut switched, 1 << 31), (Some(true), Some(1.0)));
        assert_eq!(press(&mut switched, 1), (Some(false), Some(1.0)));
        assert_eq!(press(&mut switched, 0x8000_0001), (Some(true), Some(0.0)));
        for (state, on) in [
            (LadderState::Disengaged, true),
            (LadderState::Aligning, true),
            (LadderState::Engaged, true),
            (LadderState::Stale, true),
            (LadderState::Disengaged, false),
        ] {
            switched.follow(400 * MS, state);
            assert_eq!(press(&mut switched, 0), (Some(on), Some(0.0)), "{state:?}");
        }
    }

    #[test]
    fn closed_at_start_and_bounce_are_no_press() {
        let mut engage = buttons(None, Some(0), None);
        for n in 0..100 {
            assert_eq!(engage.at(n * MS, known(1)).0, Some(false), "{n}");
        }
        for n in 100..200 {
            assert_eq!(engage.at(n * MS, known(0)).0, Some(false));
        }
        // A contact that bounces for 6 ms: one press.
        for (n, level) in [1, 0, 1, 0, 1, 0].into_iter().chain([1; 60]).enumerate() {
            let on = engage.at((200 + n as u64) * MS, known(level)).0;
            assert!(n < 6 || on == Some(true), "{n}: {on:?}");
        }
    }

    #[test]
    fn invalid_mapping_is_refused() {
        for (clutch, engage, gripper) in [
            (Some(32), None, None),
            (None, Some(32), None),
            (Some(0), Some(1), None),
            (Some(1), None, Some(1)),
            (None, Some(2), Some(2)),
        ] {
            assert!(ButtonSettings { clutch, engage, gripper }.check().is_err());
        }
    }
}
