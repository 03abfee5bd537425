//! Records of a bridge run as arrays.

use std::collections::BTreeMap;

use haptether_bridge::{
    Column, LinkStatistics, PathReport, Trace,
    live::{Granted, LoopReport},
    recorder::RecordingReport,
};
use numpy::{PyArrayMethods, ToPyArray};
use pyo3::prelude::*;

use crate::arrays::column;

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<MasterTrace>()?;
    module.add_class::<SlaveTrace>()?;
    module.add_class::<PyLinkStatistics>()?;
    module.add_class::<PyPathReport>()?;
    module.add_class::<PyLoopReport>()?;
    module.add_class::<PyRecordingReport>()?;
    Ok(())
}

fn seconds(ns: u64) -> f64 {
    if ns == u64::MAX { f64::INFINITY } else { ns as f64 * 1e-9 }
}

/// Convert a column to an array, of shape `(n_ticks,)` for one axis, else `(n_ticks, axes)`; none if there
/// is no such column.
fn array(py: Python<'_>, trace: &Trace, name: &str) -> PyResult<Option<Py<PyAny>>> {
    let Some(values) = trace.column(name) else { return Ok(None) };
    Ok(Some(match values {
        Column::Vectors(1, flat) | Column::Numbers(flat) => flat.to_pyarray(py).into_any().unbind(),
        Column::Vectors(width, flat) => {
            flat.to_pyarray(py).reshape([trace.ticks(), *width])?.into_any().unbind()
        }
        // The only column of counts holds codes of faults.
        #[allow(clippy::cast_possible_truncation)]
        Column::Counts(counts) => column::<u8>(py, counts.iter().map(|count| *count as u8).collect()),
        Column::Codes(codes) => codes.to_pyarray(py).into_any().unbind(),
    }))
}

/// Convert a column of times in s; infinite before the first frame of the peer.
fn times(py: Python<'_>, trace: &Trace, name: &str) -> Py<PyAny> {
    let Some(Column::Numbers(values)) = trace.column(name) else { return column::<f64>(py, Vec::new()) };
    column(py, values.iter().map(|value| if value.is_nan() { f64::INFINITY } else { *value }).collect())
}

/// Declares the class of a trace with a getter per column.
macro_rules! trace_class {
    ($class:ident, [$($name:ident),* $(,)?]) => {
        #[documented]
        #[pyclass(module = "haptether.bridge", frozen)]
        pub(crate) struct $class {
            pub(crate) trace: Trace,
        }

        #[documented]
        #[pymethods]
        impl $class {
            #[getter]
            fn time_s(&self, py: Python<'_>) -> Py<PyAny> {
                let Some(Column::Counts(times)) = self.trace.column("time_ns") else {
                    return column::<f64>(py, Vec::new());
                };
                column(py, times.iter().copied().map(seconds).collect())
            }

            #[getter]
            fn age_s(&self, py: Python<'_>) -> Py<PyAny> {
                times(py, &self.trace, "age_s")
            }

            #[getter]
            fn round_trip_s(&self, py: Python<'_>) -> Py<PyAny> {
                times(py, &self.trace, "round_trip_s")
            }

            $(#[getter]
            fn $name(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
                array(py, &self.trace, stringify!($name))
            })*

            fn __len__(&self) -> usize {
                self.trace.ticks()
            }
        }
    };
}

trace_class! {
    MasterTrace,
    [
        position, velocity, hand_force, rendered_force, grasp_force, safety_force, device_force, trigger,
        velocity_force, grasp, windowed_energy_j, tripped, acted, state, reason, clutch, overshoot_s, fault,
        orientation, angular_velocity, hand_torque, rendered_torque, grasp_torque, safety_torque,
        device_torque, trigger_velocity, trigger_rendered_force, trigger_safety_force, trigger_device_force,
        trigger_tripped,
    ]
}

trace_class! {
    SlaveTrace,
    [
        position, command, environment_force, exerted_force, gripper, gripper_command, gripper_force, holds_object,
        limited, state, reason, clutch, overshoot_s, fault, orientation, command_orientation,
        environment_torque,
    ]
}

#[documented]
#[pyclass(name = "LinkStatistics", module = "haptether.bridge", frozen, get_all)]
#[derive(Clone, Copy)]
pub(crate) struct PyLinkStatistics {
    sent: u64,
    fresh: u64,
    late: u64,
    duplicate: u64,
    refused: u64,
    missing: u64,
    round_trip_s: f64,
    least_round_trip_s: f64,
    play_out_s: f64,
    coupling: &'static str,
}

