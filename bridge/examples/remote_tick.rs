//! Cost of a tick of a remote scene in virtual time: `remote_tick REPEATS SCENE.json...` prints one line of JSON each.
//!
//! Each scene, in the form of `haptether.bridge.scene_json`, is run `REPEATS` times with plain and `REPEATS` times
//! with encoded frames. Times are the least of the runs, in ns per tick of the master, on one thread. The line also
//! has the outcome, the counts of both sides, and a checksum of signals and events. These must not depend on the
//! encoding.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // a bench: any failure ends it

use std::{env, fs, sync::atomic::AtomicBool, time::Instant};

use haptether_bridge::scene::{SceneError, SceneRun, simulate, simulate_encoded};
use serde_json::{Value, json};

type Simulate = fn(&[u8], &AtomicBool) -> Result<SceneRun, SceneError>;

/// Return the CRC-32 of names and values of the signals, and of time, kind and detail of the events.
fn checksum(run: &SceneRun) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    for signal in &run.signals {
        sum.update(signal.name.as_bytes());
        signal.values.iter().for_each(|value| sum.update(&value.to_le_bytes()));
    }
    for event in &run.events {
        sum.update(&event.time_s.to_le_bytes());
        sum.update(event.kind.as_bytes());
        sum.update(event.detail.as_bytes());
    }
    sum.finalize()
}

fn counts(run: &SceneRun) -> Vec<Vec<u64>> {
    let reports = run.reports.iter().flatten();
    reports
        .map(|report| {
            let (link, path) = (&report.link, &report.path);
            let (seen, losses, order) =
                (&path.statistics, &path.statistics.losses, &path.statistics.reordering);
            vec![
                report.ticks,
                report.skipped,
                link.sent,
                link.fresh,
                link.late,
                link.duplicate,
                link.refused,
                link.missing,
                report.holds,
                report.limited,
                seen.received,
                seen.expected,
                losses.lost,
                losses.bursts,
                losses.longest,
                order.reordered,
                order.longest_extent,
                seen.duplicate,
                seen.too_late,
                path.clock_faults,
                path.steps,
            ]
        })
        .collect()
}

fn outcome(run: &SceneRun) -> Value {
    let one = &run.outcome;
    json!([
        one.ticks,
        one.max_ejection_velocity,
        one.peak_device_force,
        one.time_to_trip_s,
        one.false_trips,
        one.passivity_min_j,
        one.position_rmse_m,
        one.force_rmse_n,
        one.max_ejection_rate,
        one.peak_device_torque,
        one.orientation_rmse_rad,
        one.torque_rmse_n_m,
    ])
}

fn timed(simulate: Simulate, scene: &[u8]) -> Result<(SceneRun, f64), SceneError> {
    let begun = Instant::now();
    let run = simulate(scene, &AtomicBool::new(false))?;
    let took_ns = begun.elapsed().as_secs_f64() * 1e9;
    let ns_per_tick = took_ns / run.outcome.ticks.max(1) as f64;
    Ok((run, ns_per_tick))
}

fn main() {
    let mut arguments = env::args().skip(1);
    let repeats: u32 = arguments.next().unwrap().parse().unwrap();
    let transports: [(&str, Simulate); 2] = [("frames", simulate), ("bytes", simulate_encoded)];
    for path in arguments {
        let scene = fs::read(&path).unwrap();
        let mut least_ns = [f64::INFINITY; 2];
        let mut seen = [const { None }; 2];
        // In turn, so that both run under the same load.
        for _ in 0..repeats {
            for (transport, (_, simulate)) in transports.iter().enumerate() {
                seen[transport] = Some(match timed(*simulate, &scene) {
                    Ok((run, ns)) => {
                        least_ns[transport] = least_ns[transport].min(ns);
                        json!([checksum(&run), counts(&run), outcome(&run)])
                    }
                    Err(error) => json!([error.to_string()]),
                });
            }
        }
        let line = json!({
            "scene": path, "ns_per_tick": least_ns[0], "encoded_ns_per_tick": least_ns[1],
            "is_same": seen[0] == seen[1], "run": seen[0],
        });
        println!("{line}");
    }
}
