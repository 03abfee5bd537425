//! A simulated tool that rotates, in a world of surfaces, holes, handles and bodies that it can hold.

mod body;
mod handle;
mod hold;
mod rigid;
mod settings;
mod surroundings;
#[cfg(test)]
mod tests;
mod world;

pub use settings::{HandleSettings, HoleSettings, RigidBodySettings, ToolSettings, ToolWorldSettings};

use nalgebra::{Unit, UnitQuaternion};

use crate::{ArmSettings, Axes, ControlKind, ModelError, Pusher, PusherSettings, all_finite, require};
use body::Body;
use handle::Handle;
use hold::{Frame, Grip, Hold, Stiffness};
use rigid::{Inertia, Load, Rate, Rigid, mean};
use settings::{finite, non_negative, orientation, positive};
use surroundings::{Hole, Surroundings};
use world::{Held, Loads, Motion, Servo, SetPose, World};

/// Phase in rad of the stiffest part per sub-step.
const STEP_PHASE: f64 = 0.25;
/// Maximum rate in rad/s of the stiffest part: 400 sub-steps per ms.
const MAX_RATE: f64 = 1e5;
const ALLOWED_RATE: &str = "at most 1e5 rad/s of the stiffest part, sqrt(stiffness / mass_kg) or \
                            sqrt(rotational_stiffness / inertia_kg_m2): make [slave.tool] or its contacts softer, or \
                            what moves heavier";
/// Shortest piece in s. A kink closer than this to the start of a piece or the end of the tick counts as there.
const SHORTEST: f64 = 1e-12;
/// Longest time in s between two writes for which the set pose may catch up at once: the period of the slowest loop.
const MAX_UNWRITTEN_S: f64 = 0.02;
/// Tolerance of the jaw position around a held object, as a share of the jaw travel.
const JAW_PLAY: f64 = 0.02;

/// Measurement of a tool, in the base frame about the tool point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolSample {
    /// In m.
    pub position: Axes<3>,
    /// In m/s.
    pub velocity: Axes<3>,
    /// `F_e` of the environment on the tool, in N.
    pub force: Axes<3>,
    /// R, `base_from_tool`.
    pub orientation: UnitQuaternion<f64>,
    /// w in rad/s.
    pub angular_velocity: Axes<3>,
    /// Torque of the environment on the tool, in N m.
    pub torque: Axes<3>,
}

/// Memory of a Runge-Kutta step.
#[derive(Clone, Debug, PartialEq)]
struct Scratch {
    motion: Motion,
    loads: Loads,
    tool: [Rate; 4],
    bodies: Vec<[Rate; 4]>,
    handles: Vec<[[f64; 2]; 4]>,
}

/// A rigid tool under an impedance servo, with contact points, in a world whose objects it can hold.
///
/// ```text
/// m x'' = K (x_set - x) + B (v_set - v) + F_e
/// I w' + w x I w = k_r log(R_set R') + b_r (w_set - w) + tau_e
/// F_e = sum f_i,  tau_e = sum R p_i x f_i
/// ```
///
/// The sums run over the contact forces `f_i` at the points `p_i` of the tool, pushers and torques, and the reaction of
/// a held object. Torques are about the tool point, which is the centre of mass; gravity does not act on the tool.
///
/// **Handles** turn about one axis: `J theta'' = -b theta' - c sign(theta') - k theta + (p x f + tau)·a`.
///
/// **Bodies** are boxes under gravity that rest on surfaces with their corners; the tool touches them only with its
/// jaws. A stiff spring and damper in translation and rotation binds a held object. Between jaws it slips if the force
/// across their closing direction, the tool's x axis, exceeds `2 mu F`, or if the moment exceeds `2 mu F r`. It is
/// released once it has slipped out of the jaws.
///
/// **Integrator.** Runge-Kutta-Munthe-Kaas of order 4, with at least 25 sub-steps per oscillation of the stiffest part;
/// R stays a rotation. A sub-step ends where a torque, a push or the motion of an object has a kink. Contacts are not
/// located. Friction at a surface is regularised as in [`Contact`](crate::Contact), so the equations are continuous.
/// Slip between jaws is applied after each sub-step.
///
/// Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; Munthe-Kaas 1998; Hogan 1985 (impedance).
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedTool {
    world: World,
    motion: Motion,
    scratch: Scratch,
    set: SetPose,
    takes_force: bool,
    sample: ToolSample,
    touches: bool,
    jaw_width: f64,
    jaw_friction: f64,
    jaw_radius: f64,
    jaws: Option<f64>,
    /// Rate of the stiffest part in rad/s.
    rate: f64,
    begun_ns: u64,
    now_ns: u64,
    started_ns: Option<u64>,
}

