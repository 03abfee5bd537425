//! Recorded and replayed ticks as columns of numbers, for any number of axes.

use std::collections::HashMap;

use haptether_numeric::of_axes;
use haptether_safety::{Axes, Fault, controller::ControllerKind};

use super::{HandImpedance, RecordedTick, Replay, ReplayedTick};
use crate::{
    endpoint::{CarriedState, HandInput, MasterReading},
    scene::{
        assemble::{SceneError, bad_axes},
        outline::{scene_outline, scene_spec},
    },
};

/// Largest number of ticks left out between two recorded ticks.
const MAX_MISSED: u64 = 10_000;
/// Largest distance of a recorded quaternion's norm from 1.
const MAX_NORM_ERROR: f64 = 1e-6;

/// Error of a recording or scene that cannot be replayed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReplayError {
    /// The scene is invalid.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A signal is missing.
    #[error("{0}: was not recorded")]
    Missing(&'static str),
    /// A signal has another length.
    #[error("{name}: {seen} numbers, must be {width} for each of {ticks} ticks")]
    Length {
        /// Name of the signal.
        name: &'static str,
        /// Number of its values.
        seen: usize,
        /// Values per tick.
        width: usize,
        /// Number of ticks.
        ticks: usize,
    },
    /// More ticks were left out than allowed.
    #[error("missed = {0}: must be at most {MAX_MISSED}")]
    Missed(f64),
    /// A quaternion is not a unit quaternion.
    #[error("orientation: a norm of {norm} at row {row}, must be 1")]
    Orientation {
        /// Norm of the quaternion.
        norm: f64,
        /// Row of the quaternion.
        row: usize,
    },
}

/// Recorded signals by name; each has all values of the first tick, then of the next.
#[derive(Clone, Debug, Default)]
pub struct RecordedColumns {
    /// Time of each tick in ns since the run began.
    pub times_ns: Vec<u64>,
    /// Signals by name.
    pub signals: HashMap<String, Vec<f64>>,
}

/// Values of one signal.
#[derive(Clone, Copy)]
struct Rows<'a> {
    values: &'a [f64],
    width: usize,
}

impl Rows<'_> {
    fn axes<const N: usize>(&self, row: usize) -> Axes<N> {
        Axes::from_column_slice(&self.values[row * self.width..(row + 1) * self.width])
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // recorded counts; the cast saturates
    fn count(&self, row: usize) -> u64 {
        self.values[row] as u64
    }

    fn is_known(&self) -> bool {
        self.values.iter().any(|value| value.is_finite())
    }
}

