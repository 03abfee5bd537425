//! First-order adaptive windowing: long windows during slow motion, short ones at a reversal.

use nalgebra::SimdValue;

use super::{Estimator, MAX_WINDOW, Motion};
use crate::parameter::{ParameterError, in_range, positive};
use crate::{About, Axes, Real};
use haptether_numeric::{padded, shared};

/// V is the slope of the longest straight line that stays within the noise bound d of every sample that it spans.
///
/// The window i = 1, 2, ... grows up to its greatest length, or until a sample j = 1 ... i violates |x\[n\] -
/// x\[n-j\] - j dT `b_i`| <= d for the slope `b_i` of the window. All samples up to j together allow one interval of
/// slopes, the intersection of \[(x\[n\] - x\[n-j\] ± d) / (j dT)\]. Each i therefore costs one comparison, and a
/// tick costs O(window) instead of its square. With an encoder, a sample lies at exactly d from the line in a third of
/// all ticks. It counts as within the bound, and rounding does not change that at any device position.
///
/// A is the slope of V, found in the same way. The uncertainty of a value of V follows from its window: two
/// positions, each wrong by d, give 2 d / (i dT). The larger bound of the two compared samples counts. Each axis has
/// its own windows, so no axis disturbs another.
///
/// **Alignment.** To give the device force the lag of A, the force moves a simulated unit mass. The A of that mass is
/// computed with the windows that the device's motion has at each tick. A line added to the path of the mass adds a
/// constant to V and nothing to A. After each tick, the line along which the mass would coast is therefore subtracted
/// from the stored path. Let f be the force of the newest tick and dT = 1. The values at lag l become
/// path\[l\] = path\[l-1\] + f (l - 1/2) and V\[l\] = V\[l-1\] - f. The result depends only on the forces in the
/// stored window, and no integral runs, so nothing can drift.
///
/// Source: Janabi-Sharifi, Hayward & Chen 2000, "Discrete-time adaptive windowing for velocity estimation", IEEE
/// Trans. Control Systems Technology 8(6) (end-fit and best-fit FOAW); A and alignment derived above.
#[derive(Clone, Debug)]
pub struct AdaptiveWindow<const N: usize> {
    period_s: f64,
    rule: Rule,
    axes: [Axis; N],
    started: bool,
}

impl<const N: usize> AdaptiveWindow<N> {
    /// Name, title and source.
    pub const ABOUT: About = About {
        name: "adaptive-window",
        title: "longest straight line through the last samples",
        source: "Janabi-Sharifi, Hayward and Chen 2000",
    };

    /// Create an estimator for positions sampled every `period_s`, with windows of up to `max_window` ticks and
    /// d = `noise_bound_m`.
    ///
    /// `max_window` is at most [`MAX_WINDOW`]. For an encoder of quantum q, d = q gives every motion at constant
    /// velocity the full window. Each position is wrong by at most q/2, so a position between two others is at most q
    /// off the line through them. The d = q/2 of Janabi-Sharifi et al. follows a reversal faster.
    pub fn new(
        period_s: f64,
        noise_bound_m: f64,
        max_window: usize,
        fit: Fit,
    ) -> Result<Self, ParameterError> {
        positive("period_s", "dT", period_s)?;
        positive("noise_bound_m", "d", noise_bound_m)?;
        let longest = MAX_WINDOW as f64;
        in_range("max_window", "n", max_window as f64, 1.0, longest, "1 to 128")?;
        Ok(Self {
            period_s,
            rule: Rule { fit, bound: noise_bound_m, max_window },
            axes: [Axis::at_rest(0.0, noise_bound_m, max_window); N],
            started: false,
        })
    }
}

impl<const N: usize> Estimator<N> for AdaptiveWindow<N> {
    type One = Self;

    fn gather(of: &[&Self]) -> Option<Self> {
        if let [one] = of { Some((*one).clone()) } else { None }
    }

    fn step(&mut self, position: &Axes<N>) -> Motion<N> {
        if !self.started {
            self.reset(position);
        }
        for (axis, x) in self.axes.iter_mut().zip(position) {
            axis.step(*x, &self.rule);
        }
        Motion {
            velocity: Axes::from_fn(|i, _| self.axes[i].velocities[0] / self.period_s),
            acceleration: Axes::from_fn(|i, _| self.axes[i].acceleration / (self.period_s * self.period_s)),
        }
    }

    fn align(&mut self, device_force: &Axes<N>) -> Axes<N> {
        Axes::from_fn(|i, _| self.axes[i].align(device_force[i], &self.rule))
    }

