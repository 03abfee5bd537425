//! Peer clock, packet age and path statistics against closed forms, and on random paths.

use haptether_netsim::{Direction, Distribution, Link, LinkSettings, Packet, Verdict};
use proptest::prelude::*;

use super::*;

const US: u64 = 1000;
const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;

/// Peer's clock: ahead by `ahead_ns`, faster by `ppb`.
#[derive(Clone, Copy)]
struct Peer {
    ahead_ns: u64,
    ppb: i64,
}

impl Peer {
    fn at(self, own_ns: u64) -> u64 {
        let drifted = i128::from(own_ns) * i128::from(self.ppb) / i128::from(BILLION);
        (own_ns + self.ahead_ns).checked_add_signed(i64::try_from(drifted).unwrap()).unwrap()
    }

    fn exchange(self, sent_ns: u64, forward_ns: u64, held_ns: u64, backward_ns: u64) -> TimestampExchange {
        let there = sent_ns + forward_ns;
        TimestampExchange {
            sent_ns,
            peer_received_ns: self.at(there),
            peer_sent_ns: self.at(there + held_ns),
            received_ns: there + held_ns + backward_ns,
        }
    }

    fn error(self, clock: &PeerClock, now_ns: u64) -> (i64, u64) {
        let known = clock.offset(now_ns).unwrap();
        (known.offset_ns - difference(self.at(now_ns), now_ns), known.bound_ns)
    }
}

#[test]
fn an_asymmetric_delay_costs_half_the_asymmetry() {
    for (forward, backward) in [(10 * MS, 10 * MS), (30 * MS, 10 * MS), (0, 50 * MS), (7, 4)] {
        for ahead_ns in [0, 3_600 * S, 1 << 61] {
            let peer = Peer { ahead_ns, ppb: 0 };
            let mut clock = PeerClock::new(MAX_DRIFT_PPB);
            for n in 1..5_000 {
                assert_eq!(clock.take(&peer.exchange(n * MS, forward, n % 7 * US, backward)), Ok(true));
            }
            let (error, bound) = peer.error(&clock, 5 * S);
            let half = (forward.cast_signed() - backward.cast_signed()) / 2;
            // The upper line, older by the round trip, has relaxed by 200 ppm of it: half of that, plus rounding.
            let parted = (forward + backward + 6 * US).cast_signed() / 10_000 + 3;
            assert!((half - 3..=half + parted).contains(&error), "{error} of {half}");
            assert!(error.unsigned_abs() <= bound);
        }
    }
}

/// A day with clocks at their limits and queues of up to 20 ms in each direction.
#[test]
fn a_day_of_drift_stays_within_the_bound() {
    for ppb in [100_000, -100_000, 0] {
        let peer = Peer { ahead_ns: 86_400 * S, ppb };
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        let mut random = 88_172_645_463_325_252_u64;
        let mut queue = || {
            random ^= random << 13;
            random ^= random >> 7;
            random ^= random << 17;
            random % (20 * MS)
        };
        let mut worst = 0;
        for n in 0..86_400 * 10 {
            let sent = n * 100 * MS;
            let times = peer.exchange(sent, 15 * MS + queue(), n % 5 * MS, 10 * MS + queue());
            clock.take(&times).unwrap();
            let (error, bound) = peer.error(&clock, times.received_ns);
            assert!(error.unsigned_abs() <= bound, "{ppb} at {n}: {error} of {bound}");
            assert!(bound < 36 * MS);
            if n > 10 * 600 {
                worst = worst.max((error - 2_500_000).unsigned_abs());
            }
        }
        // A queue of s ms has probability s / 20. A line relaxes by at most 0.03 ms between exchanges. The least of
        // 60, up to 1.8 ms old, exceeds 14 ms with (14 / 20)^60 = 5e-10. An error of 8 ms needs that.
        assert!(worst < 8 * MS, "{ppb}: {worst}");
    }
}

#[test]
fn error_without_queues_is_drift_within_an_exchange() {
    for ppb in [100_000, -100_000] {
        let peer = Peer { ahead_ns: S, ppb };
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        for n in 0..600_000 {
            clock.take(&peer.exchange(n * MS, 10 * MS, 100 * US, 10 * MS)).unwrap();
        }
        // Half of 200 ppm of the upper line, 20.1 ms old, plus half of the 100 ppm drift meanwhile, plus rounding.
        assert!(peer.error(&clock, 600 * S).0.unsigned_abs() < 2_010 + 1_005 + 10);
    }
}

