//! Position-position coupling.

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space, spring_damper};

/// Spring and damper between the sides, at each side.
///
/// `F_m = K (x_m - x_s') + B (v_m - v_s')`, `F_c = K (x_m' - x_s) + B (v_m' - v_s)`. In series it has the compliance
/// `1/K`. In free motion the hand feels inertia and friction of the slave. With delay the damper creates energy.
///
/// Source: Lawrence 1993 (position-position).
#[derive(Clone, Copy, Debug)]
pub(crate) struct PositionPosition<const N: usize> {
    gains: Gains,
}

impl<const N: usize> Method<N> for PositionPosition<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "position-position",
        title: "a spring and a damper between both positions",
        source: "Lawrence 1993",
    };
    const DEFAULT: Gains = Gains::spring(100.0, 2.0);
    const SLAVE_SENDS: Sends = Sends::Motion;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, _space: Space) -> Self {
        Self { gains }
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        -spring_damper(&self.gains, own, peer)
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        spring_damper(&self.gains, own, peer)
    }
}
