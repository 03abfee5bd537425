//! One smooth stretch of motion, exactly.

/// Terms of the series: at `rate h <= 1/2` the first one left out is below 1e-18 of the position and 3e-17 of the
/// velocity.
const TERMS: usize = 16;

/// The solution of `m x'' + d x' + k x = f0 + f1 t`, as the Taylor series of itself about t = 0.
///
/// The equation is linear, so its solution is entire and the coefficients follow from a two-term recursion:
/// `m (n+1)(n+2) x_{n+2} = f_n - d (n+1) x_{n+1} - k x_n`. One formula serves the over- and underdamped, the free
/// and the negatively damped case, and its derivative is as exact as itself, which the event search needs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stretch {
    coefficients: [f64; TERMS],
}

/// The linear equation of a stretch.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Linear {
    pub(crate) mass: f64,
    pub(crate) damping: f64,
    pub(crate) stiffness: f64,
    /// f0 in N.
    pub(crate) force: f64,
    /// f1 in N/s.
    pub(crate) force_rate: f64,
}

impl Linear {
    /// Longest time in s for which the series holds full precision.
    pub(crate) fn reach(&self) -> f64 {
        let rate = (self.damping.abs() / self.mass).max((self.stiffness / self.mass).sqrt());
        if rate > 0.0 { 0.5 / rate } else { f64::INFINITY }
    }

    /// The motion that starts at x in m with V in m/s.
    pub(crate) fn from(&self, position: f64, velocity: f64) -> Stretch {
        let mut x = [0.0; TERMS];
        (x[0], x[1]) = (position, velocity);
        for n in 0..TERMS - 2 {
            let force = match n {
                0 => self.force,
                1 => self.force_rate,
                _ => 0.0,
            };
            let next = (n + 1) as f64;
            x[n + 2] = (force - self.damping * next * x[n + 1] - self.stiffness * x[n])
                / (self.mass * next * (next + 1.0));
        }
        Stretch { coefficients: x }
    }
}

impl Stretch {
    pub(crate) fn position(&self, t: f64) -> f64 {
        self.coefficients.iter().rev().fold(0.0, |sum, x| sum * t + x)
    }

    pub(crate) fn velocity(&self, t: f64) -> f64 {
        let derivatives = self.coefficients.iter().enumerate().skip(1).rev();
        derivatives.fold(0.0, |sum, (n, x)| sum * t + n as f64 * x)
    }
}

/// The first time in (0, end] at which `f` has become negative, located to rounding; `f` may start at zero.
///
/// Looks at eight points before it bisects: within half a time constant of a linear motion a sign cannot change
/// twice between two of them by more than rounding.
pub(crate) fn first_negative(f: impl Fn(f64) -> f64, end: f64) -> Option<f64> {
    const LOOKS: i32 = 8;
    let mut before = 0.0;
    for look in 1..=LOOKS {
        let mut after = end * f64::from(look) / f64::from(LOOKS);
        if f(after) < 0.0 {
            for _ in 0..60 {
                let middle = 0.5 * (before + after);
                if f(middle) < 0.0 { after = middle } else { before = middle }
            }
            return Some(after);
        }
        before = after;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Closed forms: free ramped force, under- and overdamped oscillator, negative damping.
    #[test]
    fn equals_the_closed_forms() {
        let t: f64 = 1e-3;
        let free = Linear { mass: 0.2, damping: 0.0, stiffness: 0.0, force: 3.0, force_rate: 7.0 };
        let motion = free.from(0.1, -0.4);
        let expected = 0.1 - 0.4 * t + 15.0 * t * t / 2.0 + 35.0 * t.powi(3) / 6.0;
        assert!((motion.position(t) - expected).abs() < 1e-16);

        let spring = Linear { mass: 0.157, damping: 0.0, stiffness: 200.0, force: 0.0, force_rate: 0.0 };
        let w = (200.0_f64 / 0.157).sqrt();
        let motion = spring.from(-0.039, 0.0);
        assert!((motion.position(t) + 0.039 * (w * t).cos()).abs() < 1e-16);
        assert!((motion.velocity(t) - 0.039 * w * (w * t).sin()).abs() < 1e-14);

        for damping in [5.0, -0.005] {
            let drag = Linear { mass: 0.157, damping, stiffness: 0.0, force: 0.0, force_rate: 0.0 };
            let motion = drag.from(0.0, 1.2);
            assert!((motion.velocity(t) - 1.2 * (-damping / 0.157 * t).exp()).abs() < 1e-15);
        }
        // Overdamped: m = 1, d = 50, k = 600 has the roots -20 and -30.
        let heavy = Linear { mass: 1.0, damping: 50.0, stiffness: 600.0, force: 0.0, force_rate: 0.0 };
        let (a, b) = ((-20.0 * t).exp(), (-30.0 * t).exp());
        assert!((heavy.from(1.0, 0.0).position(t) - (3.0 * a - 2.0 * b)).abs() < 1e-15);
    }

    #[test]
    fn full_precision_to_its_reach() {
        let spring = Linear { mass: 0.1, damping: 0.0, stiffness: 1e5, force: 0.0, force_rate: 0.0 };
        let t = spring.reach();
        let motion = spring.from(1.0, 0.0);
        assert!((motion.position(t) - 0.5_f64.cos()).abs() < 1e-15);
    }

    #[test]
    fn finds_the_first_crossing() {
        let t = first_negative(|t| 0.3 - t, 1.0).unwrap();
        assert!((t - 0.3).abs() < 1e-15);
        assert_eq!(first_negative(|t| t, 1.0), None);
    }
}
