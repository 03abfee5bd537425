//! Three-channel coupling with the force of the hand.

use haptether_safety::Axes;

use super::{
    super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space},
    four_channel::FourChannel,
};

/// Four-channel coupling without `F_e` on the way back: `C2 = 0`, `C6 = -1`.
///
/// The hand feels the environment by the spring. An error of the estimated `F_h` is a force on the tool.
///
/// Source: Hashtrudi-Zaad and Salcudean 2002.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ThreeChannelGrasp<const N: usize>(FourChannel<N>);

impl<const N: usize> Method<N> for ThreeChannelGrasp<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "three-channel-grasp",
        title: "motions both ways, force of the hand forward",
        source: "Hashtrudi-Zaad and Salcudean 2002",
    };
    const DEFAULT: Gains = Gains { impedance: 2.0, grasp_gain: 1.0, ..Gains::spring(300.0, 8.0) };
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