#[test]
fn netsim_links_are_measured_within_the_bound() {
    for seed in 0..4 {
        let settings = LinkSettings {
            delay_s: 0.02,
            jitter_s: 0.002,
            distribution: Distribution::Uniform,
            loss: 0.1,
            ..LinkSettings::default()
        };
        let mut links = [Direction::Forward, Direction::Backward]
            .map(|direction| (direction, Link::new(direction, seed, &settings).unwrap()));
        let mut pass = |path: usize, index, sent_ns| {
            let (direction, link) = &mut links[path];
            match link.judge(&Packet { direction: *direction, sent_ns, size: 100, index }).verdict {
                Verdict::Deliver { at_ns } => Some(at_ns),
                Verdict::Drop { .. } => None,
            }
        };
        let peer = Peer { ahead_ns: 77 * S, ppb: 50_000 };
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        for index in 0..60_000 {
            // Far enough apart that no packet meets another.
            let sent_ns = index * 10 * MS;
            let Some(there) = pass(0, index, sent_ns) else { continue };
            let Some(received_ns) = pass(1, index, there) else { continue };
            let times = TimestampExchange {
                sent_ns,
                peer_received_ns: peer.at(there),
                peer_sent_ns: peer.at(there),
                received_ns,
            };
            clock.take(&times).unwrap();
            let (error, bound) = peer.error(&clock, received_ns);
            assert!(error.unsigned_abs() <= bound);
        }
        // Each direction adds up to 6.9 ms, evenly. A line relaxes by at most 2.5 us between exchanges. The least of
        // 240 within 0.6 ms exceeds 1.4 ms with (1 - 0.2)^(0.8 * 240) = 3e-19. An error of 1 ms needs that.
        assert!(peer.error(&clock, 600 * S).0.unsigned_abs() < MS);
    }
}

#[test]
fn suspended_peer_is_detected_and_estimate_restarts() {
    for step in [300 * MS, 3_600 * S] {
        for back in [false, true] {
            let (mut peer, after) = (Peer { ahead_ns: 10_000 * S, ppb: 20_000 }, 30_000);
            let mut clock = PeerClock::new(MAX_DRIFT_PPB);
            let mut faults = Vec::new();
            for n in 0..2 * after {
                if n == after {
                    peer.ahead_ns = if back { peer.ahead_ns - step } else { peer.ahead_ns + step };
                }
                faults.extend(clock.take(&peer.exchange(n * MS, 20 * MS, 0, 20 * MS)).err());
            }
            let [ClockFault::Step { by_ns, at_least_ns, .. }] = faults[..] else { panic!("{faults:?}") };
            assert_eq!(by_ns < 0, back);
            assert!(by_ns.unsigned_abs().abs_diff(step) < MS, "{by_ns} of {step}");
            // Minus the two delays, which are not known, 200 ppm of 40 ms and rounding.
            assert!(
                (step - 40 * MS - 20 * US..=step - 40 * MS).contains(&at_least_ns),
                "{at_least_ns} of {step}"
            );
            assert_eq!(clock.steps(), 1);
            assert!(peer.error(&clock, 60 * S).0.unsigned_abs() < 10 * US);
        }
    }
}

#[test]
fn impossible_exchanges_change_nothing_but_are_reported() {
    let good = TimestampExchange {
        sent_ns: S,
        peer_received_ns: 9 * S,
        peer_sent_ns: 9 * S + MS,
        received_ns: S + 11 * MS,
    };
    let cases = [
        (TimestampExchange { received_ns: S - 5, ..good }, ClockFault::Backwards { side: "own", by_ns: 5 }),
        (
            TimestampExchange { peer_received_ns: 9 * S + MS + 3, ..good },
            ClockFault::Backwards { side: "peer", by_ns: 3 },
        ),
        (
            TimestampExchange { peer_sent_ns: 9 * S + 12 * MS, ..good },
            ClockFault::NegativeRoundTrip { by_ns: MS },
        ),
        (TimestampExchange { peer_sent_ns: u64::MAX, ..good }, ClockFault::OutOfRange { seen_ns: u64::MAX }),
    ];
    let mut clock = PeerClock::new(MAX_DRIFT_PPB);
    clock.take(&good).unwrap();
    let before = clock;
    for (times, fault) in cases {
        assert_eq!(clock.take(&times), Err(fault));
        assert_eq!(clock, before);
    }
}