fn pushers(of: &[PusherSettings<3>]) -> Result<Vec<Pusher<3>>, ModelError> {
    of.iter().map(PusherSettings::pusher).collect()
}

/// Springs and dampers of an arm and its tool.
fn servo(arm: &ArmSettings<3>, tool: &ToolSettings) -> Result<Servo, ModelError> {
    Ok(Servo {
        stiffness: non_negative("stiffness", arm.stiffness)?,
        damping: non_negative("damping", arm.damping)?,
        rotational_stiffness: tool.rotational_stiffness,
        rotational_damping: tool.rotational_damping,
        max_speed: arm.max_speed.unwrap_or(f64::INFINITY),
        max_angular_speed: tool.max_angular_speed.unwrap_or(f64::INFINITY),
        viscous: non_negative("viscous", arm.viscous)?,
    })
}

impl SimulatedTool {
    /// A tool at rest at `now_ns` in its world, on an arm with `pd` control.
    pub fn new(
        arm: &ArmSettings<3>,
        tool: &ToolSettings,
        world: &ToolWorldSettings,
        now_ns: u64,
    ) -> Result<Self, ModelError> {
        if arm.control != ControlKind::Pd {
            let allowed = "\"pd\" for an arm that turns: it alone yields to what it touches";
            return Err(ModelError { name: "slave control", seen: f64::NAN, allowed });
        }
        tool.check()?;
        let inertia = Inertia { mass_kg: positive("mass_kg", arm.mass_kg)?, moments: tool.inertia_kg_m2 };
        let servo = servo(arm, tool)?;
        let least = tool.inertia_kg_m2.min();
        let handles = world
            .handles
            .iter()
            .map(|handle| Handle::new(handle, inertia.mass_kg, least))
            .collect::<Result<Vec<_>, _>>()?;
        let (mut bodies, mut lying) = (Vec::new(), Vec::new());
        for settings in &world.bodies {
            let (body, rigid) = Body::new(settings)?;
            bodies.push(body);
            lying.push(rigid);
        }
        let lightest = bodies.iter().map(|body| body.inertia.mass_kg).fold(inertia.mass_kg, f64::min);
        let smallest = bodies.iter().map(|body| body.inertia.moments.min()).fold(least, f64::min);
        let linear = tool.jaw_stiffness;
        let angular = linear * tool.jaw_radius_m * tool.jaw_radius_m;
        let world = World {
            servo,
            exerted: None,
            inertia,
            points: tool.points.iter().copied().map(Axes::from).collect(),
            surroundings: Surroundings::new(world)?,
            pushers: pushers(&world.pushers)?,
            torques: pushers(&world.torques)?,
            jaw_stiffness: Stiffness {
                linear: (linear, (linear * lightest).sqrt()),
                angular: (angular, (angular * smallest).sqrt()),
            },
            handles,
            bodies,
            held: None,
            grip: None,
            push_from: f64::INFINITY,
        };
        let rate = world.rate();
        require("rate of tool and world", rate, rate <= MAX_RATE, ALLOWED_RATE)?;
        let tool_at = Rigid {
            position: finite("position", arm.position.into())?,
            velocity: Axes::zeros(),
            orientation: orientation("tool quat_wxyz", tool.quat_wxyz)?,
            momentum: Axes::zeros(),
        };
        let motion = Motion { tool: tool_at, bodies: lying, handles: vec![[0.0; 2]; world.handles.len()] };
        let loads = Loads {
            bodies: vec![Load::default(); motion.bodies.len()],
            handles: vec![0.0; motion.handles.len()],
            ..Loads::default()
        };
        let scratch = Scratch {
            motion: motion.clone(),
            loads,
            tool: [Rate::default(); 4],
            bodies: vec![[Rate::default(); 4]; motion.bodies.len()],
            handles: vec![[[0.0; 2]; 4]; motion.handles.len()],
        };
        let zeros = Axes::zeros();
        let set = SetPose {
            position: tool_at.position,
            velocity: zeros,
            orientation: tool_at.orientation,
            angular_velocity: zeros,
            at_s: 0.0,
        };
        let sample = ToolSample {
            position: tool_at.position,
            velocity: zeros,
            force: zeros,
            orientation: tool_at.orientation,
            angular_velocity: zeros,
            torque: zeros,
        };
        Ok(Self {
            world,
            motion,
            scratch,
            set,
            takes_force: arm.takes_force,
            sample,
            touches: false,
            jaw_width: tool.jaw_width_m,
            jaw_friction: tool.jaw_friction,
            jaw_radius: tool.jaw_radius_m,
            jaws: None,
            rate,
            begun_ns: now_ns,
            now_ns,
            started_ns: None,
        })
    }

