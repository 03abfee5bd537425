//! The delay follows its law: moments, quantiles, whole distribution, memory, order.

use crate::{DelayLaw, Direction, Distribution, Link, LinkSettings, Packet, Verdict};

const SEED: u64 = 0x5EED_0000_0000_0004;

/// What the tests call a law, and the settings of it at 50 ms +- 5 ms or so.
fn laws() -> Vec<(&'static str, LinkSettings)> {
    let settings = |jitter_s, distribution, distribution_shape| LinkSettings {
        delay_s: 0.05,
        jitter_s,
        distribution,
        distribution_shape,
        ..LinkSettings::default()
    };
    vec![
        ("normal", settings(0.005, Distribution::Normal, None)),
        ("normal, cut", settings(0.035, Distribution::Normal, None)),
        ("uniform", settings(0.005, Distribution::Uniform, None)),
        ("exponential", settings(0.005, Distribution::Exponential, None)),
        ("gamma", settings(0.025, Distribution::Gamma, None)),
        ("gamma, shape 2", settings(0.005, Distribution::Gamma, Some(2.0))),
        ("lognormal", settings(0.01, Distribution::Lognormal, None)),
        ("pareto", settings(0.005, Distribution::Pareto, None)),
        ("table", settings(0.005, Distribution::Table(skewed_table()), None)),
    ]
}

/// Neither mean 0 nor deviation 1, as the tables of iproute2.
fn skewed_table() -> Vec<i16> {
    (0..4096).map(|i| i16::try_from(i * i / 700 - 7000).unwrap()).collect()
}

/// Delays in s of packets sent at a rate, all of which arrive, and whether they arrive in order.
fn delays(settings: &LinkSettings, rate_hz: u64, packets: u64) -> (Vec<f64>, bool) {
    let mut link = Link::new(Direction::Forward, SEED, settings).unwrap();
    let period_ns = 1_000_000_000 / rate_hz;
    let delays = (0..packets)
        .map(|index| {
            let sent_ns = index * period_ns;
            let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index };
            match link.judge(&packet).verdict {
                Verdict::Deliver { at_ns } => (at_ns - sent_ns) as f64 * 1e-9,
                Verdict::Drop { .. } => panic!("no rule drops"),
            }
        })
        .collect();
    (delays, link.counters().overtaking == 0)
}

fn moments(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

fn p99(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    let rank = sorted.len() * 99 / 100;
    *sorted.select_nth_unstable_by(rank, f64::total_cmp).1
}

fn autocorrelation(values: &[f64], lag: usize) -> f64 {
    let (mean, sigma) = moments(values);
    let pairs = values.iter().zip(&values[lag..]);
    let sum: f64 = pairs.map(|(a, b)| (a - mean) * (b - mean)).sum();
    sum / (values.len() - lag) as f64 / (sigma * sigma)
}

#[test]
#[ignore = "a table to read"]
fn measure() {
    for (name, settings) in laws() {
        for (tau_s, keep_order) in [(0.0, false), (0.02, true), (0.05, true), (0.1, true), (0.0, true), (0.05, false)] {
            let settings = LinkSettings { jitter_correlation_s: Some(tau_s), keep_order, ..settings.clone() };
            let law = DelayLaw::new(&settings).unwrap();
            let started = std::time::Instant::now();
            let (delays, ordered) = delays(&settings, 1000, 1_000_000);
            let cost = started.elapsed().as_nanos() as f64 / 1e6;
            let (mean, sigma) = moments(&delays);
            let at = |part: f64| if tau_s > 0.0 { autocorrelation(&delays, (part * tau_s * 1e3) as usize) } else { 0.0 };
            println!(
                "{name:15} tau {tau_s:5} order {keep_order:5} {ordered:5} mean {:+.4} sigma {:+.4} p99 {:+.4} acf {:.3} {:.3} {:.3}  {cost:.0} ns",
                (mean - law.mean_s()) / law.sigma_s(),
                sigma / law.sigma_s() - 1.0,
                p99(&delays) / law.quantile_s(0.99) - 1.0,
                at(0.2), at(1.0), at(2.0),
            );
        }
    }
}
