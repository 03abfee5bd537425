//! Replay of a recorded side of a hand under other settings.

use haptether_bridge::scene::{HandImpedance, RecordedColumns, ReplayedColumn, replay_columns};
use pyo3::{prelude::*, types::PyDict};

use crate::{
    arrays::{SignalArray, column},
    axes::refuse,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(replay_recording, module)?)
}

#[documented]
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
    let mut recorded = RecordedColumns { times_ns, ..RecordedColumns::default() };
    for (name, values) in signals {
        let values = values.extract::<SignalArray<'_>>()?;
        recorded.signals.insert(name.extract()?, values.array().as_array().iter().copied().collect());
    }
    let columns = py.detach(|| replay_columns(scene_json, &recorded, recouples, hand)).map_err(refuse)?;
    let table = PyDict::new(py);
    for (name, values) in columns {
        let values = match values {
            ReplayedColumn::Vectors(width, flat) => {
                let ticks = flat.len() / width;
                column(py, flat).call_method1(py, "reshape", (ticks, width))?
            }
            ReplayedColumn::Numbers(numbers) => column(py, numbers),
            ReplayedColumn::Bits(bits) => column::<u8>(py, bits),
        };
        table.set_item(name, values)?;
    }
    Ok(table.unbind())
}
