use std::collections::VecDeque;

use proptest::prelude::*;

use super::codel::Codel;
use crate::impairments::{CrossTraffic, Discipline, Opportunities};
use crate::{Direction, DropCause, Link, LinkSettings, Packet, Verdict};
use haptether_numeric::random::draw;

const MS: u64 = 1_000_000;

/// Verdicts of a link on packets (time in ns, payload in bytes).
fn verdicts(settings: &LinkSettings, packets: &[(u64, usize)]) -> Vec<Verdict> {
    let direction = Direction::Forward;
    let mut link = Link::new(direction, 11, settings).unwrap();
    let packets = packets.iter().zip(0..);
    packets
        .map(|(&(sent_ns, size), index)| link.judge(&Packet { direction, sent_ns, size, index }).verdict)
        .collect()
}

fn at(at_ns: u64) -> Verdict {
    Verdict::Deliver { at_ns }
}

const FULL: Verdict = Verdict::Drop { cause: DropCause::Queue };

fn limited(rate_bps: f64) -> LinkSettings {
    LinkSettings { rate_bps: Some(rate_bps), ..LinkSettings::default() }
}

#[test]
fn a_packet_takes_its_time_on_the_line_and_waits_for_those_before_it() {
    // 64 + 28 bytes at 1 Mbit/s: 736 us.
    let packets = [(0, 64), (0, 64), (10_000_000, 64)];
    assert_eq!(verdicts(&limited(1e6), &packets), [at(736_000), at(1_472_000), at(10_736_000)]);
    // The wait adds to the delay.
    let delayed = LinkSettings { delay_s: 0.02, ..limited(1e6) };
    assert_eq!(verdicts(&delayed, &packets), [at(20_736_000), at(21_472_000), at(30_736_000)]);
    let bare = LinkSettings { overhead_bytes: 0, ..limited(8e9) };
    assert_eq!(verdicts(&bare, &[(5, 1), (5, 1000)]), [at(6), at(1006)]);
}

#[test]
fn every_bound_of_the_queue_drops_packets_while_it_is_full() {
    // A packet of 1000 bytes takes 1 ms; one is in transmission, the others wait.
    let line = LinkSettings { overhead_bytes: 0, ..limited(8e6) };
    let burst = [(0, 1000); 4];
    let cases = [
        (LinkSettings { queue_packets: Some(2), ..line.clone() }, [at(MS), at(2 * MS), at(3 * MS), FULL]),
        (LinkSettings { queue_bytes: Some(1999), ..line.clone() }, [at(MS), at(2 * MS), FULL, FULL]),
        (LinkSettings { queue_ms: Some(2.0), ..line.clone() }, [at(MS), at(2 * MS), at(3 * MS), FULL]),
        (
            LinkSettings { queue_ms: Some(2.0), queue_packets: Some(1), ..line.clone() },
            [at(MS), at(2 * MS), FULL, FULL],
        ),
    ];
    for (settings, expected) in cases {
        assert_eq!(verdicts(&settings, &burst), expected, "{settings:?}");
    }
    let many = verdicts(&line, &[(0, 1000); 1010]);
    assert_eq!(
        many.iter().filter(|verdict| **verdict != FULL).count(),
        1001,
        "1000 wait, one is in transmission"
    );
}

#[test]
fn a_queue_without_a_bottleneck_is_refused() {
    let cases = [
        (LinkSettings { queue_packets: Some(3), ..LinkSettings::default() }, "queue_packets"),
        (LinkSettings { queue_ms: Some(3.0), ..LinkSettings::default() }, "queue_ms"),
        (LinkSettings { discipline: Discipline::Codel, ..LinkSettings::default() }, "discipline"),
        (limited(0.0), "rate_bps"),
        (LinkSettings { queue_packets: Some(0), ..limited(1e6) }, "queue_packets"),
        (LinkSettings { overhead_bytes: 5000, ..limited(1e6) }, "overhead_bytes"),
        (
            LinkSettings { opportunities: Some(Opportunities { time_ms: vec![1] }), ..limited(1e6) },
            "opportun",
        ),
        (scheduled(&[]), "opportunities.time_ms"),
        (scheduled(&[0, 0]), "opportunities.time_ms.1"),
        (scheduled(&[3, 2]), "opportunities.time_ms.1"),
        (crossed(1e6, 1500, 1e12), "cross_traffic.rate_bps"),
        (crossed(1e6, 1, 1e9), "cross_traffic"),
    ];
    for (settings, key) in cases {
        let message = settings.validate().unwrap_err().to_string();
        assert!(message.starts_with(key), "{message}");
    }
}

