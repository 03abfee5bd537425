//! Servo and surroundings of a tool: the forces on the tool and on held objects.

use nalgebra::UnitQuaternion;

use super::{
    body::Body,
    handle::{FULL_TURN, Handle, STOP_STIFFNESS},
    hold::{Frame, Grip, Hold, Stiffness},
    rigid::{Inertia, Load, Rigid},
    surroundings::Surroundings,
};
use crate::{Axes, FULL_SLIP, Pusher};

/// Set pose of the servo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SetPose {
    pub(super) position: Axes<3>,
    pub(super) velocity: Axes<3>,
    pub(super) orientation: UnitQuaternion<f64>,
    pub(super) angular_velocity: Axes<3>,
    /// Time at which it was set, in s.
    pub(super) at_s: f64,
}

impl SetPose {
    pub(super) fn at(&self, t: f64) -> (Axes<3>, UnitQuaternion<f64>) {
        let since = t - self.at_s;
        let turn = UnitQuaternion::from_scaled_axis(self.angular_velocity * since);
        (self.position + self.velocity * since, turn * self.orientation)
    }
}

/// Springs and dampers between the set pose and the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Servo {
    pub(super) stiffness: f64,
    pub(super) damping: f64,
    pub(super) rotational_stiffness: f64,
    pub(super) rotational_damping: f64,
    pub(super) max_speed: f64,
    pub(super) max_angular_speed: f64,
    /// b in N s/m under a force.
    pub(super) viscous: f64,
}

/// State of everything that moves.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Motion {
    pub(super) tool: Rigid,
    pub(super) bodies: Vec<Rigid>,
    /// Angle in rad and rate in rad/s of each handle.
    pub(super) handles: Vec<[f64; 2]>,
}

/// Loads on everything that moves.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Loads {
    pub(super) tool: Load,
    /// The part of the tool's load that is not from the servo.
    pub(super) environment: Load,
    pub(super) bodies: Vec<Load>,
    pub(super) handles: Vec<f64>,
    pub(super) touches: bool,
}

/// Object held by the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Held {
    Handle(usize, Hold),
    Body(usize, Hold),
}

/// Everything without its own state, and the couplings.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct World {
    pub(super) servo: Servo,
    /// `F_c` in N and `tau_c` in N m that the servo exerts instead of following the set pose; None while it follows.
    pub(super) exerted: Option<Load>,
    pub(super) inertia: Inertia,
    pub(super) points: Vec<Axes<3>>,
    pub(super) surroundings: Surroundings,
    pub(super) pushers: Vec<Pusher<3>>,
    pub(super) torques: Vec<Pusher<3>>,
    pub(super) handles: Vec<Handle>,
    pub(super) bodies: Vec<Body>,
    pub(super) jaw_stiffness: Stiffness,
    pub(super) held: Option<Held>,
    /// Grip of the jaws, if there are any.
    pub(super) grip: Option<Grip>,
    /// Origin of the time of pushers and torques, in s; infinity before they start.
    pub(super) push_from: f64,
}

impl World {
    /// Rate in rad/s of the stiffest part, oscillating or damped, with all points and corners in contact at once.
    pub(super) fn rate(&self) -> f64 {
        let (contact, damping) = self.surroundings.stiffest();
        let swings =
            |stiffness: f64, damping: f64, inertia: f64| (stiffness / inertia).sqrt().max(damping / inertia);
        let count = self.points.len() as f64;
        let held = self.handles.iter().map(|handle| handle.hold).chain([self.jaw_stiffness]);
        let (mut most, mut turning) = ((0.0_f64, 0.0_f64), (0.0_f64, 0.0_f64));
        for Stiffness { linear, angular } in held {
            most = (most.0.max(linear.0), most.1.max(linear.1));
            turning = (turning.0.max(angular.0), turning.1.max(angular.1));
        }
        if self.handles.is_empty() && self.bodies.is_empty() {
            (most, turning) = ((0.0, 0.0), (0.0, 0.0));
        }
        let reach: f64 = self.points.iter().map(Axes::norm_squared).sum();
        let Servo { stiffness, damping: of_servo, rotational_stiffness, rotational_damping, .. } = self.servo;
        let least = self.inertia.moments.min();
        let mut rate = swings(
            stiffness + count * contact + most.0,
            of_servo + count * damping + most.1,
            self.inertia.mass_kg,
        )
        .max(swings(
            rotational_stiffness + reach * contact + turning.0,
            rotational_damping + reach * damping + turning.1,
            least,
        ));
        for body in &self.bodies {
            let Inertia { mass_kg, moments } = body.inertia;
            let lever = 8.0 * body.half_extents.norm_squared();
            // Friction under its own weight below full slip.
            let sliding = body.gravity / FULL_SLIP;
            rate = rate
                .max(swings(8.0 * contact + most.0, 8.0 * damping + most.1, mass_kg))
                .max(swings(lever * contact + turning.0, lever * damping + turning.1, moments.min()))
                .max(sliding);
        }
        for handle in &self.handles {
            let lever = handle.lever.norm_squared();
            let stiffness =
                handle.stiffness + STOP_STIFFNESS + handle.hold.linear.0 * lever + handle.hold.angular.0;
            let damping = handle.viscous
                + 2.0 * (STOP_STIFFNESS * handle.inertia).sqrt()
                + handle.coulomb / FULL_TURN
                + handle.hold.linear.1 * lever
                + handle.hold.angular.1;
            rate = rate.max(swings(stiffness, damping, handle.inertia));
        }
        rate
    }

    pub(super) fn tool_frame(&self, motion: &Motion) -> Frame {
        let Rigid { position, velocity, orientation, .. } = motion.tool;
        let angular_velocity = motion.tool.angular_velocity(&self.inertia);
        Frame { position, velocity, orientation, angular_velocity }
    }

