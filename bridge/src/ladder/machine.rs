//! The ladder of one endpoint: what is the case at a tick, and where that leads.

use super::{
    history::{History, Transition},
    input::LadderInput,
    settings::{LadderError, LadderSettings},
    state::LadderState,
    table::{Facts, Reason, next},
};

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
    /// Whether the clutch was seen open since the last hold began, a press ended unanswered, or the last fault ended.
    opened: bool,
    /// When ALIGNING began, in ns.
    aligning_ns: u64,
    holds: u64,
    /// How often a release became necessary.
    closings: u64,
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
            aligning_ns: 0,
            holds: 0,
            closings: 0,
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
        let LadderSettings { stale_after_ns, hold_after_ns, stop_after_ns, align_ns, .. } = self.settings;
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
        let aligning = self.state == LadderState::Aligning;
        let silent_ns = match self.excess_ns {
            Some(excess) if sound || aligning => excess,
            // A press at the start waits for the peer's first frame as long as any press does.
            None if aligning => 0,
            _ => unsound_ns,
        };

        let held = matches!(self.state, LadderState::Hold | LadderState::Stop);
        self.opened |= !input.clutch && (answered || !(held || input.needs_answer));
        self.ready = both_hear && !stands(LadderState::Fault) && (answered || !held);
        let pressed = input.asks && self.opened && (self.ready || !held);
        let aligned = peer.is_some_and(|peer| peer.is_current && peer.state.is_aligned());
        Facts::default()
            .with(Reason::PeerSilent, silent || !seen)
            .with(Reason::PeerDeaf, !heard)
            .with(Reason::PeerHolds, stands(LadderState::Hold))
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
            .with(Reason::AlignTimedOut, aligning && now_ns.saturating_sub(self.aligning_ns) >= align_ns)
            .with(Reason::PeerDisengaged, stands(LadderState::Disengaged) && input.clutch)
    }

    /// Goes where the facts lead, as far as they do. Each leads one step only, so this ends.
    fn follow(&mut self, now_ns: u64, mut facts: Facts) {
        while let Some(row) = next(self.state, facts) {
            facts = facts.without(row.reason);
            if row.to == LadderState::Hold {
                self.holds += 1;
            }
            if row.to == LadderState::Aligning {
                self.aligning_ns = now_ns;
                // What was too long in the state before is not so in this one.
                facts = facts.without(Reason::SilentTooLong);
            }
            let is_unanswered = row.from == LadderState::Aligning
                && row.to == LadderState::Disengaged
                && row.reason != Reason::ClutchReleased;
            let is_held = matches!(row.to, LadderState::Hold | LadderState::Fault);
            // Another peer must not be coupled with by a clutch that waits, pressed.
            let is_ended = row.reason == Reason::PeerEnded;
            // Whoever says that a fault is mended must not be surprised by a clutch that waits, pressed.
            if is_held || is_unanswered || is_ended || row.from == LadderState::Fault {
                self.opened = false;
                self.closings += 1;
            }
            if is_held || is_unanswered || is_ended {
                // A press at the very tick at which a hold begins is none that answers it.
                facts = facts.without(Reason::ClutchPressed);
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

    /// How often a release became necessary, by a hold, a fault or a press that ended unanswered.
    pub fn closings(&self) -> u64 {
        self.closings
    }

    /// Whether a press has ended without the two being coupled, and no other was made since.
    pub fn is_unanswered(&self) -> bool {
        self.history.last().is_some_and(|last| {
            (last.from, last.to) == (LadderState::Aligning, LadderState::Disengaged)
                && last.reason != Reason::ClutchReleased
        })
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
#[path = "pair_search.rs"]
mod pair_search;
#[cfg(test)]
#[path = "machine_tests.rs"]
mod tests;
