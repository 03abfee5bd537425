//! Four-channel coupling: motions and forces both ways.

use std::{fmt::Debug, marker::PhantomData};

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space, spring_damper};

/// Time constant in s of the filter on `F_h`: an estimate from the second difference of positions is noisy.
const FILTER_S: f64 = 0.01;
/// Time in s over which the measured forces fade in: the path may be so long that the gain of the ladder is 1 already.
const FADE_S: f64 = 0.2;

/// Spring and damper between the sides, with the force of the hand and of the environment.
///
/// - `F_m = K (x_m - x_s') + B (v_m - v_s') - C2 F_e' - C6 F_h + d v_m`
/// - `F_c = K (x_m' - x_s) + B (v_m' - v_s) + C3 F_h' + C5 F_e - d v_s`
///
/// With `C6 = C2 - 1` and `C5 = C3 - 1` both sides are at the same place at rest, and the hand feels the force of the
/// environment: the compliance in series is 0.
///
/// `C3 F_h + C5 F_e` is `C3` times what accelerates both together, less what the environment already does. So the tool moves
/// as one of `1 / C3` of its mass. With `C2 = 0` or `C3 = 0` three channels are left. Leaving out one of the four terms alone
/// would multiply the force.
///
/// `F_h` passes a low-pass of first order, 10 ms, at the half that uses it. Measured forces fade in over 0.2 s.
///
/// The acceleration form has the same equations: `C2 = M_m K_f`, `C3 = M_s K_f` and `K = M K_p`, where observers of the
/// reaction force give `F_h` and `F_e`.
///
/// Source: Lawrence 1993; Hashtrudi-Zaad and Salcudean 2001, 2002; acceleration form: Sakaino, Sato and Ohnishi 2011.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Channels<const N: usize, F> {
    gains: Gains,
    /// `F_h` in N after the filter.
    grasp: Axes<N>,
    /// Share of the measured forces, 0 at the engagement to 1.
    share: f64,
    form: PhantomData<F>,
}

/// Form of the coupling: its channels by its default gains.
pub(super) trait Form: Copy + Debug {
    const ABOUT: CouplingAbout;
    const DEFAULT: Gains;
}

/// All four channels.
#[derive(Clone, Copy, Debug)]
pub(crate) struct All;

pub(crate) type FourChannel<const N: usize> = Channels<N, All>;

impl Form for All {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "four-channel",
        title: "motions and forces both ways",
        source: "Lawrence 1993; Hashtrudi-Zaad and Salcudean 2001, 2002",
    };
    const DEFAULT: Gains =
        Gains { impedance: 5.0, environment_gain: 0.3, grasp_gain: 1.0, ..Gains::spring(300.0, 8.0) };
}

impl<const N: usize, F> Channels<N, F> {
    /// Step filter and fade; return `F_h` and the share of the measured forces.
    fn measured(&mut self, grasp: &Axes<N>, dt: f64) -> (Axes<N>, f64) {
        let share = self.share;
        self.share = (share + dt / FADE_S).min(1.0);
        self.grasp += (grasp - self.grasp) * (dt / (FILTER_S + dt));
        (self.grasp, share)
    }
}

impl<const N: usize, F: Form> Method<N> for Channels<N, F> {
    const ABOUT: CouplingAbout = F::ABOUT;
    const DEFAULT: Gains = F::DEFAULT;
    const SLAVE_SENDS: Sends = Sends::Motion;
    const NEEDS_GRASP_FORCE: bool = true;
    const IS_LINEAR: bool = false;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, _space: Space) -> Self {
        Self { gains, grasp: Axes::zeros(), share: 0.0, form: PhantomData }
    }

    fn compliance(_gains: &Gains, _round_trip_s: f64, _period_s: f64) -> f64 {
        0.0
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let Gains { environment_gain, impedance, .. } = self.gains;
        let (grasp, share) = self.measured(own.force, own.dt);
        let measured = grasp * (1.0 - environment_gain) - peer.force * environment_gain;
        measured * share + own.velocity * (impedance * own.gain) - spring_damper(&self.gains, own, peer)
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let Gains { grasp_gain, impedance, .. } = self.gains;
        let (grasp, share) = self.measured(peer.force, own.dt);
        let measured = grasp * grasp_gain + own.force * (grasp_gain - 1.0);
        spring_damper(&self.gains, own, peer) + measured * share - own.velocity * impedance
    }
}
