//! The records of a run of the bridge, as arrays.

use std::collections::BTreeMap;

use haptether_bridge::{
    Feeling, FingerTick, LinkStatistics, MasterRecord, MasterRotation, PathReport, SlaveRecord,
    SlaveRotation,
    live::{Granted, LoopReport},
    recorder::{Recorded, RecordingReport},
};
use haptether_safety::{Axes, controller::ControllerKind};
use numpy::{IntoPyArray, PyArrayMethods};
use pyo3::prelude::*;

use crate::{
    arrays::column,
    axes::{per_axes, with_axes},
};

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

type MasterRecords<const N: usize> = Vec<MasterRecord<N>>;
type FeelingRecords<const N: usize> = Vec<MasterRecord<N, Feeling<()>>>;
type SlaveRecords<const N: usize> = Vec<SlaveRecord<N>>;

per_axes!(
    /// Ticks of a master.
    MasterTicks,
    MasterRecords
);
per_axes!(
    /// Ticks of a master whose finger feels its trigger.
    FeelingTicks,
    FeelingRecords
);
per_axes!(
    /// Ticks of a slave.
    SlaveTicks,
    SlaveRecords
);

/// Ticks of a master: of points along any number of axes or of poses, and either with a trigger that the finger feels.
#[derive(Clone)]
pub(crate) enum MasterRows {
    Points(MasterTicks),
    Poses(Vec<MasterRecord<3, MasterRotation>>),
    FeelingPoints(FeelingTicks),
    FeelingPoses(Vec<MasterRecord<3, Feeling<MasterRotation>>>),
}

/// Ticks of a slave: of points along any number of axes, or of poses.
#[derive(Clone)]
pub(crate) enum SlaveRows {
    Points(SlaveTicks),
    Poses(Vec<SlaveRecord<3, SlaveRotation>>),
}

/// A record of which there are many, of a known number of axes.
pub(crate) trait Rowed: Recorded {
    /// The same of any number of axes.
    type Rows;

    /// Takes them together.
    fn rows(records: Vec<Self>) -> Self::Rows;
}

macro_rules! rowed {
    ($($variant:ident $n:literal),*) => {
        $(impl Rowed for MasterRecord<$n> {
            type Rows = MasterRows;

            fn rows(records: Vec<Self>) -> MasterRows {
                MasterRows::Points(MasterTicks::$variant(records))
            }
        }

        impl Rowed for MasterRecord<$n, Feeling<()>> {
            type Rows = MasterRows;

            fn rows(records: Vec<Self>) -> MasterRows {
                MasterRows::FeelingPoints(FeelingTicks::$variant(records))
            }
        }

        impl Rowed for SlaveRecord<$n> {
            type Rows = SlaveRows;

            fn rows(records: Vec<Self>) -> SlaveRows {
                SlaveRows::Points(SlaveTicks::$variant(records))
            }
        })*
    };
}

rowed!(One 1, Two 2, Three 3, Four 4, Five 5, Six 6, Seven 7);

impl Rowed for MasterRecord<3, MasterRotation> {
    type Rows = MasterRows;

    fn rows(records: Vec<Self>) -> MasterRows {
        MasterRows::Poses(records)
    }
}

impl Rowed for MasterRecord<3, Feeling<MasterRotation>> {
    type Rows = MasterRows;

    fn rows(records: Vec<Self>) -> MasterRows {
        MasterRows::FeelingPoses(records)
    }
}

impl Rowed for SlaveRecord<3, SlaveRotation> {
    type Rows = SlaveRows;

    fn rows(records: Vec<Self>) -> SlaveRows {
        SlaveRows::Poses(records)
    }
}

/// Ticks of the master.
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct MasterTrace {
    pub(crate) rows: MasterRows,
}

/// Ticks of the slave.
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SlaveTrace {
    pub(crate) rows: SlaveRows,
}

/// Vectors over ticks: of shape `(n_ticks,)` for one axis, else `(n_ticks, axes)`.
fn vectors<const N: usize>(py: Python<'_>, values: impl Iterator<Item = Axes<N>>) -> PyResult<Py<PyAny>> {
    let flat: Vec<f64> = values.flat_map(|value| value.data.0[0]).collect();
    if N == 1 {
        return Ok(column(py, flat));
    }
    let ticks = flat.len() / N;
    Ok(flat.into_pyarray(py).reshape([ticks, N])?.into_any().unbind())
}

/// Runs an expression on the records of all kinds of rows of a master.
macro_rules! of_master {
    ($rows:expr, $records:ident => $body:expr) => {
        match $rows {
            MasterRows::Points(ticks) => with_axes!(ticks, MasterTicks, $records => $body),
            MasterRows::Poses($records) => $body,
            MasterRows::FeelingPoints(ticks) => with_axes!(ticks, FeelingTicks, $records => $body),
            MasterRows::FeelingPoses($records) => $body,
        }
    };
}

/// The same of a slave.
macro_rules! of_slave {
    ($rows:expr, $records:ident => $body:expr) => {
        match $rows {
            SlaveRows::Points(ticks) => with_axes!(ticks, SlaveTicks, $records => $body),
            SlaveRows::Poses($records) => $body,
        }
    };
}

