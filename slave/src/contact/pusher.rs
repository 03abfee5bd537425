//! A force over time that pushes the tool.

use crate::{
    Axes, ModelError,
    contact::window::{Window, rounded_to_ns},
    require, require_axes,
};

/// Values over time: linear between the points, constant outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Series<const N: usize> {
    time_s: Vec<f64>,
    values: Vec<Axes<N>>,
}

impl<const N: usize> Series<N> {
    /// Times in s, increasing, with one row of values each.
    pub fn new(time_s: Vec<f64>, values: Vec<Axes<N>>) -> Result<Self, ModelError> {
        require("number of recorded times", time_s.len() as f64, !time_s.is_empty(), "1 or more")?;
        let fits = values.len() == time_s.len();
        require("number of recorded values", values.len() as f64, fits, "as many as times")?;
        let mut before = f64::NEG_INFINITY;
        for &t in &time_s {
            require("recorded time", t, t > before, "finite and above the one before")?;
            before = t;
        }
        values.iter().try_for_each(|row| require_axes("recorded value", row, |_| true, "finite"))?;
        Ok(Self { time_s, values })
    }

    /// The value at t in s.
    pub fn at(&self, t: f64) -> Axes<N> {
        self.on(t, t)
    }

    fn on(&self, piece: f64, t: f64) -> Axes<N> {
        let after = self.time_s.partition_point(|&time| time <= piece);
        if after == 0 {
            return self.values[0];
        }
        if after == self.time_s.len() {
            return self.values[after - 1];
        }
        let (from, to) = (self.time_s[after - 1], self.time_s[after]);
        self.values[after - 1].lerp(&self.values[after], (t - from) / (to - from))
    }

    /// The value before the first point or after the last; none between.
    fn level_on(&self, piece: f64) -> Option<Axes<N>> {
        let after = self.time_s.partition_point(|&time| time <= piece);
        match after {
            0 => Some(self.values[0]),
            _ if after == self.time_s.len() => Some(self.values[after - 1]),
            // Between equal values the interpolation is constant, but not to the last bit.
            _ => None,
        }
    }

    fn next_kink(&self, t: f64) -> f64 {
        let after = self.time_s.partition_point(|&time| time <= t);
        self.time_s.get(after).copied().unwrap_or(f64::INFINITY)
    }
}

/// A constant force on the tool that a person asks for during a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Push<const N: usize> {
    /// Force in N, of norm 30 at most.
    pub force_n: Axes<N>,
    /// Duration in s (0.01 to 2).
    pub duration_s: f64,
}

impl<const N: usize> Push<N> {
    /// Reject numbers that are not finite or out of range.
    ///
    /// # Errors
    ///
    /// Name, value and range of the first invalid number.
    pub fn check(&self) -> Result<(), ModelError> {
        let Self { force_n, duration_s } = self;
        require_axes("force", force_n, |_| true, "finite")?;
        require("|force|", force_n.norm(), force_n.norm() <= 30.0, "at most 30 N")?;
        require("duration_s", *duration_s, (0.01..=2.0).contains(duration_s), "0.01 to 2 s")
    }
}

/// The shape of a push over time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PushShape {
    /// Full force at once.
    Step,
    /// Linear rise to F, then constant.
    Ramp {
        /// In s (>= 0).
        rise_s: f64,
    },
    /// `F sin(pi t / duration)`.
    HalfSine,
    /// `F sin(2 pi f t)`.
    Sine {
        /// f in Hz (>= 0).
        frequency_hz: f64,
    },
}

#[derive(Clone, Debug, PartialEq)]
enum Course<const N: usize> {
    Shaped(PushShape, Axes<N>),
    Recorded(Series<N>),
}

/// A force on the tool with a start, a shape over time and an end.
///
/// It acts from its start until its end, which is excluded; both are whole ns, like ticks.
#[derive(Clone, Debug, PartialEq)]
pub struct Pusher<const N: usize = 1> {
    at_s: f64,
    duration_s: f64,
    window: Window,
    course: Course<N>,
}

