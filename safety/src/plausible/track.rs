//! Path of a point, from its last samples.

use nalgebra::SimdBool as _;

use super::bounds::{PerTick, SampleBounds, is_short};
use crate::{Axes, Real};
use haptether_numeric::{is_within, no_lanes, selected};

/// Largest number of ticks between two samples of a device that samples more slowly than the loop.
pub(super) const MAX_EVERY: f64 = 4.0;

/// Last change among samples.
#[derive(Clone, Copy, Debug)]
pub(super) struct Change<T> {
    /// Its tick.
    pub(super) at: f64,
    /// Ticks since the change before it; infinite if the sample of a tick between them is unknown.
    pub(super) interval: f64,
    pub(super) from: T,
    pub(super) to: T,
}

impl<T: Copy + PartialEq> Change<T> {
    /// Find the last change; `last` is the last sample before the others, at tick 0, and has been the same for `same_for`
    /// ticks.
    pub(super) fn find(last: T, same_for: f64, samples: impl Iterator<Item = (f64, T)>) -> Self {
        let (mut before, mut now) = (last, (-same_for, last));
        let (mut interval, mut seen_at, mut is_known) = (0.0, 0.0, true);
        for (at, value) in samples {
            is_known &= !is_gap(at - seen_at, 1.0);
            seen_at = at;
            if value != now.1 {
                interval = if is_known { at - now.0 } else { f64::INFINITY };
                (before, now, is_known) = (now.1, (at, value), true);
            }
        }
        Self { at: now.0, interval, from: before, to: now.1 }
    }

    /// Return whether the device is slower than the loop, and not slower than is followed.
    pub(super) fn is_of_slow_device(&self) -> bool {
        self.interval > 1.0 && self.interval <= MAX_EVERY
    }
}

/// Return the mask of times in ticks that have more ticks than samples.
#[inline(always)]
pub(super) fn is_gap<S: Real>(ticks: S, samples: S) -> S::SimdBool {
    ticks.simd_gt(samples + S::splat(0.5))
}

/// Path of a point: `x(k) = x_a + v k`, k ticks after the anchor `x_a`.
///
/// The anchor is the last sample. A device that samples more slowly than the loop repeats its samples; the anchor is
/// then the first of equal samples.
///
/// A sample is on the path where `|x - x_a - v k| <= dV dT + q (k + 1)`. The bound allows a change of velocity by dV, and rounding
/// to the quantum q of this sample and of the two that define v.
///
/// Source: derived here.
#[derive(Clone, Copy, Debug)]
pub struct Track<const N: usize, S = f64> {
    pub(super) bounds: PerTick,
    pub(super) path: Path<N, S>,
}

/// State of a [`Track`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Path<const N: usize, S = f64> {
    pub(super) anchor: Option<Axes<N, S>>,
    /// v in m per tick; None before the second sample.
    pub(super) rate: Option<Axes<N, S>>,
    /// Ticks from the anchor to the last sample.
    pub(super) since: S,
    /// Ticks from the last sample that differed from its predecessor to the last sample; more than [`MAX_EVERY`] after a
    /// tick without a sample.
    pub(super) same_for: S,
    /// Ticks between the last two samples that differed, with a sample at each tick between them.
    pub(super) every: S,
}

impl<const N: usize, S: Real> Track<N, S> {
    /// Create the path of a device sampled every `period_s`, before its first sample.
    pub fn new(bounds: SampleBounds, period_s: f64) -> Self {
        Self::of(bounds.per_tick(period_s))
    }

    fn of(bounds: PerTick) -> Self {
        let [since, same_for, every] = [S::zero(), S::zero(), S::one()];
        Self { bounds, path: Path { anchor: None, rate: None, since, same_for, every } }
    }

    /// Gather one path per lane. Returns None if bounds differ or a path has begun.
    pub fn gather(of: &[&Track<N>]) -> Option<Self> {
        let bounds = of.first()?.bounds;
        of.iter().all(|one| one.bounds == bounds && one.path.anchor.is_none()).then(|| Self::of(bounds))
    }

