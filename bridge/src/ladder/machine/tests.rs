use super::*;
use crate::{LadderInput, PeerReport};
use LadderState::{Aligning, Disengaged, Engaged, Fault, Hold, Stale, Stop};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

/// Input with an engaged peer that hears this side and was heard `age` ms ago, over a link with a smallest
/// age of 1 ms.
fn sound(age: u64) -> LadderInput {
    LadderInput {
        age_ns: Some(age * MS),
        expected_age_ns: MS,
        over_baseline_ns: Some(0),
        round_trip_ns: 2 * MS,
        peer: Some(PeerReport { state: Engaged, hears: true, answers: true, is_current: true }),
        clutch: true,
        needs_answer: false,
        is_press: false,
        ended: false,
        alignment: AlignmentState::Any,
    }
}

fn press() -> LadderInput {
    LadderInput { is_press: true, ..sound(1) }
}

/// Ladder that is engaged, and fully faded in at 300 ms.
fn engaged() -> Ladder {
    let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
    ladder.step(0, &press());
    for now in 1..=300 {
        ladder.step(now * MS, &sound(1));
    }
    assert_eq!(ladder.state(), Engaged);
    assert!((ladder.gain() - 1.0).abs() < 1e-12);
    ladder
}

#[test]
fn silence_leads_down_the_ladder_at_its_times() {
    let mut ladder = engaged();
    let mut last = ladder.gain();
    for silence in 1..=1000 {
        ladder.step((299 + silence) * MS, &sound(silence));
        let expected = match silence {
            0..=6 => Engaged,
            7..=21 => Stale,
            22..=201 => Hold,
            _ => Stop,
        };
        assert_eq!(ladder.state(), expected, "{silence}");
        assert!(ladder.gain() <= last);
        assert!(expected != Stale || ladder.gain() == last, "the gain is constant in STALE");
        last = ladder.gain();
        assert!(silence < 97 || last == 0.0, "the force is zero 100 ms after the last frame");
    }
    assert_eq!(ladder.holds(), 1);
    let reasons: Vec<_> = ladder.history().iter().map(|one| one.reason).collect();
    assert_eq!(
        reasons,
        [
            Reason::ClutchPressed,
            Reason::BothAligned,
            Reason::FramesLate,
            Reason::PeerSilent,
            Reason::SilentTooLong
        ]
    );
}

#[test]
fn long_delay_is_not_silence() {
    let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
    let late = LadderInput { age_ns: Some(500 * MS), expected_age_ns: 500 * MS, ..press() };
    ladder.step(0, &late);
    for now in 1..2000 {
        assert_eq!(ladder.step(now * MS, &LadderInput { is_press: false, ..late }), Engaged);
    }
    ladder.step(2000 * MS, &LadderInput { age_ns: Some(506 * MS), ..late });
    assert_eq!(ladder.state(), Stale);
    ladder.step(2001 * MS, &LadderInput { age_ns: Some(521 * MS), ..late });
    assert_eq!(ladder.state(), Hold);
}

#[test]
fn peer_report_holds_this_side() {
    let report = PeerReport { state: Engaged, hears: true, answers: true, is_current: true };
    for (peer, reason) in [
        (PeerReport { hears: false, ..report }, Reason::PeerDeaf),
        (PeerReport { state: Hold, ..report }, Reason::PeerHolds),
        (PeerReport { state: Stop, ..report }, Reason::PeerStopped),
        (PeerReport { state: Fault, ..report }, Reason::PeerFaulted),
        (PeerReport { state: Disengaged, ..report }, Reason::PeerDisengaged),
    ] {
        let mut ladder = engaged();
        let input = LadderInput { peer: Some(peer), ..sound(1) };
        ladder.step(301 * MS, &input);
        assert_eq!((ladder.state(), ladder.history().last().unwrap().reason), (Hold, reason));
        // A peer that is deaf, in STOP or in FAULT stops this side in the end; a peer in HOLD may hold for
        // any time.
        for now in 302..600 {
            ladder.step(now * MS, &input);
        }
        let stays = peer.hears && matches!(peer.state, Hold | Disengaged);
        assert_eq!(ladder.state(), if stays { Hold } else { Stop }, "{reason:?}");
    }
    let mut ladder = engaged();
    ladder.step(301 * MS, &LadderInput { peer: None, age_ns: None, ..sound(1) });
    assert_eq!(ladder.state(), Hold);
}