    /// Set the clock to `now_ns` without advancing: everything rests until then.
    pub fn begin(&mut self, now_ns: u64) {
        (self.begun_ns, self.now_ns) = (now_ns, now_ns);
        self.set.at_s = 0.0;
    }

    /// Start the time of pushers and torques; later calls have no effect. Without jaws the tool holds the nearest
    /// handle within reach from here on.
    pub fn start(&mut self, now_ns: u64) {
        if self.started_ns.is_some() {
            return;
        }
        self.started_ns = Some(now_ns);
        if self.jaws.is_none() {
            self.world.held = self.handle_in_reach().map(|index| self.taken_handle(index));
        }
    }

    fn time_s(&self, now_ns: u64) -> f64 {
        now_ns.saturating_sub(self.begun_ns) as f64 * 1e-9
    }

    /// Exert a force in N and a torque in N m until the next command. Values that are not finite are ignored. An arm that
    /// takes motions only ignores all.
    pub fn exert(&mut self, force: &Axes<3>, torque: &Axes<3>) {
        if self.takes_force && all_finite(force) && all_finite(torque) {
            self.world.exerted = Some(Load { force: *force, torque: *torque });
        }
    }

    /// Follow a set pose again, from where the tool is.
    fn follow(&mut self) {
        if self.world.exerted.take().is_some() {
            let Rigid { position, orientation, .. } = self.motion.tool;
            let zeros = Axes::zeros();
            let at_s = self.time_s(self.now_ns);
            self.set = SetPose { position, velocity: zeros, orientation, angular_velocity: zeros, at_s };
        }
    }

    /// Command a position in m and the velocity there in m/s. Values that are not finite are ignored.
    pub fn write(&mut self, position: &Axes<3>, velocity: &Axes<3>) {
        if !all_finite(position) {
            return;
        }
        self.follow();
        let t = self.time_s(self.now_ns);
        let (_, turned) = self.set.at(t);
        let most = self.world.servo.max_speed * self.unwritten_s(t);
        let way = position - self.set.position;
        let over = way.norm() > most;
        self.set.position = if over { self.set.position + way * (most / way.norm()) } else { *position };
        let bound = self.world.servo.max_speed;
        self.set.velocity = if all_finite(velocity) { velocity.cap_magnitude(bound) } else { Axes::zeros() };
        // The set orientation continues from its present value.
        self.set.orientation = Unit::new_normalize(turned.into_inner());
        self.set.at_s = t;
    }

    /// Time in s since the last write, up to the time for which a set pose may catch up at once.
    fn unwritten_s(&self, t: f64) -> f64 {
        (t - self.set.at_s).min(MAX_UNWRITTEN_S)
    }

