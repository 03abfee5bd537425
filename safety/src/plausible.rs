//! Plausibility check of samples: a wrong sample moves neither force nor arm, and an impossible motion is a fault.

mod bounds;
mod sample;
#[cfg(test)]
mod tests;
mod track;
mod turn;

pub use bounds::{Excess, SampleBounds};
pub(crate) use sample::Parts;
pub use sample::{Sample, Turned};
pub use track::Track;

use nalgebra::UnitQuaternion;

use self::{
    bounds::{PerTick, is_short},
    track::{Change, Path},
    turn::{TurnTrack, is_small},
};
use crate::{Axes, Signal};

/// Fewest accepted samples between two steps of a device in the same direction.
const MIN_BETWEEN_STEPS: u32 = 100;

/// Largest number of successive samples off the path that count as outliers.
const MAX_OUTLIERS: usize = 3;
/// Largest number of held samples: one more, since the fourth sample may itself be wrong.
pub(crate) const MAX_HELD: usize = MAX_OUTLIERS + 1;

/// Sets of up to [`MAX_OUTLIERS`] wrong samples as bits by index, the smallest sets first. The sample of the path has
/// index 0.
const WRONG: [u8; 14] = [
    0b00010, 0b00100, 0b01000, 0b10000, // one
    0b00110, 0b01010, 0b10010, 0b01100, 0b10100, 0b11000, // two
    0b01110, 0b10110, 0b11010, 0b11100, // three
];

/// Largest change of velocity per sample, as a fraction of dV, for a path to count as smooth once its wrong samples
/// are left out.
///
/// Two equal wrong samples thus cannot pass as motion: they deviate by at least dV, and the limit is 0.9 dV. With the
/// first left out, the second may deviate by `0.3 dV (2 + 1) / 2` per tick over 2 ticks
/// ([`Guard::is_smooth_without`]).
const SMOOTH: f64 = 0.3;

/// Return the fraction of dV by which a sample `ticks` after the path may deviate while a wrong sample is held; the
/// next may be wrong too.
///
/// The fraction covers a device that accelerates by dV / 10 per tick, 50 m/s^2 at 1 kHz. Such a
/// device leaves the path by `dV dT k (k + 1) / 20` in k ticks.
fn share_after(ticks: f64) -> f64 {
    (0.05 * ticks * (ticks + 1.0)).min(1.0)
}

