//! `haptether.bridge`: both sides live, each with a socket and a loop on its own thread.

use std::{
    path::PathBuf,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use haptether_bridge::{
    OperatorCommand, Side,
    live::{LiveHandle, run_live},
    scene::{simulated_master, simulated_slave},
};
use pyo3::{exceptions::PyTypeError, prelude::*};

use crate::{
    axes::{of_axes, refuse},
    bridge::{PyMasterSettings, PySlaveSettings},
    bridge_trace::{MasterRows, MasterTrace, PyLoopReport, PyRecordingReport, Rowed, SlaveRows, SlaveTrace},
    live_options::{realtime_settings, recorder_settings},
    live_watch::{How, Live, Place, Running, ended, finished_before, not_begun, security, watch_methods},
    scene::{live_periods, scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LiveMaster>()?;
    module.add_class::<LiveSlave>()
}

type Run<Rows> = Box<dyn Running<Rows>>;

/// Never contended: the mutex only tells Python that the reader of the rings may move between threads.
fn locked<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Without the interpreter: once a first loop has locked the process's memory, the rings of the next take 100 ms to map.
fn start<S>(py: Python<'_>, side: S, place: Place) -> PyResult<Run<<S::Record as Rowed>::Rows>>
where
    S: Side<Record: Rowed> + Send + 'static,
{
    py.detach(|| {
        // Before the loop: it locks what memory there is.
        let (newest, recorder) = (place.newest()?, place.recorder()?);
        let run =
            run_live(side, place.socket, place.settings, place.security, recorder).map_err(not_begun)?;
        Ok(Box::new(Live::new(run, newest)) as Run<_>)
    })
}

/// How long between two looks at whether a loop has ended.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// Ends a loop and gives its report. Others may look at it meanwhile, so that nothing is locked while it ends.
fn join<Rows: 'static>(py: Python<'_>, of: &Mutex<Run<Rows>>) -> PyResult<PyLoopReport> {
    locked(of).stop();
    while !locked(of).is_finished() {
        py.detach(|| std::thread::sleep(LOOK_EVERY));
    }
    locked(of).join().map(Into::into).ok_or_else(finished_before)
}

/// A scene in place of a side, as `scene_json` writes it.
fn json_of<'a>(settings: &'a Bound<'_, PyAny>, class: &str) -> PyResult<&'a [u8]> {
    settings.extract().map_err(|_| {
        let kind = settings.get_type();
        PyTypeError::new_err(format!("settings: is a {kind}, must be {class} or the bytes of scene_json"))
    })
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveMaster {
    run: Mutex<Run<MasterRows>>,
}

impl LiveMaster {
    fn watch(&self) -> MutexGuard<'_, Run<MasterRows>> {
        locked(&self.run)
    }

    pub(crate) fn handle(&self) -> LiveHandle {
        self.watch().handle()
    }

    fn act(&self, act: OperatorCommand) -> PyResult<()> {
        let mut run = self.watch();
        if run.is_finished() { Err(ended()) } else { run.act(act) }
    }
}

#[pymethods]
impl LiveMaster {
    #[new]
    #[pyo3(signature = (settings, *, peer, session, key=None, insecure=false, listen=None, duration_s=None,
        patience_s=None, started_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        settings: &Bound<'_, PyAny>,
        peer: &str,
        session: u64,
        key: Option<&Bound<'_, PyAny>>,
        insecure: bool,
        listen: Option<&str>,
        duration_s: Option<f64>,
        patience_s: Option<f64>,
        started_s: Option<f64>,
        keep_s: f64,
        realtime: &str,
        priority: u8,
        cpu: Option<u16>,
        record: Option<PathBuf>,
        min_free_bytes: u64,
    ) -> PyResult<Self> {
        let realtime = realtime_settings(realtime, priority, cpu)?;
        let record = recorder_settings(record, min_free_bytes, insecure);
        let place = |period_ns| {
            let security = security(key, insecure)?;
            let how =
                How { security, period_ns, duration_s, patience_s, started_s, keep_s, realtime, record };
            Place::of_master(peer, listen, how)
        };
        let run = if let Ok(settings) = settings.cast::<PyMasterSettings>() {
            let settings = settings.get();
            start(py, settings.side(session)?, place(settings.endpoint.period_ns)?)?
        } else {
            let json = json_of(settings, "MasterSettings")?;
            of_axes!(scene_axes(json)?, N => {
                let scene = scene_spec::<N>(json)?;
                let place = place(live_periods(&scene)?[0])?;
                start(py, simulated_master::<N>(&scene, session).map_err(refuse)?, place)?
            })
        };
        Ok(Self { run: Mutex::new(run) })
    }

    #[getter]
    fn finished(&self) -> bool {
        self.watch().is_finished()
    }

    #[getter]
    fn realtime(&self) -> String {
        self.watch().realtime()
    }

    fn press_clutch(&self) {
        self.watch().press_clutch();
    }

    fn set_force_scale(&self, scale: f64) -> PyResult<()> {
        self.act(OperatorCommand::ForceScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(MasterTrace, PyLoopReport)> {
        let report = join(py, &self.run)?;
        Ok((MasterTrace { rows: self.watch().rows() }, report))
    }
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveSlave {
    run: Mutex<Run<SlaveRows>>,
}

impl LiveSlave {
    fn watch(&self) -> MutexGuard<'_, Run<SlaveRows>> {
        locked(&self.run)
    }

    pub(crate) fn handle(&self) -> LiveHandle {
        self.watch().handle()
    }

    fn act(&self, act: OperatorCommand) -> PyResult<()> {
        let mut run = self.watch();
        if run.is_finished() { Err(ended()) } else { run.act(act) }
    }
}

#[pymethods]
impl LiveSlave {
    #[new]
    #[pyo3(signature = (settings, *, listen, session, key=None, insecure=false, duration_s=None,
        patience_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        settings: &Bound<'_, PyAny>,
        listen: &str,
        session: u64,
        key: Option<&Bound<'_, PyAny>>,
        insecure: bool,
        duration_s: Option<f64>,
        patience_s: Option<f64>,
        keep_s: f64,
        realtime: &str,
        priority: u8,
        cpu: Option<u16>,
        record: Option<PathBuf>,
        min_free_bytes: u64,
    ) -> PyResult<Self> {
        let realtime = realtime_settings(realtime, priority, cpu)?;
        let record = recorder_settings(record, min_free_bytes, insecure);
        let place = |period_ns| {
            let security = security(key, insecure)?;
            let how = How {
                security,
                period_ns,
                duration_s,
                patience_s,
                started_s: None,
                keep_s,
                realtime,
                record,
            };
            Place::of_slave(listen, how)
        };
        let run = if let Ok(settings) = settings.cast::<PySlaveSettings>() {
            let settings = settings.get();
            start(py, settings.side(session)?, place(settings.endpoint.period_ns)?)?
        } else {
            let json = json_of(settings, "SlaveSettings")?;
            of_axes!(scene_axes(json)?, N => {
                let scene = scene_spec::<N>(json)?;
                let place = place(live_periods(&scene)?[1])?;
                start(py, simulated_slave::<N>(&scene, session).map_err(refuse)?, place)?
            })
        };
        Ok(Self { run: Mutex::new(run) })
    }

    #[getter]
    fn finished(&self) -> bool {
        self.watch().is_finished()
    }

    #[getter]
    fn realtime(&self) -> String {
        self.watch().realtime()
    }

    fn allow_takeover(&self) {
        self.watch().allow_takeover();
    }

    fn set_position_scale(&self, scale: f64) -> PyResult<()> {
        self.act(OperatorCommand::PositionScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(SlaveTrace, PyLoopReport)> {
        let report = join(py, &self.run)?;
        Ok((SlaveTrace { rows: self.watch().rows() }, report))
    }
}

watch_methods!(LiveMaster);
watch_methods!(LiveSlave);