    fn shift(&mut self, by: &Axes<N>) {
        for (axis, by) in self.axes.iter_mut().zip(by) {
            axis.positions.iter_mut().for_each(|position| *position += by);
        }
    }

    fn has_late_velocity(&self) -> bool {
        true
    }

    fn reset(&mut self, position: &Axes<N>) {
        let Rule { bound, max_window, .. } = self.rule;
        self.axes = position.data.0[0].map(|x| Axis::at_rest(x, bound, max_window));
        self.started = true;
    }
}

/// One estimator per lane, since the reach of a window depends on the samples of its lane.
impl<const N: usize, S: Real> Estimator<N, S> for Box<[AdaptiveWindow<N>]> {
    type One = Self;

    fn gather(of: &[&Self::One]) -> Option<Self> {
        shared(of, |one| one.first().map(|one| one.period_s))?;
        (of.len() <= S::LANES).then(|| padded(of, S::LANES).flat_map(|one| one.iter()).cloned().collect())
    }

    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        let mut motion = Motion::<N, S> { velocity: Axes::zeros(), acceleration: Axes::zeros() };
        for (lane, estimator) in self.iter_mut().enumerate() {
            let Motion { velocity, acceleration } = estimator.step(&position.extract(lane));
            motion.velocity.replace(lane, velocity);
            motion.acceleration.replace(lane, acceleration);
        }
        motion
    }

    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        let mut aligned = Axes::<N, S>::zeros();
        for (lane, estimator) in self.iter_mut().enumerate() {
            aligned.replace(lane, estimator.align(&device_force.extract(lane)));
        }
        aligned
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        for (lane, estimator) in self.iter_mut().enumerate() {
            estimator.shift(&by.extract(lane));
        }
    }

    fn has_late_velocity(&self) -> bool {
        true
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        for (lane, estimator) in self.iter_mut().enumerate() {
            estimator.reset(&position.extract(lane));
        }
    }
}

impl<const N: usize> From<AdaptiveWindow<N>> for Box<[AdaptiveWindow<N>]> {
    fn from(one: AdaptiveWindow<N>) -> Self {
        Self::from([one])
    }
}

/// Line whose slope is the estimate; it passes through the newest sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum Fit {
    /// Slope of the chord from the oldest to the newest sample of the window.
    #[default]
    End,
    /// Least-squares slope over the window.
    Best,
}

/// Parameters that determine a window and its slope.
#[derive(Clone, Copy, Debug)]
struct Rule {
    fit: Fit,
    bound: f64,
    max_window: usize,
}

/// State of one axis, in ticks: a velocity is in m per tick.
#[derive(Clone, Copy, Debug)]
struct Axis {
    positions: Series,
    velocities: Series,
    /// Error bound of each velocity.
    velocity_bounds: Series,
    acceleration: f64,
    velocity_window: usize,
    acceleration_window: usize,
    /// Path and velocities of a unit mass under the force, relative to its present coasting line.
    force_path: Series,
    force_velocities: Series,
}

impl Axis {
    fn at_rest(position: f64, bound: f64, max_window: usize) -> Self {
        Self {
            positions: [position; MAX_WINDOW + 1],
            velocities: [0.0; MAX_WINDOW + 1],
            velocity_bounds: [2.0 * bound / max_window as f64; MAX_WINDOW + 1],
            acceleration: 0.0,
            velocity_window: max_window,
            acceleration_window: max_window,
            force_path: [0.0; MAX_WINDOW + 1],
            force_velocities: [0.0; MAX_WINDOW + 1],
        }
    }

    fn step(&mut self, position: f64, rule: &Rule) {
        let Rule { fit, bound, max_window } = *rule;
        push(&mut self.positions, position, max_window);
        let positions = &self.positions[..=max_window];
        let (window, velocity) = widest_line(fit, positions, |_| bound, |lag| positions[lag].abs());
        self.velocity_window = window;
        push(&mut self.velocities, velocity, max_window);
        push(&mut self.velocity_bounds, 2.0 * bound / window as f64, max_window);
        let bounds = &self.velocity_bounds;
        let velocities = &self.velocities[..=max_window];
        // A velocity carries the rounding errors of its positions.
        let size = |lag: usize| positions[lag].abs() + velocities[lag].abs();
        (self.acceleration_window, self.acceleration) =
            widest_line(fit, velocities, |lag| bounds[0].max(bounds[lag]), size);
    }

