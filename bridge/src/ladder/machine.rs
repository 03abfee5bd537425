//! Degradation ladder of one endpoint: a state machine that finds the facts of each tick and steps by the
//! table; its time settings; and its last transitions.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer};

use super::{
    PRESS_NS,
    input::{AlignmentState, LadderInput},
    table::{Facts, LadderState, Reason, next},
};

/// Ladder of one endpoint: a state machine that depends only on its inputs and their times.
#[allow(clippy::struct_excessive_bools)] // facts of the last tick
#[derive(Clone, Debug, PartialEq)]
pub struct Ladder {
    settings: LadderSettings,
    state: LadderState,
    gain: f64,
    last_ns: Option<u64>,
    /// Time in ns at which the peer was last sound: this side heard it, it heard this side, and it was
    /// neither in STOP nor in FAULT. Before that, time of the first tick.
    last_sound_ns: Option<u64>,
    hears: bool,
    ready: bool,
    /// Age in ns of the peer's newest frame beyond the expected age.
    excess_ns: Option<u64>,
    /// End in ns of the last stall of this side's own loop. Frames that arrived by then do not count.
    blind_until_ns: Option<u64>,
    /// True if a press counts: the clutch was open since the last hold, unanswered press, ended peer or
    /// fault.
    opened: bool,
    /// Time in ns at which ALIGNING began.
    aligning_ns: u64,
    /// True if the peer, in its present run, has said that it hears this side.
    was_heard: bool,
    /// Time in ns since which every frame that arrived in ALIGNING refused the press: it said STOP, or that
    /// the peer does not hear this side.
    apart_since_ns: Option<u64>,
    /// True if the arm is to rotate to the master's orientation, as of the last tick.
    turns: bool,
    holds: u64,
    /// Number of times that a release of the clutch became necessary.
    closings: u64,
    history: History,
}

