//! The claims of the peer's clock on any path, against all pairs of bounds.

use proptest::prelude::*;

use super::*;

const US: u64 = 1000;
const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;

/// Greatest drift of the settings by default: clocks here go up to it.
const MAX_PPB: i64 = 200_000;
const PARTS: i128 = BILLION as i128;

/// A healthy clock that wanders: its rate changes with every second.
#[derive(Clone, Debug)]
struct Wandering {
    ahead_ns: u64,
    ppb: Vec<i64>,
    /// When it jumps and how far.
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

/// Exchanges that overtake each other at will, in the order of arrival.
fn exchanges(peer: &Wandering, packets: &[(u64, u64, u64, u64)]) -> Vec<FourTimes> {
    let mut sent = 0;
    let mut exchanges: Vec<_> = packets
        .iter()
        .map(|&(step, forward, held, backward)| {
            sent += step;
            let (there, back) = (sent + forward, sent + forward + held);
            FourTimes {
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

/// By how many parts the bounds of exchanges leave room for a clock, over all pairs: below 0 none fits.
fn room(exchanges: &[FourTimes]) -> i128 {
    let pair = |upper: &FourTimes, lower: &FourTimes| {
        let most = i128::from(difference(upper.peer_received_ns, upper.sent_ns));
        let least = i128::from(difference(lower.peer_sent_ns, lower.received_ns));
        let apart = i128::from(upper.sent_ns.abs_diff(lower.received_ns));
        (most - least) * PARTS + apart * i128::from(MAX_PPB)
    };
    exchanges.iter().flat_map(|upper| exchanges.iter().map(move |lower| pair(upper, lower))).min().unwrap()
}

/// Delays of any size, each with a chance of its own.
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

/// Any number, more often one at the ends of what is taken.
fn number() -> impl Strategy<Value = u64> {
    prop_oneof![0..9_u64, any::<u64>(), (1 << 63) - 9..(1 << 63) + 9_u64, u64::MAX - 9..=u64::MAX]
}

proptest! {
    /// Numbers at the ends of 64 bits, of times and of settings: taken or refused, but no overflow.
    #[test]
    fn any_numbers_are_borne(
        (max_drift_ppb, window_ns) in (number(), number()),
        packets in prop::collection::vec((number(), number(), number(), number(), number()), 1..50),
    ) {
        let mut clock = PeerClock::new(ClockSettings { window_ns, max_drift_ppb });
        let mut age = PacketAge::new(AgeSettings { window_ns, max_drift_ppb, ..AgeSettings::default() });
        for (sent_ns, peer_received_ns, peer_sent_ns, received_ns, counter) in packets {
            let _ = clock.take(&FourTimes { sent_ns, peer_received_ns, peer_sent_ns, received_ns });
            let _ = clock.backward_delay(peer_sent_ns, received_ns);
            clock.offset(sent_ns);
            age.sent(counter, sent_ns);
            let _ = age.received(received_ns, Some((counter, peer_sent_ns)));
            if let Some(Age { at_most_ns: Some(most), at_most_by_peer_ns: Some(closer), .. }) = age.age(sent_ns) {
                prop_assert!(closer <= most);
            }
        }
    }

    /// Healthy clocks, whatever the ways do: no fault is told and the truth is within the bound, then and later.
    #[test]
    fn the_bound_holds_and_nothing_is_told_on_any_path(
        peer in wandering(),
        packets in path(),
        later_ns in prop_oneof![Just(0), 0..S, 0..10_000 * S],
    ) {
        let mut clock = PeerClock::new(ClockSettings::default());
        for times in exchanges(&peer, &packets) {
            let reading = clock.take(&times).unwrap().unwrap();
            for now_ns in [times.sent_ns, times.received_ns, times.received_ns + later_ns] {
                let known = clock.offset(now_ns).unwrap();
                let error = known.offset_ns.abs_diff(peer.offset(now_ns));
                prop_assert!(error <= known.bound_ns, "{} of {} at {}", error, known.bound_ns, now_ns);
            }
            // Of the ways, on the peer's clock.
            let ways = [
                (reading.forward, difference(times.peer_received_ns, peer.at(times.sent_ns))),
                (reading.backward, difference(peer.at(times.received_ns), times.peer_sent_ns)),
            ];
            for (way, truth) in ways {
                prop_assert!(way.delay_ns.abs_diff(truth) <= way.bound_ns, "{:?} of {}", way, truth);
            }
            prop_assert!(clock.backward_delay(times.peer_sent_ns, times.received_ns).unwrap().is_some());
        }
        prop_assert_eq!(clock.steps(), 0);
    }

    /// The bound is not wider than the best pair of bounds makes it: half the round trip and the drift, if one
    /// exchange was all.
    #[test]
    fn the_range_is_the_intersection_of_all(peer in wandering(), packets in path()) {
        let mut bounds = causal::CausalBounds::new(MAX_PPB.unsigned_abs());
        let all = exchanges(&peer, &packets);
        for (count, times) in (1..).zip(&all) {
            bounds.narrow(times);
            let now = i128::from(times.received_ns);
            let most = all[..count].iter().map(|times| {
                let since = now - i128::from(times.sent_ns);
                i128::from(difference(times.peer_received_ns, times.sent_ns)) * PARTS + since * i128::from(MAX_PPB)
            }).min().unwrap();
            let least = all[..count].iter().map(|times| {
                let since = now - i128::from(times.received_ns);
                i128::from(difference(times.peer_sent_ns, times.received_ns)) * PARTS - since * i128::from(MAX_PPB)
            }).max().unwrap();
            let (low, high) = bounds.range(times.received_ns).unwrap();
            // 2 ns for readings, less than one for the rounding outwards.
            let (below, above) = (least - i128::from(low) * PARTS, i128::from(high) * PARTS - most);
            prop_assert!((2 * PARTS..3 * PARTS).contains(&below) && (2 * PARTS..3 * PARTS).contains(&above));
        }
    }

    /// A step is told only if no healthy clock fits all exchanges so far, and not later than when even twice what the
    /// clocks may part in the longest exchange, and the rounding of four readings, explain it no more.
    #[test]
    fn a_step_is_told_when_and_only_when_it_is_proven(
        mut peer in wandering(),
        packets in path(),
        (at_ns, by_ns) in (0..30 * S, prop_oneof![
            -50 * S.cast_signed()..50 * S.cast_signed(),
            -100 * MS.cast_signed()..100 * MS.cast_signed(),
        ]),
    ) {
        peer.step = Some((at_ns, by_ns));
        let mut clock = PeerClock::new(ClockSettings::default());
        let mut taken: Vec<FourTimes> = Vec::new();
        for times in exchanges(&peer, &packets) {
            let longest = taken.iter().chain([&times]).map(FourTimes::took_ns).max().unwrap();
            let unsure = i128::from(longest) * 2 * i128::from(MAX_PPB) + 4 * PARTS;
            match clock.take(&times) {
                Ok(reading) => {
                    prop_assert!(reading.is_some());
                    taken.push(times);
                    prop_assert!(room(&taken) >= -unsure, "proven, but not told");
                }
                // An exchange that is impossible by itself: its own two bounds, or a clock that went back.
                Err(ClockFault::NegativeRoundTrip { .. }) => prop_assert!(room(&[times]) < 0),
                Err(ClockFault::Backwards { side: "peer", .. }) => prop_assert!(by_ns < 0),
                Err(ClockFault::Step { by_ns: told_ns, at_least_ns, .. }) => {
                    taken.push(times);
                    prop_assert!(room(&taken) < 0, "told, but not proven");
                    // Its sign is that of the step only if no exchange overtook another.
                    prop_assert!(at_least_ns <= by_ns.unsigned_abs() && at_least_ns <= told_ns.unsigned_abs());
                    break;
                }
                Err(fault) => prop_assert!(false, "{fault:?}"),
            }
        }
    }

    /// After a step the estimate begins anew with what is of after it, so the bound holds again, and it is told once.
    #[test]
    fn after_a_step_the_bound_holds_anew(
        mut peer in wandering(),
        packets in path(),
        at_ns in 0..30 * S,
        back in any::<bool>(),
    ) {
        // Of more than all that ways can explain.
        let by_ns = if back { -50 * S.cast_signed() } else { 80 * S.cast_signed() };
        peer.ahead_ns += 60 * S;
        peer.step = Some((at_ns, by_ns));
        let mut clock = PeerClock::new(ClockSettings::default());
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

/// What once made a fault of a healthy clock: a fit that took the path to be constant.
#[test]
fn long_and_varying_delays_are_no_step() {
    let peer = Wandering { ahead_ns: S, ppb: vec![44_637], step: None };
    let mut clock = PeerClock::new(ClockSettings::default());
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
        let times = FourTimes {
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
fn our_own_clock_that_goes_back_is_told() {
    let peer = Wandering { ahead_ns: S, ppb: vec![0], step: None };
    let mut clock = PeerClock::new(ClockSettings::default());
    let [first, second] = exchanges(&peer, &[(MS, MS, 0, MS), (MS, MS, 0, MS)])[..] else {
        panic!("two were made")
    };
    clock.take(&second).unwrap();
    assert_eq!(clock.take(&first), Err(ClockFault::Backwards { side: "own", by_ns: MS }));
}
