//! Three-channel coupling with the force of the environment.

use super::{
    super::{CouplingAbout, Gains},
    four_channel::{Channels, Form},
};

/// Four-channel coupling without `F_h` on the way to the slave: `C3 = 0`, `C5 = -1`.
///
/// `F_c` cancels the force of the environment on the tool. The tool follows the hand by spring and damper, which need more
/// damping than with four channels. An error of the estimated `F_h` acts at the hand, `(1 - C2) / C2` times.
///
/// Source: Hashtrudi-Zaad and Salcudean 2002.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Environment;

pub(crate) type ThreeChannelEnvironment<const N: usize> = Channels<N, Environment>;

impl Form for Environment {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "three-channel-environment",
        title: "motions both ways, force of the environment back",
        source: "Hashtrudi-Zaad and Salcudean 2002",
    };
    const DEFAULT: Gains = Gains { impedance: 10.0, environment_gain: 0.3, ..Gains::spring(300.0, 8.0) };
}
