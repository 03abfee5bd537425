//! Arm, objects and pushers as in the tables of a scene.
//!
//! With the feature `serde` they are read from JSON; a vector is a list with one number per axis. Unknown fields are
//! rejected, so a mismatch between writer and reader is an error.

use crate::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, ForceSensor, FreeBody, GripperSettings, ModelError,
    Object, ObjectMotion, PushShape, Pusher, Series, Shape, ToolSettings,
};

/// `[slave]`: a simulated arm.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct ArmSettings<const N: usize> {
    /// Kind of its control.
    pub control: ControlKind,
    /// M in kg.
    pub mass_kg: f64,
    /// Bandwidth in Hz of its position or velocity control.
    pub bandwidth_hz: f64,
    /// `K_s` in N/m; `pd` only.
    pub stiffness: f64,
    /// `B_s` in N s/m; `pd` only.
    pub damping: f64,
    /// Speed limit of the set value in m/s; none without a limit.
    pub max_speed: Option<f64>,
    /// Acceleration limit of the set value in m/s²; none without a limit.
    pub max_acceleration: Option<f64>,
    /// True if the arm takes forces: `M x'' = F_c - b V + F_e`.
    pub takes_force: bool,
    /// b in N s/m, friction that the arm does not compensate under a force.
    pub viscous: f64,
    /// Largest force in N (N m) of a coupling on an arm that takes forces.
    pub max_force_n: f64,
    /// Largest torque in N m of the same; arms with rotation only.
    pub max_torque_nm: f64,
    /// Speed bound in m/s (rad/s) against which its samples are checked; default: the bound of its kind.
    pub speed_bound: Option<f64>,
    /// Period of its loop in s.
    pub period_s: f64,
    /// Initial position in m per axis.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub position: Axes<N>,
    /// Its force sensor; without one the measured force is exact.
    pub force_sensor: Option<ForceSensorSettings<N>>,
    /// Its gripper; none without one.
    pub gripper: Option<GripperSettings>,
    /// Its tool; arms with rotation only.
    pub tool: Option<ToolSettings>,
}

impl<const N: usize> ArmSettings<N> {
    /// Return the checked control, mass and limits.
    pub fn model(&self) -> Result<ArmModel, ModelError> {
        let control = match self.control {
            ControlKind::Position => ArmControl::Position { bandwidth_hz: self.bandwidth_hz },
            ControlKind::Velocity => ArmControl::Velocity { bandwidth_hz: self.bandwidth_hz },
            ControlKind::Pd => ArmControl::Pd { stiffness: self.stiffness, damping: self.damping },
        };
        let model = ArmModel::new(control, self.mass_kg, self.max_speed, self.max_acceleration)?;
        if self.takes_force { model.taking_forces(self.viscous) } else { Ok(model) }
    }
}

/// Kind of an arm's control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum ControlKind {
    /// A position, tracked as a critically damped second-order system.
    Position,
    /// A velocity (from the commanded positions), tracked as a first-order system.
    Velocity,
    /// `M x'' = K_s (x_set - x) + B_s (V_set - V) + F_e`.
    Pd,
}

/// `[slave.force_sensor]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct ForceSensorSettings<const N: usize> {
    /// Standard deviation of the noise in N.
    pub noise_n: f64,
    /// Bias in N per axis.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub bias_n: Axes<N>,
    /// Quantum in N; 0 is exact.
    pub quantum_n: f64,
    /// Samples per second; none samples at each tick.
    pub rate_hz: Option<f64>,
}

impl<const N: usize> ForceSensorSettings<N> {
    /// The sensor; the seed determines its noise.
    pub fn sensor(&self, seed: u64) -> Result<ForceSensor<N>, ModelError> {
        ForceSensor::new(self.noise_n, self.bias_n, self.quantum_n, self.rate_hz, seed)
    }
}

/// `[[environment.objects]]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct ObjectSettings<const N: usize> {
    /// Its shape.
    pub shape: ShapeSettings<N>,
    /// Contact law of its surface.
    pub contact: ContactSettings,
    /// Prescribed motion, if any.
    pub motion: Option<ObjectMotionSettings<N>>,
    /// Its body, if it slides freely.
    pub body: Option<BodySettings<N>>,
}

impl<const N: usize> ObjectSettings<N> {
    /// The object.
    pub fn object(&self) -> Result<Object<N>, ModelError> {
        let (shape, contact) = (self.shape.shape()?, self.contact.contact()?);
        match (&self.motion, &self.body) {
            (None, None) => Object::fixed(shape, contact),
            (Some(motion), None) => {
                let ObjectMotionSettings { velocity, from_s, until_s, amplitude, frequency_hz } = *motion;
                let motion = ObjectMotion::new(velocity, from_s, until_s, amplitude, frequency_hz)?;
                Object::moving(shape, contact, motion)
            }
            (None, Some(body)) => {
                let body = FreeBody::new(body.mass_kg, body.viscous, body.coulomb, body.velocity)?;
                Object::free(shape, contact, body)
            }
            (Some(_), Some(_)) => {
                let allowed = "1 at most: an object has a motion of its own or a body, not both";
                Err(ModelError { name: "motions and bodies of an object", seen: 2.0, allowed })
            }
        }
    }
}

