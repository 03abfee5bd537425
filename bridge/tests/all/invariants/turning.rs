//! Hands and arms that turn: models, and devices with drivers.

use std::{cell::RefCell, rc::Rc};

use haptether_bridge::{
    DrivenSlave, MasterPlant, SlaveOrder, SlavePlant, ToolMotion, TurningMaster, coupling::RotationState,
};
use haptether_master::{
    LegShape, RotationHand, RotationHandParameters, RotationLeg, RotationParameters, RotationSample,
    SimulatedMaster, SimulatedRotation,
};
use haptether_safety::Axes;
use haptether_slave::{
    ArmSettings, ContactLawKind, ContactSettings, ControlKind, GripperSample, ObjectSettings, ShapeSettings,
    SimulatedTool, ToolSettings, ToolWorldSettings,
};
use nalgebra::{Unit, UnitQuaternion};

use super::{drawn::Drawn, spied::Turning, turned::DrawnPose};

/// Angular deceleration in rad/s² of a driven arm that is no longer led.
const ANGULAR_DECELERATION: f64 = 25.0;

fn turned(by: Axes<3>, from: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((UnitQuaternion::from_scaled_axis(by) * from).into_inner())
}

fn quat_wxyz(of: &UnitQuaternion<f64>) -> [f64; 4] {
    [of.w, of.i, of.j, of.k]
}

/// Device that turns exactly as its hand does, because the hand is much stronger than any torque.
#[derive(Clone, Debug)]
struct Led {
    point: SimulatedMaster<3>,
    orientation: UnitQuaternion<f64>,
    velocity: Axes<3>,
    turns: Vec<(f64, Axes<3>)>,
    measures: bool,
    now_ns: u64,
}

impl MasterPlant<3> for Led {
    fn begin(&mut self, now_ns: u64) {
        self.point.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<3>, Option<Axes<3>>) {
        let past_ns = now_ns - std::mem::replace(&mut self.now_ns, now_ns);
        let at_s = now_ns as f64 * 1e-9;
        let turn = self.turns.iter().find(|(until_s, _)| at_s < *until_s);
        self.velocity = turn.map_or(Axes::<3>::zeros(), |(_, velocity)| *velocity);
        self.orientation = turned(self.velocity * (past_ns as f64 * 1e-9), &self.orientation);
        MasterPlant::read(&mut self.point, now_ns)
    }

    fn write(&mut self, force: &Axes<3>) {
        self.point.write(force);
    }

    fn engaged(&mut self) {
        self.point.engaged();
    }

    fn rotation(&self) -> Option<RotationSample> {
        let angular_velocity = self.measures.then_some(self.velocity);
        Some(RotationSample { orientation: self.orientation, angular_velocity })
    }
}

/// Return the device of a scene of kind pose.
pub(crate) fn device(point: SimulatedMaster<3>, pose: &DrawnPose) -> Box<dyn MasterPlant<3>> {
    let start = pose.starts[0];
    if !pose.is_modelled[0] {
        let (turns, measures) = (pose.turns.clone(), pose.measures);
        let velocity = Axes::zeros();
        return Box::new(Led { point, orientation: start, velocity, turns, measures, now_ns: 0 });
    }
    let (mut end, mut from_s) = (start, 0.0);
    let legs = pose.turns.iter().map(|(until_s, velocity)| {
        let duration_s = until_s - std::mem::replace(&mut from_s, *until_s);
        // The hand turns by less than pi in one leg.
        end = turned((velocity * duration_s).cap_magnitude(3.0), &end);
        RotationLeg { duration_s, end_wxyz: quat_wxyz(&end), shape: LegShape::MinimumJerk }
    });
    let hand = RotationHandParameters {
        stiffness: 1.0,
        damping: 0.02,
        strength_n_m: None,
        start_wxyz: quat_wxyz(&start),
        legs: legs.collect(),
        release: None,
    };
    let parameters = RotationParameters {
        measures_angular_velocity: pose.measures,
        ..RotationParameters::ideal(pose.inertia_kg_m2, 0.0, 0.0)
    };
    let body = SimulatedRotation::new(parameters, RotationHand::new(&hand).unwrap(), 0).unwrap();
    Box::new(TurningMaster { point, body })
}

/// First order to a driver that violates the invariants.
pub(crate) type Complaint = Rc<RefCell<Option<String>>>;

