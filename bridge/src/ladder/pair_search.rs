//! Search of every state that two ladders can reach over a bad link, with the conditions that each state must
//! meet.
//!
//! Two real [`Ladder`]s with their real [`LadderInputs`] and the master's [`Button`] step every 100 ms.
//! Between two steps an operator may press, release and acknowledge faults. In each direction the link
//! delivers the frame, loses it, or delivers a frame that it stored earlier.
//!
//! In addition a run has a number of events:
//!
//! - The link stores a frame for any time.
//! - A side restarts, ends in an orderly way, sleeps for any time, or has a fault.
//! - An attacker forges a message to one side that the other has ended.
//!
//! Restarting a side that has ended uses up no event. If the slave rotates to the master's orientation before
//! it engages, each tick chooses one result: still to turn, aligned, or too far.
//!
//! Time is unbounded. The search measures ages from the present and saturates them where they make no
//! difference, so the states are finite. Without events the search visits all states; with one event it
//! visits those that few moves reach. `HAPTETHER_SEARCH_EVENTS` and `HAPTETHER_SEARCH_STATES` request more.
#![allow(clippy::cast_possible_truncation)] // small numbers of ticks

use std::collections::{HashSet, VecDeque};

use super::{
    super::{AlignmentState, Button, LadderInputs, LinkView, PeerFrame},
    *,
};
use crate::wire::Role;

const TICK_NS: u64 = 100_000_000;
/// Short times keep the number of states small. Two missing frames lead to HOLD, three to STOP. `align` is
/// five ticks: the shortest in which one direction can be cut for two round trips and recover.
const SETTINGS: LadderSettings = LadderSettings {
    stale_after_ns: 5_000_000,
    hold_after_ns: 50_000_000,
    stop_after_ns: 150_000_000,
    extrapolate_ns: 15_000_000,
    fade_out_ns: 75_000_000,
    fade_in_ns: 200_000_000,
    align_ns: 5 * TICK_NS,
};
const ALIGN: u64 = SETTINGS.align_ns / TICK_NS;
/// Assumed round trip in ticks. An answer takes two ticks, and must arrive within two round trips; 1 is the
/// smallest such value.
const ROUND_TRIP: u64 = 1;
/// Largest age in ticks of a press by which a slave may engage. The master reports ALIGNING for `align`, and
/// its last such frame may itself be `align` old, plus one tick.
const SLAVE_PRESS: u64 = 2 * ALIGN + 1;
/// Age in ticks from which on ages make no difference.
const OLD: u64 = SLAVE_PRESS + 1;
const MASTER: usize = 0;
const SLAVE: usize = 1;

#[derive(Clone, Copy, Debug, PartialEq)]
struct Sent {
    session: u64,
    /// Also the tick at which it was sent.
    sequence: u64,
    state: LadderState,
    clutch: bool,
    hears: bool,
    echo: Option<(u64, u64)>,
    ended: bool,
}

#[derive(Clone, Debug)]
struct Side {
    ladder: Ladder,
    inputs: LadderInputs,
    session: u64,
    newest: Option<(Sent, u64)>,
    asleep: bool,
    /// True if the side has ended: it rests, and its frames say so.
    ended: bool,
    /// True if its newest input was an end of its peer.
    peer_ended: bool,
}

impl Side {
    fn new(role: Role, session: u64) -> Self {
        let ladder = Ladder { settings: SETTINGS, ..Ladder::new(LadderSettings::default()).unwrap() };
        let inputs = LadderInputs::new(role);
        Self { ladder, inputs, session, newest: None, asleep: false, ended: false, peer_ended: false }
    }

    /// Accept frames like [`crate::FrameLink`]: newer ones, and a newer session once the present one is
    /// silent. The session layer excludes older sessions.
    fn receive(&mut self, now: u64, frame: Sent, engages: bool) -> bool {
        let Some((newest, arrived)) = self.newest else {
            (self.newest, self.peer_ended) = (Some((frame, now)), frame.ended);
            return false;
        };
        let begins = newest.session < frame.session && (now - arrived) * TICK_NS >= SETTINGS.stop_after_ns;
        if begins || newest.session == frame.session && newest.sequence < frame.sequence {
            (self.newest, self.peer_ended) = (Some((frame, now)), frame.ended);
        }
        if begins {
            self.ladder.new_run(now * TICK_NS, engages);
        }
        begins
    }

