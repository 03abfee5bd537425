//! Couplings: the force of each half on its device, from both motions in the slave's frame.

mod force;
mod master;
mod registry;
mod slave;
mod space;
mod tool;
mod turn;

use haptether_safety::Axes;

pub use force::ForceArm;
pub(crate) use force::Room;
pub(crate) use master::{CoupledMaster, HandMotion};
pub use registry::CouplingKind;
pub(crate) use registry::Half;
pub(crate) use slave::{CoupledSlave, OfHalf, OfMaster};
use space::Space;
pub use tool::VirtualToolSettings;
pub(crate) use tool::{VirtualTool, capped};
pub(crate) use turn::{CoupledMasterTurn, CoupledSlaveTurn};

use super::{CouplingError, mapping::check};
use crate::{command::OperatorCommand, wire::Role};

#[cfg(test)]
mod tests;

/// Name, title and source of a coupling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CouplingAbout {
    /// Name in scenes and tables.
    pub name: &'static str,
    /// One line for tables.
    pub title: &'static str,
    /// Publication.
    pub source: &'static str,
}

/// Value of the N numbers that a half sends beside position, velocity and force.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sends {
    /// Motion in m since the engagement, in the master's frame.
    Motion,
    /// `F_c` in N, in the slave's frame; only of a slave.
    Force,
    /// Integral of a wave in (J s)^(1/2) since the engagement, in the slave's frame.
    Wave,
}

/// Numbers of a coupling. A coupling does not use those that are 0 in its defaults.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// K in N/m (N m/rad).
    pub stiffness: f64,
    /// B in N s/m (N m s/rad).
    pub damping: f64,
    /// b in N s/m (N m s/rad): impedance of a wave, the damping `d0` at the master's port, or d at each side.
    pub impedance: f64,
    /// `E_0` in J, energy that each side has at the engagement.
    pub start_j: f64,
    /// Time in s over which a wave is spread.
    pub spread_s: f64,
    /// Largest damping in N s/m (N m s/rad) that the master may add.
    pub most_damping: f64,
    /// C2: gain of `F_e` at the hand.
    pub environment_gain: f64,
    /// C3: gain of `F_h` at the slave.
    pub grasp_gain: f64,
}

impl Gains {
    /// Return spring and damper alone.
    pub const fn spring(stiffness: f64, damping: f64) -> Self {
        Self {
            stiffness,
            damping,
            impedance: 0.0,
            start_j: 0.0,
            spread_s: 0.0,
            most_damping: 0.0,
            environment_gain: 0.0,
            grasp_gain: 0.0,
        }
    }

    /// Check all numbers: K above 0, the others at least 0.
    pub fn checked(self) -> Result<Self, CouplingError> {
        check("stiffness", "K", self.stiffness)?;
        let rest = [
            ("damping", "B", self.damping),
            ("impedance", "b", self.impedance),
            ("start_energy_j", "E_0", self.start_j),
            ("spread_s", "spread", self.spread_s),
            ("most_damping", "alpha_max", self.most_damping),
            ("environment_gain", "C2", self.environment_gain),
            ("grasp_gain", "C3", self.grasp_gain),
        ];
        match rest.into_iter().find(|(_, _, seen)| !(*seen >= 0.0 && seen.is_finite())) {
            Some((name, symbol, seen)) => Err(CouplingError::Negative { name, symbol, seen }),
            None => Ok(self),
        }
    }
}

/// Settings of a coupling with two halves; position-force has none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MethodSettings {
    /// Kind of the coupling.
    pub kind: CouplingKind,
    /// Spring and damper.
    pub gains: Gains,
    /// Virtual tool of the slave.
    pub tool: VirtualToolSettings,
    /// Bounds on force and torque of an arm that takes forces. It needs no virtual tool. None if the arm takes motions.
    pub forces: Option<[ForceArm; 2]>,
    /// `lambda_p` of the scene.
    pub position_scale: f64,
    /// The same for the rotation, in N m/rad, N m s/rad, kg m² and N m s/rad; None for a scene that does not turn.
    pub rotation: Option<(Gains, VirtualToolSettings)>,
}

