//! Several simulated slaves in parallel. A slave advances in its lane if no event occurs on its axes within the tick;
//! otherwise it advances alone. Both give bit-identical results.

use nalgebra::{SVector, SimdBool as _};

use super::{Continuous, Plant, SimulatedSlave, SlaveSample};
use crate::{
    Axes, Environment, Object, Real,
    solver::linear::{Bend, LONGEST, LineLanes, SHORTEST},
};

/// Measurements of several slaves at one tick.
#[derive(Clone, Copy, Debug)]
pub struct SlaveLanesSample<const N: usize, S: Real> {
    /// Tool positions in m.
    pub position: SVector<S, N>,
    /// Tool velocities in m/s.
    pub velocity: SVector<S, N>,
    /// `F_e` in N.
    pub environment_force: SVector<S, N>,
}

/// An object that acts along the axes, one per slave.
#[derive(Clone, Debug)]
enum ObjectLanes<const N: usize, S: Real> {
    Plane { axis: usize, surface: S, normal: S, stiffness: S, damping: S },
    Spring { anchor: SVector<S, N>, stiffness: S, damping: S },
}

/// Slaves in parallel, each bit-identical to a separate [`SimulatedSlave`].
///
/// Lanes support arms with position or pd control whose set position has no bound on its acceleration. Their objects
/// are Kelvin-Voigt planes and springs only, and they have no force sensor. A slave stays in its lane over ticks in
/// which no contact changes and no push starts or ends.
#[derive(Clone, Debug)]
pub struct SlaveLanes<const N: usize, S: Real> {
    slaves: Vec<SimulatedSlave<N>>,
    /// None if the slaves cannot run in lanes.
    fast: Option<Box<Fast<N, S>>>,
    /// Sample of the last read.
    sample: SlaveLanesSample<N, S>,
    has_started: bool,
}

/// Arms in lanes.
///
/// Tool, command and set position of a [loaded](Self::loaded) lane are stored here, those of the other lanes in their
/// slaves. The environments always stay in the slaves.
#[derive(Clone, Debug)]
struct Fast<const N: usize, S: Real> {
    lines: [LineLanes<S>; N],
    objects: Vec<ObjectLanes<N, S>>,
    /// M in kg, K in N/m and B in N s/m of the arms.
    mass: S,
    stiffness: S,
    damping: S,
    /// True if the controls use the velocity of the command.
    feeds_forward: bool,
    /// Largest speed in m/s of a set position.
    speed: S,
    /// True if all slaves have the same pushers.
    shares_pushes: bool,
    begun_ns: u64,
    now_ns: u64,
    state: ArmLanes<N, S>,
    /// Bit mask of the lanes whose state is here.
    loaded: u64,
    /// Absence of each lane.
    absences: Vec<Absence>,
}

/// Maximum number of ticks for which a slave stays out of its lane.
const MAX_ABSENCE: u32 = 64;

/// Retry delay of a slave that could not advance in its lane.
#[derive(Clone, Copy, Debug, Default)]
struct Absence {
    /// Ticks left until the retry.
    left: u32,
    /// Length in ticks of the present absence.
    whole: u32,
}

impl Absence {
    /// Start an absence: of one tick if the lane was used since the last one, else twice as long as that.
    fn begin(&mut self, was_used: bool) {
        self.whole = if was_used { 1 } else { (2 * self.whole).clamp(1, MAX_ABSENCE) };
        self.left = self.whole;
    }

    /// Count one tick; return true if the absence is over.
    fn step(&mut self) -> bool {
        self.left = self.left.saturating_sub(1);
        self.left == 0
    }
}

/// State of the arms in lanes.
#[derive(Clone, Copy, Debug)]
struct ArmLanes<const N: usize, S: Real> {
    position: SVector<S, N>,
    velocity: SVector<S, N>,
    command: SVector<S, N>,
    command_velocity: SVector<S, N>,
    /// 1 if the command is the rest position of a stop, else 0.
    stops: S,
    /// Set positions; speed and phase follow from the command.
    set_position: SVector<S, N>,
}