impl Ladder {
    /// Build a disengaged ladder. A clutch that is pressed from the start need not be released first.
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
            was_heard: false,
            apart_since_ns: None,
            turns: false,
            holds: 0,
            closings: 0,
            history: History::default(),
        })
    }

    /// Step one tick at `now_ns`.
    #[inline(always)] // otherwise its arguments go through memory
    pub fn step(&mut self, now_ns: u64, input: &LadderInput) -> LadderState {
        if self.stays_engaged(now_ns, input) { self.state } else { self.step_by_table(now_ns, *input) }
    }

    /// Fast path of [`step_by_table`](Self::step_by_table) for the common tick. If all conditions below hold,
    /// no row of ENGAGED applies (an assertion in `table.rs` lists the rows): it does the same as the table
    /// and returns true. Else it changes nothing.
    ///
    /// Conditions: engaged with full force, clutch closed; a peer that has not ended, is aligning or coupled,
    /// and hears this side; its frames in time, of the usual age, and newer than the last stall.
    #[inline(always)] // as step
    fn stays_engaged(&mut self, now_ns: u64, input: &LadderInput) -> bool {
        let (Some(age_ns), Some(peer)) = (input.age_ns, input.peer) else { return false };
        let LadderSettings { stale_after_ns, hold_after_ns, .. } = self.settings;
        let excess_ns = age_ns.saturating_sub(input.expected_age_ns);
        let stays = self.state == LadderState::Engaged
            && self.gain >= 1.0
            && !self.turns
            && excess_ns <= stale_after_ns
            && self.blind_until_ns.is_none_or(|until| now_ns.saturating_sub(age_ns) > until)
            && input.over_baseline_ns.is_none_or(|over| over <= hold_after_ns)
            && peer.hears
            && peer.state.is_aligned()
            && input.clutch
            && !input.ended;
        if stays {
            (self.excess_ns, self.last_sound_ns, self.last_ns) =
                (Some(excess_ns), Some(now_ns), Some(now_ns));
            (self.hears, self.ready) = (true, true);
        }
        stays
    }

    /// Step one tick by the table, for any facts.
    #[inline(never)] // input by value: a reference would keep it in memory at every tick
    fn step_by_table(&mut self, now_ns: u64, input: LadderInput) -> LadderState {
        let (facts, may_engage) = self.facts(now_ns, &input);
        self.follow(now_ns, facts);
        self.turns =
            self.state == LadderState::Aligning && may_engage && input.alignment == AlignmentState::Remaining;
        self.fade(now_ns);
        self.state
    }

    /// Return the facts of this tick, and whether the link and the peer permit engaging: both sides hear each
    /// other, and a current report says that the peer is aligned.
    fn facts(&mut self, now_ns: u64, input: &LadderInput) -> (Facts, bool) {
        let LadderSettings { stale_after_ns, hold_after_ns, stop_after_ns, align_ns, .. } = self.settings;
        self.excess_ns = input.age_ns.map(|age| age.saturating_sub(input.expected_age_ns));
        let (has_age, excess_ns) = (self.excess_ns.is_some(), self.excess_ns.unwrap_or(0));
        let silent = !has_age || excess_ns > hold_after_ns;
        let old = input.over_baseline_ns.is_some_and(|over| over > hold_after_ns);
        // Frames that arrived before the end of a stall are too old to count.
        let seen = input
            .age_ns
            .is_some_and(|age| self.blind_until_ns.is_none_or(|until| now_ns.saturating_sub(age) > until));
        self.hears = !silent && seen;
        let peer = input.peer;
        let said = peer.map_or(Facts::default(), |peer| Facts::of_peer(peer.state));
        let heard = peer.is_some_and(|peer| peer.hears);
        let answered = peer.is_some_and(|peer| peer.answers);
        let both_hear = self.hears && heard;
        let peer_faulted = said.has(Reason::PeerFaulted);
        let sound = heard && !said.has(Reason::PeerStopped) && !peer_faulted;
        if self.hears && sound || self.last_sound_ns.is_none() {
            self.last_sound_ns = Some(now_ns);
        }
        let unsound_ns = now_ns.saturating_sub(self.last_sound_ns.unwrap_or(now_ns));
        let aligning = self.state == LadderState::Aligning;
        self.was_heard |= heard;
        let refuses = self.refuses_press(now_ns, input, heard, said.has(Reason::PeerStopped));
        let silent_ns = match self.excess_ns {
            Some(excess) if sound || aligning => excess,
            // Before the peer's first frame, silence does not end a press; only the timeout of a press does.
            None if aligning => 0,
            _ => unsound_ns,
        };

        let held = matches!(self.state, LadderState::Hold | LadderState::Stop);
        self.opened |= !input.clutch && (answered || !(held || input.needs_answer));
        self.ready = both_hear && !peer_faulted && (answered || !held);
        let pressed = input.is_press && self.opened && (self.ready || !held);
        let aligned = peer.is_some_and(|peer| peer.is_current && peer.state.is_aligned());
        let may_engage = both_hear && aligned;
        // While the arm turns, the operator may release the clutch. So silence ends the turn after the same
        // time in which it ends a coupling.
        let is_cut = self.turns && !may_engage;
        // A disengaged peer counts only while this side's clutch is closed.
        let facts = if input.clutch { said } else { said.without(Reason::PeerDisengaged) };
        // A press tolerates a stopped peer until the peer can have answered.
        let facts = if aligning && !refuses { facts.without(Reason::PeerStopped) } else { facts }
            .with(Reason::PeerSilent, silent || !seen)
            .with(Reason::PeerDeaf, !heard && (!aligning || refuses))
            .with(Reason::PeerEnded, input.ended)
            // The link's baseline age is measured at an engagement, so it applies only while coupled.
            .with(Reason::NewsOld, self.state.is_coupled() && old)
            .with(Reason::ClutchReleased, !input.clutch)
            .with(Reason::ClutchPressed, pressed)
            .with(
                Reason::BothAligned,
                may_engage && matches!(input.alignment, AlignmentState::Any | AlignmentState::Reached),
            )
            .with(Reason::TurnRefused, may_engage && input.alignment == AlignmentState::TooFar)
            .with(Reason::FramesLate, has_age && excess_ns > stale_after_ns)
            .with(Reason::FramesBack, has_age && excess_ns <= stale_after_ns)
            .with(Reason::SilentTooLong, silent_ns > stop_after_ns)
            .with(Reason::TurnCut, is_cut)
            .with(Reason::AlignTimedOut, aligning && now_ns.saturating_sub(self.aligning_ns) >= align_ns);
        (facts, may_engage)
    }

    /// Return whether the peer refuses a waiting press. It refuses if it says that it is in STOP or does not
    /// hear this side, for two round trips and at least [`ANSWER_NS`].
    ///
    /// The time counts from the first to the newest refusal that arrived, because silence has its own
    /// timeout. A peer that has never heard this side does not refuse: it may start after the press.
    fn refuses_press(&mut self, now_ns: u64, input: &LadderInput, heard: bool, stopped: bool) -> bool {
        let is_apart = self.state == LadderState::Aligning
            && self.was_heard
            && input.peer.is_some()
            && (!heard || stopped);
        let (true, Some(age_ns)) = (is_apart, input.age_ns) else {
            self.apart_since_ns = None;
            return false;
        };
        let arrived_ns = now_ns.saturating_sub(age_ns);
        let since_ns = *self.apart_since_ns.get_or_insert(arrived_ns.max(self.aligning_ns));
        arrived_ns.saturating_sub(since_ns) >= input.round_trip_ns.saturating_mul(2).max(ANSWER_NS)
    }

    /// Apply rows while the facts match one. Each fact is used once, so the loop ends.
    fn follow(&mut self, now_ns: u64, mut facts: Facts) {
        while let Some(row) = next(self.state, facts) {
            facts = facts.without(row.reason);
            if row.to == LadderState::Hold {
                self.holds += 1;
            }
            if row.to == LadderState::Aligning {
                self.aligning_ns = now_ns;
                // The silence belongs to the state before, and the peer cannot know of the press yet.
                facts = [Reason::SilentTooLong, Reason::PeerStopped, Reason::PeerDeaf]
                    .into_iter()
                    .fold(facts, Facts::without);
            }
            let is_unanswered = row.from == LadderState::Aligning
                && row.to == LadderState::Disengaged
                && row.reason != Reason::ClutchReleased;
            let is_held = matches!(row.to, LadderState::Hold | LadderState::Fault);
            // Another peer must not be coupled by a clutch that is still pressed.
            let is_ended = row.reason == Reason::PeerEnded;
            // An operator who acknowledges a fault must not be surprised by a clutch that is still pressed.
            if is_held || is_unanswered || is_ended || row.from == LadderState::Fault {
                self.opened = false;
                self.closings += 1;
            }
            if is_held || is_unanswered || is_ended {
                // A press at the tick at which a hold begins does not answer that hold.
                facts = facts.without(Reason::ClutchPressed);
            }
            self.history.push(Transition { time_ns: now_ns, from: row.from, to: row.to, reason: row.reason });
            self.state = row.to;
        }
    }

    /// Move the gain of the force as the state requires.
    fn fade(&mut self, now_ns: u64) {
        let elapsed_ns = now_ns.saturating_sub(self.last_ns.unwrap_or(now_ns));
        self.last_ns = Some(now_ns);
        let elapsed = elapsed_ns as f64;
        self.gain = match self.state {
            LadderState::Engaged if self.gain >= 1.0 => 1.0,
            LadderState::Engaged => {
                // A late loop must not catch up on the fade-in that it missed.
                let rising = elapsed.min(self.settings.hold_after_ns as f64 / 10.0);
                (self.gain + rising / self.settings.fade_in_ns as f64).min(1.0)
            }
            // Without new frames there is no reason to raise or lower the gain.
            LadderState::Stale => self.gain,
            LadderState::Stop | LadderState::Fault => 0.0,
            _ => (self.gain - elapsed / self.settings.fade_out_ns as f64).max(0.0),
        };
    }

    fn apply(&mut self, now_ns: u64, reason: Reason) {
        self.follow(now_ns, Facts::default().with(reason, true));
    }

    /// Record that a new run of the peer began. With `engages` (at a slave), the ladder goes to DISENGAGED
    /// unless it is in FAULT, and the next press needs no release: a person has started the master. Without
    /// it (at a master), a coupled ladder goes to HOLD until a press: a datagram must not engage a master.
    pub fn new_run(&mut self, now_ns: u64, engages: bool) {
        self.was_heard = false;
        self.apply(now_ns, Reason::PeerRestarted);
        if engages && self.state != LadderState::Fault {
            self.apply(now_ns, Reason::MasterStartedAnew);
            (self.gain, self.last_sound_ns, self.opened) = (0.0, None, true);
        }
    }

    /// Go to FAULT with zero gain after an invalid number.
    pub fn fault(&mut self, now_ns: u64) {
        self.apply(now_ns, Reason::BadNumber);
        self.gain = 0.0;
    }

    /// Withhold the force after a trip: no hand is felt, or the hand yields (`yields`). A person must confirm
    /// that a hand is there.
    pub fn withhold(&mut self, now_ns: u64, yields: bool) {
        self.apply(now_ns, if yields { Reason::HandYields } else { Reason::HandGone });
    }

    /// Acknowledge the fault on behalf of the operator. The clutch must then be released and pressed.
    pub fn acknowledge(&mut self, now_ns: u64) {
        self.apply(now_ns, Reason::Acknowledged);
    }

    /// Record a stall: until `now_ns` this side was late by more than the ladder allows. The force is zero at
    /// once, and a coupled side goes to HOLD. Frames that arrived by then do not count.
    pub fn stalled(&mut self, now_ns: u64) {
        (self.gain, self.blind_until_ns) = (0.0, Some(now_ns));
        // A press keeps waiting unless the arm already turns.
        if self.state != LadderState::Aligning || self.turns {
            self.apply(now_ns, Reason::OwnDelay);
        }
    }

    /// Return whether the peer was heard recently enough, as of the last tick.
    pub fn hears_peer(&self) -> bool {
        self.hears
    }

    /// Return whether a press would count if the clutch were open; the operator sees this during a hold.
    pub fn is_ready(&self) -> bool {
        self.ready
    }

    /// State of the ladder.
    pub fn state(&self) -> LadderState {
        self.state
    }

    /// Share of the force that may be rendered, 0 to 1.
    pub fn gain(&self) -> f64 {
        self.gain
    }

    /// Return whether the arm is to rotate to the master's orientation: in ALIGNING, while both sides hear
    /// each other, the peer is aligned, and a rotation remains.
    pub fn turns(&self) -> bool {
        self.turns
    }

    /// Number of transitions to HOLD.
    pub fn holds(&self) -> u64 {
        self.holds
    }

    /// Number of times that a release of the clutch became necessary: by a hold, a fault, an ended peer or an
    /// unanswered press.
    pub fn closings(&self) -> u64 {
        self.closings
    }

    /// Return whether the last press expired: neither a coupling nor a release of the clutch ended it, and no
    /// transition followed.
    pub fn is_unanswered(&self) -> bool {
        self.history.last().is_some_and(|last| {
            (last.from, last.to) == (LadderState::Aligning, LadderState::Disengaged)
                && last.reason != Reason::ClutchReleased
        })
    }

    /// Time in ns in STALE, by the age of the newest frame; 0 in every other state.
    pub fn stale_ns(&self) -> u64 {
        match (self.state, self.excess_ns) {
            (LadderState::Stale, Some(excess)) => excess.saturating_sub(self.settings.stale_after_ns),
            _ => 0,
        }
    }

    /// Times of the ladder.
    pub fn settings(&self) -> &LadderSettings {
        &self.settings
    }

    /// Last transitions.
    pub fn history(&self) -> &History {
        &self.history
    }
}