/// Arm with a driver: it moves to the ordered position, and springs pull it back.
#[derive(Clone, Debug)]
pub(crate) struct DrivenArm {
    arm: DrivenSlave<3>,
    position: Axes<3>,
    orientation: UnitQuaternion<f64>,
    home: UnitQuaternion<f64>,
    /// Stiffness in N/m and N m/rad.
    stiffness: [f64; 2],
    rate: f64,
    now_ns: u64,
    /// Last order.
    ordered: Option<(Axes<3>, UnitQuaternion<f64>)>,
    /// Angular velocity of the last order.
    ordered_turn: Axes<3>,
    is_led: bool,
    turning: Turning,
    past_s: [f64; 2],
    moved_rad: Option<Axes<3>>,
    /// Largest ordered speeds in m/s and rad/s, with deceleration included.
    fastest: [f64; 2],
    complaint: Complaint,
}

impl DrivenArm {
    /// Follow the order for `past_s`.
    fn follow(&mut self, past_s: f64) {
        let [mut velocity, mut angular_velocity] = [Axes::<3>::zeros(); 2];
        if let SlaveOrder::Move { position, rotation, .. } = *self.arm.order() {
            let share = (self.rate * past_s).min(1.0);
            let way = (position - self.position) * share;
            self.position += way;
            let turn = rotation.map_or(Axes::<3>::zeros(), |(orientation, _)| {
                (orientation * self.orientation.inverse()).scaled_axis() * share
            });
            self.orientation = turned(turn, &self.orientation);
            (velocity, angular_velocity) = (way / past_s, turn / past_s);
        }
        let [stiffness, rotational_stiffness] = self.stiffness;
        let force = Axes::<3>::new((-stiffness * self.position.x).max(0.0), 0.0, 0.0);
        let back = (self.home * self.orientation.inverse()).scaled_axis();
        self.arm.sample = [self.position, velocity.cap_magnitude(1e3), force.cap_magnitude(1e3)];
        self.arm.rotation = Some(RotationState {
            orientation: self.orientation,
            angular_velocity: angular_velocity.cap_magnitude(1e3),
            torque: back * rotational_stiffness,
        });
    }

    /// Report orders that no driver could follow.
    fn check(&mut self) {
        let order = *self.arm.order();
        let before = self.ordered.take();
        let SlaveOrder::Move { position, velocity, rotation } = order else { return };
        let is_finite = position.iter().chain(&velocity).all(|x| x.is_finite());
        let is_sound = rotation.is_some_and(|(orientation, velocity)| {
            (orientation.quaternion().norm() - 1.0).abs() <= 1e-9 && velocity.iter().all(|x| x.is_finite())
        });
        self.ordered = rotation.map(|(orientation, _)| (position, orientation));
        let over_s = self.past_s[0].max(self.past_s[1]);
        let turn = rotation.map_or(Axes::zeros(), |(_, velocity)| velocity);
        let changed = (turn - std::mem::replace(&mut self.ordered_turn, turn)).norm();
        // A driven arm that is no longer led decelerates evenly and never stops at once.
        let is_led = self.is_led || self.turning.get();
        let brakes = is_led || before.is_none() || changed <= ANGULAR_DECELERATION * over_s + 1e-6;
        let follows = before.zip(self.ordered).is_none_or(|((from, turned_from), (to, turned_to))| {
            let most = |of: usize| self.fastest[of] * over_s * (1.0 + 1e-6) + 1e-7;
            (to - from).norm() <= most(0) && turned_to.angle_to(&turned_from) <= most(1)
        });
        if !(is_finite && is_sound && follows && brakes) {
            let at_ms = self.now_ns as f64 * 1e-6;
            let complain = || format!("at {at_ms} ms ordered {order:?} after {before:?}");
            self.complaint.borrow_mut().get_or_insert_with(complain);
        }
    }
}

/// Arm of a scene of kind pose.
#[derive(Clone, Debug)]
pub(crate) enum Arm {
    Modelled(Box<SimulatedTool>),
    Driven(Box<DrivenArm>),
}