impl<const N: usize, S: Real> SlaveLanes<N, S> {
    /// Slaves before their first read; none if there are more slaves than lanes.
    pub fn new(slaves: Vec<SimulatedSlave<N>>) -> Option<Self> {
        let zeros = SVector::<S, N>::zeros();
        let sample = SlaveLanesSample { position: zeros, velocity: zeros, environment_force: zeros };
        let fits = slaves.len() <= S::LANES;
        fits.then(|| Self { fast: Fast::gather(&slaves).map(Box::new), slaves, sample, has_started: false })
    }

    /// Start the time of all pushers; later calls have no effect.
    #[inline(always)] // nearly always returns at once
    pub fn start(&mut self, now_ns: u64) {
        if !self.has_started {
            self.has_started = true;
            self.slaves.iter_mut().for_each(|slave| slave.start(now_ns));
        }
    }

    /// Command positions in m and the velocities there in m/s to the lanes of the mask, as [`SimulatedSlave::write`].
    #[inline(always)] // once a tick
    pub fn write(&mut self, lanes: u64, position: &SVector<S, N>, velocity: &SVector<S, N>) {
        let mut alone = lanes;
        if let Some(fast) = &mut self.fast {
            fast.state.command(position, velocity);
            alone &= !fast.loaded;
        }
        if alone != 0 {
            for lane in lanes_of(alone, self.slaves.len()) {
                self.slaves[lane].write(&of_lane(position, lane), &of_lane(velocity, lane));
            }
        }
    }

    /// Bring the lanes of the mask to rest, as [`SimulatedSlave::stop`]; return the rest positions in m.
    #[inline(never)] // rare
    pub fn stop(&mut self, lanes: u64) -> SVector<S, N> {
        let mut rests = self.sample.position;
        for lane in lanes_of(lanes, self.slaves.len()) {
            let slave = &mut self.slaves[lane];
            if let Some(fast) = &mut self.fast {
                fast.give_back(lane, slave);
            }
            set(&mut rests, lane, &slave.stop());
        }
        rests
    }

    /// Advance the lanes of the mask to `now_ns` (monotonic) and return their measurements.
    #[inline(always)] // once a tick, from one caller
    pub fn read(&mut self, lanes: u64, now_ns: u64) -> &SlaveLanesSample<N, S> {
        let mut alone = lanes;
        if let Some(fast) = &mut self.fast {
            alone &= !fast.read(lanes, now_ns, &mut self.slaves, &mut self.sample);
        }
        if alone != 0 {
            self.read_alone(alone, now_ns);
        }
        &self.sample
    }

    /// Read each slave of the mask separately.
    #[inline(never)] // rare, and long
    fn read_alone(&mut self, lanes: u64, now_ns: u64) {
        for lane in lanes_of(lanes, self.slaves.len()) {
            let SlaveSample { position, velocity, environment_force, .. } = self.slaves[lane].read(now_ns);
            set(&mut self.sample.position, lane, &position);
            set(&mut self.sample.velocity, lane, &velocity);
            set(&mut self.sample.environment_force, lane, &environment_force);
        }
    }
}

/// Lane indices of a mask.
fn lanes_of(mask: u64, count: usize) -> impl Iterator<Item = usize> {
    (0..count).filter(move |lane| mask >> lane & 1 == 1)
}

fn set<const N: usize, S: Real>(lanes: &mut SVector<S, N>, lane: usize, value: &Axes<N>) {
    for axis in 0..N {
        lanes[axis].replace(lane, value[axis]);
    }
}

fn of_lane<const N: usize, S: Real>(lanes: &SVector<S, N>, lane: usize) -> Axes<N> {
    Axes::from_fn(|axis, _| lanes[axis].extract(lane))
}

#[inline(always)]
fn everywhere<S: Real>() -> S::SimdBool {
    S::zero().simd_le(S::zero())
}

