//! Statistics of many delays compared with their distribution.

use super::{correlated, delays, delays_at, independent, laws};
use crate::checks::nanoseconds;
use crate::{DelayLaw, LinkSettings};

/// Correlation time of the delays in s; 0 if each is independent.
fn memory_s(settings: &LinkSettings) -> f64 {
    match (settings.jitter_correlation_s, settings.keep_order) {
        (Some(0.0), false) => 0.0,
        (tau_s, false) => tau_s.unwrap_or(0.1),
        // As short as order permits.
        (tau_s, true) => tau_s.unwrap_or(0.1).max(4.0 * settings.jitter_s),
    }
}

/// Fourth central moment in units of sigma: an integral over the normal variate.
fn kurtosis(law: &DelayLaw) -> f64 {
    const STEP: f64 = 0.01;
    let terms = (-600..=600).map(|n| {
        let z = f64::from(n) * STEP;
        let x = (law.quantile_s(0.5 * libm::erfc(-z / 2_f64.sqrt())) - law.mean_s()) / law.sigma_s();
        (-0.5 * z * z).exp() / (2.0 * std::f64::consts::PI).sqrt() * x.powi(4) * STEP
    });
    terms.sum()
}

/// Standard error of the mean of a series, from a hundred parts of many correlation times each.
fn standard_error(values: &[f64]) -> f64 {
    const PARTS: usize = 100;
    let mean_of = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let mean = mean_of(values);
    let parts = values.chunks_exact(values.len() / PARTS).map(mean_of);
    let spread: f64 = parts.map(|part| (part - mean).powi(2)).sum::<f64>() / (PARTS - 1) as f64;
    (spread / PARTS as f64).sqrt()
}

/// Check mean, standard deviation and 99th percentile, within 2 % or three standard errors, whichever is
/// larger.
///
/// No function of an Ornstein-Uhlenbeck process decorrelates more slowly than `exp(-t / tau)`. The mean of a
/// function with variance v over a time T therefore has at most the variance `2 tau v / T`. Order limits how
/// fast a heavy tail comes and goes, which takes longer; the error from the parts of the series then applies,
/// if larger.
fn assert_moments(name: &str, settings: &LinkSettings, delays_ns: &[u64], period_s: f64) {
    let law = DelayLaw::new(settings).unwrap();
    let (mean, sigma, p99) = (law.mean_s(), law.sigma_s(), law.quantile_s(0.99));
    let count = delays_ns.len() as f64;
    let own = count.min(count * period_s / (2.0 * memory_s(settings)));
    let average = |values: &[f64], variance: f64| {
        (values.iter().sum::<f64>() / count, (variance / own).sqrt().max(standard_error(values)))
    };
    // In standard deviations from the mean.
    let mut x: Vec<f64> = delays_ns.iter().map(|&ns| (ns as f64 * 1e-9 - mean) / sigma).collect();
    let squares: Vec<f64> = x.iter().map(|x| x * x).collect();
    let above: Vec<f64> = x.iter().map(|x| f64::from(u8::from(mean + x * sigma > p99))).collect();

    // 2 % of sigma, not of the mean, which would accept nearly anything.
    let (bias, error) = average(&x, 1.0);
    assert!(bias.abs() < (3.0 * error).max(0.02), "{name}: mean off by {bias} +- {error} sigma");
    let (square, error) = average(&squares, kurtosis(&law) - 1.0);
    let (seen, error) = (square.sqrt(), 0.5 * error);
    assert!((seen - 1.0).abs() < (3.0 * error).max(0.02), "{name}: sigma {seen} +- {error} of the request");
    // The percentile is above (below) a limit if more (less) than 1 % of the packets are.
    let (share, error) = average(&above, 0.0099);
    let rank = x.len() * 99 / 100;
    let seen = mean + sigma * *x.select_nth_unstable_by(rank, f64::total_cmp).1;
    let close = (seen / p99 - 1.0).abs() < 0.02 || (share - 0.01).abs() < 3.0 * error;
    assert!(close, "{name}: p99 {seen}, asked {p99}; {share} +- {error} above");
}

/// Checks that the path itself keeps order, with a tenth of the packet spacing to spare: no packet waits.
fn assert_in_order(name: &str, delays_ns: &[u64], period_ns: u64) {
    let slack = period_ns / 10 - 2;
    let close = delays_ns.windows(2).position(|pair| pair[1] + period_ns < pair[0] + slack);
    assert_eq!(close, None, "{name}");
}

#[test]
fn independent_delays_have_the_given_moments() {
    for (name, settings) in laws() {
        let settings = independent(&settings);
        let delays = delays(&settings, 1000, 1_000_000);
        assert_moments(name, &settings, &delays, 0.001);
    }
}