impl Arm {
    pub(crate) fn new(drawn: &Drawn, pose: &DrawnPose, complaint: Complaint, turning: Turning) -> Self {
        let [mass_kg, bandwidth_hz, speed] = drawn.arm;
        let ([stiffness, damping], start) = (drawn.wall, pose.starts[1]);
        let position = Axes::<3>::new(0.02, 0.0, 0.0);
        if !pose.is_modelled[1] {
            let angular_speed = pose.slave.bounds.speed;
            // While the coupled point stays, the tool point moves around it.
            let round = pose.reference_m.map_or(0.0, |reference_m| reference_m.norm() * angular_speed);
            let arm = DrivenSlave::new(5.0).unwrap();
            return Self::Driven(Box::new(DrivenArm {
                arm,
                position,
                orientation: start,
                home: start,
                stiffness: [stiffness, pose.stiffness],
                rate: 10.0 * bandwidth_hz,
                now_ns: 0,
                ordered: None,
                ordered_turn: Axes::zeros(),
                is_led: false,
                turning,
                past_s: [0.0; 2],
                moved_rad: pose.moved_rad,
                // A clock with an error can make more motion due at once.
                fastest: if drawn.clocks[1].is_some() {
                    [f64::INFINITY; 2]
                } else {
                    [drawn.bounds.speed + round, angular_speed]
                },
                complaint,
            }));
        }
        let settings = ArmSettings {
            control: ControlKind::Pd,
            mass_kg,
            bandwidth_hz,
            stiffness: 100.0 * bandwidth_hz,
            damping: 2.0 * mass_kg * bandwidth_hz,
            max_speed: Some(speed),
            max_acceleration: None,
            takes_force: false,
            viscous: 0.0,
            max_force_n: 50.0,
            max_torque_nm: 5.0,
            speed_bound: None,
            period_s: 1e-3,
            position,
            force_sensor: None,
            gripper: None,
            tool: None,
        };
        let tool = ToolSettings {
            inertia_kg_m2: Axes::<3>::repeat(2e-2),
            rotational_stiffness: 20.0,
            rotational_damping: 1.0,
            max_angular_speed: None,
            quat_wxyz: quat_wxyz(&start),
            points: vec![[0.0; 3], [0.0, 0.03, 0.02]],
            jaw_width_m: 0.08,
            jaw_friction: 0.5,
            jaw_stiffness: 2e4,
            jaw_radius_m: 0.01,
        };
        let wall = ObjectSettings {
            shape: ShapeSettings::Plane { point: Axes::zeros(), normal: Axes::<3>::x() },
            contact: ContactSettings {
                law: ContactLawKind::KelvinVoigt,
                stiffness,
                damping,
                exponent: 1.0,
                friction: 0.3,
            },
            motion: None,
            body: None,
        };
        let world = ToolWorldSettings { objects: vec![wall], ..ToolWorldSettings::default() };
        Self::Modelled(Box::new(SimulatedTool::new(&settings, &tool, &world, 0).unwrap()))
    }

    fn plant(&mut self) -> &mut dyn SlavePlant<3> {
        match self {
            Self::Modelled(tool) => &mut **tool,
            Self::Driven(driven) => &mut driven.arm,
        }
    }

    fn as_plant(&self) -> &dyn SlavePlant<3> {
        match self {
            Self::Modelled(tool) => &**tool,
            Self::Driven(driven) => &driven.arm,
        }
    }
}

impl SlavePlant<3> for Arm {
    fn begin(&mut self, now_ns: u64) {
        self.plant().begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<3>; 3] {
        if let Self::Driven(driven) = self {
            let past_ns = now_ns - std::mem::replace(&mut driven.now_ns, now_ns);
            driven.past_s = [driven.past_s[1], past_ns.max(1) as f64 * 1e-9];
            driven.check();
            if past_ns > 0 && *driven.arm.order() == SlaveOrder::Wait {
                let by = driven.moved_rad.take().unwrap_or_default();
                driven.orientation = turned(by, &driven.orientation);
            }
            driven.follow(driven.past_s[1]);
        }
        self.plant().read(now_ns)
    }

    fn write(&mut self, position: &Axes<3>, velocity: &Axes<3>) {
        self.plant().write(position, velocity);
    }

    fn exert(&mut self, wrench: (&Axes<3>, &Axes<3>), motion: &ToolMotion<3>) {
        self.plant().exert(wrench, motion);
    }

    fn stop(&mut self) -> Axes<3> {
        self.plant().stop()
    }

    fn hold(&mut self) -> Axes<3> {
        if let Self::Driven(driven) = self {
            driven.is_led = false;
        }
        self.plant().hold()
    }

    fn engaged(&mut self, now_ns: u64) {
        if let Self::Driven(driven) = self {
            driven.is_led = true;
        }
        self.plant().engaged(now_ns);
    }

    fn rotation(&self) -> Option<RotationState> {
        self.as_plant().rotation()
    }

    fn write_rotation(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) {
        self.plant().write_rotation(orientation, angular_velocity);
    }

    fn rest_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.as_plant().rest_orientation()
    }

    fn braking_speeds(&self) -> [f64; 2] {
        self.as_plant().braking_speeds()
    }

    fn grip(&mut self, jaws: &GripperSample) -> Option<Option<f64>> {
        self.plant().grip(jaws)
    }

    fn touches(&self) -> bool {
        self.as_plant().touches()
    }
}