#[test]
fn a_packet_from_the_future_is_a_fault_of_a_clock() {
    let peer = Peer { ahead_ns: 50 * S, ppb: 0 };
    let mut clock = PeerClock::new(MAX_DRIFT_PPB);
    assert_eq!(clock.check_arrival(0, 0), Ok(()));
    assert_eq!(clock.check_arrival(u64::MAX, 0), Err(ClockFault::OutOfRange { seen_ns: u64::MAX }));
    clock.take(&peer.exchange(S, 10 * MS, 0, 10 * MS)).unwrap();
    let now = S + 30 * MS;
    let arrives = |early_ns| clock.check_arrival(peer.at(now + early_ns), now);
    assert_eq!(clock.check_arrival(peer.at(now - 10 * MS), now), Ok(()));
    // The delay there, 200 ppm of the 30 ms since its beginning, and rounding.
    assert_eq!(arrives(10 * MS + 6 * US + 4), Ok(()));
    assert_eq!(arrives(10 * MS + 6 * US + 5), Err(ClockFault::NegativeDelay { by_ns: 1 }));
}

#[test]
fn excessive_drift_is_reported_when_proven() {
    let peer = Peer { ahead_ns: 0, ppb: 1_000_000 };
    let mut clock = PeerClock::new(MAX_DRIFT_PPB);
    let faults: Vec<_> = (0..10_000)
        .filter_map(|n| {
            clock.take(&peer.exchange(n * 20 * MS, 30 * MS, 0, 30 * MS)).err().map(|fault| (n, fault))
        })
        .collect();
    // The excess of 800 ppm leaves the 60 ms that causality allows after 75 s each time.
    let [(first, ClockFault::Step { by_ns, .. }), (second, ClockFault::Step { .. })] = faults[..] else {
        panic!("{faults:?}")
    };
    assert!(
        (3_750..3_760).contains(&first) && (3_750..3_765).contains(&(second - first)),
        "{first} {second}"
    );
    assert!(by_ns > 0);
}

proptest! {
    /// The true age is within its bound, for any delays and any healthy clock.
    #[test]
    fn the_age_is_within_its_bound(
        ppb in -150_000i64..150_000,
        packets in prop::collection::vec((1u64..50, 0u64..30_000, 0u64..30_000, 0u64..9_000), 1..200)
    ) {
        let peer = Peer { ahead_ns: 7 * S, ppb };
        let mut age = PacketAge::new(MAX_DRIFT_PPB);
        let (mut now, mut newest_sent) = (0, 0);
        for (counter, (step, forward, backward, held)) in (0..).zip(packets) {
            now += step * MS;
            age.sent(counter, now);
            let times = peer.exchange(now, forward * US, held * US, backward * US);
            now = times.received_ns;
            // Some echoes are missing.
            if counter % 3 != 1 {
                age.received(now, (counter, times.held_ns())).unwrap();
            }
            newest_sent = newest_sent.max(now - backward * US);
            for later in [0, MS, S] {
                let truth = now + later - newest_sent;
                prop_assert!(age.max_ns(now + later).is_none_or(|most| most >= truth));
            }
        }
    }
}

#[test]
fn the_age_is_the_round_trip_and_the_silence_since() {
    let mut age = PacketAge::new(MAX_DRIFT_PPB);
    assert_eq!(age.max_ns(0), None);
    for n in 0..5_000 {
        age.sent(n, n * MS);
        if n >= 101 {
            // 50 ms in each direction; the peer answers after 1 ms.
            age.received(n * MS, (n - 101, MS)).unwrap();
        }
    }
    assert_eq!(age.max_ns(4_999 * MS), Some(101 * MS));
    assert_eq!(age.max_ns(5_006 * MS), Some(108 * MS));
}

