//! Outliers, changes of velocity and steps of points, joints and rotations.

use nalgebra::UnitQuaternion;
use proptest::prelude::*;

use super::*;

const PERIOD: f64 = 1e-3;
const QUANTUM: f64 = 2.3e-5;

fn guard(quantum: f64) -> Guard<1> {
    let bounds = SampleBounds { quantum, ..SampleBounds::LINEAR };
    Guard::new(bounds, SampleBounds::UNBOUNDED, PERIOD)
}

fn at(x: f64) -> Sample<1> {
    Sample::point(&Axes::<1>::new(x), None)
}

/// Pass positions, one per tick; return the accepted or predicted positions and the excess that ended the run.
fn taken(guard: &mut Guard<1>, positions: impl IntoIterator<Item = f64>) -> (Vec<f64>, Option<Excess>) {
    let mut all = Vec::new();
    for x in positions {
        if let Err(excess) = guard.pass(&at(x), 1.0) {
            return (all, Some(excess));
        }
        all.push(guard.sample_in_use().position[0]);
    }
    (all, None)
}

fn rounded(x: f64, quantum: f64) -> f64 {
    if quantum > 0.0 { (x / quantum).round() * quantum } else { x }
}

/// Draw velocity in m/s, acceleration in m/s² and tremor amplitude in m of a hand that rests, moves, presses or is
/// pushed.
fn motions() -> impl Strategy<Value = (f64, f64, f64)> {
    (-2.0..2.0f64, -35.0..35.0f64, 0.0..0.001f64)
}

