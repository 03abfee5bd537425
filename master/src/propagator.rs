//! Motion over a whole tick without an event, as a linear map kept from tick to tick.

use crate::{Axes, DeviceParameters, Hand, Real, path::DEGREE};

/// Terms of the series of a map; computed once for many ticks, so far more than needed.
const TERMS: usize = 32;

/// Largest rate times dT: the first term left out is below `2^32 / 32! = 2e-26` of the first.
const REACH: f64 = 2.0;

/// Rotations of a tremor's phase before its sine and cosine are recomputed. A rotation rounds by 3e-16, plus
/// 4e-16 per rad of the angle, which is the rounding of the phase itself.
const MAX_TURNS: u32 = 16;

/// Map of one tick of length dT under a linear law, exact to rounding.
///
/// From x and V with the acceleration a, the deviation `e = x(t) - x - V t` obeys:
///
/// `e'' = a - k V t + w(t) - c e' - k e` with `k = K/m`, `c = B/m`.
/// `w` is the target's contribution: its polynomial, and `a sin` of a tremor. Each part of the right side has
/// its own solution from rest, so `(e, e')` at dT is a sum of products.
///
/// Source: variation of constants, Hairer, Norsett and Wanner 1993, section I.11.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Propagator<const N: usize> {
    duration: f64,
    impedance: [f64; 2],
    pub(crate) axes: [AxisPropagator; N],
    /// True if mass and viscous friction are equal on all axes.
    pub(crate) is_isotropic: bool,
    /// True if dT is short against all rates.
    pub(crate) reaches: bool,
    /// Largest shift of the target within the tick by `sin` and `cos` of a tremor, in m per unit of each.
    pub(crate) shakes: [f64; 2],
    /// Amplitude of the tremor in m, and growth of its phase within the tick in rad.
    pub(crate) tremor: [f64; 2],
}

/// Responses `(e, e')` in m and m/s of one axis to each part of the acceleration, of one device or of several
/// lanes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct AxisPropagator<S = f64> {
    pub(crate) inverse_mass: S,
    /// `g K_h / m` of the hand.
    pub(crate) pull: S,
    /// `B / m` of hand and device.
    pub(crate) damping: S,
    /// Response to an acceleration of 1.
    pub(crate) to_acceleration: [S; 2],
    /// Response to `-k t` at a speed of 1.
    pub(crate) to_speed: [S; 2],
    /// Response to each power of the path, from the first.
    pub(crate) to_path: [[S; 2]; DEGREE],
    /// Response to sine and cosine of a tremor at the start.
    pub(crate) to_tremor: [[S; 2]; 2],
    /// Bound on `|V(t) - V|` in the tick, per unit of a bound on the right side without e.
    pub(crate) most: S,
}

impl<const N: usize> Propagator<N> {
    /// A map of zero duration.
    pub(crate) fn none() -> Self {
        Self {
            duration: 0.0,
            impedance: [0.0; 2],
            axes: [AxisPropagator::none(); N],
            is_isotropic: false,
            reaches: false,
            shakes: [0.0; 2],
            tremor: [0.0; 2],
        }
    }

    /// Tick length in s.
    pub(crate) fn duration(&self) -> f64 {
        self.duration
    }

    /// True if this map is for that tick length in s and impedance (K in N/m, B in N s/m).
    #[inline]
    pub(crate) fn is_of(&self, duration: f64, impedance: [f64; 2]) -> bool {
        self.duration == duration && self.impedance == impedance
    }