/// Return the sets of wrong samples among `length` samples.
fn sets(length: usize) -> impl Iterator<Item = u8> {
    WRONG.into_iter().filter(move |wrong| usize::from(*wrong) < 1 << (length - 1))
}

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
    /// Held: off the path, perhaps an outlier. [`Guard::sample_in_use`] is the prediction for this
    /// time in ticks.
    Held(f64),
    /// Accepted; the ticks since the last accepted sample must be caught up ([`Guard::between`]).
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
///   path again, the held samples count as outliers. They are then interpolated between the samples around them. For
///   an accelerating device the path may also continue with its last acceleration, or be smooth without the held
///   samples.
/// - **Change of velocity that stays**, for example at a mechanical stop. After 3 ticks off the path the samples are
///   accepted if the speed between them is within the bound of the device. One sample that fits neither neighbour is
///   left out.
/// - **Step.** A displacement faster than the bound is a fault if the samples do not return. A step within the bound,
///   after which the device moves on as before, moves the origin and adds no velocity.
///
/// Source: derived here.
#[derive(Clone, Debug)]
pub struct Guard<const N: usize> {
    bounds: [SampleBounds; 2],
    period_s: f64,
    track: Track<N>,
    turn: TurnTrack,
    /// Path before the last sample was accepted, and the ticks from its end to that sample.
    before: (Path<N>, TurnTrack, f64),
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
            before: (track.path, turn, 1.0),
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
    pub fn sample_in_use(&self) -> &Sample<N> {
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

    /// Return the path of the positions, from which lanes are gathered.
    pub fn track(&self) -> &Track<N> {
        &self.track
    }

    /// Forget the path. The next sample starts a path; until then
    /// [`sample_in_use`](Self::sample_in_use) returns `sample`.
    pub fn restart_at(&mut self, sample: &Sample<N>) {
        let ([bounds, rotation], outliers) = (self.bounds, self.outliers);
        *self = Self { outliers, last: *sample, ..Self::new(bounds, rotation, self.period_s) };
    }

    /// Judge a finite sample, `ticks` after the one before; return the excess if the device cannot move so fast.
    ///
    /// [`sample_in_use`](Self::sample_in_use) then returns the sample or its prediction.
    pub fn pass(&mut self, sample: &Sample<N>, ticks: f64) -> Result<(), Excess> {
        if self.count == 0 && self.contains(sample.parts(), ticks, 1.0) {
            self.accept(sample.parts(), ticks, 1.0);
            return Ok(());
        }
        match self.judge_general(sample, ticks) {
            Judged::Stepped(excess) => Err(excess),
            _ => Ok(()),
        }
    }

    /// Judge as [`pass`](Self::pass), for a caller that catches up with [`between`](Self::between).
    #[inline(always)]
    pub(crate) fn judge(&mut self, parts: Parts<'_, N>, ticks: f64) -> Judged<N> {
        if self.count == 0 && ticks == 1.0 && self.contains(parts, 1.0, 1.0) {
            self.accept(parts, 1.0, 1.0);
            return Judged::Passed;
        }
        self.judge_general(&parts.sample(), ticks)
    }

    #[inline(never)]
    fn judge_general(&mut self, sample: &Sample<N>, gap: f64) -> Judged<N> {
        let at = gap + if self.count == 0 { 0.0 } else { self.held[self.count - 1].at };
        // A held sample that repeats the last one is late, not wrong.
        let last = self.last;
        let wrong = self.held[..self.count].iter().filter(|knot| last != knot.sample).count();
        let share = if wrong == 0 { 1.0 } else { share_after(at) };
        if self.contains(sample.parts(), at, share) || (wrong > 0 && self.bends_to(sample, at, share)) {
            self.outliers += wrong as u64;
            self.settle(&[], Knot { at, sample: *sample }, None);
            self.accept(sample.parts(), at, 1.0 + (self.count - wrong) as f64);
            return Judged::Settled;
        }
        if self.count == 0 && self.returns(sample, gap) {
            // The last accepted sample was wrong by less than the limit; drop it.
            let (path, turn, ticks) = self.before;
            (self.track.path, self.turn) = (path, turn);
            self.settle(&[], Knot { at, sample: *sample }, None);
            self.accept(sample.parts(), ticks + gap, 1.0);
            return Judged::Settled;
        }
        let newest = Knot { at, sample: *sample };
        let (chain, length) = self.chain(newest);
        let chain = &chain[..length];
        if let Some(wrong) = sets(length).find(|wrong| self.is_smooth_without(*wrong, chain)) {
            return self.change_without(wrong, chain, |_, _| None);
        }
        if self.count < MAX_OUTLIERS { self.hold(newest) } else { self.decide(chain) }
    }

    /// Return the last sample of the path, the held samples and the newest one, and their number.
    fn chain(&self, newest: Knot<N>) -> ([Knot<N>; MAX_HELD + 2], usize) {
        let mut chain = [newest; MAX_HELD + 2];
        chain[0] = Knot { at: 0.0, sample: self.last };
        chain[1..=self.count].copy_from_slice(&self.held[..self.count]);
        (chain, self.count + 2)
    }

    /// Return whether a sample is on the path of a device that keeps accelerating, and no held sample is on the line
    /// from the last sample to it.
    ///
    /// The path then bends by the change of the last two velocities: `x(k) = x_a + v k + (v - v') k (k + 1) / 2`.
    fn bends_to(&self, sample: &Sample<N>, ticks: f64, share: f64) -> bool {
        let (path, turn, gap) = &self.before;
        // A late tick or a repeat does not show the acceleration.
        if *gap != 1.0 || self.track.path.every.max(self.turn.every) > 1.0 {
            return false;
        }
        let Some(bend) = self.track.path.rate.zip(path.rate).map(|(now, before)| now - before) else {
            return false;
        };
        let rotation = self.last.rotation.zip(self.turn.rate().zip(turn.rate()));
        let turning = rotation.map(|(_, (now, before))| now - before);
        // Rounding changes the bend by up to two quanta; a smaller bend counts as zero.
        let rounding = |of: &PerTick| 0.5 * of.quantum * ticks * (ticks + 1.0);
        let limit =
            |of: &PerTick| (of.change * share + rounding(of)).min(of.change) + of.quantum * (ticks + 1.0);
        let faster = |of: &PerTick| (share + 2.0 * ticks * of.quantum / of.change).min(1.0);
        let (point, turn) = (&self.track.bounds, &self.turn.bounds);
        let is_straight = is_short(&bend, 2.0 * point.quantum, point.per_axis)
            && turning.is_none_or(|bend| bend.norm() <= 2.0 * turn.quantum);
        let straight = self.path_at(ticks);
        let (after, speed) = (0.5 * ticks * (ticks + 1.0), ticks / self.period_s);
        let [last, newest] = [(0.0, self.last), (ticks, *sample)].map(|(at, sample)| Knot { at, sample });
        !is_straight
            && self.excess(&last, &newest).is_none()
            && is_short(&(sample.position - straight.position - bend * after), limit(point), point.per_axis)
            && self
                .last
                .velocity
                .zip(sample.velocity)
                .is_none_or(|(from, to)| point.is_steady(&(from + bend * speed), &to, faster(point)))
            && straight.rotation.zip(sample.rotation).zip(turning).is_none_or(|((from, to), bend)| {
                let expected = UnitQuaternion::from_scaled_axis(bend * after) * from.orientation;
                is_small(&expected.rotation_to(&to.orientation), limit(turn))
                    && from
                        .angular_velocity
                        .zip(to.angular_velocity)
                        .is_none_or(|(from, to)| turn.is_steady(&(from + bend * speed), &to, faster(turn)))
            })
            && self.held[..self.count]
                .iter()
                .all(|held| held.sample == self.last || !self.are_in_line(&last, &newest, held))
    }

    /// Return whether a sample is on the path as it was before its last sample.
    fn returns(&self, sample: &Sample<N>, gap: f64) -> bool {
        let (path, turn, ticks) = &self.before;
        let repeats = self.last == *sample && self.track.path.since + gap < self.track.path.every;
        // A path of one sample has no direction, and a repeat equals the last sample.
        path.rate.is_some()
            && !repeats
            && self.is_on(path, turn, sample.parts(), ticks + gap, share_after(ticks + gap))
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
    fn contains(&self, parts: Parts<'_, N>, ticks: f64, share: f64) -> bool {
        self.is_on(&self.track.path, &self.turn, parts, ticks, share)
    }

    #[inline(always)]
    fn is_on(&self, path: &Path<N>, turn: &TurnTrack, parts: Parts<'_, N>, ticks: f64, share: f64) -> bool {
        let Parts { position, velocity, rotation } = parts;
        let bounds = &self.track.bounds;
        if !path.contains(bounds, position, ticks, share) {
            return false;
        }
        if path.anchor.is_none() {
            return true;
        }
        let last = &self.last;
        let is_steady = match (&last.velocity, velocity) {
            (Some(from), Some(to)) => bounds.is_steady(from, to, share),
            _ => true,
        };
        is_steady
            && match (&last.rotation, rotation) {
                (Some(from), Some(to)) => turn.contains_turned(from, to, ticks, share),
                _ => true,
            }
    }

    #[inline(always)]
    fn accept(&mut self, parts: Parts<'_, N>, ticks: f64, samples: f64) {
        let Parts { position, velocity, rotation } = parts;
        (self.before.0, self.before.2) = (self.track.path, ticks);
        self.track.accept(position, ticks, samples);
        if let Some(turned) = rotation {
            self.before.1 = self.turn;
            self.turn.accept(&turned.orientation, ticks, samples);
            self.last.rotation = Some(*turned);
        }
        (self.last.position, self.last.velocity, self.count) = (*position, velocity.copied(), 0);
        self.since_shift = self.since_shift.saturating_add(1);
    }

    /// Decide, once more samples are off the path than can be outliers.
    fn decide(&mut self, chain: &[Knot<N>]) -> Judged<N> {
        let length = chain.len();
        let newest = chain[length - 1];
        let excess = |from: usize, to: usize| self.excess(&chain[from], &chain[to]);
        let Some(first) = (1..length).find(|to| excess(to - 1, *to).is_some()) else {
            let in_line = |of: [usize; 3]| {
                self.are_in_line(&chain[length - of[0]], &chain[length - of[1]], &chain[length - of[2]])
            };
            // The newest sample, or the one before, may be wrong although all speeds are within the bound.
            if self.count < MAX_HELD && !in_line([3, 2, 1]) {
                return self.hold(newest);
            }
            if self.count == MAX_HELD && !in_line([4, 3, 2]) && in_line([4, 3, 1]) {
                return self.change_without(1 << (length - 2), chain, Self::step_of);
            }
            return self.change(&chain[1..], Self::step_of);
        };
        let mut waits = first == length - 1;
        for wrong in sets(length) {
            match self.are_wrong(wrong, chain) {
                Some(true) => return self.change_without(wrong, chain, Self::step_of),
                Some(false) => {}
                None => waits = true,
            }
        }
        // The newest sample may itself be wrong.
        if waits && self.count < MAX_HELD {
            return self.hold(newest);
        }
        match excess(first - 1, first) {
            Some(excess) => Judged::Stepped(excess),
            None => self.change(&chain[1..], Self::step_of),
        }
    }

    /// Return whether the path continues smoothly without the samples in `wrong` (bits by index), each of which is
    /// off the line between its neighbours.
    ///
    /// The velocity then changes by at most 0.3 dV per sample; leaving samples out never makes a stop, blow or step
    /// that smooth.
    fn is_smooth_without(&self, wrong: u8, chain: &[Knot<N>]) -> bool {
        let (point, turn) = (&self.track.bounds, &self.turn.bounds);
        // A slow device repeats its samples and has no such path.
        let is_slow = self.track.path.every.max(self.turn.every) > 1.0;
        if is_slow && chain.windows(2).any(|pair| pair[0].sample == pair[1].sample) {
            return false;
        }
        let Some(mut rate) = self.track.path.rate else { return false };
        let mut turning = self.turn.rate();
        let (mut from, mut span, mut kept) = (0, 1.0, 0);
        for to in (1..chain.len()).filter(|n| wrong >> n & 1 == 0) {
            let (one, other) = (&chain[from], &chain[to]);
            // A late tick does not widen the limit.
            let (ticks, samples) = (other.at - one.at, (to - from) as f64);
            let limit = |of: &PerTick| {
                0.5 * (SMOOTH * of.change * (samples + span) + of.quantum * (1.0 / samples + 1.0 / span))
            };
            if self.excess(one, other).is_some() {
                return false;
            }
            let now = (other.sample.position - one.sample.position) / ticks;
            let is_steady = one
                .sample
                .velocity
                .zip(other.sample.velocity)
                .is_none_or(|(from, to)| point.is_steady(&from, &to, SMOOTH * samples));
            if !is_steady || !is_short(&(now - rate), limit(point), point.per_axis) {
                return false;
            }
            if let (Some(before), Some((from, to))) =
                (turning, one.sample.rotation.zip(other.sample.rotation))
            {
                let now = (to.orientation * from.orientation.inverse()).scaled_axis() / ticks;
                let is_steady = from
                    .angular_velocity
                    .zip(to.angular_velocity)
                    .is_none_or(|(from, to)| turn.is_steady(&from, &to, SMOOTH * samples));
                if !is_steady || (now - before).norm() > limit(turn) {
                    return false;
                }
                turning = Some(now);
            }
            if (from + 1..to).any(|n| self.are_in_line(one, other, &chain[n])) {
                return false;
            }
            (from, span, kept, rate) = (to, samples, kept + 1, now);
        }
        kept >= 2 && from + 1 == chain.len()
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
                    && one
                        .angular_velocity
                        .zip(other.angular_velocity)
                        .is_none_or(|(one, other)| turn.is_steady(&one, &other, 1.0))
            })
            && one.velocity.zip(other.velocity).is_none_or(|(one, other)| point.is_steady(&one, &other, 1.0))
    }

