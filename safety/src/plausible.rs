//! Plausibility check of samples: a wrong sample moves neither force nor arm, and an impossible motion is a fault.

use std::fmt;

use nalgebra::UnitQuaternion;

use crate::{
    Axes, Fault, ParameterError, Real, Signal,
    lanes::{is_within, nowhere, selected},
};

#[cfg(test)]
mod tests;

/// Bounds on the samples of a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleBounds {
    /// Speed bound of the device in m/s (rad/s).
    pub speed: f64,
    /// Largest change of velocity in m/s (rad/s) between successive samples of one path. At 1 kHz, 0.5 m/s is 0.5 mm
    /// off the path.
    pub velocity_change: f64,
    /// Resolution of the position in m (rad).
    pub quantum: f64,
    /// If true, each axis must meet the bounds separately, as for joints; else the norm must.
    pub per_axis: bool,
}

impl SampleBounds {
    /// Bounds of a point: 20 m/s, and 0.5 mm off its path at 1 kHz.
    ///
    /// A hand throws at 10 m/s at most. A motor of 8.5 N on 75 g reaches 9.3 m/s over its workspace.
    pub const LINEAR: Self = Self { speed: 20.0, velocity_change: 0.5, quantum: 0.0, per_axis: false };

    /// Bounds of joints: 60 rad/s, and the path of a point at a lever of 0.1 m, a short link.
    pub const JOINTS: Self = Self {
        speed: 60.0,
        velocity_change: Self::LINEAR.velocity_change / 0.1,
        quantum: 0.0,
        per_axis: true,
    };

    /// No bounds: every sample is valid.
    pub const UNBOUNDED: Self =
        Self { speed: f64::INFINITY, velocity_change: f64::INFINITY, quantum: 0.0, per_axis: false };

    /// Default bounds for a number of axes: joints from four axes on, else a point.
    pub const fn of_axes(axes: usize) -> Self {
        if axes <= 3 { Self::LINEAR } else { Self::JOINTS }
    }

    /// Check that speed and velocity change are above 0, and the quantum finite and 0 or more. NaN is refused.
    pub fn checked(self) -> Result<Self, ParameterError> {
        let refused = |name, symbol, seen: f64, accepted: bool, allowed| {
            if accepted { Ok(()) } else { Err(ParameterError { name, symbol, seen, allowed }) }
        };
        let Self { speed, velocity_change, quantum, .. } = self;
        refused("speed_bound", "V_max", speed, speed > 0.0, "above 0")?;
        refused("velocity_change", "dV", velocity_change, velocity_change > 0.0, "above 0")?;
        refused("quantum", "q", quantum, quantum >= 0.0 && quantum.is_finite(), "finite and 0 or more")?;
        Ok(self)
    }

    /// Bounds of the rotation of a handle that the hand holds at lever r in m.
    ///
    /// A point on its rim deviates from the path as a point device may. The speed bound is that of
    /// [`JOINTS`](Self::JOINTS).
    #[must_use]
    pub fn at_lever(self, lever_m: f64) -> Self {
        Self {
            speed: Self::JOINTS.speed,
            velocity_change: self.velocity_change / lever_m,
            quantum: self.quantum / lever_m,
            per_axis: false,
        }
    }

    /// Convert the bounds to units per tick of `period_s`.
    fn per_tick(self, period_s: f64) -> PerTick {
        let Self { speed, velocity_change, quantum, per_axis } = self;
        PerTick { period_s, speed: speed * period_s, change: velocity_change * period_s, quantum, per_axis }
    }
}

/// [`SampleBounds`] in m (rad) per tick.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PerTick {
    period_s: f64,
    speed: f64,
    change: f64,
    quantum: f64,
    per_axis: bool,
}

impl PerTick {
    /// Test a velocity in m/s: its speed is within the bound, and it differs from the one before by at most `share` of dV.
    #[inline(always)]
    fn is_steady<const N: usize, S: Real>(
        &self,
        from: &Axes<N, S>,
        to: &Axes<N, S>,
        share: S,
    ) -> S::SimdBool {
        let [period_s, speed, change] = [self.period_s, self.speed, self.change].map(S::splat);
        is_short(&((to - from) * period_s), change * share, self.per_axis)
            & is_short(&(to * period_s), speed, self.per_axis)
    }
}