    #[cold]
    pub(crate) fn new(
        device: &DeviceParameters<N>,
        hand: &Hand<N>,
        impedance: [f64; 2],
        duration: f64,
    ) -> Self {
        let (amplitude, rate) = hand
            .tremor()
            .map_or((0.0, 0.0), |tremor| (tremor.amplitude, std::f64::consts::TAU * tremor.frequency_hz));
        let mut reaches = rate * duration <= REACH;
        let axes = std::array::from_fn(|axis| {
            let inverse_mass = device.mass_kg[axis].recip();
            let pull = impedance[0] * inverse_mass;
            let damping = (impedance[1] + device.viscous[axis]) * inverse_mass;
            let magnitude = (impedance[1] + device.viscous[axis].abs()) * inverse_mass;
            reaches &= magnitude.max(pull.sqrt()) * duration <= REACH;
            let answer = |part: &dyn Fn(usize) -> f64| respond(part, pull, damping, duration);
            let power = |exponent: usize, n: usize| if n == exponent { 1.0 } else { 0.0 };
            // sin(p + r t) - sin p = sin p (cos r t - 1) + cos p sin r t.
            let wave = |n: usize, is_odd: bool| {
                if n == 0 || (n % 2 == 1) != is_odd {
                    return 0.0;
                }
                let sign = if n / 2 % 2 == 1 { -1.0 } else { 1.0 };
                (1..=n).fold(sign * pull * amplitude, |term, i| term * rate / i as f64)
            };
            AxisPropagator {
                inverse_mass,
                pull,
                damping,
                to_acceleration: answer(&|n| power(0, n)),
                to_speed: answer(&|n| -pull * power(1, n)),
                to_path: std::array::from_fn(|exponent| answer(&|n| pull * power(exponent + 1, n))),
                to_tremor: [answer(&|n| wave(n, false)), answer(&|n| wave(n, true))],
                // With equal signs, no term of the true series is larger.
                most: respond(&|n| power(0, n), -pull, -magnitude, duration)[1] * (1.0 + 1e-12),
            }
        });
        let same = |values: &Axes<N>| values.iter().all(|value| *value == values[0]);
        let phase = rate * duration;
        Self {
            duration,
            impedance,
            axes,
            is_isotropic: same(&device.mass_kg) && same(&device.viscous),
            reaches,
            shakes: [amplitude * 0.5 * phase * phase, amplitude * phase],
            tremor: [amplitude, phase],
        }
    }
}

impl<S: Real> AxisPropagator<S> {
    pub(crate) fn none() -> Self {
        let zero = S::zero();
        Self {
            inverse_mass: zero,
            pull: zero,
            damping: zero,
            to_acceleration: [zero; 2],
            to_speed: [zero; 2],
            to_path: [[zero; 2]; DEGREE],
            to_tremor: [[zero; 2]; 2],
            most: zero,
        }
    }

    pub(crate) fn load(&mut self, lane: usize, of: &AxisPropagator) {
        self.inverse_mass.replace(lane, of.inverse_mass);
        self.pull.replace(lane, of.pull);
        self.damping.replace(lane, of.damping);
        self.most.replace(lane, of.most);
        let pairs = [&mut self.to_acceleration, &mut self.to_speed].into_iter();
        let pairs = pairs.chain(&mut self.to_path).chain(&mut self.to_tremor);
        let numbers = [&of.to_acceleration, &of.to_speed].into_iter().chain(&of.to_path).chain(&of.to_tremor);
        for (pair, numbers) in pairs.zip(numbers) {
            pair[0].replace(lane, numbers[0]);
            pair[1].replace(lane, numbers[1]);
        }
    }

    /// Changes over the tick: x beyond `V dt`, and V. They follow from acceleration and V at the start, and
    /// from the target's path and tremor.
    #[inline(always)]
    pub(crate) fn change(
        &self,
        acceleration: S,
        speed: S,
        path: Option<[f64; DEGREE]>,
        wave: Option<[f64; 2]>,
    ) -> [S; 2] {
        // Written out: a closure over lanes would not be inlined.
        let mut e = [
            self.to_acceleration[0] * acceleration + self.to_speed[0] * speed,
            self.to_acceleration[1] * acceleration + self.to_speed[1] * speed,
        ];
        if let Some(path) = path {
            for (answer, term) in self.to_path.iter().zip(path) {
                e[0] += answer[0] * S::splat(term);
                e[1] += answer[1] * S::splat(term);
            }
        }
        if let Some(wave) = wave {
            for (answer, wave) in self.to_tremor.iter().zip(wave) {
                e[0] += answer[0] * S::splat(wave);
                e[1] += answer[1] * S::splat(wave);
            }
        }
        e
    }

