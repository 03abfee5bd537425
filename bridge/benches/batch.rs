//! Time of a sweep of the reference work unit, per scenario-tick: `cargo bench -p haptether-bridge`.
//!
//! `work_unit.json` is `benches/work_unit.toml` as the Python side hands it over; a test holds the two together.
#![allow(clippy::unwrap_used, missing_docs)] // a bench may; criterion's macros make public items

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use haptether_bridge::scene::{Metrics, Progress, SweepSettings, Variation, sweep};

const SCENE: &[u8] = include_bytes!("work_unit.json");
const TICKS: u64 = 2000;

fn depths(scenarios: u32) -> Variation {
    let share = |i: u32| f64::from(i) / f64::from(scenarios - 1);
    Variation {
        path: "operator.legs.0.end.0".into(),
        values: (0..scenarios).map(|i| -(0.01 + 0.05 * share(i))).collect(),
    }
}

fn batch(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("scenario-tick");
    group.sample_size(10);
    for scenarios in [100, 10_000] {
        let variations = [depths(scenarios)];
        group.throughput(Throughput::Elements(u64::from(scenarios) * TICKS));
        for (name, threads, lanes) in
            [("lanes", 1, true), ("lanes, 2 threads", 2, true), ("single", 1, false)]
        {
            let settings = SweepSettings { threads, lanes, metrics: Metrics::ALL };
            group.bench_with_input(BenchmarkId::new(name, scenarios), &settings, |bencher, settings| {
                bencher.iter(|| {
                    black_box(sweep(SCENE, &variations, *settings, &Progress::default(), None).unwrap())
                });
            });
        }
    }
    group.finish();
}

criterion_group!(benches, batch);
criterion_main!(benches);
