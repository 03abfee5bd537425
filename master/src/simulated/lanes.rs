//! Several simulated masters in lanes. A master with an event in a tick is advanced by itself; results are
//! bit-identical.

use nalgebra::SimdBool as _;

use super::{SimulatedMaster, add_one};
use crate::{
    Axes, Hand, Real,
    axes::norm,
    device::{exerted, quantised},
    propagator::{AxisPropagator, Outlook},
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
    /// State at the last read.
    motion: Motion<N, S>,
    /// True force of the hands in N.
    hand_force: Axes<N, S>,
    quantum: S,
    is_exact: bool,
    measures_velocity: bool,
}

/// x in m and V in m/s.
#[derive(Clone, Copy, Debug)]
struct Motion<const N: usize, S: Real> {
    position: Axes<N, S>,
    velocity: Axes<N, S>,
}

/// Devices and hands in lanes. Motion and force of [loaded](Self::loaded) lanes are here, those of the others
/// in their masters.
#[derive(Clone, Debug)]
struct Fast<const N: usize, S: Real> {
    /// Common hand with a strength of 1 N; its impedance is not used.
    hand: Hand<N>,
    outlook: Outlook<N>,
    waits: bool,
    time: f64,
    hand_ns: u64,
    now_ns: u64,
    last_ns: u64,
    /// `K_h` in N/m, `B_h` in N s/m and grip strength in N.
    stiffness: S,
    damping: S,
    strength: S,
    device: DeviceLanes<N, S>,
    maps: [AxisPropagator<S>; N],
    /// Gain, whether the grip has released, and tick length in s for which the maps hold.
    regime: (f64, bool, f64),
    motion: Motion<N, S>,
    lost: [Axes<N, S>; 2],
    held_force: Axes<N, S>,
    /// Mask of the loaded lanes.
    loaded: u64,
    absences: Vec<Absence>,
}

/// Most ticks for which a master stays out of its lane after a failed attempt.
const MAX_ABSENCE: u32 = 64;

/// Ticks for which a master stays out of its lane.
#[derive(Clone, Copy, Debug, Default)]
struct Absence {
    /// Ticks left.
    left: u32,
    /// Ticks at its start.
    whole: u32,
}

impl Absence {
    /// Start an absence, twice as long as the last unless the lane was used since.
    fn begin(&mut self, was_used: bool) {
        self.whole = if was_used { 1 } else { (2 * self.whole).clamp(1, MAX_ABSENCE) };
        self.left = self.whole;
    }

    /// Count one tick; return true once the absence is over.
    fn step(&mut self) -> bool {
        self.left = self.left.saturating_sub(1);
        self.left == 0
    }
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
            motion: Motion { position: Axes::zeros(), velocity: Axes::zeros() },
            hand_force: Axes::zeros(),
            quantum: number(&masters, |master| master.device.encoder_quantum),
            is_exact: masters.iter().all(|master| master.device.encoder_quantum == 0.0),
            measures_velocity,
            masters,
        };
        for lane in 0..lanes.masters.len() {
            lanes.look(lane);
        }
        Some(lanes)
    }

    /// Set whether the hands wait at the start of their path; their time runs while they do not wait.
    #[inline(always)] // once per tick
    pub fn set_waiting(&mut self, waits: bool) {
        if self.masters.first().is_some_and(|master| master.waits != waits) {
            self.masters.iter_mut().for_each(|master| master.waits = waits);
            self.fast.iter_mut().for_each(|fast| fast.waits = waits);
        }
    }

    /// Advance the lanes in the mask `lanes` to `now_ns` (monotonic) and return their measurements.
    #[inline(always)] // once per tick, from one place
    pub fn read(&mut self, lanes: u64, now_ns: u64) -> MasterLanesSample<N, S> {
        let mut alone = lanes;
        if let Some(fast) = &mut self.fast {
            alone &= !fast.read(lanes, now_ns, &mut self.masters);
            self.motion = fast.motion;
            self.hand_force = fast.hand_force();
        }
        if alone != 0 {
            self.read_alone(alone, now_ns);
        }
        let Motion { position, velocity } = self.motion;
        let mut measured = position;
        for axis in 0..N {
            measured[axis] = quantised(position[axis], self.quantum, self.is_exact);
        }
        MasterLanesSample { position: measured, velocity: self.measures_velocity.then_some(velocity) }
    }

    #[inline(never)] // rare and long
    fn read_alone(&mut self, lanes: u64, now_ns: u64) {
        for lane in lanes_of(lanes, self.masters.len()) {
            self.masters[lane].read(now_ns);
            self.look(lane);
        }
    }

    /// Copy the visible state of a master into its lane.
    fn look(&mut self, lane: usize) {
        let master = &self.masters[lane];
        set(&mut self.motion.position, lane, &master.position);
        set(&mut self.motion.velocity, lane, &master.velocity);
        set(&mut self.hand_force, lane, &master.hand_force());
    }

    /// Hold this force in N for the lanes in the mask `lanes`, as [`SimulatedMaster::write`].
    #[inline(always)] // once per tick
    pub fn write(&mut self, lanes: u64, force: &Axes<N, S>) {
        let mut alone = lanes;
        if let Some(fast) = &mut self.fast {
            fast.write(force);
            alone &= !fast.loaded;
        }
        if alone != 0 {
            for lane in lanes_of(alone, self.masters.len()) {
                self.masters[lane].write(&of_lane(force, lane));
            }
        }
    }

    /// True position in m.
    #[inline(always)]
    pub fn position(&self) -> &Axes<N, S> {
        &self.motion.position
    }

    /// True velocity in m/s.
    #[inline(always)]
    pub fn velocity(&self) -> &Axes<N, S> {
        &self.motion.velocity
    }

    /// True force of the hands on the devices in N at the last read.
    #[inline(always)]
    pub fn hand_force(&self) -> &Axes<N, S> {
        &self.hand_force
    }
}

