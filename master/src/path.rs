//! Target of a hand over time.

use crate::{Axes, ModelError, require};

/// Profile of a leg over its duration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum LegShape {
    /// Constant velocity.
    Linear,
    /// `3 s² - 2 s³`: starts and ends at rest, with jumps of the acceleration.
    Smooth,
    /// `10 s³ - 15 s⁴ + 6 s⁵`: starts and ends at rest, without jumps of the acceleration.
    ///
    /// Source: Flash and Hogan 1985.
    MinimumJerk,
}

/// Degree of the steepest shape.
pub(crate) const DEGREE: usize = 5;

impl LegShape {
    /// Coefficients of the fraction travelled, over s in \[0, 1\].
    pub(crate) fn coefficients(self) -> [f64; DEGREE + 1] {
        match self {
            Self::Linear => [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            Self::Smooth => [0.0, 0.0, 3.0, -2.0, 0.0, 0.0],
            Self::MinimumJerk => [0.0, 0.0, 0.0, 10.0, -15.0, 6.0],
        }
    }
}

/// Shortest leg in s; powers of its rate stay far from overflow.
pub(crate) const MIN_LEG_S: f64 = 1e-9;

/// One leg, from the end of the previous one to `end` within `duration_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct Leg<const N: usize> {
    /// Duration in s (>= 1e-9).
    pub duration_s: f64,
    /// Position at its end in m.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub end: Axes<N>,
    /// Profile of the leg.
    pub shape: LegShape,
}

/// A path of legs, at rest before the first and after the last.
#[derive(Clone, Debug, PartialEq)]
pub struct Path<const N: usize> {
    start: Axes<N>,
    legs: Vec<Leg<N>>,
    /// Start of each leg, and end of the last one.
    begins: Vec<f64>,
    /// Powers of `1 / duration_s` of each leg.
    rates: Vec<[f64; DEGREE + 1]>,
}

impl<const N: usize> Path<N> {
    /// A path that begins at `start` in m at time 0.
    pub fn new(start: Axes<N>, legs: Vec<Leg<N>>) -> Result<Self, ModelError> {
        for x in &start {
            require("start", *x, true, "finite")?;
        }
        let (mut begins, mut rates) = (Vec::with_capacity(legs.len() + 1), Vec::with_capacity(legs.len()));
        begins.push(0.0);
        let mut time = 0.0;
        for leg in &legs {
            let allowed = "finite and at least 1e-9";
            require("duration_s", leg.duration_s, leg.duration_s >= MIN_LEG_S, allowed)?;
            for x in &leg.end {
                require("end", *x, true, "finite")?;
            }
            time += leg.duration_s;
            begins.push(time);
            rates.push(rates_of(leg.duration_s));
        }
        Ok(Self { start, legs, begins, rates })
    }

    /// Replace a path of one leg by `leg` from `start` in m, without allocating.
    pub(crate) fn restart(&mut self, start: Axes<N>, leg: Leg<N>) {
        self.start = start;
        self.begins[1] = leg.duration_s;
        self.rates[0] = rates_of(leg.duration_s);
        self.legs[0] = leg;
    }

    /// Start of leg `index` in m.
    fn from(&self, index: usize) -> &Axes<N> {
        if index == 0 { &self.start } else { &self.legs[index - 1].end }
    }

    /// Leg just after time t, if any.
    pub(crate) fn leg_at(&self, t: f64) -> Option<usize> {
        let begun = self.begins.partition_point(|&begin| begin <= t);
        (begun > 0 && begun <= self.legs.len()).then(|| begun - 1)
    }

    /// Position in m at time t in s.
    pub fn at(&self, t: f64) -> Axes<N> {
        self.taylor(t)[0]
    }

    /// Polynomial of the path from time t in s to the next knot, in powers of the time since t.
    pub(crate) fn taylor(&self, t: f64) -> [Axes<N>; DEGREE + 1] {
        self.taylor_in(self.leg_at(t), t)
    }

