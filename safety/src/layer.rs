//! The whole chain of one master tick: from a device sample to the force it is told to exert.

use nalgebra::SimdValue as _;

use crate::{
    Axes, DeviceModel, Fault, Observation, ParameterError, Real,
    controller::{Intervention, Response, SafetyController, SafetySettings},
    estimator::{AnyEstimator, Estimator, EstimatorKind, MeasuredVelocity, Motion},
    fault::Signal,
    is_within,
    lanes::{option, pack, part},
    limiter::{Acted, Bounded, Limiter, LimiterSettings},
};

/// How a safety layer is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LayerSettings<const N: usize> {
    /// Dynamics of the device, for the grasp force and the kinetic energy.
    pub device: DeviceModel<N>,
    /// dT in s.
    pub period_s: f64,
    /// How V and A are had from positions, for a device that does not measure its velocity.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device force.
    pub limiter: LimiterSettings,
}

/// What the safety layer saw and decided at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyTick<const N: usize> {
    /// V and A.
    pub motion: Motion<N>,
    /// `F_v` in N as far as the device can render it: what the observers saw.
    pub rendered_force: Axes<N>,
    /// `F_h` in N; zero when no controller reads it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N: what the device is to exert until the next tick.
    pub device_force: Axes<N>,
    /// `F_c` and the observers' values.
    pub intervention: Intervention<N>,
    /// Which bounds acted.
    pub acted: Acted,
    /// Energy in J that PC asked for and the bounds kept it from dissipating.
    pub owed_energy_j: f64,
    /// Why the force is zero, if it is so because of a bad number. Stays until [`SafetyLayer::reset`].
    pub fault: Option<Fault>,
}

/// What the safety layer saw and decided at one tick, in each lane.
#[derive(Clone, Copy, Debug)]
pub struct Advance<const N: usize, S: Real = f64> {
    /// V and A.
    pub motion: Motion<N, S>,
    /// `F_v` in N as far as the device can render it: what the observers saw.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N; zero when no controller reads it.
    pub grasp_force: Axes<N, S>,
    /// `F_v` in N as late as `F_h`.
    pub aligned_rendered_force: Axes<N, S>,
    /// `F_device` in N: what the device is to exert until the next tick.
    pub device_force: Axes<N, S>,
    /// `F_c` and the observers' values.
    pub response: Response<N, S>,
    /// `F_v` and where it was bounded.
    pub rendering: Bounded<N, S>,
    /// `F_device` and where it was bounded.
    pub limited: Bounded<N, S>,
    /// Energy in J that PC asked for and the bounds kept it from dissipating.
    pub owed_energy_j: S,
}

impl<const N: usize, S: Real> Advance<N, S> {
    /// What the observers saw.
    #[inline(always)]
    pub fn seen(&self) -> Observation<N, S> {
        Observation {
            velocity: self.motion.velocity,
            rendered_force: self.rendered_force,
            grasp_force: self.grasp_force,
            aligned_rendered_force: self.aligned_rendered_force,
        }
    }

    /// The tick of one lane.
    #[inline(always)]
    pub fn lane(&self, lane: usize) -> SafetyTick<N> {
        SafetyTick {
            motion: Motion {
                velocity: self.motion.velocity.extract(lane),
                acceleration: self.motion.acceleration.extract(lane),
            },
            rendered_force: self.rendered_force.extract(lane),
            grasp_force: self.grasp_force.extract(lane),
            device_force: self.device_force.extract(lane),
            intervention: self.response.lane(lane),
            acted: self.rendering.acted(lane).and(self.limited.acted(lane)),
            owed_energy_j: self.owed_energy_j.extract(lane),
            fault: None,
        }
    }
}

