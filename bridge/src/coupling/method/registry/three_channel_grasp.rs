//! Three-channel coupling with the force of the hand.

use super::{
    super::{CouplingAbout, Gains},
    four_channel::{Channels, Form},
};

/// Four-channel coupling without `F_e` on the way back: `C2 = 0`, `C6 = -1`.
///
/// The hand feels the environment by the spring. An error of the estimated `F_h` is a force on the tool.
///
/// Source: Hashtrudi-Zaad and Salcudean 2002.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Grasp;

pub(crate) type ThreeChannelGrasp<const N: usize> = Channels<N, Grasp>;

impl Form for Grasp {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "three-channel-grasp",
        title: "motions both ways, force of the hand forward",
        source: "Hashtrudi-Zaad and Salcudean 2002",
    };
    const DEFAULT: Gains = Gains { impedance: 2.0, grasp_gain: 1.0, ..Gains::spring(300.0, 8.0) };
}
