//! Walls and pushes rendered by a servo loop.

use std::f64::consts::{PI, TAU};

use crate::{
    Axes, ModelError, PushShape,
    contact::window::{Window, rounded_to_ns},
    require,
};

/// The shape of a push over time, without parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Course {
    Step,
    Ramp,
    Sine,
}

/// A push in closed form.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderedPush<const N: usize> {
    /// Its shape over time.
    pub shape: PushShape,
    /// Start in s.
    pub at_s: f64,
    /// Duration in s (> 0).
    pub duration_s: f64,
    /// F in N.
    pub force_n: Axes<N>,
}

/// A plane wall `F = n max(0, K d + B d')` while d > 0, or a two-sided one, with `d = x_w - n·x`.
///
/// Source: paper Eq. 15, without pulling forces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderedWall<const N: usize> {
    /// Outward normal; need not have unit length.
    pub normal: Axes<N>,
    /// A point of the surface in m.
    pub point: Axes<N>,
    /// K in N/m.
    pub stiffness: f64,
    /// B in N s/m.
    pub damping: f64,
    /// True if it acts on both sides and also pulls.
    pub is_two_sided: bool,
}

/// Walls and pushes.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedWalls<const N: usize> {
    walls: Vec<Plane<N>>,
    pushes: Vec<Push<N>>,
    /// True if any wall has damping.
    is_damped: bool,
}

#[derive(Clone, Debug, PartialEq)]
struct Plane<const N: usize> {
    normal: Axes<N>,
    surface: f64,
    stiffness: f64,
    damping: f64,
    is_damped: bool,
    is_two_sided: bool,
}

#[derive(Clone, Debug, PartialEq)]
struct Push<const N: usize> {
    course: Course,
    /// In whole ns.
    at: f64,
    /// In whole ns, excluded.
    ends: f64,
    /// Share per second of a ramp, or radians per second of a sine.
    rate: f64,
    force: Axes<N>,
}

impl<const N: usize> RenderedWalls<N> {
    /// Walls and pushes of one scenario.
    pub fn new(walls: &[RenderedWall<N>], pushes: &[RenderedPush<N>]) -> Result<Self, ModelError> {
        let walls = walls.iter().map(|wall| {
            let length = wall.normal.norm();
            require("wall normal", length, length > 0.0, "finite and of some length")?;
            let normal = wall.normal / length;
            let surface = normal.dot(&wall.point);
            require("wall point", surface, true, "finite")?;
            require("wall stiffness", wall.stiffness, wall.stiffness >= 0.0, "finite and 0 or more")?;
            require("wall damping", wall.damping, wall.damping >= 0.0, "finite and 0 or more")?;
            Ok(Plane {
                normal,
                surface,
                stiffness: wall.stiffness,
                damping: wall.damping,
                is_damped: wall.damping > 0.0,
                is_two_sided: wall.is_two_sided,
            })
        });
        let pushes = pushes.iter().map(|push| {
            require("push time", push.at_s, true, "finite")?;
            require("push duration", push.duration_s, push.duration_s > 0.0, "finite and above 0")?;
            for force in &push.force_n {
                require("push force", *force, true, "finite")?;
            }
            let (course, rate) = match push.shape {
                PushShape::Step => (Course::Step, 0.0),
                PushShape::Ramp { rise_s } => {
                    require("push rise", rise_s, rise_s >= 0.0, "finite and 0 or more")?;
                    if rounded_to_ns(rise_s) == 0.0 {
                        (Course::Step, 0.0)
                    } else {
                        (Course::Ramp, rise_s.recip())
                    }
                }
                PushShape::HalfSine => (Course::Sine, PI / push.duration_s),
                PushShape::Sine { frequency_hz } => {
                    require("push frequency", frequency_hz, frequency_hz >= 0.0, "finite and 0 or more")?;
                    (Course::Sine, TAU * frequency_hz)
                }
            };
            let Window { from_ns, until_ns } = Window::lasting(push.at_s, push.duration_s);
            Ok(Push { course, at: from_ns, ends: until_ns, rate, force: push.force_n })
        });
        let walls = walls.collect::<Result<Vec<_>, _>>()?;
        let is_damped = walls.iter().any(|wall| wall.is_damped);
        Ok(Self { walls, pushes: pushes.collect::<Result<_, _>>()?, is_damped })
    }

