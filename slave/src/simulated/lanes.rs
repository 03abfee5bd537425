//! Several simulated slaves side by side: those on whose axes nothing happens within a tick are advanced in lanes, each of
//! the others by itself, to the same bits.

use nalgebra::{SVector, SimdBool as _};

use super::{Continuous, Plant, SimulatedSlave, SlaveSample};
use crate::{
    Axes, Environment, Object, Real,
    solver::linear::{Bend, LONGEST, LineLanes, SHORTEST},
};

/// What several slaves measure at one tick.
#[derive(Clone, Copy, Debug)]
pub struct SlaveLanesSample<const N: usize, S: Real> {
    /// Tool positions in m.
    pub position: SVector<S, N>,
    /// Tool velocities in m/s.
    pub velocity: SVector<S, N>,
    /// `F_e` in N.
    pub environment_force: SVector<S, N>,
}

/// An object that acts along the axes, of each slave.
#[derive(Clone, Debug)]
enum ObjectLanes<const N: usize, S: Real> {
    Plane { axis: usize, surface: S, normal: S, stiffness: S, damping: S },
    Spring { anchor: SVector<S, N>, stiffness: S, damping: S },
}

/// Slaves side by side, of which each is as alone: see [`SimulatedSlave`].
///
/// In lanes are arms with control of position or pd whose set position has no bound on its acceleration, among planes and
/// springs of Kelvin and Voigt alone and without a force sensor, over ticks within which no contact changes and no push begins
/// or ends.
#[derive(Clone, Debug)]
pub struct SlaveLanes<const N: usize, S: Real> {
    slaves: Vec<SimulatedSlave<N>>,
    /// None where they are not for lanes.
    fast: Option<Box<Fast<N, S>>>,
    /// Of the last read.
    sample: SlaveLanesSample<N, S>,
    has_started: bool,
}

/// Arms in lanes. Tool, command and set position of those that are [loaded](Self::loaded) are here, those of the others in their
/// slaves; what surrounds them is in their slaves always.
#[derive(Clone, Debug)]
struct Fast<const N: usize, S: Real> {
    lines: [LineLanes<S>; N],
    objects: Vec<ObjectLanes<N, S>>,
    /// M in kg, K in N/m and B in N s/m of the arms.
    mass: S,
    stiffness: S,
    damping: S,
    /// Whether the controls use the velocity of the command.
    feeds_forward: bool,
    /// Largest speed in m/s of a set position.
    speed: S,
    /// Whether all are pushed alike.
    shares_pushes: bool,
    begun_ns: u64,
    now_ns: u64,
    state: ArmLanes<N, S>,
    /// A bit for each lane that is here.
    loaded: u64,
    /// Of each lane.
    absences: Vec<Absence>,
}

/// Most ticks for which a slave that cannot be advanced in its lane is left out of it.
const MAX_ABSENCE: u32 = 64;

/// For how long one that could not be advanced in its lane stays with its slave.
#[derive(Clone, Copy, Debug, Default)]
struct Absence {
    /// Ticks that are left of it.
    left: u32,
    /// Ticks that it had when it began.
    whole: u32,
}

impl Absence {
    /// It begins: longer each time, if the lane could not be used since the last.
    fn begin(&mut self, was_used: bool) {
        self.whole = if was_used { 1 } else { (2 * self.whole).clamp(1, MAX_ABSENCE) };
        self.left = self.whole;
    }

    /// A tick of it; says whether it is over.
    fn step(&mut self) -> bool {
        self.left = self.left.saturating_sub(1);
        self.left == 0
    }
}

/// What changes of arms in lanes.
#[derive(Clone, Copy, Debug)]
struct ArmLanes<const N: usize, S: Real> {
    position: SVector<S, N>,
    velocity: SVector<S, N>,
    command: SVector<S, N>,
    command_velocity: SVector<S, N>,
    /// 1 where the command is where the arm comes to rest, else 0.
    stops: S,
    /// Of which speed and phase follow from the command.
    set_position: SVector<S, N>,
}

impl<const N: usize, S: Real> SlaveLanes<N, S> {
    /// Slaves before their first read; None if they are more than there are lanes.
    pub fn new(slaves: Vec<SimulatedSlave<N>>) -> Option<Self> {
        let zeros = SVector::<S, N>::zeros();
        let sample = SlaveLanesSample { position: zeros, velocity: zeros, environment_force: zeros };
        let fits = slaves.len() <= S::LANES;
        fits.then(|| Self { fast: Fast::gather(&slaves).map(Box::new), slaves, sample, has_started: false })
    }