/// Old frames hold without a silence. They neither stop the side nor prevent a press from engaging, because
/// engaging sets the baseline to the present age.
#[test]
fn old_news_holds_until_a_press_at_the_new_age() {
    let old = |over| LadderInput { over_baseline_ns: Some(over), ..sound(1) };
    let mut ladder = engaged();
    assert_eq!(ladder.step(301 * MS, &old(20 * MS)), Engaged);
    assert_eq!(ladder.step(302 * MS, &old(20 * MS + 1)), Hold);
    assert_eq!(ladder.history().last().unwrap().reason, Reason::NewsOld);
    for now in 303..1000 {
        assert_eq!(ladder.step(now * MS, &old(900 * MS)), Hold, "the peer is heard");
    }
    ladder.step(1000 * MS, &LadderInput { clutch: false, ..old(900 * MS) });
    assert_eq!(ladder.step(1001 * MS, &LadderInput { is_press: true, ..old(900 * MS) }), Engaged);
    assert_eq!(ladder.step(1002 * MS, &old(0)), Engaged);
    let unknown = LadderInput { over_baseline_ns: None, ..sound(1) };
    assert_eq!(ladder.step(1003 * MS, &unknown), Engaged);
}

/// Inputs that engage a held ladder again, and inputs that do not.
#[test]
fn only_a_press_after_a_release_engages_again() {
    let open = LadderInput { clutch: false, ..sound(1) };
    let deaf = PeerReport { state: Hold, hears: false, answers: true, is_current: true };
    let unaware = PeerReport { state: Engaged, hears: true, answers: false, is_current: true };
    for (held_for, state) in [(30, Hold), (400, Stop)] {
        for (name, inputs, engages) in [
            ("the link is back", vec![sound(1)], false),
            ("the clutch is released", vec![open], false),
            ("an edge without an observed release", vec![press()], false),
            ("released and pressed", vec![open, press()], true),
            (
                "pressed while the link is dead",
                vec![open, LadderInput { age_ns: Some(90 * MS), ..press() }, sound(1)],
                false,
            ),
            (
                "pressed while the peer is deaf",
                vec![open, LadderInput { peer: Some(deaf), ..press() }, sound(1)],
                false,
            ),
            (
                "released before the peer knew",
                vec![LadderInput { peer: Some(unaware), ..open }, press()],
                false,
            ),
            (
                "pressed before the peer knew",
                vec![open, LadderInput { peer: Some(unaware), ..press() }],
                false,
            ),
        ] {
            let mut ladder = engaged();
            for silence in 1..=held_for {
                ladder.step((300 + silence) * MS, &sound(silence + 1));
            }
            assert_eq!(ladder.state(), state);
            for (tick, input) in (1..).zip(&inputs) {
                ladder.step((300 + held_for + tick) * MS, input);
            }
            let expected = if engages { Engaged } else { state };
            assert_eq!(ladder.state(), expected, "{name} in {state:?}");
            let now = (300 + held_for + inputs.len() as u64 + 100) * MS;
            assert_eq!(ladder.step(now, &sound(1)), expected, "{name} in {state:?}, later");
        }
    }
}

