//! Where a hand means to be, over time.

use crate::{ModelError, require};

/// How a leg of a path is travelled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LegShape {
    /// Constant velocity.
    Linear,
    /// `10 s³ - 15 s⁴ + 6 s⁵`: starts and ends at rest.
    ///
    /// Source: Flash and Hogan 1985.
    MinimumJerk,
}

/// One leg: from where the last one ended to `end`, within `duration_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Leg {
    /// Duration in s (> 0).
    pub duration_s: f64,
    /// Position at its end in m.
    pub end: f64,
    /// How it is travelled.
    pub shape: LegShape,
}

/// A path of legs, at rest before the first and after the last.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    start: f64,
    legs: Vec<Leg>,
}

impl Path {
    /// A path that begins at `start` in m, at time 0.
    pub fn new(start: f64, legs: Vec<Leg>) -> Result<Self, ModelError> {
        require("start", start, true, "finite")?;
        for leg in &legs {
            require("duration_s", leg.duration_s, leg.duration_s > 0.0, "finite and above 0")?;
            require("end", leg.end, true, "finite")?;
        }
        Ok(Self { start, legs })
    }

    /// Position in m where the path begins.
    pub fn start(&self) -> f64 {
        self.start
    }

    /// Position in m at time t in s.
    pub fn at(&self, t: f64) -> f64 {
        let (mut from, mut begun) = (self.start, 0.0);
        for leg in &self.legs {
            if t <= begun {
                return from;
            }
            let s = (t - begun) / leg.duration_s;
            if s < 1.0 {
                let share = match leg.shape {
                    LegShape::Linear => s,
                    LegShape::MinimumJerk => s * s * s * (10.0 + s * (6.0 * s - 15.0)),
                };
                return from + (leg.end - from) * share;
            }
            (from, begun) = (leg.end, begun + leg.duration_s);
        }
        from
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passes_its_knots_and_rests_at_both_ends() {
        let legs = vec![
            Leg { duration_s: 1.0, end: -2.0, shape: LegShape::MinimumJerk },
            Leg { duration_s: 2.0, end: 2.0, shape: LegShape::Linear },
        ];
        let path = Path::new(1.0, legs).unwrap();
        for (t, x) in [(-1.0, 1.0), (0.0, 1.0), (0.5, -0.5), (1.0, -2.0), (2.0, 0.0), (3.0, 2.0), (9.0, 2.0)]
        {
            assert!((path.at(t) - x).abs() < 1e-15, "{t}");
        }
        let speed = |t: f64| (path.at(t + 1e-6) - path.at(t - 1e-6)) / 2e-6;
        assert!(speed(1e-5).abs() < 1e-6 && speed(1.0 - 2e-6).abs() < 1e-6);
    }
}