#[test]
fn send_times_are_known_for_the_kept_counters() {
    let mut age = PacketAge::new(MAX_DRIFT_PPB);
    let known = |age: &PacketAge, counters: [u64; 4]| counters.map(|counter| age.sent_at(counter));
    assert_eq!(known(&age, [0, 1, 4096, u64::MAX]), [None; 4]);
    for n in 0..=4096 {
        age.sent(n, n * MS);
    }
    assert_eq!(known(&age, [0, 1, 4096, 4097]), [None, Some(MS), Some(4096 * MS), None]);
    // A counter that does not follow clears those before, also at 0 and 2^64 - 1.
    age.sent(9_000, 5 * S);
    age.sent(9_001, 6 * S);
    assert_eq!(known(&age, [4096, 8_999, 9_000, 9_001]), [None, None, Some(5 * S), Some(6 * S)]);
    for (counter, before) in [(u64::MAX, 9_001), (0, u64::MAX), (0, 1)] {
        age.sent(counter, 7 * S);
        assert_eq!([age.sent_at(before), age.sent_at(counter)], [None, Some(7 * S)]);
    }
}

/// Ages are the same with and without reports, across a new run of the peer.
#[test]
fn ages_do_not_depend_on_reports() {
    let (mut read, mut unread) = (PeerPath::default(), PeerPath::default());
    unread.leave_out_reports();
    for n in 0..3_000_u64 {
        for path in [&mut read, &mut unread] {
            path.sent(n, n * MS);
            if n == 1_000 {
                path.begin();
            }
            if n == 1_500 {
                path.anchor();
            }
            if let Some(echoed) = n.checked_sub(40 + n % 7) {
                let echo = Echo { run_id: 1, sequence: echoed, sent_ns: echoed * MS, held_ns: MS };
                path.arrived(n, n * MS, n * MS);
                path.newest(n * MS, Some(&echo), n * MS, n * MS);
            }
        }
        let of = |path: &PeerPath| (path.max_age_ns(n * MS + 3), path.over_baseline_ns(n * MS + 3));
        assert_eq!(of(&read), of(&unread));
    }
    let (read, unread) = (read.report(3 * S), unread.report(3 * S));
    assert!(read.statistics.received > 1_000 && read.baseline_age_ns.is_some());
    assert_eq!(unread, PathReport { baseline_age_ns: read.baseline_age_ns, ..PathReport::default() });
}

#[test]
fn age_grows_while_our_direction_is_dead() {
    let mut age = PacketAge::new(MAX_DRIFT_PPB);
    age.sent(0, 0);
    for n in 1..1_000 {
        age.received(n * MS + 20 * MS, (0, n * MS)).unwrap();
    }
    assert_eq!(age.max_ns(1_019 * MS), Some(1_019 * MS));
}

#[test]
fn unknown_and_impossible_echoes_do_no_harm() {
    let mut age = PacketAge::new(MAX_DRIFT_PPB);
    for n in 0..4100 {
        age.sent(n, n * MS);
    }
    // Overwritten by 4096 later ones; never sent; held by the peer for longer than the exchange took.
    age.received(4110 * MS, (3, 0)).unwrap();
    age.received(4110 * MS, (5000, 0)).unwrap();
    assert_eq!(age.max_ns(4110 * MS), None);
    age.received(4111 * MS, (4099, 0)).unwrap();
    let impossible = ClockFault::NegativeRoundTrip { by_ns: u64::MAX - 13 * MS };
    assert_eq!(age.received(4112 * MS, (4099, u64::MAX)), Err(impossible));
    assert_eq!(age.max_ns(4112 * MS), Some(13 * MS));
    age.restart();
    assert_eq!(age.max_ns(4113 * MS), None);
}

/// Maximum drift of clocks in these tests.
const MAX_PPB: i64 = MAX_DRIFT_PPB.cast_signed();
const PARTS: i128 = BILLION as i128;

/// A healthy clock whose rate changes with every second.
#[derive(Clone, Debug)]
struct Wandering {
    ahead_ns: u64,
    ppb: Vec<i64>,
    /// Time and size of a jump.
    step: Option<(u64, i64)>,
}

impl Wandering {
    fn at(&self, own_ns: u64) -> u64 {
        let mut drifted = 0;
        for (second, &ppb) in (0..).zip(&self.ppb) {
            let lasts = if second + 1 == self.ppb.len() as u64 { u64::MAX } else { (second + 1) * S };
            let within = own_ns.min(lasts).saturating_sub(second * S);
            drifted += i128::from(within) * i128::from(ppb);
        }
        let step = self.step.map_or(0, |(at_ns, by_ns)| if own_ns >= at_ns { by_ns } else { 0 });
        let reading =
            i128::from(own_ns) + i128::from(self.ahead_ns) + i128::from(step) + drifted.div_euclid(PARTS);
        u64::try_from(reading).unwrap()
    }