    /// Command an orientation and its angular velocity in rad/s, before each [`write`](Self::write). Values that are
    /// not finite are ignored.
    pub fn write_rotation(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) {
        if !orientation.coords.iter().all(|part| part.is_finite()) {
            return;
        }
        self.follow();
        let t = self.time_s(self.now_ns);
        let bound = self.world.servo.max_angular_speed;
        let before = self.set.orientation;
        let way = (orientation * before.inverse()).scaled_axis();
        let most = bound * self.unwritten_s(t);
        let wanted = if way.norm() > most {
            UnitQuaternion::from_scaled_axis(way * (most / way.norm())) * before
        } else {
            *orientation
        };
        let velocity =
            if all_finite(angular_velocity) { angular_velocity.cap_magnitude(bound) } else { Axes::zeros() };
        // Extrapolated back by this time, so that the next `write` keeps the orientation.
        let since = t - self.set.at_s;
        self.set.angular_velocity = velocity;
        self.set.orientation = UnitQuaternion::from_scaled_axis(velocity * -since) * wanted;
    }

    /// Hold the present set pose, and return it.
    pub fn stop(&mut self) -> (Axes<3>, UnitQuaternion<f64>) {
        self.follow();
        let t = self.time_s(self.now_ns);
        let (position, orientation) = self.set.at(t);
        let orientation = Unit::new_normalize(orientation.into_inner());
        let zeros = Axes::zeros();
        self.set = SetPose { position, velocity: zeros, orientation, angular_velocity: zeros, at_s: t };
        (position, orientation)
    }

    /// Present set orientation.
    pub fn set_orientation(&self) -> UnitQuaternion<f64> {
        self.set.at(self.time_s(self.now_ns)).1
    }

    /// Set the jaw position, 0 open to 1 closed, and the grip force in N; called at each tick of a tool with a gripper.
    pub fn grip(&mut self, jaws: f64, force_n: f64) {
        if !(jaws.is_finite() && force_n.is_finite()) {
            return;
        }
        self.jaws = Some(jaws);
        if force_n <= 0.0 {
            (self.world.held, self.world.grip) = (None, None);
            return;
        }
        let force = 2.0 * self.jaw_friction * force_n;
        self.world.grip = Some(Grip { force, moment: force * self.jaw_radius });
        let Some((held, at)) = self.between() else { return };
        let is_near = (jaws - at).abs() <= JAW_PLAY;
        self.world.held = is_near.then_some(held).or(self.world.held.filter(|_| jaws >= at - JAW_PLAY));
    }

    /// True if its world has anything to hold.
    pub fn has_things_to_hold(&self) -> bool {
        !(self.world.handles.is_empty() && self.world.bodies.is_empty())
    }

    /// Position at which the jaws meet the object between them, 0 open to 1 closed; none without an object.
    pub fn between_jaws(&self) -> Option<f64> {
        self.between().map(|(_, at)| at)
    }

    /// Object between the jaws, as if it were taken now, and the jaw position at which they meet it.
    fn between(&self) -> Option<(Held, f64)> {
        let at = |width: f64| (width <= self.jaw_width).then_some(1.0 - width / self.jaw_width);
        match self.world.held {
            Some(held @ Held::Handle(index, _)) => return Some((held, at(self.world.handles[index].width)?)),
            Some(held @ Held::Body(index, _)) => return Some((held, at(self.body_width(index))?)),
            None => {}
        }
        if let Some(index) = self.handle_in_reach() {
            return Some((self.taken_handle(index), at(self.world.handles[index].width)?));
        }
        let tool = self.tool_frame();
        let reached = |index: &usize| {
            self.world.bodies[*index].in_reach(&tool, &self.world.body_frame(&self.motion, *index))
        };
        let index = (0..self.world.bodies.len()).find(reached)?;
        let hold = Hold::at(&tool, &self.world.body_frame(&self.motion, index));
        Some((Held::Body(index, hold), at(self.body_width(index))?))
    }

