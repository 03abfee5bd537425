use super::*;

/// Motion of one coordinate in m, `number` tells one from another; its speed is about 1 m/s.
fn path(kind: Path, t: f64, number: f64) -> f64 {
    match kind {
        Path::Sines => {
            let t = t * (1.0 + 0.13 * number);
            (9.0 * t).sin() / 9.0 + 0.3 * (23.0 * t).sin() / 23.0
        }
        // Minimum jerk, 10 s^3 - 15 s^4 + 6 s^5, and stops of 0.2 s in each second.
        Path::Rests => {
            let share = ((t.fract() - 0.2) / 0.8).max(0.0);
            let eased = share.powi(3) * (10.0 - 15.0 * share + 6.0 * share * share);
            (0.5 + 0.1 * number) * if t.floor() % 2.0 == 0.0 { eased } else { 1.0 - eased }
        }
        Path::Circle => (6.0 * t + 0.5 * std::f64::consts::PI * number).sin() / 6.0,
        Path::Line => t * (1.0 + number),
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Path {
    Sines,
    Rests,
    Circle,
    Line,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Axes {
    /// One encoder.
    One,
    /// Three of them.
    Three,
    /// A stylus on three joints, with lengths in m.
    Stylus,
}

#[derive(Clone, Copy, Debug)]
struct Case {
    /// Period of the device in ticks.
    every: f64,
    /// How far in ticks the reads scatter; where that is more than the device is faster, samples do repeat.
    jitter: f64,
    quantum: f64,
    speed: f64,
    path: Path,
    axes: Axes,
}

/// 4 s at 1 kHz of a device.
fn measured(case: &Case, stamped: bool) -> Renewal {
    let Case { every, jitter, quantum, speed, path: kind, axes } = *case;
    let mut renewal = Renewal::default();
    for tick in 0..4_000_u32 {
        let read = f64::from(tick) + jitter * (f64::from(tick) * 2.4).sin();
        let time_s = (read / every + 0.3).floor() * every * 1e-3;
        let lever = if axes == Axes::Stylus { 0.135 } else { 1.0 };
        let encoder = |number: f64| {
            let x = speed * path(kind, time_s, number) / lever;
            let quantum = quantum / lever;
            if quantum > 0.0 { (x / quantum).round() * quantum } else { x }
        };
        let q = [encoder(0.0), encoder(1.0), encoder(2.0)];
        let position = match axes {
            Axes::One => vec![q[0]],
            Axes::Three => q.to_vec(),
            Axes::Stylus => {
                let [yaw, upper, lower] = [q[0] + 0.3, q[1] + 0.5, q[2] + 0.4];
                let reach = lever * (upper.cos() + lower.sin());
                let height = lever * (upper.sin() - lower.cos());
                vec![reach * yaw.sin(), height, reach * yaw.cos()]
            }
        };
        let sample = Stamped { position: &position, orientation: None, time_s: stamped.then_some(time_s) };
        renewal.step(Some(sample), false);
    }
    renewal
}

#[test]
fn a_slow_device_is_measured_over_what_it_moves_and_a_coarse_one_is_not_slow() {
    let mut unseen = 0;
    for every in [0.25, 0.9, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 8.0, 16.0, 33.0] {
        for (path, axes) in [
            (Path::Sines, Axes::One),
            (Path::Sines, Axes::Stylus),
            (Path::Rests, Axes::One),
            (Path::Rests, Axes::Stylus),
            (Path::Circle, Axes::Three),
            (Path::Line, Axes::One),
            (Path::Line, Axes::Stylus),
        ] {
            for quantum in [0.0, 2.3e-5, 1e-4] {
                for speed in [0.005, 0.05, 0.4] {
                    for jitter in [0.0, if every == 0.9 { 0.0 } else { 0.2 }] {
                        let case = Case { every, jitter, quantum, speed, path, axes };
                        let expected = f64::min(1.0, 1.0 / every);
                        let total = measured(&case, false).total_share();
                        // So many quanta per sample are enough to tell, but along a line at one speed.
                        let quanta = speed * 1e-3 * every.max(1.0) / quantum.max(1e-9);
                        let is_enough = quanta > 12.0 && every <= 16.0 && path != Path::Line;
                        assert!(!is_enough || total.is_some(), "{case:?}");
                        if let Some(share) = total {
                            let slack = if is_enough && jitter == 0.0 { 0.03 } else { 0.2 };
                            assert!((share - expected).abs() <= slack, "{case:?}: {share}");
                            assert_eq!(share < MIN_RENEWAL, expected < MIN_RENEWAL, "{case:?}: {share}");
                        }
                        unseen += u32::from(total.is_none());
                    }
                }
            }
        }
        let still = Case { every, jitter: 0.0, quantum: 1e-4, speed: 0.0, path: Path::Line, axes: Axes::One };
        assert_eq!(measured(&still, false).total_share(), None);
        let exact = measured(&still, true).total_share().unwrap();
        assert!((exact - f64::min(1.0, 1.0 / every)).abs() < 0.01, "{every}: {exact}");
    }
    assert!(unseen > 0);
}

#[test]
fn a_device_at_rest_is_not_measured_but_by_its_own_times() {
    let mut renewal = [Renewal::default(), Renewal::default()];
    for tick in 0..1001_u32 {
        for (renewal, stamped) in renewal.iter_mut().zip([false, true]) {
            let time_s = stamped.then_some(f64::from(tick.div_ceil(2)));
            renewal.step(Some(Stamped { position: &[0.1], orientation: None, time_s }), false);
        }
    }
    assert_eq!(renewal.map(|renewal| renewal.total_share()), [None, Some(0.5)]);
}

/// Two coarse encoders with noise, at about half a quantum per tick, repeat samples and have a few alike changes.
#[test]
fn noisy_coarse_encoders_are_not_slow() {
    for quanta_per_s in [500.0, 550.0, 600.0] {
        let mut renewal = Renewal::default();
        for tick in 0..8000_u32 {
            let t = f64::from(tick) * 1e-3;
            let encoder = |n: f64| {
                // Noise within half a quantum, the same at each run.
                let noise =
                    ((f64::from(tick) * (12.9898 + 7.1 * n)).sin() * 43758.5453).rem_euclid(1.0) - 0.5;
                ((quanta_per_s + 30.0 * n) * (t + 0.1 * (3.0 * t + n).sin()) + noise).round() * 1e-4
            };
            let position = [encoder(0.0), encoder(1.0)];
            renewal.step(Some(Stamped { position: &position, orientation: None, time_s: None }), false);
        }
        let share = renewal.total_share();
        assert!(share.is_none_or(|share| share >= MIN_RENEWAL), "{quanta_per_s}: {share:?}");
    }
}

/// Steps at constant speed are equal, but no slow device has a new sample at each tick.
#[test]
fn device_at_constant_speed_is_as_fast_as_its_loop() {
    let mut renewal = Renewal::default();
    for tick in 0..1000_u32 {
        let position = [f64::from(tick) * 0.125];
        renewal.step(Some(Stamped { position: &position, orientation: None, time_s: None }), false);
    }
    assert_eq!(renewal.total_share(), Some(1.0));
}

#[test]
fn late_ticks_and_ticks_without_a_sample_do_not_count() {
    // Every other tick is late, and the device renews its sample as often.
    for has_sample in [false, true] {
        let mut renewal = Renewal::default();
        for tick in 0..4000_u32 {
            let position = [path(Path::Sines, f64::from(tick / 2) * 2e-3, 0.0)];
            let is_late = tick % 2 == 1;
            let sample =
                Stamped { position: &position, orientation: None, time_s: Some(f64::from(tick / 2)) };
            renewal.step((has_sample || !is_late).then_some(sample), is_late);
        }
        assert_eq!(renewal.total_share(), None, "{has_sample}");
    }
}

/// Late ticks hide as many ticks with a new sample as without, whatever their share.
#[test]
fn late_ticks_do_not_bias_the_share() {
    for every in [0.9, 1.0, 1.25, 1.3, 1.5, 2.0, 3.0] {
        for late_share in [0.1, 0.3, 0.6] {
            let mut renewal = Renewal::default();
            for tick in 0..20_000_u32 {
                let draw = |n: f64| ((f64::from(tick) * (12.9898 + n)).sin() * 43758.5453).rem_euclid(1.0);
                let is_late = draw(0.0) < late_share;
                let read = f64::from(tick) + if is_late { 0.5 + 0.45 * draw(3.1) } else { 0.0 };
                let time_s = (read / every + 0.3).floor() * every * 1e-3;
                let position = [0.4 * path(Path::Sines, time_s, 0.0)];
                renewal.step(Some(Stamped { position: &position, orientation: None, time_s: None }), is_late);
            }
            let (share, expected) = (renewal.total_share().unwrap(), f64::min(1.0, 1.0 / every));
            assert!((share - expected).abs() < 0.03, "{every} {late_share}: {share}, must be {expected}");
        }
    }
}

#[test]
fn the_slower_of_position_and_orientation_counts_whatever_the_sign_of_the_quaternion() {
    let mut renewal = Renewal::default();
    for tick in 0..4000_u32 {
        let position = [path(Path::Sines, f64::from(tick) * 1e-3, 0.0)];
        let angle = path(Path::Sines, f64::from(tick / 4) * 4e-3, 1.0);
        let sign = if tick % 3 == 0 { -1.0 } else { 1.0 };
        let turned = [angle.cos() * sign, angle.sin() * sign, 0.0, 0.0];
        renewal.step(Some(Stamped { position: &position, orientation: Some(&turned), time_s: None }), false);
    }
    let share = renewal.share().unwrap();
    assert!((share - 0.25).abs() < 0.01, "{share}");
}

#[test]
fn numbers_that_are_not_finite_are_passed_over() {
    let mut renewal = Renewal::default();
    for tick in 0..4000_u32 {
        let x = path(Path::Sines, f64::from(tick) * 1e-3, 0.0);
        let position = [if tick % 50 == 0 { f64::NAN } else { x }];
        renewal.step(Some(Stamped { position: &position, orientation: None, time_s: Some(f64::NAN) }), false);
    }
    let share = renewal.position.count.total.share().unwrap();
    assert!(share > 0.95, "{share}");
}
