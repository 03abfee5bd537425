//! Device and hand advanced in steps of a classical integrator, for one scenario or for several side by side.

use crate::{
    Axes, ContinuousWall, DeviceParameters, Friction, Hand, ModelError, Real, SteppedHand,
    axes::{gather, gather_axes},
    device::{exerted, quantised},
    require,
};

/// How a step is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum Stepping {
    /// `V += h a(x, V)`, then `x += h V`: order 1, symplectic. Source: Hairer, Lubich and Wanner 2006, I.1.
    SemiImplicitEuler,
    /// Half a kick, drift, half a kick: order 2, symplectic. Source: Swope et al. 1982.
    VelocityVerlet,
    /// The classical method of order 4. Source: Kutta 1901.
    #[cfg_attr(feature = "serde", serde(rename = "rk4"))]
    RungeKutta4,
}

/// Added in m/s and taken away again, it leaves a speed above 1e-84 m/s as it is, bit for bit, and nothing below 1e-117.
const NEGLIGIBLE_SPEED: f64 = 1e-100;

/// Ticks after which [`NEGLIGIBLE_SPEED`] is looked for: friction that takes a speed from 1e-117 to 1e-308 m/s within so many,
/// a thousandth a tick, passes the subnormal numbers in five.
const TICKS_TO_REST: u64 = 64;

/// Device, hand and continuous walls, in steps.
///
/// It computes what [`SimulatedMaster`](crate::SimulatedMaster) solves, for comparison and for batches: no event is
/// located, so friction cannot hold the device at rest but is `c V / V_f` below the speed `V_f`. With a lane type for S
/// each lane is a scenario of its own, and has the bits that it has alone.
#[derive(Clone, Debug)]
pub struct SteppedMaster<const N: usize, S = f64> {
    stepping: Stepping,
    step_s: f64,
    steps: u64,
    now_ns: u64,
    step_ns: f64,
    /// The last time between two reads in ns, and how many steps it holds.
    last_steps: (u64, u64),
    ticks: u64,
    waits: bool,
    /// 1 / m, and 1 / `V_f` below: a division takes longer than all else in a step.
    per_mass: Axes<N, S>,
    viscous: Axes<N, S>,
    coulomb: Axes<N, S>,
    friction: Friction,
    friction_speed: S,
    per_friction_speed: S,
    encoder_quantum: S,
    measures_velocity: bool,
    stops: Option<(Axes<N, S>, Axes<N, S>)>,
    max_force_n: S,
    force_quantum_n: S,
    /// Whether no scenario rounds positions, or forces.
    is_exact: [bool; 2],
    /// Whether no scenario bounds the force.
    is_unbounded: bool,
    hand: SteppedHand<N, S>,
    walls: Vec<SteppedWall<N, S>>,
    held_force: Axes<N, S>,
    position: Axes<N, S>,
    velocity: Axes<N, S>,
    hand_force: Axes<N, S>,
}

#[derive(Clone, Debug)]
struct SteppedWall<const N: usize, S> {
    normal: Axes<N, S>,
    surface: S,
    stiffness: S,
    damping: S,
    is_two_sided: bool,
}

