//! Time of an exact tick of device and hand: `cargo bench -p haptether-master --bench exact_tick`.
#![allow(clippy::unwrap_used, missing_docs)] // a bench may; criterion's macros make public items

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use haptether_master::{
    Axes, DeviceParameters, Friction, Hand, Leg, LegShape, Path, SimulatedMaster, Tremor,
};

/// A hand that trembles, and moves along `legs`.
fn tick<const N: usize>(
    criterion: &mut Criterion,
    name: &str,
    device: DeviceParameters<N>,
    damping: f64,
    legs: Vec<Leg<N>>,
) {
    let hand = Hand::new(300.0, damping, 12.0, Path::new(Axes::zeros(), legs).unwrap(), None).unwrap();
    let hand = hand.with_tremor(Tremor { amplitude: 1e-3, frequency_hz: 5.0 }).unwrap();
    let mut master = SimulatedMaster::new(device, hand, 0).unwrap();
    let mut now_ns = 0;
    // A whole second, so that events have their share.
    criterion.bench_function(name, |bencher| {
        bencher.iter(|| {
            for _ in 0..1000 {
                now_ns += 1_000_000;
                let sample = master.read(now_ns);
                master.write(&(sample.position * 0.0));
                black_box(master.hand_force());
            }
        });
    });
}

fn exact(criterion: &mut Criterion) {
    let axis = DeviceParameters::<3> { friction: Friction::Axis, ..DeviceParameters::phantom_desktop() };
    tick(criterion, "1000 ticks, 1 axis", DeviceParameters::<1>::phantom_desktop(), 8.0, Vec::new());
    tick(criterion, "1000 ticks, 3 axes, friction on each", axis, 8.0, Vec::new());
    let along = DeviceParameters::<3>::phantom_desktop();
    tick(criterion, "1000 ticks, 3 axes, friction along the motion", along, 8.0, Vec::new());
    let legs = (0..4000)
        .map(|n| {
            let angle = f64::from(n) * 0.8;
            let end = Axes::<3>::new(angle.cos(), angle.sin(), (0.7 * angle).sin()) * 0.03;
            Leg { duration_s: 0.4, end, shape: LegShape::MinimumJerk }
        })
        .collect();
    tick(criterion, "1000 ticks, 3 axes, friction along a motion that bends", along, 8.0, legs);
    let stiff = DeviceParameters::<1>::ideal(0.005, 0.0, 0.038);
    tick(criterion, "1000 ticks, stiff device", stiff, 8.0, Vec::new());
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(30).measurement_time(std::time::Duration::from_secs(2));
    targets = exact
}
criterion_main!(benches);
