//! A recorded side of a hand under other settings.

use haptether_bridge::{
    HandInput, MasterReading, Past,
    scene::{HandImpedance, RecordedTick, Replay, ReplayedTick},
};
use haptether_safety::{Axes, Fault, controller::ControllerKind};
use pyo3::{exceptions::PyValueError, prelude::*, types::PyDict};

use crate::{
    arrays::{SignalArray, column},
    axes::{of_axes, refuse},
    scene::{scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(replay_recording, module)?)
}

/// Rows of numbers, all of one length.
struct Rows {
    values: Vec<f64>,
    width: usize,
}

impl Rows {
    fn axes<const N: usize>(&self, row: usize) -> Axes<N> {
        Axes::from_column_slice(&self.values[row * self.width..(row + 1) * self.width])
    }
}

/// What was recorded, signal by signal.
struct Recorded<'a, 'py> {
    signals: &'a Bound<'py, PyDict>,
    ticks: usize,
}

impl Recorded<'_, '_> {
    /// A signal of `width` numbers a tick; none where it is not there.
    fn rows(&self, name: &str, width: usize) -> PyResult<Option<Rows>> {
        let Some(values) = self.signals.get_item(name)? else { return Ok(None) };
        let array = values.extract::<SignalArray<'_>>()?;
        let values: Vec<f64> = array.array().as_array().iter().copied().collect();
        if values.len() != self.ticks * width {
            let (seen, ticks) = (values.len(), self.ticks);
            return Err(PyValueError::new_err(format!(
                "{name}: {seen} numbers, must be {width} for each of {ticks} ticks"
            )));
        }
        Ok(Some(Rows { values, width }))
    }

    fn needed(&self, name: &str, width: usize) -> PyResult<Rows> {
        self.rows(name, width)?.ok_or_else(|| PyValueError::new_err(format!("{name}: was not recorded")))
    }
}

