//! Play-out and statistics against closed forms, brute force and links of known truth.

use haptether_netsim::{Direction, Distribution, Link, LinkSettings, Packet, Verdict};
use proptest::prelude::*;

use super::*;

const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;

/// Sequence, sending time on the sender's clock, arrival on ours; in the order of arrival.
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

/// Plays a trace in ticks of `tick_ns`.
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
fn a_constant_delay_is_exactly_periodic_when_the_jitter_is_within_it() {
    // Uniform over 2 sqrt(3) 1.5 ms = 5.2 ms, in order or not.
    for (seed, keep_order) in [(1, true), (2, false), (3, true), (4, false)] {
        let link = LinkSettings { keep_order, ..jittery(0.03, 0.0015) };
        let trace = through_link(&link, seed, 20_000, 0);
        let constant = PlayoutPolicy::Constant { delay_ns: 6 * MS };
        let (played, counts) = play(PlayoutSettings::new(constant), &trace, MS);
        assert_eq!((counts.played, counts.late, counts.missing, counts.anew), (20_000, 0, 0, 0));
        let settled: Vec<_> = played.iter().filter(|packet| packet.play_ns > 2 * S).collect();
        assert!(settled.len() > 17_000);
        assert!(settled.windows(2).all(|pair| pair[1].play_ns - pair[0].play_ns == MS && pair[1].gap == 0));
        // The least delay of thousands of packets is near the lowest possible, 30 - 2.6 ms; to it come the 6 ms.
        let delay = settled[0].play_ns - settled[0].sequence * MS;
        assert!(delay.abs_diff(33_402_000) < 600_000, "{delay}");
    }
}

#[test]
fn drifting_clocks_leave_the_constant_delay_where_it_is() {
    for ppb in [100_000, -100_000] {
        let trace = through_link(&jittery(0.03, 0.0005), 5, 120_000, ppb);
        let constant = PlayoutPolicy::Constant { delay_ns: 5 * MS };
        let (played, counts) = play(PlayoutSettings::new(constant), &trace, MS);
        assert_eq!((counts.late, counts.missing, counts.anew), (0, 0, 0), "{ppb}");
        for packet in played.iter().filter(|packet| packet.play_ns > 2 * S) {
            // In 120 s the clocks part by 12 ms. The window lags by at most 10 s of drift, 1 ms; beyond the tolerance
            // of 0.5 ms the play-out follows; the least delay is 0.87 ms below the mean.
            let delay = packet.play_ns - packet.sequence * MS;
            assert!(delay.abs_diff(30 * MS - 866_000 + 5 * MS) < 1_700_000, "{ppb}: {delay}");
        }
    }
}

#[test]
fn the_adaptive_delay_grows_with_the_jitter_and_stays_in_bounds() {
    let adaptive = PlayoutPolicy::Adaptive { factor: 4, least_ns: MS, most_ns: 40 * MS };
    let mut last_delay = 0;
    for jitter_s in [0.0, 0.001, 0.004, 0.03] {
        let link = LinkSettings { keep_order: false, ..jittery(0.1, jitter_s) };
        let trace = through_link(&link, 9, 30_000, 0);
        let (played, counts) = play(PlayoutSettings::new(adaptive), &trace, MS);
        let last = played.last().unwrap();
        let least = trace.iter().map(|&(sequence, _, at_ns)| at_ns - sequence * MS).min().unwrap();
        let delay = last.play_ns - last.sequence * MS - least;
        assert!((MS - 500_000..=40 * MS + 500_000).contains(&delay), "{jitter_s}: {delay}");
        assert!(delay > last_delay, "{jitter_s}: {delay}");
        last_delay = delay;
        // Uniform jitter of half width w has mean deviation w / 2: 4 of them reach to 2 w above the mean.
        if jitter_s < 0.01 {
            assert!(counts.late < 60, "{jitter_s}: {counts:?}");
        }
        assert!(played.windows(2).all(|pair| pair[0].play_ns <= pair[1].play_ns), "{jitter_s}");
    }
}

