//! Scenes: single runs and sweeps.

use std::{
    borrow::Cow,
    collections::HashMap,
    path::PathBuf,
    sync::{
        Arc,
        atomic::Ordering,
        mpsc::{self, RecvTimeoutError},
    },
    thread,
    time::Duration,
};

use haptether_bridge::scene::{
    Metric, Metrics, Outcome, Progress, RecordingFiles, Refused, ResearchFactory, SceneOutline, SceneRun,
    Signal, SweepPart, SweepSettings, Variation, scene_outline, simulate_recorded, sweep_parts,
};
use haptether_bridge::{SideKind, coupling::ROUND_TRIP_S, ladder::PRESS_NS};
use numpy::{PyArrayMethods, PyReadonlyArray1, ToPyArray};
use pyo3::{
    exceptions::PyValueError,
    prelude::*,
    pybacked::PyBackedBytes,
    types::{PyDict, PyList, PyTuple},
};

use crate::{
    arrays::column,
    axes::refuse,
    bridge::nanoseconds,
    bridge_trace::PyLoopReport,
    research::{PyObservation, PyResearch},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PySceneRun>()?;
    module.add_class::<PyObservation>()?;
    module.add("PRESS_S", PRESS_NS as f64 / 1e9)?;
    module.add("ROUND_TRIP_S", ROUND_TRIP_S)?;
    module.add("METRICS", PyTuple::new(module.py(), Metric::ALL.map(Metric::name))?)?;
    module.add_function(wrap_pyfunction!(simulate_scene, module)?)?;
    module.add_function(wrap_pyfunction!(sweep_scenes, module)?)
}

#[documented]
#[pyclass(name = "SceneRun", module = "haptether._core", frozen)]
pub(crate) struct PySceneRun {
    signals: Py<PyDict>,
    events: Py<PyList>,
    metrics: Py<PyDict>,
    reports: Option<[Py<PyLoopReport>; 2]>,
}

#[documented]
#[pymethods]
impl PySceneRun {
    #[getter]
    fn signals(&self, py: Python<'_>) -> Py<PyDict> {
        self.signals.clone_ref(py)
    }

    #[getter]
    fn events(&self, py: Python<'_>) -> Py<PyList> {
        self.events.clone_ref(py)
    }

    #[getter]
    fn metrics(&self, py: Python<'_>) -> Py<PyDict> {
        self.metrics.clone_ref(py)
    }

    #[getter]
    fn reports(&self, py: Python<'_>) -> Option<(Py<PyLoopReport>, Py<PyLoopReport>)> {
        self.reports.as_ref().map(|[master, slave]| (master.clone_ref(py), slave.clone_ref(py)))
    }
}

/// Signals with whole numbers: codes and masks.
const CODES: [&str; 4] = ["tripped", "rotation_tripped", "state", "slave_state"];

fn signal_out(py: Python<'_>, signal: &Signal) -> PyResult<Py<PyAny>> {
    if CODES.contains(&signal.name) {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // codes of one byte
        let codes = signal.values.iter().map(|value| *value as u8).collect();
        return Ok(column::<u8>(py, codes));
    }
    let flat = signal.values.to_pyarray(py);
    if signal.width == 1 {
        return Ok(flat.into_any().unbind());
    }
    Ok(flat.reshape([signal.values.len() / signal.width, signal.width])?.into_any().unbind())
}

fn metrics_out(py: Python<'_>, outcome: &Outcome, period_s: f64) -> PyResult<Py<PyDict>> {
    let metrics = PyDict::new(py);
    metrics.set_item("outcome", outcome.ending.name())?;
    metrics.set_item("max_ejection_velocity", outcome.max_ejection_velocity)?;
    metrics.set_item("peak_device_force", outcome.peak_device_force)?;
    metrics.set_item("time_to_trip_s", outcome.time_to_trip_s)?;
    metrics.set_item("false_trips", outcome.false_trips)?;
    metrics.set_item("intervention_s", outcome.intervention_ticks.map(|ticks| ticks as f64 * period_s))?;
    metrics.set_item("position_rmse_m", outcome.position_rmse_m)?;
    metrics.set_item("force_rmse_n", outcome.force_rmse_n)?;
    metrics.set_item("max_ejection_rate", outcome.max_ejection_rate)?;
    metrics.set_item("peak_device_torque", outcome.peak_device_torque)?;
    metrics.set_item("orientation_rmse_rad", outcome.orientation_rmse_rad)?;
    metrics.set_item("torque_rmse_n_m", outcome.torque_rmse_n_m)?;
    metrics.set_item("passivity_min_j", outcome.passivity_min_j)?;
    metrics.set_item("diverged", outcome.diverged.is_some())?;
    metrics.set_item("ticks", outcome.ticks)?;
    Ok(metrics.unbind())
}