proptest! {
    /// Up to 3 wrong samples of any size and sign, at any time of a motion, do not interrupt the path.
    #[test]
    fn outliers_are_replaced_and_counted(
        (v, a, tremor) in motions(),
        size in prop_oneof![0.0009..0.0012f64, 0.0012..0.5f64],
        signs in prop::array::uniform3(any::<bool>()),
        run in 1..=3_usize,
        quantum in prop::sample::select(vec![0.0, QUANTUM]),
        from in 20..60_usize,
    ) {
        let true_x = |n: usize| {
            let t = n as f64 * PERIOD;
            v * t + 0.5 * a * t * t + tremor * (60.0 * t).sin()
        };
        let measured = |n: usize| {
            let wrong = (from..from + run).contains(&n);
            let by = if signs[(n + 3 - from % 3) % 3] { size } else { -size };
            rounded(true_x(n) + if wrong { by } else { 0.0 }, quantum)
        };
        // A sample that repeats the last one counts as late.
        prop_assume!((from..from + run).all(|n| measured(n) != measured(from - 1)));
        let mut guard = guard(quantum);
        let (all, ended) = taken(&mut guard, (0..100).map(measured));
        prop_assert_eq!(ended, None);
        prop_assert_eq!(guard.outliers(), run as u64);
        for (n, x) in all.into_iter().enumerate() {
            if (from..from + run).contains(&n) {
                // Acceleration and rounding: a k^2 / 2 with k = 3.
                prop_assert!((x - true_x(n)).abs() < 3.5e-4 + 4.0 * quantum, "{n}: {x} {}", true_x(n));
            } else {
                prop_assert_eq!(x.to_bits(), measured(n).to_bits(), "{}", n);
            }
        }
    }

    /// A wrong sample within the bound passes and does not disturb later samples.
    #[test]
    fn wrong_sample_within_the_bound_passes(
        (v, a, _) in motions(),
        size in -0.0005..0.0005f64,
        quantum in prop::sample::select(vec![0.0, QUANTUM]),
    ) {
        let measured = |n: usize| {
            let t = n as f64 * PERIOD;
            rounded(v * t + 0.2 * a * t * t + if n == 30 { size } else { 0.0 }, quantum)
        };
        let mut guard = guard(quantum);
        let (all, ended) = taken(&mut guard, (0..60).map(measured));
        prop_assert_eq!(ended, None);
        for (n, x) in all.into_iter().enumerate() {
            prop_assert!((x - measured(n)).abs() <= size.abs() + 1e-4 + 2.0 * quantum, "{n}: {x} {}", measured(n));
        }
    }

    /// A stop, a blow or a bounce at any instant of a tick is never a fault, and is accepted from the fourth tick on.
    ///
    /// A wrong sample among the following ones does not matter, unless it lies on the path from before, straight or
    /// bent: it says that there was no blow.
    #[test]
    fn lasting_change_of_velocity_is_accepted(
        before in -9.0..9.0f64,
        after in -9.0..9.0f64,
        instant in 0.0..1.0f64,
        wrong in prop::option::of((0..8_usize, -0.5..0.5f64)),
        quantum in prop::sample::select(vec![0.0, QUANTUM]),
    ) {
        let hit = 0.05 + instant * PERIOD;
        let true_x = |n: usize| {
            let t = n as f64 * PERIOD;
            before * t.min(hit) + after * (t - hit).max(0.0)
        };
        let measured = |n: usize| {
            let by = wrong.filter(|(late, _)| n == 51 + late).map_or(0.0, |(_, by)| by);
            rounded(true_x(n) + by, quantum)
        };
        let is_confirmed = wrong.is_some_and(|(late, _)| {
            let off = measured(51 + late) - before * (51 + late) as f64 * PERIOD;
            // The velocity of a bent path changes by up to 0.5 m/s a tick.
            off.abs() < 0.5 * PERIOD * ((late + 2) * (late + 3) / 2) as f64 + 10.0 * quantum
        });
        prop_assume!(!is_confirmed || (after - before).abs() < 0.5);
        let mut guard = guard(quantum);
        let (all, ended) = taken(&mut guard, (0..100).map(measured));
        prop_assert_eq!(ended, None);
        for (n, x) in all.into_iter().enumerate().filter(|(n, _)| *n < 50 || *n > 64) {
            prop_assert!((x - measured(n)).abs() < 1e-12, "{n}");
        }
    }

    /// A stop or a blow that lasts for up to 3 ticks has no outliers, and its samples are accepted as measured.
    #[test]
    fn change_of_velocity_has_no_outliers(
        before in -9.0..9.0f64,
        after in -9.0..9.0f64,
        instant in 0.0..1.0f64,
        lasts in 0.0..3.0f64,
        quantum in prop::sample::select(vec![0.0, QUANTUM]),
    ) {
        let true_x = |n: usize| {
            let late = (n as f64 - 50.0 - instant).max(0.0);
            let during = late.min(lasts);
            let turned = if lasts > 0.0 { 0.5 * during * during / lasts + late - during } else { late };
            rounded((before * n as f64 + (after - before) * turned) * PERIOD, quantum)
        };
        let mut guard = guard(quantum);
        let mut held = 0;
        for n in 0..100 {
            prop_assert_eq!(guard.pass(&at(true_x(n)), 1.0), Ok(()), "{}", n);
            held += u32::from(guard.holds());
            prop_assert!(n < 60 || guard.sample_in_use() == &at(true_x(n)), "{n}");
        }
        prop_assert_eq!(guard.outliers(), 0);
        prop_assert!(held <= 6, "{held}");
    }

    /// A lasting step beyond the speed bound is a fault at the fourth tick, with value and bound.
    #[test]
    fn step_is_a_fault(
        v in -1.0..1.0f64,
        size in 0.023..5.0f64,
        up in any::<bool>(),
        ticks in 1..4_u32,
    ) {
        let by = f64::from(ticks) * if up { size } else { -size };
        let mut guard = guard(0.0);
        let (all, ended) = taken(&mut guard, (0..50).map(|n| v * f64::from(n) * PERIOD));
        prop_assert_eq!((all.len(), ended), (50, None));
        let after = |n: u32| at(v * f64::from(49 + ticks + n) * PERIOD + by);
        for n in 0..3 {
            prop_assert_eq!(guard.pass(&after(n), f64::from(if n == 0 { ticks } else { 1 })), Ok(()));
            prop_assert!((guard.sample_in_use().position[0] - after(n).position[0] + by).abs() < 1e-9, "predicted");
        }
        let excess = guard.pass(&after(3), 1.0).unwrap_err();
        prop_assert_eq!((excess.signal, excess.bound), (Signal::Position, 20.0));
        prop_assert!((excess.seen * PERIOD - size).abs() < 1.1e-3, "{excess}");
    }

    /// A wrong measured velocity is an outlier, with or without a wrong position.
    #[test]
    fn wrong_velocity_is_an_outlier(
        v in -2.0..2.0f64,
        wrong_v in 0.6..40.0f64,
        wrong_x in prop::option::of(0.0008..0.5f64),
        run in 1..=3_usize,
    ) {
        let mut guard = guard(QUANTUM);
        for n in 0..60_usize {
            let is_wrong = (30..30 + run).contains(&n);
            let x = rounded(v * n as f64 * PERIOD + wrong_x.filter(|_| is_wrong).unwrap_or(0.0), QUANTUM);
            let velocity = Axes::<1>::new(if is_wrong { v - wrong_v } else { v });
            let sample = Sample::point(&Axes::<1>::new(x), Some(&velocity));
            prop_assert_eq!(guard.pass(&sample, 1.0), Ok(()));
            prop_assert_eq!(guard.sample_in_use().velocity.unwrap()[0], v);
            prop_assert!((guard.sample_in_use().position[0] - v * n as f64 * PERIOD).abs() < 6.0 * QUANTUM);
        }
        prop_assert!(guard.outliers() == run as u64);
    }

    /// Rotations about any axis have outliers, stops and steps as points have.
    #[test]
    fn rotations_follow_the_same_rule(
        axis in prop::array::uniform3(-1.0..1.0f64),
        w in -20.0..20.0f64,
        size in 0.02..3.0f64,
        run in 1..=3_usize,
        kind in 0..3_u8,
    ) {
        let axis = nalgebra::Unit::new_normalize(Axes::<3>::from(axis) + Axes::<3>::new(0.0, 0.0, 1.5));
        let about = |angle: f64| UnitQuaternion::from_axis_angle(&axis, angle);
        let tilt = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.4, -0.3, 0.1));
        let mut guard =
            Guard::<1>::new(SampleBounds::UNBOUNDED, SampleBounds::LINEAR.at_lever(0.05), PERIOD);
        let mut ended = None;
        for n in 0..60_usize {
            let truth = about(w * n as f64 * PERIOD) * tilt;
            let stopped = about(w * (n as f64).min(30.0) * PERIOD) * tilt;
            let other = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, size, 0.0));
            let orientation = match kind {
                0 if (30..30 + run).contains(&n) => other * truth,
                0 => truth,
                1 => stopped,
                _ if n >= 30 => UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, size + 0.06, 0.0)) * truth,
                _ => truth,
            };
            let turned = Turned { orientation, angular_velocity: None };
            let sample = Sample { rotation: Some(turned), ..at(0.0) };
            if let Err(excess) = guard.pass(&sample, 1.0) {
                ended = Some(excess);
                break;
            }
            let taken = guard.sample_in_use().rotation.unwrap().orientation;
            match kind {
                1 if (31..34).contains(&n) => {}
                1 => prop_assert!(taken.angle_to(&stopped) < 1e-6, "{n}"),
                _ => prop_assert!(taken.angle_to(&truth) < 1e-6, "{n}: {}", taken.angle_to(&truth)),
            }
        }
        match kind {
            0 => prop_assert_eq!((ended, guard.outliers()), (None, run as u64)),
            1 => prop_assert_eq!((ended, guard.outliers()), (None, 0)),
            _ => prop_assert_eq!(ended.unwrap().signal, Signal::Orientation),
        }
    }
}