    /// Return whether the samples in `wrong` (bits by index) are wrong; None if the next sample
    /// will tell.
    ///
    /// True if the other samples are within the speed bound, and no sample of `wrong` is on their
    /// line.
    fn are_wrong(&self, wrong: u8, chain: &[Knot<N>]) -> Option<bool> {
        let length = chain.len();
        let mut kept = (0..length).filter(|n| wrong >> n & 1 == 0);
        let mut from = kept.next()?;
        for to in kept {
            if self.excess(&chain[from], &chain[to]).is_some() {
                return Some(false);
            }
            from = to;
        }
        let (newest, last_wrong) = (length - 1, wrong.ilog2() as usize);
        let (from, to) = if last_wrong + 2 < length {
            (last_wrong + 1, last_wrong + 2)
        } else if wrong.is_power_of_two() {
            (last_wrong - 2, last_wrong - 1)
        } else if self.are_in_line(&chain[newest - 2], &chain[newest - 1], &chain[newest]) {
            return Some(false);
        } else if self.count < MAX_HELD {
            return None;
        } else {
            (0, newest)
        };
        let mut wrong = (1..newest).filter(|n| wrong >> n & 1 == 1);
        Some(wrong.all(|n| !self.are_in_line(&chain[from], &chain[to], &chain[n])))
    }

