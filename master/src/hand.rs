//! A hand along one axis: an impedance towards a path, held by a finite grip that can let go.

use crate::{ModelError, Path, require};

/// How the grip is given up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Release {
    /// When it begins, in s.
    pub at_s: f64,
    /// Time in s over which the grip strength falls linearly to zero; 0 lets go at once.
    pub duration_s: f64,
}

/// A hand that steers the device along a path, with as much force as its grip can pass on.
///
/// `F_h = K_h (x_target - x) - B_h V`, clipped to the grip strength: beyond it the stylus slips through the
/// fingers. People hold with a margin above the load, so a loosening grip first changes nothing, then slips.
///
/// Source: impedance of a hand, Hogan 1989; grip margin, Johansson and Westling 1984.
#[derive(Clone, Debug, PartialEq)]
pub struct Hand {
    stiffness: f64,
    damping: f64,
    strength_n: f64,
    path: Path,
    release: Option<Release>,
}

impl Hand {
    /// `K_h` in N/m and `B_h` in N s/m (>= 0), grip strength in N (>= 0), the path it follows, when it lets go.
    pub fn new(
        stiffness: f64,
        damping: f64,
        strength_n: f64,
        path: Path,
        release: Option<Release>,
    ) -> Result<Self, ModelError> {
        require("hand stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
        require("hand damping", damping, damping >= 0.0, "finite and 0 or more")?;
        require("grip strength", strength_n, strength_n >= 0.0, "finite and 0 or more")?;
        if let Some(Release { at_s, duration_s }) = release {
            require("release time", at_s, true, "finite")?;
            require("release duration", duration_s, duration_s >= 0.0, "finite and 0 or more")?;
        }
        Ok(Self { stiffness, damping, strength_n, path, release })
    }

    /// No hand at all: the device rests at `position` in m and nobody holds it.
    pub fn absent(position: f64) -> Result<Self, ModelError> {
        Self::new(0.0, 0.0, 0.0, Path::new(position, Vec::new())?, None)
    }

    pub(crate) fn stiffness(&self) -> f64 {
        self.stiffness
    }

    pub(crate) fn damping(&self) -> f64 {
        self.damping
    }

    /// The path that the hand means to follow.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// When it lets go.
    pub fn release(&self) -> Option<Release> {
        self.release
    }

    /// Grip strength in N at time t in s.
    pub fn strength_at(&self, t: f64) -> f64 {
        match self.release {
            Some(Release { at_s, duration_s }) if t >= at_s => {
                if t >= at_s + duration_s {
                    0.0
                } else {
                    self.strength_n * (1.0 - (t - at_s) / duration_s)
                }
            }
            _ => self.strength_n,
        }
    }

    /// The next time after t at which the strength ceases to be one straight line.
    pub(crate) fn next_kink(&self, t: f64) -> Option<f64> {
        let Release { at_s, duration_s } = self.release?;
        [at_s, at_s + duration_s].into_iter().find(|&kink| kink > t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strength_falls_over_the_release() {
        let path = Path::new(0.0, Vec::new()).unwrap();
        let release = Some(Release { at_s: 1.0, duration_s: 0.04 });
        let hand = Hand::new(300.0, 5.0, 20.0, path.clone(), release).unwrap();
        for (t, n) in [(0.0, 20.0), (1.0, 20.0), (1.01, 15.0), (1.04, 0.0), (5.0, 0.0)] {
            assert!((hand.strength_at(t) - n).abs() < 1e-12, "{t}");
        }
        let sudden = Some(Release { at_s: 1.0, duration_s: 0.0 });
        let hand = Hand::new(300.0, 5.0, 20.0, path, sudden).unwrap();
        assert_eq!((hand.strength_at(0.999), hand.strength_at(1.0)), (20.0, 0.0));
    }
}