impl<const N: usize> SteppedMaster<N> {
    /// A device at rest where the hand's path starts, at time 0, advanced by `stepping` with steps of `step_s`;
    /// friction is proportional to V below `friction_speed` in m/s (> 0).
    pub fn new(
        device: &DeviceParameters<N>,
        hand: &Hand<N>,
        walls: &[ContinuousWall<N>],
        stepping: Stepping,
        step_s: f64,
        friction_speed: f64,
    ) -> Result<Self, ModelError> {
        device.check()?;
        require("step_s", step_s, step_s > 0.0, "finite and above 0")?;
        require("friction_speed", friction_speed, friction_speed > 0.0, "finite and above 0")?;
        let (lower, upper) = device.stops;
        let has_stops = lower.iter().chain(&upper).any(|stop| stop.is_finite());
        let mut master = Self {
            stepping,
            step_s,
            steps: 0,
            now_ns: 0,
            step_ns: step_s * 1e9,
            last_steps: (0, 0),
            ticks: 0,
            waits: false,
            per_mass: device.mass_kg.map(f64::recip),
            viscous: device.viscous,
            coulomb: device.coulomb,
            friction: device.friction,
            friction_speed,
            per_friction_speed: friction_speed.recip(),
            encoder_quantum: device.encoder_quantum,
            measures_velocity: device.measures_velocity,
            stops: has_stops.then_some((lower, upper)),
            max_force_n: device.max_force_n,
            force_quantum_n: device.force_quantum_n,
            is_exact: [device.encoder_quantum == 0.0, device.force_quantum_n == 0.0],
            is_unbounded: device.max_force_n.is_infinite(),
            hand: SteppedHand::new(hand),
            walls: walls
                .iter()
                .map(|wall| SteppedWall {
                    normal: wall.normal,
                    surface: wall.surface,
                    stiffness: wall.stiffness,
                    damping: wall.damping,
                    is_two_sided: wall.is_two_sided,
                })
                .collect(),
            held_force: Axes::zeros(),
            position: hand.target_at(0.0),
            velocity: Axes::zeros(),
            hand_force: Axes::zeros(),
        };
        master.update_hand_force();
        Ok(master)
    }

    /// Puts the device at x in m with V in m/s.
    pub fn place(&mut self, position: Axes<N>, velocity: Axes<N>) -> Result<(), ModelError> {
        for (x, v) in position.iter().zip(&velocity) {
            require("position", *x, true, "finite")?;
            require("velocity", *v, true, "finite")?;
        }
        (self.position, self.velocity) = (position, velocity);
        self.update_hand_force();
        Ok(())
    }

    /// Several scenarios side by side; none if they differ in what lanes must share: method, step, which walls there
    /// are, how friction acts, the shapes of the path.
    pub fn gather<S: Real>(of: &[&Self]) -> Option<SteppedMaster<N, S>> {
        let first = of.first()?;
        let shares = |one: &Self| {
            let kinds = |master: &Self| {
                (master.stepping, master.step_s, master.steps, master.ticks, master.now_ns, master.friction)
            };
            kinds(one) == kinds(first)
                && one.walls.len() == first.walls.len()
                && one.walls.iter().zip(&first.walls).all(|(a, b)| a.is_two_sided == b.is_two_sided)
                && (one.measures_velocity, one.waits) == (first.measures_velocity, first.waits)
                && one.stops.is_some() == first.stops.is_some()
        };
        if of.len() != S::LANES || !of.iter().all(|one| shares(one)) {
            return None;
        }
        let hands: Vec<_> = of.iter().map(|one| &one.hand).collect();
        let wall = |index: usize| SteppedWall {
            normal: gather_axes(of, |one| one.walls[index].normal),
            surface: gather(of, |one| one.walls[index].surface),
            stiffness: gather(of, |one| one.walls[index].stiffness),
            damping: gather(of, |one| one.walls[index].damping),
            is_two_sided: first.walls[index].is_two_sided,
        };
        let stop = |side: fn(&(Axes<N>, Axes<N>)) -> Axes<N>| {
            gather_axes(of, |one| one.stops.as_ref().map_or(Axes::zeros(), side))
        };
        Some(SteppedMaster {
            stepping: first.stepping,
            step_s: first.step_s,
            steps: first.steps,
            now_ns: first.now_ns,
            step_ns: first.step_ns,
            last_steps: first.last_steps,
            ticks: first.ticks,
            waits: first.waits,
            per_mass: gather_axes(of, |one| one.per_mass),
            viscous: gather_axes(of, |one| one.viscous),
            coulomb: gather_axes(of, |one| one.coulomb),
            friction: first.friction,
            friction_speed: gather(of, |one| one.friction_speed),
            per_friction_speed: gather(of, |one| one.per_friction_speed),
            encoder_quantum: gather(of, |one| one.encoder_quantum),
            measures_velocity: first.measures_velocity,
            stops: first.stops.is_some().then(|| (stop(|stops| stops.0), stop(|stops| stops.1))),
            max_force_n: gather(of, |one| one.max_force_n),
            force_quantum_n: gather(of, |one| one.force_quantum_n),
            is_exact: [0, 1].map(|which| of.iter().all(|one| one.is_exact[which])),
            is_unbounded: of.iter().all(|one| one.is_unbounded),
            hand: SteppedHand::gather(&hands)?,
            walls: (0..first.walls.len()).map(wall).collect(),
            held_force: gather_axes(of, |one| one.held_force),
            position: gather_axes(of, |one| one.position),
            velocity: gather_axes(of, |one| one.velocity),
            hand_force: gather_axes(of, |one| one.hand_force),
        })
    }
}