impl MethodSettings {
    /// Return an error for a change of frame or scale that this coupling does not allow. `is_open` is true if the clutch is
    /// open and no force is left.
    ///
    /// The sides compare motions in the frame of the scene. If only one side changed, its spring would push. A coupling that
    /// counts energy keeps its scales, because energy that it holds has their units. Waves hold no locked axis.
    pub(crate) fn check_change(&self, command: &OperatorCommand, is_open: bool) -> Result<(), CouplingError> {
        let kind = self.kind.name();
        let fixed = |name, while_engaged| Err(CouplingError::Fixed { name, kind, while_engaged });
        match command {
            OperatorCommand::PositionScale(_) if self.kind.compares_motions() || self.kind.sends_energy() => {
                fixed("position_scale", false)
            }
            OperatorCommand::ForceScale(_) if self.kind.sends_energy() => fixed("force_scale", false),
            OperatorCommand::TorqueScale(_) if self.kind.sends_energy() => fixed("torque_scale", false),
            OperatorCommand::Frame { locked, .. }
                if self.kind.sends(Role::Master) == Some(Sends::Wave) && locked.contains(&true) =>
            {
                fixed("locked_axes", false)
            }
            OperatorCommand::RotationScale(_) if self.rotation.is_some() => fixed("rotation_scale", false),
            OperatorCommand::Frame { .. } if !is_open => fixed("quat_wxyz", true),
            _ => Ok(()),
        }
    }
}

/// State of a half's own device at this tick, in the slave's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Local<'a, const N: usize> {
    /// Position in m.
    pub(crate) position: &'a Axes<N>,
    /// Velocity in m/s.
    pub(crate) velocity: &'a Axes<N>,
    /// Way in m since the last tick.
    pub(crate) moved: &'a Axes<N>,
    /// `F_m` or `F_c` in N that was really exerted over that way.
    pub(crate) exerted: &'a Axes<N>,
    /// Force in N on the device: `F_h` of the hand at the master, one tick old and zero unless the coupling needs it; `F_e`
    /// of the environment at the slave.
    pub(crate) force: &'a Axes<N>,
    /// Share of the damping in effect, 0 to 1: the gain of the ladder at the master, 1 at the slave.
    pub(crate) gain: f64,
    /// Time in s since the last tick.
    pub(crate) dt: f64,
}

/// State of the other side in its newest frame, or in the frame that is played now, in the slave's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Peer<'a, const N: usize> {
    /// Position in m, from the same origin as the own position.
    pub(crate) position: &'a Axes<N>,
    /// Velocity in m/s.
    pub(crate) velocity: &'a Axes<N>,
    /// Force in N on its device, as [`Local::force`].
    pub(crate) force: &'a Axes<N>,
    /// Its own numbers, if they are a force in N or the integral of a wave; else zero.
    pub(crate) vector: &'a Axes<N>,
    /// Its energy in J, which only rises; 0 for a coupling that sends none.
    pub(crate) sum: f64,
    /// True if its frame is another one than at the last tick.
    pub(crate) is_new: bool,
    /// True if the half of the master is not engaged, or its frames are old: the set position of the slave then rests.
    pub(crate) rests: bool,
}

/// Two pure halves of a coupling. Frame map, scales, anchors and locks stand outside, in [`CoupledMaster`] and
/// [`CoupledSlave`].
///
/// Neither half is stepped while the sides are not engaged. Both motions are zero at the engagement, and each engagement
/// begins with a new half.
pub(crate) trait Method<const N: usize> {
    const ABOUT: CouplingAbout;
    /// Numbers of a scene that states none.
    const DEFAULT: Gains;
    /// Numbers that each half sends.
    const MASTER_SENDS: Sends = Sends::Motion;
    const SLAVE_SENDS: Sends;
    /// True if each half sends an energy, so that frames of another engagement must not count.
    const SENDS_ENERGY: bool = false;
    /// True if constant delay improves the coupling, so that frames pass a play-out.
    const PLAYS_OUT: bool = false;
    /// True if the coupling uses `F_h`, so that the safety layer estimates it and frames of the master have it.
    const NEEDS_GRASP_FORCE: bool = false;
    /// True if each half is a linear function of the motions alone, at one tick.
    const IS_LINEAR: bool = true;
    /// True if the push on a released stylus may grow, so that no bound may assume the force at the release.
    const PUSH_MAY_GROW: bool;