fn scheduled(time_ms: &[u64]) -> LinkSettings {
    let opportunities = Some(Opportunities { time_ms: time_ms.to_vec() });
    LinkSettings { opportunities, overhead_bytes: 0, ..LinkSettings::default() }
}

/// Times in ns and payloads in bytes.
type Arrivals<'a> = &'a [(u64, usize)];

#[test]
fn opportunities_carry_1500_bytes_each() {
    let settings = scheduled(&[2, 2, 5, 10]);
    let cases: [(Arrivals, &[u64]); 6] = [
        (&[(0, 1500)], &[2]),
        // Two small packets share one opportunity.
        (&[(0, 700), (0, 800), (0, 10)], &[2, 2, 2]),
        // A large packet takes three; the rest of the third goes to the next packet.
        (&[(0, 4400), (0, 100), (0, 1)], &[5, 5, 10]),
        // A packet that arrives with the opportunity misses it, and the rest of the opportunity is lost.
        (&[(0, 10), (2 * MS, 10)], &[2, 5]),
        // The list repeats.
        (
            &[(10 * MS, 1500), (10 * MS, 1500), (10 * MS, 1500), (10 * MS, 1500), (10 * MS, 1)],
            &[12, 12, 15, 20, 22],
        ),
        (&[(1_000_000_000_007 * MS, 1)], &[1_000_000_000_010]),
    ];
    for (packets, left_ms) in cases {
        let expected: Vec<Verdict> = left_ms.iter().map(|ms| at(ms * MS)).collect();
        assert_eq!(verdicts(&settings, packets), expected);
    }
}

/// Event-driven queue with the same arrivals (arrival, bytes on the wire); returns departures, `None` if
/// dropped.
fn by_events(
    arrivals: &[(u64, u64)],
    ns_per_byte: u64,
    packets: usize,
    mut codel: Option<RfcCodel>,
) -> Vec<Option<u64>> {
    let mut left = vec![None; arrivals.len()];
    let mut queue: VecDeque<Queued> = VecDeque::new();
    let mut done_ns = None;
    let mut next = 0;
    while next < arrivals.len() || done_ns.is_some() {
        // At equal times, departures precede arrivals.
        if let Some(now_ns) = done_ns.filter(|&done| next == arrivals.len() || done <= arrivals[next].0) {
            done_ns = serve(&mut queue, now_ns, codel.as_mut(), ns_per_byte, &mut left);
            continue;
        }
        let (arrival_ns, bytes) = arrivals[next];
        let backlog = queue.iter().map(|queued| queued.bytes).sum::<u64>() + bytes;
        if done_ns.is_none() {
            queue.push_back(Queued { index: next, arrival_ns, bytes, backlog });
            done_ns = serve(&mut queue, arrival_ns, codel.as_mut(), ns_per_byte, &mut left);
        } else if queue.len() < packets {
            queue.push_back(Queued { index: next, arrival_ns, bytes, backlog });
        }
        next += 1;
    }
    left
}

#[derive(Clone, Copy)]
struct Queued {
    index: usize,
    arrival_ns: u64,
    bytes: u64,
    backlog: u64,
}

fn serve(
    queue: &mut VecDeque<Queued>,
    now_ns: u64,
    codel: Option<&mut RfcCodel>,
    ns_per_byte: u64,
    left: &mut [Option<u64>],
) -> Option<u64> {
    let served = match codel {
        None => queue.pop_front(),
        Some(codel) => codel.deque(queue, now_ns),
    }?;
    let done_ns = now_ns + served.bytes * ns_per_byte;
    left[served.index] = Some(done_ns);
    Some(done_ns)
}

