//! The degradation ladder: what a silent peer leads to.
//!
//! ```text
//!            frames                 silent > hold_after            silent > stop_after
//! WAITING ------------> ENGAGED ----------------------> HOLD ------------------------> STOP
//!    ^                     ^                              |                              |
//!    |                     +------------------------------+                              |
//!    |                              frames: fades in                                     |
//!    +-----------------------------------------------------------------------------------+
//!                        slave only: a master that was started anew
//! any state -- bad number at the door --> FAULT (stays)
//! ```

/// Where an endpoint stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LadderState {
    /// No peer yet.
    Waiting,
    /// Coupled.
    Engaged,
    /// The peer is silent: the slave holds, the master's force fades to zero.
    Hold,
    /// The peer was silent for too long; only a new session engages again.
    Stop,
    /// A bad number; only a restart engages again.
    Fault,
}

impl LadderState {
    /// The state's byte on the wire and in records.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// The state's name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Engaged => "engaged",
            Self::Hold => "hold",
            Self::Stop => "stop",
            Self::Fault => "fault",
        }
    }

    /// The state with that byte.
    pub fn from_code(code: u8) -> Option<Self> {
        [Self::Waiting, Self::Engaged, Self::Hold, Self::Stop, Self::Fault]
            .into_iter()
            .find(|state| state.code() == code)
    }
}

/// Times of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LadderSettings {
    /// Silence in ns that leads to HOLD.
    pub hold_after_ns: u64,
    /// Silence in ns that leads to STOP.
    pub stop_after_ns: u64,
    /// Time in ns in which the force fades from full to zero.
    pub fade_out_ns: u64,
    /// Time in ns in which the force rises from zero to full.
    pub fade_in_ns: u64,
}

impl Default for LadderSettings {
    /// 20 ms is the command-loss time of libfranka and UR, 200 ms their ceiling; a force that falls within 80 ms
    /// is gone 100 ms after the last frame; 200 ms is the least fade-in.
    fn default() -> Self {
        Self {
            hold_after_ns: 20_000_000,
            stop_after_ns: 200_000_000,
            fade_out_ns: 80_000_000,
            fade_in_ns: 200_000_000,
        }
    }
}

/// The ladder of one endpoint: a pure function of what it is told and when.
#[derive(Clone, Debug, PartialEq)]
pub struct Ladder {
    settings: LadderSettings,
    state: LadderState,
    gain: f64,
    last_ns: Option<u64>,
    /// When the peer was last heard and ready.
    last_ready_ns: Option<u64>,
    hears: bool,
    /// Until when this side itself was blind.
    blind_until_ns: Option<u64>,
    holds: u64,
}

impl Ladder {
    /// A ladder that waits.
    pub fn new(settings: LadderSettings) -> Self {
        Self {
            settings,
            state: LadderState::Waiting,
            gain: 0.0,
            last_ns: None,
            last_ready_ns: None,
            hears: false,
            blind_until_ns: None,
            holds: 0,
        }
    }

    /// One tick at `now_ns`: `age_ns` is the silence of the peer (none before its first frame), `ready` whether
    /// the peer says that it hears this side and has not stopped. Each side's view holds both: were only one
    /// direction of the network dead, the side that still hears would otherwise go on.
    pub fn step(&mut self, now_ns: u64, age_ns: Option<u64>, ready: bool) -> LadderState {
        self.hears = age_ns.is_some_and(|age| {
            let arrived = now_ns.saturating_sub(age);
            age <= self.settings.hold_after_ns && self.blind_until_ns.is_none_or(|until| arrived > until)
        });
        let coupled = self.hears && ready;
        let silent_since =
            if ready { age_ns.map(|age| now_ns.saturating_sub(age)) } else { self.last_ready_ns };
        if coupled {
            self.last_ready_ns = Some(now_ns);
        }
        let silence = now_ns.saturating_sub(silent_since.unwrap_or(now_ns));
        let next = match self.state {
            LadderState::Waiting | LadderState::Hold if coupled => LadderState::Engaged,
            LadderState::Engaged if !coupled => LadderState::Hold,
            LadderState::Hold if silence > self.settings.stop_after_ns => LadderState::Stop,
            state => state,
        };
        if next == LadderState::Hold && self.state != LadderState::Hold {
            self.holds += 1;
        }
        self.state = next;
        let elapsed = now_ns.saturating_sub(self.last_ns.unwrap_or(now_ns)) as f64;
        self.last_ns = Some(now_ns);
        // A loop that was late must not make up for the time in which it did not fade in.
        let rising = elapsed.min(self.settings.hold_after_ns as f64 / 10.0);
        self.gain = match self.state {
            LadderState::Engaged => (self.gain + rising / self.settings.fade_in_ns as f64).min(1.0),
            LadderState::Fault => 0.0,
            _ => (self.gain - elapsed / self.settings.fade_out_ns as f64).max(0.0),
        };
        self.state
    }