    /// Start the time of the pushers of all, once.
    #[inline(always)] // nearly always it has
    pub fn start(&mut self, now_ns: u64) {
        if !self.has_started {
            self.has_started = true;
            self.slaves.iter_mut().for_each(|slave| slave.start(now_ns));
        }
    }

    /// Commands positions in m and the velocities there in m/s to those with a bit in `lanes`, as [`SimulatedSlave::write`].
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

    /// Brings those with a bit in `lanes` to rest, as [`SimulatedSlave::stop`]; returns where, in m.
    #[inline(never)] // seldom
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

    /// Advance those with a bit in `lanes` to `now_ns` (monotonic); return what these measure there.
    #[inline(always)] // once a tick, from one place
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

    /// Read each of these slaves by itself.
    #[inline(never)] // seldom, and long
    fn read_alone(&mut self, lanes: u64, now_ns: u64) {
        for lane in lanes_of(lanes, self.slaves.len()) {
            let SlaveSample { position, velocity, environment_force, .. } = self.slaves[lane].read(now_ns);
            set(&mut self.sample.position, lane, &position);
            set(&mut self.sample.velocity, lane, &velocity);
            set(&mut self.sample.environment_force, lane, &environment_force);
        }
    }
}

/// The lanes that have a bit in a mask.
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

/// Where all axes are finite numbers.
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

/// A piece of a tick.
struct Piece {
    /// When the tick began, in s.
    from: f64,
    /// When it begins, in s.
    now: f64,
    /// When it ends, in s from the begin of the tick.
    end: f64,
    /// How long it lasts, in s.
    step: f64,
    /// A time within it, in s.
    inside: f64,
}

/// Largest coefficient of friction of an object in lanes.
const MAX_FRICTION: f64 = 1e6;

/// The objects of slaves in lanes; None unless they are of the same kinds.
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
            // One that leans by less than rounding of its length has a force along the other axes, too.
            let is_straight = (0..N).all(|other| other == axis || normal[other] == 0.0);
            // Times no slip at all, friction is nothing as long as it is a number.
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
    /// Lanes for slaves that may be in them; none is loaded yet.
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

    /// Takes over the state of a slave, if that may be in its lane.
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

    /// Give a slave the state of its lane, if that has it.
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

    /// Advance those with a bit in `lanes` that may be in their lanes; return which these are.
    #[inline(always)] // as its caller
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

    #[inline(never)] // seldom
    fn load_all(&mut self, lanes: u64, slaves: &[SimulatedSlave<N>]) {
        for lane in lanes_of(lanes, slaves.len()) {
            if self.absences[lane].step() && slaves[lane].now_ns == self.now_ns {
                self.load(lane, &slaves[lane]);
            }
        }
    }

    /// These cannot be advanced in their lanes over this tick: those that could not since they were taken over, after `before`,
    /// stay with their slaves for longer each time.
    #[inline(never)] // seldom
    fn leave(&mut self, lanes: u64, before: u64, slaves: &mut [SimulatedSlave<N>]) {
        for lane in lanes_of(lanes, slaves.len()) {
            self.give_back(lane, &mut slaves[lane]);
            self.absences[lane].begin(before >> lane & 1 == 1);
        }
    }

    /// The arms after a tick from a time in s on that lasts so many s, and where they are so: where no contact changes and no
    /// push begins or ends before.
    #[inline(always)] // as its caller
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
                // The set position goes to the command at one speed, and rests there.
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

    /// The pushes in N at the begin of a piece and by how much each grows within it in N/s; no lane stays where a push has a
    /// kink before its end.
    #[inline(always)] // as its caller
    fn pushes(
        &self,
        lanes: u64,
        slaves: &mut [SimulatedSlave<N>],
        piece: &Piece,
        stays: &mut S::SimdBool,
    ) -> [SVector<S, N>; 2] {
        let mut found = [SVector::<S, N>::zeros(); 2];
        // 1 where a push has one.
        let mut kinks = S::zero();
        for lane in lanes_of(lanes, slaves.len()) {
            let Plant::Continuous(plant) = &mut slaves[lane].plant else { continue };
            let environment = &mut plant.environment;
            let Piece { from, now, end, step, inside } = *piece;
            let stretch = environment.push_stretch(now);
            // A piece ends no later than the stretch.
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
    #[inline(always)] // as its caller
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
