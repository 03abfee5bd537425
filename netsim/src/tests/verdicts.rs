//! Verdicts of the virtual driver: golden values, statistics, independence of the impairments.

use super::{rough, scattered, virtual_delays};
use crate::checks::nanoseconds;
use crate::{Direction, Distribution, Link, LinkSettings, Packet, Verdict};

const SEED: u64 = 0x5EED_0000_0000_0001;
/// First seed that loses exactly one of the first 16 packets.
const GOLDEN_SEED: u64 = 16;
const MANY: u64 = 1_000_000;

/// An independent implementation in Python with scipy gives the same values.
#[test]
fn verdicts_are_the_same_on_every_platform() {
    let forward = [
        Some(43_443_298),
        Some(43_796_844),
        Some(44_150_391),
        Some(44_503_937),
        Some(44_857_483),
        Some(44_696_188),
        Some(44_342_642),
        Some(43_989_096),
        Some(43_635_549),
        Some(43_282_003),
        Some(43_502_989),
        Some(43_856_535),
        None,
        Some(44_563_627),
        Some(44_917_174),
        Some(45_270_720),
    ];
    let backward = [Some(53_019_716), Some(52_666_170), Some(52_312_624), Some(51_959_077)];
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
fn uniform_jitter_is_uniform_around_the_delay() {
    const BINS: usize = 100;
    let settings = LinkSettings { loss: 0.0, distribution: Distribution::Uniform, ..scattered() };
    let delays = virtual_delays(Direction::Backward, SEED, &settings, MANY);
    let half_width_ns = nanoseconds(0.005 * 3_f64.sqrt());
    let least_ns = 50_000_000 - half_width_ns;
    let mut bins = [0_u64; BINS];
    let mut sum_ns = 0;
    for delay_ns in delays.into_iter().flatten() {
        assert!((least_ns..=least_ns + 2 * half_width_ns).contains(&delay_ns), "{delay_ns}");
        sum_ns += delay_ns;
        let bin = usize::try_from((delay_ns - least_ns) * BINS as u64 / (2 * half_width_ns + 1)).unwrap();
        bins[bin] += 1;
    }
    // The mean of a million is within 4 sigma / 1000.
    let mean_ns = sum_ns as f64 / MANY as f64;
    assert!((mean_ns - 50e6).abs() < 4.0 * 5e6 / 1000.0, "{mean_ns}");
    // Chi-square with 99 degrees of freedom: mean 99, sigma 14.
    let expected = MANY as f64 / BINS as f64;
    let chi_square: f64 = bins.iter().map(|&seen| (seen as f64 - expected).powi(2) / expected).sum();
    assert!((99.0 - 4.0 * 14.0..99.0 + 4.0 * 14.0).contains(&chi_square), "{chi_square}");
}

#[test]
fn one_impairment_shifts_no_other() {
    let delays = |settings| virtual_delays(Direction::Forward, SEED, &settings, 10_000);
    for settings in [rough(), scattered()] {
        let both = delays(settings.clone());
        let jitter_only = delays(LinkSettings { loss: 0.0, ..settings.clone() });
        let loss_only = delays(LinkSettings { jitter_s: 0.0, ..settings });
        assert!(both.iter().any(Option::is_none));
        for ((both, jittered), lossy) in both.iter().zip(&jitter_only).zip(&loss_only) {
            assert_eq!(both.is_none(), lossy.is_none());
            if both.is_some() {
                assert_eq!(both, jittered);
            }
        }
    }
}

#[test]
fn a_verdict_depends_only_on_settings_seed_and_packet() {
    let delays = |direction, seed| virtual_delays(direction, seed, &scattered(), 1000);
    let forward = delays(Direction::Forward, SEED);
    assert_eq!(forward, delays(Direction::Forward, SEED));
    assert_ne!(forward, delays(Direction::Forward, SEED + 1));
    assert_ne!(forward, delays(Direction::Backward, SEED));
    // Earlier packets do not affect a packet.
    let mut link = Link::new(Direction::Forward, SEED, &scattered()).unwrap();
    let packet = Packet { direction: Direction::Forward, sent_ns: 7, size: 1200, index: 999 };
    let expected = forward[999].unwrap();
    assert_eq!(link.judge(&packet).verdict, Verdict::Deliver { at_ns: 7 + expected });
}

#[test]
fn counters_add_up_and_tell_overtaking() {
    let mut link = Link::new(Direction::Forward, SEED, &scattered()).unwrap();
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
    assert!(overtaking > 5_000, "5 ms of jitter at 1 kHz: {overtaking}");
}
