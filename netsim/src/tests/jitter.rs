//! Delays follow their distribution: moments, quantiles, shape, correlation, order.

mod known_answers;
mod refusals;
mod statistics;

use crate::{Direction, Distribution, Link, LinkSettings, Packet, Verdict};

const SEED: u64 = 0x5EED_0000_0000_0004;

/// Link settings per distribution, with a name for messages.
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

/// Mean not 0 and deviation not 1, as in the tables of iproute2.
fn skewed_table() -> Vec<i16> {
    (0..4096).map(|i| i16::try_from(i + i * i / 1000 - 7000).unwrap()).collect()
}

fn independent(settings: &LinkSettings) -> LinkSettings {
    LinkSettings { keep_order: false, jitter_correlation_s: Some(0.0), ..settings.clone() }
}

fn correlated(settings: &LinkSettings, tau_s: f64) -> LinkSettings {
    LinkSettings { jitter_correlation_s: Some(tau_s), ..settings.clone() }
}

/// Delays in ns of packets sent at given times; all arrive.
fn delays_at(settings: &LinkSettings, times_ns: impl IntoIterator<Item = u64>) -> Vec<u64> {
    let direction = Direction::Forward;
    let mut link = Link::new(direction, SEED, settings).unwrap();
    let delay = |(index, sent_ns)| match link
        .judge(&Packet { direction, sent_ns, size: 64, index: index as u64 })
        .verdict
    {
        Verdict::Deliver { at_ns } => at_ns - sent_ns,
        Verdict::Drop { cause } => panic!("{cause:?}"),
    };
    times_ns.into_iter().enumerate().map(delay).collect()
}

fn delays(settings: &LinkSettings, rate_hz: u64, packets: u64) -> Vec<u64> {
    delays_at(settings, (0..packets).map(|index| index * (1_000_000_000 / rate_hz)))
}
