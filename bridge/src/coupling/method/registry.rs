//! Registry of the couplings: a coupling is one file and one line here.

use haptether_safety::Axes;
use schemars::JsonSchema;
use serde::Deserialize;

use super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space};
use crate::wire::Role;

/// Declare every item that depends on the set of couplings; each line is `Kind = code: file;`.
macro_rules! couplings {
    ($(#[$doc:meta])* $measured:ident = $zero:literal; $($(#[$docs:meta])* $kind:ident = $code:literal: $file:ident;)+) => {
        $(pub(super) mod $file;)+

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
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::ABOUT,)+
                }
            }

            /// Return the gains of a scene that states none. None for a coupling without gains.
            pub const fn default_gains(self) -> Option<Gains> {
                match self {
                    Self::$measured => None,
                    $(Self::$kind => Some(<$file::$kind<1> as Method<1>>::DEFAULT),)+
                }
            }

            /// Return the meaning of a side's numbers. None for a coupling that sends none.
            pub const fn sends(self, role: Role) -> Option<Sends> {
                match (self, role) {
                    (Self::$measured, _) => None,
                    $((Self::$kind, Role::Master) => Some(<$file::$kind<1> as Method<1>>::MASTER_SENDS),
                    (Self::$kind, Role::Slave) => Some(<$file::$kind<1> as Method<1>>::SLAVE_SENDS),)+
                }
            }

            /// Return whether both sides send an energy.
            pub const fn sends_energy(self) -> bool {
                match self {
                    Self::$measured => false,
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::SENDS_ENERGY,)+
                }
            }

            /// Return whether frames pass a play-out.
            pub const fn plays_out(self) -> bool {
                match self {
                    Self::$measured => false,
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::PLAYS_OUT,)+
                }
            }

            /// Return whether the coupling uses the force of the hand.
            pub const fn needs_grasp_force(self) -> bool {
                match self {
                    Self::$measured => false,
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::NEEDS_GRASP_FORCE,)+
                }
            }

            /// Return whether both halves are linear.
            pub const fn is_linear(self) -> bool {
                match self {
                    Self::$measured => false,
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::IS_LINEAR,)+
                }
            }

            /// Return C in m/N in series between hand and tool at rest. None for position-force, whose slave commands a
            /// motion.
            pub fn compliance(self, gains: &Gains, round_trip_s: f64, period_s: f64) -> Option<f64> {
                match self {
                    Self::$measured => None,
                    $(Self::$kind => Some(<$file::$kind<1> as Method<1>>::compliance(gains, round_trip_s, period_s)),)+
                }
            }

            /// Return the least B in N s/m with which the coupling is passive at a stiffness in N/m, a round trip and a
            /// tick in s. None if it claims no passivity.
            pub fn least_damping(self, stiffness: f64, round_trip_s: f64, period_s: f64) -> Option<f64> {
                match self {
                    Self::$measured => None,
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::least_damping(stiffness, round_trip_s, period_s),)+
                }
            }

            /// Return whether the push on a released stylus may grow.
            pub const fn push_may_grow(self) -> bool {
                match self {
                    Self::$measured => false,
                    $(Self::$kind => <$file::$kind<1> as Method<1>>::PUSH_MAY_GROW,)+
                }
            }
        }

        /// Half of a coupling, of either side.
        #[derive(Clone, Copy, Debug)]
        pub(crate) enum Half<const N: usize> {
            $($kind($file::$kind<N>),)+
        }

        impl<const N: usize> Half<N> {
            /// Build the half of a coupling. None for position-force, whose halves are those of
            /// [`Mapping`](crate::coupling::Mapping).
            pub(super) fn new(kind: CouplingKind, gains: Gains, space: Space) -> Option<Self> {
                Some(match kind {
                    CouplingKind::$measured => return None,
                    $(CouplingKind::$kind => Self::$kind(Method::<N>::new(gains, space)),)+
                })
            }

            #[inline]
            pub(super) fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
                match self { $(Self::$kind(half) => half.master(own, peer),)+ }
            }

            #[inline]
            pub(super) fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
                match self { $(Self::$kind(half) => half.slave(own, peer),)+ }
            }

            /// Return the own numbers and the energy in J for the next frame.
            #[inline]
            pub(super) fn sent(&self) -> (Axes<N>, f64) {
                match self { $(Self::$kind(half) => Method::<N>::sent(half),)+ }
            }

            /// Return the energy in J that the half may still give.
            #[inline]
            pub(super) fn left_j(&self) -> f64 {
                match self { $(Self::$kind(half) => Method::<N>::left_j(half),)+ }
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
    /// Waves: motion and force combined, so that delay only stores energy.
    Wave = 4: wave;
    /// Time-domain passivity: as computed force, with observers of energy at both sides.
    Tdpa = 5: tdpa;
    /// Set positions modulated by energy.
    Pspm = 6: pspm;
    /// Motions and forces both ways.
    FourChannel = 7: four_channel;
    /// Four-channel without the force of the hand on the way forward.
    ThreeChannelEnvironment = 8: three_channel_environment;
    /// Four-channel without the force of the environment on the way back.
    ThreeChannelGrasp = 9: three_channel_grasp;
}

impl CouplingKind {
    /// Code in frames and in their form.
    #[allow(clippy::cast_lossless)] // a constant function
    pub const fn code(self) -> u16 {
        self as u16
    }

    /// Return whether each side compares its motion with that of the other.
    pub const fn compares_motions(self) -> bool {
        matches!(self.sends(Role::Slave), Some(Sends::Motion))
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
                Half::<1>::new(*kind, Gains::spring(1.0, 1.0), Space::Translation).is_none(),
                kind.code() == 0
            );
        }
        assert_eq!(CouplingKind::from_code(15), None);
    }
}