    pub(super) fn body_frame(&self, motion: &Motion, index: usize) -> Frame {
        let rigid = &motion.bodies[index];
        let Rigid { position, velocity, orientation, .. } = *rigid;
        let angular_velocity = rigid.angular_velocity(&self.bodies[index].inertia);
        Frame { position, velocity, orientation, angular_velocity }
    }

    /// First time in s after t at which a push, a torque or the motion of an object has a kink.
    pub(super) fn next_kink(&self, t: f64) -> f64 {
        let pushers = self.pushers.iter().chain(&self.torques);
        let pushed = pushers.map(|pusher| pusher.next_kink(t - self.push_from) + self.push_from);
        pushed.fold(self.surroundings.next_kink(t), f64::min)
    }

    /// All loads at t in s, on the smooth piece valid at time `piece`.
    pub(super) fn loads(&self, motion: &Motion, set: &SetPose, piece: f64, t: f64, loads: &mut Loads) {
        let tool = self.tool_frame(motion);
        let Loads { environment, bodies, handles, touches, .. } = loads;
        (*environment, *touches) = (Load::default(), false);
        for point in &self.points {
            let lever = tool.orientation * point;
            let velocity = tool.velocity + tool.angular_velocity.cross(&lever);
            let (force, inside) = self.surroundings.force(&(tool.position + lever), &velocity, piece, t);
            environment.add(&force, &lever);
            *touches |= inside;
        }
        let (on, pushed_s) = (piece - self.push_from, t - self.push_from);
        for pusher in &self.pushers {
            environment.force += pusher.on(on, pushed_s);
        }
        for torque in &self.torques {
            environment.torque += torque.on(on, pushed_s);
        }
        for (index, (body, load)) in self.bodies.iter().zip(bodies.iter_mut()).enumerate() {
            *load = self.lying(body, &self.body_frame(motion, index), piece, t);
        }
        for ((handle, state), torque) in self.handles.iter().zip(&motion.handles).zip(handles.iter_mut()) {
            *torque = handle.own_torque(*state);
        }
        match &self.held {
            None => {}
            Some(Held::Handle(index, hold)) => {
                let handle = &self.handles[*index];
                let frame = handle.frame(motion.handles[*index]);
                let load = hold.load(&tool, &frame, &handle.hold, self.grip.as_ref());
                environment.add(&-load.force, &(frame.position - tool.position));
                environment.torque -= load.torque;
                let lever = frame.position - handle.point;
                handles[*index] += handle.axis.dot(&(lever.cross(&load.force) + load.torque));
            }
            Some(Held::Body(index, hold)) => {
                let frame = self.body_frame(motion, *index);
                let load = hold.load(&tool, &frame, &self.jaw_stiffness, self.grip.as_ref());
                environment.add(&-load.force, &(frame.position - tool.position));
                environment.torque -= load.torque;
                bodies[*index].force += load.force;
                bodies[*index].torque += load.torque;
            }
        }
        let servo = self.servo_load(set, &tool, t);
        loads.tool = Load {
            force: servo.force + loads.environment.force,
            torque: servo.torque + loads.environment.torque,
        };
    }

    /// Load of the servo on the tool at t in s.
    fn servo_load(&self, set: &SetPose, tool: &Frame, t: f64) -> Load {
        let Servo { stiffness, damping, rotational_stiffness, rotational_damping, viscous, .. } = self.servo;
        if let Some(Load { force, torque }) = self.exerted {
            return Load { force: force - tool.velocity * viscous, torque };
        }
        let (position, orientation) = set.at(t);
        let way = (orientation * tool.orientation.inverse()).scaled_axis();
        Load {
            force: (position - tool.position) * stiffness + (set.velocity - tool.velocity) * damping,
            torque: way * rotational_stiffness
                + (set.angular_velocity - tool.angular_velocity) * rotational_damping,
        }
    }

    /// Gravity, and the contacts of the corners of a box.
    pub(super) fn lying(&self, body: &Body, frame: &Frame, piece: f64, t: f64) -> Load {
        let mut load = Load::default();
        load.force[2] = -body.inertia.mass_kg * body.gravity;
        for corner in 0..8_u8 {
            let sign = |axis: u8| if corner >> axis & 1 == 0 { 1.0 } else { -1.0 };
            let signs = Axes::<3>::new(sign(0), sign(1), sign(2));
            let lever = frame.orientation * signs.component_mul(&body.half_extents);
            let velocity = frame.velocity + frame.angular_velocity.cross(&lever);
            let (force, _) = self.surroundings.force(&(frame.position + lever), &velocity, piece, t);
            load.add(&force, &lever);
        }
        load
    }

    /// Let a held object slip beyond the grip of the jaws; release it once it has slipped out.
    pub(super) fn slip(&mut self, motion: &Motion) {
        let (Some(grip), Some(held)) = (self.grip, self.held) else { return };
        let tool = self.tool_frame(motion);
        self.held = match held {
            Held::Handle(index, mut hold) => {
                let (handle, frame) =
                    (&self.handles[index], self.handles[index].frame(motion.handles[index]));
                hold.slip(&tool, &frame, &handle.hold, &grip);
                let is_near = (frame.position - tool.position).norm() <= handle.reach;
                is_near.then_some(Held::Handle(index, hold))
            }
            Held::Body(index, mut hold) => {
                let frame = self.body_frame(motion, index);
                hold.slip(&tool, &frame, &self.jaw_stiffness, &grip);
                self.bodies[index].in_reach(&tool, &frame).then_some(Held::Body(index, hold))
            }
        };
    }
}
