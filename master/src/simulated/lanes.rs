//! Several simulated masters in lanes. A master with an event in a tick is advanced by itself; results are
//! bit-identical.

use haptether_numeric::{Occupancy, lanes_of, pack};
use nalgebra::{SimdBool as _, SimdValue as _};

use super::{
    Clock, Motion, SimulatedMaster,
    one_step::{Bend, OneStep},
};
use crate::{
    Axes, Hand, Real,
    device::{exerted, quantised_axes},
    hand::gripped,
    propagator::AxisPropagator,
};

/// Measurements of several devices at one tick.
#[derive(Clone, Copy, Debug)]
pub struct MasterLanesSample<const N: usize, S: Real> {
    /// x in m, as encoded.
    pub position: Axes<N, S>,
    /// V in m/s, if the devices measure it.
    pub velocity: Option<Axes<N, S>>,
}

/// Masters in lanes; each behaves exactly as a single [`SimulatedMaster`].
///
/// Lanes require per-axis friction and no walls. The hands need the same path, release and regrasp, and no
/// tremor. Ticks must have equal length and contain no event.
#[derive(Clone, Debug)]
pub struct MasterLanes<const N: usize, S: Real> {
    masters: Vec<SimulatedMaster<N>>,
    /// None if the masters do not qualify for lanes.
    fast: Option<Box<Fast<N, S>>>,
    /// True x in m, V in m/s and force of the hands in N at the last read.
    position: Axes<N, S>,
    velocity: Axes<N, S>,
    hand_force: Axes<N, S>,
    quantum: S,
    is_exact: bool,
    measures_velocity: bool,
}

/// Devices and hands in lanes. Motion and force of [loaded](Occupancy::loaded) lanes are here, those of the others
/// in their masters.
#[derive(Clone, Debug)]
struct Fast<const N: usize, S: Real> {
    /// Common hand with a strength of 1 N; its impedance is not used.
    hand: Hand<N>,
    clock: Clock<N>,
    /// `K_h` in N/m and `B_h` in N s/m.
    impedance: [S; 2],
    /// Grip strength in N.
    strength: S,
    device: DeviceLanes<N, S>,
    maps: [AxisPropagator<S>; N],
    /// Gain, whether the grip has released, and tick length in ns for which the maps hold.
    regime: (f64, bool, u64),
    motion: Motion<N, S>,
    held_force: Axes<N, S>,
    occupancy: Occupancy,
}

#[derive(Clone, Debug)]
struct DeviceLanes<const N: usize, S: Real> {
    viscous: Axes<N, S>,
    coulomb: Axes<N, S>,
    stops: [Axes<N, S>; 2],
    max_force_n: S,
    force_quantum_n: S,
    is_exact: bool,
}

impl<const N: usize, S: Real> MasterLanes<N, S> {
    /// Lanes for masters before their first read. None if there are more masters than lanes, or if only some
    /// measure their velocity.
    pub fn new(masters: Vec<SimulatedMaster<N>>) -> Option<Self> {
        let measures_velocity = masters.first()?.device.measures_velocity;
        let is_alike = |master: &SimulatedMaster<N>| master.device.measures_velocity == measures_velocity;
        if masters.len() > S::LANES || !masters.iter().all(is_alike) {
            return None;
        }
        let mut lanes = Self {
            fast: Fast::gather(&masters).map(Box::new),
            position: Axes::zeros(),
            velocity: Axes::zeros(),
            hand_force: Axes::zeros(),
            quantum: pack(&masters, |master| master.device.encoder_quantum)?,
            is_exact: masters.iter().all(|master| master.device.encoder_quantum == 0.0),
            measures_velocity,
            masters,
        };
        for lane in 0..lanes.masters.len() {
            lanes.copy_state(lane);
        }
        Some(lanes)
    }

    /// Set whether the hands wait at the start of their path; their time runs while they do not wait.
    #[inline(always)] // once per tick
    pub fn set_waiting(&mut self, waits: bool) {
        if self.masters.first().is_some_and(|master| master.clock.waits != waits) {
            self.masters.iter_mut().for_each(|master| master.set_waiting(waits));
            self.fast.iter_mut().for_each(|fast| fast.clock.waits = waits);
        }
    }