    fn align(&mut self, force: f64, rule: &Rule) -> f64 {
        let Rule { fit, max_window, .. } = *rule;
        push(&mut self.force_path, 0.0, max_window);
        for lag in 1..=max_window {
            self.force_path[lag] += force * (lag as f64 - 0.5);
        }
        let velocity = slope(fit, &self.force_path, self.velocity_window);
        for earlier in &mut self.force_velocities[..max_window] {
            *earlier -= force;
        }
        push(&mut self.force_velocities, velocity, max_window);
        slope(fit, &self.force_velocities, self.acceleration_window)
    }
}

/// Insert `value` at lag 0 and drop the value at lag `max_window`.
fn push(series: &mut Series, value: f64, max_window: usize) {
    series.copy_within(..max_window, 1);
    series[0] = value;
}

/// Values of one axis, newest first.
type Series = [f64; MAX_WINDOW + 1];

/// Return the longest window in ticks whose line stays within `bound(lag)` of each of its samples, and its slope.
///
/// A sample allows one interval of slopes; all samples of a window together allow the intersection, which is updated
/// as the window grows. `series` holds at least two samples, newest first.
///
/// Encoder samples often meet their bound exactly, since samples and bound are whole numbers of quanta. Rounding must
/// not decide this case, because rounding depends on the distance of the device from zero. The bound is therefore
/// widened by the largest rounding error: a sample is wrong by eps/2 of `size(lag)`, and line and difference add a few
/// times that. A true violation exceeds the bound by at least a quantum / window, which is far larger.
fn widest_line(
    fit: Fit,
    series: &[f64],
    bound: impl Fn(usize) -> f64,
    size: impl Fn(usize) -> f64,
) -> (usize, f64) {
    let newest = series[0];
    let newest_size = size(0);
    let mut sums = Sums::default();
    let (mut lowest, mut highest) = (f64::NEG_INFINITY, f64::INFINITY);
    let mut widest = (1, newest - series[1]);
    for (lag, sample) in series.iter().enumerate().skip(1) {
        let ticks = lag as f64;
        // One division per lag, since divisions dominate the cost of this loop.
        let per_tick = 1.0 / ticks;
        let rise = newest - sample;
        let slope = match fit {
            Fit::End => rise * per_tick,
            Fit::Best => sums.add(ticks, rise).least_squares_slope(ticks),
        };
        let roundings = match fit {
            // Interval and slope, each with the rounding of both samples and of their difference: less than 4 eps
            // each.
            Fit::End => 8.0,
            // The sums add up to 12 eps to the slope per tick of lag (Higham 2002, section 4.2).
            Fit::Best => 8.0 + 12.0 * ticks,
        };
        let bound = bound(lag);
        let room = bound + roundings * f64::EPSILON * (newest_size + size(lag) + bound);
        lowest = lowest.max((rise - room) * per_tick);
        highest = highest.min((rise + room) * per_tick);
        if !(lowest..=highest).contains(&slope) {
            break;
        }
        widest = (lag, slope);
    }
    widest
}

/// Return the slope per tick over a given window.
fn slope(fit: Fit, series: &Series, window: usize) -> f64 {
    let newest = series[0];
    match fit {
        Fit::End => (newest - series[window]) / window as f64,
        Fit::Best => {
            let mut sums = Sums::default();
            for (lag, sample) in series[..=window].iter().enumerate() {
                sums.add(lag as f64, newest - sample);
            }
            sums.least_squares_slope(window as f64)
        }
    }
}

/// Sums of the rises since each lag for the least-squares slope.
#[derive(Default)]
struct Sums {
    rise: f64,
    moment: f64,
}

impl Sums {
    fn add(&mut self, ticks: f64, rise: f64) -> &Self {
        self.rise += rise;
        self.moment += ticks * rise;
        self
    }