    fn offset(&self, own_ns: u64) -> i64 {
        difference(self.at(own_ns), own_ns)
    }
}

/// Exchanges that may overtake each other, in order of arrival.
fn exchanges(peer: &Wandering, packets: &[(u64, u64, u64, u64)]) -> Vec<TimestampExchange> {
    let mut sent = 0;
    let mut exchanges: Vec<_> = packets
        .iter()
        .map(|&(step, forward, held, backward)| {
            sent += step;
            let (there, back) = (sent + forward, sent + forward + held);
            TimestampExchange {
                sent_ns: sent,
                peer_received_ns: peer.at(there),
                peer_sent_ns: peer.at(back),
                received_ns: back + backward,
            }
        })
        .collect();
    exchanges.sort_by_key(|times| times.received_ns);
    exchanges
}

/// Slack of the bounds of exchanges for a clock in parts, over all pairs: below 0 none fits.
fn slack(exchanges: &[TimestampExchange]) -> i128 {
    let pair = |upper: &TimestampExchange, lower: &TimestampExchange| {
        let most = i128::from(difference(upper.peer_received_ns, upper.sent_ns));
        let least = i128::from(difference(lower.peer_sent_ns, lower.received_ns));
        let apart = i128::from(upper.sent_ns.abs_diff(lower.received_ns));
        (most - least) * PARTS + apart * i128::from(MAX_PPB)
    };
    exchanges.iter().flat_map(|upper| exchanges.iter().map(move |lower| pair(upper, lower))).min().unwrap()
}

/// Delays of four magnitudes, with equal chances.
fn delay() -> impl Strategy<Value = u64> {
    prop_oneof![0..2_u64, 0..200 * US, 0..100 * MS, 0..20 * S]
}

fn wandering() -> impl Strategy<Value = Wandering> {
    let rates = prop_oneof![
        prop::collection::vec(-MAX_PPB..=MAX_PPB, 1..20),
        prop::collection::vec(prop::sample::select(vec![-MAX_PPB, MAX_PPB]), 1..20),
    ];
    (60 * S..1 << 60, rates).prop_map(|(ahead_ns, ppb)| Wandering { ahead_ns, ppb, step: None })
}

fn path() -> impl Strategy<Value = Vec<(u64, u64, u64, u64)>> {
    let gap = prop_oneof![Just(MS), 0..5 * MS, 0..2 * S];
    prop::collection::vec((gap, delay(), delay(), delay()), 1..60)
}

/// Any number, more often at the ends of the valid range.
fn number() -> impl Strategy<Value = u64> {
    prop_oneof![0..9_u64, any::<u64>(), (1 << 63) - 9..(1 << 63) + 9_u64, u64::MAX - 9..=u64::MAX]
}