    /// Advance the lanes in the mask `lanes` to `now_ns` (monotonic) and return their measurements.
    #[inline(always)] // once per tick, from one place
    pub fn read(&mut self, lanes: u64, now_ns: u64) -> MasterLanesSample<N, S> {
        let mut scalar = lanes;
        if let Some(fast) = &mut self.fast {
            scalar &= !fast.read(lanes, now_ns, &mut self.masters);
            (self.position, self.velocity) = (fast.motion.position, fast.motion.velocity);
            self.hand_force = fast.hand_force();
        }
        if scalar != 0 {
            self.read_scalar(scalar, now_ns);
        }
        let velocity = self.measures_velocity.then_some(self.velocity);
        MasterLanesSample { position: quantised_axes(&self.position, self.quantum, self.is_exact), velocity }
    }

    #[inline(never)] // rare and long
    fn read_scalar(&mut self, lanes: u64, now_ns: u64) {
        for lane in lanes_of(lanes, self.masters.len()) {
            self.masters[lane].read(now_ns);
            self.copy_state(lane);
        }
    }

    /// Copy the visible state of a master into its lane.
    fn copy_state(&mut self, lane: usize) {
        let master = &self.masters[lane];
        self.position.replace(lane, *master.position());
        self.velocity.replace(lane, *master.velocity());
        self.hand_force.replace(lane, master.hand_force());
    }

    /// Hold this force in N for the lanes in the mask `lanes`, as [`SimulatedMaster::write`].
    #[inline(always)] // once per tick
    pub fn write(&mut self, lanes: u64, force: &Axes<N, S>) {
        let mut scalar = lanes;
        if let Some(fast) = &mut self.fast {
            let DeviceLanes { max_force_n, force_quantum_n, is_exact, .. } = fast.device;
            fast.held_force = exerted(force, max_force_n, force_quantum_n, is_exact);
            scalar &= !fast.occupancy.loaded();
        }
        if scalar != 0 {
            for lane in lanes_of(scalar, self.masters.len()) {
                self.masters[lane].write(&force.extract(lane));
            }
        }
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

    /// True force of the hands on the devices in N at the last read.
    #[inline(always)]
    pub fn hand_force(&self) -> &Axes<N, S> {
        &self.hand_force
    }
}

impl<const N: usize, S: Real> Fast<N, S> {
    /// Lanes for masters that qualify; none is loaded yet.
    fn gather(masters: &[SimulatedMaster<N>]) -> Option<Self> {
        let first = masters.first()?;
        let hand = first.hand.with_strength(1.0);
        let is_for_lanes = |one: &SimulatedMaster<N>| {
            !one.device.rubs_along_motion()
                && one.walls.is_empty()
                && one.hand.tremor().is_none()
                && one.hand.full_strength() > 0.0
                && one.hand.moves_as(&first.hand)
                && one.clock.waits == first.clock.waits
                && [one.clock.now_ns, one.clock.hand_ns, one.clock.last_ns] == [first.clock.now_ns, 0, 0]
        };
        if !masters.iter().all(is_for_lanes) {
            return None;
        }
        Some(Self {
            clock: Clock::new(&hand, first.clock.now_ns, first.clock.waits),
            hand,
            impedance: [
                pack(masters, |master| master.hand.stiffness())?,
                pack(masters, |master| master.hand.damping())?,
            ],
            strength: pack(masters, |master| master.hand.full_strength())?,
            device: DeviceLanes {
                viscous: pack(masters, |master| master.device.viscous)?,
                coulomb: pack(masters, |master| master.device.coulomb)?,
                stops: [
                    pack(masters, |master| master.device.stops.0)?,
                    pack(masters, |master| master.device.stops.1)?,
                ],
                max_force_n: pack(masters, |master| master.device.max_force_n)?,
                force_quantum_n: pack(masters, |master| master.device.force_quantum_n)?,
                is_exact: masters.iter().all(|master| master.device.force_quantum_n == 0.0),
            },
            maps: [AxisPropagator::none(); N],
            regime: (f64::NAN, false, 0),
            motion: Motion::at_rest(Axes::zeros()),
            held_force: Axes::zeros(),
            occupancy: Occupancy::new(masters.len()),
        })
    }