    fn new(gains: Gains, space: Space) -> Self;

    /// Return the least B in N s/m with which the coupling is passive at a round trip and a tick in s. None if it claims no
    /// passivity.
    fn least_damping(_stiffness: f64, _round_trip_s: f64, _period_s: f64) -> Option<f64> {
        None
    }

    /// Return C in m/N, the compliance in series between hand and tool at rest, at a round trip and a tick in s.
    fn compliance(gains: &Gains, _round_trip_s: f64, _period_s: f64) -> f64 {
        1.0 / gains.stiffness
    }

    /// Return `F_m` in N against the hand, in the slave's frame: the hand feels `F_v = -lambda_f R' L F_m`.
    fn master(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N>;

    /// Return `F_c` in N on the slave.
    fn slave(&mut self, own: &Local<'_, N>, peer: &Peer<'_, N>) -> Axes<N>;

    /// Return the own numbers and the energy in J for the next frame.
    fn sent(&self) -> (Axes<N>, f64) {
        (Axes::zeros(), 0.0)
    }

    /// Return the energy in J that the half may still give. It is below 0 for a deficit that it has to take back, and NaN
    /// for a half that counts none.
    fn left_j(&self) -> f64 {
        f64::NAN
    }
}

/// Coefficients of both halves, which are linear: of `F_m` in `x_m, v_m, x_s', v_s', F_c'`, and of `F_c` in
/// `x_s, v_s, x_m', v_m'`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CouplingMatrix {
    /// Coefficients of `F_m`.
    pub master: [f64; 5],
    /// Coefficients of `F_c`.
    pub slave: [f64; 4],
}

/// Return the coefficients of a linear coupling, by its halves. None for position-force, whose slave commands a motion.
pub fn coupling_matrix(kind: CouplingKind, gains: Gains) -> Option<CouplingMatrix> {
    let mut half = Half::<1>::new(kind, gains, Space::Translation).filter(|_| kind.is_linear())?;
    let axes = Axes::<1>::new;
    let one = |index: usize, at: usize| axes(f64::from(u8::from(index == at)));
    let inputs = |at: usize| [0, 1, 2, 3, 4].map(|index| one(index, at));
    let zero = Axes::zeros();
    let mut step = |at: usize, is_master: bool| {
        let [position, velocity, peer_position, peer_velocity, vector] = inputs(at);
        let own = Local {
            position: &position,
            velocity: &velocity,
            moved: &zero,
            exerted: &zero,
            force: &zero,
            gain: 1.0,
            dt: 1e-3,
        };
        let peer = Peer {
            position: &peer_position,
            velocity: &peer_velocity,
            force: &zero,
            vector: &vector,
            sum: 0.0,
            is_new: true,
            rests: false,
        };
        if is_master { half.master(&own, &peer)[0] } else { half.slave(&own, &peer)[0] }
    };
    let master = [0, 1, 2, 3, 4].map(|at| step(at, true));
    let slave = [0, 1, 2, 3].map(|at| step(at, false));
    Some(CouplingMatrix { master, slave })
}

/// Return `K (to - from) + B g (to' - from')`.
fn spring_damper<const N: usize>(gains: &Gains, from: &Local<'_, N>, to: &Peer<'_, N>) -> Axes<N> {
    (to.position - from.position) * gains.stiffness
        + (to.velocity - from.velocity) * (gains.damping * from.gain)
}
