//! The ladder of one endpoint: what is the case at a tick, and where that leads.

use super::{
    history::{History, Transition},
    settings::{LadderError, LadderSettings},
    state::LadderState,
    table::{Facts, Reason, next},
};

/// What the newest frame of the peer says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerReport {
    /// Where the peer stands.
    pub state: LadderState,
    /// Whether it hears this very side.
    pub hears: bool,
    /// Whether it knew of this side's last hold when it sent that frame. What it said before says nothing of a press
    /// or release after the hold began.
    pub answers: bool,
}

/// What one tick tells the ladder.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LadderInput {
    /// Age in ns of the newest that is known of the peer; none before its first frame.
    pub age_ns: Option<u64>,
    /// Age in ns that the link has when nothing is wrong: silence counts from there.
    pub expected_age_ns: u64,
    /// By how much in ns the newest may be older than the link is used to; none until that is known.
    pub over_usual_ns: Option<u64>,
    /// What the newest frame says.
    pub peer: Option<PeerReport>,
    /// Whether the clutch is closed: at the master the button, at the slave what the master's frame says of it.
    pub clutch: bool,
    /// Whether that is an act at this tick: at the master the edge of the button, at the slave a master that aligns.
    pub asks: bool,
    /// Whether the peer has ended in good order.
    pub ended: bool,
    /// Whether the peer follows no more, though it has seen this side align and no release since: it took this side for
    /// ended.
    pub left: bool,
}

/// The ladder of one endpoint: a pure function of what it is told and when.
#[derive(Clone, Debug, PartialEq)]
pub struct Ladder {
    settings: LadderSettings,
    state: LadderState,
    gain: f64,
    last_ns: Option<u64>,
    /// When the peer was last heard and sound.
    last_sound_ns: Option<u64>,
    hears: bool,
    ready: bool,
    /// How much older than expected the peer's newest is, in ns.
    excess_ns: Option<u64>,
    /// Until when this side itself was blind.
    blind_until_ns: Option<u64>,
    /// Whether the clutch was seen open since the last hold began, or the last fault ended.
    opened: bool,
    holds: u64,
    history: History,
}

impl Ladder {
    /// A ladder that is disengaged; whoever presses the clutch at the start need not release it before.
    pub fn new(settings: LadderSettings) -> Result<Self, LadderError> {
        settings.check()?;
        Ok(Self {
            settings,
            state: LadderState::Disengaged,
            gain: 0.0,
            last_ns: None,
            last_sound_ns: None,
            hears: false,
            ready: false,
            excess_ns: None,
            blind_until_ns: None,
            opened: true,
            holds: 0,
            history: History::default(),
        })
    }

    /// One tick at `now_ns`.
    pub fn step(&mut self, now_ns: u64, input: &LadderInput) -> LadderState {
        let facts = self.facts(now_ns, input);
        self.follow(now_ns, facts);
        self.fade(now_ns);
        self.state
    }

    /// What is the case.
    fn facts(&mut self, now_ns: u64, input: &LadderInput) -> Facts {
        let LadderSettings { stale_after_ns, hold_after_ns, stop_after_ns, .. } = self.settings;
        self.excess_ns = input.age_ns.map(|age| age.saturating_sub(input.expected_age_ns));
        let silent = self.excess_ns.is_none_or(|excess| excess > hold_after_ns);
        let old = input.over_usual_ns.is_some_and(|over| over > hold_after_ns);
        // What had arrived while this side was blind is as old as that.
        let seen = input
            .age_ns
            .is_some_and(|age| self.blind_until_ns.is_none_or(|until| now_ns.saturating_sub(age) > until));
        self.hears = !silent && seen;
        let peer = input.peer;
        let stands = |state| peer.is_some_and(|peer| peer.state == state);
        let heard = peer.is_some_and(|peer| peer.hears);
        let answered = peer.is_some_and(|peer| peer.answers);
        let both_hear = self.hears && heard;
        let sound = heard && !stands(LadderState::Stop) && !stands(LadderState::Fault);
        if self.hears && sound || self.last_sound_ns.is_none() {
            self.last_sound_ns = Some(now_ns);
        }
        let unsound_ns = now_ns.saturating_sub(self.last_sound_ns.unwrap_or(now_ns));
        let silent_ns = if sound { self.excess_ns.unwrap_or(unsound_ns) } else { unsound_ns };

        let held = matches!(self.state, LadderState::Hold | LadderState::Stop);
        self.opened |= !input.clutch && (answered || !held);
        self.ready = both_hear && !stands(LadderState::Fault) && (answered || !held);
        let pressed = input.asks && self.opened && (self.ready || !held);
        let aligned = peer.is_some_and(|peer| peer.state.is_coupled() || peer.state == LadderState::Aligning);
        Facts::default()
            .with(Reason::PeerSilent, silent || !seen)
            .with(Reason::PeerDeaf, !heard)
            .with(Reason::PeerHolds, stands(LadderState::Hold) || input.left)
            .with(Reason::PeerStopped, stands(LadderState::Stop))
            .with(Reason::PeerFaulted, stands(LadderState::Fault))
            .with(Reason::PeerEnded, input.ended)
            // What it is used to is that of an engagement.
            .with(Reason::NewsOld, self.state.is_coupled() && old)
            .with(Reason::ClutchReleased, !input.clutch)
            .with(Reason::ClutchPressed, pressed)
            .with(Reason::BothAligned, both_hear && aligned)
            .with(Reason::FramesLate, self.excess_ns.is_some_and(|excess| excess > stale_after_ns))
            .with(Reason::FramesBack, self.excess_ns.is_some_and(|excess| excess <= stale_after_ns))
            .with(Reason::SilentTooLong, silent_ns > stop_after_ns)
    }

