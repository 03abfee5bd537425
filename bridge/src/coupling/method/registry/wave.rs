//! Waves: scattering variables with their integrals and energies in the frames.

use haptether_safety::Axes;

use super::super::{CouplingAbout, Gains, Local, Method, Peer, Sends, Space, capped};

/// Time in s of rest after which the slave removes a drift: longer than the round trip, in which waves still come back.
const QUIET_S: f64 = 1.0;
/// Rate in 1/s at which the slave removes a drift, and its largest speed in small distances per second.
const DRIFT_PER_S: f64 = 2.0;
const DRIFT_SPEED: f64 = 100.0;
/// Damping of the master in units of b that pays for the damper b, which is held for a tick.
const PAYING: f64 = 0.05;

/// Wave coupling of impedance b.
///
/// `u = (b v_m + F_m) / (2b)^(1/2)` goes to the slave, and `w = (b v_sd - F_s) / (2b)^(1/2)` comes back. The power of a side
/// is the difference of its waves: `F v = (u² - w²) / 2`. So a constant delay only stores energy.
///
/// A spring K and a damper B hold the tool at `x_sd`: `F_s = K (x_sd - x_s) + B (v_sd - v_s)`, solved with `v_sd` of the same
/// tick. In series the coupling has the compliance `1/K + (T1 + T2 + dT + 2 spread) / (2 b)`. The `dT` stands there
/// because a wave of the master describes the last tick.
///
/// A frame has the integral of the wave and its energy. The receiver plays over `spread` what it has not played yet, and at
/// most the energy that has arrived and `E_0`. So loss, jitter and order create no energy. Over a longer gap the
/// last wave stays, and `E_0` advances its energy.
///
/// A sender pays its wave from the energy that its port has received: the exerted force times the measured motion. The damper
/// b of the master is held for a tick and takes less energy than its wave has. A damping of 5 % of b pays the difference.
///
/// The slave moves `x_sd` towards the position of the master: across the force at all times, because an integral of twists
/// is no orientation, and along it while both sides rest without force. It pays this from what the waves left.
///
/// Source: Anderson and Spong 1989; Niemeyer and Slotine 1991, 2004; energy: Chopra, Berestesky and Spong 2003.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wave<const N: usize> {
    gains: Gains,
    space: Space,
    outgoing: Outgoing<N>,
    incoming: Incoming<N>,
    /// Energy in J that the port has received and the wave has not taken.
    budget_j: f64,
    /// Force in N of the damping that pays, over the last tick of the master.
    paying: Axes<N>,
    /// `x_sd - x_s` in m of the slave.
    stretch: Axes<N>,
    /// Time in s that spring and wave of the slave have been small.
    quiet_s: f64,
}

/// Wave that a half sends. The part that its budget does not pay is sent later.
#[derive(Clone, Copy, Debug)]
struct Outgoing<const N: usize> {
    waiting: Axes<N>,
    sent: Axes<N>,
    energy_j: f64,
}

impl<const N: usize> Outgoing<N> {
    /// Send as much of `amount`, a wave times dt, and of what waits as the budget in J pays.
    fn send(&mut self, amount: &Axes<N>, dt: f64, budget_j: &mut f64) {
        self.waiting += amount;
        let wave = capped(&(self.waiting / dt), (2.0 * budget_j.max(0.0) / dt).sqrt());
        let energy_j = 0.5 * dt * wave.norm_squared();
        self.waiting -= wave * dt;
        self.sent += wave * dt;
        self.energy_j += energy_j;
        *budget_j -= energy_j;
    }
}

/// Wave that a half plays, from the integral and the energy of its peer.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Incoming<const N: usize> {
    pub(in super::super) played: Axes<N>,
    pub(in super::super) energy_j: f64,
    /// Wave of the last tick, and the time in s since the newest frame.
    pub(in super::super) wave: Axes<N>,
    pub(in super::super) age_s: f64,
}

impl<const N: usize> Incoming<N> {
    /// Return the wave of this tick: it reaches the newest integral `spread_s` after the tick in which that came, and then
    /// stays. So it is constant over a gap in the frames, and over a tick that is late: the energy of a wave that varies does
    /// not pay for its integral.
    ///
    /// The energy that has arrived bounds the wave in two ways. This tick can play `w² dT / 2` of it. And all that has arrived
    /// can be played as one constant wave: its energy and its integral then end together. Without the second bound a few long
    /// gaps take the energy of a force at rest, and a part of its integral can never be played.
    pub(in super::super) fn play(&mut self, peer: &Peer<'_, N>, spread_s: f64, dt: f64) -> Axes<N> {
        self.age_s = if peer.is_new { 0.0 } else { self.age_s + dt };
        let rest_s = spread_s - self.age_s;
        let left = peer.vector - self.played;
        let left_j = (peer.sum - self.energy_j).max(0.0);
        let wanted = if rest_s > -0.5 * dt { left / (rest_s.max(0.0) + dt) } else { self.wave };
        // 0 / 0 is NaN, which min ignores.
        let wave = capped(&wanted, (2.0 * left_j / dt).sqrt().min(2.0 * left_j / left.norm()));
        self.wave = wave;
        self.played += wave * dt;
        self.energy_j += 0.5 * dt * wave.norm_squared();
        wave
    }
}