fn lanes_of(mask: u64, count: usize) -> impl Iterator<Item = usize> {
    (0..count).filter(move |lane| mask >> lane & 1 == 1)
}

fn set<const N: usize, S: Real>(lanes: &mut Axes<N, S>, lane: usize, value: &Axes<N>) {
    for axis in 0..N {
        lanes[axis].replace(lane, value[axis]);
    }
}

fn of_lane<const N: usize, S: Real>(lanes: &Axes<N, S>, lane: usize) -> Axes<N> {
    Axes::from_fn(|axis, _| lanes[axis].extract(lane))
}

/// One number per master; 1 in unused lanes.
fn number<const N: usize, S: Real>(
    of: &[SimulatedMaster<N>],
    number: impl Fn(&SimulatedMaster<N>) -> f64,
) -> S {
    let mut lanes = S::one();
    for (lane, one) in of.iter().enumerate() {
        lanes.replace(lane, number(one));
    }
    lanes
}

#[inline(always)]
fn everywhere<S: Real>() -> S::SimdBool {
    S::zero().simd_le(S::zero())
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
                && one.waits == first.waits
                && [one.now_ns, one.hand_ns, one.last_ns] == [first.now_ns, 0, 0]
        };
        if !masters.iter().all(is_for_lanes) {
            return None;
        }
        let axes = |of: &dyn Fn(&SimulatedMaster<N>, usize) -> f64| {
            Axes::<N, S>::from_fn(|axis, _| number(masters, |master| of(master, axis)))
        };
        Some(Self {
            outlook: Outlook::new(&hand, 0.0),
            hand,
            waits: first.waits,
            time: 0.0,
            hand_ns: 0,
            now_ns: first.now_ns,
            last_ns: 0,
            stiffness: number(masters, |master| master.hand.stiffness()),
            damping: number(masters, |master| master.hand.damping()),
            strength: number(masters, |master| master.hand.full_strength()),
            device: DeviceLanes {
                viscous: axes(&|master, axis| master.device.viscous[axis]),
                coulomb: axes(&|master, axis| master.device.coulomb[axis]),
                stops: [
                    axes(&|master, axis| master.device.stops.0[axis]),
                    axes(&|master, axis| master.device.stops.1[axis]),
                ],
                max_force_n: number(masters, |master| master.device.max_force_n),
                force_quantum_n: number(masters, |master| master.device.force_quantum_n),
                is_exact: masters.iter().all(|master| master.device.force_quantum_n == 0.0),
            },
            maps: [AxisPropagator::none(); N],
            regime: (f64::NAN, false, 0.0),
            motion: Motion { position: Axes::zeros(), velocity: Axes::zeros() },
            lost: [Axes::zeros(); 2],
            held_force: Axes::zeros(),
            loaded: 0,
            absences: vec![Absence::default(); masters.len()],
        })
    }

    /// Load a master if its map matches the regime.
    fn load(&mut self, lane: usize, master: &SimulatedMaster<N>) {
        let (gain, has_let_go, duration) = self.regime;
        let impedance = [master.hand.stiffness(), master.hand.damping()];
        let impedance = if has_let_go { [0.0; 2] } else { impedance.map(|of| gain * of) };
        if !(master.propagator.is_of(duration, impedance) && master.propagator.reaches) {
            return;
        }
        for (map, of) in self.maps.iter_mut().zip(&master.propagator.axes) {
            map.load(lane, of);
        }
        set(&mut self.motion.position, lane, &master.position);
        set(&mut self.motion.velocity, lane, &master.velocity);
        for (lanes, lost) in self.lost.iter_mut().zip(&master.lost) {
            set(lanes, lane, lost);
        }
        set(&mut self.held_force, lane, &master.held_force);
        self.loaded |= 1 << lane;
    }

    /// Write the state and time of a lane back to its master.
    fn give_back(&mut self, lane: usize, master: &mut SimulatedMaster<N>) {
        self.loaded &= !(1 << lane);
        (master.time, master.hand_ns, master.now_ns, master.last_ns) =
            (self.time, self.hand_ns, self.now_ns, self.last_ns);
        let [gain, strength] = self.outlook.grip;
        // An infinite strength does not change.
        let full = master.hand.full_strength();
        let strength = strength.map(|of| if of == 0.0 { 0.0 } else { of * full });
        master.outlook = self.outlook;
        master.outlook.grip = [gain, strength];
        master.position = of_lane(&self.motion.position, lane);
        master.velocity = of_lane(&self.motion.velocity, lane);
        master.lost = self.lost.each_ref().map(|lost| of_lane(lost, lane));
        master.held_force = of_lane(&self.held_force, lane);
    }

    /// Hold the force, as [`SimulatedMaster::write`].
    #[inline(always)] // once per tick
    fn write(&mut self, force: &Axes<N, S>) {
        let zero = S::zero();
        let finite = force.iter().fold(everywhere::<S>(), |all, x| all & (*x * zero).simd_eq(zero));
        let mut commanded = *force;
        for axis in 0..N {
            commanded[axis] = force[axis].select(finite, zero);
        }
        let DeviceLanes { max_force_n, force_quantum_n, is_exact, .. } = self.device;
        self.held_force = exerted(&commanded, max_force_n, force_quantum_n, is_exact);
    }

    /// Advance the lanes in `lanes` that can be advanced as lanes; return their mask.
    #[inline(always)] // inlined into its caller
    fn read(&mut self, lanes: u64, now_ns: u64, masters: &mut [SimulatedMaster<N>]) -> u64 {
        let past_ns = now_ns.saturating_sub(self.now_ns);
        if past_ns > 0 {
            let duration = past_ns as f64 * 1e-9;
            let [gain, strength] = self.outlook.grip;
            let regime = (gain[0], strength[0] == 0.0, duration);
            let is_smooth = gain[1] == 0.0
                && strength[1] == 0.0
                && past_ns == self.last_ns
                && duration <= self.outlook.until - self.outlook.time;
            let before = self.loaded;
            if !is_smooth || regime != self.regime {
                self.leave(before, before, masters);
                self.regime = regime;
            }
            if is_smooth {
                if lanes & !self.loaded != 0 {
                    self.load_all(lanes & !self.loaded, masters);
                }
                let (motion, lost, stays) = self.advanced();
                let fails = if stays.all() { 0 } else { self.loaded & !stays.bitmask() };
                if fails != 0 {
                    self.leave(fails, before, masters);
                }
                (self.motion, self.lost) = (motion, lost);
            }
            self.last_ns = past_ns;
            if !self.waits {
                self.hand_ns += past_ns;
                self.time = self.hand_ns as f64 / 1e9;
            }
            self.outlook.advance(&self.hand, self.time, past_ns);
            self.now_ns = now_ns;
        }
        lanes & self.loaded
    }

    #[inline(never)] // rare
    fn load_all(&mut self, lanes: u64, masters: &[SimulatedMaster<N>]) {
        for lane in lanes_of(lanes, masters.len()) {
            if self.absences[lane].step() && masters[lane].now_ns == self.now_ns {
                self.load(lane, &masters[lane]);
            }
        }
    }

    /// Unloads lanes that cannot be advanced over this tick. A lane without a successful tick since its load
    /// (not in `before`) stays out longer each time.
    #[inline(never)] // rare
    fn leave(&mut self, lanes: u64, before: u64, masters: &mut [SimulatedMaster<N>]) {
        for lane in lanes_of(lanes, masters.len()) {
            self.give_back(lane, &mut masters[lane]);
            self.absences[lane].begin(before >> lane & 1 == 1);
        }
    }

    /// Motion after a tick, its rounding errors, and the mask of lanes without an event in the tick;
    /// bit-identical to [`SimulatedMaster::propagates`].
    #[inline(always)] // inlined into its caller
    fn advanced(&self) -> (Motion<N, S>, [Axes<N, S>; 2], S::SimdBool) {
        let (zero, above) = (S::zero(), S::splat(1.0 + 1e-12));
        let (gain, has_let_go, duration) = self.regime;
        let (Motion { mut position, mut velocity }, mut lost) = (self.motion, self.lost);
        let mut stays = everywhere::<S>();
        let mut wish = self.wish(gain);
        let mut impedance = [S::splat(gain) * self.stiffness, S::splat(gain) * self.damping];
        if has_let_go {
            let pulls = wish.iter().fold(!everywhere::<S>(), |any, x| any | x.simd_ne(zero));
            stays = (self.stiffness + self.damping).simd_eq(zero) | pulls;
            (wish, impedance) = (Axes::zeros(), [zero; 2]);
        }
        let moves = !self.waits && self.outlook.moves;
        let shift = if moves { self.outlook.most_moved(duration) } else { Axes::zeros() };
        let step = S::splat(duration);
        let (mut most_moved, mut most_gained) = (Axes::<N, S>::zeros(), Axes::<N, S>::zeros());
        for axis in 0..N {
            let (x, v, map) = (position[axis], velocity[axis], &self.maps[axis]);
            let [lower, upper] = [self.device.stops[0][axis], self.device.stops[1][axis]];
            let (coulomb, shift) = (self.device.coulomb[axis], S::splat(shift[axis]));
            let push = self.held_force[axis] + wish[axis];
            let most_pulled = shift * (impedance[0] * above);
            let (rubs, moving) = (coulomb.simd_ne(zero), v.simd_ne(zero));
            let holds = (push.magnitude() + most_pulled).simd_le(coulomb * S::splat(1.0 - 1e-12));
            let stuck = rubs & !moving & holds;
            stays = stays & (!rubs | moving | stuck);
            let friction = coulomb.select(v.simd_gt(zero), -coulomb).select(rubs & moving, zero);
            let a = (push - friction - self.device.viscous[axis] * v) * map.inverse_mass;
            let target = map.pull * shift + zero;
            let [farther, faster] = map.bounds(a, v, target, step);
            let e = map.change(a, v, moves.then(|| self.outlook.path_of(axis)), None);
            let [moved, gained] = [v * step + e[0], e[1]];
            // Friction may change its sign here.
            let turns = friction.simd_ne(zero) & v.magnitude().simd_le(faster);
            let bends = map.damping.magnitude() * faster + map.pull * farther + target;
            let is_monotone = (a.magnitude() * S::splat(1.0 - 1e-12)).simd_gt(bends);
            let after = v + gained;
            let forward = after.select(v.simd_gt(zero), -after);
            let goes_on = is_monotone & forward.simd_gt(S::splat(1e-12) * faster);
            let clear = (x - farther).simd_gt(lower) & (x + farther).simd_lt(upper);
            let rests = x.simd_gt(lower) & x.simd_lt(upper);
            stays = stays & ((stuck & rests) | (!stuck & clear & (!turns | goes_on)));
            most_moved[axis] = zero.select(stuck, farther);
            most_gained[axis] = zero.select(stuck, faster);
            let [of_position, of_velocity] = &mut lost;
            add_one(&mut position[axis], &mut of_position[axis], zero.select(stuck, moved));
            add_one(&mut velocity[axis], &mut of_velocity[axis], zero.select(stuck, gained));
            velocity[axis] = zero.select(stuck, velocity[axis]);
            of_velocity[axis] = zero.select(stuck, of_velocity[axis]);
        }
        if !has_let_go {
            let farther = most_moved.zip_map(&shift, |moved, shift| S::splat(shift) + moved);
            let change = impedance[0] * norm(&farther) + impedance[1] * norm(&most_gained);
            let slips = ((norm(&wish) + change) * above).simd_ge(self.strength_now());
            stays = stays & !slips;
        }
        (Motion { position, velocity }, lost, stays)
    }

    #[inline(always)]
    fn strength_now(&self) -> S {
        let [_, strength] = self.outlook.grip;
        S::splat(strength[0]) * self.strength
    }

    /// Force of the hands in N with unlimited strength.
    #[inline(always)]
    fn wish(&self, gain: f64) -> Axes<N, S> {
        let Motion { position, velocity } = &self.motion;
        Axes::from_fn(|axis, _| {
            let away = S::splat(self.outlook.target[axis]) - position[axis];
            (away * self.stiffness - velocity[axis] * self.damping) * S::splat(gain)
        })
    }

    /// Force of the hands in N, as [`SimulatedMaster::hand_force`].
    #[inline(always)]
    fn hand_force(&self) -> Axes<N, S> {
        let [gain, share] = self.outlook.grip;
        let (wish, strength) = (self.wish(gain[0]), self.strength_now());
        let holds = wish.dot(&wish).simd_lt(S::splat(0.99) * strength * strength);
        if holds.all() {
            return wish;
        }
        if share[0] == 0.0 {
            return wish.map(|x| x * S::zero());
        }
        let wished = norm(&wish);
        let part = S::one().select(holds | wished.simd_le(strength), strength / wished);
        wish.map(|x| x * part)
    }
}

#[cfg(test)]
mod tests;