    fn step(&mut self, now: u64, button: bool) -> Sent {
        let newest = self.newest.map(|(frame, _)| {
            let echo = frame.echo.filter(|(session, _)| *session == self.session);
            PeerFrame {
                state: frame.state,
                clutch: frame.clutch,
                hears: frame.hears && echo.is_some(),
                echo: echo.map(|(_, sequence)| sequence),
                echo_age_ns: echo.map(|(_, sequence)| (now - sequence) * TICK_NS),
            }
        });
        let view = LinkView {
            age_ns: self.newest.map(|(_, arrived)| (now - arrived) * TICK_NS),
            expected_age_ns: TICK_NS,
            over_baseline_ns: None,
            round_trip_ns: ROUND_TRIP * TICK_NS,
            newest,
            next_sequence: now,
            ended: self.peer_ended,
        };
        self.inputs.step(&mut self.ladder, now * TICK_NS, button, &view);
        Sent {
            session: self.session,
            sequence: now,
            state: match self.ladder.state() {
                state if self.ended && !state.is_held() => LadderState::Disengaged,
                LadderState::Aligning if self.inputs.alignment != AlignmentState::Any => {
                    LadderState::Disengaged
                }
                state => state,
            },
            clutch: self.inputs.clutch() && !self.ended,
            hears: self.ladder.hears_peer(),
            echo: self.newest.map(|(frame, _)| (frame.session, frame.sequence)),
            ended: self.ended,
        }
    }
}

/// Last press of the operator, as the search itself remembers it.
#[derive(Clone, Copy, Debug)]
struct Press {
    tick: u64,
    /// Per side: true while the press may still couple it. False after a hold, a fault, an end, an unanswered
    /// press, a restart of its known peer, or a refusal for two round trips. A restarted slave takes the
    /// master's value; a slave that meets a new master takes `of_this_life`.
    counts: [bool; 2],
    /// True if it happened in this run of the master.
    of_this_life: bool,
}

/// Reports that a side received from its peer, as the search itself remembers them.
#[derive(Clone, Copy, Debug, Default)]
struct Shown {
    /// True if the peer has said, in the present runs of both, that it hears this side.
    was_heard: bool,
    /// First tick of an unbroken series of frames, during a waiting press, in which the peer is in STOP or
    /// FAULT or does not hear this side.
    apart: Option<u64>,
}

#[derive(Clone, Debug)]
struct Pair {
    now: u64,
    sides: [Side; 2],
    level: bool,
    button: Button,
    /// Frame of each side from the last tick.
    fresh: [Option<Sent>; 2],
    /// Frame of each side that the link has stored.
    kept: [Option<Sent>; 2],
    events: u8,
    press: Press,
    shown: [Shown; 2],
    /// True if the slave rotates to the master's orientation before it engages.
    aligns: bool,
}

/// Fate of a direction's frame at a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fate {
    Delivered,
    Lost,
    /// Lost; the stored frame is delivered instead.
    KeptDelivered,
    /// Stored, and not delivered now.
    Kept,
}

#[derive(Clone, Copy, Debug)]
enum Move {
    /// Tick: whether the operator moves the button, fate of each side's frame, whether sleepers wake, and
    /// alignment of the slave.
    Tick(bool, [Fate; 2], bool, AlignmentState),
    /// Restart of a side; for a master, whether the clutch is pressed at its start.
    Restart(usize, bool),
    Sleep(usize),
    Fault(usize),
    Acknowledge(usize),
    End(usize),
    FalseEnd(usize),
}

impl Pair {
    fn start(pressed: bool, events: u8, aligns: bool) -> Self {
        let now = 1000;
        let mut pair = Self {
            now,
            sides: [Side::new(Role::Master, 1), Side::new(Role::Slave, 1)],
            level: pressed,
            button: Button::default(),
            fresh: [None; 2],
            kept: [None; 2],
            events,
            press: Press { tick: 0, counts: [false; 2], of_this_life: false },
            shown: [Shown::default(); 2],
            aligns,
        };
        if pressed {
            pair.presses();
        }
        pair
    }

    fn presses(&mut self) {
        self.press = Press { tick: self.now, counts: [true; 2], of_this_life: true };
        self.shown[MASTER].apart = None;
    }