/// Each joint must meet the bounds separately.
#[test]
fn joints_are_checked_separately() {
    let mut guard = Guard::<6>::new(SampleBounds::JOINTS, SampleBounds::UNBOUNDED, PERIOD);
    // 6 joints at 3 rad/s: 3 mrad each per tick, 7.3 mrad together.
    for n in 0..20 {
        let joints = Axes::<6>::repeat(if n < 10 { 0.0 } else { 3e-3 * f64::from(n - 9) });
        assert_eq!(guard.pass(&Sample::point(&joints, None), 1.0), Ok(()));
        assert_eq!(guard.sample_in_use().position, joints);
    }
    let mut wrong = guard.sample_in_use().position + Axes::repeat(3e-3);
    wrong[4] += 0.007;
    guard.pass(&Sample::point(&wrong, None), 1.0).unwrap();
    assert!(guard.holds() && (guard.sample_in_use().position[4] - wrong[4] + 0.007).abs() < 1e-12);
}

/// A sensor at half to a quarter of the loop rate repeats its samples; none is an outlier.
#[test]
fn slower_sensor_has_no_outliers() {
    for every in [2, 3, 4] {
        for v in [0.1, 0.4, 1.0, 3.0] {
            let mut guard = guard(QUANTUM);
            let x = |n: usize| {
                let t = (n - n % every) as f64 * PERIOD;
                // Constant acceleration to the speed v within 0.2 s.
                rounded(v * if t < 0.2 { t * t / 0.4 } else { t - 0.1 }, QUANTUM)
            };
            let (all, ended) = taken(&mut guard, (0..400).map(x));
            assert_eq!((ended, guard.outliers()), (None, 0), "{every} {v}");
            let room = v * every as f64 * PERIOD + 5.0 * QUANTUM;
            let worst =
                (250..400).map(|n| (all[n] - v * (n as f64 * PERIOD - 0.1)).abs()).fold(0.0, f64::max);
            assert!(worst < room, "{every} {v}: {worst}");
        }
    }
}