/// Delay that wanders over seconds, with next to no jitter from packet to packet.
#[test]
fn a_slow_wander_is_waited_for_too() {
    let adaptive = PlayoutPolicy::Adaptive { factor: 4, least_ns: MS, most_ns: 100 * MS };
    let trace: Trace = (0..60_000u64)
        .map(|n| {
            let phase = n % 2000;
            (n, n * MS, n * MS + 20 * MS + phase.min(2000 - phase) * 10_000)
        })
        .collect();
    let (_, counts) = play(PlayoutSettings::new(adaptive), &trace, MS);
    assert!(counts.late < 600, "{counts:?}");
}

#[test]
fn losses_are_told_as_gaps() {
    let link = LinkSettings { loss: 0.2, ..jittery(0.01, 0.001) };
    let trace = through_link(&link, 3, 10_000, 0);
    for policy in [PlayoutPolicy::Newest, PlayoutPolicy::Constant { delay_ns: 8 * MS }] {
        let (played, counts) = play(PlayoutSettings::new(policy), &trace, MS / 4);
        let arrived = trace.len() as u64;
        assert_eq!(counts.played + counts.superseded + counts.late, arrived);
        let gaps: u64 = played.iter().map(|packet| packet.gap).sum();
        // From what arrived first, which a newer one may have superseded before it was played.
        let first = trace.iter().map(|(sequence, ..)| *sequence).min().unwrap();
        let span = played.last().unwrap().sequence - first + 1;
        assert_eq!(counts.missing, gaps);
        assert_eq!(counts.played + counts.superseded + gaps, span, "{policy:?}");
    }
}

#[test]
fn a_path_that_became_longer_is_learnt_after_a_while() {
    let trace: Trace =
        (0..5_000u64).map(|n| (n, n * MS, n * MS + if n < 2_000 { 20 } else { 60 } * MS)).collect();
    let constant = PlayoutPolicy::Constant { delay_ns: 5 * MS };
    let (played, counts) = play(PlayoutSettings::new(constant), &trace, MS);
    // Late until 200 ms have passed since the first late one.
    assert_eq!((counts.anew, counts.late, counts.missing), (1, 200, 200));
    let last = played.last().unwrap();
    assert_eq!(last.play_ns - last.sequence * MS, 65 * MS);
    assert_eq!(played.iter().find(|packet| packet.sequence > 2_100).unwrap().gap, 200);
}

#[test]
fn a_step_of_the_senders_clock_starves_nobody() {
    for step in [-1000 * S.cast_signed(), 1000 * S.cast_signed()] {
        let trace: Trace = (0..4_000u64)
            .map(|n| {
                let sent = 2_000 * S + n * MS;
                (n, if n < 2_000 { sent } else { sent.checked_add_signed(step).unwrap() }, n * MS + 20 * MS)
            })
            .collect();
        let (played, counts) =
            play(PlayoutSettings::new(PlayoutPolicy::Constant { delay_ns: 5 * MS }), &trace, MS);
        assert_eq!((counts.anew, counts.played + counts.missing), (1, 4_000), "{step}");
        // Back, all are late for 200 ms; forth, what waited is dropped.
        assert!(played.len() >= 3_790, "{counts:?}");
        assert_eq!(played.last().unwrap().sequence, 3_999);
    }
}

#[test]
fn settings_that_play_nothing_are_refused() {
    let newest = PlayoutSettings::new(PlayoutPolicy::Newest);
    let backwards = PlayoutPolicy::Adaptive { factor: 4, least_ns: 2, most_ns: 1 };
    let cases = [
        (PlayoutSettings { capacity: 0, ..newest }, "capacity = 0: must be from 1 to 1048576 sequences"),
        (
            PlayoutSettings { slew_ppb: 1_000_000_000, ..newest },
            "slew_ppb = 1000000000: must be below 1000000000, or time runs backwards",
        ),
        (PlayoutSettings::new(backwards), "least_ns = 2: must be at most most_ns = 1"),
    ];
    for (settings, message) in cases {
        assert_eq!(Playout::<u8>::new(settings).unwrap_err().to_string(), message);
    }
    let mut playout = Playout::new(newest).unwrap();
    assert_eq!(playout.arrived(0, u64::MAX, 0, ()), Arrival::Refused);
    assert_eq!(playout.arrived(u64::MAX, 0, 0, ()), Arrival::Refused);
    assert_eq!(playout.arrived(u64::MAX - 1, 0, 0, ()), Arrival::Queued);
    assert_eq!(playout.next_due(0).unwrap().sequence, u64::MAX - 1);
}