#[test]
fn release_disengages_and_press_engages_again() {
    let mut ladder = engaged();
    let open = LadderInput { clutch: false, ..sound(1) };
    for now in 301..=400 {
        assert_eq!(ladder.step(now * MS, &open), Disengaged);
    }
    assert_eq!((ladder.gain(), ladder.holds()), (0.0, 0));
    ladder.step(401 * MS, &press());
    assert_eq!(ladder.state(), Engaged);
    assert!(ladder.gain() <= 1.0 / 200.0 + 1e-12, "it fades in from zero");
}

const ALONE: LadderInput = LadderInput {
    age_ns: None,
    expected_age_ns: MS,
    over_baseline_ns: None,
    round_trip_ns: 0,
    peer: None,
    clutch: true,
    needs_answer: false,
    is_press: false,
    ended: false,
    alignment: AlignmentState::Any,
};

#[test]
fn press_without_peer_waits() {
    let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
    assert_eq!(ladder.step(0, &LadderInput { is_press: true, ..ALONE }), Aligning);
    for now in 1..1000 {
        assert_eq!(ladder.step(now * MS, &ALONE), Aligning);
    }
    let idle = PeerReport { state: Disengaged, hears: true, answers: true, is_current: true };
    ladder.step(1000 * MS, &LadderInput { peer: Some(idle), ..sound(1) });
    assert_eq!(ladder.state(), Aligning, "the peer does not know of the press");
    let stale = PeerReport { state: Engaged, is_current: false, ..idle };
    ladder.step(1001 * MS, &LadderInput { peer: Some(stale), ..sound(1) });
    assert_eq!(ladder.state(), Aligning, "the report is from before the press");
    assert_eq!(ladder.step(1002 * MS, &sound(1)), Engaged);
}

/// Ladder in ALIGNING from 100 ms on; the peer does not know of the press.
fn aligning() -> Ladder {
    let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
    ladder.step(100 * MS, &LadderInput { is_press: true, ..waiting(1) });
    assert_eq!(ladder.state(), Aligning);
    ladder
}

fn waiting(age: u64) -> LadderInput {
    let peer = PeerReport { state: Disengaged, hears: true, answers: true, is_current: true };
    LadderInput { peer: Some(peer), ..sound(age) }
}

const DEAF: PeerReport = PeerReport { state: Disengaged, hears: false, answers: false, is_current: false };

fn refusing(peer: PeerReport) -> LadderInput {
    LadderInput { peer: Some(peer), ..sound(0) }
}

/// The press is at 100 ms, and the peer refuses it from the next tick on. The press ends after refusing
/// frames for two round trips, and at least 50 ms.
///
/// A peer that never heard this side in its run may still hear it.
#[test]
fn refused_press_ends_after_two_round_trips() {
    let stopped = PeerReport { state: Stop, hears: true, answers: true, is_current: false };
    for peer in [DEAF, stopped] {
        for (round_trip_ms, ends_ms) in
            [(0, 151), (2, 151), (25, 151), (26, 153), (500, 1101), (2400, 4901), (2500, 5100)]
        {
            let mut ladder = aligning();
            let input = LadderInput { round_trip_ns: round_trip_ms * MS, ..refusing(peer) };
            for now in 101..ends_ms {
                assert_eq!(
                    ladder.step(now * MS, &input),
                    Aligning,
                    "{peer:?} {round_trip_ms} ms at {now} ms"
                );
            }
            assert_eq!(ladder.step(ends_ms * MS, &input), Disengaged, "{peer:?} {round_trip_ms} ms");
            assert_eq!(ladder.closings(), 1, "a release is necessary");
        }
        // Frames that are missing, and one frame without a refusal.
        let mut ladder = aligning();
        for now in 101..5000 {
            let age = now % 40;
            let input =
                if age == 0 { waiting(0) } else { LadderInput { age_ns: Some(age * MS), ..refusing(peer) } };
            assert_eq!(ladder.step(now * MS, &input), Aligning, "{peer:?} at {now} ms");
        }
        // The peer refused before the press, so it cannot have known of it.
        let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
        ladder.step(0, &waiting(0));
        (1..1000).for_each(|now| _ = ladder.step(now * MS, &LadderInput { clutch: false, ..refusing(peer) }));
        ladder.step(1000 * MS, &LadderInput { is_press: true, ..refusing(peer) });
        let states: Vec<_> = (1001..1100).map(|now| ladder.step(now * MS, &refusing(peer))).collect();
        assert_eq!(states.iter().filter(|state| **state == Aligning).count(), 50, "{peer:?}");
    }
    // A new run of the peer has heard nothing yet, like the first run.
    for restarts in [false, true] {
        let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
        if restarts {
            ladder.step(0, &LadderInput { clutch: false, ..waiting(0) });
            ladder.new_run(MS, false);
        }
        ladder.step(100 * MS, &LadderInput { is_press: true, ..refusing(DEAF) });
        for now in 101..5100 {
            assert_eq!(ladder.step(now * MS, &refusing(DEAF)), Aligning, "{restarts} at {now} ms");
        }
        assert_eq!(ladder.step(5100 * MS, &refusing(DEAF)), Disengaged);
    }
}