    /// Accept a sample, `ticks` after the last one; `samples` are those seen since, which repeat the last one, and this
    /// one.
    ///
    /// A late tick or an outlier tells nothing about the rate of the device.
    #[inline(always)]
    pub(super) fn accept(&mut self, position: &Axes<N, S>, ticks: S, samples: S) {
        let Self { bounds, path } = self;
        let Some(anchor) = path.anchor.replace(*position) else { return };
        let (k, same_for) = (path.since + ticks, path.same_for + ticks);
        let same_for = (same_for + S::splat(MAX_EVERY)).select(is_gap(ticks, samples), same_for);
        let moved = position - anchor;
        let is_same = is_within(&moved, 0.0);
        let mut repeats = no_lanes::<S>();
        if path.rate.is_some() {
            repeats = is_same & k.simd_lt(path.every);
        }
        let rate = path.rate.unwrap_or(Axes::zeros());
        // Most samples follow after one tick; a division is slow.
        let now = if k.simd_eq(S::one()).all() { moved } else { moved / k };
        path.rate = Some(selected(repeats, rate, &now));
        // A repeat keeps the position of the anchor.
        path.since = k.select(repeats, S::zero());
        // Steps of a quantum or two are a slow motion, and a longer time without a change is a rest.
        let [quantum, max_every] = [bounds.quantum, MAX_EVERY].map(S::splat);
        let keeps = is_short(&moved, quantum + quantum, bounds.per_axis) | same_for.simd_gt(max_every);
        path.every = path.every.select(keeps, same_for);
        path.same_for = same_for.select(is_same, S::zero());
    }

    /// Test a measured velocity in m/s: its speed is within the bound, and it differs from the one before by at most dV.
    #[inline(always)]
    pub fn is_steady(&self, from: &Axes<N, S>, to: &Axes<N, S>) -> S::SimdBool {
        self.bounds.is_steady(from, to, S::one())
    }

    /// Accept a sample, `ticks` after the one before, and return the mask of lanes where it was on the path.
    ///
    /// In the other lanes the path is no longer usable.
    #[inline(always)]
    pub fn step(&mut self, position: &Axes<N, S>, ticks: S) -> S::SimdBool {
        let on_path = self.path.contains(&self.bounds, position, ticks, S::one());
        self.accept(position, ticks, S::one());
        on_path
    }
}

impl<const N: usize, S: Real> Path<N, S> {
    /// Return the mask of samples on the path, `ticks` after its last sample and within `share` of dV.
    ///
    /// A late tick widens nothing but the rounding: a wrong sample after it is as wrong as at any other tick.
    #[inline(always)]
    pub(super) fn contains(
        &self,
        bounds: &PerTick,
        position: &Axes<N, S>,
        ticks: S,
        share: S,
    ) -> S::SimdBool {
        let Some(anchor) = &self.anchor else { return !no_lanes::<S>() };
        let [speed, change, quantum] = [bounds.speed, bounds.change, bounds.quantum].map(S::splat);
        let k = self.since + ticks;
        let moved = position - anchor;
        let is_slow = is_short(&moved, speed * k + quantum + quantum, bounds.per_axis);
        let Some(rate) = &self.rate else { return is_slow };
        let limit = change * share + quantum * (k + S::one());
        is_slow & is_short(&(moved - rate * k), limit, bounds.per_axis)
    }
}

impl<const N: usize> Track<N> {
    /// Predict the position `ticks` after the last sample; None before the first.
    pub(super) fn at(&self, ticks: f64) -> Option<Axes<N>> {
        let Path { anchor, rate, since, .. } = self.path;
        let rate = rate.unwrap_or(Axes::zeros());
        anchor.map(|anchor| anchor + rate * (since + ticks))
    }

    /// Forget the path, but not how often the device samples.
    pub(super) fn restart(&mut self) {
        let every = self.path.every;
        *self = Self::of(self.bounds);
        self.path.every = every;
    }

    /// Continue from a place beside the path with the same velocity.
    pub(super) fn step_to(&mut self, position: &Axes<N>) {
        (self.path.anchor, self.path.since) = (Some(*position), 0.0);
    }

    /// Continue after a change of the path; a slow device continues from its last two different samples.
    pub(super) fn resume(&mut self, change: &Change<Axes<N>>, newest_at: f64, is_step: bool) {
        let Self { bounds, path } = self;
        path.same_for = newest_at - change.at;
        let moved = change.to - change.from;
        let is_still = is_short(&moved, 2.0 * bounds.quantum, bounds.per_axis);
        if !is_step && change.is_of_slow_device() && !is_still {
            (path.anchor, path.rate) = (Some(change.to), Some(moved / change.interval));
            (path.since, path.every) = (newest_at - change.at, change.interval);
        }
    }
}