/// A step within the bound is not a motion: later samples lie on the same path with an offset.
#[test]
fn step_within_the_bound_moves_the_origin() {
    let mut guard = guard(0.0);
    let x = |n: i32| 1e-4 * f64::from(n) + if n < 50 { 0.0 } else { 0.012 };
    let mut shifts = Vec::new();
    for n in 0..100 {
        guard.pass(&at(x(n)), 1.0).unwrap();
        shifts.extend(guard.between().and_then(|between| between.shift));
    }
    assert_eq!(shifts.len(), 1);
    assert!((shifts[0].position[0] - 0.012).abs() < 1e-12 && guard.outliers() == 0);
}

#[test]
fn message_states_value_and_limit() {
    let mut guard = guard(0.0);
    let (_, excess) = taken(&mut guard, (0..20).map(|n| if n < 10 { 0.0 } else { 0.5 }));
    assert_eq!(
        excess.unwrap().to_string(),
        "position stepped at 500.000 m/s: must be at most 20 m/s, its speed_bound; check sensor and cable"
    );
}

/// Wrong samples for longer than an outlier lasts, and back: no velocity is read into them.
#[test]
fn a_step_and_its_way_back_are_no_velocity() {
    for wrong in 4..=8 {
        for size in [2e-3, -0.015] {
            let mut guard = guard(QUANTUM);
            let x = |n: usize| if (300..300 + wrong).contains(&n) { size } else { 0.0 };
            for n in 0..400 {
                assert_eq!(guard.pass(&at(x(n)), 1.0), Ok(()), "{wrong} {n}");
                if let Some(between) = guard.between() {
                    let knots: Vec<f64> =
                        (0..=between.ticks).map(|tick| between.at(tick).position[0]).collect();
                    let most = knots.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
                    assert!(most < 1e-3, "{wrong} x {size}: {knots:?}");
                }
            }
        }
    }
}

/// A wrong sample after ticks that were left out is held, as at any other tick.
#[test]
fn wrong_sample_after_a_late_tick_is_held() {
    for gap in 1..=12 {
        for size in [0.9e-3, 3e-3, -0.1] {
            let mut guard = guard(QUANTUM);
            for _ in 0..100 {
                guard.pass(&at(0.0), 1.0).unwrap();
            }
            guard.pass(&at(size), f64::from(gap)).unwrap();
            assert!(guard.holds() && guard.sample_in_use().position[0].abs() < 1e-12, "{gap} {size}");
            guard.pass(&at(0.0), 1.0).unwrap();
            assert_eq!((guard.holds(), guard.outliers()), (false, 1), "{gap} {size}");
        }
    }
}