/// Times of the ladder. Ages count from the expected age of the link, so a long delay is not silence.
///
/// A scene gives them in s.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LadderSettings {
    /// Age in ns beyond the expected age that leads to STALE.
    #[serde(rename = "stale_after_s", deserialize_with = "integer_ns")]
    #[schemars(with = "f64")]
    pub stale_after_ns: u64,
    /// Age in ns beyond the expected age that leads to HOLD; above `stale_after_ns` and at most 100 ms. The
    /// force then fades over `fade_out_ns`, so it is zero at most 200 ms beyond the expected age.
    #[serde(rename = "hold_after_s", deserialize_with = "integer_ns")]
    #[schemars(with = "f64")]
    pub hold_after_ns: u64,
    /// Age in ns beyond the expected age that leads to STOP; above `hold_after_ns`.
    #[serde(rename = "stop_after_s", deserialize_with = "integer_ns")]
    #[schemars(with = "f64")]
    pub stop_after_ns: u64,
    /// Time in ns in STALE over which the slave's velocity decays to zero; at most 20 ms, and at most the
    /// time from STALE to HOLD.
    #[serde(rename = "extrapolate_s", deserialize_with = "integer_ns")]
    #[schemars(with = "f64")]
    pub extrapolate_ns: u64,
    /// Time in ns over which the force fades from full to zero, 50 to 100 ms.
    #[serde(rename = "fade_out_s", deserialize_with = "integer_ns")]
    #[schemars(with = "f64")]
    pub fade_out_ns: u64,
    /// Time in ns over which the force rises from zero to full, at least 200 ms.
    #[serde(rename = "fade_in_s", deserialize_with = "integer_ns")]
    #[schemars(with = "f64")]
    pub fade_in_ns: u64,
    /// Timeout in ns of a press in ALIGNING, and greatest age of a frame by which a slave aligns; 0.5 to 5 s.
    #[serde(skip, default = "default_align_ns")]
    pub align_ns: u64,
}