/// Mask of vectors no longer than a limit.
#[inline(always)]
fn is_short<const N: usize, S: Real>(vector: &Axes<N, S>, limit: S, per_axis: bool) -> S::SimdBool {
    if N == 1 || per_axis {
        return vector.iter().fold(!nowhere::<S>(), |all, x| all & x.magnitude().simd_le(limit));
    }
    vector.dot(vector).simd_le(limit * limit)
}

/// Largest number of ticks between two samples of a device that samples more slowly than the loop.
const MAX_EVERY: f64 = 4.0;

/// Fewest accepted samples between two steps of a device in one direction.
const MIN_BETWEEN_STEPS: u32 = 100;

/// Return whether a device with this number of ticks between changing samples is slower than the loop, and still followed.
fn is_of_slow_device(interval: f64) -> bool {
    interval > 1.0 && interval <= MAX_EVERY
}

/// Find the last change among samples: ticks since the change before it, its tick, and the values before and after it.
///
/// `last` is the last sample before them, at tick 0, and has been the same for `same_for` ticks.
fn last_change<T: Copy + PartialEq>(
    last: T,
    same_for: f64,
    samples: impl Iterator<Item = (f64, T)>,
) -> (f64, f64, [T; 2]) {
    let (mut before, mut now) = ((-same_for, last), (-same_for, last));
    for (at, value) in samples {
        if value != now.1 {
            (before, now) = (now, (at, value));
        }
    }
    (now.0 - before.0, now.0, [before.1, now.1])
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
    bounds: PerTick,
    anchor: Option<Axes<N, S>>,
    /// v in m per tick; None before the second sample.
    rate: Option<Axes<N, S>>,
    /// Ticks from the anchor to the last sample.
    since: S,
    /// Ticks from the last sample that differed from its predecessor to the last sample.
    same_for: S,
    /// Ticks between the last two samples that differed.
    every: S,
}

impl<const N: usize, S: Real> Track<N, S> {
    /// Create the path of a device sampled every `period_s`, before its first sample.
    pub fn new(bounds: SampleBounds, period_s: f64) -> Self {
        Self::of(bounds.per_tick(period_s))
    }

    fn of(bounds: PerTick) -> Self {
        let [since, same_for, every] = [S::zero(), S::zero(), S::one()];
        Self { bounds, anchor: None, rate: None, since, same_for, every }
    }

    /// Gather one path per lane. Returns None if bounds differ or a path has begun.
    pub fn gather(of: &[&Track<N>]) -> Option<Self> {
        let bounds = of.first()?.bounds;
        of.iter().all(|one| one.bounds == bounds && one.anchor.is_none()).then(|| Self::of(bounds))
    }

    /// Return the mask of samples on the path, `ticks` after its last sample and within `share` of dV.
    ///
    /// A late tick widens nothing but the rounding: a wrong sample after it is as wrong as at any other tick.
    #[inline(always)]
    fn contains(&self, position: &Axes<N, S>, ticks: S, share: S) -> S::SimdBool {
        let Some(anchor) = &self.anchor else { return !nowhere::<S>() };
        let PerTick { speed, change, quantum, per_axis, .. } = self.bounds;
        let [speed, change, quantum] = [speed, change, quantum].map(S::splat);
        let k = self.since + ticks;
        let moved = position - anchor;
        let is_slow = is_short(&moved, speed * k + quantum + quantum, per_axis);
        let Some(rate) = &self.rate else { return is_slow };
        is_slow & is_short(&(moved - rate * k), change * share + quantum * (k + S::one()), per_axis)
    }

    /// Accept a sample, `ticks` after the last one.
    #[inline(always)]
    fn accept(&mut self, position: &Axes<N, S>, ticks: S) {
        let Some(anchor) = self.anchor.replace(*position) else { return };
        let (k, same_for) = (self.since + ticks, self.same_for + ticks);
        let moved = position - anchor;
        let is_same = is_within(&moved, 0.0);
        let mut repeats = nowhere::<S>();
        if self.rate.is_some() {
            repeats = is_same & k.simd_lt(self.every);
        }
        let rate = self.rate.unwrap_or(Axes::zeros());
        self.rate = Some(selected(repeats, rate, &(moved / k)));
        // A repeat keeps the position of the anchor.
        self.since = k.select(repeats, S::zero());
        // Steps of a quantum or two are a slow motion, and a longer time without a change is a rest.
        let [quantum, max_every] = [self.bounds.quantum, MAX_EVERY].map(S::splat);
        let keeps = is_short(&moved, quantum + quantum, self.bounds.per_axis) | same_for.simd_gt(max_every);
        self.every = self.every.select(keeps, same_for);
        self.same_for = same_for.select(is_same, S::zero());
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
        let on_path = self.contains(position, ticks, S::one());
        self.accept(position, ticks);
        on_path
    }
}