/// A coarse encoder in slow motion moves by single quanta; outliers are then replaced, too.
#[test]
fn coarse_joint_in_slow_motion_bears_outliers() {
    let quantum = std::f64::consts::TAU / 4096.0;
    for (amplitude, rate) in [(0.1, 3.0), (0.1, 1.0), (0.6, 3.0)] {
        for size in [0.05, 0.5] {
            for run in 1..=3 {
                let bounds = SampleBounds { quantum, speed: 30.0, ..SampleBounds::JOINTS };
                let mut guard = Guard::<1>::new(bounds, SampleBounds::UNBOUNDED, PERIOD);
                let measured = |n: usize| {
                    let sign = if n.is_multiple_of(2) { 1.0 } else { -1.0 };
                    let wrong = n > 100 && n % 97 < run;
                    let x = amplitude * (rate * n as f64 * PERIOD).sin();
                    rounded(x + if wrong { sign * size } else { 0.0 }, quantum)
                };
                let (_, ended) = taken(&mut guard, (0..4000).map(measured));
                let case = format!("{amplitude} rad at {rate} rad/s, {run} of {size} rad");
                assert_eq!(ended, None, "{case}");
                let count = (101..4000).filter(|n| n % 97 < run).count() as u64;
                assert_eq!(guard.outliers(), count, "{case}");
            }
        }
    }
}

/// Pass samples by tick until a fault; a tick that lacks a sample is late. Return the tick of the fault.
fn fault_tick(turns: bool, x: impl Fn(u32) -> Option<f64>) -> Option<u32> {
    let bounds = SampleBounds { speed: 10.0, quantum: QUANTUM, ..SampleBounds::LINEAR };
    let [point, turn] =
        if turns { [SampleBounds::UNBOUNDED, bounds] } else { [bounds, SampleBounds::UNBOUNDED] };
    let mut guard = Guard::<1>::new(point, turn, PERIOD);
    let mut last = 0;
    for n in 1..1000 {
        let Some(x) = x(n) else { continue };
        let orientation = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, 0.0, x));
        let rotation = turns.then_some(Turned { orientation, angular_velocity: None });
        let sample = Sample { rotation, ..at(if turns { 0.0 } else { x }) };
        if guard.pass(&sample, f64::from(n - last)).is_err() {
            return Some(n);
        }
        last = n;
    }
    None
}

/// An outlier or a late tick says nothing about the rate of the device, so a later step is a fault.
#[test]
fn step_is_a_fault_after_outliers_and_late_ticks() {
    for (turns, v) in [(false, 0.0), (false, 0.01), (false, 0.02), (false, 0.03), (true, 0.01), (true, 0.02)]
    {
        for (outliers, late) in [(0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3), (2, 2)] {
            for step in [0.012, 0.018, 0.028, 0.035, 0.039] {
                let x = |n: u32| {
                    let wrong = if (300..300 + outliers).contains(&n) { 0.05 } else { 0.0 };
                    let x = rounded(v * f64::from(n) * PERIOD, QUANTUM) + wrong;
                    (!(310..310 + late).contains(&n)).then_some(x + if n < 700 { 0.0 } else { step })
                };
                let fault = fault_tick(turns, x);
                let case = format!("{turns}, {v} m/s, {outliers} outliers, {late} late ticks, {step} m");
                assert!(fault.is_some_and(|n| (702..706).contains(&n)), "{case}: {fault:?}");
            }
        }
    }
}