proptest! {
    /// Numbers at the ends of 64 bits, for times and settings, are accepted or refused without overflow.
    #[test]
    fn any_numbers_are_accepted_or_refused(
        max_drift_ppb in number(),
        packets in prop::collection::vec((number(), number(), number(), number(), number()), 1..50),
    ) {
        let mut clock = PeerClock::new(max_drift_ppb);
        let mut age = PacketAge::new(max_drift_ppb);
        for (sent_ns, peer_received_ns, peer_sent_ns, received_ns, counter) in packets {
            let _ = clock.take(&TimestampExchange { sent_ns, peer_received_ns, peer_sent_ns, received_ns });
            let _ = clock.check_arrival(peer_sent_ns, received_ns);
            clock.offset(sent_ns);
            age.sent(counter, sent_ns);
            let _ = age.received(received_ns, (counter, peer_sent_ns));
            age.max_ns(sent_ns);
        }
    }

    /// Healthy clocks and any delays: no fault, and the truth stays within the bound.
    #[test]
    fn bound_holds_without_fault_on_any_path(
        peer in wandering(),
        packets in path(),
        later_ns in prop_oneof![Just(0), 0..S, 0..10_000 * S],
    ) {
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        for times in exchanges(&peer, &packets) {
            prop_assert_eq!(clock.take(&times), Ok(true));
            for now_ns in [times.sent_ns, times.received_ns, times.received_ns + later_ns] {
                let known = clock.offset(now_ns).unwrap();
                let error = known.offset_ns.abs_diff(peer.offset(now_ns));
                prop_assert!(error <= known.bound_ns, "{} of {} at {}", error, known.bound_ns, now_ns);
            }
            prop_assert_eq!(clock.check_arrival(times.peer_sent_ns, times.received_ns), Ok(()));
        }
        prop_assert_eq!(clock.steps(), 0);
    }

    /// The bound is as narrow as the best pair of bounds allows: half the round trip plus the drift for a single
    /// exchange.
    #[test]
    fn the_range_is_the_intersection_of_all(peer in wandering(), packets in path()) {
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        let all = exchanges(&peer, &packets);
        for (count, times) in (1..).zip(&all) {
            clock.take(times).unwrap();
            let now = i128::from(times.received_ns);
            let most = all[..count].iter().map(|times| {
                let since = now - i128::from(times.sent_ns);
                i128::from(difference(times.peer_received_ns, times.sent_ns)) * PARTS + since * i128::from(MAX_PPB)
            }).min().unwrap();
            let least = all[..count].iter().map(|times| {
                let since = now - i128::from(times.received_ns);
                i128::from(difference(times.peer_sent_ns, times.received_ns)) * PARTS - since * i128::from(MAX_PPB)
            }).max().unwrap();
            let (low, high) = clock.range(times.received_ns).unwrap();
            // 2 ns for readings, less than one for the rounding outwards.
            let (below, above) = (least - i128::from(low) * PARTS, i128::from(high) * PARTS - most);
            prop_assert!((2 * PARTS..3 * PARTS).contains(&below) && (2 * PARTS..3 * PARTS).contains(&above));
        }
    }

    /// A step is reported only if no healthy clock fits all exchanges. At the latest it is when twice the drift over
    /// the longest exchange, plus four roundings, does not explain it.
    #[test]
    fn a_step_is_reported_when_and_only_when_it_is_proven(
        mut peer in wandering(),
        packets in path(),
        (at_ns, by_ns) in (0..30 * S, prop_oneof![
            -50 * S.cast_signed()..50 * S.cast_signed(),
            -100 * MS.cast_signed()..100 * MS.cast_signed(),
        ]),
    ) {
        peer.step = Some((at_ns, by_ns));
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        let mut taken: Vec<TimestampExchange> = Vec::new();
        for times in exchanges(&peer, &packets) {
            let longest = taken.iter().chain([&times]).map(TimestampExchange::took_ns).max().unwrap();
            let unsure = i128::from(longest) * 2 * i128::from(MAX_PPB) + 4 * PARTS;
            match clock.take(&times) {
                Ok(is_used) => {
                    prop_assert!(is_used);
                    taken.push(times);
                    prop_assert!(slack(&taken) >= -unsure, "proven, but not reported");
                }
                // An exchange invalid by itself: its own two bounds, or a clock that went back.
                Err(ClockFault::NegativeRoundTrip { .. }) => prop_assert!(slack(&[times]) < 0),
                Err(ClockFault::Backwards { side: "peer", .. }) => prop_assert!(by_ns < 0),
                Err(ClockFault::Step { by_ns: reported_ns, at_least_ns, .. }) => {
                    taken.push(times);
                    prop_assert!(slack(&taken) < 0, "reported, but not proven");
                    // Its sign is that of the step only if no exchange overtook another.
                    prop_assert!(at_least_ns <= by_ns.unsigned_abs() && at_least_ns <= reported_ns.unsigned_abs());
                    break;
                }
                Err(fault) => prop_assert!(false, "{fault:?}"),
            }
        }
    }

    /// After a step the estimate restarts with later exchanges: the bound holds again, and the step is reported once.
    #[test]
    fn bound_holds_again_after_a_step(
        mut peer in wandering(),
        packets in path(),
        at_ns in 0..30 * S,
        back in any::<bool>(),
    ) {
        // More than all that delays can explain.
        let by_ns = if back { -50 * S.cast_signed() } else { 80 * S.cast_signed() };
        peer.ahead_ns += 60 * S;
        peer.step = Some((at_ns, by_ns));
        let mut clock = PeerClock::new(MAX_DRIFT_PPB);
        for times in exchanges(&peer, &packets) {
            if let Err(fault) = clock.take(&times) {
                let impossible = matches!(fault, ClockFault::NegativeRoundTrip { .. } | ClockFault::Backwards { .. });
                prop_assert!(impossible || matches!(fault, ClockFault::Step { .. }), "{:?}", fault);
            }
            prop_assert!(clock.steps() <= 1);
            if clock.steps() == 1 && let Some(known) = clock.offset(times.received_ns) {
                prop_assert!(known.offset_ns.abs_diff(peer.offset(times.received_ns)) <= known.bound_ns);
            }
        }
    }
}

