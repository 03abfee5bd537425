//! Play-out against closed forms, brute force and links of known parameters.

use haptether_netsim::{Direction, Distribution, Link, LinkSettings, Packet, Verdict};
use proptest::prelude::*;

use super::*;

const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;

/// Sequence, send time on the sender's clock, arrival on ours; in order of arrival.
type Trace = Vec<(u64, u64, u64)>;

/// The sender's clock: an hour ahead, and `ppb` faster.
fn sender_clock(own_ns: u64, ppb: i64) -> u64 {
    (own_ns + 3_600 * S).checked_add_signed(own_ns.cast_signed() / 1000 * ppb / 1_000_000).unwrap()
}

fn through_link(settings: &LinkSettings, seed: u64, count: u64, ppb: i64) -> Trace {
    let mut link = Link::new(Direction::Forward, seed, settings).unwrap();
    let mut trace: Trace = (0..count)
        .filter_map(|index| {
            let sent_ns = index * MS;
            match link.judge(&Packet { direction: Direction::Forward, sent_ns, size: 100, index }).verdict {
                Verdict::Deliver { at_ns } => Some((index, sender_clock(sent_ns, ppb), at_ns)),
                Verdict::Drop { .. } => None,
            }
        })
        .collect();
    trace.sort_by_key(|&(index, _, at_ns)| (at_ns, index));
    trace
}

fn play(settings: PlayoutSettings, trace: &Trace, tick_ns: u64) -> (Vec<Played<u64>>, PlayoutCounts) {
    let mut playout = Playout::new(settings).unwrap();
    let mut played = Vec::new();
    let mut packets = trace.iter().peekable();
    let end = trace.last().unwrap().2 + S;
    let mut now = 0;
    while now < end {
        while let Some(&&(sequence, sent_ns, at_ns)) = packets.peek().filter(|packet| packet.2 <= now) {
            playout.arrived(sequence, sent_ns, at_ns, sequence);
            packets.next();
        }
        while let Some(packet) = playout.next_due(now) {
            assert!(packet.play_ns <= now && packet.payload == packet.sequence);
            played.push(packet);
        }
        now += tick_ns;
    }
    (played, playout.counts())
}

fn jittery(delay_s: f64, jitter_s: f64) -> LinkSettings {
    let jitter_correlation_s = Some(0.0);
    LinkSettings {
        delay_s,
        jitter_s,
        jitter_correlation_s,
        distribution: Distribution::Uniform,
        ..LinkSettings::default()
    }
}

#[test]
fn play_is_exactly_periodic_for_jitter_within_the_delay() {
    // Uniform over 2 sqrt(3) 1.5 ms = 5.2 ms, in order or not.
    for (seed, keep_order) in [(1, true), (2, false), (3, true), (4, false)] {
        let link = LinkSettings { keep_order, ..jittery(0.03, 0.0015) };
        let trace = through_link(&link, seed, 20_000, 0);
        let (played, counts) = play(PlayoutSettings::new(6 * MS), &trace, MS);
        assert_eq!((counts.played, counts.late, counts.missing, counts.anew), (20_000, 0, 0, 0));
        let settled: Vec<_> = played.iter().filter(|packet| packet.play_ns > 2 * S).collect();
        assert!(settled.len() > 17_000);
        assert!(settled.windows(2).all(|pair| pair[1].play_ns - pair[0].play_ns == MS && pair[1].gap == 0));
        // The minimum delay of thousands of packets is near the lowest possible, 30 - 2.6 ms, plus the 6 ms.
        let delay = settled[0].play_ns - settled[0].sequence * MS;
        assert!(delay.abs_diff(33_402_000) < 600_000, "{delay}");
    }
}

#[test]
fn delay_stays_constant_despite_drift() {
    for ppb in [100_000, -100_000] {
        let trace = through_link(&jittery(0.03, 0.0005), 5, 120_000, ppb);
        let (played, counts) = play(PlayoutSettings::new(5 * MS), &trace, MS);
        assert_eq!((counts.late, counts.missing, counts.anew), (0, 0, 0), "{ppb}");
        for packet in played.iter().filter(|packet| packet.play_ns > 2 * S) {
            // The clocks drift apart by 12 ms in 120 s. The window lags by at most 10 s of drift, 1 ms, and the
            // play-out by the tolerance of 0.5 ms. The minimum delay is 0.87 ms below the mean.
            let delay = packet.play_ns - packet.sequence * MS;
            assert!(delay.abs_diff(30 * MS - 866_000 + 5 * MS) < 1_700_000, "{ppb}: {delay}");
        }
    }
}

#[test]
fn losses_are_gaps() {
    let link = LinkSettings { loss: 0.2, ..jittery(0.01, 0.001) };
    let trace = through_link(&link, 3, 10_000, 0);
    let (played, counts) = play(PlayoutSettings::new(8 * MS), &trace, MS / 4);
    let arrived = trace.len() as u64;
    assert_eq!(counts.played + counts.superseded + counts.late, arrived);
    let gaps: u64 = played.iter().map(|packet| packet.gap).sum();
    // From the smallest sequence, which a newer one may have superseded before it was played.
    let first = trace.iter().map(|(sequence, ..)| *sequence).min().unwrap();
    let span = played.last().unwrap().sequence - first + 1;
    assert_eq!(counts.missing, gaps);
    assert_eq!(counts.played + counts.superseded + gaps, span);
}