    /// Bounds over the tick on the motion of x and on the change of V; the target adds at most `target` to
    /// the acceleration.
    #[inline(always)]
    pub(crate) fn bounds(&self, acceleration: S, speed: S, target: S, duration: S) -> [S; 2] {
        let faster =
            self.most * (acceleration.magnitude() + self.pull * duration * speed.magnitude() + target);
        [duration * (speed.magnitude() + faster) * S::splat(1.0 + 1e-12), faster]
    }
}

/// `(e, e')` at t of `e'' = f - c e' - k e` from rest, f given by its Taylor coefficients.
fn respond(f: &dyn Fn(usize) -> f64, k: f64, c: f64, t: f64) -> [f64; 2] {
    let mut e = [0.0; TERMS];
    for n in 0..TERMS - 2 {
        e[n + 2] = (f(n) - c * (n + 1) as f64 * e[n + 1] - k * e[n]) / ((n + 1) * (n + 2)) as f64;
    }
    let (mut at, mut rate) = (0.0, 0.0);
    for n in (1..TERMS).rev() {
        at = at * t + e[n];
        rate = rate * t + n as f64 * e[n];
    }
    [at * t, rate]
}

/// The hand's intent from an instant on, computed once for the end of one tick and the start of the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct HandForecast<const N: usize> {
    /// Instant in s.
    pub(crate) time: f64,
    /// Path from there, in powers of the time.
    pub(crate) path: [Axes<N>; DEGREE + 1],
    /// Leg at the instant.
    leg: Option<usize>,
    /// True if the path is more than a point.
    pub(crate) moves: bool,
    /// Sine and cosine of the tremor.
    pub(crate) wave: [f64; 2],
    /// Rotations since the last computation.
    turns: u32,
    tick_ns: u64,
    /// Sine and cosine of the phase step of such a tick; none before a second one.
    turn: Option<[f64; 2]>,
    /// Target of the hand in m.
    pub(crate) target: Axes<N>,
    /// Gain, and grip strength in N, each as value and rate.
    pub(crate) grip: [[f64; 2]; 2],
    /// End in s of the interval in which path and grip are smooth.
    pub(crate) until: f64,
}

impl<const N: usize> HandForecast<N> {
    pub(crate) fn new(hand: &Hand<N>, t: f64) -> Self {
        let (gain, strength) = hand.grip_line(t);
        let leg = hand.path().leg_at(t);
        let mut forecast = Self {
            time: t,
            path: hand.path().taylor_in(leg, t),
            leg,
            moves: false,
            wave: [0.0; 2],
            turns: 0,
            tick_ns: 0,
            turn: None,
            target: Axes::zeros(),
            grip: [gain, strength],
            until: hand.next_kink(t).unwrap_or(f64::INFINITY),
        };
        forecast.moves = forecast.path[1..].iter().any(|term| *term != Axes::<N>::zeros());
        forecast.update_tremor(hand, 0);
        forecast
    }

    /// Path of the target along one axis without its constant term: the coefficients of t, t², ...
    #[inline(always)]
    pub(crate) fn path_of(&self, axis: usize) -> [f64; DEGREE] {
        std::array::from_fn(|degree| self.path[degree + 1][axis])
    }

    /// Largest shift of the target along each axis by the path, in m.
    #[inline(always)]
    pub(crate) fn most_moved(&self, duration: f64) -> Axes<N> {
        let (mut shift, mut power) = (Axes::zeros(), 1.0);
        for term in &self.path[1..] {
            power *= duration;
            shift += term.abs() * power;
        }
        shift
    }

