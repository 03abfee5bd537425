//! Buttons of a device: drawn values and invariants.

use haptether_bridge::{ButtonSettings, ButtonWord, LadderState, TickTime};

use super::{
    drawn::{MS, Numbers},
    spied::Watch,
};

/// Longest bounce of a contact in ns.
const BOUNCE_NS: u64 = 20 * MS;

/// Functions of a device's buttons, and their levels over time.
#[derive(Clone, Debug)]
pub(crate) struct DrawnButtons {
    pub(crate) settings: ButtonSettings,
    /// Levels, each with the time in ns until which they hold.
    pub(crate) course: Vec<(u64, ButtonWord)>,
}

impl DrawnButtons {
    pub(crate) fn draw(n: &mut Numbers, end_ns: u64) -> Self {
        let bit = n.one_of(&[0, 1, 7, 30]);
        let (clutch, engage) = n.one_of(&[(Some(bit), None), (None, Some(bit)), (None, None)]);
        let gripper = (clutch.or(engage).is_none() || n.chance(0.5)).then_some(bit + 1);
        let (mut at_ns, mut course, mut word) = (0, Vec::new(), 0_u32);
        if n.chance(0.2) {
            word = 1 << bit;
        }
        while at_ns < end_ns {
            at_ns += match n.integer(0, 5) {
                // A contact that bounces.
                0 => n.integer(MS / 2, 6 * MS),
                1 | 2 => n.integer(15 * MS, 40 * MS),
                _ => n.integer(30 * MS, 250 * MS),
            };
            let said = if n.chance(0.12) { ButtonWord::UNKNOWN } else { ButtonWord(Some(word)) };
            course.push((at_ns, said));
            if n.chance(0.8) {
                word ^= 1 << bit;
            }
            if n.chance(0.4) {
                word ^= 1 << (bit + 1);
            }
            // Buttons without a function.
            if n.chance(0.2) {
                word ^= 1 << 3;
            }
        }
        Self { settings: ButtonSettings { clutch, engage, gripper }, course }
    }

    pub(crate) fn at(&self, now_ns: u64) -> ButtonWord {
        let now = self.course.iter().find(|(until_ns, _)| now_ns < *until_ns);
        now.or(self.course.last()).map_or(ButtonWord::UNKNOWN, |(_, word)| *word)
    }
}

/// Coverage of buttons.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SeenButtons {
    pub(crate) presses: u64,
    /// Ends of gaps with unknown levels, with the clutch button closed.
    pub(crate) gaps: u64,
    /// Presses and closings without effect: bounces, and buttons closed at the start.
    pub(crate) void: u64,
    pub(crate) engagements: u64,
    /// Switches of the gripper.
    pub(crate) switched: u64,
}

impl SeenButtons {
    pub(crate) fn and(&self, other: &Self) -> Self {
        Self {
            presses: self.presses + other.presses,
            gaps: self.gaps + other.gaps,
            void: self.void + other.void,
            engagements: self.engagements + other.engagements,
            switched: self.switched + other.switched,
        }
    }

    /// Return the counts that must be positive in a run of ten thousand scenes.
    pub(crate) fn all(&self) -> [u64; 5] {
        [self.presses, self.gaps, self.void, self.engagements, self.switched]
    }
}

/// One contact, judged by its levels only.
#[derive(Clone, Copy, Debug, Default)]
struct Contact {
    /// Time in ns since which it was open at every tick.
    open_ns: Option<u64>,
    /// Level at the last tick: closed, open or unknown.
    level: Option<bool>,
}

impl Contact {
    /// Return true if it is pressed at this tick: closed after it was open for longer than contacts bounce.
    fn is_pressed(&mut self, now_ns: u64, level: Option<bool>) -> bool {
        self.level = level;
        if level == Some(false) {
            self.open_ns.get_or_insert(now_ns);
            return false;
        }
        let open_ns = self.open_ns.take();
        level == Some(true) && open_ns.is_some_and(|open_ns| now_ns - open_ns >= BOUNCE_NS)
    }

    /// Mark the state as unknown.
    fn forget(&mut self) {
        (self.open_ns, self.level) = (None, None);
    }
}

/// Invariants of a device's buttons.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ButtonWatch {
    settings: ButtonSettings,
    clutch: Contact,
    gripper: Contact,
    /// True if the clutch may be closed.
    armed: bool,
    pressed_ns: Option<u64>,
    is_closed: bool,
    was_aligned: bool,
}

impl ButtonWatch {
    pub(crate) fn new(settings: ButtonSettings) -> Self {
        let contact = Contact::default();
        Self {
            settings,
            clutch: contact,
            gripper: contact,
            armed: false,
            pressed_ns: None,
            is_closed: false,
            was_aligned: false,
        }
    }

    /// The operator releases the clutch.
    pub(crate) fn release(&mut self) {
        self.clutch.forget();
        self.armed = false;
    }

    /// The loop stalled.
    pub(crate) fn stall(&mut self) {
        self.gripper.forget();
        // A held clutch button continues; a toggle opens.
        if !self.armed || self.settings.engage.is_some() {
            self.release();
        }
    }

    /// Check a tick at which the device reported `word`; `stood` is the state of the ladder before it.
    pub(crate) fn tick(
        &mut self,
        watch: &mut Watch,
        time: TickTime,
        word: ButtonWord,
        stood: LadderState,
        clutch: bool,
        trigger: Option<f64>,
    ) {
        let now_ns = time.now_ns;
        let level = |bit: Option<u8>| bit.and_then(|bit| word.0.map(|word| word >> bit & 1 == 1));
        let ButtonSettings { clutch: held, engage, gripper } = self.settings;
        if held.or(engage).is_some() {
            let (before, now) = (self.clutch.level, level(held.or(engage)));
            let pressed = self.clutch.is_pressed(now_ns, now);
            let was_aligned = std::mem::replace(&mut self.was_aligned, stood.is_aligned());
            if engage.is_some() {
                let parted = was_aligned && !stood.is_aligned();
                // A toggle: the next press opens it.
                self.armed = now.is_some() && ((self.armed && !parted) ^ pressed);
            } else {
                let bounces = before == Some(false)
                    && self.pressed_ns.is_some_and(|pressed_ns| now_ns - pressed_ns <= BOUNCE_NS);
                self.armed = now == Some(true) && (self.armed || pressed || bounces);
            }
            if pressed {
                self.pressed_ns = Some(now_ns);
            }
            let armed = self.armed;
            watch.hold(armed || !clutch, time, || format!("the clutch is closed by no press: {word:?}"));
            let is_new = now == Some(true) && before != Some(true);
            let seen = &mut watch.seen.buttons;
            seen.presses += u64::from(pressed);
            seen.gaps += u64::from(is_new && before.is_none());
            seen.void += u64::from(is_new && !pressed && !clutch);
            seen.engagements += u64::from(watch.state.is_coupled() && !stood.is_coupled());
        }
        if gripper.is_some() {
            let pressed = self.gripper.is_pressed(now_ns, level(gripper));
            self.is_closed ^= pressed;
            let expected = f64::from(u8::from(self.is_closed));
            let fits = trigger.is_none_or(|trigger| trigger == expected);
            watch.hold(fits, time, || format!("trigger {trigger:?}, its button says {expected}: {word:?}"));
            watch.seen.buttons.switched += u64::from(pressed);
        }
    }
}
