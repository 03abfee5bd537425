//! Items generated from the registry: kinds, sets, bits, and the controllers that a tick steps.

use std::{
    fmt::{self, Debug, Formatter},
    ops::{Index, IndexMut},
};

use super::ControllerKind;

/// Declare every item that depends on the set of controllers; each line is `Kind: file::Type;`.
///
/// The controllers are fields of one struct, so that each is known to a tick at compile time.
macro_rules! controllers {
    ($($(#[$doc:meta])* $kind:ident: $file:ident::$controller:ident;)+) => {
        $(pub use $file::$controller;)+

        /// Kind of a controller.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(rename_all = "snake_case"))]
        pub enum ControllerKind {
            $($(#[$doc])* $kind,)+
        }

        impl ControllerKind {
            /// All kinds, in the order of the registry.
            pub const ALL: [Self; [$(stringify!($kind)),+].len()] = [$(Self::$kind),+];

            /// Return name, title and source.
            pub const fn about(self) -> &'static About {
                match self { $(Self::$kind => <$controller<1> as Controller<1, f64>>::ABOUT,)+ }
            }

            /// Return the names of the observer's value.
            pub const fn observed(self) -> &'static Observed {
                match self { $(Self::$kind => <$controller<1> as Controller<1, f64>>::OBSERVED,)+ }
            }

            /// Return the threshold of the observer's value.
            pub fn threshold(self, settings: &SafetySettings) -> f64 {
                match self { $(Self::$kind => <$controller<1> as Controller<1, f64>>::threshold(settings),)+ }
            }

            /// Return whether it adds its own force; the other controllers request `-F_v - mu V`.
            pub const fn adds_force(self) -> bool {
                match self { $(Self::$kind => <$controller<1> as Controller<1, f64>>::ADDS_FORCE,)+ }
            }

            /// Return whether it compares `F_v` with `F_h`.
            pub(crate) const fn reads_aligned_force(self) -> bool {
                match self { $(Self::$kind => <$controller<1> as Controller<1, f64>>::READS_ALIGNED_FORCE,)+ }
            }
        }

        /// The controllers in use; the others are not built.
        #[derive(Clone, Debug, PartialEq)]
        struct BuiltControllers<const N: usize, S = f64> {
            $($file: Option<$controller<N, S>>,)+
        }

        impl<const N: usize> BuiltControllers<N> {
            fn new(
                device: &DeviceModel<N>,
                period_s: f64,
                settings: &SafetySettings,
            ) -> Result<Self, ParameterError> {
                // Unused controllers are built and checked too: a wrong value is reported before it is used.
                $(let $file = {
                    let is_used = settings.controllers.contains(ControllerKind::$kind);
                    let built =
                        <$controller<N> as Controller<N, f64>>::build(device, period_s, settings, is_used)?;
                    is_used.then_some(built)
                };)+
                Ok(Self { $($file),+ })
            }
        }

        impl<const N: usize, S: Real> BuiltControllers<N, S> {
            /// Gather one set per lane; return None unless all have built the same controllers.
            fn gather(of: &[&BuiltControllers<N>]) -> Option<Self> {
                Some(Self { $($file: option(of, |one| one.$file.as_ref(), Controller::gather)?,)+ })
            }

            #[inline(always)]
            fn step(&mut self, seen: &Observation<N, S>) -> Verdicts<N, S> {
                let mut is_unsafe = no_lanes::<S>();
                Verdicts {
                    $($file: if let Some(controller) = &mut self.$file {
                        let verdict = controller.step(seen);
                        // Combined here, so that controllers that are not built cost nothing.
                        is_unsafe = is_unsafe | verdict.is_unsafe;
                        verdict
                    } else {
                        Verdict::without_force(S::splat(f64::NAN), no_lanes::<S>())
                    },)+
                    is_unsafe,
                }
            }

            #[inline(always)]
            fn reads_grasp_force(&self) -> bool {
                false $(|| $controller::<N, S>::READS_GRASP_FORCE && self.$file.is_some())+
            }

            /// Return the energy in J that the controllers requested and that `delivered` did not
            /// dissipate.
            #[inline(always)]
            fn owed_energy_j(
                &self,
                observed: &PerController<S>,
                delivered: &Axes<N, S>,
                velocity: &Axes<N, S>,
            ) -> S {
                let mut owed = S::splat(0.0);
                $(if $controller::<N, S>::ADDS_FORCE {
                    if let Some(controller) = &self.$file {
                        owed += controller.owed_energy_j(
                            observed[ControllerKind::$kind], delivered, velocity);
                    }
                })+
                owed
            }

            #[inline(always)]
            fn is_empty(&self) -> bool {
                true $(&& self.$file.is_none())+
            }

            fn kinds(&self) -> Controllers {
                Controllers::NONE $(.with(ControllerKind::$kind, self.$file.is_some()))+
            }

            fn reset(&mut self) {
                $(if let Some(controller) = &mut self.$file {
                    controller.reset();
                })+
            }
        }

        /// Verdict of each controller at one tick; NaN and no force for a controller that is not built.
        pub(crate) struct Verdicts<const N: usize, S: Real> {
            $($file: Verdict<N, S>,)+
            /// Lanes in which any controller calls the tick unsafe.
            is_unsafe: S::SimdBool,
        }

        impl<const N: usize, S: Real> Verdicts<N, S> {
            /// Return the lanes in which each controller calls the tick unsafe.
            #[inline(always)]
            fn tripped(&self) -> PerController<S::SimdBool> {
                PerController([$(self.$file.is_unsafe),+])
            }

            /// Return the lanes in which any controller calls the tick unsafe.
            #[inline(always)]
            pub(crate) fn is_unsafe(&self) -> S::SimdBool {
                self.is_unsafe
            }

            /// Return the observers' values.
            #[inline(always)]
            fn observed(&self) -> PerController<S> {
                PerController([$(self.$file.observed),+])
            }

            /// Add the force of each controller that has one, scaled by the share `1 - gain` that an intervention
            /// leaves.
            #[inline(always)]
            fn add_forces(
                &self,
                built: &BuiltControllers<N, S>,
                gain: S,
                authority: S,
                response: &mut Response<N, S>,
            ) {
                $(if $controller::<N, S>::ADDS_FORCE && built.$file.is_some() {
                    response.add_force(ControllerKind::$kind, &self.$file.force, gain, authority);
                })+
            }
        }
    };
}
pub(super) use controllers;

/// Number of controllers.
const COUNT: usize = ControllerKind::ALL.len();

impl ControllerKind {
    /// Iterate over the kinds that request `-F_v - mu V`, in the order of the registry.
    pub fn cancelling() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|kind| !kind.adds_force())
    }

    /// Return its bit in [`Tripped`]. The bit of [`Tripped::HELD`], after the first four, belongs to no controller.
    const fn bit(self) -> u8 {
        let bit = 1 << self as u8;
        if bit < Tripped::HELD.0 { bit } else { bit << 1 }
    }
}

