//! Time-domain passivity approach: position-force with computed force, and an energy observer at each side.

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space};

/// Rate in 1/s at which the slave follows the position of the master.
const FOLLOW_PER_S: f64 = 20.0;

/// Two-port with an exact passivity controller at each side.
///
/// Slave: `F_s = K (x_sd - x_s) + B (v_sd - v_s) = P_0 + g v_sd`, with `g = K dT + B`. It wants
/// `v = v_m' + k_d (x_m' - x_sd)`. It takes the largest share s of it, from 0 to 1, that its energy pays:
/// `dT s v (P_0 + g s v) <= W`, `W = E_0 + E_in,m' - E_out,s`. W never falls below zero, nothing is divided by a force or a
/// velocity, and W pays for the correction of the drift.
///
/// Master: `F_m = F_s' + (d_0 + alpha) v`. `W_m = E_0 + E_in,s' - E_out,m` plus what alpha has really taken. Below zero,
/// `alpha = -W_m / (dT v²)` up to a bound, and the rest of the deficit is carried. The damping `d_0` counts as energy of
/// the hand. Without it and without `E_0` the slave never begins to move.
///
/// Source: Ryu, Artigas and Preusche 2010; drift: Coelho et al. 2019; exact energies: Stramigioli et al. 2005.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tdpa<const N: usize> {
    gains: Gains,
    space: Space,
    /// Energy in J from the plant into the link, which frames carry.
    in_j: f64,
    /// Energy in J from the link into the plant, less what alpha has taken.
    out_j: f64,
    /// W in J; below 0 for a deficit of the master that alpha has not taken yet.
    left_j: f64,
    /// Force in N at the last tick, and its share by alpha.
    force: Axes<N>,
    taken: Axes<N>,
    /// `x_sd - x_s` in m of the slave.
    stretch: Axes<N>,
}

impl<const N: usize> Tdpa<N> {
    /// Renew W from the energy of the peer.
    fn renew(&mut self, peer: &Peer<'_, N>) {
        self.left_j = self.gains.start_j + peer.sum - self.out_j;
    }
}

impl<const N: usize> Method<N> for Tdpa<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "tdpa",
        title: "computed force back, with a passivity controller at each side",
        source: "Ryu, Artigas and Preusche 2010; Coelho et al. 2019",
    };
    const DEFAULT: Gains = Gains { impedance: 3.0, most_damping: 20.0, ..Gains::spring(300.0, 8.0) };
    const SLAVE_SENDS: Sends = Sends::Force;
    const SENDS_ENERGY: bool = true;
    const PLAYS_OUT: bool = true;
    const IS_LINEAR: bool = false;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, space: Space) -> Self {
        let [force, taken, stretch] = [Axes::zeros(); 3];
        Self { gains, space, in_j: 0.0, out_j: 0.0, left_j: gains.start_j, force, taken, stretch }
    }

    /// `K dT`: the spring of the slave is sampled.
    fn least_damping(stiffness: f64, _round_trip_s: f64, period_s: f64) -> Option<f64> {
        Some(stiffness * period_s)
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let squared = self.force.norm_squared();
        let share = if squared > 0.0 { (own.exerted.dot(&self.force) / squared).clamp(0.0, 1.0) } else { 0.0 };
        let taken_j = (self.taken.dot(own.moved) * share).max(0.0);
        let port_j = own.exerted.dot(own.moved) - taken_j;
        self.out_j += (-port_j).max(0.0) - taken_j;
        self.in_j += port_j.max(0.0);
        let speed = own.velocity.norm_squared();
        self.renew(peer);
        let alpha = if self.left_j < 0.0 && speed > 0.0 {
            (-self.left_j / (own.dt * speed)).min(self.gains.most_damping)
        } else {
            0.0
        };
        self.taken = own.velocity * alpha;
        self.force = peer.vector + own.velocity * (self.gains.impedance * own.gain) + self.taken;
        self.force
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let Gains { stiffness, damping, .. } = self.gains;
        self.stretch = self.space.left(&self.stretch, own.moved);
        let at_rest = self.stretch * stiffness - own.velocity * damping;
        let per_speed = stiffness * own.dt + damping;
        let behind = self.space.left(&(peer.position - own.position), &self.stretch);
        let wanted = peer.velocity + behind * FOLLOW_PER_S;
        // Energy of a share s of the wanted motion: dT (s p + s² q).
        let (p, q) = (wanted.dot(&at_rest), per_speed * wanted.norm_squared());
        self.renew(peer);
        let most = self.left_j.max(0.0) / own.dt;
        let root = (p * p + 4.0 * q * most).sqrt();
        // Each form of the root where it does not cancel.
        let share = if p + q <= most {
            1.0
        } else if p > 0.0 {
            (2.0 * most / (p + root)).clamp(0.0, 1.0)
        } else {
            ((root - p) / (2.0 * q)).clamp(0.0, 1.0)
        };
        let velocity = wanted * share;
        self.stretch = self.space.advanced(&self.stretch, &(velocity * own.dt));
        self.force = at_rest + velocity * per_speed;
        let port_j = own.dt * self.force.dot(&velocity);
        self.out_j += port_j.max(0.0);
        self.in_j += (-port_j).max(0.0);
        self.left_j -= port_j.max(0.0);
        self.force
    }

    fn sent(&self) -> (Axes<N>, f64) {
        (self.force, self.in_j)
    }

    fn left_j(&self) -> f64 {
        self.left_j
    }
}
