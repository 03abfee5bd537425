//! One smooth stretch of motion, solved exactly.

use crate::{
    Axes, ContinuousWall, DeviceParameters, Hand,
    direction::Direction,
    hand::line,
    polynomial::{Series, TERMS},
};

/// Source of the hand's force during a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Grip {
    /// The full impedance.
    Holds,
    /// The grip strength, along the impedance force that exceeds it.
    Slips,
}

/// Friction during a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Rub<const N: usize> {
    /// A constant force in N on each axis.
    Constant(Axes<N>),
    /// `c V / |V|`, against the motion as it rotates.
    AlongMotion(f64),
}

/// Laws that act over a stretch; their strengths may vary.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Regime<const N: usize> {
    pub(crate) grip: Grip,
    pub(crate) rub: Rub<N>,
    /// Axes held by friction or a stop.
    pub(crate) stuck: [bool; N],
    /// Mask of the walls that push.
    pub(crate) pushing: u64,
    /// Direction of a device that moves on a straight line with friction along its motion.
    pub(crate) straight: Option<Axes<N>>,
}

/// Forces over a stretch.
pub(crate) struct Law<'a, const N: usize> {
    pub(crate) device: &'a DeviceParameters<N>,
    pub(crate) hand: &'a Hand<N>,
    pub(crate) walls: &'a [ContinuousWall<N>],
    /// Force of the motors in N.
    pub(crate) held: Axes<N>,
    pub(crate) target: &'a [Axes<N>; TERMS],
    /// Fraction of the impedance, as value and rate.
    pub(crate) gain: [f64; 2],
    /// Grip strength in N, as value and rate.
    pub(crate) strength: [f64; 2],
    /// Longest stretch requested in s; a reach beyond it does not matter.
    pub(crate) wanted: f64,
}

/// Taylor series about t = 0 of the solution of
/// `m x'' = F + g (K_h (target - x) - B_h x') + walls - b x' - friction`.
///
/// A recursion gives the coefficients: those of the acceleration up to order n give x to order n + 2. If all
/// laws are linear, the solution is entire: one axis, or several that neither slip nor have friction along
/// the motion. One formula then serves the over- and underdamped, the free and the negatively damped case. A
/// direction `w / |w|` is a series too; its radius of convergence then bounds the stretch. The derivative is
/// as exact as the solution, as the event search requires.
///
/// Source: recursion for powers of series, Jorba and Zou 2005, section 2.
#[derive(Clone, Debug)]
pub(crate) struct Stretch<const N: usize> {
    /// Series of x.
    pub(crate) position: [Axes<N>; TERMS],
    /// Force that the hand wishes to exert.
    pub(crate) wish: [Axes<N>; TERMS],
    /// All forces except friction on an axis at rest.
    pub(crate) push: [Axes<N>; TERMS],
    /// Longest time in s with full precision of the series.
    pub(crate) reach: f64,
}

/// `1 / ((n + 1) (n + 2))`, from the series of the acceleration to that of x. A division takes longer than
/// the rest of a term.
const INVERSE: [f64; TERMS] = {
    let mut inverse = [0.0; TERMS];
    let mut n = 0;
    while n < TERMS {
        inverse[n] = 1.0 / ((n + 1) * (n + 2)) as f64;
        n += 1;
    }
    inverse
};

/// Number of time constants within the wanted time from which a motion counts as stiff and gets its own
/// series.
const STIFF: f64 = 16.0;

