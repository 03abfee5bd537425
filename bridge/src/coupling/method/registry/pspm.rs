//! Passive set-position modulation.

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space, capped};

/// Largest energy that a side keeps, as a share of `E_0`. The rest goes to the peer.
const KEPT: f64 = 0.25;

/// Spring K and damper B at each side towards a set position, which moves to the peer's as far as energy allows.
///
/// `F = K (y - x) - B v`. At each tick y moves to the point nearest to the peer's position that the energy E pays:
/// `y = x + clip(x' - x, r)`, `r² = |y_before - x|² + 2 (E + D) / K`.
///
/// D is what the damper has taken since the last tick: the work of the plant less the change of the spring. It is
/// `(B - K dT/2) |dx|² / dT`. What E has above its bound goes to the peer. In series it has the compliance `1/K`.
///
/// Source: Lee and Huang 2010; the sampled spring: Colgate and Schenkel 1997.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pspm<const N: usize> {
    gains: Gains,
    space: Space,
    /// E in J.
    left_j: f64,
    /// Energy in J given to and taken from the peer.
    given_j: f64,
    taken_j: f64,
    /// `y - x` in m.
    stretch: Axes<N>,
}

impl<const N: usize> Pspm<N> {
    /// Step the set position; `work_j` is the work in J of the plant on this side. Return `K (y - x)`.
    fn pull(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>, work_j: f64) -> Axes<N> {
        let Gains { stiffness, start_j, .. } = self.gains;
        let stored_j = |stretch: &Axes<N>| 0.5 * stiffness * stretch.norm_squared();
        let after = self.space.left(&self.stretch, own.moved);
        let dissipated_j = work_j + stored_j(&self.stretch) - stored_j(&after);
        let received_j = (peer.sum - self.taken_j).max(0.0);
        self.taken_j += received_j;
        self.left_j += dissipated_j + received_j;
        let reach = (after.norm_squared() + 2.0 * self.left_j / stiffness).max(0.0).sqrt();
        self.stretch = capped(&(peer.position - own.position), reach);
        self.left_j -= stored_j(&self.stretch) - stored_j(&after);
        let over_j = (self.left_j - KEPT * start_j).max(0.0);
        self.left_j -= over_j;
        self.given_j += over_j;
        self.stretch * stiffness
    }
}

impl<const N: usize> Method<N> for Pspm<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "pspm",
        title: "springs to set positions that move only as far as energy allows",
        source: "Lee and Huang 2010",
    };
    const DEFAULT: Gains = Gains { start_j: 2.5e-3, ..Gains::spring(300.0, 4.0) };
    const SLAVE_SENDS: Sends = Sends::Motion;
    const SENDS_ENERGY: bool = true;
    const IS_LINEAR: bool = false;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, space: Space) -> Self {
        Self { gains, space, left_j: gains.start_j, given_j: 0.0, taken_j: 0.0, stretch: Axes::zeros() }
    }

    /// `K dT / 2` of the sampled spring, and as much again because V is older than the force.
    fn least_damping(stiffness: f64, _round_trip_s: f64, period_s: f64) -> Option<f64> {
        Some(stiffness * period_s)
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let pull = self.pull(own, peer, own.exerted.dot(own.moved));
        own.velocity * (self.gains.damping * own.gain) - pull
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let pull = self.pull(own, peer, -own.exerted.dot(own.moved));
        pull - own.velocity * (self.gains.damping * own.gain)
    }

    fn sent(&self) -> (Axes<N>, f64) {
        (Axes::zeros(), self.given_j)
    }

    fn left_j(&self) -> f64 {
        self.left_j
    }
}