/// Mask of the lanes in which all axes are finite.
#[inline(always)]
fn finite<const N: usize, S: Real>(of: &SVector<S, N>) -> S::SimdBool {
    of.iter().fold(everywhere::<S>(), |all, x| all & (*x * S::zero()).simd_eq(S::zero()))
}

impl<const N: usize, S: Real> ArmLanes<N, S> {
    fn at_rest() -> Self {
        let zeros = SVector::<S, N>::zeros();
        Self {
            position: zeros,
            velocity: zeros,
            command: zeros,
            command_velocity: zeros,
            stops: S::zero(),
            set_position: zeros,
        }
    }

    /// As [`SimulatedSlave::write`].
    #[inline(always)] // once a tick
    fn command(&mut self, position: &SVector<S, N>, velocity: &SVector<S, N>) {
        let (taken, moves) = (finite(position), finite(velocity));
        let mut same = everywhere::<S>();
        for axis in 0..N {
            let before = [self.command[axis], self.command_velocity[axis]];
            let position = position[axis].select(taken, before[0]);
            let velocity = velocity[axis].select(moves, S::zero()).select(taken, before[1]);
            same = same & position.simd_eq(before[0]) & velocity.simd_eq(before[1]);
            (self.command[axis], self.command_velocity[axis]) = (position, velocity);
        }
        self.stops = self.stops.select(same, S::zero());
    }
}

/// Part of a tick.
struct Piece {
    /// Start of the tick, in s.
    from: f64,
    /// Start of the part, in s.
    now: f64,
    /// End of the part, in s since the start of the tick.
    end: f64,
    /// Duration in s.
    step: f64,
    /// A time strictly within the part, in s.
    inside: f64,
}

/// Largest coefficient of friction of an object in lanes.
const MAX_FRICTION: f64 = 1e6;

/// The objects of the slaves in lanes; none unless all slaves have the same kinds of objects.
fn objects<const N: usize, S: Real>(of: &[&Environment<N>]) -> Option<Vec<ObjectLanes<N, S>>> {
    let count = of.first()?.objects.len();
    if of.iter().any(|one| one.objects.len() != count) {
        return None;
    }
    let number = |index: usize, number: &dyn Fn(&Object<N>) -> f64| {
        let mut lanes = S::zero();
        for (lane, one) in of.iter().enumerate() {
            lanes.replace(lane, number(&one.objects[index]));
        }
        lanes
    };
    let object = |index: usize| {
        let first = &of[0].objects[index];
        let stiffness = number(index, &|object| object.contact().linear().0);
        let damping = number(index, &|object| object.contact().linear().1);
        if first.shape().is_spring() {
            let anchor = SVector::from_fn(|axis, _| number(index, &|one| one.shape().reference()[axis]));
            let is_alike = of.iter().all(|one| one.objects[index].shape().is_spring());
            return is_alike.then_some(ObjectLanes::Spring { anchor, stiffness, damping });
        }
        let (axis, ..) = first.shape().across_axis()?;
        let plane = |object: &Object<N>| {
            let (_, normal) = object.shape().surface(&Axes::zeros());
            // A plane that leans by less than the rounding of its length still has a force along the other axes.
            let is_straight = (0..N).all(|other| other == axis || normal[other] == 0.0);
            // With no slip the friction force is zero if the coefficient is finite.
            let is_small = object.contact().friction() <= MAX_FRICTION;
            object.shape().across_axis().filter(|(along, ..)| *along == axis && is_straight && is_small)
        };
        if of.iter().any(|one| plane(&one.objects[index]).is_none()) {
            return None;
        }
        let surface = number(index, &|object| plane(object).map_or(0.0, |(_, surface, _)| surface));
        let normal = number(index, &|object| plane(object).map_or(0.0, |(.., normal)| normal));
        Some(ObjectLanes::Plane { axis, surface, normal, stiffness, damping })
    };
    (0..count).map(object).collect()
}