impl<const N: usize> Pusher<N> {
    /// A push with a shape and a force in N, from `at_s` for `duration_s`.
    pub fn shaped(
        shape: PushShape,
        at_s: f64,
        duration_s: f64,
        force_n: Axes<N>,
    ) -> Result<Self, ModelError> {
        match shape {
            PushShape::Ramp { rise_s } => {
                require("push rise", rise_s, rise_s >= 0.0, "finite and 0 or more")?;
            }
            PushShape::Sine { frequency_hz } => {
                require("push frequency", frequency_hz, frequency_hz >= 0.0, "finite and 0 or more")?;
            }
            PushShape::Step | PushShape::HalfSine => {}
        }
        require_axes("push force", &force_n, |_| true, "finite")?;
        Self::during(at_s, duration_s, Course::Shaped(shape, force_n))
    }

    /// The pusher of a valid push from `at_s` on.
    pub(crate) fn asked(push: &Push<N>, at_s: f64) -> Self {
        let Push { force_n, duration_s } = *push;
        let course = Course::Shaped(PushShape::Step, force_n);
        Self { at_s, duration_s, window: Window::lasting(at_s, duration_s), course }
    }

    /// A recorded push in N whose time 0 is `at_s`.
    pub fn recorded(series: Series<N>, at_s: f64, duration_s: f64) -> Result<Self, ModelError> {
        Self::during(at_s, duration_s, Course::Recorded(series))
    }

    fn during(at_s: f64, duration_s: f64, course: Course<N>) -> Result<Self, ModelError> {
        require("push time", at_s, true, "finite")?;
        require("push duration", duration_s, duration_s >= 0.0, "finite and 0 or more")?;
        Ok(Self { at_s, duration_s, window: Window::lasting(at_s, duration_s), course })
    }

    /// Force on the tool in N at time t in s.
    pub fn force(&self, t: f64) -> Axes<N> {
        self.on(t, t)
    }

    /// The same, on the smooth piece valid at time `piece`.
    pub(crate) fn on(&self, piece: f64, t: f64) -> Axes<N> {
        if !self.window.contains(piece) {
            return Axes::zeros();
        }
        let (piece, since) = (piece - self.at_s, t - self.at_s);
        match &self.course {
            Course::Shaped(PushShape::Ramp { rise_s }, force)
                if rounded_to_ns(piece) < rounded_to_ns(*rise_s) =>
            {
                force * (since / rise_s).clamp(0.0, 1.0)
            }
            Course::Shaped(PushShape::Step | PushShape::Ramp { .. }, force) => *force,
            Course::Shaped(PushShape::HalfSine, force) => {
                force * (std::f64::consts::PI * since / self.duration_s).sin()
            }
            Course::Shaped(PushShape::Sine { frequency_hz }, force) => {
                force * (std::f64::consts::TAU * frequency_hz * since).sin()
            }
            Course::Recorded(series) => series.on(piece, since),
        }
    }

    /// Force on the smooth piece valid at time `piece` if it is constant there; none if it may change.
    pub(crate) fn level_on(&self, piece: f64) -> Option<Axes<N>> {
        if !self.window.contains(piece) {
            return Some(Axes::zeros());
        }
        let since = piece - self.at_s;
        match &self.course {
            Course::Shaped(PushShape::Step, force) => Some(*force),
            Course::Shaped(PushShape::Ramp { rise_s }, force) => {
                (rounded_to_ns(since) >= rounded_to_ns(*rise_s)).then_some(*force)
            }
            Course::Shaped(PushShape::HalfSine | PushShape::Sine { .. }, _) => None,
            Course::Recorded(series) => series.level_on(since),
        }
    }