/// Each end of a waiting press: its time and reason. After it, only a release and a press couple.
#[test]
fn unanswered_press_ends_and_stops_counting() {
    type Input = fn(u64) -> LadderInput;
    let faulty = PeerReport { state: Fault, hears: true, answers: true, is_current: true };
    let cases: [(&str, Input, u64, Reason); 4] = [
        ("no peer", |_| ALONE, 5100, Reason::AlignTimedOut),
        ("a peer that does not align", |_| waiting(1), 5100, Reason::AlignTimedOut),
        ("a link that was cut", |now| waiting(now - 99), 301, Reason::SilentTooLong),
        ("a peer that no longer hears", |_| refusing(DEAF), 151, Reason::PeerDeaf),
    ];
    let fell = |ladder: &Ladder, reason| {
        assert_eq!((ladder.state(), ladder.history().last().unwrap().reason), (Disengaged, reason));
    };
    let mut fallen = Vec::new();
    for (name, input, ends_ms, reason) in cases {
        let mut ladder = aligning();
        for now in 101..ends_ms {
            assert_eq!(ladder.step(now * MS, &input(now)), Aligning, "{name} at {now} ms");
        }
        ladder.step(ends_ms * MS, &input(ends_ms));
        fell(&ladder, reason);
        fallen.push((name, ladder, ends_ms));
    }
    for master in [true, false] {
        let mut ladder = aligning();
        ladder.new_run(200 * MS, !master);
        fell(&ladder, Reason::PeerRestarted);
        // A slave may follow a restarted master.
        let engages = ladder.clone().step(201 * MS, &press()) == Engaged;
        assert_eq!(engages, !master);
        if master {
            fallen.push(("a peer that was restarted", ladder, 200));
        }
    }
    let mut ladder = aligning();
    ladder.step(200 * MS, &LadderInput { peer: Some(faulty), ..sound(1) });
    fell(&ladder, Reason::PeerFaulted);
    fallen.push(("a peer in fault", ladder, 200));
    for (name, mut ladder, at_ms) in fallen {
        for now in at_ms + 1..at_ms + 20_000 {
            assert_eq!(
                ladder.step(now * MS, &sound(1)),
                Disengaged,
                "{name}: the link by itself couples nothing"
            );
        }
        // A slave sees a press for as long as the master aligns.
        assert_eq!(ladder.step((at_ms + 20_000) * MS, &press()), Disengaged, "{name}: without a release");
        ladder.step((at_ms + 20_001) * MS, &LadderInput { clutch: false, ..sound(1) });
        assert_eq!(ladder.step((at_ms + 20_002) * MS, &press()), Engaged, "{name}: a new press");
    }
}