impl<const N: usize, S: Real> Fast<N, S> {
    /// Lanes for supported slaves; none is loaded yet.
    fn gather(slaves: &[SimulatedSlave<N>]) -> Option<Self> {
        let mut parts = Vec::with_capacity(slaves.len());
        for slave in slaves {
            let Plant::Continuous(plant) = &slave.plant else { return None };
            let linear = plant.linear.as_ref().filter(|linear| linear.is_complete)?;
            if slave.sensor.is_some() || plant.drive.model().limits().acceleration.is_finite() {
                return None;
            }
            parts.push((&**plant, linear));
        }
        let (first, _) = *parts.first()?;
        let (begun_ns, now_ns) = (slaves.first()?.begun_ns, slaves.first()?.now_ns);
        let feeds_forward = |plant: &Continuous<N>| plant.drive.model().impedance().2;
        let is_alike = slaves.iter().all(|slave| slave.begun_ns == begun_ns && slave.now_ns == now_ns)
            && parts.iter().all(|(plant, _)| feeds_forward(plant) == feeds_forward(first));
        if !is_alike {
            return None;
        }
        let line = |axis: usize| {
            LineLanes::gather(&parts.iter().map(|(_, linear)| &linear.lines()[axis]).collect::<Vec<_>>())
        };
        let environments: Vec<_> = parts.iter().map(|(plant, _)| &plant.environment).collect();
        let number = |of: &dyn Fn(&Continuous<N>) -> f64| {
            let mut lanes = S::one();
            for (lane, (plant, _)) in parts.iter().enumerate() {
                lanes.replace(lane, of(plant));
            }
            lanes
        };
        Some(Self {
            lines: (0..N).map(line).collect::<Option<Vec<_>>>()?.try_into().ok()?,
            objects: objects(&environments)?,
            mass: number(&|plant| plant.drive.model().mass_kg()),
            stiffness: number(&|plant| plant.drive.model().impedance().0),
            damping: number(&|plant| plant.drive.model().impedance().1),
            feeds_forward: feeds_forward(first),
            speed: number(&|plant| plant.drive.model().limits().speed),
            shares_pushes: environments.iter().all(|one| one.pushers == first.environment.pushers),
            begun_ns,
            now_ns,
            state: ArmLanes::at_rest(),
            loaded: 0,
            absences: vec![Absence::default(); slaves.len()],
        })
    }

    /// Copy the state of a slave into its lane, if the lane supports it.
    fn load(&mut self, lane: usize, slave: &SimulatedSlave<N>) {
        let Plant::Continuous(plant) = &slave.plant else { return };
        let (drive, tool) = (&plant.drive, &plant.tool);
        let (Some(linear), (Some(command), velocity)) = (&plant.linear, drive.commanded()) else { return };
        let (stiffness, damping, _) = drive.model().impedance();
        for (axis, line) in self.lines.iter_mut().enumerate() {
            line.load(lane, &linear.lines()[axis], [drive.model().mass_kg(), stiffness, damping]);
            self.state.set_position[axis].replace(lane, drive.set_points()[axis].position);
        }
        set(&mut self.state.position, lane, &tool.position);
        set(&mut self.state.velocity, lane, &tool.velocity);
        set(&mut self.state.command, lane, &command);
        set(&mut self.state.command_velocity, lane, &velocity);
        self.state.stops.replace(lane, f64::from(u8::from(drive.stops())));
        self.loaded |= 1 << lane;
    }

    /// Copy the state of a loaded lane back to its slave.
    fn give_back(&mut self, lane: usize, slave: &mut SimulatedSlave<N>) {
        let Plant::Continuous(plant) = &mut slave.plant else { return };
        if self.loaded >> lane & 1 == 0 {
            return;
        }
        self.loaded &= !(1 << lane);
        slave.now_ns = self.now_ns;
        let ArmLanes { position, velocity, command, command_velocity, stops, set_position } = &self.state;
        (plant.tool.position, plant.tool.velocity) = (of_lane(position, lane), of_lane(velocity, lane));
        let command = (of_lane(command, lane), of_lane(command_velocity, lane));
        plant.drive.resume(command, stops.extract(lane) > 0.0, &of_lane(set_position, lane));
    }