/// RFC 8289, section 5, function by function.
#[derive(Default)]
struct RfcCodel {
    first_above: u64,
    drop_next: u64,
    count: u32,
    last_count: u32,
    dropping: bool,
}

impl RfcCodel {
    fn dodeque(&mut self, queue: &mut VecDeque<Queued>, now: u64) -> (Option<Queued>, bool) {
        let Some(packet) = queue.pop_front() else {
            self.first_above = 0;
            return (None, false);
        };
        let mut ok_to_drop = false;
        if now - packet.arrival_ns < 5 * MS || packet.backlog <= 1500 {
            self.first_above = 0;
        } else if self.first_above == 0 {
            self.first_above = now + 100 * MS;
        } else if now >= self.first_above {
            ok_to_drop = true;
        }
        (Some(packet), ok_to_drop)
    }

    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "below 1e8")]
    fn law(from: u64, count: u32) -> u64 {
        from + (1e8 / f64::from(count).sqrt()).round() as u64
    }

    fn deque(&mut self, queue: &mut VecDeque<Queued>, now: u64) -> Option<Queued> {
        let (mut packet, mut ok_to_drop) = self.dodeque(queue, now);
        if self.dropping {
            if !ok_to_drop {
                self.dropping = false;
            }
            while now >= self.drop_next && self.dropping {
                self.count += 1;
                (packet, ok_to_drop) = self.dodeque(queue, now);
                if ok_to_drop {
                    self.drop_next = Self::law(self.drop_next, self.count);
                } else {
                    self.dropping = false;
                }
            }
        } else if ok_to_drop {
            (packet, _) = self.dodeque(queue, now);
            self.dropping = true;
            let delta = self.count - self.last_count;
            self.count = 1;
            if delta > 1 && now.saturating_sub(self.drop_next) < 1600 * MS {
                self.count = delta;
            }
            self.drop_next = Self::law(now, self.count);
            self.last_count = self.count;
        }
        packet
    }
}

fn departures(verdicts: &[Verdict]) -> Vec<Option<u64>> {
    let departure = |verdict: &Verdict| match verdict {
        Verdict::Deliver { at_ns } => Some(*at_ns),
        Verdict::Drop { .. } => None,
    };
    verdicts.iter().map(departure).collect()
}

proptest! {
    #[test]
    fn a_queue_agrees_with_one_by_events(
        packets in prop::collection::vec((0_u64..3000, 0_usize..1500), 1..200),
        bound in 1_usize..20,
    ) {
        let mut now_ns = 0;
        let mut arrivals = Vec::new();
        for (gap_us, size) in packets {
            now_ns += gap_us * 1000;
            arrivals.push((now_ns, size));
        }
        // 1 us per byte.
        let settings = LinkSettings { queue_packets: Some(bound), overhead_bytes: 7, ..limited(8e6) };
        let on_the_wire: Vec<_> = arrivals.iter().map(|&(arrival, size)| (arrival, size as u64 + 7)).collect();
        let expected = by_events(&on_the_wire, 1000, bound, None);
        prop_assert_eq!(departures(&verdicts(&settings, &arrivals)), expected);
    }
}

/// Reference by mahimahi's rules: each opportunity in turn, with the packets that arrived before it.
fn by_opportunities(arrivals: &[(u64, usize)], time_ms: &[u64]) -> Vec<Option<u64>> {
    let mut left_ms = vec![None; arrivals.len()];
    let mut next = 0;
    let mut owed = arrivals[0].1;
    for cycle in 0.. {
        for ms in time_ms.iter().map(|ms| cycle * time_ms.last().unwrap() + ms) {
            let mut bytes = 1500;
            while arrivals[next].0 < ms * MS && owed.min(bytes) + usize::from(owed == 0) > 0 {
                let carried = owed.min(bytes);
                owed -= carried;
                bytes -= carried;
                if owed == 0 {
                    left_ms[next] = Some(ms * MS);
                    next += 1;
                    let Some(&(_, size)) = arrivals.get(next) else {
                        return left_ms;
                    };
                    owed = size;
                }
            }
        }
    }
    left_ms
}

