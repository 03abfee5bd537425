//! Outages: schedule, duration, effect.

use super::chains::{MANY, bursts, check_geometric, lost, two_states};
use crate::{Direction, DropCause, Link, LinkSettings, Outage, OutageEffect, OutageTimes, Packet, Verdict};

const MILLISECOND: u64 = 1_000_000;

fn outages(times: &[OutageTimes], effect: OutageEffect) -> LinkSettings {
    let outages = times.iter().map(|&times| Outage { times, effect }).collect();
    LinkSettings { outages, ..LinkSettings::default() }
}

#[test]
fn outages_at_given_times_take_exactly_what_is_sent_during_them() {
    let once = OutageTimes::Once { at_s: 0.1, duration_s: 0.05 };
    let periodic = OutageTimes::Periodic { at_s: 0.02, period_s: 0.2, duration_s: 0.004 };
    let in_once = |ms: u64| (100..150).contains(&ms);
    let in_periodic = |ms: u64| ms >= 20 && (ms - 20) % 200 < 4;
    let settings = outages(&[once, periodic], OutageEffect::Drop);
    for (ms, lost) in (0..).zip(lost(&settings, MILLISECOND, MANY)) {
        assert_eq!(lost, in_once(ms) || in_periodic(ms), "{ms}");
    }
    let mut link = Link::new(Direction::Forward, 0, &settings).unwrap();
    let packet = Packet { direction: Direction::Forward, sent_ns: 100 * MILLISECOND, size: 64, index: 0 };
    assert_eq!(link.judge(&packet).verdict, Verdict::Drop { cause: DropCause::Outage });
}

#[test]
fn random_outages_have_the_share_and_the_duration_asked_for() {
    for (mean_up_s, mean_down_s) in [(0.5, 0.02), (0.02, 0.05), (0.002, 0.1)] {
        let settings = outages(&[OutageTimes::Random { mean_up_s, mean_down_s }], OutageEffect::Drop);
        let lost = lost(&settings, MILLISECOND, MANY);
        // Sampled every ms, a two-state process is a chain, as in Gilbert loss in time.
        let share = mean_down_s / (mean_up_s + mean_down_s);
        let rho = (-0.001 * (1.0 / mean_up_s + 1.0 / mean_down_s)).exp();
        let (start, stay) = (share * (1.0 - rho), share + (1.0 - share) * rho);
        two_states(start, stay).check_rate(&lost, share);
        check_geometric(&bursts(&lost), stay);
    }
}

#[test]
fn each_random_outage_has_its_own_times() {
    let random = OutageTimes::Random { mean_up_s: 0.05, mean_down_s: 0.05 };
    let one = lost(&outages(&[random], OutageEffect::Drop), MILLISECOND, MANY);
    let two = lost(&outages(&[random, random], OutageEffect::Drop), MILLISECOND, MANY);
    assert!(one.iter().zip(&two).all(|(one, two)| !one || *two), "the second moved the first");
    let passing = two.iter().filter(|lost| !**lost).count() as f64 / MANY as f64;
    assert!((passing - 0.25).abs() < 0.01, "{passing}");
}

#[test]
fn held_packets_arrive_in_order_when_the_outage_is_over() {
    let times = [
        OutageTimes::Once { at_s: 0.1, duration_s: 0.05 },
        OutageTimes::Once { at_s: 0.12, duration_s: 0.06 },
        OutageTimes::Random { mean_up_s: 0.3, mean_down_s: 0.02 },
    ];
    let settings = LinkSettings { delay_s: 0.005, ..outages(&times, OutageEffect::Hold) };
    let dropping = outages(&times, OutageEffect::Drop);
    let out = lost(&dropping, MILLISECOND, 100_000);
    let mut link = Link::new(Direction::Forward, super::chains::SEED, &settings).unwrap();
    let mut latest_ns = 0;
    let mut held = 0;
    for (index, out) in (0..).zip(out) {
        let sent_ns = index * MILLISECOND;
        let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index };
        let Verdict::Deliver { at_ns } = link.judge(&packet).verdict else { panic!("a hold drops nothing") };
        assert!(at_ns >= latest_ns && at_ns >= sent_ns + 5 * MILLISECOND);
        latest_ns = at_ns;
        if out {
            held += u64::from(at_ns > sent_ns + 5 * MILLISECOND);
        }
        match index {
            99 => assert_eq!(at_ns, 104 * MILLISECOND),
            100..120 => assert!(at_ns >= 150 * MILLISECOND),
            120..170 => assert!(at_ns >= 180 * MILLISECOND),
            _ => {}
        }
    }
    assert!(held > 3000, "{held}");
}

#[test]
fn a_long_silence_costs_no_more_than_a_short_one() {
    let random = OutageTimes::Random { mean_up_s: 1e-6, mean_down_s: 1e-3 };
    let burst = LinkSettings { loss: 0.5, mean_burst_s: Some(1e-6), ..LinkSettings::default() };
    let chain = LinkSettings { loss: 0.5, mean_burst: Some(1e9), ..LinkSettings::default() };
    let held = outages(&[random], OutageEffect::Hold);
    for settings in [outages(&[random], OutageEffect::Drop), held, burst, chain] {
        let mut link = Link::new(Direction::Forward, 1, &settings).unwrap();
        for power in 0..64 {
            // Times and indices that double: from ns to centuries.
            let far = (1_u64 << power) - 1 + (1_u64 << power);
            let packet = Packet { direction: Direction::Forward, sent_ns: far, size: 64, index: far };
            link.judge(&packet);
        }
        assert_eq!(link.counters().sent, 64);
    }
}