    /// Goes where the facts lead, as far as they do. Each leads one step only, so this ends.
    fn follow(&mut self, now_ns: u64, mut facts: Facts) {
        while let Some(row) = next(self.state, facts) {
            facts = facts.without(row.reason);
            if row.to == LadderState::Hold {
                self.holds += 1;
            }
            if matches!(row.to, LadderState::Hold | LadderState::Fault) {
                self.opened = false;
                // A press at the very tick at which a hold begins is none that answers it.
                facts = facts.without(Reason::ClutchPressed);
            }
            if row.reason == Reason::PeerEnded {
                // Another one must not be coupled with by a clutch that waits, pressed.
                self.opened = false;
            }
            if row.from == LadderState::Fault {
                // Whoever says that a fault is mended must not be surprised by a clutch that waits, pressed.
                self.opened = false;
            }
            self.history.push(Transition { time_ns: now_ns, from: row.from, to: row.to, reason: row.reason });
            self.state = row.to;
        }
    }

    /// Lets the share of the force follow the state.
    fn fade(&mut self, now_ns: u64) {
        let elapsed = now_ns.saturating_sub(self.last_ns.unwrap_or(now_ns)) as f64;
        self.last_ns = Some(now_ns);
        // A loop that was late must not make up for the time in which it did not fade in.
        let rising = elapsed.min(self.settings.hold_after_ns as f64 / 10.0);
        self.gain = match self.state {
            LadderState::Engaged => (self.gain + rising / self.settings.fade_in_ns as f64).min(1.0),
            // Nothing new is known that would speak for more, or for less.
            LadderState::Stale => self.gain,
            LadderState::Stop | LadderState::Fault => 0.0,
            _ => (self.gain - elapsed / self.settings.fade_out_ns as f64).max(0.0),
        };
    }

    fn tell(&mut self, now_ns: u64, reason: Reason) {
        self.follow(now_ns, Facts::default().with(reason, true));
    }

    /// The peer is another than before. A slave (`engages`) may follow a master that was started anew, because that
    /// is the act of a person; a hand is never coupled by what arrives from the network.
    pub fn new_session(&mut self, now_ns: u64, engages: bool) {
        self.tell(now_ns, Reason::PeerRestarted);
        if engages && self.state != LadderState::Fault {
            self.tell(now_ns, Reason::MasterStartedAnew);
            (self.gain, self.last_sound_ns, self.opened) = (0.0, None, true);
        }
    }

    /// A number that cannot be was met.
    pub fn fault(&mut self, now_ns: u64) {
        self.tell(now_ns, Reason::BadNumber);
        self.gain = 0.0;
    }

    /// A person at this side says that the fault is mended. The clutch must then be released and pressed.
    pub fn acknowledge(&mut self, now_ns: u64) {
        self.tell(now_ns, Reason::Acknowledged);
    }

    /// This side itself was late by more than the ladder allows, until `now_ns`: what it knows is old. It holds
    /// without force.
    pub fn stalled(&mut self, now_ns: u64) {
        (self.gain, self.blind_until_ns) = (0.0, Some(now_ns));
        self.tell(now_ns, Reason::OwnDelay);
    }

    /// Whether the peer was heard recently enough, as of the last tick.
    pub fn hears_peer(&self) -> bool {
        self.hears
    }

    /// Whether a press of the clutch would count, were it open: what a person is shown while it holds.
    pub fn is_ready(&self) -> bool {
        self.ready
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

    /// For how long in ns it has stood in STALE by the age of the newest frame; 0 unless it does.
    pub fn stale_ns(&self) -> u64 {
        match (self.state, self.excess_ns) {
            (LadderState::Stale, Some(excess)) => excess.saturating_sub(self.settings.stale_after_ns),
            _ => 0,
        }
    }

    /// Its times.
    pub fn settings(&self) -> &LadderSettings {
        &self.settings
    }

    /// Its last transitions.
    pub fn history(&self) -> &History {
        &self.history
    }
}

#[cfg(test)]
#[path = "machine_tests.rs"]
mod tests;