    fn moves(&self) -> Vec<Move> {
        let mut moves = Vec::new();
        let fates = |from: usize| {
            let mut fates = vec![Fate::Lost];
            let hears = !self.sides[1 - from].asleep;
            if self.fresh[from].is_some() && hears {
                fates.push(Fate::Delivered);
            }
            if self.kept[from].is_some() && hears {
                fates.push(Fate::KeptDelivered);
            }
            if self.fresh[from].is_some() && self.events > 0 {
                fates.push(Fate::Kept);
            }
            fates
        };
        let wakes: &[bool] =
            if self.sides.iter().any(|side| side.asleep) { &[false, true] } else { &[false] };
        let is_coupled = self.sides[SLAVE].ladder.state().is_coupled();
        let turns: &[_] = match (self.aligns, is_coupled) {
            (false, _) => &[AlignmentState::Any],
            (true, true) => &[AlignmentState::Remaining],
            (true, false) => &[AlignmentState::Remaining, AlignmentState::Reached, AlignmentState::TooFar],
        };
        for forward in fates(MASTER) {
            for backward in fates(SLAVE) {
                // Not searched: storing both frames in one tick.
                if forward == Fate::Kept && backward == Fate::Kept {
                    continue;
                }
                for moves_button in [false, true] {
                    for wakes in wakes {
                        moves.extend(
                            turns
                                .iter()
                                .map(|turn| Move::Tick(moves_button, [forward, backward], *wakes, *turn)),
                        );
                    }
                }
            }
        }
        for side in [MASTER, SLAVE] {
            if self.sides[side].ladder.state() == LadderState::Fault {
                moves.push(Move::Acknowledge(side));
            }
            let Side { asleep, ended, newest, .. } = &self.sides[side];
            if (self.events > 0 || *ended) && !asleep {
                moves.push(Move::Restart(side, false));
                if side == MASTER {
                    moves.push(Move::Restart(MASTER, true));
                }
            }
            if self.events > 0 && !asleep && !ended {
                moves.extend([Move::Sleep(side), Move::Fault(side), Move::End(side)]);
                if newest.is_some() {
                    moves.push(Move::FalseEnd(side));
                }
            }
        }
        moves
    }

    /// Change a side, and clear its press if that made a release necessary.
    fn at(&mut self, side: usize, does: impl FnOnce(&mut Side)) {
        let before = self.sides[side].ladder.closings();
        does(&mut self.sides[side]);
        self.press.counts[side] &= self.sides[side].ladder.closings() == before;
    }

    fn does(&mut self, what: Move) -> Result<(), String> {
        let now_ns = self.now * TICK_NS;
        // Restarting a side that has ended uses up no event.
        let is_free = match what {
            Move::Acknowledge(_) => true,
            Move::Restart(side, _) => self.sides[side].ended,
            _ => false,
        };
        match what {
            Move::Tick(moves_button, fates, wakes, turn) => {
                self.sides[SLAVE].inputs.alignment = turn;
                return self.tick(moves_button, fates, wakes);
            }
            Move::Acknowledge(side) => self.at(side, |side| side.ladder.acknowledge(now_ns)),
            Move::Fault(side) => self.at(side, |side| side.ladder.fault(now_ns)),
            Move::Sleep(side) => self.sides[side].asleep = true,
            Move::End(side) => (self.sides[side].ended, self.press.counts[side]) = (true, false),
            Move::FalseEnd(side) => self.sides[side].peer_ended = true,
            Move::Restart(MASTER, pressed) => {
                let session = self.sides[MASTER].session + 1;
                self.sides[MASTER] = Side::new(Role::Master, session);
                self.shown[MASTER] = Shown::default();
                (self.button, self.level) = (Button::default(), pressed);
                // Frames of the old master may still be in flight: the slave takes the old master for alive
                // until it falls silent.
                (self.press.counts[MASTER], self.press.of_this_life) = (false, false);
                if pressed {
                    self.presses();
                }
            }
            Move::Restart(..) => {
                let session = self.sides[SLAVE].session + 1;
                self.shown[SLAVE] = Shown::default();
                // Frames of the old slave may still be in flight, like those of a master.
                self.sides[SLAVE] = Side::new(Role::Slave, session);
                // The old slave's history does not bind the new one: a press that waits at the master may
                // reach it.
                self.press.counts[SLAVE] = self.press.counts[MASTER];
            }
        }
        if !is_free {
            self.events -= 1;
        }
        Ok(())
    }

