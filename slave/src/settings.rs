//! Arm, objects and pushers as the tables of a scene have them: vectors are lists with one number per axis.
//!
//! With the feature `serde` these are read from JSON. Every field is required and no other is taken, so that a table
//! that writer and reader describe differently cannot be misread.

use crate::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, ForceSensor, FreeBody, ModelError, Object, ObjectMotion,
    PushShape, Pusher, Series, Shape, require,
};

/// One value per axis from a list.
fn axes<const N: usize>(name: &'static str, values: &[f64]) -> Result<Axes<N>, ModelError> {
    require(name, values.len() as f64, values.len() == N, "one value per axis")?;
    Ok(Axes::from_column_slice(values))
}

/// `[slave]`: a simulated arm.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct ArmSettings {
    /// What its controller takes.
    pub control: ControlKind,
    /// M in kg.
    pub mass_kg: f64,
    /// Bandwidth in Hz of its position or velocity control.
    pub bandwidth_hz: f64,
    /// `K_s` in N/m, of `pd` only.
    pub stiffness: f64,
    /// `B_s` in N s/m, of `pd` only.
    pub damping: f64,
    /// In m/s; none without a bound.
    pub max_speed: Option<f64>,
    /// In m/s²; none without a bound.
    pub max_acceleration: Option<f64>,
    /// Period of its loop in s.
    pub period_s: f64,
    /// Where it starts, in m per axis.
    pub position: Vec<f64>,
    /// Its force sensor; without it the force is exact.
    pub force_sensor: Option<ForceSensorSettings>,
}

impl ArmSettings {
    /// Its control, mass and bounds, checked.
    pub fn model(&self) -> Result<ArmModel, ModelError> {
        let control = match self.control {
            ControlKind::Position => ArmControl::Position { bandwidth_hz: self.bandwidth_hz },
            ControlKind::Velocity => ArmControl::Velocity { bandwidth_hz: self.bandwidth_hz },
            ControlKind::Pd => ArmControl::Pd { stiffness: self.stiffness, damping: self.damping },
        };
        ArmModel::new(control, self.mass_kg, self.max_speed, self.max_acceleration)
    }
}

/// What an arm's controller takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(rename_all = "kebab-case"))]
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
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct ForceSensorSettings {
    /// Standard deviation in N.
    pub noise_n: f64,
    /// In N per axis.
    pub bias_n: Vec<f64>,
    /// In N; 0 is exact.
    pub quantum_n: f64,
    /// Samples per second; none for one at each tick.
    pub rate_hz: Option<f64>,
}

impl ForceSensorSettings {
    /// The sensor, whose noise a seed determines.
    pub fn sensor<const N: usize>(&self, seed: u64) -> Result<ForceSensor<N>, ModelError> {
        let bias = axes("number of values of slave.force_sensor.bias_n", &self.bias_n)?;
        ForceSensor::new(self.noise_n, bias, self.quantum_n, self.rate_hz, seed)
    }
}

/// `[[environment.objects]]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct ObjectSettings {
    /// Its shape.
    pub shape: ShapeSettings,
    /// How it resists.
    pub contact: ContactSettings,
    /// How it moves on its own.
    pub motion: Option<ObjectMotionSettings>,
    /// Its mass, if it slides freely.
    pub body: Option<BodySettings>,
}

impl ObjectSettings {
    /// The object.
    pub fn object<const N: usize>(&self) -> Result<Object<N>, ModelError> {
        let (shape, contact) = (self.shape.shape()?, self.contact.contact()?);
        match (&self.motion, &self.body) {
            (None, None) => Object::fixed(shape, contact),
            (Some(motion), None) => {
                let velocity =
                    axes("number of values of environment.objects.motion.velocity", &motion.velocity)?;
                let amplitude =
                    axes("number of values of environment.objects.motion.amplitude", &motion.amplitude)?;
                let (from_s, until_s) = (motion.from_s, motion.until_s);
                let motion = ObjectMotion::new(velocity, from_s, until_s, amplitude, motion.frequency_hz)?;
                Object::moving(shape, contact, motion)
            }
            (None, Some(body)) => {
                let velocity = axes("number of values of environment.objects.body.velocity", &body.velocity)?;
                let body = FreeBody::new(body.mass_kg, body.viscous, body.coulomb, velocity)?;
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
    derive(serde::Deserialize),
    serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)
)]
pub enum ShapeSettings {
    /// Fills the side of a plane that its normal points away from.
    Plane {
        /// A point on it, in m.
        point: Vec<f64>,
        /// Outward normal; need not have unit length.
        normal: Vec<f64>,
    },
    /// A ball.
    Sphere {
        /// In m.
        centre: Vec<f64>,
        /// In m.
        radius: f64,
    },
    /// A box along the axes.
    Box {
        /// In m.
        centre: Vec<f64>,
        /// In m per axis.
        half_extents: Vec<f64>,
    },
    /// A spring that pushes and pulls: `F = K (anchor - x) - B V`, everywhere.
    Spring {
        /// In m.
        anchor: Vec<f64>,
    },
}

impl ShapeSettings {
    /// The shape.
    pub fn shape<const N: usize>(&self) -> Result<Shape<N>, ModelError> {
        const CENTRE: &str = "number of values of environment.objects.shape.centre";
        match self {
            Self::Plane { point, normal } => Shape::plane(
                axes("number of values of environment.objects.shape.point", point)?,
                axes("number of values of environment.objects.shape.normal", normal)?,
            ),
            Self::Sphere { centre, radius } => Shape::sphere(axes(CENTRE, centre)?, *radius),
            Self::Box { centre, half_extents } => {
                let half = axes("number of values of environment.objects.shape.half_extents", half_extents)?;
                Shape::cuboid(axes(CENTRE, centre)?, half)
            }
            Self::Spring { anchor } => {
                Shape::spring(axes("number of values of environment.objects.shape.anchor", anchor)?)
            }
        }
    }
}

/// `[environment.objects.contact]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct ContactSettings {
    /// The law along the normal.
    pub law: ContactLawKind,
    /// K in N/m (N/m^n of Hunt and Crossley).
    pub stiffness: f64,
    /// B in N s/m of Kelvin and Voigt; chi in s/m of Hunt and Crossley.
    pub damping: f64,
    /// n of Hunt and Crossley.
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
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(rename_all = "kebab-case"))]
pub enum ContactLawKind {
    /// `F = max(0, K d + B d')`.
    KelvinVoigt,
    /// `F = max(0, K d^n (1 + chi d'))`.
    HuntCrossley,
}