fn check_in_order(tau_s: f64, rate_hz: u64, packets: u64) {
    for (name, settings) in laws() {
        let settings = correlated(&settings, tau_s);
        let delays = delays(&settings, rate_hz, packets);
        assert_moments(name, &settings, &delays, 1.0 / rate_hz as f64);
        assert_in_order(name, &delays, 1_000_000_000 / rate_hz);
    }
}

#[test]
fn correlated_delays_in_order_have_the_given_moments_at_20_ms() {
    check_in_order(0.02, 1000, 1_000_000);
}

#[test]
fn correlated_delays_in_order_have_the_given_moments_at_50_ms() {
    check_in_order(0.05, 1000, 1_000_000);
}

#[test]
fn correlated_delays_in_order_have_the_given_moments_at_100_ms() {
    check_in_order(0.1, 1000, 1_000_000);
}

#[test]
fn delays_in_order_without_a_correlation_time_have_the_given_moments() {
    check_in_order(0.0, 1000, 1_000_000);
}

#[test]
fn delays_have_the_given_moments_at_other_rates() {
    check_in_order(0.05, 100, 200_000);
    check_in_order(0.02, 10_000, 1_000_000);
}

#[test]
fn correlated_delays_out_of_order_have_the_given_moments() {
    for (name, settings) in laws() {
        let settings = LinkSettings { keep_order: false, ..correlated(&settings, 0.05) };
        assert_moments(name, &settings, &delays(&settings, 1000, 1_000_000), 0.001);
    }
}

/// Kolmogorov-Smirnov distance between delays and distribution, times the root of their number. It exceeds
/// 1.95 with a probability of 0.1 %.
fn distance(law: &DelayLaw, delays_ns: &mut [u64]) -> f64 {
    const STEPS: usize = 2000;
    delays_ns.sort_unstable();
    let count = delays_ns.len() as f64;
    let apart = (1..STEPS).map(|step| {
        let p = step as f64 / STEPS as f64;
        let limit = law.quantile_s(p) * 1e9;
        (delays_ns.partition_point(|&ns| (ns as f64) < limit) as f64 / count - p).abs()
    });
    apart.fold(0.0, f64::max) * count.sqrt()
}

#[test]
fn the_whole_distribution_of_independent_delays_is_that_of_the_law() {
    for (name, settings) in laws() {
        let law = DelayLaw::new(&settings).unwrap();
        let seen = distance(&law, &mut delays(&independent(&settings), 1000, 400_000));
        assert!(seen < 1.95, "{name}: {seen}");
    }
}

/// At a spacing of eight correlation times, delays are independent to within exp(-8).
#[test]
fn the_whole_distribution_of_correlated_delays_is_that_of_the_law() {
    for (name, settings) in laws() {
        let law = DelayLaw::new(&settings).unwrap();
        let tau_s = (4.0 * settings.jitter_s).max(0.05);
        let times = (0..8000).map(|index| index * nanoseconds(8.0 * tau_s));
        let seen = distance(&law, &mut delays_at(&correlated(&settings, tau_s), times));
        assert!(seen < 1.95, "{name}: {seen}");
    }
}

fn autocorrelation(values: &[f64], lag: usize) -> f64 {
    let centred =
        |values: &[f64]| values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64;
    let sum: f64 = values.iter().zip(&values[lag..]).map(|(a, b)| a * b).sum();
    sum / (values.len() - lag) as f64 / centred(values)
}

fn milliseconds(seconds: f64) -> usize {
    usize::try_from(nanoseconds(seconds) / 1_000_000).unwrap()
}

/// The velocity of the path decorrelates over `eps = tau / n`, n from 12 (steep) to 50. An Ornstein-Uhlenbeck
/// process with this inertia has the autocorrelation `(a exp(-b t) - b exp(-a t)) / (a - b)`,
/// `a + b = 1 / eps`, `a b = 1 / (tau eps)`. It exceeds `exp(-t / tau)` by up to `eps / tau` of it. Bartlett:
/// the standard error of an estimate over a time T is at most `sqrt(tau / T)`.
#[test]
fn normal_delays_decorrelate_exponentially() {
    for (sigma_s, tau_s, turns) in [
        (0.0005, 0.05, 50.0),
        (0.005, 0.1, 50.0),
        (0.005, 0.05, 50.0),
        (0.005, 0.02, 12.0),
        (0.02, 0.1, 12.5),
    ] {
        let settings = LinkSettings { delay_s: 0.2, jitter_s: sigma_s, ..LinkSettings::default() };
        let settings = correlated(&settings, tau_s);
        let delays = delays(&settings, 1000, 2_000_000);
        let deviations: Vec<f64> = delays.iter().map(|&ns| ns as f64 * 1e-9 - 0.2).collect();
        let error = (tau_s / 2000.0).sqrt();
        for lag in [0.2, 1.0, 2.0] {
            let seen = autocorrelation(&deviations, milliseconds(lag * tau_s));
            let asked = (-lag).exp();
            let tolerance = 3.0 * error + 1.2 * asked / turns;
            assert!(
                (seen - asked).abs() < tolerance,
                "{sigma_s} {tau_s} {lag}: {seen}, asked {asked} +- {tolerance}"
            );
        }
    }
}

