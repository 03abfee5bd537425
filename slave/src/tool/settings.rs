//! A tool that rotates and its world, as in the tables of a scene.

use nalgebra::{Quaternion, Unit, UnitQuaternion};

use crate::{Axes, ContactSettings, ModelError, ObjectSettings, PusherSettings, require, require_axes};

/// `[slave.tool]`: a rigid tool on an arm with rotation; mass, stiffness and damping of its point are those of the arm.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct ToolSettings {
    /// I in kg m² about the axes of the tool's frame, through the tool point, which is its centre of mass (> 0).
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub inertia_kg_m2: Axes<3>,
    /// `k_r` in N m/rad (>= 0).
    pub rotational_stiffness: f64,
    /// `b_r` in N m s/rad (>= 0).
    pub rotational_damping: f64,
    /// Speed limit of the set orientation in rad/s (> 0); none without a limit.
    pub max_angular_speed: Option<f64>,
    /// Initial orientation, unit quaternion w, x, y, z.
    pub quat_wxyz: [f64; 4],
    /// Contact points, in m in the tool frame.
    pub points: Vec<[f64; 3]>,
    /// Distance between the open jaws along the tool's x axis, in m (> 0).
    pub jaw_width_m: f64,
    /// Coefficient of friction at the jaws (>= 0).
    pub jaw_friction: f64,
    /// Stiffness of the hold between the jaws, in N/m (> 0).
    pub jaw_stiffness: f64,
    /// Radius in m of a jaw's pad, at which friction resists moments (> 0).
    pub jaw_radius_m: f64,
}

/// `[[environment.holes]]`: a round hole in a half space.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct HoleSettings {
    /// Centre of its entrance, in m.
    pub entrance: [f64; 3],
    /// Its axis, pointing out of the material, with nonzero length.
    pub axis: [f64; 3],
    /// In m (> 0).
    pub radius: f64,
    /// In m (> 0).
    pub depth: f64,
    /// Height in m of a chamfer of 45 degrees (>= 0).
    pub chamfer_m: f64,
    /// Its contact law.
    pub contact: ContactSettings,
}

/// `[[environment.handles]]`: an object that turns about one axis, such as a valve, a crank or a door.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct HandleSettings {
    /// A point on its axis, in m.
    pub point: [f64; 3],
    /// Its axis, with nonzero length.
    pub axis: [f64; 3],
    /// Grip point at angle 0, in m.
    pub grip: [f64; 3],
    /// Distance in m within which the tool point can hold it (> 0).
    pub reach_m: f64,
    /// Its width in m between the jaws (>= 0).
    pub width_m: f64,
    /// I in kg m² about its axis (> 0).
    pub inertia_kg_m2: f64,
    /// b in N m s/rad (>= 0).
    pub viscous: f64,
    /// c in N m (>= 0), fully developed above 0.01 rad/s.
    pub coulomb: f64,
    /// Stiffness in N m/rad of a spring that returns it to 0 (>= 0).
    pub stiffness: f64,
    /// Lower and upper stop in rad.
    pub stops_rad: [f64; 2],
    /// Stiffness in N/m of the hold by a tool with or without jaws (> 0).
    pub hold_stiffness: f64,
    /// Rotational stiffness of the hold in N m/rad (>= 0).
    pub hold_rotational_stiffness: f64,
}

/// `[[environment.bodies]]`: a box that rests on surfaces and that jaws can hold.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct RigidBodySettings {
    /// In kg (> 0).
    pub mass_kg: f64,
    /// Half of its size in m (> 0).
    pub half_extents: [f64; 3],
    /// Initial position of its centre, in m.
    pub position: [f64; 3],
    /// Initial orientation, unit quaternion w, x, y, z.
    pub quat_wxyz: [f64; 4],
    /// Gravity along -z, in m/s² (>= 0).
    pub gravity: f64,
}

/// Surroundings of a tool.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ToolWorldSettings {
    /// Objects that it may touch.
    pub objects: Vec<ObjectSettings<3>>,
    /// Forces on the tool point.
    pub pushers: Vec<PusherSettings<3>>,
    /// Torques on the tool; force values of a pusher are in N m here.
    pub torques: Vec<PusherSettings<3>>,
    /// Holes.
    pub holes: Vec<HoleSettings>,
    /// Handles.
    pub handles: Vec<HandleSettings>,
    /// Bodies.
    pub bodies: Vec<RigidBodySettings>,
}

/// Allowed deviation of the norm of a given quaternion from 1.
const UNIT: f64 = 1e-6;

pub(super) fn orientation(
    name: &'static str,
    [w, x, y, z]: [f64; 4],
) -> Result<UnitQuaternion<f64>, ModelError> {
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    require(name, norm, (norm - 1.0).abs() <= UNIT, "of norm 1 to 1e-6")?;
    Ok(Unit::new_normalize(quaternion))
}

pub(super) fn direction(name: &'static str, axis: [f64; 3]) -> Result<Unit<Axes<3>>, ModelError> {
    let axis = Axes::from(axis);
    let norm = axis.norm();
    require(name, norm, norm > 0.0, "of any length but 0")?;
    Ok(Unit::new_unchecked(axis / norm))
}

pub(super) fn finite(name: &'static str, vector: [f64; 3]) -> Result<Axes<3>, ModelError> {
    let vector = Axes::from(vector);
    require_axes(name, &vector, |_| true, "finite")?;
    Ok(vector)
}

pub(super) fn positive(name: &'static str, value: f64) -> Result<f64, ModelError> {
    require(name, value, value > 0.0, "finite and above 0")?;
    Ok(value)
}

pub(super) fn non_negative(name: &'static str, value: f64) -> Result<f64, ModelError> {
    require(name, value, value >= 0.0, "finite and 0 or more")?;
    Ok(value)
}

impl ToolSettings {
    /// Reject invalid settings.
    pub(super) fn check(&self) -> Result<(), ModelError> {
        require_axes("tool inertia_kg_m2", &self.inertia_kg_m2, |one| one > 0.0, "finite and above 0")?;
        non_negative("tool rotational_stiffness", self.rotational_stiffness)?;
        non_negative("tool rotational_damping", self.rotational_damping)?;
        if let Some(speed) = self.max_angular_speed {
            positive("tool max_angular_speed", speed)?;
        }
        for point in &self.points {
            finite("tool points", *point)?;
        }
        positive("tool jaw_width_m", self.jaw_width_m)?;
        non_negative("tool jaw_friction", self.jaw_friction)?;
        positive("tool jaw_stiffness", self.jaw_stiffness)?;
        positive("tool jaw_radius_m", self.jaw_radius_m)?;
        Ok(())
    }
}