fn is_known(rows: &Rows) -> bool {
    rows.values.iter().any(|value| value.is_finite())
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // counts that were written as such; it saturates
fn count(rows: &Rows, row: usize) -> u64 {
    rows.values[row] as u64
}

fn ticks<const N: usize>(recorded: &Recorded<'_, '_>, times: &[u64]) -> PyResult<Vec<RecordedTick<N>>> {
    let needed = |name| recorded.needed(name, N);
    let position = needed("position")?;
    let velocity = recorded.rows("measured_velocity", N)?.filter(is_known);
    let [received, requested, device_force] =
        [needed("received_force")?, needed("requested_force")?, needed("device_force")?];
    let one = |name| recorded.needed(name, 1);
    let [gain, missed, past, fault, grip] =
        [one("gain")?, one("missed")?, one("past")?, one("given_fault")?, one("grip")?];
    let orientation = recorded.rows("orientation", 4)?;
    let turning = orientation
        .map(|orientation| -> PyResult<_> {
            let rate = recorded.rows("measured_angular_velocity", 3)?.filter(is_known);
            Ok((
                orientation,
                rate,
                recorded.needed("received_torque", 3)?,
                recorded.needed("requested_torque", 3)?,
            ))
        })
        .transpose()?;
    let mut ticks = Vec::with_capacity(times.len());
    for (row, &time_ns) in times.iter().enumerate() {
        // A loop that leaves out more has stalled, and takes nothing over.
        if count(&missed, row) > MAX_MISSED {
            let text = format!("missed = {}: must be at most {MAX_MISSED}", missed.values[row]);
            return Err(PyValueError::new_err(text));
        }
        let mut reading =
            MasterReading::point(position.axes(row), velocity.as_ref().map(|rows| rows.axes(row)));
        let mut input = HandInput {
            received_force: received.axes(row),
            requested_force: requested.axes(row),
            gain: gain.values[row],
            missed: count(&missed, row),
            past: match count(&past, row) {
                0 => Past::Kept,
                1 => Past::Stalled,
                _ => Past::Acknowledged,
            },
            fault: u8::try_from(count(&fault, row)).ok().and_then(Fault::from_code),
            ..HandInput::idle()
        };
        if let Some((orientation, rate, received, requested)) = &turning {
            let rate = rate.as_ref().map(|rows| rows.axes(row));
            let norm = orientation.axes::<4>(row).norm();
            if (norm - 1.0).abs() > MAX_NORM_ERROR {
                let text = format!("orientation: a norm of {norm} at row {row}, must be 1");
                return Err(PyValueError::new_err(text));
            }
            reading = reading.turned(orientation.axes::<4>(row).into(), rate);
            (input.received_torque, input.requested_torque) = (received.axes(row), requested.axes(row));
        }
        let (device_force, grip) = (device_force.axes(row), grip.values[row]);
        ticks.push(RecordedTick { time_ns, reading, input, device_force, grip });
    }
    Ok(ticks)
}

fn rows_out<const W: usize>(py: Python<'_>, rows: impl Iterator<Item = Axes<W>>) -> PyResult<Py<PyAny>> {
    let flat: Vec<f64> = rows.flat_map(<[f64; W]>::from).collect();
    let ticks = flat.len() / W;
    column(py, flat).call_method1(py, "reshape", (ticks, W))
}

/// Ticks that may be left out between two.
const MAX_MISSED: u64 = 10_000;
/// How far a recorded quaternion may be from the length of 1.
const MAX_NORM_ERROR: f64 = 1e-6;

/// A signal of a replayed tick.
type Signal<const N: usize> = fn(&ReplayedTick<N>) -> Axes<N>;

fn out<const N: usize>(py: Python<'_>, done: &[ReplayedTick<N>]) -> PyResult<Py<PyDict>> {
    let table = PyDict::new(py);
    let vectors: [(&str, Signal<N>); 7] = [
        ("velocity", |tick| tick.safety.motion.velocity),
        ("rendered_force", |tick| tick.safety.rendered_force),
        ("grasp_force", |tick| tick.safety.grasp_force),
        ("safety_force", |tick| tick.safety.intervention.safety_force),
        ("device_force", |tick| tick.safety.device_force),
        ("displacement", |tick| tick.displacement),
        ("displacement_rate", |tick| tick.displacement_rate),
    ];
    for (name, of) in vectors {
        table.set_item(name, rows_out(py, done.iter().map(of))?)?;
    }
    let bits = |of: fn(&ReplayedTick<N>) -> u8| column::<u8>(py, done.iter().map(of).collect());
    table.set_item("tripped", bits(|tick| tick.safety.intervention.tripped.bits()))?;
    table.set_item("acted", bits(|tick| tick.safety.acted.bits()))?;
    table.set_item("fault", bits(|tick| tick.safety.fault.map_or(0, Fault::code)))?;
    for kind in ControllerKind::ALL {
        let observed = done.iter().map(|tick| tick.safety.intervention.observed[kind]).collect::<Vec<f64>>();
        table.set_item(kind.observed().column, column(py, observed))?;
    }
    let turns: Option<Vec<_>> = done.iter().map(|tick| tick.rotation).collect();
    if let Some(turns) = turns.filter(|turns| !turns.is_empty()) {
        table.set_item("rendered_torque", rows_out(py, turns.iter().map(|turn| turn.rendered_force))?)?;
        table.set_item("grasp_torque", rows_out(py, turns.iter().map(|turn| turn.grasp_force))?)?;
        table.set_item(
            "safety_torque",
            rows_out(py, turns.iter().map(|turn| turn.intervention.safety_force))?,
        )?;
        table.set_item("device_torque", rows_out(py, turns.iter().map(|turn| turn.device_force))?)?;
        let tripped = turns.iter().map(|turn| turn.intervention.tripped.bits()).collect();
        table.set_item("rotation_tripped", column::<u8>(py, tripped))?;
    }
    Ok(table.unbind())
}

/// Steps the side of a hand through what was recorded of it.
#[pyfunction]
#[pyo3(signature = (scene_json, signals, times_ns, *, recouples, hand=None))]
fn replay_recording(
    py: Python<'_>,
    scene_json: &[u8],
    signals: &Bound<'_, PyDict>,
    times_ns: Vec<u64>,
    recouples: bool,
    hand: Option<(f64, f64, f64)>,
) -> PyResult<Py<PyDict>> {
    let hand = hand.map(|(mass_kg, damping, stiffness)| HandImpedance { mass_kg, damping, stiffness });
    let recorded = Recorded { signals, ticks: times_ns.len() };
    of_axes!(scene_axes(scene_json)?, N => {
        let mut replay = Replay::<N>::new(&scene_spec::<N>(scene_json)?, recouples, hand).map_err(refuse)?;
        let ticks = ticks::<N>(&recorded, &times_ns)?;
        let done: Vec<_> = py.detach(|| ticks.iter().map(|tick| replay.step(tick)).collect());
        out(py, &done)
    })
}