/// A late tick among the samples of a change says nothing about the rate of the device.
#[test]
fn step_is_a_fault_after_a_change_with_a_late_tick() {
    let moved = [0.004, 0.008, 0.012, 0.013];
    for turns in [false, true] {
        for late in [1, 2] {
            let x = |n: u32| match n {
                0..300 => Some(0.0),
                300..304 => Some(moved[n as usize - 300]),
                _ if n < 304 + late => None,
                304..700 => Some(0.014),
                _ => Some(0.032),
            };
            let fault = fault_tick(turns, x);
            assert!(fault.is_some_and(|n| (702..706).contains(&n)), "{turns}, {late}: {fault:?}");
        }
    }
}

/// An outlier at a step does not hide it.
#[test]
fn step_is_a_fault_after_an_outlier() {
    for turns in [false, true] {
        for outliers in 1..=2_u32 {
            let x = |n: u32| match n {
                0..300 => Some(0.0),
                _ if n < 300 + outliers => Some(-0.2),
                _ => Some(0.3),
            };
            let fault = fault_tick(turns, x);
            assert!(fault.is_some_and(|n| (302..307).contains(&n)), "{turns}, {outliers}: {fault:?}");
        }
    }
}

/// Up to 3 wrong samples in a row do not interrupt a motion whose acceleration is beyond dV / 10 per tick.
#[test]
fn outliers_in_a_quick_motion_are_no_fault() {
    // Period in s, frequency in Hz and amplitude in m.
    let motions = [(5e-3, 4.0, 0.03), (5e-3, 1.0, 0.3), (2e-3, 10.0, 0.012), (1e-3, 10.0, 0.018)];
    for (period, frequency, amplitude) in motions {
        for wrong in [&[0.05][..], &[0.05, -0.05], &[0.05, -0.05, 0.05], &[0.2, 0.2, 0.2], &[0.3, 0.0, -0.1]]
        {
            for phase in 0..40 {
                let bounds = SampleBounds { speed: 10.0, quantum: QUANTUM, ..SampleBounds::LINEAR };
                let mut guard = Guard::<1>::new(bounds, SampleBounds::UNBOUNDED, period);
                let x = |n: usize| {
                    let turn = std::f64::consts::TAU * frequency * n as f64 * period;
                    let by = n.checked_sub(200).and_then(|n| wrong.get(n)).unwrap_or(&0.0);
                    rounded(amplitude * (turn + 0.157 * f64::from(phase)).sin() + by, QUANTUM)
                };
                let (_, ended) = taken(&mut guard, (0..400).map(x));
                let case = format!("{period} s, {frequency} Hz, {amplitude} m, phase {phase}, {wrong:?}");
                assert_eq!(ended, None, "{case}");
            }
        }
    }
}