    /// The peer began a new session: a stopped endpoint may engage again, from zero force.
    pub fn new_session(&mut self) {
        if self.state != LadderState::Fault {
            (self.state, self.gain, self.last_ready_ns) = (LadderState::Waiting, 0.0, None);
        }
    }

    /// A bad number was met.
    pub fn fault(&mut self) {
        (self.state, self.gain) = (LadderState::Fault, 0.0);
    }

    /// This side itself was late by more than the ladder allows, until `now_ns`: what it knows is old. It holds
    /// without force until a frame arrives after that time, and then fades in.
    pub fn stalled(&mut self, now_ns: u64) {
        (self.gain, self.blind_until_ns) = (0.0, Some(now_ns));
        if self.state == LadderState::Engaged {
            self.state = LadderState::Hold;
            self.holds += 1;
        }
    }

    /// Whether the peer was heard recently enough, as of the last tick.
    pub fn hears_peer(&self) -> bool {
        self.hears
    }

    /// Where it stands.
    pub fn state(&self) -> LadderState {
        self.state
    }

    /// Share of the force that may be rendered, 0 to 1.
    pub fn gain(&self) -> f64 {
        self.gain
    }

    /// How often it went to HOLD.
    pub fn holds(&self) -> u64 {
        self.holds
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use LadderState::{Engaged, Fault, Hold, Stop, Waiting};

    const MS: u64 = 1_000_000;

    #[test]
    fn table() {
        // (state, silence in ms, peer ready) -> state
        for (from, age, ready, to) in [
            (Waiting, None, true, Waiting),
            (Waiting, Some(0), true, Engaged),
            (Waiting, Some(0), false, Waiting),
            (Engaged, Some(20), true, Engaged),
            (Engaged, Some(21), true, Hold),
            (Engaged, Some(0), false, Hold),
            (Hold, Some(0), true, Engaged),
            (Hold, Some(0), false, Hold),
            (Hold, Some(200), true, Hold),
            (Hold, Some(201), true, Stop),
            (Stop, Some(0), true, Stop),
            (Fault, Some(0), true, Fault),
        ] {
            let mut ladder = Ladder::new(LadderSettings::default());
            ladder.state = from;
            ladder.last_ready_ns = Some(1000 * MS);
            assert_eq!(
                ladder.step(1000 * MS, age.map(|age| age * MS), ready),
                to,
                "{from:?} {age:?} {ready}"
            );
        }
    }

    #[test]
    fn a_silent_peer_takes_the_force_within_100_ms_and_it_stays_away() {
        let mut ladder = Ladder::new(LadderSettings::default());
        for now in 0..=300 {
            ladder.step(now * MS, Some(0), true);
        }
        assert!((ladder.gain() - 1.0).abs() < 1e-12);
        let mut last = 1.0;
        for silence in 1..=400 {
            ladder.step((300 + silence) * MS, Some(silence * MS), true);
            assert!(ladder.gain() <= last);
            last = ladder.gain();
            if silence >= 101 {
                assert_eq!(ladder.gain(), 0.0, "{silence}");
            }
        }
        assert_eq!((ladder.state(), ladder.holds()), (Stop, 1));
        ladder.step(701 * MS, Some(0), true);
        assert_eq!(ladder.state(), Stop, "frames alone do not engage again");
        ladder.new_session();
        ladder.step(702 * MS, Some(0), true);
        assert_eq!(ladder.state(), Engaged);
        assert!(ladder.gain() <= 1.0 / 200.0 + 1e-12);
    }

    #[test]
    fn a_peer_that_does_not_hear_us_stops_us_in_the_end() {
        let mut ladder = Ladder::new(LadderSettings::default());
        ladder.step(0, Some(0), true);
        for (now, state) in [(1, Hold), (199, Hold), (201, Stop)] {
            assert_eq!(ladder.step(now * MS, Some(0), false), state, "{now}");
        }
    }

    #[test]
    fn a_stall_holds_without_force_until_something_new_arrives() {
        let mut ladder = Ladder::new(LadderSettings::default());
        for now in 0..=300 {
            ladder.step(now * MS, Some(0), true);
        }
        // The loop wakes 60 ms late; what it then finds had arrived meanwhile.
        ladder.stalled(360 * MS);
        assert_eq!((ladder.step(360 * MS, Some(0), true), ladder.gain()), (Hold, 0.0));
        assert_eq!((ladder.step(361 * MS, Some(MS), true), ladder.gain()), (Hold, 0.0));
        assert_eq!(ladder.step(362 * MS, Some(0), true), Engaged);
        assert!(ladder.gain() <= 1.0 / 200.0 + 1e-12, "it fades in from zero: {}", ladder.gain());
    }

    #[test]
    fn codes_are_reversible() {
        for code in 0..5 {
            assert_eq!(LadderState::from_code(code).map(LadderState::code), Some(code));
        }
        assert_eq!(LadderState::from_code(5), None);
    }
}