/// `[environment.objects.shape]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)
)]
pub enum ShapeSettings<const N: usize> {
    /// Fills the half space opposite to the outward normal.
    Plane {
        /// A point on it, in m.
        #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
        point: Axes<N>,
        /// Outward normal; need not have unit length.
        #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
        normal: Axes<N>,
    },
    /// A ball.
    Sphere {
        /// In m.
        #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
        centre: Axes<N>,
        /// In m.
        radius: f64,
    },
    /// A box along the axes.
    Box {
        /// In m.
        #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
        centre: Axes<N>,
        /// In m per axis.
        #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
        half_extents: Axes<N>,
    },
    /// A spring that pushes and pulls: `F = K (anchor - x) - B V`, everywhere.
    Spring {
        /// In m.
        #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
        anchor: Axes<N>,
    },
}

impl<const N: usize> ShapeSettings<N> {
    /// The shape.
    pub fn shape(&self) -> Result<Shape<N>, ModelError> {
        match *self {
            Self::Plane { point, normal } => Shape::plane(point, normal),
            Self::Sphere { centre, radius } => Shape::sphere(centre, radius),
            Self::Box { centre, half_extents } => Shape::cuboid(centre, half_extents),
            Self::Spring { anchor } => Shape::spring(anchor),
        }
    }
}

/// `[environment.objects.contact]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct ContactSettings {
    /// The law along the normal.
    pub law: ContactLawKind,
    /// K in N/m (N/m^n for Hunt and Crossley).
    pub stiffness: f64,
    /// Kelvin and Voigt: B in N s/m. Hunt and Crossley: chi in s/m.
    pub damping: f64,
    /// n; Hunt and Crossley only.
    pub exponent: f64,
    /// Coefficient of Coulomb friction along the surface.
    pub friction: f64,
}

impl ContactSettings {
    /// The contact.
    pub fn contact(&self) -> Result<Contact, ModelError> {
        let (stiffness, damping) = (self.stiffness, self.damping);
        let law = match self.law {
            ContactLawKind::KelvinVoigt => ContactLaw::KelvinVoigt { stiffness, damping },
            ContactLawKind::HuntCrossley => {
                ContactLaw::HuntCrossley { stiffness, exponent: self.exponent, damping }
            }
        };
        Contact::new(law, self.friction)
    }
}

/// The law of a contact along the normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum ContactLawKind {
    /// `F = max(0, K d + B d')`.
    KelvinVoigt,
    /// `F = max(0, K d^n (1 + chi d'))`.
    HuntCrossley,
}

/// `[environment.objects.motion]`: constant velocity in a time window, plus a sine.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct ObjectMotionSettings<const N: usize> {
    /// Velocity in m/s per axis.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub velocity: Axes<N>,
    /// Start of the velocity window, in s.
    pub from_s: f64,
    /// End of the velocity window, in s.
    pub until_s: f64,
    /// Amplitude of the sine in m per axis.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub amplitude: Axes<N>,
    /// Its frequency in Hz.
    pub frequency_hz: f64,
}

/// `[environment.objects.body]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct BodySettings<const N: usize> {
    /// In kg.
    pub mass_kg: f64,
    /// Viscous friction with the ground in N s/m.
    pub viscous: f64,
    /// Coulomb friction with the ground in N.
    pub coulomb: f64,
    /// Initial V in m/s per axis.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub velocity: Axes<N>,
}

/// `[[environment.pushers]]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct PusherSettings<const N: usize> {
    /// Its shape over time.
    pub shape: PushKind,
    /// Start in s since engagement; since the start of the run without an arm.
    pub at_s: f64,
    /// Duration in s.
    pub duration_s: f64,
    /// Rise of a ramp in s.
    pub rise_s: f64,
    /// Frequency of a sine in Hz.
    pub frequency_hz: f64,
    /// Force in N per axis.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub force_n: Axes<N>,
    /// Force over time in N; recorded pushes only.
    pub recorded: Option<SeriesSettings<N>>,
}

impl<const N: usize> PusherSettings<N> {
    /// The pusher.
    pub fn pusher(&self) -> Result<Pusher<N>, ModelError> {
        if self.shape == PushKind::Recorded {
            let empty = SeriesSettings { time_s: Vec::new(), values: Vec::new() };
            let series = self.recorded.as_ref().unwrap_or(&empty).series()?;
            return Pusher::recorded(series, self.at_s, self.duration_s);
        }
        Pusher::shaped(self.push_shape(), self.at_s, self.duration_s, self.force_n)
    }

    /// The shape of a push that is not recorded.
    pub fn push_shape(&self) -> PushShape {
        match self.shape {
            PushKind::Step | PushKind::Recorded => PushShape::Step,
            PushKind::Ramp => PushShape::Ramp { rise_s: self.rise_s },
            PushKind::HalfSine => PushShape::HalfSine,
            PushKind::Sine => PushShape::Sine { frequency_hz: self.frequency_hz },
        }
    }
}

/// The shape of a push over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum PushKind {
    /// Full force at once.
    Step,
    /// Linear rise, then constant.
    Ramp,
    /// `F sin(pi t / duration)`.
    HalfSine,
    /// `F sin(2 pi f t)`.
    Sine,
    /// A recorded series.
    Recorded,
}

/// Values over time, linear between its points and constant outside.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct SeriesSettings<const N: usize> {
    /// In s, increasing.
    pub time_s: Vec<f64>,
    /// One row of values (one per axis) for each time.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<Vec<f64>>"))]
    pub values: Vec<Axes<N>>,
}

impl<const N: usize> SeriesSettings<N> {
    /// The series, checked.
    pub fn series(&self) -> Result<Series<N>, ModelError> {
        Series::new(self.time_s.clone(), self.values.clone())
    }
}