/// One value per controller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PerController<T>(
    /// Values in the order of [`ControllerKind::ALL`].
    pub [T; COUNT],
);

impl<T> PerController<T> {
    /// Compute a value for each kind.
    pub fn of(value: impl FnMut(ControllerKind) -> T) -> Self {
        Self(ControllerKind::ALL.map(value))
    }
}

impl<T: Copy> PerController<T> {
    /// Repeat one value for all kinds.
    pub const fn repeat(value: T) -> Self {
        Self([value; COUNT])
    }
}

impl<T> Index<ControllerKind> for PerController<T> {
    type Output = T;

    #[inline(always)]
    fn index(&self, kind: ControllerKind) -> &T {
        &self.0[kind as usize]
    }
}

impl<T> IndexMut<ControllerKind> for PerController<T> {
    #[inline(always)]
    fn index_mut(&mut self, kind: ControllerKind) -> &mut T {
        &mut self.0[kind as usize]
    }
}

/// Set of controllers; in JSON the list of their names.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(from = "Vec<ControllerKind>"),
    schemars(with = "Vec<ControllerKind>")
)]
pub struct Controllers(u8);

impl Controllers {
    /// The empty set.
    pub const NONE: Self = Self(0);

    /// Return whether `kind` belongs to the set.
    pub const fn contains(self, kind: ControllerKind) -> bool {
        self.0 >> kind as u8 & 1 == 1
    }