#[test]
fn statistics_of_a_link_are_what_its_settings_say() {
    let link = LinkSettings { loss: 0.05, keep_order: false, ..jittery(0.05, 0.002) };
    let count = 100_000;
    let trace = through_link(&link, 11, count, 0);
    let mut meter = PathMeter::new();
    for &(sequence, sent_ns, at_ns) in &trace {
        meter.arrived(sequence, sent_ns, at_ns);
    }
    let end = trace.last().unwrap().2;
    let statistics = meter.statistics(end);
    assert_eq!(statistics.received, trace.len() as u64);
    assert_eq!(statistics.expected, statistics.received + statistics.losses.lost);
    // Independent losses: five standard deviations of a binomial; bursts are geometric of mean 1 / (1 - p).
    assert!((statistics.loss() - 0.05).abs() < 5.0 * (0.05 * 0.95 / count as f64).sqrt());
    assert!((statistics.losses.mean() - 1.0 / 0.95).abs() < 0.02);
    assert!((statistics.rate_hz - 950.0).abs() < 5.0);
    assert!(statistics.reordering.reordered > 0);
    assert_eq!(meter.statistics(end + S).worst_gap_ns, S);
}

#[test]
fn independent_uniform_delays_have_the_jitter_of_their_law() {
    // Packets 20 ms apart never pass each other; |D| of two uniform delays of half width w has mean 2 w / 3.
    let mut link = Link::new(Direction::Forward, 4, &jittery(0.05, 0.001)).unwrap();
    let mut meter = PathMeter::new();
    let (mut sum, count) = (0, 20_000);
    for index in 0..count {
        let sent_ns = index * 20 * MS;
        let verdict = link.judge(&Packet { direction: Direction::Forward, sent_ns, size: 1, index }).verdict;
        let Verdict::Deliver { at_ns } = verdict else { panic!("no loss was set") };
        meter.arrived(index, sent_ns, at_ns);
        sum += meter.statistics(at_ns).jitter_ns;
    }
    let mean = sum as f64 / count as f64;
    let wanted = 2.0 / 3.0 * 3_f64.sqrt() * 1e6;
    // Deviation of |D| is 0.47 w; the differences are not independent, hence 5 of twice as much.
    assert!(
        (mean - wanted).abs() < 5.0 * 2.0 * 0.47 * 1.73e6 / (count as f64).sqrt() + 30.0,
        "{mean} of {wanted}"
    );
}

/// Everything by its definition, over the whole trace.
fn by_definition(sequences: &[u64]) -> (u64, u64, u64, u64, u64, u64, u64) {
    let mut unique: Vec<u64> = Vec::new();
    let mut duplicate = 0;
    for &sequence in sequences {
        if unique.contains(&sequence) {
            duplicate += 1;
        } else {
            unique.push(sequence);
        }
    }
    let (mut lost, mut bursts, mut longest, mut run) = (0, 0, 0, 0);
    for sequence in unique[0]..=*unique.iter().max().unwrap() {
        run = if unique.contains(&sequence) { 0 } else { run + 1 };
        lost += u64::from(run > 0);
        bursts += u64::from(run == 1);
        longest = longest.max(run);
    }
    let extents = (0..unique.len()).filter_map(|i| (0..i).find(|&j| unique[j] > unique[i]).map(|j| i - j));
    let extents: Vec<u64> = extents.map(|extent| extent as u64).collect();
    (
        duplicate,
        lost,
        bursts,
        longest,
        extents.len() as u64,
        extents.iter().sum(),
        extents.into_iter().max().unwrap_or(0),
    )
}