const MS: u64 = 1_000_000;

/// Shortest time in ns of refusals by the peer that ends a press, for any round trip. Covers a few ticks of a
/// slow loop, and a burst of losses.
const ANSWER_NS: u64 = 50 * MS;

/// Read a time in s as integer ns.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // saturates; `check` then tests the range
fn integer_ns<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    f64::deserialize(deserializer).map(|seconds| (seconds * 1e9).round() as u64)
}

const fn default_align_ns() -> u64 {
    PRESS_NS
}

impl Default for LadderSettings {
    /// Defaults. HOLD begins at 20 ms, the command-loss time of libfranka and UR. STOP begins at 200 ms, the
    /// longest command loss that they tolerate; 200 ms is also the shortest fade-in. With a fade-out of 75 ms
    /// the force is zero 95 ms beyond the expected age.
    fn default() -> Self {
        Self {
            stale_after_ns: 5 * MS,
            hold_after_ns: 20 * MS,
            stop_after_ns: 200 * MS,
            extrapolate_ns: 15 * MS,
            fade_out_ns: 75 * MS,
            fade_in_ns: 200 * MS,
            align_ns: default_align_ns(),
        }
    }
}

/// Ladder time that is out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("ladder {name} = {seen} ns: must be between {min} and {max}")]
pub struct LadderError {
    name: &'static str,
    seen: u64,
    min: u64,
    max: u64,
}

