//! Three-channel coupling with the force of the environment.

use haptether_safety::Axes;

use super::{
    super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space},
    four_channel::FourChannel,
};

/// Four-channel coupling without `F_h` on the way to the slave: `C3 = 0`, `C5 = -1`.
///
/// The tool does not feel the environment itself: `F_c` has its reaction. It follows the hand by spring and damper, which need
/// more damping than with four channels. An error of the estimated `F_h` acts at the hand, `(1 - C2) / C2` times.
///
/// Source: Hashtrudi-Zaad and Salcudean 2002.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ThreeChannelEnvironment<const N: usize>(FourChannel<N>);

impl<const N: usize> Method<N> for ThreeChannelEnvironment<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "three-channel-environment",
        title: "motions both ways, force of the environment back",
        source: "Hashtrudi-Zaad and Salcudean 2002",
    };
    const DEFAULT: Gains = Gains { impedance: 10.0, environment_gain: 0.3, ..Gains::spring(300.0, 8.0) };
    const SLAVE_SENDS: Sends = Sends::Motion;
    const NEEDS_GRASP_FORCE: bool = true;
    const IS_LINEAR: bool = false;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, _space: Space) -> Self {
        Self(FourChannel::of(gains))
    }

    fn compliance(_gains: &Gains, _round_trip_s: f64, _period_s: f64) -> f64 {
        0.0
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        self.0.at_master(own, peer)
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        self.0.at_slave(own, peer)
    }
}