/// Regression: a fit that assumed a constant path reported a fault of a healthy clock.
#[test]
fn long_and_varying_delays_are_no_step() {
    let peer = Wandering { ahead_ns: S, ppb: vec![44_637], step: None };
    let mut clock = PeerClock::new(MAX_DRIFT_PPB);
    let mut random = 88_172_645_463_325_252_u64;
    let mut delay = || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random % (100 * MS)
    };
    let mut now = 0;
    for _ in 0..20_000 {
        now += 300 * MS;
        let (there, back) = (now + delay(), now + 100 * MS + delay());
        let times = TimestampExchange {
            sent_ns: now,
            peer_received_ns: peer.at(there),
            peer_sent_ns: peer.at(back),
            received_ns: back + delay(),
        };
        clock.take(&times).unwrap();
        let known = clock.offset(times.received_ns).unwrap();
        assert!(known.offset_ns.abs_diff(peer.offset(times.received_ns)) <= known.bound_ns);
        now = times.received_ns;
    }
}

#[test]
fn own_clock_that_goes_back_is_reported() {
    let peer = Wandering { ahead_ns: S, ppb: vec![0], step: None };
    let mut clock = PeerClock::new(MAX_DRIFT_PPB);
    let [first, second] = exchanges(&peer, &[(MS, MS, 0, MS), (MS, MS, 0, MS)])[..] else {
        panic!("two were made")
    };
    clock.take(&second).unwrap();
    assert_eq!(clock.take(&first), Err(ClockFault::Backwards { side: "own", by_ns: MS }));
}

/// Sequence, send time on the sender's clock, arrival on ours; in order of arrival.
type Trace = Vec<(u64, u64, u64)>;

fn through_link(settings: &LinkSettings, seed: u64, count: u64) -> Trace {
    let mut link = Link::new(Direction::Forward, seed, settings).unwrap();
    let mut trace: Trace = (0..count)
        .filter_map(|index| {
            let sent_ns = index * MS;
            match link.judge(&Packet { direction: Direction::Forward, sent_ns, size: 100, index }).verdict {
                Verdict::Deliver { at_ns } => Some((index, sent_ns, at_ns)),
                Verdict::Drop { .. } => None,
            }
        })
        .collect();
    trace.sort_by_key(|&(index, _, at_ns)| (at_ns, index));
    trace
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
fn statistics_of_a_link_match_its_settings() {
    let link = LinkSettings { loss: 0.05, keep_order: false, ..jittery(0.05, 0.002) };
    let count = 100_000;
    let trace = through_link(&link, 11, count);
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
    fn statistics_match_their_definitions(
        first in 0u64..1 << 40,
        order in prop::collection::vec(0u64..300, 1..400)
    ) {
        // The first to arrive is the smallest: those before it are not expected.
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

    /// Beyond the window as well, if nothing arrives that late.
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

    /// Numbers at the ends of 64 bits are counted without overflow.
    #[test]
    fn any_numbers_are_counted(
        packets in prop::collection::vec(
            (prop_oneof![0..9_u64, u64::MAX - 9..=u64::MAX, any::<u64>()],
             prop_oneof![0..9_u64, any::<u64>(), (1 << 63) - 9..=(1 << 63) + 9_u64],
             prop_oneof![0..9 * S, 0..1_u64 << 62]),
            1..50,
        ),
    ) {
        let mut meter = PathMeter::new();
        let mut now = 0_u64;
        for &(sequence, sent_ns, step) in &packets {
            now = now.saturating_add(step);
            meter.arrived(sequence, sent_ns, now);
            let seen = meter.statistics(now);
            prop_assert!(seen.losses.lost <= seen.expected && seen.rate_hz.is_finite());
        }
        let seen = meter.statistics(now);
        prop_assert_eq!(seen.received + seen.duplicate + seen.too_late, packets.len() as u64);
    }
}
