//! Device or arm whose sensors may be faulty.

use haptether_bridge::{ButtonWord, MasterPlant, SlavePlant, ToolMotion, Truth, coupling::RotationState};
use haptether_master::RotationSample;
use haptether_safety::Axes;
use haptether_slave::GripperSample;
use nalgebra::{Quaternion, Unit, UnitQuaternion};

use super::{
    drawn::Broken,
    pressed::DrawnButtons,
    turned::{BrokenTurn, Wrong},
};

/// Plant with sensors that may be faulty. It stores the last written values.
#[derive(Clone, Debug)]
pub(crate) struct Plant<P, const N: usize> {
    pub(crate) model: P,
    broken: Option<Broken>,
    broken_turn: Option<BrokenTurn>,
    /// Fault of the rotation at this tick.
    wrong: Option<Wrong>,
    buttons: Option<DrawnButtons>,
    word: Option<ButtonWord>,
    /// Position, velocity and force of an arm, as measured at the last tick.
    pub(crate) sample: [Axes<N>; 3],
    pub(crate) written: Option<[Axes<N>; 2]>,
    pub(crate) torque: Option<Axes<3>>,
    pub(crate) turned: Option<(UnitQuaternion<f64>, Axes<3>)>,
    pub(crate) stops: u64,
}

impl<P, const N: usize> Plant<P, N> {
    pub(crate) fn new(model: P, broken: Option<Broken>) -> Self {
        Self {
            model,
            broken,
            broken_turn: None,
            wrong: None,
            buttons: None,
            word: None,
            sample: [Axes::zeros(); 3],
            written: None,
            torque: None,
            turned: None,
            stops: 0,
        }
    }

    /// Return the plant with a rotation sensor that may be faulty.
    pub(crate) fn turning(self, broken_turn: Option<BrokenTurn>) -> Self {
        Self { broken_turn, ..self }
    }

    /// Return the plant with buttons.
    pub(crate) fn with_buttons(self, buttons: Option<DrawnButtons>) -> Self {
        Self { buttons, ..self }
    }

    /// Return true if a sensor is faulty at this tick.
    pub(crate) fn is_broken(&self, now_ns: u64) -> bool {
        Broken::at(self.broken, now_ns).is_some() || self.wrong.is_some()
    }

    /// Return the fault of the rotation at this tick.
    pub(crate) fn wrong(&self) -> Option<Wrong> {
        self.wrong
    }

    fn orientation(&self, orientation: UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        match self.wrong {
            // Scaled by component, so that NaN and infinities stay.
            Some(Wrong::Norm(norm)) => {
                Unit::new_unchecked(Quaternion::from(orientation.coords.map(|part| part * norm)))
            }
            Some(Wrong::Leap(angle)) => {
                UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, 0.0, angle)) * orientation
            }
            _ => orientation,
        }
    }

    fn angular_velocity(&self, mut velocity: Axes<3>) -> Axes<3> {
        if let Some(Wrong::Speed(value)) = self.wrong {
            velocity[1] = value;
        }
        velocity
    }
}

impl<P: MasterPlant<N>, const N: usize> MasterPlant<N> for Plant<P, N> {
    fn begin(&mut self, now_ns: u64) {
        self.model.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        let (mut position, velocity) = self.model.read(now_ns);
        if let Some(value) = Broken::at(self.broken, now_ns) {
            position[N - 1] = value;
        }
        self.wrong = BrokenTurn::at(self.broken_turn, now_ns);
        self.word = self.buttons.as_ref().map(|buttons| buttons.at(now_ns));
        (position, velocity)
    }

    fn write(&mut self, force: &Axes<N>) {
        self.written = Some([*force, Axes::zeros()]);
        self.model.write(force);
    }

    fn buttons(&self) -> Option<ButtonWord> {
        // Also before the first tick: the value shows whether the plant has buttons.
        self.word.or(self.buttons.as_ref().map(|_| ButtonWord::UNKNOWN))
    }

    fn engaged(&mut self) {
        self.model.engaged();
    }

    /// None: records then hold the endpoint's values from the samples, as with a driver.
    fn truth(&self) -> Option<Truth<N>> {
        None
    }

    fn rotation(&self) -> Option<RotationSample> {
        let sample = self.model.rotation().filter(|_| !matches!(self.wrong, Some(Wrong::Unknown)))?;
        Some(RotationSample {
            orientation: self.orientation(sample.orientation),
            angular_velocity: sample.angular_velocity.map(|velocity| self.angular_velocity(velocity)),
        })
    }

    fn write_torque(&mut self, torque: &Axes<3>) {
        self.torque = Some(*torque);
        self.model.write_torque(torque);
    }
}

impl<P: SlavePlant<N>, const N: usize> SlavePlant<N> for Plant<P, N> {
    fn begin(&mut self, now_ns: u64) {
        self.model.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3] {
        let mut sample = self.model.read(now_ns);
        if let Some(value) = Broken::at(self.broken, now_ns) {
            sample[(now_ns % 3) as usize][N - 1] = value;
        }
        self.wrong = BrokenTurn::at(self.broken_turn, now_ns);
        self.sample = sample;
        sample
    }

    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        self.written = Some([*position, *velocity]);
        self.model.write(position, velocity);
    }

    fn exert(&mut self, wrench: (&Axes<N>, &Axes<3>), motion: &ToolMotion<N>) {
        self.model.exert(wrench, motion);
    }

    fn stop(&mut self) -> Axes<N> {
        self.stops += 1;
        self.model.stop()
    }

    fn hold(&mut self) -> Axes<N> {
        self.stops += 1;
        self.model.hold()
    }

    fn engaged(&mut self, now_ns: u64) {
        self.model.engaged(now_ns);
    }

    fn rotation(&self) -> Option<RotationState> {
        let mut state = self.model.rotation().filter(|_| !matches!(self.wrong, Some(Wrong::Unknown)))?;
        state.orientation = self.orientation(state.orientation);
        state.angular_velocity = self.angular_velocity(state.angular_velocity);
        if let Some(Wrong::Torque(value)) = self.wrong {
            state.torque[2] = value;
        }
        Some(state)
    }

    fn write_rotation(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) {
        self.turned = Some((*orientation, *angular_velocity));
        self.model.write_rotation(orientation, angular_velocity);
    }

    fn braking_speeds(&self) -> [f64; 2] {
        self.model.braking_speeds()
    }

    fn rest_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.model.rest_orientation()
    }

    fn grip(&mut self, jaws: &GripperSample) -> Option<Option<f64>> {
        self.model.grip(jaws)
    }

    fn touches(&self) -> bool {
        self.model.touches()
    }
}