    /// Load a master if its map matches the regime.
    fn load(&mut self, lane: usize, master: &SimulatedMaster<N>) {
        let (gain, has_let_go, past_ns) = self.regime;
        let impedance = [master.hand.stiffness(), master.hand.damping()];
        let impedance = if has_let_go { [0.0; 2] } else { impedance.map(|of| gain * of) };
        let is_now = master.clock.now_ns == self.clock.now_ns;
        if !(is_now && master.propagator.is_of(past_ns as f64 * 1e-9, impedance) && master.propagator.reaches)
        {
            return;
        }
        for (map, of) in self.maps.iter_mut().zip(&master.propagator.axes) {
            map.load(lane, of);
        }
        self.motion.position.replace(lane, master.motion.position);
        self.motion.velocity.replace(lane, master.motion.velocity);
        for (lanes, lost) in self.motion.lost.iter_mut().zip(master.motion.lost) {
            lanes.replace(lane, lost);
        }
        self.held_force.replace(lane, master.held_force);
        self.occupancy.load(lane);
    }

    /// Write the state and time of a lane back to its master.
    fn write_back(&self, lane: usize, master: &mut SimulatedMaster<N>) {
        // An infinite strength does not change.
        let full = master.hand.full_strength();
        master.clock = self.clock;
        for of in &mut master.clock.forecast.grip[1] {
            *of = if *of == 0.0 { 0.0 } else { *of * full };
        }
        master.motion = Motion {
            position: self.motion.position.extract(lane),
            velocity: self.motion.velocity.extract(lane),
            lost: self.motion.lost.map(|lost| lost.extract(lane)),
        };
        master.held_force = self.held_force.extract(lane);
    }

    /// Advance the lanes in `lanes` that can be advanced as lanes; return their mask.
    #[inline(always)] // inlined into its caller
    fn read(&mut self, lanes: u64, now_ns: u64, masters: &mut [SimulatedMaster<N>]) -> u64 {
        let past_ns = now_ns.saturating_sub(self.clock.now_ns);
        if past_ns > 0 {
            let [[gain, _], [strength, _]] = self.clock.forecast.grip;
            let regime = (gain, strength == 0.0, past_ns);
            let (before, is_smooth) = (self.occupancy.loaded(), self.clock.is_smooth(past_ns));
            if !is_smooth || regime != self.regime {
                self.leave(before, before, masters);
                self.regime = regime;
            }
            if is_smooth {
                if lanes & !self.occupancy.loaded() != 0 {
                    for lane in lanes_of(self.occupancy.due(lanes), masters.len()) {
                        self.load(lane, &masters[lane]);
                    }
                }
                let (motion, stays) = self.advanced();
                if !stays.all() {
                    self.leave(!stays.bitmask(), before, masters);
                }
                self.motion = motion;
            }
            self.clock.advance(&self.hand, past_ns);
        }
        lanes & self.occupancy.loaded()
    }

    /// Unload lanes, as [`Occupancy::leave`].
    #[inline(never)] // rare
    fn leave(&mut self, lanes: u64, before: u64, masters: &mut [SimulatedMaster<N>]) {
        for lane in lanes_of(self.occupancy.leave(lanes, before), masters.len()) {
            self.write_back(lane, &mut masters[lane]);
        }
    }

    /// Devices and hands at the start of a tick.
    #[inline(always)]
    fn one_step(&self) -> OneStep<'_, N, S> {
        let (_, _, past_ns) = self.regime;
        let [_, [strength, _]] = self.clock.forecast.grip;
        OneStep {
            clock: &self.clock,
            duration: past_ns as f64 * 1e-9,
            motion: &self.motion,
            held_force: &self.held_force,
            impedance: self.impedance,
            strength: S::splat(strength) * self.strength,
            viscous: &self.device.viscous,
            coulomb: &self.device.coulomb,
            stops: self.device.stops.each_ref(),
        }
    }

    /// Motion after a tick, and the mask of lanes without an event in the tick.
    #[inline(always)] // inlined into its caller
    fn advanced(&self) -> (Motion<N, S>, S::SimdBool) {
        let (step, maps) = (self.one_step(), &self.maps);
        let (grip, is_pulled) = step.standing_grip();
        let (push, shift) = (step.push(&grip), self.clock.shift(step.duration, None));
        let (friction, sticks) = step.standing_friction(&push, &grip, &shift);
        let acceleration = step.acceleration(maps, &push, &friction);
        let (motion, _, stays) = step.moved(maps, &grip, &friction, &shift, &acceleration, &Bend::Straight);
        (motion, is_pulled & sticks & stays)
    }

    /// Force of the hands in N, as [`SimulatedMaster::hand_force`].
    #[inline(always)]
    fn hand_force(&self) -> Axes<N, S> {
        let step = self.one_step();
        gripped(&step.wish(), step.strength)
    }
}

#[cfg(test)]
mod tests;
