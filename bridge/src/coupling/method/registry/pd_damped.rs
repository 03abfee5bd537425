//! Proportional coupling with damping injection (P+d).

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space};

/// Spring between the sides, and a damper to ground at each side.
///
/// `F_m = K (x_m - x_s') + B v_m`, `F_c = K (x_m' - x_s) - B v_s`. In series it has the compliance `1/K`.
///
/// It is passive if `4 B_m B_s > (T1 + T2)² K_m K_s`; the bounds of the delays include jitter. A sampled spring needs
/// `B > K (dT/2 + d dT)` beside it, where V lags by d ticks. With equal gains: `B > K ((T1 + T2) / 2 + dT)`.
///
/// Source: Lee and Spong 2006; Nuno, Basanez and Ortega 2011; sampled: Colgate and Schenkel 1997.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PdDamped<const N: usize> {
    gains: Gains,
}

impl<const N: usize> Method<N> for PdDamped<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "pd-damped",
        title: "a spring between both positions, and a damper at each side",
        source: "Lee and Spong 2006; Nuno, Basanez and Ortega 2011",
    };
    const DEFAULT: Gains = Gains::spring(100.0, 3.0);
    const SLAVE_SENDS: Sends = Sends::Motion;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, _space: Space) -> Self {
        Self { gains }
    }

    /// `K (T1 + T2) / 2 + K dT`: half a tick for the sampled spring, and half a tick because V is older than the force.
    fn least_damping(stiffness: f64, round_trip_s: f64, period_s: f64) -> Option<f64> {
        Some(stiffness * (0.5 * round_trip_s + period_s))
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        (own.position - peer.position) * self.gains.stiffness + own.velocity * (self.gains.damping * own.gain)
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        (peer.position - own.position) * self.gains.stiffness - own.velocity * (self.gains.damping * own.gain)
    }
}