    /// Width in m of a box along the closing direction of the jaws.
    fn body_width(&self, index: usize) -> f64 {
        let (body, rigid) = (&self.world.bodies[index], &self.motion.bodies[index]);
        let closing = rigid.orientation.inverse() * (self.motion.tool.orientation * Axes::<3>::x());
        2.0 * closing.abs().dot(&body.half_extents)
    }

    fn tool_frame(&self) -> Frame {
        self.world.tool_frame(&self.motion)
    }

    fn handle_in_reach(&self) -> Option<usize> {
        let away = |index: usize| {
            let grip = self.world.handles[index].frame(self.motion.handles[index]).position;
            (grip - self.motion.tool.position).norm()
        };
        (0..self.world.handles.len())
            .filter(|index| away(*index) <= self.world.handles[*index].reach)
            .min_by(|a, b| away(*a).total_cmp(&away(*b)))
    }

    fn taken_handle(&self, index: usize) -> Held {
        let frame = self.world.handles[index].frame(self.motion.handles[index]);
        Held::Handle(index, Hold::at(&self.tool_frame(), &frame))
    }

    /// True if the tool holds something.
    pub fn holds(&self) -> bool {
        self.world.held.is_some()
    }

    /// True if the tool touches or holds something.
    pub fn touches(&self) -> bool {
        self.touches || self.holds()
    }

    /// Measurement at the last read.
    pub fn sample(&self) -> &ToolSample {
        &self.sample
    }

    /// Angle in rad and rate in rad/s of a handle.
    pub fn handle(&self, index: usize) -> Option<[f64; 2]> {
        self.motion.handles.get(index).copied()
    }

    /// Centre in m and orientation of a body.
    pub fn body(&self, index: usize) -> Option<(Axes<3>, UnitQuaternion<f64>)> {
        self.motion.bodies.get(index).map(|body| (body.position, body.orientation))
    }

