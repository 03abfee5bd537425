//! Position-force coupling with the computed force.

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space, spring_damper};

/// Position forward, the force of the slave's controller back.
///
/// `F_c = K (x_m' - x_s) + B (v_m' - v_s)`, `F_m = F_c'`. At rest the hand feels
/// `F = (x_t - x_w) / (lambda_f lambda_p / K_h + 1/K + 1/K_e)`. At short delays it is stable on stiffer walls than the
/// measured force.
///
/// Source: Hannaford 1989; Lawrence 1993; Daniel and `McAree` 1998.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PositionForceComputed<const N: usize> {
    gains: Gains,
}

impl<const N: usize> Method<N> for PositionForceComputed<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "position-force-computed",
        title: "position forward, force of the slave's controller back",
        source: "Hannaford 1989; Lawrence 1993; Daniel and McAree 1998",
    };
    const DEFAULT: Gains = Gains::spring(300.0, 8.0);
    const SLAVE_SENDS: Sends = Sends::Force;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, _space: Space) -> Self {
        Self { gains }
    }

    fn master(&mut self, _own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        *peer.vector
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        spring_damper(&self.gains, own, peer)
    }
}