/// Estimator, grasp force, observers, controllers and limiter in one step.
///
/// The limiter stands at both ends: before the observers, so that they see the force that can be rendered, and after
/// the controllers, so that nothing leaves unbounded.
///
/// Source: paper Eq. 1 to 14, in the order of `docs/architecture.md`, "One master tick".
#[derive(Clone, Debug)]
pub struct SafetyLayer<const N: usize, S = f64> {
    device: DeviceModel<N, S>,
    estimator: AnyEstimator<N, S>,
    measured: MeasuredVelocity<N, S>,
    /// The estimator once more, as the kernel for `F_v`; only where HSC reads it.
    rendered: Option<AnyEstimator<N, S>>,
    last_rendered: Axes<N, S>,
    /// What the device can render of what is asked: norm, growth and ramp-in of `F_v` alone.
    rendering: Limiter<N, S>,
    controller: SafetyController<N, S>,
    /// The bounds on the sum.
    limiter: Limiter<N, S>,
    device_force: Axes<N, S>,
    fault: Option<Fault>,
}

impl<const N: usize> SafetyLayer<N> {
    /// A layer for a device at rest, without force.
    pub fn new(settings: &LayerSettings<N>) -> Result<Self, ParameterError> {
        let LayerSettings { device, period_s, estimator, safety, limiter } = settings;
        Ok(Self {
            device: *device,
            estimator: estimator.build(*period_s)?,
            measured: MeasuredVelocity::new(*period_s)?,
            rendered: safety.hsc.then(|| estimator.build(*period_s)).transpose()?,
            last_rendered: Axes::zeros(),
            controller: SafetyController::new(device, *period_s, safety)?,
            rendering: Limiter::new(*period_s, *limiter)?,
            limiter: Limiter::new(*period_s, LimiterSettings { ramp_in_s: 0.0, ..*limiter })?,
            device_force: Axes::zeros(),
            fault: None,
        })
    }

    /// One tick: position x in m, velocity V in m/s if the device measures it (at every tick or at none), `F_v`
    /// in N.
    ///
    /// A number that is not finite or absurd gives zero force at this tick and a fault that stays until
    /// [`reset`](Self::reset).
    pub fn tick(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        rendered_force: &Axes<N>,
    ) -> SafetyTick<N> {
        self.tick_with_authority(position, velocity, rendered_force, 1.0)
    }

    /// As [`tick`](Self::tick), with the controllers' damping in the share `authority` (0 to 1) only.
    pub fn tick_with_authority(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        rendered_force: &Axes<N>,
        authority: f64,
    ) -> SafetyTick<N> {
        let door = match self.fault {
            Some(fault) => Err(fault),
            None => Signal::Position
                .check(position)
                .and_then(|()| velocity.map_or(Ok(()), |v| Signal::Velocity.check(v)))
                .and_then(|()| Signal::RenderedForce.check(rendered_force)),
        };
        let perceived = door.and_then(|()| {
            let perceived = self.perceive(position, velocity, rendered_force);
            perceived.seen.check().map(|()| perceived)
        });
        match perceived {
            Ok(perceived) => self.act(&perceived, authority).lane(0),
            Err(fault) => self.stop(fault),
        }
    }

    /// A tick that was missed: the device has kept its force, and was at `position` (between two samples) by then.
    ///
    /// Estimator and observers are carried along, so that a late loop does not read several ticks of motion as one;
    /// nothing is decided. The next [`tick`](Self::tick) refuses what is not finite.
    pub fn missed(&mut self, position: &Axes<N>, velocity: Option<&Axes<N>>) {
        if self.fault.is_none() && is_within(position, Signal::Position.bound()) {
            let rendered_force = self.last_rendered;
            let (_, seen) = self.observe(position, velocity, &rendered_force);
            // A bad number would be met again at the tick, which names it.
            let _ = self.controller.step(&seen);
        }
    }

    /// Renders no force from now on, until [`reset`](Self::reset): a fault that only others can see.
    pub fn fail(&mut self, fault: Fault) {
        self.fault.get_or_insert(fault);
    }

    fn stop(&mut self, fault: Fault) -> SafetyTick<N> {
        self.fault = Some(fault);
        self.device_force = Axes::zeros();
        self.rendering.reset();
        self.limiter.reset();
        SafetyTick {
            motion: Motion { velocity: Axes::zeros(), acceleration: Axes::zeros() },
            rendered_force: Axes::zeros(),
            grasp_force: Axes::zeros(),
            device_force: Axes::zeros(),
            intervention: Intervention::none(),
            acted: Acted::default(),
            owed_energy_j: 0.0,
            fault: Some(fault),
        }
    }