    /// Advance the lanes of the mask that can stay in lanes; return their mask.
    #[inline(always)] // like its caller
    fn read(
        &mut self,
        lanes: u64,
        now_ns: u64,
        slaves: &mut [SimulatedSlave<N>],
        sample: &mut SlaveLanesSample<N, S>,
    ) -> u64 {
        let before = self.loaded;
        if lanes & !before != 0 {
            self.load_all(lanes & !before, slaves);
        }
        let from = self.now_ns.saturating_sub(self.begun_ns) as f64 * 1e-9;
        let span = now_ns.saturating_sub(self.now_ns) as f64 * 1e-9;
        let (state, stays) = self.advanced([from, span], lanes & self.loaded, slaves);
        let fails = if stays.all() { 0 } else { lanes & self.loaded & !stays.bitmask() };
        if fails != 0 {
            self.leave(fails, before, slaves);
        }
        self.state = state;
        self.now_ns = self.now_ns.max(now_ns);
        let force = self.force(slaves, from + span);
        let ArmLanes { position, velocity, .. } = state;
        *sample = SlaveLanesSample { position, velocity, environment_force: force };
        lanes & self.loaded
    }

    #[inline(never)] // rare
    fn load_all(&mut self, lanes: u64, slaves: &[SimulatedSlave<N>]) {
        for lane in lanes_of(lanes, slaves.len()) {
            if self.absences[lane].step() && slaves[lane].now_ns == self.now_ns {
                self.load(lane, &slaves[lane]);
            }
        }
    }

    /// Move lanes that cannot advance in this tick back to their slaves. A lane that was not in use `before` the tick
    /// stays away for longer each time.
    #[inline(never)] // rare
    fn leave(&mut self, lanes: u64, before: u64, slaves: &mut [SimulatedSlave<N>]) {
        for lane in lanes_of(lanes, slaves.len()) {
            self.give_back(lane, &mut slaves[lane]);
            self.absences[lane].begin(before >> lane & 1 == 1);
        }
    }

    /// Advance the arms by a tick that starts at `from` in s and lasts `span` in s. The mask holds the lanes for which
    /// the result is valid: no contact changes and no push starts or ends in the tick.
    #[inline(always)] // like its caller
    fn advanced(
        &mut self,
        [from, span]: [f64; 2],
        lanes: u64,
        slaves: &mut [SimulatedSlave<N>],
    ) -> (ArmLanes<N, S>, S::SimdBool) {
        let (zero, mut state, mut stays) = (S::zero(), self.state, everywhere::<S>());
        let mut done = 0.0;
        while done < span {
            let now = from + done;
            let mut end = done + LONGEST;
            if span - end < SHORTEST {
                end = span;
            }
            let step = end - done;
            let piece = Piece { from, now, end, step, inside: from + 0.5 * (done + end) };
            let [push, growth] = self.pushes(lanes, slaves, &piece, &mut stays);
            for axis in 0..N {
                let line = &mut self.lines[axis];
                line.prepare(step);
                // The set position moves to the command at constant speed and rests there.
                let (target, set) = (state.command[axis], state.set_position[axis]);
                let away = target - set;
                let rests = away.simd_eq(zero) | self.speed.simd_eq(S::splat(f64::INFINITY));
                let set = target.select(rests, set);
                let set_velocity = zero.select(rests, self.speed.select(away.simd_gt(zero), -self.speed));
                let phase = S::splat(f64::INFINITY).select(rests, away.magnitude() / self.speed);
                let mut feed = zero;
                if self.feeds_forward {
                    let wanted = state.command_velocity[axis];
                    let wanted = (-self.speed).select(wanted.simd_lt(-self.speed), wanted);
                    feed = self.damping * self.speed.select(wanted.simd_gt(self.speed), wanted);
                }
                let input = [
                    (push[axis] + self.stiffness * set + feed) / self.mass,
                    (growth[axis] + self.stiffness * set_velocity) / self.mass,
                ];
                let bend = Bend { at: phase, slope: self.stiffness * set_velocity / self.mass };
                let bends = phase.simd_lt(S::splat(step));
                let before = [state.position[axis], state.velocity[axis]];
                let ([x, v], keeps) = line.advance(input, bends, &bend, before);
                stays = stays & keeps & finite(&SVector::<S, 2>::new(x, v));
                (state.position[axis], state.velocity[axis]) = (x, v);
                let arrives = S::splat(step).simd_ge(phase * S::splat(1.0 - 1e-12));
                let moved = target.select(arrives, set + S::splat(step) * set_velocity);
                state.set_position[axis] = set.select(rests, moved);
            }
            done = end;
        }
        (state, stays)
    }