/// A sleep beyond the timeout of ALIGNING ends the press; frames that arrived meanwhile do not take
/// precedence.
#[test]
fn press_times_out_in_a_loop_that_slept() {
    for (asleep_ms, expected) in [(4900, Engaged), (5000, Disengaged), (30_000, Disengaged)] {
        let mut ladder = aligning();
        let now_ns = (100 + asleep_ms) * MS;
        ladder.stalled(now_ns);
        assert_eq!(ladder.step(now_ns, &sound(0)), if expected == Engaged { Aligning } else { Disengaged });
        assert_eq!(ladder.step(now_ns + 2 * MS, &sound(1)), expected, "{asleep_ms}");
    }
}

#[test]
fn fault_lasts_until_acknowledged_and_clutch_pressed_again() {
    let mut ladder = engaged();
    ladder.fault(301 * MS);
    assert_eq!((ladder.state(), ladder.gain()), (Fault, 0.0));
    let open = LadderInput { clutch: false, ..sound(1) };
    for (tick, input) in [sound(1), open, press(), open].into_iter().enumerate() {
        assert_eq!(ladder.step((302 + tick as u64) * MS, &input), Fault);
    }
    ladder.new_run(310 * MS, true);
    assert_eq!(ladder.state(), Fault, "a restarted master does not end a fault");
    ladder.acknowledge(311 * MS);
    // A slave sees a press for as long as the master aligns; a press from before the acknowledgement must not
    // count.
    assert_eq!(ladder.step(312 * MS, &press()), Disengaged);
    ladder.step(313 * MS, &open);
    assert_eq!(ladder.step(314 * MS, &press()), Engaged);
}

#[test]
fn restarted_master_ends_slave_stop_but_not_vice_versa() {
    for engages in [true, false] {
        let mut ladder = engaged();
        for silence in 1..=400 {
            ladder.step((300 + silence) * MS, &sound(silence + 1));
        }
        assert_eq!(ladder.state(), Stop);
        ladder.new_run(701 * MS, engages);
        ladder.step(702 * MS, &press());
        assert_eq!(ladder.state(), if engages { Engaged } else { Stop });
        assert!(ladder.gain() <= 2.0 / 200.0 + 1e-12);
    }
    // A slave that restarts while the master is engaged holds the master.
    let mut ladder = engaged();
    ladder.new_run(301 * MS, false);
    assert_eq!(ladder.step(302 * MS, &press()), Hold);
}

#[test]
fn a_stall_holds_without_force() {
    let mut ladder = engaged();
    ladder.stalled(360 * MS);
    assert_eq!((ladder.step(360 * MS, &sound(1)), ladder.gain()), (Hold, 0.0));
    assert!(!ladder.hears_peer(), "frames from before the stall are old");
    ladder.step(362 * MS, &sound(1));
    assert!(ladder.hears_peer());
    assert_eq!(ladder.state(), Hold);
}

#[test]
fn peer_end_is_not_a_hold_and_needs_a_new_press() {
    let end = LadderInput { ended: true, peer: None, ..sound(1) };
    let mut ladder = engaged();
    assert_eq!(ladder.step(301 * MS, &end), Disengaged);
    for now in 302..1000 {
        let silent = LadderInput { age_ns: Some((now - 301) * MS), ..end };
        assert_eq!(ladder.step(now * MS, &silent), Disengaged);
    }
    let reasons: Vec<_> = ladder.history().iter().map(|step| step.reason).collect();
    assert_eq!(reasons[2..], [Reason::PeerEnded]);
    assert!(ladder.gain() == 0.0 && ladder.holds() == 0);
    // A clutch that is still pressed must not couple the next peer, and neither may the network.
    ladder.new_run(1000 * MS, false);
    assert_eq!(ladder.step(1001 * MS, &press()), Disengaged);
    ladder.step(1002 * MS, &LadderInput { clutch: false, ..sound(1) });
    assert_eq!(ladder.step(1003 * MS, &press()), Engaged);
    // A hold stays a hold; a fault takes precedence over the end.
    let failed = Some(PeerReport { state: Fault, hears: true, answers: true, is_current: true });
    assert_eq!(ladder.step(1004 * MS, &LadderInput { peer: failed, ..end }), Hold);
    assert_eq!(ladder.step(1005 * MS, &end), Hold);
    assert_eq!(ladder.history().last().map(|step| step.reason), Some(Reason::PeerFaulted));
}