    /// Return the set with or without `kind`.
    #[must_use]
    pub const fn with(self, kind: ControllerKind, is_member: bool) -> Self {
        Self(self.0 & !(1 << kind as u8) | (is_member as u8) << kind as u8)
    }

    /// Iterate over the controllers of the set, in the order of [`ControllerKind::ALL`].
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

/// Set of controllers that called the tick unsafe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tripped(u8);

impl Tripped {
    /// No controller.
    pub const NONE: Self = Self(0);
    /// No controller now, but the hold-off or the release ramp has not ended.
    pub const HELD: Self = Self(16);
    /// A [research controller](super::ResearchController); the last bit, so that the registry can grow.
    pub const RESEARCH: Self = Self(128);

    /// Return the bit of one controller.
    pub const fn of(kind: ControllerKind) -> Self {
        Self(kind.bit())
    }

    /// Convert from [`bits`](Self::bits); unknown bits are dropped.
    pub fn from_bits(bits: u8) -> Self {
        let all = ControllerKind::ALL
            .into_iter()
            .fold(Self::HELD.and(Self::RESEARCH), |all, kind| all.and(Self::of(kind)));
        Self(bits & all.0)
    }

    /// Return whether any bit is set.
    pub fn any(self) -> bool {
        self.0 != 0
    }

    /// Return whether all of `other` is set.
    pub fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Return the union.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Iterate over the names of the set bits: controllers in the order of the registry, then "held" and "research".
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        let names = ControllerKind::ALL.map(|kind| (Self::of(kind), kind.about().name));
        let named = names.into_iter().chain([(Self::HELD, "held"), (Self::RESEARCH, "research")]);
        named.filter(move |(bit, _)| self.contains(*bit)).map(|(_, name)| name)
    }

    /// Return the bits for records: VFC 1, HSC 2, WSC 4, PC 8, held 16, research 128.
    pub fn bits(self) -> u8 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_and_names_match_the_tripped_controllers() {
        let named: Vec<_> = ControllerKind::ALL
            .into_iter()
            .map(|kind| (Tripped::of(kind), kind.about().name))
            .chain([(Tripped::HELD, "held"), (Tripped::RESEARCH, "research")])
            .collect();
        assert_eq!(
            named[..4].iter().map(|(bit, name)| (bit.bits(), *name)).collect::<Vec<_>>(),
            [(1, "vfc"), (2, "hsc"), (4, "wsc"), (8, "pc")]
        );
        let known: u8 = named.iter().map(|(bit, _)| bit.bits()).sum();
        assert_eq!(known.count_ones() as usize, named.len(), "each has its own bit");
        for bits in 0..=u8::MAX {
            let tripped = Tripped::from_bits(bits);
            assert_eq!((tripped.bits(), tripped.any()), (bits & known, bits & known != 0));
            let mut expected = Vec::new();
            for (one, name) in &named {
                let is_set = bits & one.bits() != 0;
                assert_eq!(tripped.contains(*one), is_set);
                assert_eq!(tripped.and(*one), Tripped::from_bits(bits | one.bits()));
                if is_set {
                    expected.push(*name);
                }
            }
            assert_eq!(tripped.names().collect::<Vec<_>>(), expected);
            assert!(tripped.contains(Tripped::NONE) && tripped.contains(tripped));
        }
    }

    #[test]
    fn a_set_contains_its_members() {
        for bits in 0..1_usize << COUNT {
            let is_in = |kind: ControllerKind| bits >> kind as usize & 1 == 1;
            let set: Controllers = ControllerKind::ALL.into_iter().filter(|kind| is_in(*kind)).collect();
            for kind in ControllerKind::ALL {
                assert_eq!(set.contains(kind), is_in(kind));
                assert!(set.with(kind, true).contains(kind) && !set.with(kind, false).contains(kind));
                assert_eq!(set.with(kind, is_in(kind)), set);
            }
            assert!(set.iter().eq(ControllerKind::ALL.into_iter().filter(|kind| is_in(*kind))));
        }
        assert_eq!(
            format!("{:?}", Controllers::from([ControllerKind::Pc, ControllerKind::Vfc])),
            "{Vfc, Pc}"
        );
    }
}