    /// Return 6 sum (2 l - i) rise\[l\] / (i (i+1) (i+2)) over l = 0 ... i.
    fn least_squares_slope(&self, window: f64) -> f64 {
        let scale = window * (window + 1.0) * (window + 2.0);
        6.0 * (2.0 * self.moment - window * self.rise) / scale
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_S: f64 = 1e-3;
    const BOUND_M: f64 = 2.3e-5;

    fn estimator(fit: Fit) -> AdaptiveWindow<1> {
        AdaptiveWindow::new(PERIOD_S, BOUND_M, 32, fit).unwrap()
    }

    fn window(estimator: &AdaptiveWindow<1>) -> usize {
        estimator.axes[0].velocity_window
    }

    #[test]
    fn a_ramp_is_exact_as_soon_as_the_window_lies_on_it() {
        for fit in [Fit::End, Fit::Best] {
            let mut estimator = estimator(fit);
            for n in 0..200 {
                let motion = estimator.step(&Axes::from([0.1 + 0.2 * n as f64 * PERIOD_S]));
                // 0.2 mm per tick breaks every line that reaches back before the start.
                assert!(n == 0 || window(&estimator) <= n);
                // Positions below 0.2 m round to 3e-17 m; the shortest window divides by dT.
                assert!(n == 0 || (motion.velocity[0] - 0.2).abs() < 4.0 * 3e-17 / PERIOD_S);
                if n > 66 {
                    assert!(motion.acceleration[0].abs() < 1e-10);
                }
            }
            assert_eq!(window(&estimator), 32);
        }
    }

    #[test]
    fn noise_below_the_bound_leaves_the_window_full_and_noise_above_does_not() {
        // Alternating noise is the worst case: neighbours differ by twice the amplitude.
        for (amplitude_m, full) in [(0.49 * BOUND_M, true), (0.51 * BOUND_M, false)] {
            let mut estimator = estimator(Fit::End);
            let mut windows = Vec::new();
            for n in 0..200 {
                let noise = if n % 2 == 0 { amplitude_m } else { -amplitude_m };
                estimator.step(&Axes::from([0.05 * f64::from(n) * PERIOD_S + noise]));
                windows.push(window(&estimator));
            }
            assert_eq!(windows[100..].iter().all(|window| *window == 32), full);
        }
    }

    #[test]
    fn a_turn_shortens_the_window_at_once() {
        let mut estimator = estimator(Fit::End);
        let mut position = 0.0;
        for n in 0..100 {
            position += if n < 99 { 2e-4 } else { -2e-4 };
            estimator.step(&Axes::from([position]));
        }
        assert_eq!(window(&estimator), 1);
    }

    /// Reference in exact integer arithmetic, with positions in quanta. Every velocity is a whole multiple of 1 / `LCM`
    /// of a quantum per tick.
    struct InCounts {
        fit: Fit,
        positions: Vec<i128>,
        /// Velocities in 1 / LCM of a quantum per tick, with their windows.
        velocities: Vec<(i128, i128)>,
    }

    const LONGEST: usize = 16;
    /// Common multiple of the divisors of windows of up to 16 ticks, end-fit and best-fit: i (i+1) (i+2) / 6.
    const LCM: i128 = 12_252_240;

    impl InCounts {
        fn new(fit: Fit, start: i128) -> Self {
            Self {
                fit,
                positions: vec![start; LONGEST + 1],
                velocities: vec![(0, LONGEST as i128); LONGEST + 1],
            }
        }

        /// Return the slope of a window as numerator and denominator.
        fn slope(&self, series: &[i128], window: usize) -> (i128, i128) {
            let i = window as i128;
            match self.fit {
                Fit::End => (series[0] - series[window], i),
                Fit::Best => {
                    let sum: i128 = (0..=window).map(|l| (2 * l as i128 - i) * (series[0] - series[l])).sum();
                    (6 * sum, i * (i + 1) * (i + 2))
                }
            }
        }

        /// Return the longest line; `bound` gives numerator and denominator in the unit of the series.
        fn widest(&self, series: &[i128], bound: impl Fn(usize) -> (i128, i128)) -> (usize, (i128, i128)) {
            let holds = |window: &usize| {
                let (top, bottom) = self.slope(series, *window);
                (1..=*window).all(|lag| {
                    let (most, of) = bound(lag);
                    ((series[0] - series[lag]) * bottom - lag as i128 * top).abs() * of <= most * bottom
                })
            };
            let window = (1..=LONGEST).take_while(holds).last().unwrap();
            (window, self.slope(series, window))
        }

        fn step(&mut self, position: i128) -> ([usize; 2], [f64; 2]) {
            self.positions.insert(0, position);
            let (window, (top, bottom)) = self.widest(&self.positions, |_| (1, 1));
            assert_eq!(top * LCM % bottom, 0);
            self.velocities.insert(0, (top * LCM / bottom, window as i128));
            let velocities: Vec<_> = self.velocities[..=LONGEST].iter().map(|one| one.0).collect();
            // Velocity bound 2 d / w, with the shorter of the two windows.
            let bound = |lag: usize| (2 * LCM, self.velocities[0].1.min(self.velocities[lag].1));
            let (of_acceleration, (rise, ticks)) = self.widest(&velocities, bound);
            let per_tick = |top: i128, bottom: i128| top as f64 / bottom as f64;
            ([window, of_acceleration], [per_tick(top, bottom), per_tick(rise, ticks * LCM)])
        }
    }

    /// Position in quanta of a hand that draws, slows down, rests and reverses.
    #[allow(clippy::cast_possible_truncation)] // a few thousand quanta
    fn hand(n: i32) -> i128 {
        let t = f64::from(n) * PERIOD_S;
        let x = 0.02 * (4.4 * t).sin() + 0.002 * (18.85 * t).sin() + 2e-5 * (62.8 * t).sin();
        (x / BOUND_M).round() as i128
    }

    /// After a reset, the velocity bounds of a device at rest apply from the first tick, even if the device has moved.
    #[test]
    fn motion_from_rest_has_the_exact_windows() {
        for (fit, jump) in
            [Fit::End, Fit::Best].into_iter().flat_map(|fit| (0..8).map(move |jump| (fit, jump)))
        {
            let mut exact = InCounts::new(fit, 0);
            let mut estimator = AdaptiveWindow::<1>::new(PERIOD_S, BOUND_M, LONGEST, fit).unwrap();
            estimator.reset(&Axes::zeros());
            for n in 0..60 {
                let counts = jump + n * n / 90;
                estimator.step(&Axes::from([counts as f64 * BOUND_M]));
                let (windows, _) = exact.step(counts);
                let axis = &estimator.axes[0];
                let found = [axis.velocity_window, axis.acceleration_window];
                assert_eq!(found, windows, "{fit:?} {jump} tick {n}");
            }
        }
    }

    /// Ties at d = quantum are resolved as in exact arithmetic at any device position. All windows are equal, and V
    /// and A differ only by the rounding of the positions.
    #[test]
    fn windows_match_exact_arithmetic_at_any_position() {
        for fit in [Fit::End, Fit::Best] {
            // Up to 10 m in both directions.
            for offset in [0_i128, 1, 4_348, 43_478, -217_391, 434_782, -434_782] {
                let mut exact = InCounts::new(fit, hand(0) + offset);
                let mut estimator = AdaptiveWindow::<1>::new(PERIOD_S, BOUND_M, LONGEST, fit).unwrap();
                estimator.reset(&Axes::from([(hand(0) + offset) as f64 * BOUND_M]));
                let mut short = 0;
                for n in 0..3000 {
                    let counts = hand(n) + offset;
                    let motion = estimator.step(&Axes::from([counts as f64 * BOUND_M]));
                    let (windows, [velocity, acceleration]) = exact.step(counts);
                    let axis = &estimator.axes[0];
                    let found = [axis.velocity_window, axis.acceleration_window];
                    assert_eq!(found, windows, "{fit:?} {offset} tick {n}");
                    short += u32::from(windows[0] < LONGEST);
                    // Positions up to 10.1 m, each wrong by eps/2 of that; no slope weights them more than twice.
                    let rounding = 4.0 * f64::EPSILON * 10.1;
                    let apart = [
                        motion.velocity[0] * PERIOD_S - velocity * BOUND_M,
                        motion.acceleration[0] * PERIOD_S * PERIOD_S - acceleration * BOUND_M,
                    ];
                    assert!(apart[0].abs() <= rounding && apart[1].abs() <= 4.0 * rounding, "{apart:?}");
                }
                assert!(
                    (300..2700).contains(&short),
                    "the motion should need long and short windows: {short}"
                );
            }
        }
    }

    #[test]
    fn invalid_parameters_are_refused() {
        assert!(AdaptiveWindow::<1>::new(PERIOD_S, 0.0, 32, Fit::End).is_err());
        assert!(AdaptiveWindow::<1>::new(PERIOD_S, BOUND_M, 0, Fit::End).is_err());
        assert!(AdaptiveWindow::<1>::new(PERIOD_S, BOUND_M, 129, Fit::End).is_err());
    }

    #[test]
    fn interval_test_matches_the_test_of_each_sample() {
        let mut series = [0.0; MAX_WINDOW + 1];
        for (lag, sample) in series.iter_mut().enumerate() {
            let t = lag as f64;
            *sample = 40.0 * (t / 17.0).sin() + (t * t * 0.37).sin();
        }
        for fit in [Fit::End, Fit::Best] {
            for bound in [0.5, 1.1, 2.0, 4.0, 8.0, 16.0] {
                let direct = (1..=MAX_WINDOW).take_while(|window| {
                    let slope = slope(fit, &series, *window);
                    (1..=*window).all(|lag| (series[0] - series[lag] - lag as f64 * slope).abs() <= bound)
                });
                let (found, rate) = widest_line(fit, &series, |_| bound, |lag| series[lag].abs());
                assert_eq!(direct.last(), Some(found), "{fit:?} {bound}");
                assert!((rate - slope(fit, &series, found)).abs() < 1e-12);
            }
        }
    }
}