impl MasterTrace {
    /// The rotation of each tick, of a side that turns.
    fn turns(&self) -> Option<Vec<&MasterRotation>> {
        match &self.rows {
            MasterRows::Poses(records) => Some(records.iter().map(|record| &record.rotation).collect()),
            MasterRows::FeelingPoses(records) => {
                Some(records.iter().map(|record| &record.rotation.turn).collect())
            }
            MasterRows::Points(_) | MasterRows::FeelingPoints(_) => None,
        }
    }

    /// What the finger felt at each tick, of a trigger that is felt.
    fn fingers(&self) -> Option<Vec<&FingerTick>> {
        match &self.rows {
            MasterRows::FeelingPoints(ticks) => with_axes!(ticks, FeelingTicks, records => {
                Some(records.iter().map(|record| &record.rotation.finger).collect())
            }),
            MasterRows::FeelingPoses(records) => {
                Some(records.iter().map(|record| &record.rotation.finger).collect())
            }
            MasterRows::Points(_) | MasterRows::Poses(_) => None,
        }
    }
}

impl SlaveTrace {
    /// The rotation of each tick, of a side that turns.
    fn turns(&self) -> Option<Vec<&SlaveRotation>> {
        match &self.rows {
            SlaveRows::Poses(records) => Some(records.iter().map(|record| &record.rotation).collect()),
            SlaveRows::Points(_) => None,
        }
    }
}

/// Getters that return one array per signal.
macro_rules! columns {
    ($class:ident, $of_rows:ident, $record:ident,
        { $($name:ident => $value:expr),* $(,)? }, { $($vector:ident),* $(,)? }) => {
        #[pymethods]
        impl $class {
            $(#[getter]
            fn $name(&self, py: Python<'_>) -> Py<PyAny> {
                $of_rows!(&self.rows, records => {
                    column(py, records.iter().map(|$record| $value).collect())
                })
            })*

            $(#[getter]
            fn $vector(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
                $of_rows!(&self.rows, records => {
                    vectors(py, records.iter().map(|record| record.$vector))
                })
            })*

            fn __len__(&self) -> usize {
                $of_rows!(&self.rows, records => records.len())
            }
        }
    };
}

columns!(MasterTrace, of_master, record, {
    time_s => seconds(record.time_ns),
    trigger => record.trigger,
    velocity_force => record.observers[ControllerKind::Vfc],
    grasp => record.observers[ControllerKind::Hsc],
    windowed_energy_j => record.observers[ControllerKind::Wsc],
    tripped => record.tripped,
    acted => record.acted,
    state => record.state.code(),
    reason => record.reason,
    clutch => u8::from(record.clutch),
    age_s => seconds(record.age_ns),
    round_trip_s => seconds(record.round_trip_ns),
    overshoot_s => seconds(record.overshoot_ns),
    fault => record.fault,
}, { position, velocity, hand_force, rendered_force, grasp_force, safety_force, device_force });

columns!(SlaveTrace, of_slave, record, {
    time_s => seconds(record.time_ns),
    gripper => record.gripper,
    gripper_command => record.gripper_command,
    gripper_force => record.gripper_force,
    holds_object => u8::from(record.holds_object),
    limited => record.limited,
    state => record.state.code(),
    reason => record.reason,
    clutch => u8::from(record.clutch),
    age_s => seconds(record.age_ns),
    round_trip_s => seconds(record.round_trip_ns),
    overshoot_s => seconds(record.overshoot_ns),
    fault => record.fault,
}, { position, command, environment_force });

/// Getters that return one array per signal of a rotation, none of a point.
macro_rules! rotation_columns {
    ($class:ident, { $($quaternion:ident),* }, { $($vector:ident),* }) => {
        #[pymethods]
        impl $class {
            $(#[getter]
            fn $quaternion(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
                let Some(turns) = self.turns() else { return Ok(None) };
                vectors(py, turns.iter().map(|turn| Axes::<4>::from(turn.$quaternion))).map(Some)
            })*

            $(#[getter]
            fn $vector(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
                let Some(turns) = self.turns() else { return Ok(None) };
                vectors(py, turns.iter().map(|turn| turn.$vector)).map(Some)
            })*
        }
    };
}

rotation_columns!(MasterTrace, { orientation }, {
    angular_velocity, hand_torque, rendered_torque, grasp_torque, safety_torque, device_torque
});
rotation_columns!(SlaveTrace, { orientation, command_orientation }, { environment_torque });

/// Getters that return one array per signal of a trigger that is felt, else none.
macro_rules! finger_columns {
    ($($name:ident => $field:ident),*) => {
        #[pymethods]
        impl MasterTrace {
            $(#[getter]
            fn $name(&self, py: Python<'_>) -> Option<Py<PyAny>> {
                let fingers = self.fingers()?;
                Some(column(py, fingers.iter().map(|finger| finger.$field).collect()))
            })*
        }
    };
}

finger_columns!(
    trigger_velocity => velocity,
    trigger_rendered_force => rendered_force,
    trigger_safety_force => safety_force,
    trigger_device_force => device_force,
    trigger_tripped => tripped
);

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
            least_round_trip_s: seconds(of.min_round_trip_ns),
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
    out_of_memory: bool,
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
            out_of_memory: of.out_of_memory,
        }
    }
}
