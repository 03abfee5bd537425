//! Verdicts of the virtual driver: golden values, statistics, independence of the impairments.

use super::{rough, virtual_delays};
use crate::{Direction, Link, LinkSettings, Packet, Verdict};

const SEED: u64 = 0x5EED_0000_0000_0001;
/// The first seed that loses exactly one of the first 16 packets.
const GOLDEN_SEED: u64 = 16;
const MANY: u64 = 1_000_000;

/// The values were also computed by an independent implementation in Python integers.
#[test]
fn verdicts_are_the_same_on_every_platform() {
    let forward = [
        Some(42_516_611),
        Some(58_846_485),
        Some(56_049_517),
        Some(56_248_473),
        Some(52_463_797),
        Some(47_654_962),
        Some(51_699_668),
        Some(41_660_612),
        Some(43_357_043),
        Some(42_249_165),
        Some(48_699_023),
        Some(47_370_133),
        None,
        Some(56_552_223),
        Some(56_025_230),
        Some(56_759_361),
    ];
    let backward = [Some(41_558_923), Some(42_616_037), Some(53_562_547), Some(46_126_007)];
    assert_eq!(virtual_delays(Direction::Forward, GOLDEN_SEED, &rough(), 16), forward);
    assert_eq!(virtual_delays(Direction::Backward, GOLDEN_SEED, &rough(), 4), backward);
}

#[test]
fn loss_is_as_frequent_as_asked() {
    for probability in [0.001, 0.01, 0.3] {
        let settings = LinkSettings { loss: probability, ..LinkSettings::default() };
        let delays = virtual_delays(Direction::Forward, SEED, &settings, MANY);
        let lost = delays.iter().filter(|delay| delay.is_none()).count() as f64;
        let expected = probability * MANY as f64;
        let sigma = (expected * (1.0 - probability)).sqrt();
        assert!((lost - expected).abs() < 4.0 * sigma, "{probability}: {lost}");
    }
}

#[test]
fn the_ends_of_the_loss_range_are_exact() {
    for (loss, survives) in [(0.0, true), (1.0, false)] {
        let settings = LinkSettings { loss, ..LinkSettings::default() };
        let delays = virtual_delays(Direction::Forward, SEED, &settings, 10_000);
        assert!(delays.iter().all(|delay| delay.is_some() == survives));
    }
}

#[test]
fn jitter_is_uniform_around_the_delay() {
    const BINS: usize = 100;
    let settings = LinkSettings { loss: 0.0, ..rough() };
    let delays = virtual_delays(Direction::Backward, SEED, &settings, MANY);
    let mut bins = [0_u64; BINS];
    let mut sum_ns = 0;
    for delay_ns in delays.into_iter().flatten() {
        assert!((40_000_000..=60_000_000).contains(&delay_ns));
        sum_ns += delay_ns;
        let bin = usize::try_from((delay_ns - 40_000_000) / 200_000).unwrap();
        bins[bin.min(BINS - 1)] += 1;
    }
    // A uniform law of half-width w has sigma = w / sqrt(3); the mean of a million is within 4 sigma / 1000.
    let mean_ns = sum_ns as f64 / MANY as f64;
    assert!((mean_ns - 50e6).abs() < 4.0 * 10e6 / 3_f64.sqrt() / 1000.0, "{mean_ns}");
    // Chi-square with 99 degrees of freedom: mean 99, sigma 14.
    let expected = MANY as f64 / BINS as f64;
    let chi_square: f64 = bins.iter().map(|&seen| (seen as f64 - expected).powi(2) / expected).sum();
    assert!((99.0 - 4.0 * 14.0..99.0 + 4.0 * 14.0).contains(&chi_square), "{chi_square}");
}

#[test]
fn one_impairment_shifts_no_other() {
    let delays = |settings| virtual_delays(Direction::Forward, SEED, &settings, 10_000);
    let both = delays(rough());
    let jitter_only = delays(LinkSettings { loss: 0.0, ..rough() });
    let loss_only = delays(LinkSettings { jitter_s: 0.0, ..rough() });
    assert!(both.iter().any(Option::is_none));
    for ((both, jittered), lossy) in both.iter().zip(&jitter_only).zip(&loss_only) {
        assert_eq!(both.is_none(), lossy.is_none());
        if both.is_some() {
            assert_eq!(both, jittered);
        }
    }
}

#[test]
fn a_verdict_depends_on_settings_seed_and_packet_alone() {
    let delays = |direction, seed| virtual_delays(direction, seed, &rough(), 1000);
    let forward = delays(Direction::Forward, SEED);
    assert_eq!(forward, delays(Direction::Forward, SEED));
    assert_ne!(forward, delays(Direction::Forward, SEED + 1));
    assert_ne!(forward, delays(Direction::Backward, SEED));
    // The packets before it leave no trace on a packet.
    let mut link = Link::new(Direction::Forward, SEED, &rough()).unwrap();
    let packet = Packet { direction: Direction::Forward, sent_ns: 7, size: 1200, index: 999 };
    let expected = forward[999].unwrap();
    assert_eq!(link.judge(&packet).verdict, Verdict::Deliver { at_ns: 7 + expected });
}

#[test]
fn counters_add_up_and_tell_overtaking() {
    let mut link = Link::new(Direction::Forward, SEED, &rough()).unwrap();
    let mut latest = 0;
    let mut overtaking = 0;
    for index in 0..10_000 {
        let sent_ns = index * 1_000_000;
        let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index };
        if let Verdict::Deliver { at_ns } = link.judge(&packet).verdict {
            overtaking += u64::from(at_ns < latest);
            latest = latest.max(at_ns);
        }
    }
    let counters = link.counters();
    assert_eq!(counters.sent, 10_000);
    assert_eq!(counters.dropped + counters.delivered, counters.sent);
    assert_eq!(counters.overtaking, overtaking);
    assert!(overtaking > 5_000, "10 ms of jitter at 1 kHz: {overtaking}");
}