proptest! {
    #[test]
    fn opportunities_agree_with_an_account_of_each(
        packets in prop::collection::vec((0_u64..5, 1_usize..4000), 1..60),
        mut time_ms in prop::collection::vec(0_u64..20, 1..12),
    ) {
        time_ms.sort_unstable();
        time_ms.push(20);
        let mut now_ms = 0;
        let mut arrivals = Vec::new();
        for (gap_ms, size) in packets {
            now_ms += gap_ms;
            arrivals.push((now_ms * MS, size));
        }
        let expected = by_opportunities(&arrivals, &time_ms);
        prop_assert_eq!(departures(&verdicts(&scheduled(&time_ms), &arrivals)), expected);
    }
}

/// Loads from just below to twice the rate; the queue empties in between.
#[test]
fn codel_agrees_with_its_rfc() {
    let mut dropped = 0;
    for seed in 0..8 {
        let mut now_ns = 0;
        let arrivals: Vec<(u64, usize)> = (0..20_000)
            .map(|index| {
                let [a, b, ..] = draw(seed, 0, index);
                let phase = (index / 2500) % 4;
                let mean_us = [520, 900, 1050, 700][usize::try_from(phase).unwrap()];
                now_ns += u64::from(a) % (2 * mean_us) * 1000;
                (now_ns, 500 + (b % 1000) as usize)
            })
            .collect();
        let settings = LinkSettings {
            discipline: Discipline::Codel,
            queue_packets: Some(1000),
            overhead_bytes: 0,
            ..limited(8e6)
        };
        let seen = verdicts(&settings, &arrivals);
        dropped += seen.iter().filter(|seen| **seen == Verdict::Drop { cause: DropCause::Codel }).count();
        let on_the_wire: Vec<_> = arrivals.iter().map(|&(arrival, size)| (arrival, size as u64)).collect();
        let expected = by_events(&on_the_wire, 1000, 1000, Some(RfcCodel::default()));
        assert_eq!(departures(&seen), expected);
    }
    assert!(dropped > 1000, "{dropped}");
}

#[test]
fn codel_leaves_a_short_queue_alone() {
    let mut codel = Codel::default();
    for step in 1..1000 {
        let now_ns = step * MS;
        assert!(!codel.drops(now_ns.saturating_sub(4 * MS), now_ns, 100_000), "wait below the target");
        assert!(!codel.drops(0, now_ns, 1500), "a single packet");
    }
}

fn crossed(line_bps: f64, packet_bytes: usize, rate_bps: f64) -> LinkSettings {
    let cross_traffic = Some(CrossTraffic { rate_bps, packet_bytes, mean_on_s: None, mean_off_s: None });
    LinkSettings { cross_traffic, overhead_bytes: 0, ..limited(line_bps) }
}

/// Waits in ms of small packets sent every 20 ms.
fn waits_ms(settings: &LinkSettings, count: u64) -> Vec<f64> {
    let packets: Vec<(u64, usize)> = (0..count).map(|index| (index * 20 * MS, 0)).collect();
    let verdicts = verdicts(settings, &packets);
    let wait = |(verdict, packet): (&Verdict, &(u64, usize))| match verdict {
        Verdict::Deliver { at_ns } => (at_ns - packet.0) as f64 / 1e6,
        Verdict::Drop { .. } => f64::NAN,
    };
    verdicts.iter().zip(&packets).map(wait).collect()
}