impl<const N: usize> Law<'_, N> {
    /// Longest time in s for which the series of a linear motion has full precision.
    pub(crate) fn linear_reach(&self, pushing: u64) -> f64 {
        let (mut damping, mut stiffness) = (self.hand.damping(), self.hand.stiffness());
        for (index, wall) in self.walls.iter().enumerate() {
            if pushing & (1 << index) != 0 {
                damping += wall.damping;
                stiffness += wall.stiffness;
            }
        }
        let mass = self.device.mass_kg.min();
        let viscous = self.device.viscous.amax();
        let tremor = self.hand.tremor().map_or(0.0, |tremor| std::f64::consts::TAU * tremor.frequency_hz);
        let rate = ((damping + viscous) / mass).max((stiffness / mass).sqrt()).max(tremor);
        if rate > 0.0 { 0.5 / rate } else { f64::INFINITY }
    }

    /// Motion from x in m and V in m/s, written in place because it is large.
    pub(crate) fn follow(
        &self,
        regime: &Regime<N>,
        position: Axes<N>,
        velocity: Axes<N>,
        stretch: &mut Stretch<N>,
    ) {
        let Stretch { position: x, wish, push, .. } = stretch;
        let mut v = [Axes::zeros(); TERMS];
        for beyond in TERMS - 2..TERMS {
            (wish[beyond], push[beyond]) = (Axes::zeros(), Axes::zeros());
        }
        let (mut grip_direction, mut motion_direction) = (Direction::new(), Direction::new());
        let (gain, strength) = (line(self.gain), line(self.strength));
        let inverse_mass = self.device.mass_kg.map(f64::recip);
        // Values of the previous term.
        let (mut slipping, mut impedance) = (Axes::zeros(), Axes::zeros());
        (x[0], v[0]) = (position, velocity);
        if N == 1 {
            x[1] = velocity;
        } else {
            x[1] = masked(velocity, &regime.stuck);
        }
        // The newest terms are held separately: reading back a fresh store would stall.
        let (mut place, mut ahead) = (x[0], x[1]);
        for n in 0..TERMS - 2 {
            let speed = ahead * (n + 1) as f64;
            v[n] = speed;
            let wished = (self.target[n] - place) * self.hand.stiffness() - speed * self.hand.damping();
            let wishes = wished * gain[0] + impedance * gain[1];
            wish[n] = wishes;
            impedance = wished;
            let hand = match regime.grip {
                Grip::Holds => wishes,
                // A released hand pulls in no direction.
                Grip::Slips if self.strength == [0.0; 2] => Axes::zeros(),
                Grip::Slips if N == 1 => wish[0].map(f64::signum) * strength[n],
                Grip::Slips => {
                    let before = slipping * strength[1];
                    slipping = grip_direction.coefficient(wish, &wishes, n);
                    slipping * strength[0] + before
                }
            };
            let mut pushes = hand - self.device.viscous.component_mul(&speed);
            if n == 0 {
                pushes += self.held;
            }
            for (index, wall) in self.walls.iter().enumerate() {
                if regime.pushing & (1 << index) != 0 {
                    let surface = if n == 0 { wall.surface } else { 0.0 };
                    let depth = surface - wall.normal.dot(&place);
                    let force = wall.stiffness * depth - wall.damping * wall.normal.dot(&speed);
                    pushes += wall.normal * force;
                }
            }
            push[n] = pushes;
            let mut force = pushes;
            match regime.rub {
                Rub::Constant(friction) if n == 0 => force -= friction,
                Rub::Constant(_) => {}
                Rub::AlongMotion(coulomb) => force -= motion_direction.coefficient(&v, &speed, n) * coulomb,
            }
            let next = match n {
                // The acceleration itself, to rounding.
                0 => force.component_div(&self.device.mass_kg) * 0.5,
                _ => force.component_mul(&inverse_mass) * INVERSE[n],
            };
            (place, ahead) = (ahead, masked(next, &regime.stuck));
            x[n + 2] = ahead;
        }
        let mut reach = self.linear_reach(regime.pushing);
        if N > 1 && regime.grip == Grip::Slips && self.strength != [0.0; 2] {
            reach = reach.min(grip_direction.reach(self.wanted));
        }
        if let Rub::AlongMotion(coulomb) = regime.rub {
            // Across the motion, friction acts as damping c / |V|, even for a component too slow to change
            // |V|.
            let turn_s = 0.5 * self.device.mass_kg.min() * velocity.norm() / coulomb;
            reach = reach.min(motion_direction.reach(self.wanted)).min(turn_s);
        }
        stretch.reach = reach;
    }
}