    /// Pushes in N at the start of a part, and their growth within it in N/s. Clears `stays` for lanes whose push has a
    /// kink before the end of the part.
    #[inline(always)] // like its caller
    fn pushes(
        &self,
        lanes: u64,
        slaves: &mut [SimulatedSlave<N>],
        piece: &Piece,
        stays: &mut S::SimdBool,
    ) -> [SVector<S, N>; 2] {
        let mut found = [SVector::<S, N>::zeros(); 2];
        // 1 in lanes whose push has a kink.
        let mut kinks = S::zero();
        for lane in lanes_of(lanes, slaves.len()) {
            let Plant::Continuous(plant) = &mut slaves[lane].plant else { continue };
            let environment = &mut plant.environment;
            let Piece { from, now, end, step, inside } = *piece;
            let stretch = environment.push_stretch(now);
            // A part without a kink ends at or before the end of the stretch.
            let has_kink = stretch.until - from < end;
            let (push, growth) = environment.linear_push(&stretch, inside, [now, from + end], step);
            if self.shares_pushes {
                if has_kink {
                    *stays = !everywhere::<S>();
                }
                return [push, growth].map(|of| of.map(S::splat));
            }
            kinks.replace(lane, f64::from(u8::from(has_kink)));
            set(&mut found[0], lane, &push);
            set(&mut found[1], lane, &growth);
        }
        *stays = *stays & kinks.simd_eq(S::zero());
        found
    }

    /// `F_e` in N at a time in s.
    #[inline(always)] // like its caller
    fn force(&self, slaves: &[SimulatedSlave<N>], time_s: f64) -> SVector<S, N> {
        let mut force = SVector::<S, N>::zeros();
        for lane in lanes_of(self.loaded, slaves.len()) {
            let Plant::Continuous(plant) = &slaves[lane].plant else { continue };
            let push = plant.environment.push_at(time_s);
            if self.shares_pushes {
                force = push.map(S::splat);
                break;
            }
            set(&mut force, lane, &push);
        }
        let (zero, x, v) = (S::zero(), &self.state.position, &self.state.velocity);
        for object in &self.objects {
            match object {
                ObjectLanes::Plane { axis, surface, normal, stiffness, damping } => {
                    let depth = -((x[*axis] - *surface) * *normal);
                    let pressing = *stiffness * depth + *damping * -(*normal * v[*axis]);
                    let touches = depth.simd_gt(zero) & pressing.simd_gt(zero);
                    force[*axis] = (force[*axis] + *normal * pressing).select(touches, force[*axis]);
                }
                ObjectLanes::Spring { anchor, stiffness, damping } => {
                    for axis in 0..N {
                        force[axis] += (anchor[axis] - x[axis]) * *stiffness - v[axis] * *damping;
                    }
                }
            }
        }
        force
    }
}

#[cfg(test)]
mod tests;
