use haptether_netsim::ClockSettings;

use super::*;

const MS: u64 = 1_000_000;

fn paced(settings: ClockSettings, ticks: usize) -> Vec<(u64, Wake)> {
    let mut pace = Pace::new(Some(EndpointClock::new(&settings).unwrap()), MS);
    let mut tick = || {
        let wake = pace.wake();
        let at_ns = pace.true_ns;
        pace.wait_after(&wake);
        (at_ns, wake)
    };
    (0..ticks).map(|_| tick()).collect()
}

/// A device whose sample period is `drift_ppm` longer than 1 ms.
struct Device {
    pace: DevicePace,
    now_ns: u64,
}

impl Device {
    fn new() -> Self {
        let mut pace = DevicePace::new(MS);
        pace.begin(5 * MS);
        // The first sample is due a period later.
        Self { pace, now_ns: 4 * MS }
    }

    fn sample(&mut self, drift_ppm: i64) -> Wake {
        // One ppm of 1 ms is 1 ns.
        self.now_ns += (1_000_000 + drift_ppm).cast_unsigned();
        assert!(
            self.now_ns >= self.pace.earliest_ns(),
            "a device that is fast by less than an eighth never waits"
        );
        let wake = self.pace.sampled(self.now_ns);
        assert_eq!((wake.deadline_ns, wake.missed), (self.now_ns, wake.overshoot_ns / MS));
        assert!(!wake.is_stalled());
        wake
    }
}

/// Fraction of a deviation that is left after a tick, by [`PACE_SHARE`].
const LEFT: f64 = 1.0 - 1.0 / 1024.0;

#[test]
fn device_sets_the_pace_with_any_clock() {
    for drift_ppm in [-20_000_i64, -1000, -100, 0, 100, 900] {
        let mut device = Device::new();
        let mut late_ns = 0;
        for n in 0..200_000 {
            let wake = device.sample(drift_ppm);
            assert_eq!(wake.missed, 0, "{drift_ppm} {n}");
            late_ns = wake.overshoot_ns;
        }
        // Steady state: the lateness grows in a tick by as much as its share removes.
        let expected_ns = (drift_ppm * 1024).max(0).cast_unsigned();
        assert!(late_ns.abs_diff(expected_ns) < 2048, "{drift_ppm}: {late_ns}");
    }
}

/// A device slow by more than a 1024th is repeatedly late by a period, and by no more.
///
/// Lateness L grows by d - L / 1024 a tick. It grows from 0 to the period P in k ticks where P = 1024 d (1 - LEFT^k);
/// then a tick is skipped. The excess of L over P, below d, grows at the rate of L = 0 instead of L = P. That takes
/// up to (P / 1024) / (d - P / 1024) of a tick longer. The last tick, and rounding down (below 1 ns of d each tick, 1
/// in 4000), add or remove one.
#[test]
fn device_that_is_too_slow_skips_ticks() {
    let (ticks, period) = (200_000, 1e6);
    for drift_ppm in [5000_i64, 20_000] {
        let mut device = Device::new();
        let mut missed = 0;
        for _ in 0..ticks {
            let wake = device.sample(drift_ppm);
            assert!(wake.overshoot_ns < MS + drift_ppm.cast_unsigned(), "{drift_ppm}: {wake:?}");
            missed += wake.missed;
        }
        let drift = drift_ppm as f64;
        let between = (1.0 - period / (1024.0 * drift)).ln() / LEFT.ln();
        let longer = period / 1024.0 / (drift - period / 1024.0);
        let (least, most) = (f64::from(ticks) / (between + longer) - 1.0, f64::from(ticks) / between + 1.0);
        assert!((least..=most).contains(&(missed as f64)), "{drift_ppm}: {missed} in {least}..{most}");
    }
}

