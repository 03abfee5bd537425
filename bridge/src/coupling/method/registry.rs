//! Registry of the couplings: a coupling is one file and one line here.

use haptether_safety::Axes;
use schemars::JsonSchema;
use serde::Deserialize;

use super::{CouplingAbout, Gains, Local, Method, Peer, SlaveSends};

/// Declare every item that depends on the set of couplings; each line is `Kind = code: file;`.
macro_rules! couplings {
    ($(#[$doc:meta])* $measured:ident = $zero:literal; $($(#[$docs:meta])* $kind:ident = $code:literal: $file:ident;)+) => {
        $(mod $file;)+

        /// Kind of a coupling.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
        #[serde(rename_all = "kebab-case")]
        pub enum CouplingKind {
            $(#[$doc])*
            #[default]
            $measured = $zero,
            $($(#[$docs])* $kind = $code,)+
        }

        impl CouplingKind {
            /// All kinds, in the order of the registry.
            pub const ALL: &'static [Self] = &[Self::$measured, $(Self::$kind),+];

            /// Return name, title and source.
            pub const fn about(self) -> CouplingAbout {
                match self {
                    Self::$measured => MEASURED,
                    $(Self::$kind => <$file::$kind as Method<1>>::ABOUT,)+
                }
            }

            /// Return the gains of a scene that states none. None for a coupling without gains.
            pub const fn default_gains(self) -> Option<Gains> {
                match self {
                    Self::$measured => None,
                    $(Self::$kind => Some(<$file::$kind as Method<1>>::DEFAULT),)+
                }
            }

            /// Return the meaning of the slave's numbers. None for a coupling that sends none.
            pub const fn slave_sends(self) -> Option<SlaveSends> {
                match self {
                    Self::$measured => None,
                    $(Self::$kind => Some(<$file::$kind as Method<1>>::SLAVE_SENDS),)+
                }
            }

            /// Return the least B in N s/m with which the coupling is passive at a stiffness in N/m, a round trip and a
            /// tick in s. None if it claims no passivity.
            pub fn least_damping(self, stiffness: f64, round_trip_s: f64, period_s: f64) -> Option<f64> {
                match self {
                    Self::$measured => None,
                    $(Self::$kind => <$file::$kind as Method<1>>::least_damping(stiffness, round_trip_s, period_s),)+
                }
            }

            /// Return whether the push on a released stylus may grow.
            pub const fn push_may_grow(self) -> bool {
                match self {
                    Self::$measured => false,
                    $(Self::$kind => <$file::$kind as Method<1>>::PUSH_MAY_GROW,)+
                }
            }
        }

        /// Half of a coupling, of either side.
        #[derive(Clone, Copy, Debug)]
        pub(crate) enum Half {
            $($kind($file::$kind),)+
        }

        impl Half {
            /// Build the half of a coupling. None for position-force, whose halves are those of
            /// [`Mapping`](crate::coupling::Mapping).
            pub(crate) fn new<const N: usize>(kind: CouplingKind, gains: Gains) -> Option<Self> {
                Some(match kind {
                    CouplingKind::$measured => return None,
                    $(CouplingKind::$kind => Self::$kind(<$file::$kind as Method<N>>::new(gains)),)+
                })
            }

            #[inline]
            pub(super) fn master<const N: usize>(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
                match self { $(Self::$kind(half) => half.master(own, peer),)+ }
            }

            #[inline]
            pub(super) fn slave<const N: usize>(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
                match self { $(Self::$kind(half) => half.slave(own, peer),)+ }
            }
        }
    };
}

/// Measured position-force. Its halves are [`Mapping`](crate::coupling::Mapping), because rows in lanes use them too.
const MEASURED: CouplingAbout = CouplingAbout {
    name: "position-force",
    title: "position forward, measured force back",
    source: "Hannaford 1989; Lawrence 1993",
};

couplings! {
    /// Position forward, measured force backward.
    PositionForce = 0;
    /// Position forward, computed force backward.
    PositionForceComputed = 1: computed_force;
    /// Positions both ways: a spring and a damper between the sides.
    PositionPosition = 2: position_position;
    /// Positions both ways, with a damper at each side.
    PdDamped = 3: pd_damped;
}

impl CouplingKind {
    /// Code in frames and in their form.
    #[allow(clippy::cast_lossless)] // a constant function
    pub const fn code(self) -> u16 {
        self as u16
    }

    /// Return whether each side compares its motion with that of the other.
    pub const fn compares_motions(self) -> bool {
        matches!(self.slave_sends(), Some(SlaveSends::Motion))
    }

    /// Return the kind of a code.
    pub fn from_code(code: u16) -> Option<Self> {
        Self::ALL.iter().copied().find(|kind| kind.code() == code)
    }

    /// Name in scenes.
    pub const fn name(self) -> &'static str {
        self.about().name
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_scenes_are_those_of_the_table_and_codes_fit_four_bits() {
        for kind in CouplingKind::ALL {
            let named: CouplingKind = serde_json::from_value(kind.name().into()).unwrap();
            assert_eq!(named, *kind);
            assert_eq!(CouplingKind::from_code(kind.code()), Some(*kind));
            assert!(kind.code() < 15, "{kind:?}: 15 is reserved");
            assert_eq!(
                Half::new::<1>(*kind, Gains { stiffness: 1.0, damping: 1.0 }).is_none(),
                kind.code() == 0
            );
        }
        assert_eq!(CouplingKind::from_code(15), None);
    }
}