impl<const N: usize, S: Real> SteppedMaster<N, S> {
    /// Whether the hand waits at the start of its path; once it no longer waits, its time runs from there.
    pub fn set_waiting(&mut self, waits: bool) {
        self.waits = waits;
    }

    /// Sets the clock to `now_ns` without advancing: the device rests until then.
    pub fn begin(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
    }

    /// Advances to `now_ns` (monotonic), by as many whole steps as the time since the last read holds.
    #[inline(always)]
    pub fn advance(&mut self, now_ns: u64) {
        let elapsed_ns = now_ns.saturating_sub(self.now_ns);
        if elapsed_ns == 0 {
            return;
        }
        if elapsed_ns != self.last_steps.0 {
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a time apart, not below 0
            let steps = (elapsed_ns as f64 / self.step_ns).round() as u64;
            self.last_steps = (elapsed_ns, steps);
        }
        self.now_ns = now_ns;
        for _ in 0..self.last_steps.1 {
            self.step();
        }
        self.ticks += 1;
        if self.ticks.is_multiple_of(TICKS_TO_REST) {
            self.rest();
        }
    }

    /// What is left of a motion that friction has ended: below `V_f` it decays and never reaches zero, and would end among
    /// the subnormal numbers, with which a multiplication takes some 150 cycles instead of 4. Now and then, for at each tick
    /// it would be in the way of what follows from V.
    #[inline(always)]
    fn rest(&mut self) {
        let negligible = S::splat(NEGLIGIBLE_SPEED);
        for axis in 0..N {
            self.velocity[axis] = (self.velocity[axis] + negligible) - negligible;
        }
    }

    /// x in m, as the encoder sees it.
    #[inline(always)]
    pub fn measured_position(&self) -> Axes<N, S> {
        if self.is_exact[0] {
            return self.position;
        }
        // A copy and no closure: what a call gets the address of would stand in memory at each tick.
        let mut measured = self.position;
        for axis in 0..N {
            measured[axis] = quantised(measured[axis], self.encoder_quantum, self.is_exact[0]);
        }
        measured
    }

    /// V in m/s, only from a device that measures it.
    #[inline(always)]
    pub fn measured_velocity(&self) -> Option<Axes<N, S>> {
        self.measures_velocity.then_some(self.velocity)
    }

    /// Holds this force in N from now on, as far as the motors exert it.
    #[inline(always)]
    pub fn write(&mut self, force: &Axes<N, S>) {
        self.held_force =
            exerted(force, self.max_force_n, self.force_quantum_n, self.is_exact[1], self.is_unbounded);
    }

    /// True position in m.
    #[inline(always)]
    pub fn position(&self) -> &Axes<N, S> {
        &self.position
    }

    /// True velocity in m/s.
    #[inline(always)]
    pub fn velocity(&self) -> &Axes<N, S> {
        &self.velocity
    }

    /// True force of the hand on the device in N.
    #[inline(always)]
    pub fn hand_force(&self) -> &Axes<N, S> {
        &self.hand_force
    }

    /// Force in N that the motors exert since the last write.
    #[inline(always)]
    pub fn motor_force(&self) -> &Axes<N, S> {
        &self.held_force
    }

    /// True force of the continuous walls on the device in N.
    #[inline(always)]
    pub fn wall_force(&self) -> Axes<N, S> {
        self.forces_of_walls(&self.position, &self.velocity)
    }

    #[inline(always)]
    fn update_hand_force(&mut self) {
        self.hand_force = self.hand.force(self.time(0.0), &self.position, &self.velocity);
    }

    /// Time of the hand in s, `share` of a step from now.
    #[inline(always)]
    fn time(&self, share: f64) -> f64 {
        (self.steps as f64 + share) * self.step_s
    }