fn any_input() -> impl Strategy<Value = LadderInput> {
    let weighted = prop::bool::weighted(0.8);
    let peer = (0_u8..7, any::<bool>(), weighted, weighted).prop_map(|(code, hears, answers, is_current)| {
        let state = LadderState::from_code(code).unwrap_or(Fault);
        PeerReport { state, hears, answers, is_current }
    });
    let good = PeerReport { state: Engaged, hears: true, answers: true, is_current: true };
    (
        prop_oneof![6 => Just(Some(0_u64)), 3 => (0..400_u64).prop_map(Some), 1 => Just(None)],
        prop_oneof![6 => Just(Some(good)), 3 => peer.prop_map(Some), 1 => Just(None)],
        prop::bool::weighted(0.7),
        prop_oneof![6 => Just(Some(0_u64)), 1 => (0..60_u64).prop_map(Some), 1 => Just(None)],
        prop::bool::weighted(0.03),
        prop::sample::select(vec![
            AlignmentState::Any,
            AlignmentState::Remaining,
            AlignmentState::Reached,
            AlignmentState::TooFar,
        ]),
    )
        .prop_map(|(age, peer, clutch, over, ended, alignment)| LadderInput {
            age_ns: age.map(|age| age * MS),
            expected_age_ns: MS,
            over_baseline_ns: over.map(|over| over * MS),
            round_trip_ns: 2 * MS,
            peer,
            clutch,
            needs_answer: false,
            is_press: false,
            ended,
            alignment,
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// The fast path does the same as the table, before and after any other step.
    #[test]
    fn fast_path_equals_the_table(
        steps in prop::collection::vec((any_input(), 0_u8..22, 0_u64..12, 0_u8..80), 1..120),
        (expected_age_ns, was_blind) in (prop::sample::select(vec![MS, 300 * MS]), any::<bool>()),
    ) {
        let mut ladder = engaged();
        let mut now = 300 * MS;
        prop_assert!(ladder.clone().stays_engaged(now + MS, &sound(1)));
        if was_blind {
            // A stall during a waiting press: frames older than the stall count as silence, also after
            // engaging.
            ladder = Ladder::new(LadderSettings::default()).unwrap();
            let waiting = PeerReport { state: Disengaged, hears: true, answers: true, is_current: false };
            ladder.step(0, &LadderInput { peer: Some(waiting), ..press() });
            ladder.stalled(now);
            for tick in 2..=210 {
                ladder.step(now + tick * MS, &sound(1));
            }
            now += 210 * MS;
            prop_assert_eq!((ladder.state(), ladder.gain() >= 1.0), (Engaged, true));
        }
        for (any, which, wait, act) in steps {
            now += wait * MS / 4;
            match act {
                0 => ladder.fault(now),
                1 => ladder.stalled(now),
                2 => ladder.new_run(now, true),
                3 => ladder.new_run(now, false),
                4 => ladder.withhold(now, any.clutch),
                5 => ladder.acknowledge(now),
                _ => {}
            }
            // Mostly the input of a working peer, so that the ladder often stays engaged; otherwise the same
            // but for one field, or arbitrary.
            let input = match which {
                0 => any,
                1 => LadderInput { age_ns: any.age_ns, ..sound(1) },
                2 => LadderInput { over_baseline_ns: any.over_baseline_ns, ..sound(1) },
                3 => LadderInput { peer: any.peer, ..sound(1) },
                4 => LadderInput { clutch: any.clutch, ..sound(1) },
                5 => LadderInput { ended: any.ended, alignment: any.alignment, ..sound(1) },
                6 => LadderInput { is_press: true, needs_answer: any.clutch, ..sound(1) },
                7 => LadderInput { over_baseline_ns: None, ..sound(6) },
                8 => press(),
                // Around the age that leads to STALE.
                9..12 => sound(u64::from(which) - 4),
                12 => LadderInput { age_ns: Some(u64::MAX), ..sound(1) },
                13 => LadderInput { over_baseline_ns: Some(u64::MAX), ..sound(1) },
                // Over a link with that age.
                14 => LadderInput { age_ns: Some(expected_age_ns), ..sound(1) },
                _ => sound(1),
            };
            let input = LadderInput { expected_age_ns, ..input };
            let mut by_table = ladder.clone();
            let state = by_table.step_by_table(now, input);
            prop_assert_eq!(ladder.step(now, &input), state);
            prop_assert_eq!(&ladder, &by_table);
        }
    }

    /// For all inputs and times: the gain is in 0 to 1 and never jumps up, and only a press engages.
    #[test]
    fn invariants(
        steps in prop::collection::vec((any_input(), 0_u64..40, 0_u8..40), 1..200),
        master in any::<bool>(),
    ) {
        let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
        let settings = *ladder.settings();
        let mut now = 0_u64;
        // This test's own memory of the clutch.
        let (mut was_closed, mut opened, mut pressed) = (false, true, false);
        for (mut input, wait, act) in steps {
            let before = (ladder.state(), ladder.gain());
            now += wait * MS / 4;
            input.is_press = if master { input.clutch && !was_closed } else { input.clutch };
            was_closed = input.clutch;
            match act {
                0 => ladder.fault(now),
                1 => ladder.stalled(now),
                2 => ladder.acknowledge(now),
                3 => ladder.new_run(now, !master),
                _ => {}
            }
            if act == 3 && !master && before.0 != Fault { (opened, pressed) = (true, false); }
            let between = ladder.state();
            if between.is_held() && !before.0.is_held() || before.0 == Fault { (opened, pressed) = (false, false); }
            let count = ladder.history().count();
            ladder.step(now, &input);
            if !input.clutch { (opened, pressed) = (true, false); }
            if input.is_press && opened { pressed = true; }
            for step in ladder.history().iter().skip(count.min(32)) {
                // The ring holds the last 32; the newest are those of this tick.
                if step.time_ns == now && step.to == Engaged && step.from == Aligning {
                    prop_assert!(pressed, "engaged without a press");
                }
            }
            let state = ladder.state();
            if state.is_coupled() && !before.0.is_coupled() { prop_assert!(pressed); }
            if state.is_held() && !between.is_held() { (opened, pressed) = (false, false); }
            if before.0 == Fault && state != Fault { prop_assert_eq!(act, 2); }
            if before.0 == Stop && !matches!(state, Stop | Fault) {
                prop_assert!(pressed || act == 3 && !master);
            }
            let last = ladder.history().last();
            if ladder.history().count() > count && last.is_some_and(|last| last.reason == Reason::PeerEnded) {
                prop_assert_eq!(state, Disengaged);
                (opened, pressed) = (false, false);
            }
            let gain = ladder.gain();
            prop_assert!((0.0..=1.0).contains(&gain));
            prop_assert!(gain - before.1 <= 2.0 * MS as f64 / settings.fade_in_ns as f64 + 1e-12);
            if matches!(state, Stop | Fault) { prop_assert_eq!(gain, 0.0); }
            if state != Engaged { prop_assert!(gain <= before.1); }
            let at_once = matches!(state, Stop | Fault) || act == 1 || act == 0 || act == 3;
            let most = (wait * MS / 4) as f64 / settings.fade_out_ns as f64;
            prop_assert!(at_once || before.1 - gain <= most + 1e-12);
            prop_assert_eq!(ladder.stale_ns() > 0, state == Stale);
        }
    }
}

/// Indicators for the operator: whether a press would count, number of necessary releases, whether a press
/// was unanswered.
#[test]
fn clutch_indicators_are_correct() {
    let settings = LadderSettings { stale_after_ns: 4 * MS, ..LadderSettings::default() };
    let mut ladder = Ladder::new(settings).unwrap();
    assert_eq!(*ladder.settings(), settings);
    assert_eq!((ladder.is_ready(), ladder.closings(), ladder.is_unanswered()), (false, 0, false));
    let open = LadderInput { clutch: false, ..sound(1) };
    let standing = PeerReport { state: Disengaged, hears: true, answers: true, is_current: false };
    let apart = LadderInput { peer: Some(standing), ..open };
    assert_eq!(ladder.step(MS, &apart), Disengaged);
    assert!(ladder.is_ready(), "an open clutch and a sound peer");
    // Pressed and released before the peer answers: not an unanswered press.
    let waiting = LadderInput { clutch: true, ..apart };
    assert_eq!(ladder.step(2 * MS, &LadderInput { is_press: true, ..waiting }), Aligning);
    assert_eq!(ladder.step(3 * MS, &apart), Disengaged);
    assert_eq!((ladder.is_unanswered(), ladder.closings()), (false, 0));
    // Pressed and held until the timeout.
    assert_eq!(ladder.step(4 * MS, &LadderInput { is_press: true, ..waiting }), Aligning);
    let mut now = 5;
    while ladder.step(now * MS, &waiting) == Aligning {
        now += 10;
        assert!(now < 10_000);
    }
    assert_eq!(ladder.state(), Disengaged);
    assert_eq!((ladder.is_unanswered(), ladder.closings()), (true, 1));
    now += 1;
    ladder.step(now * MS, &apart);
    assert_eq!((ladder.is_ready(), ladder.is_unanswered()), (true, true));
    now += 1;
    ladder.step(now * MS, &LadderInput { age_ns: Some(5_000 * MS), ..apart });
    assert!(!ladder.is_ready(), "the peer is silent");
    // Coupled, then held: another release is necessary.
    now += 1;
    ladder.step(now * MS, &LadderInput { is_press: true, ..sound(1) });
    now += 1;
    assert_eq!(ladder.step(now * MS, &sound(1)), Engaged);
    assert_eq!((ladder.is_unanswered(), ladder.closings()), (false, 1));
    now += 100;
    assert_eq!(ladder.step(now * MS, &sound(100)), Hold);
    assert_eq!(ladder.closings(), 2);
}

#[test]
fn vanished_peer_is_silent_since_last_sound() {
    let mut ladder = engaged();
    let unknown = LadderInput { age_ns: None, over_baseline_ns: None, peer: None, ..sound(0) };
    let states: Vec<_> = (301..=600).map(|now| ladder.step(now * MS, &unknown)).collect();
    assert_eq!((states[0], states[199], states[200]), (Hold, Hold, Stop));
}

#[test]
fn press_at_the_end_of_another_does_not_count() {
    let align_ns = LadderSettings::default().align_ns;
    let standing = PeerReport { state: Disengaged, hears: true, answers: true, is_current: false };
    let waiting = LadderInput { peer: Some(standing), ..sound(1) };
    let again = LadderInput { is_press: true, ..waiting };
    for ended in [false, true] {
        let mut ladder = Ladder::new(LadderSettings::default()).unwrap();
        ladder.step(0, &LadderInput { clutch: false, ..waiting });
        assert_eq!(ladder.step(MS, &again), Aligning);
        assert_eq!(ladder.step(2 * MS, &waiting), Aligning);
        let (at_ns, last) =
            if ended { (3 * MS, LadderInput { ended, ..again }) } else { (MS + align_ns, again) };
        assert_eq!(ladder.step(at_ns, &last), Disengaged, "{ended}");
        assert_eq!(ladder.closings(), 1);
    }
}