    /// Pass the state of the world to `take`: `hole_depth` in m of its deepest point (0 for a tool without points),
    /// `handle_angle` in rad, `body_position` in m and `body_orientation`, w first. Each entry covers all objects of
    /// its kind.
    pub fn world(&self, take: &mut dyn FnMut(&'static str, &[f64])) {
        let tool = &self.motion.tool;
        let deepest = |hole: &Hole| {
            let depth = |point: &Axes<3>| hole.depth_of(&(tool.position + tool.orientation * point));
            self.world.points.iter().map(depth).reduce(f64::max).unwrap_or(0.0)
        };
        let mut all = |name, values: Vec<f64>| {
            if !values.is_empty() {
                take(name, &values);
            }
        };
        let bodies = &self.motion.bodies;
        all("hole_depth", self.world.surroundings.holes.iter().map(deepest).collect());
        all("handle_angle", self.motion.handles.iter().map(|[angle, _]| *angle).collect());
        all("body_position", bodies.iter().flat_map(|body| body.position.data.0[0]).collect());
        let turned = |body: &Rigid| {
            let [x, y, z, w] = body.orientation.coords.into();
            [w, x, y, z]
        };
        all("body_orientation", bodies.iter().flat_map(turned).collect());
    }

    /// Advance to `now_ns` (monotonic) and return the measurement there.
    pub fn read(&mut self, now_ns: u64) -> ToolSample {
        let from = self.time_s(self.now_ns);
        let span = now_ns.saturating_sub(self.now_ns) as f64 * 1e-9;
        self.now_ns = self.now_ns.max(now_ns);
        self.world.push_from = self.started_ns.map_or(f64::INFINITY, |started_ns| self.time_s(started_ns));
        let mut begun = 0.0;
        while begun < span {
            let kink = (self.world.next_kink(from + begun) - from).max(begun + SHORTEST);
            let end = if span - kink < SHORTEST { span } else { kink };
            let piece = from + 0.5 * (begun + end);
            let steps = ((end - begun) * self.rate / STEP_PHASE).ceil().max(1.0);
            let step = (end - begun) / steps;
            let mut done = 0.0;
            while done < steps {
                self.step(piece, from + begun + done * step, step);
                done += 1.0;
            }
            begun = end;
        }
        let t = from + span;
        self.world.loads(&self.motion, &self.set, t, t, &mut self.scratch.loads);
        let (tool, load) = (&self.motion.tool, &self.scratch.loads.environment);
        self.touches = self.scratch.loads.touches;
        self.sample = ToolSample {
            position: tool.position,
            velocity: tool.velocity,
            force: load.force,
            orientation: tool.orientation,
            angular_velocity: tool.angular_velocity(&self.world.inertia),
            torque: load.torque,
        };
        self.sample
    }

    /// One step in s from t, within the smooth piece valid at time `piece`.
    fn step(&mut self, piece: f64, t: f64, step: f64) {
        for stage in 0..4 {
            let share = [0.0, 0.5, 0.5, 1.0][stage] * step;
            let Scratch { motion, loads, tool, bodies, handles } = &mut self.scratch;
            let mut turn = Axes::zeros();
            if stage == 0 {
                // In place: a derived `clone_from` allocates.
                motion.tool = self.motion.tool;
                motion.bodies.copy_from_slice(&self.motion.bodies);
                motion.handles.copy_from_slice(&self.motion.handles);
            } else {
                (motion.tool, turn) = self.motion.tool.after(&tool[stage - 1], share);
            }
            for (index, rates) in handles.iter_mut().enumerate() {
                let [angle, rate] = self.motion.handles[index];
                if stage > 0 {
                    let [of_angle, of_rate] = rates[stage - 1];
                    motion.handles[index] = [angle + of_angle * share, rate + of_rate * share];
                }
            }
            // The turn of each body since the start of the step is needed again below, so it is computed before the
            // loads.
            for (index, rates) in bodies.iter().enumerate() {
                if stage > 0 {
                    motion.bodies[index] = self.motion.bodies[index].after(&rates[stage - 1], share).0;
                }
            }
            self.world.loads(motion, &self.set, piece, t + share, loads);
            tool[stage] = motion.tool.rate(&self.world.inertia, &loads.tool, &turn);
            for (index, rates) in bodies.iter_mut().enumerate() {
                let turn = if stage == 0 {
                    Axes::zeros()
                } else {
                    self.motion.bodies[index].after(&rates[stage - 1], share).1
                };
                let inertia = &self.world.bodies[index].inertia;
                rates[stage] = motion.bodies[index].rate(inertia, &loads.bodies[index], &turn);
            }
            for (index, rates) in handles.iter_mut().enumerate() {
                let acceleration = loads.handles[index] / self.world.handles[index].inertia;
                rates[stage] = [motion.handles[index][1], acceleration];
            }
        }
        let Scratch { tool, bodies, handles, .. } = &self.scratch;
        self.motion.tool = self.motion.tool.after(&mean(tool), step).0;
        for (body, rates) in self.motion.bodies.iter_mut().zip(bodies) {
            *body = body.after(&mean(rates), step).0;
        }
        for (handle, [a, b, c, d]) in self.motion.handles.iter_mut().zip(handles) {
            for (value, part) in handle.iter_mut().zip([0, 1]) {
                *value += step * (a[part] + 2.0 * (b[part] + c[part]) + d[part]) / 6.0;
            }
        }
        self.world.slip(&self.motion);
    }

    /// Kinetic energy of tool, bodies and handles, in J.
    pub fn kinetic_energy_j(&self) -> f64 {
        let tool = self.motion.tool.kinetic_energy_j(&self.world.inertia);
        let bodies = self.motion.bodies.iter().zip(&self.world.bodies);
        let bodies: f64 = bodies.map(|(rigid, body)| rigid.kinetic_energy_j(&body.inertia)).sum();
        let handles = self.motion.handles.iter().zip(&self.world.handles);
        tool + bodies + handles.map(|([_, rate], handle)| 0.5 * handle.inertia * rate * rate).sum::<f64>()
    }
}