impl<const N: usize> Track<N> {
    /// Predict the position `ticks` after the last sample; None before the first.
    fn at(&self, ticks: f64) -> Option<Axes<N>> {
        let rate = self.rate.unwrap_or(Axes::zeros());
        self.anchor.map(|anchor| anchor + rate * (self.since + ticks))
    }
}

/// Orientation and, if the device measures it, angular velocity in rad/s, both in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Turned {
    /// R, `base_from_body`.
    pub orientation: UnitQuaternion<f64>,
    /// w in rad/s.
    pub angular_velocity: Option<Axes<3>>,
}

/// Path of a rotation on SO(3), `R(k) = exp(w k) R_a`; as [`Track`], with angles for lengths.
///
/// The test compares the sine of half the angle with half of the limit. Below 0.5 rad they agree to 1 %.
#[derive(Clone, Copy, Debug)]
struct TurnTrack {
    bounds: PerTick,
    anchor: Option<UnitQuaternion<f64>>,
    /// `exp(w)`, w in rad per tick.
    rate: Option<UnitQuaternion<f64>>,
    since: f64,
    same_for: f64,
    every: f64,
}

/// Return whether the angle of a rotation is at most `angle` in rad.
#[inline]
fn is_small(turn: &UnitQuaternion<f64>, angle: f64) -> bool {
    turn.imag().norm_squared() <= 0.25 * angle * angle
}

impl TurnTrack {
    fn new(bounds: SampleBounds, period_s: f64) -> Self {
        let bounds = bounds.per_tick(period_s);
        Self { bounds, anchor: None, rate: None, since: 0.0, same_for: 0.0, every: 1.0 }
    }

    fn at(&self, ticks: f64) -> Option<UnitQuaternion<f64>> {
        let anchor = self.anchor?;
        let Some(rate) = self.rate else { return Some(anchor) };
        let k = self.since + ticks;
        Some(if k == 1.0 { rate } else { rate.powf(k) } * anchor)
    }

    fn contains(&self, orientation: &UnitQuaternion<f64>, ticks: f64, share: f64) -> bool {
        let (Some(anchor), Some(expected)) = (self.anchor, self.at(ticks)) else { return true };
        let PerTick { speed, change, quantum, .. } = self.bounds;
        let k = self.since + ticks;
        is_small(&anchor.rotation_to(orientation), speed * k + 2.0 * quantum)
            && (self.rate.is_none()
                || is_small(&expected.rotation_to(orientation), change * share + quantum * (k + 1.0)))
    }

    fn accept(&mut self, orientation: &UnitQuaternion<f64>, ticks: f64) {
        let Some(anchor) = self.anchor.replace(*orientation) else { return };
        let (k, same_for) = (self.since + ticks, self.same_for + ticks);
        let is_same = *orientation == anchor;
        self.same_for = if is_same { same_for } else { 0.0 };
        if same_for <= MAX_EVERY && !is_small(&anchor.rotation_to(orientation), 2.0 * self.bounds.quantum) {
            self.every = same_for;
        }
        if self.rate.is_some() && is_same && k < self.every {
            self.since = k;
            return;
        }
        let turn = orientation * anchor.inverse();
        self.rate = Some(if k == 1.0 { turn } else { turn.powf(1.0 / k) });
        self.since = 0.0;
    }
}

/// Measurements of a device at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// x in m (rad).
    pub position: Axes<N>,
    /// V in m/s (rad/s), if the device measures it; given at every sample or at none.
    pub velocity: Option<Axes<N>>,
    /// Rotation of a device that turns.
    pub rotation: Option<Turned>,
}

impl<const N: usize> Sample<N> {
    /// Create the sample of a point.
    #[inline]
    pub fn point(position: &Axes<N>, velocity: Option<&Axes<N>>) -> Self {
        Self { position: *position, velocity: velocity.copied(), rotation: None }
    }

    /// Return the sample of a device whose origin moves by `by`; the rotation is in the base frame.
    fn shifted(&self, by: &Self) -> Self {
        let turned = self
            .rotation
            .zip(by.rotation)
            .map(|(turned, by)| Turned { orientation: by.orientation * turned.orientation, ..turned });
        Self { position: self.position + by.position, rotation: turned.or(self.rotation), ..*self }
    }