    /// First time after t at which the force or its slope jumps.
    pub(crate) fn next_kink(&self, t: f64) -> f64 {
        let bound = self.window.next_bound(t);
        let within = match &self.course {
            Course::Shaped(PushShape::Ramp { rise_s }, _) => {
                (self.window.from_ns + rounded_to_ns(*rise_s)) / 1e9
            }
            // A time within rounding of a point counts as that point.
            Course::Recorded(series) => self.at_s + series.next_kink(t - self.at_s + 0.5e-9),
            Course::Shaped(..) => bound,
        };
        if self.window.contains(t) && within > t { within.min(bound) } else { bound }
    }

    /// True if the force is linear in time between kinks.
    pub(crate) fn is_piecewise_linear(&self) -> bool {
        !matches!(self.course, Course::Shaped(PushShape::HalfSine | PushShape::Sine { .. }, _))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_push_rises_stays_and_ends() {
        let pusher = Pusher::shaped(PushShape::Ramp { rise_s: 0.1 }, 2.0, 1.0, Axes::<1>::new(-4.0)).unwrap();
        for (t, f) in [(1.9, 0.0), (2.0, 0.0), (2.05, -2.0), (2.5, -4.0), (3.0, 0.0)] {
            assert!((pusher.force(t)[0] - f).abs() < 1e-12, "{t}");
        }
        let mut kinks = vec![1.0_f64];
        while kinks.last().unwrap().is_finite() {
            kinks.push(pusher.next_kink(*kinks.last().unwrap()));
        }
        assert_eq!(kinks, [1.0, 2.0, 2.1, 3.0, f64::INFINITY]);
    }

    #[test]
    fn a_rise_too_short_for_a_clock_is_a_step() {
        for rise_s in [0.0, 1e-300, 4e-10] {
            let pusher = Pusher::shaped(PushShape::Ramp { rise_s }, 0.1, 0.2, Axes::<1>::new(3.0)).unwrap();
            let forces = [0.1 - 1e-6, 0.1, 0.2, 0.1 + 0.2, 0.3].map(|t| pusher.force(t)[0]);
            assert_eq!(forces, [0.0, 3.0, 3.0, 0.0, 0.0], "{rise_s}");
            assert_eq!(pusher.next_kink(0.1), 0.3);
        }
    }

    #[test]
    fn shapes_take_their_courses() {
        let force = Axes::<2>::new(3.0, -1.0);
        let at = |shape, t| Pusher::shaped(shape, 1.0, 0.5, force).unwrap().force(t);
        for (shape, t, share) in [
            (PushShape::Step, 1.0, 1.0),
            (PushShape::Step, 1.5, 0.0),
            (PushShape::HalfSine, 1.25, 1.0),
            (PushShape::HalfSine, 1.0 + 0.5 / 6.0, 0.5),
            (PushShape::Sine { frequency_hz: 2.0 }, 1.125, 1.0),
            (PushShape::Sine { frequency_hz: 2.0 }, 1.375, -1.0),
        ] {
            assert!((at(shape, t) - force * share).norm() < 1e-14, "{shape:?} {t}");
        }
    }

    #[test]
    fn a_recorded_push_is_linear_between_and_constant_beyond_its_ends() {
        let rows = [1.0, 3.0, -1.0].map(Axes::<1>::new).to_vec();
        let pusher = Pusher::recorded(Series::new(vec![0.1, 0.2, 0.4], rows).unwrap(), 1.0, 0.5).unwrap();
        for (t, f) in [(0.9, 0.0), (1.05, 1.0), (1.15, 2.0), (1.3, 1.0), (1.45, -1.0), (1.6, 0.0)] {
            assert!((pusher.force(t)[0] - f).abs() < 1e-12, "{t}");
        }
        assert_eq!(pusher.next_kink(1.15), 1.2);
        assert!(Series::new(vec![0.1, 0.1], vec![Axes::<1>::zeros(); 2]).is_err());
    }
}
