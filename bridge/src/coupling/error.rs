//! Invalid parameters of a coupling, and changes out of range.

use super::AlignmentError;

/// Invalid parameter of a coupling.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CouplingError {
    /// Scale or bound that is not above 0; or not finite, unless it bounds commands.
    #[error("{name} ({symbol}) = {seen}: must be above 0, and finite unless it bounds commands")]
    Scale {
        /// Name of the parameter.
        name: &'static str,
        /// Symbol of the parameter.
        symbol: &'static str,
        /// Given value.
        seen: f64,
    },
    /// Damping or time below 0.
    #[error("{name} ({symbol}) = {seen}: must be finite and at least 0")]
    Negative {
        /// Name of the parameter.
        name: &'static str,
        /// Symbol of the parameter.
        symbol: &'static str,
        /// Given value.
        seen: f64,
    },
    /// Scale out of its range during the run.
    #[error(
        "{name} ({symbol}) = {seen:?}: must be between {} and {}, with an open clutch between {} and {}; {}",
        rounded(closed[0]), rounded(closed[1]), rounded(open[0]), rounded(open[1]),
        remedy(name, *seen, *open)
    )]
    Change {
        /// Name of the scale.
        name: &'static str,
        /// Symbol of the scale.
        symbol: &'static str,
        /// Given value.
        seen: f64,
        /// Smallest and largest value while the clutch is closed.
        closed: [f64; 2],
        /// Smallest and largest value while the clutch is open.
        open: [f64; 2],
    },
    /// Change that a coupling does not allow.
    #[error("{name}: coupling {kind} keeps that of the scene{}; set coupling.{name} in the scene", when(*while_engaged))]
    Fixed {
        /// Name of the setting.
        name: &'static str,
        /// Name of the coupling.
        kind: &'static str,
        /// True if it may change while the clutch is open.
        while_engaged: bool,
    },
    /// Coupling to which this side cannot switch.
    #[error("coupling {0}: must be that of the scene or one of its coupling.alternatives")]
    NoAlternative(&'static str),
    /// Scale that this side does not have.
    #[error("{0}: only a side of kind \"pose\" has it")]
    NoScale(&'static str),
    /// Matrix that is not a rotation.
    #[error("rotation: R' R differs from the identity by {0}: must differ by at most 1e-9")]
    Orthonormal(f64),
    /// Quaternion that is not a unit quaternion.
    #[error("quat_wxyz has a norm of {0}: must be 1 to within 1e-6")]
    Quaternion(f64),
    /// Quaternion whose rotation leaves the space of the axes.
    #[error("quat_wxyz with {0} axes: needs 3 axes, or 2 axes and a rotation about z")]
    Turn(usize),
    /// Rotation of more than three axes.
    #[error("rotation of {0} axes: must be of at most 3")]
    Rotation(usize),
    /// Measured or received quaternion that is not a unit quaternion.
    #[error(
        "orientation: quat_wxyz = {seen:?} has a norm of {norm}: must be 1 to within 1e-9; normalise it where it is made"
    )]
    Orientation {
        /// Given value.
        seen: [f64; 4],
        /// Norm of the value; NaN if a component is NaN.
        norm: f64,
    },
    /// Axis that is not a unit vector.
    #[error("axis of rotation has a length of {0}: must be 1 to within 1e-6")]
    Axis(f64),
    /// Angle out of range: no two orientations are farther apart than pi.
    #[error("{name} = {seen} rad: must be above 0 and at most pi")]
    Angle {
        /// Name of the angle.
        name: &'static str,
        /// Given value.
        seen: f64,
    },
    /// Angle between master and slave beyond the largest angle of an alignment.
    #[error(
        "master and slave are turned {seen_rad} rad from one another, alignment is allowed up to {allowed_rad} rad: turn \
         the handle towards the slave's tool"
    )]
    Misaligned {
        /// Angle between them in rad.
        seen_rad: f64,
        /// Largest allowed angle in rad.
        allowed_rad: f64,
    },
    /// Alignment that does not fit this coupling.
    #[error(transparent)]
    Alignment(#[from] AlignmentError),
}

impl CouplingError {
    pub(super) const fn scale(name: &'static str, symbol: &'static str, seen: f64) -> Self {
        Self::Scale { name, symbol, seen }
    }
}

fn when(while_engaged: bool) -> &'static str {
    if while_engaged { " while the clutch is closed" } else { "" }
}

/// Round to six digits for messages, because a factor turns short decimal numbers into long ones.
fn rounded(number: f64) -> f64 {
    format!("{number:.5e}").parse().unwrap_or(number)
}

fn remedy(name: &str, seen: f64, [least, most]: [f64; 2]) -> String {
    if (least..=most).contains(&seen) {
        "release the clutch first, or state a larger coupling.change_factor in the scene".to_owned()
    } else {
        format!("set coupling.{name} in the scene")
    }
}
