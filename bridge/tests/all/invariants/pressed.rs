//! Buttons of a device: drawn, and what they must never do.

use haptether_bridge::{ButtonSettings, ButtonWord, LadderState, TickTime};

use super::{
    drawn::{MS, Numbers},
    spied::Watch,
};

/// Longest bounce of a contact, in ns.
const BOUNCE_NS: u64 = 20 * MS;

/// What the buttons of a device do, and what for.
#[derive(Clone, Debug)]
pub(crate) struct DrawnButtons {
    pub(crate) settings: ButtonSettings,
    /// Until when in ns they say what.
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
            at_ns += match n.whole(0, 5) {
                // A contact that bounces.
                0 => n.whole(MS / 2, 6 * MS),
                1 | 2 => n.whole(15 * MS, 40 * MS),
                _ => n.whole(30 * MS, 250 * MS),
            };
            let said = if n.chance(0.12) { ButtonWord::UNKNOWN } else { ButtonWord(Some(word)) };
            course.push((at_ns, said));
            if n.chance(0.8) {
                word ^= 1 << bit;
            }
            if n.chance(0.4) {
                word ^= 1 << (bit + 1);
            }
            // Those that do nothing.
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

/// What was seen of buttons.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SeenButtons {
    pub(crate) presses: u64,
    /// Ends of gaps in which nobody knew them, with the clutch's closed.
    pub(crate) gaps: u64,
    /// Presses and closings that counted for nothing: bounces, and what was closed at the start.
    pub(crate) void: u64,
    pub(crate) engagements: u64,
    /// Of the gripper.
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

    /// What a run of ten thousand scenes must have met.
    pub(crate) fn all(&self) -> [u64; 5] {
        [self.presses, self.gaps, self.void, self.engagements, self.switched]
    }
}

/// One contact, as whoever looks at its levels alone must see it.
#[derive(Clone, Copy, Debug, Default)]
struct Contact {
    /// Since when it has been seen open at every tick.
    open_ns: Option<u64>,
    /// Closed at the last tick, or not known.
    level: Option<bool>,
}

impl Contact {
    /// Whether it is pressed at this tick: closed after it was open for longer than contacts bounce.
    fn is_pressed(&mut self, now_ns: u64, level: Option<bool>) -> bool {
        self.level = level;
        if level == Some(false) {
            self.open_ns.get_or_insert(now_ns);
            return false;
        }
        let open_ns = self.open_ns.take();
        level == Some(true) && open_ns.is_some_and(|open_ns| now_ns - open_ns >= BOUNCE_NS)
    }

    /// Nobody knows what it did meanwhile.
    fn forget(&mut self) {
        (self.open_ns, self.level) = (None, None);
    }
}

/// What the buttons of a device are held to.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ButtonWatch {
    settings: ButtonSettings,
    clutch: Contact,
    gripper: Contact,
    /// Whether the clutch may be closed.
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

    /// The operator lets go of the clutch.
    pub(crate) fn release(&mut self) {
        self.clutch.forget();
        self.armed = false;
    }

    /// The loop slept.
    pub(crate) fn stall(&mut self) {
        self.gripper.forget();
        // One that is held goes on; a switch opens.
        if !self.armed || self.settings.engage.is_some() {
            self.release();
        }
    }

    /// After a tick at which the device said `word`, with the ladder at `stood` before: what is made of it.
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
                // A switch: the next press opens it.
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
