//! The controllers by name, and sets of them.

use std::fmt::{self, Debug, Formatter};

/// A controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum ControllerKind {
    /// [`VelocityForceController`](super::VelocityForceController).
    Vfc,
    /// [`HandGraspController`](super::HandGraspController).
    Hsc,
    /// [`WindowedSafetyController`](super::WindowedSafetyController).
    Wsc,
    /// [`PassivityController`](super::PassivityController).
    Pc,
}

impl ControllerKind {
    /// All of them, in the order of their bits in [`Tripped`](super::Tripped).
    pub const ALL: [Self; 4] = [Self::Vfc, Self::Hsc, Self::Wsc, Self::Pc];
}

/// A set of controllers; in JSON the list of their names.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(from = "Vec<ControllerKind>"),
    schemars(with = "Vec<ControllerKind>")
)]
pub struct Controllers(u8);

impl Controllers {
    /// None of them.
    pub const NONE: Self = Self(0);

    /// Whether `kind` belongs to the set.
    pub const fn contains(self, kind: ControllerKind) -> bool {
        self.0 >> kind as u8 & 1 == 1
    }

    /// The set with `kind`, or without it.
    #[must_use]
    pub const fn with(self, kind: ControllerKind, is_member: bool) -> Self {
        Self(self.0 & !(1 << kind as u8) | (is_member as u8) << kind as u8)
    }

    /// The controllers of the set, in the order of [`ControllerKind::ALL`].
    pub fn iter(self) -> impl Iterator<Item = ControllerKind> {
        ControllerKind::ALL.into_iter().filter(move |kind| self.contains(*kind))
    }
}

impl FromIterator<ControllerKind> for Controllers {
    fn from_iter<I: IntoIterator<Item = ControllerKind>>(kinds: I) -> Self {
        kinds.into_iter().fold(Self::NONE, |set, kind| set.with(kind, true))
    }
}

impl<const K: usize> From<[ControllerKind; K]> for Controllers {
    fn from(kinds: [ControllerKind; K]) -> Self {
        kinds.into_iter().collect()
    }
}

impl From<Vec<ControllerKind>> for Controllers {
    fn from(kinds: Vec<ControllerKind>) -> Self {
        kinds.into_iter().collect()
    }
}

impl Debug for Controllers {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.debug_set().entries(self.iter()).finish()
    }
}