    /// The same for a known leg.
    #[inline]
    pub(crate) fn taylor_in(&self, leg: Option<usize>, t: f64) -> [Axes<N>; DEGREE + 1] {
        let mut series = [Axes::zeros(); DEGREE + 1];
        let Some(index) = leg else {
            let after = t >= self.begins[self.legs.len()];
            series[0] = if after { *self.from(self.legs.len()) } else { self.start };
            return series;
        };
        let (leg, from) = (&self.legs[index], self.from(index));
        let s = (t - self.begins[index]) / leg.duration_s;
        let shares = shifted(leg.shape.coefficients(), s);
        let displacement = leg.end - from;
        for ((term, share), rate) in series.iter_mut().zip(shares).zip(self.rates[index]) {
            *term = displacement * (share * rate);
        }
        series[0] += from;
        series
    }

    /// Next time after t at which the polynomial changes.
    pub(crate) fn next_knot(&self, t: f64) -> Option<f64> {
        let next = self.begins.partition_point(|&begin| begin <= t);
        (!self.legs.is_empty()).then(|| self.begins.get(next).copied()).flatten()
    }
}

/// Powers of `1 / duration_s`.
fn rates_of(duration_s: f64) -> [f64; DEGREE + 1] {
    let mut powers = [1.0; DEGREE + 1];
    for degree in 1..=DEGREE {
        powers[degree] = powers[degree - 1] / duration_s;
    }
    powers
}

/// Coefficients of `p(s + x)` in powers of x.
pub(crate) fn shifted<const TERMS: usize>(mut p: [f64; TERMS], s: f64) -> [f64; TERMS] {
    for first in 0..TERMS - 1 {
        for term in (first..TERMS - 1).rev() {
            p[term] += s * p[term + 1];
        }
    }
    p
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path() -> Path<1> {
        let legs = vec![
            Leg { duration_s: 1.0, end: Axes::<1>::new(-2.0), shape: LegShape::MinimumJerk },
            Leg { duration_s: 2.0, end: Axes::<1>::new(2.0), shape: LegShape::Linear },
            Leg { duration_s: 1.0, end: Axes::<1>::new(3.0), shape: LegShape::Smooth },
        ];
        Path::new(Axes::<1>::new(1.0), legs).unwrap()
    }

    #[test]
    fn passes_its_knots_and_rests_at_both_ends() {
        let path = path();
        for (t, x) in [
            (-1.0, 1.0),
            (0.0, 1.0),
            (0.5, -0.5),
            (1.0, -2.0),
            (2.0, 0.0),
            (3.0, 2.0),
            (3.5, 2.5),
            (4.0, 3.0),
            (9.0, 3.0),
        ] {
            assert!((path.at(t)[0] - x).abs() < 1e-15, "{t}");
        }
        let speed = |t: f64| (path.at(t + 1e-6)[0] - path.at(t - 1e-6)[0]) / 2e-6;
        assert!(speed(1e-5).abs() < 1e-6 && speed(1.0 - 2e-6).abs() < 1e-5);
    }

    #[test]
    fn the_polynomial_is_the_path() {
        let path = path();
        for (t, h) in [(0.3, 0.6), (1.5, 1.2), (3.2, 0.7), (5.0, 1.0), (-0.5, 0.4)] {
            let series = path.taylor(t);
            let there = series.iter().rev().fold(0.0, |sum, term| sum * h + term[0]);
            assert!((there - path.at(t + h)[0]).abs() < 1e-14, "{t}");
        }
        let knots: Vec<_> = [-1.0, 0.0, 0.5, 1.0, 3.9, 4.0].iter().map(|&t| path.next_knot(t)).collect();
        assert_eq!(knots, [Some(0.0), Some(1.0), Some(1.0), Some(3.0), Some(4.0), None]);
    }
}