/// `[environment.objects.motion]`: constant velocity for a while, and a sine.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct ObjectMotionSettings {
    /// In m/s per axis.
    pub velocity: Vec<f64>,
    /// When the velocity begins, in s.
    pub from_s: f64,
    /// When it ends, in s.
    pub until_s: f64,
    /// Amplitude in m per axis of a sine on top.
    pub amplitude: Vec<f64>,
    /// Its frequency in Hz.
    pub frequency_hz: f64,
}

/// `[environment.objects.body]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct BodySettings {
    /// In kg.
    pub mass_kg: f64,
    /// Viscous friction with the ground in N s/m.
    pub viscous: f64,
    /// Coulomb friction with the ground in N.
    pub coulomb: f64,
    /// V at the start, in m/s per axis.
    pub velocity: Vec<f64>,
}

/// `[[environment.pushers]]`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct PusherSettings {
    /// Its course.
    pub shape: PushKind,
    /// In s, since engagement; since the start without an arm.
    pub at_s: f64,
    /// In s.
    pub duration_s: f64,
    /// Rise of a ramp in s.
    pub rise_s: f64,
    /// Frequency of a sine in Hz.
    pub frequency_hz: f64,
    /// In N per axis.
    pub force_n: Vec<f64>,
    /// The course of a recorded one, in N.
    pub recorded: Option<SeriesSettings>,
}

impl PusherSettings {
    /// The pusher.
    pub fn pusher<const N: usize>(&self) -> Result<Pusher<N>, ModelError> {
        if self.shape == PushKind::Recorded {
            let empty = SeriesSettings { time_s: Vec::new(), values: Vec::new() };
            let series = self.recorded.as_ref().unwrap_or(&empty).series("environment.pushers.recorded")?;
            return Pusher::recorded(series, self.at_s, self.duration_s);
        }
        let force = axes("number of values of environment.pushers.force_n", &self.force_n)?;
        Pusher::shaped(self.push_shape(), self.at_s, self.duration_s, force)
    }

    /// The course of one that is not recorded.
    pub fn push_shape(&self) -> PushShape {
        match self.shape {
            PushKind::Step | PushKind::Recorded => PushShape::Step,
            PushKind::Ramp => PushShape::Ramp { rise_s: self.rise_s },
            PushKind::HalfSine => PushShape::HalfSine,
            PushKind::Sine => PushShape::Sine { frequency_hz: self.frequency_hz },
        }
    }
}

/// The course of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(rename_all = "kebab-case"))]
pub enum PushKind {
    /// At once.
    Step,
    /// Rises linearly, then stays.
    Ramp,
    /// `F sin(pi t / duration)`.
    HalfSine,
    /// `F sin(2 pi f t)`.
    Sine,
    /// As recorded.
    Recorded,
}

/// Values over time, linear between its points and constant outside.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize), serde(deny_unknown_fields))]
pub struct SeriesSettings {
    /// In s, increasing.
    pub time_s: Vec<f64>,
    /// One row of values (one per axis) for each time.
    pub values: Vec<Vec<f64>>,
}

impl SeriesSettings {
    /// The series; a row that has not one value per axis is refused under a name.
    pub fn series<const N: usize>(&self, name: &'static str) -> Result<Series<N>, ModelError> {
        let rows = self.values.iter().map(|row| axes(name, row));
        Series::new(self.time_s.clone(), rows.collect::<Result<_, _>>()?)
    }
}
