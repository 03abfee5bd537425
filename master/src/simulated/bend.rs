//! A tick with friction along a bending motion: its Taylor series, with as many terms as rounding requires.

use super::SimulatedMaster;
use crate::{
    Axes,
    direction::Direction,
    path::DEGREE,
    polynomial::{INVERSE, TERMS},
};

/// Largest number of terms; a tick that needs more is followed stretch by stretch.
const MAX_TERMS: usize = TERMS;

/// Smallest number of terms; the path contributes to each of these.
const MIN_TERMS: usize = DEGREE + 1;

/// Largest change of V within the tick, as a fraction of the speed. The series of its direction then
/// converges beyond twice the tick, so two terms within rounding imply that all later ones are.
pub(super) const MAX_CHANGE: f64 = 0.125;

impl<const N: usize> SimulatedMaster<N> {
    /// Changes of x in m and V in m/s over the tick, from acceleration in m/s² and speed in m/s at its start;
    /// none if the series does not converge within the tick.
    ///
    /// The terms of V, its direction U and the target P, each times its power of dT, obey:
    ///
    /// `(n + 1) V_(n+1) = dT (k P_n - c V_n - k dT V_(n-1) / n - f U_n)` for n > 0.
    /// Here `k = K/m`, `c = B/m` and f is the friction over m.
    pub(super) fn bent(
        &self,
        acceleration: &Axes<N>,
        speed: f64,
        moves: bool,
        trembles: bool,
    ) -> Option<[Axes<N>; 2]> {
        let (map, forecast) = (&self.propagator, &self.clock.forecast);
        let duration = map.duration();
        let (pull, damping) = (map.axes[0].pull, map.axes[0].damping);
        let friction = self.device.coulomb[0] * map.axes[0].inverse_mass;
        let tolerance = f64::EPSILON / 16.0 * speed;
        let mut v = [Axes::<N>::zeros(); MAX_TERMS];
        (v[0], v[1]) = (self.motion.velocity, acceleration * duration);
        let mut direction = Direction::new();
        let _ = direction.coefficient(&v, &self.motion.velocity, 0);
        let (mut before, mut newest) = (v[0], v[1]);
        let (mut turns, mut last_turn, mut last) = (true, f64::INFINITY, f64::INFINITY);
        let (mut power, mut shaken) = (1.0, map.tremor[0]);
        for n in 1..MAX_TERMS - 1 {
            let mut force = newest * -damping - before * (pull * duration * INVERSE[n]);
            if moves && n <= DEGREE {
                power *= duration;
                force += forecast.path[n] * (pull * power);
            }
            if trembles {
                shaken *= map.tremor[1] * INVERSE[n];
                let [sine, cosine] = forecast.wave;
                force.add_scalar_mut(pull * shaken * [sine, cosine, -sine, -cosine][n % 4]);
            }
            if turns {
                let turn = direction.coefficient(&v, &newest, n) * friction;
                force -= turn;
                let size = magnitude(&turn) * duration;
                turns = n < MIN_TERMS || last_turn.max(size) > tolerance;
                last_turn = size;
            }
            (before, newest) = (newest, force * (duration * INVERSE[n + 1]));
            v[n + 1] = newest;
            let size = magnitude(&newest);
            if !turns && last.max(size) <= tolerance {
                return Some(summed(&v[..n + 2], duration));
            }
            last = size;
        }
        None
    }
}

/// Upper bound of the norm, without a root.
#[inline]
fn magnitude<const N: usize>(of: &Axes<N>) -> f64 {
    of.iter().map(|x| x.abs()).sum()
}

/// Changes of x and V over the tick from the terms of V, summed smallest first.
#[inline]
fn summed<const N: usize>(v: &[Axes<N>], duration: f64) -> [Axes<N>; 2] {
    let (mut moved, mut gained) = (Axes::zeros(), Axes::zeros());
    for (n, term) in v.iter().enumerate().skip(1).rev() {
        moved += term * INVERSE[n + 1];
        gained += term;
    }
    [(v[0] + moved) * duration, gained]
}
