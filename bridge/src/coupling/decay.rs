//! Where a peer that is late may have gone: extrapolation with a velocity that decays.

/// Displacement in s per unit of velocity, and share of the velocity that is left, `late_ns` into a decay of
/// `decay_ns`.
///
/// `d(t) = t - t² / (2 T)`, `v(t) / v = 1 - t / T` for t < T; then `T / 2` and 0.
///
/// With a constant velocity an arm of 1 m/s would run on by 0.2 m before a watchdog of 200 ms; here it goes at most
/// `v T / 2`, 7.5 mm at 15 ms, and stands when HOLD begins.
pub(crate) fn decayed(late_ns: u64, decay_ns: u64) -> (f64, f64) {
    let (t, whole) = (late_ns.min(decay_ns) as f64 * 1e-9, decay_ns as f64 * 1e-9);
    if whole == 0.0 {
        return (0.0, 0.0);
    }
    (t - t * t / (2.0 * whole), 1.0 - t / whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_begins_with_all_of_the_velocity_and_ends_at_rest() {
        const MS: u64 = 1_000_000;
        assert_eq!(decayed(0, 15 * MS), (0.0, 1.0));
        for late in [15 * MS, 16 * MS, u64::MAX] {
            let (way, share) = decayed(late, 15 * MS);
            assert!((way - 7.5e-3).abs() < 1e-17 && share == 0.0);
        }
        assert_eq!(decayed(5 * MS, 0), (0.0, 0.0));
        // The way is the integral of the velocity: trapezoids are exact for a straight line.
        let mut way = 0.0;
        for tick in 0..15 {
            let [(_, before), (_, after)] = [tick, tick + 1].map(|tick| decayed(tick * MS, 15 * MS));
            way += 0.5 * (before + after) * 1e-3;
            assert!((decayed((tick + 1) * MS, 15 * MS).0 - way).abs() < 1e-16);
        }
    }
}