/// M/D/1: mean wait `rho S / (2 (1 - rho))`, second moment `2 W^2 + lambda S^3 / (3 (1 - rho))`. A packet at
/// an independent time sees the time average, and an empty packet adds no load.
///
/// Source: L. Kleinrock, "Queueing systems", volume 1, 1975 (Pollaczek-Khinchine).
#[test]
fn the_wait_behind_cross_traffic_is_that_of_m_d_1() {
    const COUNT: u64 = 50_000;
    for load in [0.3_f64, 0.5, 0.8] {
        // 1500 bytes at 12 Mbit/s: S = 1 ms.
        let waits = waits_ms(&crossed(12e6, 1500, 12e6 * load), COUNT);
        let mean = waits.iter().sum::<f64>() / COUNT as f64;
        let expected = load / (2.0 * (1.0 - load));
        let variance = expected.powi(2) + load / (3.0 * (1.0 - load));
        // The queue decorrelates with the time constant S / (1 - sqrt(rho))^2, 90 ms at most here, so
        // neighbours are correlated.
        let memory_ms = 1.0 / (1.0 - load.sqrt()).powi(2);
        let correlation = (-20.0 / memory_ms).exp();
        let inflation = (1.0 + correlation) / (1.0 - correlation);
        let sigma = (variance * inflation / COUNT as f64).sqrt();
        assert!((mean - expected).abs() < 4.0 * sigma, "{load}: {mean} {expected} {sigma}");
        assert!(4.0 * sigma < 0.08 * expected, "the test is blind: {sigma}");
    }
}

#[test]
fn cross_traffic_pauses_for_the_given_fraction_of_time() {
    let mut settings = crossed(8e7, 1000, 8e6);
    let cross = settings.cross_traffic.as_mut().unwrap();
    (cross.mean_on_s, cross.mean_off_s) = (Some(0.01), Some(0.03));
    let waits = waits_ms(&settings, 50_000);
    let busy = waits.iter().filter(|&&wait| wait > 0.0).count() as f64 / 50_000.0;
    // A quarter of the time, a load of a tenth.
    assert!((busy - 0.025).abs() < 4.0 * (0.025_f64 / 50_000.0).sqrt(), "{busy}");
    let alone = LinkSettings {
        cross_traffic: settings.cross_traffic.map(|cross| CrossTraffic { mean_off_s: None, ..cross }),
        ..settings
    };
    assert!(alone.validate().unwrap_err().to_string().contains("mean_on_s and mean_off_s"));
}

#[test]
fn a_long_silence_costs_no_more_than_a_short_one() {
    let mut settings = crossed(1e9, 1000, 8e8);
    settings.cross_traffic.as_mut().unwrap().mean_on_s = Some(1e-4);
    settings.cross_traffic.as_mut().unwrap().mean_off_s = Some(1e-4);
    let times = [0, MS, 1_000_000_000_000_000_000, u64::MAX - 1, u64::MAX];
    let packets: Vec<(u64, usize)> = times.into_iter().map(|sent_ns| (sent_ns, 64)).collect();
    assert_eq!(verdicts(&settings, &packets).len(), 5);
    // Overloaded queue with the longest memory.
    let deep = LinkSettings { queue_packets: Some(10_000_000), ..crossed(1.0, 1500, 1e10) };
    assert_eq!(verdicts(&deep, &[(0, 64), (1_000_000_000_000_000_000, 64)]).len(), 2);
}

/// Cross traffic does not depend on the link's own packets.
#[test]
fn own_packets_do_not_shift_cross_traffic() {
    let settings = crossed(12e6, 1500, 6e6);
    let sparse = verdicts(&settings, &[(500 * MS, 0), (900 * MS, 0)]);
    let dense: Vec<(u64, usize)> = (0..=900).map(|step| (step * MS, 0)).collect();
    let dense = verdicts(&settings, &dense);
    assert_eq!(sparse, [dense[500], dense[900]]);
}

#[test]
fn waits_are_the_same_on_every_platform() {
    let mut settings = crossed(12e6, 1500, 9e6);
    let cross = settings.cross_traffic.as_mut().unwrap();
    (cross.mean_on_s, cross.mean_off_s) = (Some(0.02), Some(0.01));
    let packets: Vec<(u64, usize)> = (0..20).map(|index| (index * 7 * MS, 64)).collect();
    let waits: Vec<u64> = departures(&verdicts(&settings, &packets))
        .iter()
        .zip(&packets)
        .map(|(at, sent)| at.unwrap() - sent.0)
        .collect();
    assert_eq!(
        waits[10..],
        [958_025, 42_667, 1_166_934, 42_667, 42_667, 1_249_303, 42_667, 368_920, 42_667, 2_274_363]
    );
}