impl From<LinkStatistics> for PyLinkStatistics {
    fn from(of: LinkStatistics) -> Self {
        Self {
            sent: of.sent,
            fresh: of.fresh,
            late: of.late,
            duplicate: of.duplicate,
            refused: of.refused,
            missing: of.missing,
            round_trip_s: seconds(of.round_trip_ns),
            least_round_trip_s: seconds(of.min_round_trip_ns),
            play_out_s: seconds(of.play_out_ns),
            coupling: of.coupling.name(),
        }
    }
}

#[documented]
#[pyclass(name = "PathReport", module = "haptether.bridge", frozen, get_all)]
#[derive(Clone)]
pub(crate) struct PyPathReport {
    expected: u64,
    received: u64,
    lost: u64,
    loss: f64,
    bursts: u64,
    mean_burst: f64,
    longest_burst: u64,
    reordered: u64,
    mean_extent: f64,
    longest_extent: u64,
    duplicate: u64,
    too_late: u64,
    jitter_s: f64,
    rate_hz: f64,
    worst_gap_s: f64,
    usual_age_s: Option<f64>,
    offset_s: Option<f64>,
    offset_bound_s: Option<f64>,
    clock_steps: u64,
    clock_faults: u64,
    last_clock_fault: Option<String>,
}

impl From<PathReport> for PyPathReport {
    fn from(of: PathReport) -> Self {
        let statistics = &of.statistics;
        let (losses, reordering) = (&statistics.losses, &statistics.reordering);
        Self {
            expected: statistics.expected,
            received: statistics.received,
            lost: losses.lost,
            loss: statistics.loss(),
            bursts: losses.bursts,
            mean_burst: losses.mean(),
            longest_burst: losses.longest,
            reordered: reordering.reordered,
            mean_extent: reordering.mean_extent(),
            longest_extent: reordering.longest_extent,
            duplicate: statistics.duplicate,
            too_late: statistics.too_late,
            jitter_s: seconds(statistics.jitter_ns),
            rate_hz: statistics.rate_hz,
            worst_gap_s: seconds(statistics.worst_gap_ns),
            usual_age_s: of.baseline_age_ns.map(seconds),
            offset_s: of.offset.map(|offset| offset.offset_ns as f64 * 1e-9),
            offset_bound_s: of.offset.map(|offset| seconds(offset.bound_ns)),
            clock_steps: of.steps,
            clock_faults: of.clock_faults,
            last_clock_fault: of.last_fault.map(|fault| fault.to_string()),
        }
    }
}

#[documented]
#[pyclass(name = "RecordingReport", module = "haptether.bridge", frozen, get_all)]
#[derive(Clone)]
pub(crate) struct PyRecordingReport {
    written: u64,
    dropped: u64,
    end: Option<String>,
}

impl From<RecordingReport> for PyRecordingReport {
    fn from(of: RecordingReport) -> Self {
        Self { written: of.written, dropped: of.dropped, end: of.end.map(|end| end.to_string()) }
    }
}

#[documented]
#[pyclass(name = "LoopReport", module = "haptether.bridge", frozen, get_all)]
pub(crate) struct PyLoopReport {
    ticks: u64,
    skipped: u64,
    dropped_records: u64,
    unsent: u64,
    link: PyLinkStatistics,
    path: PyPathReport,
    holds: u64,
    limited: u64,
    outliers: u64,
    renewal: Option<f64>,
    secure: bool,
    rejections: BTreeMap<String, u64>,
    engaged_s: f64,
    realtime: String,
    is_realtime: bool,
    recording: Option<PyRecordingReport>,
    out_of_memory: bool,
}

/// Cause of a rejection that the session does not see.
const ELSEWHERE: &str = "datagram from another address than the peer's";

impl From<LoopReport> for PyLoopReport {
    fn from(of: LoopReport) -> Self {
        Self {
            ticks: of.ticks,
            skipped: of.skipped,
            dropped_records: of.dropped_records,
            unsent: of.unsent,
            link: of.link.into(),
            path: of.path.into(),
            holds: of.holds,
            limited: of.limited,
            outliers: of.outliers,
            renewal: of.renewal,
            secure: of.secure,
            rejections: of
                .rejections
                .iter()
                .map(|(cause, count)| (cause.to_string(), count))
                .chain([(ELSEWHERE.to_owned(), of.elsewhere)])
                .filter(|(_, count)| *count > 0)
                .collect(),
            engaged_s: seconds(of.engaged_ns),
            realtime: of.realtime.to_string(),
            is_realtime: matches!(of.realtime.fifo, Granted::Yes(_)),
            recording: of.recording.map(Into::into),
            out_of_memory: of.out_of_memory,
        }
    }
}