    /// Interpolate from this sample to a later one: along a straight line, and at constant rate about one axis.
    #[must_use]
    pub fn towards(&self, later: &Self, share: f64) -> Self {
        let turned = |from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>| {
            let turn = UnitQuaternion::from_scaled_axis((to * from.inverse()).scaled_axis() * share);
            UnitQuaternion::new_normalize((turn * from).into_inner())
        };
        Self {
            position: self.position + (later.position - self.position) * share,
            velocity: between(self.velocity, later.velocity, share),
            rotation: self.rotation.zip(later.rotation).map(|(from, to)| Turned {
                orientation: turned(&from.orientation, &to.orientation),
                angular_velocity: between(from.angular_velocity, to.angular_velocity, share),
            }),
        }
    }
}

fn between<const N: usize>(from: Option<Axes<N>>, to: Option<Axes<N>>, share: f64) -> Option<Axes<N>> {
    from.zip(to).map(|(from, to)| from + (to - from) * share)
}

/// Speed beyond the bound of the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Excess {
    /// Signal that exceeds the bound.
    pub signal: Signal,
    /// Seen speed in m/s (rad/s).
    pub seen: f64,
    /// Bound in m/s (rad/s).
    pub bound: f64,
    /// True if both are in rad/s.
    pub is_angular: bool,
}

impl Excess {
    /// Return the fault.
    pub fn fault(&self) -> Fault {
        Fault::TooFast(self.signal)
    }
}

impl fmt::Display for Excess {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { signal, seen, bound, is_angular } = self;
        let what = if signal.is_velocity() { "is" } else { "stepped at" };
        let unit = if *is_angular { "rad/s" } else { "m/s" };
        write!(
            f,
            "{} {what} {seen:.3} {unit}: must be at most {bound} {unit}, its speed_bound; check sensor and cable",
            signal.name()
        )
    }
}

/// Largest number of successive samples off the path that count as outliers.
const MAX_OUTLIERS: usize = 3;
/// Largest number of held samples: one more, since the fourth sample may itself be wrong.
pub(crate) const MAX_HELD: usize = MAX_OUTLIERS + 1;

/// Sample and its time in ticks after the last sample of the path.
#[derive(Clone, Copy, Debug)]
struct Knot<const N: usize> {
    at: f64,
    sample: Sample<N>,
}

/// Result of judging a sample.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Judged<const N: usize> {
    /// Accepted unchanged: on the path, one tick after the last sample.
    Passed,
    /// Held: off the path, perhaps an outlier. [`Guard::taken`] is the prediction for this time in ticks.
    Held(f64),
    /// Accepted, after ticks since the last accepted sample that must be caught up with.
    Settled,
    /// Refused: the device cannot move so fast.
    Stepped(Excess),
}

/// Ticks between two accepted samples, interpolated linearly between the measurements.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Between<const N: usize> {
    knots: [Knot<N>; MAX_HELD + 2],
    count: usize,
    /// Ticks up to the newest sample.
    pub(crate) ticks: u64,
    /// Movement of the device origin in this time.
    pub(crate) shift: Option<Sample<N>>,
}

impl<const N: usize> Between<N> {
    /// Interpolate the sample of one tick.
    pub(crate) fn at(&self, tick: u64) -> Sample<N> {
        let tick = tick as f64;
        let knots = &self.knots[..self.count];
        let later = knots.iter().position(|knot| knot.at >= tick).unwrap_or(self.count - 1).max(1);
        let (from, to) = (&knots[later - 1], &knots[later]);
        from.sample.towards(&to.sample, (tick - from.at) / (to.at - from.at))
    }
}

/// Check the samples of a device against their path, before any other part uses them.
///
/// The path extrapolates from the last sample with the velocity of the last two: [`Track`]. A sample on it passes
/// unchanged.
///
/// - **Outlier.** A sample off the path is held and replaced by its prediction. If one of the next 3 ticks is on the
///   path again, the held samples count as outliers. They are then interpolated between the samples around them.
/// - **Change of velocity that stays**, for example at a mechanical stop. After 3 ticks off the path the samples are
///   accepted if the speed between them is within the bound of the device. One sample that fits neither neighbour is
///   left out.
/// - **Step.** A speed beyond the bound that does not revert is a fault. A step within the bound, after which the
///   device moves on as before, moves the origin and adds no velocity.
///
/// Source: derived here.
#[derive(Clone, Debug)]
pub struct Guard<const N: usize> {
    bounds: [SampleBounds; 2],
    period_s: f64,
    track: Track<N>,
    turn: TurnTrack,
    /// Path before the last sample was accepted, and the ticks from its end to that sample.
    before: (Track<N>, TurnTrack, f64),
    /// Last sample of the path; before the first, the sample at which the path was reset.
    last: Sample<N>,
    /// Prediction that replaces a held sample.
    predicted: Sample<N>,
    held: [Knot<N>; MAX_HELD],
    count: usize,
    between: Option<Between<N>>,
    /// The last step, and accepted samples since.
    shift: Sample<N>,
    since_shift: u32,
    outliers: u64,
}