    /// Advances to time t in s, `past_ns` later.
    #[inline(always)] // called once per tick from few places
    pub(crate) fn advance(&mut self, hand: &Hand<N>, t: f64, past_ns: u64) {
        if t == self.time {
            return;
        }
        if t < self.time || t >= self.until {
            let turn = self.turn.filter(|_| past_ns == self.tick_ns);
            *self = Self { turn, tick_ns: past_ns, ..Self::new(hand, t) };
            return;
        }
        // Leg and lines of the grip are unchanged.
        self.time = t;
        if self.moves {
            self.path = hand.path().taylor_in(self.leg, t);
        }
        if self.grip[0][1] != 0.0 || self.grip[1][1] != 0.0 {
            let (gain, strength) = hand.grip_line(t);
            self.grip = [gain, strength];
        }
        self.update_tremor(hand, past_ns);
    }

    /// Update the tremor `past_ns` after the last update; 0 for the first.
    ///
    /// Ticks of equal length advance the phase by one angle d: `sin(p + d) = sin p cos d + cos p sin d`.
    #[inline]
    fn update_tremor(&mut self, hand: &Hand<N>, past_ns: u64) {
        self.target = self.path[0];
        let Some(tremor) = hand.tremor() else {
            return;
        };
        match self.turn {
            Some([sine_turned, cosine_turned]) if past_ns == self.tick_ns && self.turns < MAX_TURNS => {
                let [sine, cosine] = self.wave;
                self.wave = [
                    sine * cosine_turned + cosine * sine_turned,
                    cosine * cosine_turned - sine * sine_turned,
                ];
                self.turns += 1;
            }
            _ => self.compute_wave(std::f64::consts::TAU * tremor.frequency_hz, past_ns),
        }
        self.target.add_scalar_mut(tremor.amplitude * self.wave[0]);
    }

    /// Compute sine and cosine of a tremor of `rate` in rad/s. After two ticks in a row of length `past_ns`,
    /// also computes those of the phase step.
    #[inline(never)]
    fn compute_wave(&mut self, rate: f64, past_ns: u64) {
        let of = |angle: f64| <[f64; 2]>::from(angle.sin_cos());
        (self.wave, self.turns) = (of(rate * self.time), 0);
        if past_ns != self.tick_ns {
            (self.tick_ns, self.turn) = (past_ns, None);
        } else if self.turn.is_none() && past_ns != 0 {
            self.turn = Some(of(rate * (past_ns as f64 * 1e-9)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Path, Tremor};
    use proptest::prelude::*;

    fn trembling(frequency_hz: f64) -> Hand<1> {
        let path = Path::new(Axes::<1>::new(0.02), Vec::new()).unwrap();
        let hand = Hand::new(300.0, 5.0, f64::INFINITY, path, None).unwrap();
        hand.with_tremor(Tremor { amplitude: 1e-3, frequency_hz }).unwrap()
    }

    proptest! {
        /// Sine and cosine match the phase at every instant for any tick lengths, within the rounding of 16
        /// rotations and of the phase.
        #[test]
        fn rotated_tremor_matches_its_phase(
            frequency_hz in 0.0..100.0f64,
            lengths in prop::collection::vec((prop_oneof![1..2_000_000u64, 1..200_000_000u64], 1..60usize), 1..30),
        ) {
            let hand = trembling(frequency_hz);
            let (mut forecast, mut now_ns) = (HandForecast::new(&hand, 0.0), 0);
            for (length_ns, ticks) in lengths {
                let mut turned = 0;
                for tick in 0..ticks {
                    now_ns += length_ns;
                    let t = now_ns as f64 / 1e9;
                    forecast.advance(&hand, t, length_ns);
                    let [phase, angle] = [t, length_ns as f64 * 1e-9].map(|t| std::f64::consts::TAU * frequency_hz * t);
                    let rounding = f64::from(MAX_TURNS) * (3e-16 + 4e-16 * angle) + 2.0 * f64::EPSILON * phase;
                    prop_assert!((forecast.wave[0] - phase.sin()).abs() <= rounding, "tick {tick} at {t}");
                    prop_assert!((forecast.wave[1] - phase.cos()).abs() <= rounding, "tick {tick} at {t}");
                    prop_assert_eq!(forecast.target[0], 0.02 + 1e-3 * forecast.wave[0]);
                    turned += forecast.turns;
                }
                prop_assert!(ticks < 4 || turned > 0, "ticks of one length are turned");
            }
        }
    }
}