proptest! {
    #[test]
    fn statistics_are_what_their_definitions_say(
        first in 0u64..1 << 40,
        order in prop::collection::vec(0u64..300, 1..400)
    ) {
        // The first to arrive is the least: those before it are not expected.
        let mut sequences: Vec<u64> = order.iter().map(|n| first + 1 + n).collect();
        sequences.insert(0, first);
        let mut meter = PathMeter::new();
        for &sequence in &sequences {
            meter.arrived(sequence, 0, 0);
        }
        let found = meter.statistics(0);
        let seen = (
            found.duplicate, found.losses.lost, found.losses.bursts, found.losses.longest,
            found.reordering.reordered, found.reordering.extent_sum, found.reordering.longest_extent,
        );
        prop_assert_eq!(seen, by_definition(&sequences));
    }

    /// Beyond the window as well, if nothing comes that late.
    #[test]
    fn losses_that_left_the_window_stay_counted(steps in prop::collection::vec(1u64..3000, 1..40)) {
        let mut sequences = vec![7];
        for step in steps {
            sequences.push(sequences[sequences.len() - 1] + step);
        }
        let mut meter = PathMeter::new();
        for &sequence in &sequences {
            meter.arrived(sequence, 0, 0);
        }
        let losses = meter.statistics(0).losses;
        let gaps: Vec<u64> = sequences.windows(2).map(|pair| pair[1] - pair[0] - 1).filter(|&gap| gap > 0).collect();
        prop_assert_eq!(losses.lost, gaps.iter().sum::<u64>());
        prop_assert_eq!(losses.bursts, gaps.len() as u64);
        prop_assert_eq!(losses.longest, gaps.into_iter().max().unwrap_or(0));
    }

    /// Numbers at the ends of 64 bits: counted or refused, but no overflow.
    #[test]
    fn any_numbers_are_borne(
        packets in prop::collection::vec(
            (prop_oneof![0..9_u64, u64::MAX - 9..=u64::MAX, any::<u64>()],
             prop_oneof![0..9_u64, any::<u64>(), (1 << 63) - 9..=(1 << 63) + 9_u64],
             prop_oneof![0..9 * S, 0..1_u64 << 62]),
            1..50,
        ),
    ) {
        let policies = [
            PlayoutPolicy::Newest,
            PlayoutPolicy::Constant { delay_ns: u64::MAX },
            PlayoutPolicy::Adaptive { factor: u32::MAX, least_ns: 0, most_ns: u64::MAX },
        ];
        for policy in policies {
            let settings = PlayoutSettings { capacity: 16, ..PlayoutSettings::new(policy) };
            let mut playout = Playout::new(settings).unwrap();
            let mut meter = PathMeter::new();
            let mut now = 0_u64;
            for &(sequence, sent_ns, step) in &packets {
                now = now.saturating_add(step);
                meter.arrived(sequence, sent_ns, now);
                playout.arrived(sequence, sent_ns, now, ());
                while playout.next_due(now).is_some() {}
                let seen = meter.statistics(now);
                prop_assert!(seen.losses.lost <= seen.expected && seen.rate_hz.is_finite());
            }
            let seen = meter.statistics(now);
            prop_assert_eq!(seen.received + seen.duplicate + seen.too_late, packets.len() as u64);
        }
    }

    /// Whatever arrives and when: forward in sequence and in time, and every packet and sequence is counted once.
    #[test]
    fn what_is_played_only_goes_forward(
        policy in prop::sample::select(vec![
            PlayoutPolicy::Newest,
            PlayoutPolicy::Constant { delay_ns: 5 * MS },
            PlayoutPolicy::Adaptive { factor: 4, least_ns: 0, most_ns: 50 * MS },
        ]),
        packets in prop::collection::vec((0u64..200, 0u64..80, 0u64..3), 1..400)
    ) {
        let settings = PlayoutSettings { capacity: 16, ..PlayoutSettings::new(policy) };
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