impl<const N: usize> Guard<N> {
    /// Create a guard for samples every `period_s`, with bounds of the position and of the rotation.
    pub fn new(bounds: SampleBounds, rotation: SampleBounds, period_s: f64) -> Self {
        let nothing = Sample { position: Axes::zeros(), velocity: None, rotation: None };
        let (track, turn) = (Track::new(bounds, period_s), TurnTrack::new(rotation, period_s));
        Self {
            bounds: [bounds, rotation],
            period_s,
            track,
            turn,
            before: (track, turn, 1.0),
            last: nothing,
            predicted: nothing,
            held: [Knot { at: 0.0, sample: nothing }; MAX_HELD],
            count: 0,
            between: None,
            shift: nothing,
            since_shift: MIN_BETWEEN_STEPS,
            outliers: 0,
        }
    }

    /// Return the accepted sample, or the prediction while the newest sample is held.
    #[inline]
    pub fn taken(&self) -> &Sample<N> {
        if self.count == 0 { &self.last } else { &self.predicted }
    }

    /// Return whether the newest sample is held.
    #[inline]
    pub fn holds(&self) -> bool {
        self.count > 0
    }

    /// Return the number of outliers.
    pub fn outliers(&self) -> u64 {
        self.outliers
    }

    /// Return the path of the positions, for lanes.
    pub fn track(&self) -> &Track<N> {
        &self.track
    }

    /// Forget the path. The next sample starts a path; until then [`taken`](Self::taken) returns `sample`.
    pub fn begin_anew(&mut self, sample: &Sample<N>) {
        let ([bounds, rotation], outliers) = (self.bounds, self.outliers);
        *self = Self { outliers, last: *sample, ..Self::new(bounds, rotation, self.period_s) };
    }

    /// Judge a finite sample, `ticks` after the one before; return the excess if the device cannot move so fast.
    ///
    /// [`taken`](Self::taken) then returns the sample or its prediction.
    pub fn pass(&mut self, sample: &Sample<N>, ticks: f64) -> Result<(), Excess> {
        if self.count == 0 && self.contains(sample, ticks, 1.0) {
            self.accept(sample, ticks);
            return Ok(());
        }
        match self.judge_general(sample, ticks) {
            Judged::Stepped(excess) => Err(excess),
            _ => Ok(()),
        }
    }

    /// Judge as [`pass`](Self::pass), for a caller that catches up with [`between`](Self::between).
    #[inline(always)]
    pub(crate) fn judge(&mut self, sample: &Sample<N>, ticks: f64) -> Judged<N> {
        if self.count == 0 && ticks == 1.0 && self.contains(sample, 1.0, 1.0) {
            self.accept(sample, 1.0);
            return Judged::Passed;
        }
        self.judge_general(sample, ticks)
    }

    #[inline(never)]
    fn judge_general(&mut self, sample: &Sample<N>, gap: f64) -> Judged<N> {
        let at = gap + if self.count == 0 { 0.0 } else { self.held[self.count - 1].at };
        // A held sample that repeats the last one is late, not wrong.
        let last = self.last;
        let wrong = self.held[..self.count].iter().filter(|knot| last != knot.sample).count();
        // After a wrong sample the next may be wrong too, so the limit is tighter. It follows a device that
        // accelerates by dV / 10 per tick, 50 m/s^2 at 1 kHz; this leaves the path by dV dT k (k + 1) / 20 in k
        // ticks.
        let share = if wrong == 0 { 1.0 } else { (0.05 * at * (at + 1.0)).min(1.0) };
        if self.contains(sample, at, share) {
            self.outliers += wrong as u64;
            self.settle(&[], Knot { at, sample: *sample }, None);
            self.accept(sample, at);
            return Judged::Settled;
        }
        if self.count == 0 && self.returns(sample, gap) {
            // The last sample was off the path, by less than the limit.
            let (track, turn, ticks) = self.before;
            (self.track, self.turn) = (track, turn);
            self.settle(&[], Knot { at, sample: *sample }, None);
            self.accept(sample, ticks + gap);
            return Judged::Settled;
        }
        if self.count < MAX_OUTLIERS {
            return self.hold(Knot { at, sample: *sample });
        }
        self.decide(Knot { at, sample: *sample })
    }