impl RecordedColumns {
    /// Return a signal of `width` values per tick; none if it was not recorded.
    fn rows(&self, name: &'static str, width: usize) -> Result<Option<Rows<'_>>, ReplayError> {
        let Some(values) = self.signals.get(name) else { return Ok(None) };
        let (seen, ticks) = (values.len(), self.times_ns.len());
        if seen != ticks * width {
            return Err(ReplayError::Length { name, seen, width, ticks });
        }
        Ok(Some(Rows { values, width }))
    }

    fn needed(&self, name: &'static str, width: usize) -> Result<Rows<'_>, ReplayError> {
        self.rows(name, width)?.ok_or(ReplayError::Missing(name))
    }

    fn ticks<const N: usize>(&self) -> Result<Vec<RecordedTick<N>>, ReplayError> {
        let needed = |name| self.needed(name, N);
        let position = needed("position")?;
        let velocity = self.rows("measured_velocity", N)?.filter(Rows::is_known);
        let [received, requested, device_force] =
            [needed("received_force")?, needed("requested_force")?, needed("device_force")?];
        let one = |name| self.needed(name, 1);
        let [gain, missed, past, fault, grip] =
            [one("gain")?, one("missed")?, one("past")?, one("given_fault")?, one("grip")?];
        let turning = match self.rows("orientation", 4)? {
            None => None,
            Some(orientation) => {
                let rate = self.rows("measured_angular_velocity", 3)?.filter(Rows::is_known);
                let torques = (self.needed("received_torque", 3)?, self.needed("requested_torque", 3)?);
                Some((orientation, rate, torques))
            }
        };
        let mut ticks = Vec::with_capacity(self.times_ns.len());
        for (row, &time_ns) in self.times_ns.iter().enumerate() {
            if missed.count(row) > MAX_MISSED {
                return Err(ReplayError::Missed(missed.values[row]));
            }
            let mut reading =
                MasterReading::point(position.axes(row), velocity.as_ref().map(|rows| rows.axes(row)));
            let mut input = HandInput {
                received_force: received.axes(row),
                requested_force: requested.axes(row),
                gain: gain.values[row],
                missed: missed.count(row),
                past: match past.count(row) {
                    0 => CarriedState::All,
                    1 => CarriedState::FaultOnly,
                    _ => CarriedState::Nothing,
                },
                fault: u8::try_from(fault.count(row)).ok().and_then(Fault::from_code),
                ..HandInput::idle()
            };
            if let Some((orientation, rate, (received, requested))) = &turning {
                let rate = rate.as_ref().map(|rows| rows.axes(row));
                let norm = orientation.axes::<4>(row).norm();
                if (norm - 1.0).abs() > MAX_NORM_ERROR {
                    return Err(ReplayError::Orientation { norm, row });
                }
                reading = reading.turned(orientation.axes::<4>(row).into(), rate);
                (input.received_torque, input.requested_torque) = (received.axes(row), requested.axes(row));
            }
            let (device_force, grip) = (device_force.axes(row), grip.values[row]);
            ticks.push(RecordedTick { time_ns, reading, input, device_force, grip });
        }
        Ok(ticks)
    }
}

/// Replayed signal.
#[derive(Clone, Debug, PartialEq)]
pub enum ReplayedColumn {
    /// Vectors with this number of values, tick by tick.
    Vectors(usize, Vec<f64>),
    /// Numbers.
    Numbers(Vec<f64>),
    /// Bits or codes.
    Bits(Vec<u8>),
}

/// Replayed signals by name.
pub type ReplayedColumns = Vec<(&'static str, ReplayedColumn)>;

fn vectors<const W: usize>(rows: impl Iterator<Item = Axes<W>>) -> ReplayedColumn {
    ReplayedColumn::Vectors(W, rows.flat_map(<[f64; W]>::from).collect())
}

/// Function that selects a signal of a replayed tick.
type Signal<const N: usize> = fn(&ReplayedTick<N>) -> Axes<N>;

fn columns<const N: usize>(done: &[ReplayedTick<N>]) -> ReplayedColumns {
    let signals: [(&str, Signal<N>); 7] = [
        ("velocity", |tick| tick.safety.motion.velocity),
        ("rendered_force", |tick| tick.safety.rendered_force),
        ("grasp_force", |tick| tick.safety.grasp_force),
        ("safety_force", |tick| tick.safety.intervention.safety_force),
        ("device_force", |tick| tick.safety.device_force),
        ("displacement", |tick| tick.displacement),
        ("displacement_rate", |tick| tick.displacement_rate),
    ];
    let mut columns: ReplayedColumns =
        signals.into_iter().map(|(name, of)| (name, vectors(done.iter().map(of)))).collect();
    let bits = |of: fn(&ReplayedTick<N>) -> u8| ReplayedColumn::Bits(done.iter().map(of).collect());
    columns.push(("tripped", bits(|tick| tick.safety.intervention.tripped.bits())));
    columns.push(("acted", bits(|tick| tick.safety.acted.bits())));
    columns.push(("fault", bits(|tick| tick.safety.fault.map_or(0, Fault::code))));
    for kind in ControllerKind::ALL {
        let observed = done.iter().map(|tick| tick.safety.intervention.observed[kind]).collect();
        columns.push((kind.observed().column, ReplayedColumn::Numbers(observed)));
    }
    let turns: Option<Vec<_>> = done.iter().map(|tick| tick.rotation).collect();
    if let Some(turns) = turns.filter(|turns| !turns.is_empty()) {
        columns.push(("rendered_torque", vectors(turns.iter().map(|turn| turn.rendered_force))));
        columns.push(("grasp_torque", vectors(turns.iter().map(|turn| turn.grasp_force))));
        columns.push(("safety_torque", vectors(turns.iter().map(|turn| turn.intervention.safety_force))));
        columns.push(("device_torque", vectors(turns.iter().map(|turn| turn.device_force))));
        let tripped = turns.iter().map(|turn| turn.intervention.tripped.bits()).collect();
        columns.push(("rotation_tripped", ReplayedColumn::Bits(tripped)));
    }
    columns
}

/// Step the master of a scene, given as JSON, through recorded ticks with a [`Replay`].
///
/// # Errors
///
/// The scene is invalid; or a signal is missing, has another length, or is invalid.
pub fn replay_columns(
    scene: &[u8],
    recorded: &RecordedColumns,
    recouples: bool,
    hand: Option<HandImpedance>,
) -> Result<ReplayedColumns, ReplayError> {
    of_axes!(
        scene_outline(scene)?.axes,
        N => {
            let mut replay = Replay::<N>::new(&scene_spec(scene)?, recouples, hand)?;
            let done: Vec<_> = recorded.ticks()?.iter().map(|tick| replay.step(tick)).collect();
            Ok(columns(&done))
        },
        axes => Err(bad_axes(axes).into())
    )
}