impl<const N: usize> Law<'_, N> {
    /// Displacement in m and gain of speed in m/s over a step of t in s, with the forces at its end. Friction
    /// and damping then only brake, however stiff they are and however fast the motion rotates.
    ///
    /// Linearly implicit Euler method, `(M + t B + t² K) dV = t (F + t F' )`. F are the forces at the start,
    /// F' is their rate along the present motion. B and K are bounds over all directions.
    ///
    /// Source: Hairer and Wanner 1996, section IV.7 (W-methods).
    pub(crate) fn coarse_step(&self, regime: &Regime<N>, stretch: &Stretch<N>, t: f64) -> (Axes<N>, Axes<N>) {
        let velocity = stretch.position[1];
        let share = match regime.grip {
            Grip::Holds => self.gain[0],
            Grip::Slips if N == 1 => 0.0,
            Grip::Slips => {
                let wish = stretch.wish[0].norm();
                if wish > 0.0 { self.gain[0] * (self.strength[0] / wish) } else { 0.0 }
            }
        };
        let (mut stiffness, mut damping) = (share * self.hand.stiffness(), share * self.hand.damping());
        let mut ahead = (self.target[1] - velocity) * stiffness;
        for wall in self.pushing(regime) {
            ahead -= wall.normal * (wall.stiffness * wall.normal.dot(&velocity));
            stiffness += wall.stiffness;
            damping += wall.damping;
        }
        let inertia = self.device.mass_kg.zip_map(&self.device.viscous, |mass, viscous| {
            mass + t * (damping + viscous.max(0.0) + t * stiffness)
        });
        let mut push = stretch.push[0] + ahead * t;
        if let Rub::Constant(friction) = regime.rub {
            push -= friction;
        }
        let free = velocity + masked(push.component_div(&inertia) * t, &regime.stuck);
        let reached = match regime.rub {
            Rub::Constant(_) => free,
            Rub::AlongMotion(coulomb) => braked(&free, &inertia.map(|inertia| coulomb * t / inertia)),
        };
        (reached * t, reached - velocity)
    }

    fn pushing<'b>(&'b self, regime: &'b Regime<N>) -> impl Iterator<Item = &'b ContinuousWall<N>> {
        let pushes = |index: &usize| regime.pushing & (1 << index) != 0;
        self.walls.iter().enumerate().filter(move |(index, _)| pushes(index)).map(|(_, wall)| wall)
    }

    /// Motion under damping so strong that the series of [`Law::follow`] reach only a small part of `wanted`
    /// s, after the initial transient. None during the transient, or if the axes are coupled or nonlinear.
    ///
    /// Along an axis `x'' = -c x' - k x + u(t) = (r_1 + r_2) x' - r_1 r_2 x + u` with `r_1 << r_2 <= 0`.
    /// So `w = x' - r_2 x` obeys `w' = r_1 w + u`: it is `A e^(r_1 t)` plus a slow solution.
    /// The series of the slow solution follows from the last term down:
    /// `w_n = ((n + 1) w_(n+1) - u_n) / r_1`. If A is within rounding, `x' = r_2 x + w` gives the series of x, whose reach depends on `r_2`.
    pub(crate) fn relaxed(
        &self,
        regime: &Regime<N>,
        position: Axes<N>,
        velocity: Axes<N>,
    ) -> Option<Stretch<N>> {
        let Rub::Constant(friction) = regime.rub else { return None };
        let slips = regime.grip == Grip::Slips;
        if (slips && N > 1 && self.strength != [0.0; 2]) || (!slips && self.gain[1] != 0.0) {
            return None;
        }
        let across = |wall: &ContinuousWall<N>| wall.normal.iter().filter(|part| **part != 0.0).count() == 1;
        if !self.pushing(regime).all(across) {
            return None;
        }
        let impedance = if slips { 0.0 } else { self.gain[0] };
        let (stiffness, damping) = (impedance * self.hand.stiffness(), impedance * self.hand.damping());
        let wish_side = ((self.target[0] - position) * self.hand.stiffness()
            - velocity * self.hand.damping())
        .map(|wish| if wish < 0.0 { -1.0 } else { 1.0 });
        let grip = line(self.strength);
        let tremor = self.hand.tremor().map_or(0.0, |tremor| std::f64::consts::TAU * tremor.frequency_hz);
        let mut reach = if tremor > 0.0 { 0.5 / tremor } else { f64::INFINITY };
        let mut x = [Axes::zeros(); TERMS];
        x[0] = position;
        let mut is_slow = false;
        for axis in (0..N).filter(|&axis| !regime.stuck[axis]) {
            let mass = self.device.mass_kg[axis];
            let (mut k, mut c) = (stiffness, damping + self.device.viscous[axis]);
            let constant = self.held[axis] - friction[axis];
            let (mut rest, mut size) = (constant, constant.abs());
            for wall in self.pushing(regime).filter(|wall| wall.normal[axis] != 0.0) {
                k += wall.stiffness;
                c += wall.damping;
                rest += wall.stiffness * wall.surface * wall.normal[axis];
                size += wall.stiffness * wall.surface.abs();
            }
            let (k, c) = (k / mass, c / mass);
            let u: Series = std::array::from_fn(|n| {
                let pulled = stiffness * self.target[n][axis];
                let slipping = if slips { wish_side[axis] * grip[n] } else { 0.0 };
                (pulled + slipping + if n == 0 { rest } else { 0.0 }) / mass
            });
            size += stiffness * self.target[0][axis].abs() + if slips { grip[0] } else { 0.0 };
            let root = (0.25 * c * c - k).sqrt();
            let fast = -(0.5 * c + root);
            let slow = k / fast;
            // Complex roots give NaN, which is not stiff.
            let is_stiff = -fast * self.wanted > STIFF && fast < 4.0 * slow && -fast > 4.0 * tremor;
            if is_stiff {
                let mut w = [0.0; TERMS + 1];
                for n in (0..TERMS).rev() {
                    w[n] = ((n + 1) as f64 * w[n + 1] - u[n]) / fast;
                }
                let along = velocity[axis] - slow * position[axis];
                let rounding = velocity[axis].abs() + (slow * position[axis]).abs() + size / mass / -fast;
                if (along - w[0]).abs() > 64.0 * f64::EPSILON * rounding {
                    return None;
                }
                for n in 0..TERMS - 1 {
                    x[n + 1][axis] = (slow * x[n][axis] + w[n]) / (n + 1) as f64;
                }
                reach = reach.min(if slow < 0.0 { 0.5 / -slow } else { f64::INFINITY });
                is_slow = true;
            } else {
                x[1][axis] = velocity[axis];
                for n in 0..TERMS - 2 {
                    let v = (n + 1) as f64 * x[n + 1][axis];
                    x[n + 2][axis] = (u[n] - k * x[n][axis] - c * v) * INVERSE[n];
                }
                let rate = c.abs().max(k.sqrt());
                reach = reach.min(if rate > 0.0 { 0.5 / rate } else { f64::INFINITY });
            }
        }
        is_slow.then(|| {
            let v = |n: usize| x.get(n + 1).map_or(Axes::zeros(), |x| x * (n + 1) as f64);
            let wish = std::array::from_fn(|n| {
                let impedance =
                    |n: usize| (self.target[n] - x[n]) * self.hand.stiffness() - v(n) * self.hand.damping();
                impedance(n) * self.gain[0]
                    + if n > 0 { impedance(n - 1) * self.gain[1] } else { Axes::zeros() }
            });
            let push = std::array::from_fn(|n| {
                let hand: Axes<N> = if slips { wish_side * grip[n] } else { wish[n] };
                let mut push = hand - self.device.viscous.component_mul(&v(n));
                for wall in self.pushing(regime) {
                    let surface = if n == 0 { wall.surface } else { 0.0 };
                    let depth = surface - wall.normal.dot(&x[n]);
                    push += wall.normal * (wall.stiffness * depth - wall.damping * wall.normal.dot(&v(n)));
                }
                if n == 0 { push + self.held } else { push }
            });
            Stretch { position: x, wish, push, reach }
        })
    }
}