    fn tick(&mut self, moves_button: bool, fates: [Fate; 2], wakes: bool) -> Result<(), String> {
        self.now += 1;
        for (from, fate) in fates.into_iter().enumerate() {
            let frame = match fate {
                Fate::Delivered => self.fresh[from],
                Fate::KeptDelivered => self.kept[from].take(),
                Fate::Lost => None,
                Fate::Kept => {
                    self.events -= 1;
                    self.kept[from] = self.fresh[from];
                    None
                }
            };
            let Some(frame) = frame else { continue };
            let (to, now, mut begins) = (1 - from, self.now, false);
            self.at(to, |side| begins = side.receive(now, frame, to == SLAVE));
            self.show(to, begins);
            if to == MASTER && begins {
                self.press.counts = [false; 2];
            }
            if to == SLAVE && begins && self.sides[SLAVE].ladder.state() != LadderState::Fault {
                // The slave may follow any press made in the new master's run.
                self.press.counts[SLAVE] = self.press.of_this_life;
            }
        }
        // As in a loop: arrivals first, then the button.
        if moves_button {
            self.level = !self.level;
            if self.level {
                self.presses();
            }
        }
        for side in [MASTER, SLAVE] {
            let now = self.now;
            if self.sides[side].asleep {
                if !wakes {
                    self.fresh[side] = None;
                    continue;
                }
                self.sides[side].asleep = false;
                self.at(side, |side| side.ladder.stalled(now * TICK_NS));
                if side == MASTER {
                    self.button.stalled();
                }
            }
            let button = side == MASTER && self.button.at(now * TICK_NS, Some(self.level)) == Some(true);
            let before = self.sides[side].ladder.state();
            let counted = self.press.counts[side];
            let mut sent = None;
            self.at(side, |side| sent = Some(side.step(now, button)));
            self.fresh[side] = sent;
            self.check(side, before, counted)?;
        }
        Ok(())
    }

    /// Record the frame that has just arrived, if it is the newest. A press stops counting once frames have
    /// refused it for two round trips.
    fn show(&mut self, to: usize, begins: bool) {
        let Side { ladder, newest, session, .. } = &self.sides[to];
        let Some((frame, arrived)) = newest else { return };
        if begins {
            self.shown[to] = Shown::default();
        }
        if *arrived != self.now {
            return;
        }
        let Shown { was_heard, apart } = &mut self.shown[to];
        let hears = frame.hears && frame.echo.is_some_and(|(of, _)| of == *session);
        *was_heard |= hears;
        let refuses = !hears || matches!(frame.state, LadderState::Stop | LadderState::Fault);
        if !(*was_heard && refuses && ladder.state == LadderState::Aligning) {
            *apart = None;
            return;
        }
        if self.now - *apart.get_or_insert(self.now) >= 2 * ROUND_TRIP {
            self.press.counts[to] = false;
        }
    }