    /// Return whether a sample is on the path without its last sample.
    fn returns(&self, sample: &Sample<N>, gap: f64) -> bool {
        let (track, turn, ticks) = &self.before;
        let repeats = self.last == *sample && self.track.since + gap < self.track.every;
        // A path of one sample has no direction, and a repeat equals the last sample.
        track.rate.is_some() && !repeats && self.is_on(track, turn, sample, ticks + gap, 1.0)
    }

    fn hold(&mut self, knot: Knot<N>) -> Judged<N> {
        self.held[self.count] = knot;
        self.count += 1;
        self.predicted = self.path_at(knot.at);
        Judged::Held(knot.at)
    }

    /// Predict the sample on the path; velocities stay those of the last sample.
    fn path_at(&self, ticks: f64) -> Sample<N> {
        let last = self.last;
        Sample {
            position: self.track.at(ticks).unwrap_or(last.position),
            rotation: last.rotation.map(|turned| Turned {
                orientation: self.turn.at(ticks).unwrap_or(turned.orientation),
                ..turned
            }),
            ..last
        }
    }

    #[inline(always)]
    fn contains(&self, sample: &Sample<N>, ticks: f64, share: f64) -> bool {
        self.is_on(&self.track, &self.turn, sample, ticks, share)
    }

    #[inline(always)]
    fn is_on(&self, track: &Track<N>, turn: &TurnTrack, sample: &Sample<N>, ticks: f64, share: f64) -> bool {
        if !track.contains(&sample.position, ticks, share) {
            return false;
        }
        if track.anchor.is_none() {
            return true;
        }
        let last = &self.last;
        let follows = |[from, to]: [&Option<Axes<N>>; 2]| match (from, to) {
            (Some(from), Some(to)) => self.track.bounds.is_steady(from, to, share),
            _ => true,
        };
        follows([&last.velocity, &sample.velocity])
            && match (&last.rotation, &sample.rotation) {
                (Some(from), Some(to)) => contains_turn(turn, from, to, ticks, share),
                _ => true,
            }
    }

    #[inline(always)]
    fn accept(&mut self, sample: &Sample<N>, ticks: f64) {
        (self.before.0, self.before.2) = (self.track, ticks);
        self.track.accept(&sample.position, ticks);
        if let Some(turned) = &sample.rotation {
            self.before.1 = self.turn;
            self.turn.accept(&turned.orientation, ticks);
        }
        (self.last, self.count) = (*sample, 0);
        self.since_shift = self.since_shift.saturating_add(1);
    }

    /// Decide when more samples are off the path than may be outliers.
    fn decide(&mut self, newest: Knot<N>) -> Judged<N> {
        let mut chain = [newest; MAX_HELD + 2];
        chain[0] = Knot { at: 0.0, sample: self.last };
        chain[1..=self.count].copy_from_slice(&self.held[..self.count]);
        let length = self.count + 2;
        let excess = |from: usize, to: usize| self.excess(&chain[from], &chain[to]);
        let Some(first) = (1..length).find(|to| excess(to - 1, *to).is_some()) else {
            let in_line = |of: [usize; 3]| {
                self.are_in_line(&chain[length - of[0]], &chain[length - of[1]], &chain[length - of[2]])
            };
            // The newest sample, or the one before, may be wrong by less than the speed bound.
            if self.count < MAX_HELD && !in_line([3, 2, 1]) {
                return self.hold(newest);
            }
            if self.count == MAX_HELD && !in_line([4, 3, 2]) && in_line([4, 3, 1]) {
                return self.change_without(length - 2, &chain[..length]);
            }
            return self.change(&chain[1..length]);
        };
        let fits_without = |wrong: usize| {
            let links = (1..length).filter(|to| *to != wrong);
            let fits = |to: usize| excess(if to == wrong + 1 { wrong - 1 } else { to - 1 }, to).is_none();
            // The two samples after it, or before it, define a line that does not contain it.
            let (from, to) = if wrong + 2 < length { (wrong + 1, wrong + 2) } else { (wrong - 2, wrong - 1) };
            links.clone().all(fits) && !self.are_in_line(&chain[from], &chain[to], &chain[wrong])
        };
        if let Some(wrong) = (1..length - 1).find(|wrong| fits_without(*wrong)) {
            return self.change_without(wrong, &chain[..length]);
        }
        // The newest sample may itself be wrong.
        if first == length - 1 && self.count < MAX_HELD {
            return self.hold(newest);
        }
        match excess(first - 1, first) {
            Some(excess) => Judged::Stepped(excess),
            None => self.change(&chain[1..length]),
        }
    }

