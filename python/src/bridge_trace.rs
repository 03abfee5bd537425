//! What a run of the bridge leaves behind, as arrays.

use std::collections::BTreeMap;

use haptether_bridge::{
    LinkStatistics, MasterRecord, PathReport, SlaveRecord,
    live::{Granted, LoopReport},
    recorder::RecordingReport,
};
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

/// Ticks of the master.
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct MasterTrace {
    pub(crate) records: Vec<MasterRecord<1>>,
}

/// Ticks of the slave.
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SlaveTrace {
    pub(crate) records: Vec<SlaveRecord<1>>,
}

/// Getters that give one array per signal.
macro_rules! columns {
    ($class:ident, $record:ident, { $($name:ident => $value:expr),* $(,)? }) => {
        #[pymethods]
        impl $class {
            $(#[getter]
            fn $name(&self, py: Python<'_>) -> Py<PyAny> {
                column(py, self.records.iter().map(|$record| $value).collect())
            })*

            fn __len__(&self) -> usize {
                self.records.len()
            }
        }
    };
}

columns!(MasterTrace, record, {
    time_s => seconds(record.time_ns),
    position => record.position[0],
    velocity => record.velocity[0],
    hand_force => record.hand_force[0],
    rendered_force => record.rendered_force[0],
    grasp_force => record.grasp_force[0],
    safety_force => record.safety_force[0],
    device_force => record.device_force[0],
    velocity_force => record.observers[0],
    grasp => record.observers[1],
    windowed_energy_j => record.observers[2],
    tripped => record.tripped,
    acted => record.acted,
    state => record.state.code(),
    reason => record.reason,
    clutch => u8::from(record.clutch),
    age_s => seconds(record.age_ns),
    round_trip_s => seconds(record.round_trip_ns),
    overshoot_s => seconds(record.overshoot_ns),
    fault => record.fault,
});

columns!(SlaveTrace, record, {
    time_s => seconds(record.time_ns),
    position => record.position[0],
    command => record.command[0],
    environment_force => record.environment_force[0],
    limited => record.limited,
    state => record.state.code(),
    reason => record.reason,
    clutch => u8::from(record.clutch),
    age_s => seconds(record.age_ns),
    round_trip_s => seconds(record.round_trip_ns),
    overshoot_s => seconds(record.overshoot_ns),
    fault => record.fault,
});

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
            least_round_trip_s: seconds(of.least_round_trip_ns),
        }
    }
}

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
    expected_age_s: Option<f64>,
    usual_age_s: Option<f64>,
    offset_s: Option<f64>,
    offset_bound_s: Option<f64>,
    drift_ppm: Option<f64>,
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
            expected_age_s: of.expected_age_ns.map(seconds),
            usual_age_s: of.usual_age_ns.map(seconds),
            offset_s: of.offset.map(|offset| offset.offset_ns as f64 * 1e-9),
            offset_bound_s: of.offset.map(|offset| seconds(offset.bound_ns)),
            drift_ppm: of.drift_ppb.map(|ppb| ppb as f64 * 1e-3),
            clock_steps: of.steps,
            clock_faults: of.clock_faults,
            last_clock_fault: of.last_fault.map(|fault| fault.to_string()),
        }
    }
}

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
    secure: bool,
    rejections: BTreeMap<String, u64>,
    engaged_s: f64,
    realtime: String,
    is_realtime: bool,
    recording: Option<PyRecordingReport>,
}

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
            secure: of.secure,
            rejections: of
                .rejections
                .iter()
                .filter(|(_, count)| *count > 0)
                .map(|(cause, count)| (cause.to_string(), count))
                .collect(),
            engaged_s: seconds(of.engaged_ns),
            realtime: of.realtime.to_string(),
            is_realtime: matches!(of.realtime.fifo, Granted::Yes(_)),
            recording: of.recording.map(Into::into),
        }
    }
}