/// Delays of every distribution have correlation 1 / e over the requested correlation time.
///
/// The inertia of the path adds at most `1.2 / turns` of it, as for the normal distribution. These deviations
/// of 1 / 200 of tau permit this even if the path keeps order. The standard error comes from a hundred parts,
/// each of a thousand correlation times.
#[test]
fn every_distribution_has_correlation_one_e_over_its_time() {
    let asked = (-1.0_f64).exp();
    for keep_order in [true, false] {
        for (name, settings) in laws() {
            let shrink = 0.0005 / settings.jitter_s;
            let settings = LinkSettings {
                delay_s: settings.delay_s * shrink,
                jitter_s: 0.0005,
                keep_order,
                ..correlated(&settings, 0.1)
            };
            let law = DelayLaw::new(&settings).unwrap();
            let times = (0..100_001).map(|index| index * nanoseconds(0.1));
            let delays = delays_at(&settings, times);
            let x: Vec<f64> =
                delays.iter().map(|&ns| (ns as f64 * 1e-9 - law.mean_s()) / law.sigma_s()).collect();
            let products: Vec<f64> = x.windows(2).map(|pair| pair[0] * pair[1]).collect();
            let seen = products.iter().sum::<f64>() / products.len() as f64;
            let error = standard_error(&products);
            let (low, high) = (asked - 4.0 * error, asked * (1.0 + 1.2 / 50.0) + 4.0 * error);
            assert!((low..high).contains(&seen), "{name} {keep_order}: {seen} +- {error}, asked {asked}");
        }
    }
}

#[test]
fn the_path_is_the_same_at_any_rate() {
    for (name, settings) in laws() {
        let settings = correlated(&settings, 0.05);
        let fast = delays(&settings, 10_000, 100_000);
        let medium = delays(&settings, 1000, 10_000);
        let slow = delays(&settings, 100, 1000);
        assert!(fast.iter().step_by(10).eq(&medium), "{name}");
        assert!(medium.iter().step_by(10).eq(&slow), "{name}");
    }
}

#[test]
fn silence_costs_little_and_forgets() {
    let times = (0..1000).chain((1..2000).map(|n| n * 900_000_000_000_000)).chain([1 << 62, u64::MAX >> 1]);
    for (name, settings) in laws() {
        let law = DelayLaw::new(&settings).unwrap();
        let delays = delays_at(&settings, times.clone());
        let rare: Vec<f64> = delays[1000..].iter().map(|&ns| ns as f64 * 1e-9).collect();
        let mean = rare.iter().sum::<f64>() / rare.len() as f64;
        let error = law.sigma_s() / (rare.len() as f64).sqrt();
        assert!((mean - law.mean_s()).abs() < 3.0 * error, "{name}: {mean} +- {error}");
        assert!(delays_at(&settings, [u64::MAX - 1_000_000_000_000]).len() == 1);
    }
}

/// Run by hand: `cargo test --release -p haptether-netsim delay_statistics -- --ignored --nocapture`.
#[test]
#[ignore = "a table to read, not an assertion"]
fn delay_statistics() {
    println!("law, tau, in order: errors of mean, sigma (of sigma), p99; autocorrelation at 0.2, 1, 2 tau");
    for (name, settings) in laws() {
        let law = DelayLaw::new(&settings).unwrap();
        for (tau_s, keep_order) in [(0.0, false), (0.02, true), (0.05, true), (0.1, true), (0.05, false)] {
            let settings = LinkSettings { keep_order, ..correlated(&settings, tau_s) };
            let seen = delays(&settings, 1000, 1_000_000);
            let mut deviations: Vec<f64> =
                seen.iter().map(|&ns| (ns as f64 * 1e-9 - law.mean_s()) / law.sigma_s()).collect();
            let at = |lag: f64| autocorrelation(&deviations, milliseconds(lag * tau_s));
            let memory = [0.2, 1.0, 2.0].map(at);
            let bias = deviations.iter().sum::<f64>() / 1e6;
            let sigma = deviations.iter().map(|x| x * x).sum::<f64>() / 1e6;
            let p99 = *deviations.select_nth_unstable_by(990_000, f64::total_cmp).1;
            let asked = (law.quantile_s(0.99) - law.mean_s()) / law.sigma_s();
            println!(
                "{name:15} {tau_s:5} {keep_order:5}: {bias:+.4} {:+.4} {:+.4}; {memory:.3?}",
                sigma.sqrt() - 1.0,
                p99 - asked
            );
        }
    }
}