impl LadderSettings {
    /// Return an error for times that are out of order or out of range.
    pub fn check(&self) -> Result<(), LadderError> {
        for (name, seen, min, max) in [
            ("stale_after", self.stale_after_ns, 1, 1_000 * MS),
            ("hold_after", self.hold_after_ns, self.stale_after_ns.saturating_add(1), 100 * MS),
            ("stop_after", self.stop_after_ns, self.hold_after_ns.saturating_add(1), 10_000 * MS),
            (
                "extrapolate",
                self.extrapolate_ns,
                0,
                (20 * MS).min(self.hold_after_ns.saturating_sub(self.stale_after_ns)),
            ),
            ("fade_out", self.fade_out_ns, 50 * MS, 100 * MS),
            ("fade_in", self.fade_in_ns, 200 * MS, 60_000 * MS),
            ("align", self.align_ns, 500 * MS, PRESS_NS),
        ] {
            if !(min..=max).contains(&seen) {
                return Err(LadderError { name, seen, min, max });
            }
        }
        Ok(())
    }
}

/// One transition of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transition {
    /// Time in ns.
    pub time_ns: u64,
    /// State before.
    pub from: LadderState,
    /// State after.
    pub to: LadderState,
    /// Reason of the transition.
    pub reason: Reason,
}