    #[inline(always)]
    fn forces_of_walls(&self, position: &Axes<N, S>, velocity: &Axes<N, S>) -> Axes<N, S> {
        let mut force = Axes::<N, S>::zeros();
        let nothing = S::splat(0.0);
        for wall in &self.walls {
            let depth = wall.surface - wall.normal.dot(position);
            let push = wall.stiffness * depth - wall.damping * wall.normal.dot(velocity);
            let acts = if wall.is_two_sided {
                push
            } else {
                push.select(depth.simd_gt(nothing) & push.simd_gt(nothing), nothing)
            };
            force += wall.normal * acts;
        }
        force
    }

    /// `c V / max(|V|, V_f)`.
    #[inline(always)]
    fn friction_force(&self, velocity: &Axes<N, S>) -> Axes<N, S> {
        let one = S::splat(1.0);
        let mut force = Axes::<N, S>::zeros();
        if N == 1 || self.friction == Friction::Axis {
            for axis in 0..N {
                force[axis] =
                    self.coulomb[axis] * (velocity[axis] * self.per_friction_speed).simd_clamp(-one, one);
            }
            return force;
        }
        let per_speed = one / velocity.dot(velocity).root().simd_max(self.friction_speed);
        for axis in 0..N {
            force[axis] = self.coulomb[axis] * (velocity[axis] * per_speed);
        }
        force
    }

    /// a in m/s² under the hand's force.
    #[inline(always)]
    fn acceleration(
        &self,
        hand_force: &Axes<N, S>,
        position: &Axes<N, S>,
        velocity: &Axes<N, S>,
    ) -> Axes<N, S> {
        let mut force = hand_force + self.held_force;
        if !self.walls.is_empty() {
            force += self.forces_of_walls(position, velocity);
        }
        force -= self.viscous.component_mul(velocity);
        force -= self.friction_force(velocity);
        force.component_mul(&self.per_mass)
    }

    #[inline(always)]
    fn acceleration_at(&self, share: f64, position: &Axes<N, S>, velocity: &Axes<N, S>) -> Axes<N, S> {
        let share = if self.waits { 0.0 } else { share };
        let hand_force = self.hand.force(self.time(share), position, velocity);
        self.acceleration(&hand_force, position, velocity)
    }

    #[inline(always)]
    fn step(&mut self) {
        let h = S::splat(self.step_s);
        let half = S::splat(0.5 * self.step_s);
        let (x, v) = (self.position, self.velocity);
        let first = self.acceleration(&self.hand_force, &x, &v);
        match self.stepping {
            Stepping::SemiImplicitEuler => {
                self.velocity = v + first * h;
                self.position = x + self.velocity * h;
            }
            Stepping::VelocityVerlet => {
                let middle = v + first * half;
                self.position = x + middle * h;
                // Damping needs V at the end; half a kick short of it the method would lose an order.
                let last = self.acceleration_at(1.0, &self.position, &(v + first * h));
                self.velocity = middle + last * half;
            }
            Stepping::RungeKutta4 => {
                let v2 = v + first * half;
                let second = self.acceleration_at(0.5, &(x + v * half), &v2);
                let v3 = v + second * half;
                let third = self.acceleration_at(0.5, &(x + v2 * half), &v3);
                let v4 = v + third * h;
                let fourth = self.acceleration_at(1.0, &(x + v3 * h), &v4);
                let (two, sixth) = (S::splat(2.0), S::splat(self.step_s / 6.0));
                self.position = x + (v + v2 * two + v3 * two + v4) * sixth;
                self.velocity = v + (first + second * two + third * two + fourth) * sixth;
            }
        }
        if let Some((lower, upper)) = &self.stops {
            let zero = S::splat(0.0);
            for axis in 0..N {
                let (x, v) = (self.position[axis], self.velocity[axis]);
                let (below, above) = (x.simd_le(lower[axis]), x.simd_ge(upper[axis]));
                self.velocity[axis] = v.simd_max(zero).select(below, v.simd_min(zero).select(above, v));
                self.position[axis] = x.simd_max(lower[axis]).simd_min(upper[axis]);
            }
        }
        if !self.waits {
            self.steps += 1;
        }
        self.update_hand_force();
    }
}