    /// Return whether a sample is on the line through two others.
    fn are_in_line(&self, from: &Knot<N>, to: &Knot<N>, other: &Knot<N>) -> bool {
        let expected = from.sample.towards(&to.sample, (other.at - from.at) / (to.at - from.at));
        self.are_near(&expected, &other.sample, 1.0)
    }

    /// Return whether two samples of one tick are as close as those of one path.
    fn are_near(&self, one: &Sample<N>, other: &Sample<N>, ticks: f64) -> bool {
        // The rounding of the velocity adds up over the ticks.
        let limit = |of: PerTick| of.change + of.quantum * (ticks + 1.0);
        let (point, turn) = (self.track.bounds, self.turn.bounds);
        is_short(&(other.position - one.position), limit(point), point.per_axis)
            && one.rotation.zip(other.rotation).is_none_or(|(one, other)| {
                is_small(&one.orientation.rotation_to(&other.orientation), limit(turn))
            })
            && one.velocity.zip(other.velocity).is_none_or(|(one, other)| point.is_steady(&one, &other, 1.0))
    }

    /// Accept the samples after a change, without the outlier at index `wrong`.
    fn change_without(&mut self, wrong: usize, chain: &[Knot<N>]) -> Judged<N> {
        self.outliers += 1;
        let mut kept = [chain[0]; MAX_HELD + 2];
        kept[..wrong].copy_from_slice(&chain[..wrong]);
        kept[wrong..chain.len() - 1].copy_from_slice(&chain[wrong + 1..]);
        self.change(&kept[1..chain.len() - 1])
    }

    /// Accept the samples after a change of the path; `knots` follow the last sample of the path.
    fn change(&mut self, knots: &[Knot<N>]) -> Judged<N> {
        let [held @ .., newest] = knots else { return Judged::Settled };
        let shift = self.step_of(knots);
        self.settle(held, *newest, shift);
        let (track, turn, last) = (self.track, self.turn, self.last);
        if let Some(shift) = shift {
            self.track.anchor = Some(newest.sample.position);
            self.track.since = 0.0;
            self.turn.anchor = newest.sample.rotation.map(|turned| turned.orientation);
            self.turn.since = 0.0;
            (self.last, self.count) = (newest.sample, 0);
            // The path without its last sample is that before the step.
            self.before.0.rate = None;
            (self.shift, self.since_shift) = (shift, 0);
        } else {
            self.track = Track { every: track.every, ..Track::new(self.bounds[0], self.period_s) };
            self.turn = TurnTrack { every: turn.every, ..TurnTrack::new(self.bounds[1], self.period_s) };
            // Two samples define a path; the third defines the path without its last sample.
            let path = &knots[knots.len().saturating_sub(3)..];
            let mut at = path[0].at - 1.0;
            for knot in path {
                self.accept(&knot.sample, knot.at - at);
                at = knot.at;
            }
        }
        let places = knots.iter().map(|knot| (knot.at, knot.sample.position));
        let (interval, since, [from, to]) = last_change(last.position, track.same_for, places);
        self.track.same_for = newest.at - since;
        if shift.is_none() && is_of_slow_device(interval) {
            let moved = to - from;
            let track = &mut self.track;
            if !is_short(&moved, 2.0 * track.bounds.quantum, track.bounds.per_axis) {
                (track.anchor, track.rate, track.every) = (Some(to), Some(moved / interval), interval);
                track.since = newest.at - since;
            }
        }
        if let Some(Turned { orientation, .. }) = last.rotation {
            let places = knots.iter().filter_map(|knot| Some((knot.at, knot.sample.rotation?.orientation)));
            let (interval, since, [from, to]) = last_change(orientation, turn.same_for, places);
            self.turn.same_for = newest.at - since;
            let moved = to * from.inverse();
            let turn = &mut self.turn;
            if shift.is_none() && is_of_slow_device(interval) && !is_small(&moved, 2.0 * turn.bounds.quantum)
            {
                (turn.anchor, turn.rate, turn.every) = (Some(to), Some(moved.powf(1.0 / interval)), interval);
                turn.since = newest.at - since;
            }
        }
        Judged::Settled
    }