/// After a step of the rate the lateness moves to 1024 d, by a 1024th a tick, but not below 0. Rounding adds less
/// than 1 ns a tick and decays by a 1024th: at most 1024 ns.
#[test]
fn a_step_of_the_rate_is_followed_over_a_thousand_ticks() {
    for (before_ppm, after_ppm) in [
        (0_i64, 900_i64),
        (900, 0),
        (900, 450),
        (-20_000, 900),
        (900, -20_000),
        (20_000, 0),
        (20_000, -20_000),
        (0, 20_000),
        (-20_000, 20_000),
    ] {
        let mut device = Device::new();
        let mut last_ns = 0;
        for _ in 0..20_000 {
            last_ns = device.sample(before_ppm).overshoot_ns % MS;
        }
        let (first, end) = (last_ns as f64, 1024.0 * after_ppm as f64);
        let mut left_out = None;
        for tick in 1..=10_000 {
            let wake = device.sample(after_ppm);
            let expected = (end + (first - end) * LEFT.powi(tick)).max(0.0);
            let over = wake.overshoot_ns as f64 - expected;
            assert!((-1e-3..=1024.0).contains(&over), "{before_ppm} to {after_ppm}, {tick}: {over} ns");
            if wake.missed > 0 {
                left_out = Some(tick);
                break;
            }
        }
        // At 2 % a period of lateness takes 1 / 0.02 to 1 / (0.02 - 1 / 1024) ticks, so 50 to 52.6.
        let expected = if after_ppm == 20_000 { 50..=53 } else { 0..=0 };
        assert!(expected.contains(&left_out.unwrap_or(0)), "{before_ppm} to {after_ppm}: {left_out:?}");
    }
}

#[test]
fn blocked_driver_skips_ticks_and_stalls() {
    for (blocked_ms, missed, stalled) in [(1, 1, false), (19, 19, false), (20, 20, false), (21, 21, true)] {
        for waits in [false, true] {
            let mut pace = DevicePace::new(MS);
            pace.begin(7 * MS);
            let mut tick = |now_ns| if waits { pace.waited(now_ns) } else { pace.sampled(now_ns) };
            assert_eq!(tick(7 * MS), Wake { deadline_ns: 7 * MS, overshoot_ns: 0, missed: 0 });
            let wake = tick((8 + blocked_ms) * MS);
            assert_eq!((wake.missed, wake.is_stalled()), (missed, stalled), "{blocked_ms} {waits}");
            assert_eq!(wake.deadline_ns, (8 + blocked_ms) * MS);
            assert_eq!(tick((9 + blocked_ms) * MS).missed, 0);
        }
    }
}

#[test]
fn offset_shifts_the_clock_alone() {
    for offset_s in [-4e9, -1.5, 0.0, 1.5, 4e9] {
        let settings = ClockSettings { offset_s, ..ClockSettings::default() };
        let first = paced(settings, 1)[0].1.deadline_ns;
        for (n, (true_ns, wake)) in (0..).zip(paced(settings, 100)) {
            let expected = Wake { deadline_ns: first + n * MS, overshoot_ns: 0, missed: 0 };
            assert_eq!((true_ns, wake), (n * MS, expected));
        }
    }
}

#[test]
fn drift_changes_the_true_period_by_its_share() {
    for (drift_ppm, ticks) in [(100.0, 100_011), (-100.0, 99_991), (0.0, 100_001)] {
        let settings = ClockSettings { drift_ppm, ..ClockSettings::default() };
        let last = paced(settings, ticks)[ticks - 1];
        // The last of these ticks is nearest to 100 s of true time, with a period of 1 ms / (1 + drift).
        let expected = (ticks - 1) as f64 * 1e6 / (1.0 + drift_ppm * 1e-6);
        assert!((last.0 as f64 - expected).abs() <= 1.0, "{drift_ppm}: {last:?}");
        assert!(last.1.overshoot_ns <= 1 && last.1.missed == 0);
    }
}

#[test]
fn step_forward_skips_ticks_as_a_late_loop() {
    for (step_ms, stalled) in [(7, false), (1000, true)] {
        let settings =
            ClockSettings { step_s: step_ms as f64 * 1e-3, step_at_s: 3.5e-3, ..ClockSettings::default() };
        let ticks = paced(settings, 6);
        let (true_ns, wake) = ticks[4];
        // Waits for 4 ms, which the clock skips at 3.5 ms.
        assert_eq!((true_ns, wake.overshoot_ns), (3_500_000, step_ms * MS - MS / 2));
        assert_eq!((wake.missed, wake.is_stalled()), (step_ms - 1, stalled));
        assert_eq!(wake.deadline_ns, ORIGIN_NS + (3 + step_ms) * MS);
        assert_eq!(ticks[5].0, 4 * MS);
    }
}