/// Wrong samples below the speed bound are no motion of a device that accelerates: samples of a hand or of a device
/// that its own motors throw.
#[test]
fn outliers_below_the_speed_bound_are_no_motion() {
    // Bounds, period in s, acceleration in m/s^2 (rad/s^2) and frequency in Hz; 0 Hz is a throw.
    let point = |speed: f64, quantum: f64| SampleBounds { speed, quantum, ..SampleBounds::LINEAR };
    let joint = SampleBounds { speed: 30.0, quantum: std::f64::consts::TAU / 4096.0, ..SampleBounds::JOINTS };
    let motions = [
        (point(16.0, 3e-5), 1e-3, 113.0, 20.0),
        (point(16.0, 3e-5), 1e-3, 113.0, 0.0),
        (point(10.0, QUANTUM), 2e-3, 38.0, 8.0),
        (point(10.0, QUANTUM), 2e-3, 50.0, 0.0),
        (point(10.0, QUANTUM), 3e-3, 24.0, 5.0),
        (point(10.0, 0.0), 5e-3, 14.0, 3.0),
        (point(10.0, QUANTUM), 5e-3, 14.0, 0.0),
        (joint, 5e-3, 252.0, 0.0),
        (joint, 5e-3, 151.0, 8.0),
        (joint, 4e-3, 197.0, 10.0),
    ];
    for (bounds, period, acceleration, frequency) in motions {
        // A joint moves by its limit in 2 or 3 ticks, so the last of several wrong samples may be on its path.
        for run in 1..=if bounds.per_axis { 1 } else { 3_usize } {
            for case in 0..24 * 8 {
                let (phase, share) = (case / 8, [-0.9, -0.7, -0.5, -0.3, 0.3, 0.5, 0.7, 0.9][case % 8]);
                let x = |n: usize| {
                    let x = if frequency == 0.0 {
                        // The wrong samples begin 1 to 13 ticks after the throw.
                        let t = (n as f64 - 199.0 + (phase / 2) as f64).max(0.0) * period;
                        0.5 * acceleration * t.min(18.0 * period) * (2.0 * t - t.min(18.0 * period))
                    } else {
                        let w = std::f64::consts::TAU * frequency;
                        acceleration / (w * w) * (w * n as f64 * period + 0.2618 * phase as f64).sin()
                    };
                    rounded(x, bounds.quantum)
                };
                let size = share * bounds.speed * period / if run == 3 { 2.0 } else { 1.0 };
                let wrong = |n: usize| {
                    let sign = if case.is_multiple_of(3) && n.is_multiple_of(2) { -1.0 } else { 1.0 };
                    if (200..200 + run).contains(&n) { sign * size } else { 0.0 }
                };
                let case =
                    format!("{period} s, {acceleration}, {frequency} Hz, phase {phase}, {run} of {size}");
                let mut guard = Guard::<1>::new(bounds, SampleBounds::UNBOUNDED, period);
                let mut accepted = 0;
                for n in 0..260 {
                    assert_eq!(guard.pass(&at(x(n) + wrong(n)), 1.0), Ok(()), "{case}");
                    if n == 199 {
                        assert!(!guard.holds() && guard.outliers() == 0, "{case}");
                    }
                    if n >= 200 + run && !guard.holds() {
                        accepted = if accepted == 0 { n } else { accepted };
                        assert!((guard.sample_in_use().position[0] - x(n)).abs() < 1e-12, "{case}: {n}");
                    }
                    if let Some(between) = guard.between() {
                        for (late, tick) in (0..=between.ticks).rev().enumerate() {
                            let off = between.at(tick).position[0] - x(n - late);
                            // Acceleration on a straight line over up to 4 ticks, and two quanta.
                            let room = 2.0 * acceleration * period * period + 2.0 * bounds.quantum;
                            assert!(off.abs() <= room, "{case}: {n} {tick}: {off}");
                        }
                    }
                }
                // A sample that repeats the last one counts as late.
                let late = (200..200 + run).filter(|n| x(*n) + wrong(*n) == x(199)).count();
                assert_eq!(guard.outliers(), (run - late) as u64, "{case}");
                assert!(accepted < 200 + run + 3, "{case}: {accepted}");
            }
        }
    }
}

/// The same holds for measured velocities and for rotations, whichever part is wrong.
#[test]
fn outliers_of_each_part_are_no_motion() {
    // Wrong position in m, velocity in m/s, angle in rad and angular velocity in rad/s.
    let parts = [[0.009, 0.0, 0.0, 0.0], [0.0, 9.0, 0.0, 0.0], [0.0, 0.0, 0.05, 0.0], [0.0, 0.0, 0.0, 30.0]];
    let parts = parts.into_iter().chain([[-0.009, -9.0, 0.05, -30.0]]);
    for wrong in parts {
        for tick in 0..40 {
            let mut guard =
                Guard::<3>::new(SampleBounds::LINEAR, SampleBounds::LINEAR.at_lever(0.05), PERIOD);
            let along = Axes::<3>::new(0.6, 0.0, 0.8);
            // 113 m/s^2 at 20 Hz, and the same at the rim of the handle.
            let [w, amplitude] = [40.0 * std::f64::consts::PI, 113.0 / (40.0 * std::f64::consts::PI).powi(2)];
            let right = |n: usize| {
                let [x, v] = [(w * n as f64 * PERIOD).sin(), w * (w * n as f64 * PERIOD).cos()];
                let turned = Turned {
                    orientation: UnitQuaternion::from_scaled_axis(along * (amplitude / 0.05 * x)),
                    angular_velocity: Some(along * (amplitude / 0.05 * v)),
                };
                let position = along * (amplitude * x);
                Sample { position, velocity: Some(along * (amplitude * v)), rotation: Some(turned) }
            };
            let [x, v, angle, rate] = wrong.map(|by| Axes::<3>::new(0.0, by, 0.0));
            for n in 0..160 {
                let mut sample = right(n);
                if n == 100 + tick {
                    sample.position += x;
                    sample.velocity = sample.velocity.map(|of| of + v);
                    sample.rotation =
                        sample.rotation.map(|Turned { orientation, angular_velocity }| Turned {
                            orientation: UnitQuaternion::from_scaled_axis(angle) * orientation,
                            angular_velocity: angular_velocity.map(|of| of + rate),
                        });
                }
                assert_eq!(guard.pass(&sample, 1.0), Ok(()), "{wrong:?} {n}");
                let waits = (100 + tick..103 + tick).contains(&n);
                assert!(waits || guard.sample_in_use() == &right(n), "{wrong:?}, tick {tick}: {n}");
            }
            assert_eq!(guard.outliers(), 1, "{wrong:?}, tick {tick}");
        }
    }
}

