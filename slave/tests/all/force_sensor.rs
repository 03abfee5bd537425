//! Errors that a force sensor adds to a force.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Environment, ForceSensor, PushShape, Pusher, SimulatedSlave,
};

const MS: u64 = 1_000_000;

#[test]
fn noise_has_its_mean_deviation_and_shape() {
    let bias = Axes::<3>::new(0.5, -1.0, 0.0);
    let sensor = ForceSensor::new(0.2, bias, 0.0, None, 42).unwrap();
    let n = 40_000_u32;
    let force = Axes::<3>::new(1.0, 2.0, 3.0);
    let draws: Vec<_> = (0..u64::from(n)).map(|k| (sensor.sample(&force, k) - force - bias) / 0.2).collect();
    let count = f64::from(n);
    for axis in 0..3 {
        let moment = |power: i32| draws.iter().map(|d| d[axis].powi(power)).sum::<f64>() / count;
        // Standard errors of the moments 1 to 4 of n normal numbers: 1, sqrt 2, sqrt 15, sqrt 96 over sqrt n; four
        // times each.
        for (power, mean, deviation) in [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0_f64)] {
            let off = moment(power) - mean;
            assert!(off.abs() < 4.0 * (deviation / count).sqrt(), "{axis} {power}: {off}");
        }
        let mut follow = 0.0;
        for pair in draws.windows(2) {
            follow += pair[0][axis] * pair[1][axis];
        }
        assert!((follow / count).abs() < 4.0 / count.sqrt(), "white: {}", follow / count);
        let across: f64 = draws.iter().map(|d| d[axis] * d[(axis + 1) % 3]).sum::<f64>() / count;
        assert!(across.abs() < 4.0 / count.sqrt(), "independent axes: {across}");
    }
    let again = ForceSensor::new(0.2, bias, 0.0, None, 42).unwrap();
    assert_eq!(again.sample(&force, 77), sensor.sample(&force, 77));
    let other = ForceSensor::new(0.2, bias, 0.0, None, 43).unwrap();
    assert!(other.sample(&force, 77) != sensor.sample(&force, 77));
}

#[test]
fn a_quantum_rounds_to_the_nearest() {
    let sensor = ForceSensor::new(0.0, Axes::<1>::zeros(), 0.25, None, 0).unwrap();
    for (force, seen) in [(0.1, 0.0), (0.13, 0.25), (-0.37, -0.25), (-0.38, -0.5), (2.0, 2.0)] {
        assert_eq!(sensor.sample(&Axes::<1>::new(force), 0)[0], seen);
    }
}

#[test]
fn a_slow_sensor_holds_its_samples_on_its_own_grid() {
    let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 10.0 }, 2.0, None, None).unwrap();
    // A force in N equal to the time in s.
    let ramp = Pusher::shaped(PushShape::Ramp { rise_s: 1.0 }, 0.0, 2.0, Axes::<1>::new(1.0)).unwrap();
    let sensor = ForceSensor::new(0.0, Axes::zeros(), 0.0, Some(300.0), 0).unwrap();
    let environment = Environment::new(Vec::new(), vec![ramp]);
    let begin = 5 * MS;
    let mut slave = SimulatedSlave::in_environment(arm, environment, Some(sensor), Axes::zeros(), 0).unwrap();
    slave.begin(begin);
    slave.start(begin);
    for tick in 0..900_u32 {
        let sample = slave.read(begin + u64::from(tick) * MS);
        let t = f64::from(tick) * 1e-3;
        assert!((sample.true_environment_force[0] - t).abs() < 1e-12);
        // The newest multiple of 1/300 s, in integers, so that rounding does not decide.
        let held = f64::from(tick * 300 / 1000) / 300.0;
        assert!(
            (sample.environment_force[0] - held).abs() < 1e-12,
            "{tick}: {}",
            sample.environment_force[0]
        );
    }
}

#[test]
fn without_a_rate_every_tick_has_noise_of_its_own() {
    let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 10.0 }, 2.0, None, None).unwrap();
    let sensor = ForceSensor::new(0.1, Axes::<2>::zeros(), 0.0, None, 9).unwrap();
    let mut slave =
        SimulatedSlave::in_environment(arm, Environment::empty(), Some(sensor), Axes::zeros(), 0).unwrap();
    let mut before = slave.read(0).environment_force;
    for tick in 1..50 {
        let sample = slave.read(tick * MS);
        assert!(sample.environment_force != before && sample.true_environment_force == Axes::<2>::zeros());
        before = sample.environment_force;
        assert_eq!(slave.read(tick * MS).environment_force, before, "the same instant is the same sample");
    }
}
