//! Several simulated slaves in parallel. A slave advances in its lane if no event occurs on its axes within the tick;
//! otherwise it advances alone. Both give bit-identical results.

use haptether_numeric::{Occupancy, all_lanes, is_finite, lanes_of, pack, shared};
use nalgebra::{SimdBool as _, SimdValue as _};

use super::{Plant, SimulatedSlave, SlaveSample};
use crate::{
    Axes, Environment, Object, Real,
    solver::linear::{Bend, LONGEST, Line, SHORTEST},
};

/// Measurements of several slaves at one tick.
#[derive(Clone, Copy, Debug)]
pub struct SlaveLanesSample<const N: usize, S: Real> {
    /// Tool positions in m.
    pub position: Axes<N, S>,
    /// Tool velocities in m/s.
    pub velocity: Axes<N, S>,
    /// `F_e` in N.
    pub environment_force: Axes<N, S>,
}

/// An object that acts along the axes, one per slave.
#[derive(Clone, Debug)]
enum ObjectLanes<const N: usize, S: Real> {
    Plane { axis: usize, surface: S, normal: S, stiffness: S, damping: S },
    Spring { anchor: Axes<N, S>, stiffness: S, damping: S },
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
/// Tool, command and set position of a [loaded](Occupancy::loaded) lane are stored here, those of the other lanes in
/// their slaves. The environments always stay in the slaves.
#[derive(Clone, Debug)]
struct Fast<const N: usize, S: Real> {
    lines: [Line<S>; N],
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
    occupancy: Occupancy,
}

/// State of the arms in lanes.
#[derive(Clone, Copy, Debug)]
struct ArmLanes<const N: usize, S: Real> {
    position: Axes<N, S>,
    velocity: Axes<N, S>,
    command: Axes<N, S>,
    command_velocity: Axes<N, S>,
    /// 1 if the command is the rest position of a stop, else 0.
    stops: S,
    /// Set positions; speed and phase follow from the command.
    set_position: Axes<N, S>,
}

impl<const N: usize, S: Real> SlaveLanes<N, S> {
    /// Slaves before their first read; none if there are more slaves than lanes.
    pub fn new(slaves: Vec<SimulatedSlave<N>>) -> Option<Self> {
        let zeros = Axes::<N, S>::zeros();
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
    pub fn write(&mut self, lanes: u64, position: &Axes<N, S>, velocity: &Axes<N, S>) {
        let mut scalar = lanes;
        if let Some(fast) = &mut self.fast {
            fast.state.command(position, velocity);
            scalar &= !fast.occupancy.loaded();
        }
        if scalar != 0 {
            for lane in lanes_of(scalar, self.slaves.len()) {
                self.slaves[lane].write(&position.extract(lane), &velocity.extract(lane));
            }
        }
    }

    /// Bring the lanes of the mask to rest, as [`SimulatedSlave::stop`]; return the rest positions in m.
    #[inline(never)] // rare
    pub fn stop(&mut self, lanes: u64) -> Axes<N, S> {
        let mut rests = self.sample.position;
        if let Some(fast) = &mut self.fast {
            fast.leave(lanes, lanes, &mut self.slaves);
        }
        for lane in lanes_of(lanes, self.slaves.len()) {
            rests.replace(lane, self.slaves[lane].stop());
        }
        rests
    }

    /// Advance the lanes of the mask to `now_ns` (monotonic) and return their measurements.
    #[inline(always)] // once a tick, from one caller
    pub fn read(&mut self, lanes: u64, now_ns: u64) -> &SlaveLanesSample<N, S> {
        let mut scalar = lanes;
        if let Some(fast) = &mut self.fast {
            scalar &= !fast.read(lanes, now_ns, &mut self.slaves, &mut self.sample);
        }
        if scalar != 0 {
            self.read_scalar(scalar, now_ns);
        }
        &self.sample
    }

    /// Read each slave of the mask separately.
    #[inline(never)] // rare, and long
    fn read_scalar(&mut self, lanes: u64, now_ns: u64) {
        for lane in lanes_of(lanes, self.slaves.len()) {
            let SlaveSample { position, velocity, environment_force, .. } = self.slaves[lane].read(now_ns);
            self.sample.position.replace(lane, position);
            self.sample.velocity.replace(lane, velocity);
            self.sample.environment_force.replace(lane, environment_force);
        }
    }
}

impl<const N: usize, S: Real> ArmLanes<N, S> {
    fn at_rest() -> Self {
        let zeros = Axes::<N, S>::zeros();
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
    fn command(&mut self, position: &Axes<N, S>, velocity: &Axes<N, S>) {
        let (taken, moves) = (is_finite(position), is_finite(velocity));
        let mut same = all_lanes::<S>();
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
    let numbers = |index: usize, number: &dyn Fn(&Object<N>) -> f64| {
        pack::<_, S>(of, |one| number(&one.objects[index]))
    };
    let object = |index: usize| {
        let first = &of[0].objects[index];
        let stiffness = numbers(index, &|object| object.contact().linear().0)?;
        let damping = numbers(index, &|object| object.contact().linear().1)?;
        if first.shape().is_spring() {
            let anchor = pack(of, |one| *one.objects[index].shape().reference())?;
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
        let surface = numbers(index, &|object| plane(object).map_or(0.0, |(_, surface, _)| surface))?;
        let normal = numbers(index, &|object| plane(object).map_or(0.0, |(.., normal)| normal))?;
        Some(ObjectLanes::Plane { axis, surface, normal, stiffness, damping })
    };
    (0..count).map(object).collect()
}

impl<const N: usize, S: Real> Fast<N, S> {
    /// Lanes for supported slaves; none is loaded yet.
    fn gather<'a>(slaves: &'a [SimulatedSlave<N>]) -> Option<Self> {
        let is_for_lanes = |slave: &SimulatedSlave<N>| {
            slave.sensor.is_none() && slave.plant.drive.model().limits().acceleration.is_infinite()
        };
        if !slaves.iter().all(is_for_lanes) {
            return None;
        }
        let (begun_ns, now_ns, feeds_forward) = shared(slaves, |slave| {
            let (.., feeds_forward) = slave.plant.drive.model().impedance();
            (slave.begun_ns, slave.now_ns, feeds_forward)
        })?;
        let linear = |slave: &'a SimulatedSlave<N>| slave.plant.linear.as_ref().filter(|of| of.is_complete);
        let linear = slaves.iter().map(linear).collect::<Option<Vec<_>>>()?;
        let line = |axis: usize| Line::gather(&linear.iter().map(|of| &of.lines()[axis]).collect::<Vec<_>>());
        let environments: Vec<_> = slaves.iter().map(SimulatedSlave::environment).collect();
        let model = |slave: &SimulatedSlave<N>| *slave.plant.drive.model();
        Some(Self {
            lines: (0..N).map(line).collect::<Option<Vec<_>>>()?.try_into().ok()?,
            objects: objects(&environments)?,
            mass: pack(slaves, |slave| model(slave).mass_kg())?,
            stiffness: pack(slaves, |slave| model(slave).impedance().0)?,
            damping: pack(slaves, |slave| model(slave).impedance().1)?,
            feeds_forward,
            speed: pack(slaves, |slave| model(slave).limits().speed)?,
            shares_pushes: environments.iter().all(|one| one.pushers == environments[0].pushers),
            begun_ns,
            now_ns,
            state: ArmLanes::at_rest(),
            occupancy: Occupancy::new(slaves.len()),
        })
    }

    /// Copy the state of a slave into its lane, if the lane supports it.
    fn load(&mut self, lane: usize, slave: &SimulatedSlave<N>) {
        let (drive, tool) = (&slave.plant.drive, &slave.plant.tool);
        let Some(linear) = slave.plant.linear.as_ref().filter(|_| slave.now_ns == self.now_ns) else {
            return;
        };
        let (command, velocity) = drive.commanded();
        let (stiffness, damping, _) = drive.model().impedance();
        for (axis, line) in self.lines.iter_mut().enumerate() {
            line.load(lane, &linear.lines()[axis], [drive.model().mass_kg(), stiffness, damping]);
            self.state.set_position[axis].replace(lane, drive.set_points()[axis].position);
        }
        self.state.position.replace(lane, tool.position);
        self.state.velocity.replace(lane, tool.velocity);
        self.state.command.replace(lane, command);
        self.state.command_velocity.replace(lane, velocity);
        self.state.stops.replace(lane, f64::from(u8::from(drive.stops())));
        self.occupancy.load(lane);
    }

    /// Copy the state of a lane back to its slave.
    fn write_back(&self, lane: usize, slave: &mut SimulatedSlave<N>) {
        slave.now_ns = self.now_ns;
        let ArmLanes { position, velocity, command, command_velocity, stops, set_position } = &self.state;
        let Plant { drive, tool, .. } = &mut slave.plant;
        (tool.position, tool.velocity) = (position.extract(lane), velocity.extract(lane));
        let command = (command.extract(lane), command_velocity.extract(lane));
        drive.resume(command, stops.extract(lane) > 0.0, &set_position.extract(lane));
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
        let before = self.occupancy.loaded();
        if lanes & !before != 0 {
            for lane in lanes_of(self.occupancy.due(lanes), slaves.len()) {
                self.load(lane, &slaves[lane]);
            }
        }
        let from = self.now_ns.saturating_sub(self.begun_ns) as f64 * 1e-9;
        let span = now_ns.saturating_sub(self.now_ns) as f64 * 1e-9;
        let (state, stays) = self.advanced([from, span], lanes & self.occupancy.loaded(), slaves);
        if !stays.all() {
            self.leave(lanes & !stays.bitmask(), before, slaves);
        }
        self.state = state;
        self.now_ns = self.now_ns.max(now_ns);
        let force = self.force(slaves, from + span);
        let ArmLanes { position, velocity, .. } = state;
        *sample = SlaveLanesSample { position, velocity, environment_force: force };
        lanes & self.occupancy.loaded()
    }

    /// Move lanes that cannot advance in this tick back to their slaves, as [`Occupancy::leave`].
    #[inline(never)] // rare
    fn leave(&mut self, lanes: u64, before: u64, slaves: &mut [SimulatedSlave<N>]) {
        for lane in lanes_of(self.occupancy.leave(lanes, before), slaves.len()) {
            self.write_back(lane, &mut slaves[lane]);
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
        let (zero, mut state, mut stays) = (S::zero(), self.state, all_lanes::<S>());
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
                    zero,
                ];
                let bend = Bend { at: phase, slope: self.stiffness * set_velocity / self.mass };
                let bends = phase.simd_lt(S::splat(step));
                let before = [state.position[axis], state.velocity[axis]];
                let ([x, v], keeps) = line.one_piece(input, (bends, &bend), before, step);
                stays = stays & keeps & is_finite(&Axes::<2, S>::new(x, v));
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
    ) -> [Axes<N, S>; 2] {
        let mut found = [Axes::<N, S>::zeros(); 2];
        // 1 in lanes whose push has a kink.
        let mut kinks = S::zero();
        for lane in lanes_of(lanes, slaves.len()) {
            let environment = &mut slaves[lane].plant.environment;
            let Piece { from, now, end, step, inside } = *piece;
            let stretch = environment.push_stretch(now);
            // A part without a kink ends at or before the end of the stretch.
            let has_kink = stretch.until - from < end;
            let (push, growth) = environment.linear_push(&stretch, inside, [now, from + end], step);
            if self.shares_pushes {
                if has_kink {
                    *stays = !all_lanes::<S>();
                }
                return [push, growth].map(|of| of.map(S::splat));
            }
            kinks.replace(lane, f64::from(u8::from(has_kink)));
            found[0].replace(lane, push);
            found[1].replace(lane, growth);
        }
        *stays = *stays & kinks.simd_eq(S::zero());
        found
    }

    /// `F_e` in N at a time in s.
    #[inline(always)] // like its caller
    fn force(&self, slaves: &[SimulatedSlave<N>], time_s: f64) -> Axes<N, S> {
        let mut force = Axes::<N, S>::zeros();
        for lane in lanes_of(self.occupancy.loaded(), slaves.len()) {
            let push = slaves[lane].plant.environment.push_at(time_s);
            if self.shares_pushes {
                force = push.map(S::splat);
                break;
            }
            force.replace(lane, push);
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