#[test]
fn longer_path_is_learnt_after_200_ms() {
    let trace: Trace =
        (0..5_000u64).map(|n| (n, n * MS, n * MS + if n < 2_000 { 20 } else { 60 } * MS)).collect();
    let (played, counts) = play(PlayoutSettings::new(5 * MS), &trace, MS);
    // Late until 200 ms after the first late one.
    assert_eq!((counts.anew, counts.late, counts.missing), (1, 200, 200));
    let last = played.last().unwrap();
    assert_eq!(last.play_ns - last.sequence * MS, 65 * MS);
    assert_eq!(played.iter().find(|packet| packet.sequence > 2_100).unwrap().gap, 200);
}

#[test]
fn step_of_senders_clock_restarts_play() {
    for step in [-1000 * S.cast_signed(), 1000 * S.cast_signed()] {
        let trace: Trace = (0..4_000u64)
            .map(|n| {
                let sent = 2_000 * S + n * MS;
                (n, if n < 2_000 { sent } else { sent.checked_add_signed(step).unwrap() }, n * MS + 20 * MS)
            })
            .collect();
        let (played, counts) = play(PlayoutSettings::new(5 * MS), &trace, MS);
        assert_eq!((counts.anew, counts.played + counts.missing), (1, 4_000), "{step}");
        // Backwards, all are late for 200 ms; forwards, waiting packets are dropped.
        assert!(played.len() >= 3_790, "{counts:?}");
        assert_eq!(played.last().unwrap().sequence, 3_999);
    }
}

#[test]
fn invalid_settings_are_refused() {
    let none = PlayoutSettings::new(0);
    let cases = [
        (PlayoutSettings { capacity: 0, ..none }, "capacity = 0: must be from 1 to 1048576 sequences"),
        (
            PlayoutSettings { slew_ppb: 1_000_000_000, ..none },
            "slew_ppb = 1000000000: must be below 1000000000, or time runs backwards",
        ),
    ];
    for (settings, message) in cases {
        assert_eq!(Playout::<u8>::new(settings).unwrap_err().to_string(), message);
    }
    let mut playout = Playout::new(none).unwrap();
    assert_eq!(playout.arrived(0, u64::MAX, 0, ()), Arrival::Refused);
    assert_eq!(playout.arrived(u64::MAX, 0, 0, ()), Arrival::Refused);
    assert_eq!(playout.arrived(u64::MAX - 1, 0, 0, ()), Arrival::Queued);
    assert_eq!(playout.next_due(0).unwrap().sequence, u64::MAX - 1);
}

proptest! {
    /// By brute force: the minimum over the blocks that the window touches.
    #[test]
    fn window_minimum_is_minimum_of_last_eight_blocks(
        steps in prop::collection::vec((0u64..400, -50i64..50), 1..300)
    ) {
        let mut window = WindowMinimum::new(800);
        let mut now = 0;
        let mut all = Vec::new();
        for (step, key) in steps {
            now += step;
            window.add(now, key);
            all.push((now / 100, key, now));
            let wanted = all.iter().filter(|(block, ..)| block + 8 > now / 100).map(|&(_, key, _)| key).min();
            prop_assert_eq!(window.least(), wanted);
        }
    }

    /// Numbers at the ends of 64 bits are counted or refused without overflow.
    #[test]
    fn any_numbers_are_accepted_or_refused(
        delay_ns in prop::sample::select(vec![0, 5 * MS, u64::MAX]),
        packets in prop::collection::vec(
            (prop_oneof![0..9_u64, u64::MAX - 9..=u64::MAX, any::<u64>()],
             prop_oneof![0..9_u64, any::<u64>(), (1 << 63) - 9..=(1 << 63) + 9_u64],
             prop_oneof![0..9 * S, 0..1_u64 << 62]),
            1..50,
        ),
    ) {
        let settings = PlayoutSettings { capacity: 16, ..PlayoutSettings::new(delay_ns) };
        let mut playout = Playout::new(settings).unwrap();
        let mut now = 0_u64;
        for (sequence, sent_ns, step) in packets {
            now = now.saturating_add(step);
            playout.arrived(sequence, sent_ns, now, ());
            while playout.next_due(now).is_some() {}
        }
    }

    /// For any arrivals: play is forward in sequence and time, and every packet and sequence is counted once.
    #[test]
    fn play_only_goes_forward(
        delay_ns in prop::sample::select(vec![0, 5 * MS, 50 * MS]),
        packets in prop::collection::vec((0u64..200, 0u64..80, 0u64..3), 1..400)
    ) {
        let settings = PlayoutSettings { capacity: 16, ..PlayoutSettings::new(delay_ns) };
        let mut playout = Playout::new(settings).unwrap();
        let (mut now, mut last, mut total) = (0, None, 0);
        for (sequence, sent, step) in packets {
            now += step * MS;
            playout.arrived(sequence, sent * MS, now, ());
            total += 1;
            while let Some(played) = playout.next_due(now) {
                prop_assert!(last.is_none_or(|last| played.sequence > last));
                prop_assert!(played.play_ns <= now);
                last = Some(played.sequence);
            }
        }
        while playout.next_due(now + 20 * S).is_some() {}
        let counts = playout.counts();
        let used = counts.played + counts.superseded + counts.overflowed;
        prop_assert_eq!(used + counts.late + counts.duplicate, total);
    }
}

#[test]
fn silence_of_centuries_clears_the_window_at_once() {
    let mut window = WindowMinimum::new(8);
    window.add(0, -5);
    window.add(u64::MAX, 7);
    assert_eq!(window.least(), Some(7));
}
