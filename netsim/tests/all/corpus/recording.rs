//! Fuzz target: all readers of recordings on the same bytes.

use haptether_netsim::{
    DelayTrace, Direction, Distribution, Link, LinkSettings, Opportunities, ParseError, parse_delay_csv,
    parse_dist, parse_irtt, parse_mahimahi,
};

/// Panics unless each reader rejects `bytes` with a position inside them, or returns settings that build a
/// link.
pub(crate) fn check(bytes: &[u8]) {
    for direction in [Direction::Forward, Direction::Backward] {
        let csv = parse_delay_csv(bytes, direction);
        buildable(bytes, csv.map(delays), "csv");
        let irtt = parse_irtt(bytes, direction);
        buildable(bytes, irtt.map(|recording| delays(recording.delays)), "irtt");
    }
    buildable(bytes, parse_mahimahi(bytes).map(opportunities), "mahimahi");
    buildable(bytes, parse_dist(bytes).map(table), "dist");
}

fn delays(trace: DelayTrace) -> LinkSettings {
    assert_eq!(trace.time_s.len(), trace.delay_s.len());
    LinkSettings { trace: Some(trace), ..LinkSettings::default() }
}

fn opportunities(opportunities: Opportunities) -> LinkSettings {
    LinkSettings { opportunities: Some(opportunities), ..LinkSettings::default() }
}

fn table(values: Vec<i16>) -> LinkSettings {
    // One of 16384 values far from the others lies 128 deviations from the mean: no delay may be negative.
    let distribution = Distribution::Table(values);
    LinkSettings { delay_s: 1.0, jitter_s: 0.005, distribution, ..LinkSettings::default() }
}

fn buildable(bytes: &[u8], read: Result<LinkSettings, ParseError>, format: &str) {
    match read {
        Ok(settings) => {
            let link = Link::new(Direction::Forward, 1, &settings);
            assert!(link.is_ok(), "{format} was read, but its link is invalid: {link:?}");
        }
        Err(error) => {
            let lines = bytes.split(|&byte| byte == b'\n').count();
            assert!((1..=lines).contains(&error.line), "{format}: {error} of {lines} lines");
            assert!((1..=bytes.len() + 2).contains(&error.column), "{format}: {error}");
            assert!(!error.problem.is_empty() && !error.problem.contains('\n'), "{format}: {error}");
            // Fits a log line for any input.
            assert!(error.problem.chars().count() < 400, "{format}: {error}");
        }
    }
}