    /// Check the conditions of a side after its step.
    fn check(&self, side: usize, before: LadderState, counted: bool) -> Result<(), String> {
        let Side { ladder, newest, ended, .. } = &self.sides[side];
        if *ended {
            return Ok(());
        }
        let state = ladder.state();
        let hold = |holds: bool, what: &str| {
            if holds { Ok(()) } else { Err(format!("{before:?} to {state:?}: {what}")) }
        };
        if state.is_coupled() && !before.is_coupled() {
            let most = [ALIGN, SLAVE_PRESS][side];
            hold(self.now - self.press.tick <= most, "coupled without a recent press")?;
            hold(
                counted,
                "coupled by a refused press, or one from before the last hold, fault, end or restart",
            )?;
        }
        let moves = state.is_coupled() || ladder.turns();
        if ladder.turns() {
            hold(
                side == SLAVE && state == LadderState::Aligning,
                "turned outside ALIGNING, or at the master",
            )?;
            hold(self.now - self.press.tick <= SLAVE_PRESS, "turned without a recent press")?;
            hold(counted, "turned by a press from before the last hold, fault, end or restart")?;
        }
        if self.aligns && side == MASTER && state.is_coupled() && !before.is_coupled() {
            let engaged = newest.is_some_and(|(frame, _)| frame.state.is_coupled());
            hold(engaged, "coupled to an arm that still turns")?;
        }
        let aligning = self.now - ladder.aligning_ns / TICK_NS;
        hold(state != LadderState::Aligning || aligning < ALIGN, "aligns for too long")?;
        if let Some((frame, arrived)) = newest {
            let missing = (self.now - arrived) * TICK_NS > TICK_NS + SETTINGS.hold_after_ns;
            hold(!moves || !missing, "coupled to a silent peer")?;
            let open = side == SLAVE && !frame.clutch;
            let apart = frame.state.is_held() || frame.state == LadderState::Disengaged || open;
            hold(!moves || !apart, "coupled to an uncoupled peer")?;
            let gone = missing && self.now - arrived > 1 + SETTINGS.stop_after_ns.div_ceil(TICK_NS);
            // A press while the peer is silent stays in ALIGNING for one tick.
            let goes_on = state == LadderState::Aligning && before == state;
            hold(!goes_on || !gone, "aligns with a silent peer")?;
        } else {
            hold(!moves, "coupled without a peer")?;
        }
        Ok(())
    }

    /// Key of all fields that the future depends on: states with equal keys behave alike. Consider every new
    /// field here.
    fn key(&self) -> Vec<u8> {
        let mut key = Vec::with_capacity(64);
        let age = |tick: u64, most: u64| (self.now - tick).min(most) as u8;
        // The ladder compares a sequence with the last event that required a release, with the waiting press
        // and with the current tick.
        let number = |side: usize, number: u64| {
            let Side { ladder, inputs, .. } = &self.sides[side];
            let pressed = ladder.state == LadderState::Aligning && number >= inputs.pressed_sequence;
            let answers = number >= inputs.closed_sequence;
            age(number, ALIGN + 1) << 2 | u8::from(answers) << 1 | u8::from(pressed)
        };
        // Sessions end in order, so all sessions before the previous one are equivalent.
        let session = |side: usize, session: u64| (self.sides[side].session - session).min(2) as u8;
        let frame = |key: &mut Vec<u8>, from: usize, frame: Option<&Sent>| {
            let Some(Sent { session: of, sequence, state, clutch, hears, echo, ended }) = frame else {
                return key.push(0xFF);
            };
            // A frame older than the newest of its session is never accepted.
            let newer = self.sides[1 - from].newest.is_none_or(|(newest, _)| {
                newest.session < *of || newest.session == *of && newest.sequence < *sequence
            });
            let flags = [*clutch, *hears, newer, echo.is_some(), *ended];
            key.extend([session(from, *of), number(from, *sequence), state.code()]);
            key.push(flags.iter().fold(0, |bits, flag| bits << 1 | u8::from(*flag)));
            if let Some((of, sequence)) = echo {
                key.extend([session(1 - from, *of), number(1 - from, *sequence)]);
            }
        };
        for side in [MASTER, SLAVE] {
            let Side { ladder, inputs, session: _, newest, asleep, ended, peer_ended } = &self.sides[side];
            let Ladder {
                settings: _,
                state,
                gain: _,
                last_ns: _,
                last_sound_ns,
                // Belongs to the last step, and is in the frame that it sent.
                hears: _,
                ready: _,
                excess_ns: _,
                blind_until_ns,
                opened,
                aligning_ns,
                was_heard,
                apart_since_ns,
                turns,
                holds: _,
                closings,
                history: _,
            } = ladder;
            let blind =
                blind_until_ns.is_some_and(|until| newest.is_none_or(|(_, at)| at * TICK_NS <= until));
            let changed = *closings != inputs.closings;
            let flags = [*opened, inputs.clutch, blind, *asleep, changed, *closings > 0, *ended, *peer_ended];
            let shown = self.shown[side];
            let flags_of_peer = [*turns, *was_heard, shown.was_heard];
            key.push(flags_of_peer.iter().fold(state.code(), |bits, flag| bits << 1 | u8::from(*flag)));
            // Only during a waiting press.
            let apart = |since: Option<u64>| match since {
                Some(since) if *state == LadderState::Aligning => age(since, 2 * ROUND_TRIP),
                _ => 0xF,
            };
            key.push(apart(apart_since_ns.map(|since| since / TICK_NS)) << 4 | apart(shown.apart));
            key.push(flags.iter().fold(0, |bits, flag| bits << 1 | u8::from(*flag)));
            // `last_sound_ns` matters only for HOLD to STOP, and is set again on engaging.
            let sound = last_sound_ns.filter(|_| state.is_coupled() || *state == LadderState::Hold);
            key.push(sound.map_or(0xFF, |at| age(at / TICK_NS, 3)));
            key.push(if *state == LadderState::Aligning { age(aligning_ns / TICK_NS, ALIGN) } else { 0 });
            key.push(newest.map_or(0xFF, |(_, arrived)| age(arrived, 4)));
            frame(&mut key, 1 - side, newest.as_ref().map(|(frame, _)| frame));
            frame(&mut key, side, self.fresh[side].as_ref());
            frame(&mut key, side, self.kept[side].as_ref());
        }
        // A tick is longer than a contact bounce, so the button's times do not matter.
        let Button { level, closed, unknown, released_ns: _, pressed_ns: _ } = self.button;
        let Press { tick, counts, of_this_life } = self.press;
        let old = self.now - tick >= OLD || counts == [false; 2] && !of_this_life;
        let flags = [self.level, unknown, closed, level == Some(true), level.is_none(), of_this_life && !old];
        key.push(flags.iter().fold(0, |bits, flag| bits << 1 | u8::from(*flag)));
        key.push(if old {
            0xFF
        } else {
            age(tick, OLD) << 2 | u8::from(counts[0]) << 1 | u8::from(counts[1])
        });
        key.push(self.events);
        key
    }
}