/// Solution V of `V + k V / |V| = free`, axis by axis; zero if friction stops it.
fn braked<const N: usize>(free: &Axes<N>, k: &Axes<N>) -> Axes<N> {
    // The sum (free / (r + k))² falls with the speed r and is 1 at the solution.
    let excess = |r: f64| free.zip_map(k, |free, k| free / (r + k)).norm_squared() - 1.0;
    let (mut least, mut most) = (0.0, free.norm());
    if excess(least) <= 0.0 {
        return Axes::zeros();
    }
    for _ in 0..60 {
        let middle = 0.5 * (least + most);
        if excess(middle) > 0.0 { least = middle } else { most = middle }
    }
    free.zip_map(k, |free, k| free * (most / (most + k)))
}

fn masked<const N: usize>(mut value: Axes<N>, stuck: &[bool; N]) -> Axes<N> {
    for (value, stuck) in value.iter_mut().zip(stuck) {
        if *stuck {
            *value = 0.0;
        }
    }
    value
}

impl<const N: usize> Stretch<N> {
    pub(crate) fn new() -> Self {
        let none = [Axes::zeros(); TERMS];
        Self { position: none, wish: none, push: none, reach: 0.0 }
    }

    /// `x(t) - x(0)` in m.
    pub(crate) fn displacement(&self, t: f64) -> Axes<N> {
        self.position.iter().skip(1).rev().fold(Axes::zeros(), |sum, x| sum * t + x) * t
    }

