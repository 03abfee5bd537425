//! The peer's clock and the age of its packets against closed forms.

use haptether_netsim::{Direction, Distribution, Link, LinkSettings, Packet, Verdict};
use proptest::prelude::*;

use super::*;

const US: u64 = 1000;
const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;

/// The peer's clock: ahead by `ahead_ns`, faster by `ppb`.
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

    fn exchange(self, sent_ns: u64, forward_ns: u64, held_ns: u64, backward_ns: u64) -> FourTimes {
        let there = sent_ns + forward_ns;
        FourTimes {
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

fn read(clock: &mut PeerClock, times: &FourTimes) -> Reading {
    clock.take(times).unwrap().unwrap()
}

#[test]
fn an_asymmetric_delay_costs_exactly_half_the_asymmetry() {
    for (forward, backward) in [(10 * MS, 10 * MS), (30 * MS, 10 * MS), (0, 50 * MS), (7, 4)] {
        for ahead_ns in [0, 3_600 * S, 1 << 61] {
            let peer = Peer { ahead_ns, ppb: 0 };
            let mut clock = PeerClock::new(ClockSettings::default());
            for n in 1..5_000 {
                let reading = read(&mut clock, &peer.exchange(n * MS, forward, n % 7 * US, backward));
                assert_eq!(reading.round_trip_ns, forward + backward);
            }
            let (error, bound) = peer.error(&clock, 5 * S);
            assert_eq!(error, (forward.cast_signed() - backward.cast_signed()) / 2);
            assert!(error.unsigned_abs() <= bound && clock.drift_ppb() == Some(0));
            assert_eq!(clock.least_round_trip_ns(), Some(forward + backward));
        }
    }
}

#[test]
fn both_ways_are_told_up_to_the_asymmetry() {
    let peer = Peer { ahead_ns: 5 * S, ppb: 0 };
    let mut clock = PeerClock::new(ClockSettings::default());
    clock.take(&peer.exchange(S, 10 * MS, 0, 10 * MS)).unwrap();
    let reading = read(&mut clock, &peer.exchange(S + MS, 13 * MS, MS, 11 * MS));
    assert_eq!(reading.forward.delay_ns, 13 * MS.cast_signed());
    assert_eq!(reading.backward.delay_ns, 11 * MS.cast_signed());
}

/// A day with clocks at their limits and a path whose queues add up to 20 ms each way.
#[test]
fn a_day_of_drift_stays_within_the_bound() {
    for ppb in [100_000, -100_000, 0] {
        let peer = Peer { ahead_ns: 86_400 * S, ppb };
        let mut clock = PeerClock::new(ClockSettings::default());
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
        let drift = clock.drift_ppb().unwrap();
        println!("{ppb} ppb: drift {drift}, worst error beside half the asymmetry {worst} ns");
        assert!(drift.abs_diff(ppb) < 15_000, "{drift} of {ppb}");
        // Two queues add s < 20 ms with probability s^2 / 800; the least of 70 exchanges of a window is above 16 ms with
        // 2e-12, and an error of 8 ms needs that.
        assert!(worst < 8 * MS, "{ppb}: {worst}");
    }
}

#[test]
fn without_queues_the_drift_is_exact() {
    for ppb in [100_000, -100_000] {
        let peer = Peer { ahead_ns: S, ppb };
        let mut clock = PeerClock::new(ClockSettings::default());
        for n in 0..600_000 {
            clock.take(&peer.exchange(n * MS, 10 * MS, 100 * US, 10 * MS)).unwrap();
        }
        assert!(clock.drift_ppb().unwrap().abs_diff(ppb) <= 2);
        // 10 ms at 100 ppm are 1000 ns that the way itself drifts; the rest is rounding.
        assert!(peer.error(&clock, 600 * S).0.unsigned_abs() < 1_100);
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
        let mut pass = |way: usize, index, sent_ns| {
            let (direction, link) = &mut links[way];
            match link.judge(&Packet { direction: *direction, sent_ns, size: 100, index }).verdict {
                Verdict::Deliver { at_ns } => Some(at_ns),
                Verdict::Drop { .. } => None,
            }
        };
        let peer = Peer { ahead_ns: 77 * S, ppb: 50_000 };
        let mut clock = PeerClock::new(ClockSettings::default());
        for index in 0..60_000 {
            // Far enough apart that no packet meets another.
            let sent_ns = index * 10 * MS;
            let Some(there) = pass(0, index, sent_ns) else { continue };
            let Some(received_ns) = pass(1, index, there) else { continue };
            let times = FourTimes {
                sent_ns,
                peer_received_ns: peer.at(there),
                peer_sent_ns: peer.at(there),
                received_ns,
            };
            clock.take(&times).unwrap();
            let (error, bound) = peer.error(&clock, received_ns);
            assert!(error.unsigned_abs() <= bound);
        }
        assert!(clock.drift_ppb().unwrap().abs_diff(50_000) < 2_000, "{:?}", clock.drift_ppb());
        // Each way adds up to 6.9 ms. Of 560 exchanges of a window that come through, the least is 2 ms above the least
        // possible with (1 - 0.042)^560 = 4e-11; an error of 1 ms needs that.
        assert!(peer.error(&clock, 600 * S).0.unsigned_abs() < MS);
    }
}

#[test]
fn a_suspended_peer_is_seen_and_the_estimate_begins_anew() {
    for step in [300 * MS, 3_600 * S] {
        for back in [false, true] {
            let (mut peer, after) = (Peer { ahead_ns: 10_000 * S, ppb: 20_000 }, 30_000);
            let mut clock = PeerClock::new(ClockSettings::default());
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
            // All but the two ways, which might have been others, and what 200 ppm make of 40 ms and rounding.
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
fn impossible_exchanges_change_nothing_but_are_told() {
    let good =
        FourTimes { sent_ns: S, peer_received_ns: 9 * S, peer_sent_ns: 9 * S + MS, received_ns: S + 11 * MS };
    let cases = [
        (FourTimes { received_ns: S - 5, ..good }, ClockFault::Backwards { side: "own", by_ns: 5 }),
        (
            FourTimes { peer_received_ns: 9 * S + MS + 3, ..good },
            ClockFault::Backwards { side: "peer", by_ns: 3 },
        ),
        (FourTimes { peer_sent_ns: 9 * S + 12 * MS, ..good }, ClockFault::NegativeRoundTrip { by_ns: MS }),
        (FourTimes { peer_sent_ns: u64::MAX, ..good }, ClockFault::OutOfRange { seen_ns: u64::MAX }),
    ];
    let mut clock = PeerClock::new(ClockSettings::default());
    clock.take(&good).unwrap();
    let before = clock.clone();
    for (times, fault) in cases {
        assert_eq!(clock.take(&times), Err(fault));
        assert_eq!(clock, before);
    }
}

#[test]
fn a_packet_from_the_future_is_a_fault_of_a_clock() {
    let peer = Peer { ahead_ns: 50 * S, ppb: 0 };
    let mut clock = PeerClock::new(ClockSettings::default());
    assert_eq!(clock.backward_delay(0, 0), Ok(None));
    read(&mut clock, &peer.exchange(S, 10 * MS, 0, 10 * MS));
    let now = S + 30 * MS;
    let way = clock.backward_delay(peer.at(now - 10 * MS), now).unwrap().unwrap();
    assert_eq!(way.delay_ns, 10 * MS.cast_signed());
    // Half the round trip, 200 ppm of the 30 ms since its beginning, and the rounding of readings.
    assert_eq!(way.bound_ns, 10 * MS + 6 * US + 2);
    let before = |early_ns| clock.backward_delay(peer.at(now + early_ns), now);
    assert_eq!(before(10 * MS).unwrap().unwrap().delay_ns, -10 * MS.cast_signed());
    // The rounding counts twice: in the bound and in this packet.
    assert_eq!(before(10 * MS + 6 * US + 4).unwrap().unwrap().bound_ns, way.bound_ns);
    assert_eq!(before(10 * MS + 6 * US + 5), Err(ClockFault::NegativeDelay { by_ns: 1 }));
}

#[test]
fn a_drift_that_no_clock_has_is_told_when_it_is_proven_and_not_used() {
    let peer = Peer { ahead_ns: 0, ppb: 1_000_000 };
    let mut clock = PeerClock::new(ClockSettings::default());
    let faults: Vec<_> = (0..10_000)
        .filter_map(|n| {
            clock.take(&peer.exchange(n * 20 * MS, 30 * MS, 0, 30 * MS)).err().map(|fault| (n, fault))
        })
        .collect();
    // It leaves the 60 ms that causality allows with the 800 ppm that are too much: after 75 s each time.
    let [(first, ClockFault::Step { by_ns, .. }), (second, ClockFault::Step { .. })] = faults[..] else {
        panic!("{faults:?}")
    };
    assert!(
        (3_750..3_760).contains(&first) && (3_750..3_765).contains(&(second - first)),
        "{first} {second}"
    );
    assert!(by_ns > 0);
    assert_eq!(clock.drift_ppb(), None);
}

proptest! {
    /// The true age is between the bounds, whatever the ways take, with any healthy clock.
    #[test]
    fn the_age_is_between_its_bounds(
        ppb in -150_000i64..150_000,
        packets in prop::collection::vec((1u64..50, 0u64..30_000, 0u64..30_000, 0u64..9_000), 1..200)
    ) {
        let peer = Peer { ahead_ns: 7 * S, ppb };
        let mut age = PacketAge::new(AgeSettings::default());
        let (mut now, mut newest_sent) = (0, 0);
        for (counter, (step, forward, backward, held)) in (0..).zip(packets) {
            now += step * MS;
            age.sent(counter, now);
            let times = peer.exchange(now, forward * US, held * US, backward * US);
            now = times.received_ns;
            // Some echoes are missing; the packets count all the same.
            let echo = (counter % 3 != 1).then_some((counter, times.held_ns()));
            age.received(now, echo).unwrap();
            newest_sent = newest_sent.max(now - backward * US);
            for later in [0, MS, S] {
                let bounds = age.age(now + later).unwrap();
                let truth = now + later - newest_sent;
                prop_assert!(bounds.at_least_ns <= truth);
                for most in [bounds.at_most_ns, bounds.at_most_by_peer_ns] {
                    prop_assert!(most.is_none_or(|most| most >= truth), "{:?} of {}", bounds, truth);
                }
                prop_assert!(bounds.at_most_by_peer_ns <= bounds.at_most_ns);
            }
        }
    }
}

#[test]
fn the_age_over_the_expected_one_is_the_silence() {
    let mut age = PacketAge::new(AgeSettings::default());
    assert_eq!((age.age(0), age.over_expected_ns(0)), (None, None));
    for n in 0..5_000 {
        age.sent(n, n * MS);
        if n >= 101 {
            // 50 ms each way; the peer answers 1 ms after it was asked.
            age.received(n * MS, Some((n - 101, MS))).unwrap();
        }
    }
    assert_eq!(age.expected_ns(), Some(101 * MS));
    assert_eq!(age.least_ns(), age.expected_ns());
    assert_eq!(age.over_expected_ns(4_999 * MS), Some(0));
    assert_eq!(age.over_expected_ns(5_006 * MS), Some(7 * MS));
    // What may be wrong with the 1 ms held: 200 ppm, and the rounding.
    let wanted =
        Age { at_least_ns: 7 * MS, at_most_ns: Some(108 * MS), at_most_by_peer_ns: Some(107 * MS + 201) };
    assert_eq!(age.age(5_006 * MS), Some(wanted));
}

#[test]
fn when_our_way_is_dead_only_the_held_time_tells_that_packets_are_fresh() {
    let mut age = PacketAge::new(AgeSettings::default());
    age.sent(0, 0);
    for n in 1..1_000 {
        age.received(n * MS + 20 * MS, Some((0, n * MS))).unwrap();
    }
    let bounds = age.age(1_019 * MS).unwrap();
    assert_eq!(bounds.at_most_ns, Some(1_019 * MS));
    let by_peer = bounds.at_most_by_peer_ns.unwrap();
    assert!((20 * MS..=20 * MS + 200 * US).contains(&by_peer), "{by_peer}");
}

/// A peer whose clock jumps by 8 ms while it holds a packet, and then says the right time again.
#[test]
fn a_peer_whose_clock_jumps_makes_no_packet_younger_than_it_may_be() {
    let mut age = PacketAge::new(AgeSettings::default());
    age.sent(0, 0);
    // 5 ms there, held for 1 ms, 5 ms back.
    age.received(11 * MS, Some((0, 9 * MS))).unwrap();
    let bounds = age.age(11 * MS).unwrap();
    assert!(bounds.at_most_ns.unwrap() >= 5 * MS && bounds.at_most_by_peer_ns.unwrap() < 5 * MS);
}

#[test]
fn unknown_and_impossible_echoes_do_no_harm() {
    let mut age = PacketAge::new(AgeSettings { sent_kept: 8, ..AgeSettings::default() });
    for n in 0..20 {
        age.sent(n, n * MS);
    }
    age.received(30 * MS, Some((3, 0))).unwrap();
    assert_eq!(age.age(30 * MS), Some(Age { at_least_ns: 0, at_most_ns: None, at_most_by_peer_ns: None }));
    age.received(31 * MS, Some((19, 0))).unwrap();
    assert!(age.received(32 * MS, Some((19, u64::MAX))).is_err());
    let known = Some(13 * MS);
    assert_eq!(age.age(32 * MS), Some(Age { at_least_ns: 0, at_most_ns: known, at_most_by_peer_ns: known }));
    age.restart();
    assert_eq!(age.age(33 * MS), None);
}
