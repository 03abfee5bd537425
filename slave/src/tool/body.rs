//! A box that rests on surfaces and that jaws can hold.

use super::{
    hold::Frame,
    rigid::{Inertia, Rigid},
    settings::{RigidBodySettings, finite, non_negative, orientation, positive},
};
use crate::{Axes, ModelError};

/// Distance in m of the tool point from a body up to which the jaws can take it.
const JAW_REACH: f64 = 5e-3;

/// A box that jaws can hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Body {
    pub(super) inertia: Inertia,
    pub(super) half_extents: Axes<3>,
    pub(super) gravity: f64,
}

impl Body {
    /// The box, and its initial state.
    pub(super) fn new(settings: &RigidBodySettings) -> Result<(Self, Rigid), ModelError> {
        let mass_kg = positive("body mass_kg", settings.mass_kg)?;
        let half_extents = finite("body half_extents", settings.half_extents)?;
        for half in &half_extents {
            positive("body half_extents", *half)?;
        }
        // Inertia of a homogeneous box: m (b² + c²) / 3 with its half extents.
        let squares = half_extents.component_mul(&half_extents);
        let moments = Axes::<3>::repeat(squares.sum()) - squares;
        let inertia = Inertia { mass_kg, moments: moments * (mass_kg / 3.0) };
        let rigid = Rigid {
            position: finite("body position", settings.position)?,
            velocity: Axes::zeros(),
            orientation: orientation("body quat_wxyz", settings.quat_wxyz)?,
            momentum: Axes::zeros(),
        };
        let gravity = non_negative("body gravity", settings.gravity)?;
        Ok((Self { inertia, half_extents, gravity }, rigid))
    }

    /// True if it is between the jaws of a tool.
    pub(super) fn in_reach(&self, tool: &Frame, at: &Frame) -> bool {
        let from = at.orientation.inverse() * (tool.position - at.position);
        (from.abs() - self.half_extents).max() <= JAW_REACH
    }
}