/// The path of a device that samples every few ticks goes on at its new velocity after a change.
#[test]
fn slower_sensor_is_followed_after_a_change() {
    for every in 2..=4 {
        for (before, after) in [(0.0, 2.0), (1.0, 3.0), (2.0, -1.0)] {
            let x = |n: usize| {
                before * n.min(240) as f64 * PERIOD + after * n.saturating_sub(240) as f64 * PERIOD
            };
            let mut guard = guard(0.0);
            let (all, ended) = taken(&mut guard, (0..400).map(|n| x(n - n % every)));
            let worst = (240 + 5 * every..400).map(|n| (all[n] - x(n)).abs()).fold(0.0, f64::max);
            let case = format!("every {every}, {before} to {after} m/s: {worst}");
            assert_eq!(ended, None, "{case}");
            // The path gives the position between two samples; a sample may be late by a tick less than `every`.
            assert!(worst < f64::abs(after) * (every as f64 - 1.0) * PERIOD + 1e-9, "{case}");
        }
    }
}

/// A stop of a device that samples every few ticks is no fault up to its speed bound.
#[test]
fn stop_of_a_slower_sensor_is_no_fault() {
    for every in 2..=4 {
        for v in [2.0, 5.0, 9.0] {
            for stop in 100..104 {
                let bounds = SampleBounds { quantum: QUANTUM, speed: 10.0, ..SampleBounds::LINEAR };
                let mut guard = Guard::<1>::new(bounds, SampleBounds::UNBOUNDED, PERIOD);
                // Constant acceleration to v within 0.05 s.
                let x = |n: usize| {
                    let t = (n - n % every).min(stop) as f64 * PERIOD;
                    rounded(v * if t < 0.05 { t * t / 0.1 } else { t - 0.025 }, QUANTUM)
                };
                let (_, ended) = taken(&mut guard, (0..200).map(x));
                assert_eq!(ended, None, "every {every}, {v} m/s, {stop}");
            }
        }
    }
}

/// The quantum of the position gives a measured velocity no room.
#[test]
fn measured_velocity_is_held_beyond_its_bound() {
    let bounds = SampleBounds { quantum: 1.5e-3, ..SampleBounds::JOINTS };
    for (change, is_held) in [(4.9, false), (5.1, true), (-5.1, true), (7.9, true)] {
        let mut guard = Guard::<1>::new(bounds, SampleBounds::UNBOUNDED, PERIOD);
        let sample = |velocity: f64| Sample::point(&Axes::<1>::new(0.0), Some(&Axes::<1>::new(velocity)));
        for _ in 0..10 {
            guard.pass(&sample(0.0), 1.0).unwrap();
        }
        guard.pass(&sample(change), 1.0).unwrap();
        assert_eq!(guard.holds(), is_held, "{change} rad/s");
    }
}