    /// Accept the samples after a change, without a set of wrong ones.
    fn change_without(
        &mut self,
        wrong: u8,
        chain: &[Knot<N>],
        step_of: impl FnOnce(&Self, &[Knot<N>]) -> Option<Sample<N>>,
    ) -> Judged<N> {
        self.outliers += u64::from(wrong.count_ones());
        let (mut kept, mut length) = ([chain[0]; MAX_HELD + 2], 0);
        for (_, knot) in chain.iter().enumerate().filter(|(n, _)| wrong >> n & 1 == 0) {
            kept[length] = *knot;
            length += 1;
        }
        self.change(&kept[1..length], step_of)
    }

    /// Accept the samples after a change of the path; `knots` follow the last sample of the path.
    fn change(
        &mut self,
        knots: &[Knot<N>],
        step_of: impl FnOnce(&Self, &[Knot<N>]) -> Option<Sample<N>>,
    ) -> Judged<N> {
        let [held @ .., newest] = knots else { return Judged::Settled };
        let shift = step_of(self, knots);
        self.settle(held, *newest, shift);
        let (same_for, last) = ([self.track.path.same_for, self.turn.same_for], self.last);
        if let Some(shift) = shift {
            self.track.step_to(&newest.sample.position);
            self.turn.step_to(newest.sample.rotation.map(|turned| turned.orientation));
            (self.last, self.count) = (newest.sample, 0);
            // The path before the step is no longer valid, so `returns` must not use it.
            self.before.0.rate = None;
            (self.shift, self.since_shift) = (shift, 0);
        } else {
            self.track.restart();
            self.turn.restart();
            // Accept the last three: two define the path; with the third, `before` is a path too.
            let path = &knots[knots.len().saturating_sub(3)..];
            let mut at = path[0].at - 1.0;
            for knot in path {
                self.accept(knot.sample.parts(), knot.at - at, 1.0);
                at = knot.at;
            }
        }
        let positions = knots.iter().map(|knot| (knot.at, knot.sample.position));
        let change = Change::find(last.position, same_for[0], positions);
        self.track.resume(&change, newest.at, shift.is_some());
        if let Some(Turned { orientation, .. }) = last.rotation {
            let turns = knots.iter().filter_map(|knot| Some((knot.at, knot.sample.rotation?.orientation)));
            let change = Change::find(orientation, same_for[1], turns);
            self.turn.resume(&change, newest.at, shift.is_some());
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

    /// Return whether a shift is a step: no step in the last 100 samples, or the reverse of the last one. Repeated
    /// shifts of a slow device are motion and are not removed.
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
        if self.track.path.anchor.is_none() {
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
            (Signal::Position, Some(size(&moved)), bounds, elapsed_s(self.track.path.every)),
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