    /// Forgets the past as [`reset`](Self::reset) does, but keeps a fault.
    pub fn restart(&mut self, position: &Axes<N>) -> Result<(), Fault> {
        let fault = self.fault;
        let restarted = self.reset(position);
        self.fault = fault;
        restarted
    }

    /// Clears a fault and the past: the device rests at `position`, and its force rises from zero again.
    pub fn reset(&mut self, position: &Axes<N>) -> Result<(), Fault> {
        Signal::Position.check(position)?;
        self.rest_at(position);
        self.fault = None;
        Ok(())
    }
}

impl<const N: usize, S: Real> SafetyLayer<N, S> {
    /// As many layers as there are lanes, without fault, whose parts can be gathered; else None. Period, estimator
    /// and what is watched must be the same in all; thresholds, bounds, times and the device need not.
    pub fn gather(of: &[SafetyLayer<N>]) -> Option<Self> {
        if of.iter().any(|one| one.fault.is_some()) {
            return None;
        }
        Some(Self {
            device: part(of, |one| one.device, DeviceModel::gather)?,
            estimator: part(of, |one| one.estimator.clone(), AnyEstimator::gather)?,
            measured: part(of, |one| one.measured.clone(), MeasuredVelocity::gather)?,
            rendered: option(of, |one| one.rendered.clone(), AnyEstimator::gather)?,
            last_rendered: pack(of, |one| one.last_rendered)?,
            rendering: part(of, |one| one.rendering.clone(), Limiter::gather)?,
            controller: part(of, |one| one.controller.clone(), SafetyController::gather)?,
            limiter: part(of, |one| one.limiter.clone(), Limiter::gather)?,
            device_force: pack(of, |one| one.device_force)?,
            fault: None,
        })
    }

    /// One tick as [`tick_with_authority`](SafetyLayer::tick_with_authority), in each lane and without its door: a bad
    /// number stops nothing. Where [`Advance::seen`] does not [pass](Observation::passes), or a number that is given
    /// here would not, the checked tick would have stopped.
    #[inline(always)]
    pub fn advance(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
        authority: S,
    ) -> Advance<N, S> {
        let perceived = self.perceive(position, velocity, rendered_force);
        self.act(&perceived, authority)
    }