    /// Return the offset of the samples from the path if it is the same for all; its rotation is in the base frame.
    fn step_of(&self, knots: &[Knot<N>]) -> Option<Sample<N>> {
        let newest = knots.last()?;
        let expected = self.path_at(newest.at);
        let position = newest.sample.position - expected.position;
        let rotation = newest.sample.rotation.zip(expected.rotation).map(|(now, expected)| Turned {
            orientation: now.orientation * expected.orientation.inverse(),
            angular_velocity: None,
        });
        let shift = Sample { position, velocity: None, rotation };
        let is_same =
            |knot: &Knot<N>| self.are_near(&self.path_at(knot.at).shifted(&shift), &knot.sample, newest.at);
        knots.iter().all(is_same).then_some(shift).filter(|shift| self.may_step(shift))
    }

    /// Return whether a shift is a step: the first for a while, or the way back of the last one. A slow device that
    /// moves shifts again and again; its motion must be read.
    fn may_step(&self, shift: &Sample<N>) -> bool {
        let limit = |of: PerTick| of.change + 2.0 * of.quantum;
        let (point, turn) = (self.track.bounds, self.turn.bounds);
        let is_back = is_short(&(shift.position + self.shift.position), limit(point), point.per_axis)
            && shift
                .rotation
                .zip(self.shift.rotation)
                .is_none_or(|(now, before)| is_small(&(now.orientation * before.orientation), limit(turn)));
        is_back || self.since_shift >= MIN_BETWEEN_STEPS
    }

    fn settle(&mut self, held: &[Knot<N>], newest: Knot<N>, shift: Option<Sample<N>>) {
        if self.track.anchor.is_none() {
            return;
        }
        let last = shift.map_or(self.last, |shift| self.last.shifted(&shift));
        let mut knots = [newest; MAX_HELD + 2];
        knots[0] = Knot { at: 0.0, sample: last };
        // After a step the held samples are on the shifted path.
        let held = if shift.is_some() { &[] } else { held };
        knots[1..=held.len()].copy_from_slice(held);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a number of ticks
        let ticks = newest.at as u64;
        self.between = Some(Between { knots, count: held.len() + 2, ticks, shift });
    }

    /// Return the ticks between the last two accepted samples, once.
    pub(crate) fn between(&mut self) -> Option<Between<N>> {
        self.between.take()
    }

    /// Return a speed beyond the bound, between two samples or as the device measures it.
    fn excess(&self, from: &Knot<N>, to: &Knot<N>) -> Option<Excess> {
        let [bounds, of_turn] = &self.bounds;
        // A device that samples every r ticks shows the motion of r ticks in one.
        let elapsed_s = |every: f64| (to.at - from.at + every - 1.0) * self.period_s;
        let moved = to.sample.position - from.sample.position;
        let size = |vector: &Axes<N>| if bounds.per_axis { vector.amax() } else { vector.norm() };
        let turned = from.sample.rotation.zip(to.sample.rotation);
        let rate = turned.and_then(|(_, to)| to.angular_velocity);
        [
            (Signal::Position, Some(size(&moved)), bounds, elapsed_s(self.track.every)),
            (Signal::Velocity, to.sample.velocity.map(|velocity| size(&velocity)), bounds, 1.0),
            (
                Signal::Orientation,
                turned.map(|(from, to)| from.orientation.angle_to(&to.orientation)),
                of_turn,
                elapsed_s(self.turn.every),
            ),
            (Signal::AngularVelocity, rate.map(|w| w.norm()), of_turn, 1.0),
        ]
        .into_iter()
        .find_map(|(signal, size, bounds, elapsed_s)| {
            let room = if signal.is_velocity() { 0.0 } else { 2.0 * bounds.quantum };
            let is_beyond = size? > bounds.speed * elapsed_s + room;
            let is_angular = bounds.per_axis || signal.of_rotation() == signal;
            let seen = size? / elapsed_s;
            is_beyond.then_some(Excess { signal, seen, bound: bounds.speed, is_angular })
        })
    }
}

#[inline(never)]
fn contains_turn(turn: &TurnTrack, from: &Turned, to: &Turned, ticks: f64, share: f64) -> bool {
    let is_steady = match (&from.angular_velocity, &to.angular_velocity) {
        (Some(from), Some(to)) => turn.bounds.is_steady(from, to, share),
        _ => true,
    };
    is_steady && turn.contains(&to.orientation, ticks, share)
}