/// Periods of master and slave in ns.
pub(crate) fn live_periods(scene: &SceneOutline) -> PyResult<[u64; 2]> {
    Ok([nanoseconds("run.period_s", scene.period_s)?, nanoseconds("slave.period_s", scene.slave_period_s)?])
}

#[documented]
#[pyfunction]
#[pyo3(signature = (scene_json, record=None, research=None))]
fn simulate_scene(
    py: Python<'_>,
    scene_json: &[u8],
    record: Option<(PathBuf, PathBuf)>,
    research: Option<Py<PyAny>>,
) -> PyResult<PySceneRun> {
    let scene = String::from_utf8_lossy(scene_json);
    let files = record.map(|(master, slave)| RecordingFiles { master, slave, scene: scene.into_owned() });
    let shared = Arc::new(Progress::default());
    let research = research.map(|factory| PyResearch::new(factory, &shared));
    let factory = research.as_ref().map(|factory| factory as &dyn ResearchFactory);
    let done = interruptibly(py, None, &shared, |progress| {
        attached(factory.is_some(), || simulate_recorded(scene_json, &progress.stop, files.as_ref(), factory))
    })?;
    research.as_ref().map_or(Ok(()), |factory| factory.finish(py))?;
    let SceneRun { signals, events, outcome, period_s, reports } = done.map_err(refuse)?;
    let by_name = PyDict::new(py);
    for signal in &signals {
        by_name.set_item(signal.name, signal_out(py, signal)?)?;
    }
    let reports = match reports {
        Some([master, slave]) => {
            Some([Py::new(py, PyLoopReport::from(master))?, Py::new(py, PyLoopReport::from(slave))?])
        }
        None => None,
    };
    let events = events.into_iter().map(|event| (event.time_s, event.kind, event.detail));
    Ok(PySceneRun {
        signals: by_name.unbind(),
        events: PyList::new(py, events.collect::<Vec<_>>())?.unbind(),
        metrics: metrics_out(py, &outcome, period_s)?,
        reports,
    })
}

/// Run `work`; if it `calls` Python at each tick, on a thread attached to Python. Creating a thread state
/// per call takes 40 us. Between calls the GIL is free.
fn attached<T: Send>(calls: bool, work: impl FnOnce() -> T + Send) -> T {
    if calls { Python::attach(|py| py.detach(work)) } else { work() }
}

/// Period at which signals and progress are checked.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Run `work` on its own thread, so that a signal ends it at once; calls `report` with the progress.
fn interruptibly<T: Send>(
    py: Python<'_>,
    report: Option<&Py<PyAny>>,
    progress: &Progress,
    work: impl FnOnce(&Progress) -> T + Send,
) -> PyResult<T> {
    let (finished, mut finishes) = mpsc::channel();
    thread::scope(|scope| {
        let worker = scope.spawn(|| {
            // The receiver exists: this function waits for the thread.
            let _ = finished.send(work(progress));
            drop(finished);
        });
        let mut reported = 0;
        let mut interrupted = None;
        loop {
            let waiting = &mut finishes;
            match py.detach(move || waiting.recv_timeout(LOOK_EVERY)) {
                Ok(done) => return interrupted.map_or(Ok(done), Err),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {}
            }
            let done = progress.done.load(Ordering::Relaxed);
            if interrupted.is_none() {
                let report = report.filter(|_| done > reported);
                interrupted = py
                    .check_signals()
                    .and_then(|()| report.map_or(Ok(()), |report| report.call1(py, (done,)).map(drop)))
                    .err();
                // The work may also have stopped itself.
                progress.stop.fetch_or(interrupted.is_some(), Ordering::Relaxed);
                reported = done;
            }
        }
        match worker.join() {
            Ok(()) => unreachable!("a thread that ends without a result has panicked"),
            Err(panicked) => std::panic::resume_unwind(panicked),
        }
    })
}

/// Columns of values that differ between rows, with their keys.
type Columns<'py> = Vec<(String, PyReadonlyArray1<'py, f64>)>;

