//! Settings without a valid delay distribution.

use super::skewed_table;
use crate::{DelayLaw, Direction, Distribution, Link, LinkSettings};

fn settings(delay_s: f64, jitter_s: f64, distribution: Distribution, shape: Option<f64>) -> LinkSettings {
    LinkSettings { delay_s, jitter_s, distribution, distribution_shape: shape, ..LinkSettings::default() }
}

#[test]
fn jitter_that_needs_negative_delays_is_refused_with_limit_and_remedy() {
    // Maximum deviation at a mean of 0.01 s.
    let cases = [
        (Distribution::Normal, None, 0.0099, "gamma or lognormal"),
        (Distribution::Uniform, None, 0.01 / 3_f64.sqrt(), "gamma or lognormal"),
        (Distribution::Exponential, None, 0.01, "gamma or lognormal"),
        (Distribution::Gamma, None, 0.01 / 0.05_f64.sqrt(), "lognormal"),
        (Distribution::Gamma, Some(4.0), 0.005, "smaller distribution_shape"),
        (Distribution::Lognormal, None, 0.05, "larger delay_s"),
        (Distribution::Pareto, None, 0.01 / 0.6_f64.sqrt(), "lognormal"),
        // Uniform distribution by 4096 values, which ends half a step early on each side.
        (Distribution::Table((-2048..2048).collect()), None, 0.01 / 1.732, "larger delay_s"),
    ];
    for (distribution, shape, most_s, remedy) in cases {
        let asked = |jitter_s| DelayLaw::new(&settings(0.01, jitter_s, distribution.clone(), shape));
        let law = asked(most_s * 0.999).unwrap();
        assert!(law.quantile_s(0.0) >= 0.0, "{distribution:?}");
        let error = asked(most_s * 1.001).unwrap_err().to_string();
        assert!(error.starts_with("jitter_s: 0.0") && error.contains("delay_s = 0.01"), "{error}");
        assert!(error.contains("at most 0.0") && error.contains(remedy), "{error}");
    }
}

#[test]
fn jitter_at_the_limit_is_accepted() {
    for (jitter_s, distribution, shape) in [
        (0.05, Distribution::Exponential, None),
        (0.05 / 3_f64.sqrt(), Distribution::Uniform, None),
        (0.05 / 2_f64.sqrt(), Distribution::Gamma, Some(2.0)),
        (0.05 / 0.6_f64.sqrt(), Distribution::Pareto, None),
    ] {
        let law = DelayLaw::new(&settings(0.05, jitter_s, distribution, shape)).unwrap();
        assert!((0.0..1e-12).contains(&law.quantile_s(0.0)), "{law:?}");
    }
}

#[test]
fn shapes_tables_and_times_are_checked() {
    let error = |settings: &LinkSettings| Link::new(Direction::Forward, 0, settings).unwrap_err().to_string();
    let asked = |distribution, shape| error(&settings(0.05, 0.005, distribution, shape));
    assert_eq!(
        asked(Distribution::Pareto, Some(2.0)),
        "distribution_shape = 2: must be a finite number from 2.5 to 100"
    );
    assert_eq!(
        asked(Distribution::Gamma, Some(f64::NAN)),
        "distribution_shape = NaN: must be a finite number from 0.05 to 10000"
    );
    assert_eq!(
        asked(Distribution::Normal, Some(2.0)),
        "distribution_shape: only the distributions gamma and pareto have a shape to choose"
    );
    assert_eq!(
        asked(Distribution::Table(vec![1]), None),
        "distribution: a table of 1 values: must have from 2 to 16384"
    );
    assert_eq!(
        asked(Distribution::Table(vec![7; 9]), None),
        "distribution: all values of the table are 7: must differ"
    );
    let negative = LinkSettings {
        jitter_correlation_s: Some(-1.0),
        ..settings(0.05, 0.005, Distribution::Table(skewed_table()), None)
    };
    assert_eq!(error(&negative), "jitter_correlation_s = -1: must be a finite number from 0 to 3600");
}

#[test]
fn extreme_settings_that_are_accepted_build_finite_delays() {
    for (delay_s, jitter_s, distribution, shape) in [
        (3600.0, 1e-9, Distribution::Normal, None),
        (3600.0, 3500.0, Distribution::Normal, None),
        (1e-9, 9.8e-10, Distribution::Normal, None),
        (3600.0, 1e-6, Distribution::Gamma, None),
        (1.0, 4.4, Distribution::Gamma, None),
        (3600.0, 3600.0, Distribution::Pareto, Some(2.5)),
        (1.0, 5.0, Distribution::Lognormal, None),
        (1.0, 0.01, Distribution::Gamma, Some(1e4)),
        (1.0, 0.01, Distribution::Gamma, Some(0.05)),
        (1.0, 0.5, Distribution::Table(vec![i16::MIN, i16::MAX]), None),
    ] {
        for keep_order in [true, false] {
            let settings =
                LinkSettings { keep_order, ..settings(delay_s, jitter_s, distribution.clone(), shape) };
            let delays = super::delays(&settings, 1000, 1000);
            // No accepted distribution reaches 1e6 standard deviations within a thousand packets.
            let most = (delay_s + 1e6 * jitter_s) * 1e9;
            assert!(delays.iter().all(|&ns| (ns as f64) < most), "{distribution:?}");
        }
    }
}