    #[inline(always)]
    fn perceive(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> Perceived<N, S> {
        // The observers compare F_v with the hand. A force that the device cannot or must not render yet would look
        // like one that nobody holds, so F_v is bounded before it is observed. At V = 0 the power bound is idle.
        let rendering = self.rendering.limit(rendered_force, &Axes::zeros());
        let (motion, seen) = self.observe(position, velocity, &rendering.force);
        Perceived { rendering, motion, seen }
    }

    #[inline(always)]
    fn act(&mut self, perceived: &Perceived<N, S>, authority: S) -> Advance<N, S> {
        let Perceived { rendering, motion, seen } = *perceived;
        let response = self.controller.respond(&seen, authority);
        let rendered_force = seen.rendered_force;
        let limited = self.limiter.limit(&(rendered_force + response.safety_force), &motion.velocity);
        let delivered = limited.force - rendered_force;
        let owed_energy_j = self.controller.owed_energy_j(response.energy_j, &delivered, &motion.velocity);
        self.device_force = limited.force;
        Advance {
            motion,
            rendered_force,
            grasp_force: seen.grasp_force,
            aligned_rendered_force: seen.aligned_rendered_force,
            device_force: limited.force,
            response,
            rendering,
            limited,
            owed_energy_j,
        }
    }

    /// V and A, and what the observers see of them.
    #[inline(always)]
    fn observe(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> (Motion<N, S>, Observation<N, S>) {
        let motion = match velocity {
            Some(velocity) => self.measured.step(velocity),
            None => self.estimator.step(position),
        };
        let grasp_force = if self.controller.needs_grasp_force() {
            let aligned = match velocity {
                Some(_) => self.measured.align(&self.device_force),
                None => self.estimator.align(&self.device_force),
            };
            self.device.grasp_force(&motion, &aligned)
        } else {
            Axes::zeros()
        };
        let aligned_rendered_force = self.align_rendered(position, velocity, rendered_force);
        let seen = Observation {
            velocity: motion.velocity,
            rendered_force: *rendered_force,
            grasp_force,
            aligned_rendered_force,
        };
        (motion, seen)
    }

    /// `F_v` of the past ticks through the kernel of A, only where an observer compares it with `F_h`.
    #[inline(always)]
    fn align_rendered(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> Axes<N, S> {
        let last = std::mem::replace(&mut self.last_rendered, *rendered_force);
        match (&mut self.rendered, velocity) {
            // F_h is a mean over the last tick, in which the last force was rendered.
            (Some(_), Some(_)) => last,
            (Some(kernel), None) => {
                // A kernel that depends on the motion must see the same motion.
                kernel.step(position);
                kernel.align(&last)
            }
            (None, _) => *rendered_force,
        }
    }

    /// Forgets the past: the device rests at `position`, and its force rises from zero again.
    pub fn rest_at(&mut self, position: &Axes<N, S>) {
        self.estimator.reset(position);
        self.measured.reset();
        if let Some(kernel) = &mut self.rendered {
            kernel.reset(position);
        }
        self.last_rendered = Axes::zeros();
        self.controller.reset();
        self.rendering.reset();
        self.limiter.reset();
        self.device_force = Axes::zeros();
    }
}

/// What is known before the controllers decide.
#[derive(Clone, Copy)]
struct Perceived<const N: usize, S: Real> {
    rendering: Bounded<N, S>,
    motion: Motion<N, S>,
    seen: Observation<N, S>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controller::Tripped;

    const PERIOD: f64 = 1e-3;
    const MASS: f64 = 0.157;

    fn settings(safety: SafetySettings) -> LayerSettings<1> {
        LayerSettings {
            device: DeviceModel::uniform(MASS, 0.0, 0.0).unwrap(),
            period_s: PERIOD,
            estimator: EstimatorKind::default(),
            safety,
            limiter: LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() },
        }
    }

    /// A free mass under the layer's force, with an encoder; `F_v` = 5 N from the start, nobody holds.
    fn ejected_trips(force_seen_by_eq_4: impl Fn(f64) -> f64) -> Vec<bool> {
        let safety = SafetySettings { hsc: true, ..SafetySettings::default() };
        let settings = settings(safety);
        let mut controller = SafetyController::<1>::new(&settings.device, PERIOD, &safety).unwrap();
        let mut estimator = settings.estimator.build::<1>(PERIOD).unwrap();
        let mut kernel_of_rendered = estimator.clone();
        let (mut x, mut v) = (0.0_f64, 0.0);
        let (mut told, rendered) = (None, Axes::<1>::new(5.0));
        let mut trips = Vec::new();
        for _ in 0..200 {
            let encoded = Axes::<1>::new((x / 2.3e-5).round() * 2.3e-5);
            // The same chain, with another idea of which force Eq. 4 subtracts.
            let motion = estimator.step(&encoded);
            kernel_of_rendered.step(&encoded);
            let of_eq_4 = told.map_or(0.0, &force_seen_by_eq_4);
            let aligned = estimator.align(&Axes::<1>::new(of_eq_4));
            let grasp_force = settings.device.grasp_force(&motion, &aligned);
            let mut seen = Observation::exact(motion.velocity, rendered, grasp_force);
            seen.aligned_rendered_force = kernel_of_rendered.align(&told.map_or(Axes::zeros(), |_| rendered));
            let step = controller.step(&seen).unwrap();
            trips.push(step.tripped.any());
            let force = 5.0 + step.safety_force[0];
            told = Some(force);
            x += v * PERIOD + force / MASS * PERIOD * PERIOD / 2.0;
            v += force / MASS * PERIOD;
        }
        trips
    }

    #[test]
    fn with_f_v_alone_hsc_switches_itself_off() {
        let all_told = ejected_trips(|told| told);
        let rendered_only = ejected_trips(|_| 5.0);
        let on = |trips: &[bool]| trips[50..].iter().filter(|&&on| on).count();
        assert_eq!(on(&all_told), 150, "once nobody holds, HSC stays on");
        // Its own damping cancels F_v; with F_v alone, that looks like a hand that pushes back with 5 N.
        assert!(on(&rendered_only) < 100, "{}", on(&rendered_only));
    }

    /// Ticks on which HSC trips while a braced hand (1500 N/m, 20 N s/m) meets a wall of 200 N/m and holds on.
    fn trips_at_contact(measures_velocity: bool) -> usize {
        let safety = SafetySettings { hsc: true, hsc_force_threshold_n: 0.5, ..SafetySettings::default() };
        let mut layer = SafetyLayer::new(&settings(safety)).unwrap();
        let (speed, mut x) = (0.15, 0.01_f64);
        let (mut v, mut force, mut trips) = (-speed, 0.0, 0);
        for n in 0..1500 {
            let seen = if measures_velocity { x } else { (x / 2.3e-5).round() * 2.3e-5 };
            let rendered = Axes::<1>::new((-200.0 * seen).max(0.0));
            let velocity = Axes::<1>::new(v);
            let tick = layer.tick(&Axes::<1>::new(seen), measures_velocity.then_some(&velocity), &rendered);
            trips += usize::from(tick.intervention.tripped.any());
            force = tick.device_force[0];
            // Ten steps a tick: the hand is no part of the servo loop.
            for step in 0..10 {
                let target = 0.01 - speed * (f64::from(n) + f64::from(step) / 10.0) * PERIOD;
                let hand = 1500.0 * (target.max(-0.03) - x) - 20.0 * v;
                v += (force + hand) / MASS * PERIOD / 10.0;
                x += v * PERIOD / 10.0;
            }
        }
        assert!(force > 2.0, "the wall was met");
        trips
    }

    #[test]
    fn a_late_estimate_is_no_release() {
        // Exact signals show a hand all the time; so must estimated ones, although they lag by 8 ms.
        assert_eq!((trips_at_contact(true), trips_at_contact(false)), (0, 0));
    }

    /// Nothing may trip while a hand holds on: a step of the remote force, beyond the cap, during the ramp-in.
    #[test]
    fn a_bounded_force_is_no_release() {
        let safety = SafetySettings { hsc: true, ..SafetySettings::default() };
        let limiter = LimiterSettings { max_force_n: 4.0, ramp_in_s: 0.05, ..LimiterSettings::default() };
        let mut layer = SafetyLayer::new(&LayerSettings { limiter, ..settings(safety) }).unwrap();
        let still = Axes::<1>::zeros();
        for n in 0..300 {
            let asked = Axes::<1>::new(if n < 100 { 1.0 } else { 30.0 });
            let tick = layer.tick(&still, Some(&still), &asked);
            assert!(!tick.intervention.tripped.any(), "tick {n}: S_h = {}", tick.intervention.grasp);
            assert!(n < 105 || (tick.device_force[0] - 4.0).abs() < 1e-12);
        }
    }

    /// 4 N are rendered all the time; a hand holds, lets go for 50 ms, and is back for good.
    #[test]
    fn a_hand_that_is_back_gets_its_force_back_over_the_ramp() {
        let safety = SafetySettings {
            hsc: true,
            hsc_force_threshold_n: 0.5,
            hold_off_s: 0.1,
            release_ramp_s: 0.2,
            ..SafetySettings::default()
        };
        let mut layer = SafetyLayer::new(&settings(safety)).unwrap();
        let rendered = Axes::<1>::new(4.0);
        let (mut x, mut v, mut largest_step, mut last) = (0.0, 0.0, 0.0_f64, 0.0);
        let mut states = Vec::new();
        for n in 0..1500 {
            let (at, moving) = (Axes::<1>::new(x), Axes::<1>::new(v));
            let tick = layer.tick(&at, Some(&moving), &rendered);
            let force = tick.device_force[0];
            if n > 10 {
                largest_step = largest_step.max(force - last);
            }
            last = force;
            states.push((tick.intervention.tripped, force));
            for _ in 0..10 {
                let hand = if (500..550).contains(&n) { 0.0 } else { -400.0 * x - 15.0 * v };
                v += (force + hand) / MASS * PERIOD / 10.0;
                x += v * PERIOD / 10.0;
            }
        }
        assert!(!states[499].0.any() && (states[499].1 - 4.0).abs() < 1e-9, "held: all is rendered");
        assert!(
            states[500..550].iter().any(|(tripped, _)| tripped.contains(Tripped::HSC)),
            "let go: it trips"
        );
        assert!(!states[1499].0.any() && (states[1499].1 - 4.0).abs() < 1e-9, "back: all is rendered again");
        assert!(largest_step < 0.3, "over the ramp, not as a step: {largest_step} N");
    }

    #[test]
    fn a_late_loop_does_not_read_several_ticks_as_one() {
        // 0.3 m/s under no force; ticks 100 to 107 are missed.
        let safety = SafetySettings { wsc: true, ..SafetySettings::default() };
        let sample = |n: i32| Axes::<1>::new((3e-4 * f64::from(n) / 2.3e-5).round() * 2.3e-5);
        let mut carried = SafetyLayer::new(&settings(safety)).unwrap();
        let mut blind = carried.clone();
        let none = Axes::zeros();
        for n in 0..100 {
            carried.tick(&sample(n), None, &none);
            blind.tick(&sample(n), None, &none);
        }
        for n in 100..108 {
            carried.missed(&sample(n), None);
        }
        let worst = |layer: &mut SafetyLayer<1>| {
            (108..130).map(|n| layer.tick(&sample(n), None, &none).grasp_force[0].abs()).fold(0.0, f64::max)
        };
        assert!(worst(&mut carried) < 0.5);
        assert!(worst(&mut blind) > 5.0, "else the test shows nothing");
    }

    #[test]
    fn bad_numbers_stop_at_the_door_in_the_same_tick_and_stay_stopped() {
        let good = Axes::<1>::new(0.0);
        for (x, v, f, name) in [
            (f64::NAN, 0.0, 0.0, "position is not a finite number"),
            (2e3, 0.0, 0.0, "position exceeds 1000 m"),
            (0.0, f64::INFINITY, 0.0, "velocity is not a finite number"),
            (0.0, 0.0, f64::NAN, "rendered force is not a finite number"),
            (0.0, 0.0, -2e4, "rendered force exceeds 10000 N"),
        ] {
            let mut layer = SafetyLayer::new(&settings(SafetySettings::default())).unwrap();
            let push = Axes::<1>::new(1.0);
            for _ in 0..5 {
                layer.tick(&good, Some(&good), &push);
            }
            assert!(layer.tick(&good, Some(&good), &push).device_force[0] > 0.9);
            let (x, v, f) = (Axes::<1>::new(x), Axes::<1>::new(v), Axes::<1>::new(f));
            for _ in 0..3 {
                let tick = layer.tick(&x, Some(&v), &f);
                assert_eq!(tick.device_force[0], 0.0);
                assert_eq!(tick.fault.unwrap().to_string(), name);
            }
            assert!(layer.tick(&good, Some(&good), &push).fault.is_some(), "latched");
            layer.reset(&good).unwrap();
            assert!(layer.tick(&good, Some(&good), &push).fault.is_none());
        }
    }

    #[test]
    fn without_a_controller_the_rendered_force_passes() {
        let mut layer = SafetyLayer::new(&settings(SafetySettings::default())).unwrap();
        let still = Axes::<1>::zeros();
        for n in 0..10 {
            let tick = layer.tick(&still, Some(&still), &Axes::<1>::new(0.3 * f64::from(n)));
            assert!((tick.device_force[0] - 0.3 * f64::from(n)).abs() < 1e-12);
            assert!(!tick.intervention.tripped.any());
        }
    }
}
