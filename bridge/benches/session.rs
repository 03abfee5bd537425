//! Time of sealing, opening and refusing datagrams, and of a handshake: `cargo bench -p haptether-bridge --bench session`.
#![allow(clippy::unwrap_used, missing_docs)] // a bench may; criterion's macros make public items

use std::hint::black_box;

use criterion::{BatchSize, BenchmarkId, Criterion, criterion_group, criterion_main};
use haptether_bridge::{
    session::{MAX_DATAGRAM, PreSharedKey, Received, SessionEnd, SessionSettings, SystemEntropy},
    wire::{FrameLayout, Role},
};

const MS: u64 = 1_000_000;

fn ends(payload: usize) -> (SessionEnd, SessionEnd) {
    let end = |role| {
        let settings = SessionSettings::new(role, payload, MS);
        SessionEnd::secure(
            settings,
            PreSharedKey::new(b"the key that both ends share: 32").unwrap(),
            &mut SystemEntropy::new(),
        )
        .unwrap()
    };
    (end(Role::Master), end(Role::Slave))
}

fn shake((master, slave): &mut (SessionEnd, SessionEnd)) {
    let mut entropy = SystemEntropy::new();
    let mut hello = master.poll(0, &mut entropy).unwrap().unwrap();
    let Ok(Received::Reply(mut answer)) = slave.receive(0, &mut hello, &mut entropy) else { unreachable!() };
    master.receive(0, &mut answer, &mut entropy).unwrap();
}

fn datagrams(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("session");
    for axes in [1, 7] {
        let payload = vec![7; FrameLayout::of(axes).length()];
        let mut pair = ends(payload.len());
        shake(&mut pair);
        let (mut master, mut slave) = pair;
        let mut buffer = [0; MAX_DATAGRAM];
        group.bench_function(BenchmarkId::new("seal and open", payload.len()), |bencher| {
            bencher.iter(|| {
                let length = master.session.seal(MS, &payload, &mut buffer).unwrap().len();
                black_box(slave.session.open(MS, &mut buffer[..length]).is_ok())
            });
        });
        let good = master.session.seal(MS, &payload, &mut buffer).unwrap().to_vec();
        for (name, at) in [
            ("refuse another length", 0),
            ("refuse another session", 8),
            ("refuse a forged tag", good.len() - 1),
        ] {
            let mut bad = good.clone();
            bad[at] ^= 1;
            if at == 0 {
                bad.pop();
            }
            group.bench_function(BenchmarkId::new(name, payload.len()), |bencher| {
                bencher.iter(|| {
                    // A forgery that is decrypted is overwritten: each try needs a fresh copy.
                    buffer[..bad.len()].copy_from_slice(&bad);
                    black_box(slave.session.open(MS, &mut buffer[..bad.len()]).is_err())
                });
            });
        }
    }
    group.bench_function("handshake, both sides", |bencher| {
        bencher.iter_batched(|| ends(92), |mut pair| shake(&mut pair), BatchSize::SmallInput);
    });
    let mut slave = ends(92).1;
    let mut hello = ends(92).0.poll(0, &mut SystemEntropy::new()).unwrap().unwrap();
    hello[80] ^= 1;
    group.bench_function("refuse a forged hello", |bencher| {
        let mut entropy = SystemEntropy::new();
        bencher.iter(|| black_box(slave.receive(MS, &mut hello.clone(), &mut entropy).is_err()));
    });
    group.finish();
}

criterion_group!(benches, datagrams);
criterion_main!(benches);