/// Capacity of the history, in transitions.
const KEPT: usize = 32;

/// Ring of the last transitions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct History {
    ring: [Option<Transition>; KEPT],
    count: usize,
    /// Result of [`cause`](Self::cause), computed once per transition because every frame sends it.
    cause: Option<Reason>,
}

impl Default for History {
    fn default() -> Self {
        Self { ring: [None; KEPT], count: 0, cause: None }
    }
}

impl History {
    /// Store a transition; it overwrites the oldest one once the ring is full.
    pub(super) fn push(&mut self, transition: Transition) {
        self.ring[self.count % KEPT] = Some(transition);
        self.count += 1;
        self.cause = self.find_cause();
    }

    /// Number of transitions so far.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Newest transition.
    pub fn last(&self) -> Option<Transition> {
        self.ring[self.count.checked_sub(1)? % KEPT]
    }

    /// Reason of the present state. For HOLD and STOP: reason of the transition that last left a state other
    /// than HOLD, STOP and FAULT.
    pub fn cause(&self) -> Option<Reason> {
        self.cause
    }

    fn find_cause(&self) -> Option<Reason> {
        let last = self.last()?;
        if !matches!(last.to, LadderState::Hold | LadderState::Stop) {
            return Some(last.reason);
        }
        let kept = self.count.saturating_sub(KEPT)..self.count;
        let newest_first = kept.rev().filter_map(|index| self.ring[index % KEPT]);
        newest_first.into_iter().find(|step| !step.from.is_held()).or(Some(last)).map(|step| step.reason)
    }

    /// Stored transitions, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = Transition> + '_ {
        (self.count.saturating_sub(KEPT)..self.count).filter_map(|index| self.ring[index % KEPT])
    }
}

#[cfg(test)]
mod settings_tests {
    use super::*;

    #[test]
    fn times_are_ordered() {
        let good = LadderSettings::default();
        assert_eq!(good.check(), Ok(()));
        for (bad, name) in [
            (LadderSettings { stale_after_ns: 0, ..good }, "stale_after"),
            (LadderSettings { stale_after_ns: 20 * MS, ..good }, "hold_after"),
            (LadderSettings { stop_after_ns: 20 * MS, ..good }, "stop_after"),
            (LadderSettings { extrapolate_ns: 16 * MS, ..good }, "extrapolate"),
            (LadderSettings { hold_after_ns: 100 * MS, extrapolate_ns: 21 * MS, ..good }, "extrapolate"),
            (LadderSettings { fade_out_ns: 49 * MS, ..good }, "fade_out"),
            (LadderSettings { fade_out_ns: 101 * MS, ..good }, "fade_out"),
            (LadderSettings { fade_in_ns: 199 * MS, ..good }, "fade_in"),
            (LadderSettings { hold_after_ns: 100 * MS + 1, ..good }, "hold_after"),
            (LadderSettings { hold_after_ns: u64::MAX, ..good }, "hold_after"),
            (LadderSettings { align_ns: 499 * MS, ..good }, "align"),
            (LadderSettings { align_ns: 5_001 * MS, ..good }, "align"),
        ] {
            assert_eq!(bad.check().unwrap_err().name, name);
        }
        assert_eq!(
            LadderSettings { fade_in_ns: 1, ..good }.check().unwrap_err().to_string(),
            "ladder fade_in = 1 ns: must be between 200000000 and 60000000000"
        );
    }
}

#[cfg(test)]
mod history_tests {
    use super::*;

    #[test]
    fn stop_has_the_cause_of_its_hold() {
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
    fn last_transitions_are_kept_in_order() {
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
#[cfg(test)]
#[path = "pair_search.rs"]
mod pair_search;
#[cfg(test)]
mod tests;