    /// True if a point at `position` in m is inside a wall; a two-sided wall has no inside.
    pub fn touches(&self, position: &Axes<N>) -> bool {
        self.walls.iter().any(|wall| !wall.is_two_sided && wall.normal.dot(position) < wall.surface)
    }

    /// True if any wall needs the velocity.
    pub fn is_damped(&self) -> bool {
        self.is_damped
    }

    /// Force in N at time t in s, x in m, V in m/s.
    #[inline]
    pub fn force(&self, t: f64, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let mut force = Axes::<N>::zeros();
        for wall in &self.walls {
            let depth = wall.surface - wall.normal.dot(position);
            let mut push = wall.stiffness * depth;
            if wall.is_damped {
                push -= wall.damping * wall.normal.dot(velocity);
            }
            let acts = wall.is_two_sided || (push > 0.0 && depth > 0.0);
            force += wall.normal * if acts { push } else { 0.0 };
        }
        if self.pushes.is_empty() {
            return force;
        }
        let now = rounded_to_ns(t);
        for push in &self.pushes {
            let since = (now - push.at) * 1e-9;
            let share = match push.course {
                Course::Step => 1.0,
                Course::Ramp => (since * push.rate).min(1.0),
                Course::Sine => (since * push.rate).sin(),
            };
            force += push.force * if now >= push.at && now < push.ends { share } else { 0.0 };
        }
        force
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_course_is_its_formula() {
        let at = |shape, t| {
            let push = RenderedPush { shape, at_s: 1.0, duration_s: 0.5, force_n: Axes::<1>::new(3.0) };
            RenderedWalls::new(&[], &[push]).unwrap().force(t, &Axes::zeros(), &Axes::zeros())[0]
        };
        for (course, t, expected) in [
            (PushShape::Step, 0.999, 0.0),
            (PushShape::Step, 1.0, 3.0),
            (PushShape::Step, 1.5, 0.0),
            (PushShape::Ramp { rise_s: 0.2 }, 1.1, 1.5),
            (PushShape::Ramp { rise_s: 0.2 }, 1.3, 3.0),
            (PushShape::HalfSine, 1.25, 3.0),
            (PushShape::Sine { frequency_hz: 2.0 }, 1.125, 3.0),
        ] {
            assert!((at(course, t) - expected).abs() < 1e-12, "{course:?} {t}");
        }
    }

    #[test]
    fn a_wall_pushes_out_and_a_two_sided_one_pulls() {
        let wall = RenderedWall {
            normal: Axes::<2>::new(0.0, 2.0),
            point: Axes::<2>::zeros(),
            stiffness: 100.0,
            damping: 1.0,
            is_two_sided: false,
        };
        let one = RenderedWalls::new(&[wall], &[]).unwrap();
        let both = RenderedWalls::new(&[RenderedWall { is_two_sided: true, ..wall }], &[]).unwrap();
        for (y, v, pushes, pulls) in [
            (-0.1, 0.0, 10.0, 10.0),
            (0.1, 0.0, 0.0, -10.0),
            (-0.1, -2.0, 12.0, 12.0),
            (-0.1, 20.0, 0.0, -10.0),
        ] {
            let (x, v) = (Axes::<2>::new(5.0, y), Axes::<2>::new(9.0, v));
            assert!((one.force(0.0, &x, &v) - Axes::<2>::new(0.0, pushes)).norm() < 1e-12);
            assert!((both.force(0.0, &x, &v) - Axes::<2>::new(0.0, pulls)).norm() < 1e-12);
        }
    }
}