    /// `V(t) - V(0)` in m/s.
    pub(crate) fn speed_gained(&self, t: f64) -> Axes<N> {
        let derivatives = self.position.iter().enumerate().skip(2).rev();
        derivatives.fold(Axes::zeros(), |sum, (n, x)| sum * t + x * n as f64) * t
    }

    pub(crate) fn velocity_along(&self, axis: usize) -> Series {
        std::array::from_fn(|n| self.position.get(n + 1).map_or(0.0, |x| (n + 1) as f64 * x[axis]))
    }

    pub(crate) fn position_along(&self, axis: usize) -> Series {
        self.position.map(|x| x[axis])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Path;

    impl<const N: usize> Stretch<N> {
        fn position(&self, t: f64) -> Axes<N> {
            self.position[0] + self.displacement(t)
        }

        fn velocity(&self, t: f64) -> Axes<N> {
            self.position[1] + self.speed_gained(t)
        }
    }

    fn follow(m: f64, d: f64, k: f64, force: f64, x: f64, v: f64) -> Stretch<1> {
        let device = DeviceParameters::<1>::ideal(m, d, 0.0);
        let path = Path::new(Axes::<1>::zeros(), Vec::new()).unwrap();
        let hand = Hand::new(k, 0.0, f64::INFINITY, path, None).unwrap();
        let law = Law {
            device: &device,
            hand: &hand,
            walls: &[],
            held: Axes::<1>::new(force),
            target: &hand.target_series(0.0),
            gain: [1.0, 0.0],
            strength: [0.0; 2],
            wanted: f64::INFINITY,
        };
        let regime = Regime {
            grip: Grip::Holds,
            rub: Rub::Constant(Axes::zeros()),
            stuck: [false],
            pushing: 0,
            straight: None,
        };
        let mut stretch = Stretch::new();
        law.follow(&regime, Axes::<1>::new(x), Axes::<1>::new(v), &mut stretch);
        stretch
    }

    /// Closed forms: constant force, under- and overdamped oscillator, negative damping.
    #[test]
    fn equals_the_closed_forms() {
        let t: f64 = 1e-3;
        let free = follow(0.2, 0.0, 0.0, 3.0, 0.1, -0.4);
        assert!((free.position(t)[0] - (0.1 - 0.4 * t + 15.0 * t * t / 2.0)).abs() < 1e-16);

        let w = (200.0_f64 / 0.157).sqrt();
        let spring = follow(0.157, 0.0, 200.0, 0.0, -0.039, 0.0);
        assert!((spring.position(t)[0] + 0.039 * (w * t).cos()).abs() < 1e-16);
        assert!((spring.velocity(t)[0] - 0.039 * w * (w * t).sin()).abs() < 1e-14);

        for damping in [5.0, -0.005] {
            let drag = follow(0.157, damping, 0.0, 0.0, 0.0, 1.2);
            assert!((drag.velocity(t)[0] - 1.2 * (-damping / 0.157 * t).exp()).abs() < 1e-15);
        }
        // Overdamped: m = 1, d = 50, k = 600 has roots -20 and -30.
        let heavy = follow(1.0, 50.0, 600.0, 0.0, 1.0, 0.0);
        let (a, b) = ((-20.0 * t).exp(), (-30.0 * t).exp());
        assert!((heavy.position(t)[0] - (3.0 * a - 2.0 * b)).abs() < 1e-15);
    }

    #[test]
    fn full_precision_to_its_reach() {
        let spring = follow(0.1, 0.0, 1e5, 0.0, 1.0, 0.0);
        assert!((spring.position(spring.reach)[0] - 0.5_f64.cos()).abs() < 1e-15);
    }

    /// Free motion with friction along it: `|V|` falls by c t / m in a constant direction. With a side force
    /// the energy balance `d(m V²/2) = (F - c V/|V|)·dx` holds over the stretch.
    #[test]
    fn friction_along_the_motion_takes_its_energy() {
        let device = DeviceParameters::<3>::ideal(0.2, 0.0, 0.5);
        let hand = Hand::absent(Axes::<3>::zeros()).unwrap();
        let held = Axes::<3>::new(0.3, -0.8, 0.1);
        let law = Law {
            device: &device,
            hand: &hand,
            walls: &[],
            held,
            target: &hand.target_series(0.0),
            gain: [1.0, 0.0],
            strength: [0.0; 2],
            wanted: f64::INFINITY,
        };
        let regime = Regime {
            grip: Grip::Holds,
            rub: Rub::AlongMotion(0.5),
            stuck: [false; 3],
            pushing: 0,
            straight: None,
        };
        let velocity = Axes::<3>::new(0.4, 0.1, -0.2);
        let mut stretch = Stretch::new();
        law.follow(&regime, Axes::zeros(), velocity, &mut stretch);
        let end = stretch.reach;
        assert!(end > 1e-3, "{end}");
        // Friction's work is -c times the path length, by Simpson's rule on 200 intervals.
        let speed = |i: i32| stretch.velocity(end * f64::from(i) / 200.0).norm();
        let simpson: f64 = (0..=200)
            .map(|i| {
                f64::from(if i == 0 || i == 200 {
                    1
                } else if i % 2 == 1 {
                    4
                } else {
                    2
                }) * speed(i)
            })
            .sum();
        let length = simpson * end / 600.0;
        let gained = 0.1 * (stretch.velocity(end).norm_squared() - velocity.norm_squared());
        let work = held.dot(&stretch.position(end)) - 0.5 * length;
        assert!((gained - work).abs() < 1e-14, "{gained} {work}");
    }
}