/// Visit states in order of their number of moves, until no new state is left or `most` states were seen.
fn search(events: u8, most: usize, aligns: bool) -> [[u64; 7]; 2] {
    let mut left: VecDeque<(Pair, u32)> =
        [false, true].map(|pressed| (Pair::start(pressed, events, aligns), 0)).into_iter().collect();
    let mut seen: HashSet<_> = left.iter().map(|(pair, _)| pair.key()).collect();
    let (mut steps, mut deepest, mut reached) = (0_u64, 0, [[0_u64; 7]; 2]);
    while let Some((pair, depth)) = left.pop_front() {
        deepest = depth;
        for side in [MASTER, SLAVE] {
            reached[side][usize::from(pair.sides[side].ladder.state.code())] += 1;
        }
        if seen.len() >= most {
            break;
        }
        for what in pair.moves() {
            steps += 1;
            let mut next = pair.clone();
            if let Err(wrong) = next.does(what) {
                let history =
                    pair.sides.each_ref().map(|side| side.ladder.history.iter().collect::<Vec<_>>());
                panic!("{wrong}, by {what:?}, at {} after {history:#?}\n{next:#?}", pair.now);
            }
            if seen.insert(next.key()) {
                left.push_back((next, depth + 1));
            }
        }
    }
    let all = if left.is_empty() { "complete" } else { "incomplete" };
    println!("{} states ({all}), {steps} steps, {events} events, {deepest} moves", seen.len());
    reached
}

#[test]
fn no_reachable_state_couples_without_a_recent_press() {
    let setting = |name: &str| std::env::var(name).ok().map(|text| text.parse::<usize>().unwrap());
    if let Some(events) = setting("HAPTETHER_SEARCH_EVENTS") {
        for aligns in [false, true] {
            search(events as u8, setting("HAPTETHER_SEARCH_STATES").unwrap_or(usize::MAX), aligns);
        }
        return;
    }
    // Presses and losses only: visit all states. With one restart, stall, fault or stored frame: visit the
    // states that few moves reach.
    for aligns in [false, true] {
        let reached = search(0, usize::MAX, aligns);
        // DISENGAGED, ALIGNING, ENGAGED, HOLD and STOP.
        assert!(
            reached.iter().all(|states| [0, 1, 2, 4, 5].iter().all(|state| states[*state] > 0)),
            "{reached:?}"
        );
        let reached = search(1, 250_000, aligns);
        // DISENGAGED, ALIGNING, ENGAGED and FAULT.
        assert!(
            reached.iter().all(|states| [0, 1, 2, 6].iter().all(|state| states[*state] > 0)),
            "{reached:?}"
        );
    }
}