#[documented]
#[pyfunction]
#[pyo3(signature = (parts, threads, lanes, progress, research=None, metrics=None))]
fn sweep_scenes(
    py: Python<'_>,
    parts: Vec<(PyBackedBytes, Columns<'_>)>,
    threads: usize,
    lanes: bool,
    progress: Option<Py<PyAny>>,
    research: Option<Py<PyAny>>,
    metrics: Option<Vec<String>>,
) -> PyResult<Vec<Py<PyDict>>> {
    let asked = metrics.map(|names| asked_metrics(&names)).transpose()?;
    let parts: Vec<(PyBackedBytes, Vec<Variation>)> = parts
        .into_iter()
        .map(|(scene, columns)| {
            let columns = columns.into_iter();
            let values = |values: PyReadonlyArray1<'_, f64>| values.as_array().to_vec();
            (scene, columns.map(|(path, of)| Variation { path, values: values(of) }).collect())
        })
        .collect();
    // Python controllers would wait for one another.
    let threads = if research.is_some() { 1 } else { threads };
    let measured = asked.as_ref().map_or(Metrics::ALL, |asked| asked.iter().copied().collect());
    let settings = SweepSettings { threads, lanes, metrics: measured };
    let shared = Arc::new(Progress::default());
    let research = research.map(|factory| PyResearch::new(factory, &shared));
    let factory = research.as_ref().map(|factory| factory as &dyn ResearchFactory);
    let of_parts: Vec<_> = parts.iter().map(|(scene, variations)| SweepPart { scene, variations }).collect();
    let swept = interruptibly(py, progress.as_ref(), &shared, |progress| {
        attached(factory.is_some(), || sweep_parts(&of_parts, settings, progress, factory))
    })?;
    research.as_ref().map_or(Ok(()), |factory| factory.finish(py))?;
    let rows = swept.map_err(refuse)?;
    of_parts.iter().zip(&rows).map(|(part, rows)| outcome_table(py, part, rows, asked.as_deref())).collect()
}

/// Metrics with these names, in the order of tables.
fn asked_metrics(names: &[String]) -> PyResult<Vec<Metric>> {
    let known = Metric::ALL.map(Metric::name);
    if let Some(unknown) = names.iter().find(|name| !known.contains(&name.as_str())) {
        return Err(PyValueError::new_err(format!("metrics: {unknown:?}: must be of {}", known.join(", "))));
    }
    Ok(Metric::ALL.into_iter().filter(|metric| names.iter().any(|name| name == metric.name())).collect())
}

/// Outcomes of one part as columns, with the requested metrics.
fn outcome_table(
    py: Python<'_>,
    part: &SweepPart<'_>,
    rows: &[Result<Outcome, Refused>],
    asked: Option<&[Metric]>,
) -> PyResult<Py<PyDict>> {
    let SceneOutline { period_s, kind, .. } = scene_outline(part.scene).map_err(refuse)?;
    let periods = part.variations.iter().find(|one| one.path == "run.period_s").map(|one| &one.values);
    let period = |row: usize| periods.map_or(period_s, |periods| periods[row]);
    let table = PyDict::new(py);
    let name = |row: &Result<Outcome, Refused>| {
        row.as_ref().map_or(Cow::Borrowed("refused"), |outcome| outcome.ending.name().into())
    };
    table.set_item("outcome", texts(py, rows.iter().map(name))?)?;
    // NaN marks a metric that was not measured. Columns of rotation appear for poses, or if requested.
    let of_all = Metric::ALL.into_iter().filter(|metric| kind == SideKind::Pose || !metric.is_of_rotation());
    let asked = asked.map_or_else(|| of_all.collect(), <[Metric]>::to_vec);
    for metric in asked {
        let of = |(index, row): (usize, &Result<Outcome, Refused>)| {
            row.as_ref().ok().and_then(|one| one.value(metric, period(index))).unwrap_or(f64::NAN)
        };
        table.set_item(metric.name(), column(py, rows.iter().enumerate().map(of).collect::<Vec<f64>>()))?;
    }
    let diverged = |row: &Result<Outcome, Refused>| row.as_ref().is_ok_and(|one| one.diverged.is_some());
    table.set_item("diverged", column(py, rows.iter().map(diverged).collect::<Vec<bool>>()))?;
    let ticks = |row: &Result<Outcome, Refused>| row.as_ref().map_or(0, |one| one.ticks);
    table.set_item("ticks", column(py, rows.iter().map(ticks).collect::<Vec<u64>>()))?;
    let reason = |row: &Result<Outcome, Refused>| match row {
        Ok(outcome) => outcome.diverged.map_or(Cow::Borrowed(""), |divergence| divergence.to_string().into()),
        Err(refused) => refused.to_string().into(),
    };
    table.set_item("reason", texts(py, rows.iter().map(reason))?)?;
    Ok(table.unbind())
}

/// A column of texts as NumPy makes it from a list; converts each distinct text once, because most rows are
/// equal.
fn texts<'py, 'a>(
    py: Python<'py>,
    rows: impl ExactSizeIterator<Item = Cow<'a, str>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut numbers = HashMap::<Cow<'a, str>, usize>::new();
    let mut different = Vec::new();
    let mut of_row = Vec::with_capacity(rows.len());
    let mut last = 0;
    for text in rows {
        if different.get(last) != Some(&text) {
            last = if let Some(known) = numbers.get(&text) {
                *known
            } else {
                numbers.insert(text.clone(), different.len());
                different.push(text);
                different.len() - 1
            };
        }
        #[allow(clippy::cast_possible_wrap)] // no list is longer
        of_row.push(last as isize);
    }
    let different = py.import("numpy")?.call_method1("array", (different,))?;
    different.call_method1("take", (column(py, of_row),))
}