impl<const N: usize> Wave<N> {
    fn root(&self) -> f64 {
        (2.0 * self.gains.impedance).sqrt()
    }

    /// Move `x_sd` towards the position of the master: across the force, which takes no power, and in all directions once
    /// spring and wave have been small for a while. The energy that has arrived and was not played pays for it.
    fn correct_drift(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>, [force, wave]: [&Axes<N>; 2]) {
        let small = self.space.small();
        let stretched = self.stretch.norm().max(self.root() * wave.norm() / self.gains.stiffness);
        let free = 1.0 - stretched / small;
        self.quiet_s = if free > 0.0 { self.quiet_s + own.dt } else { 0.0 };
        let mut drift = self.space.left(&(peer.position - own.position), &self.stretch);
        let squared = force.norm_squared();
        if self.quiet_s < QUIET_S {
            if N == 1 || squared == 0.0 {
                return;
            }
            drift -= force * (force.dot(&drift) / squared);
        }
        let step = capped(&(drift * DRIFT_PER_S), DRIFT_SPEED * small) * own.dt;
        let stretched = self.space.advanced(&self.stretch, &step);
        let cost_j = 0.5 * self.gains.stiffness * (stretched.norm_squared() - self.stretch.norm_squared());
        if cost_j <= peer.sum - self.incoming.energy_j - self.gains.start_j {
            self.incoming.energy_j += cost_j.max(0.0);
            self.stretch = stretched;
        }
    }
}

impl<const N: usize> Method<N> for Wave<N> {
    const ABOUT: CouplingAbout = CouplingAbout {
        name: "wave",
        title: "waves of motion and force, whose delay only stores energy",
        source: "Niemeyer and Slotine 1991, 2004; Chopra, Berestesky and Spong 2003",
    };
    const DEFAULT: Gains = Gains { impedance: 4.0, start_j: 2.5e-3, spread_s: 0.004, ..Gains::spring(300.0, 8.0) };
    const MASTER_SENDS: Sends = Sends::Wave;
    const SLAVE_SENDS: Sends = Sends::Wave;
    const SENDS_ENERGY: bool = true;
    const PLAYS_OUT: bool = true;
    const IS_LINEAR: bool = false;
    const PUSH_MAY_GROW: bool = true;

    fn new(gains: Gains, space: Space) -> Self {
        let zero = Axes::zeros();
        let outgoing = Outgoing { waiting: zero, sent: zero, energy_j: 0.0 };
        let incoming = Incoming { played: zero, energy_j: -gains.start_j, wave: zero, age_s: 0.0 };
        Self { gains, space, outgoing, incoming, budget_j: 0.0, paying: zero, stretch: zero, quiet_s: 0.0 }
    }

    /// `K dT`: the spring of the slave is sampled.
    fn least_damping(stiffness: f64, _round_trip_s: f64, period_s: f64) -> Option<f64> {
        Some(stiffness * period_s)
    }

    fn compliance(gains: &Gains, round_trip_s: f64, period_s: f64) -> f64 {
        1.0 / gains.stiffness + (round_trip_s + period_s + 2.0 * gains.spread_s) / (2.0 * gains.impedance)
    }

    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let (b, root) = (self.gains.impedance, self.root());
        self.budget_j += own.exerted.dot(own.moved);
        let of_wave = own.exerted - self.paying;
        self.outgoing.send(&((own.moved * b + of_wave * own.dt) / root), own.dt, &mut self.budget_j);
        if own.gain < 1.0 {
            // Motion while the force fades in is not sent.
            self.outgoing.waiting = Axes::zeros();
        }
        let wave = self.incoming.play(peer, self.gains.spread_s, own.dt);
        self.budget_j += 0.5 * own.dt * wave.norm_squared();
        self.paying = own.velocity * (PAYING * b * own.gain);
        own.velocity * (b * own.gain) + self.paying - wave * root
    }

    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N> {
        let Gains { stiffness, damping, impedance: b, spread_s, .. } = self.gains;
        let (root, dt) = (self.root(), own.dt);
        self.stretch = self.space.left(&self.stretch, own.moved);
        if peer.rests {
            return self.stretch * stiffness - own.velocity * damping;
        }
        let wave = self.incoming.play(peer, spread_s, dt);
        let at_rest = self.stretch * stiffness - own.velocity * damping;
        let per_speed = stiffness * dt + damping;
        let velocity = (wave * root - at_rest) / (b + per_speed);
        let force = at_rest + velocity * per_speed;
        self.stretch = self.space.advanced(&self.stretch, &(velocity * dt));
        let back = (velocity * b - force) / root;
        self.budget_j += 0.5 * dt * wave.norm_squared() - dt * force.dot(&velocity);
        self.outgoing.send(&(back * dt), dt, &mut self.budget_j);
        self.correct_drift(own, peer, [&force, &wave]);
        force
    }

    fn sent(&self) -> (Axes<N>, f64) {
        (self.outgoing.sent, self.outgoing.energy_j)
    }

    fn left_j(&self) -> f64 {
        self.budget_j
    }
}
