//! `haptether.bridge`: both sides live, each with a socket and a loop on its own thread.

use std::{path::PathBuf, sync::Mutex, time::Duration};

use haptether_bridge::{
    OperatorCommand, Side,
    live::{Ineffective, LiveRun, run_live},
    scene::{simulated_master, simulated_slave},
};
use pyo3::{exceptions::PyRuntimeError, prelude::*};

use crate::{
    axes::{of_axes, refuse},
    bridge_trace::{MasterRows, MasterTrace, PyLoopReport, PyRecordingReport, Rowed, SlaveRows, SlaveTrace},
    live::{
        How, Place, Watched, finished_before, locked, not_begun, realtime_settings, recorder_settings,
        security, watch_methods,
    },
    scene::{live_periods, scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LiveMaster>()?;
    module.add_class::<LiveSlave>()
}

/// A loop on a thread of its own.
struct Started<Rows> {
    run: Mutex<LiveRun>,
    watched: Watched<Rows>,
}

/// Without the interpreter: once a first loop has locked the process's memory, the rings of the next take 100 ms to
/// map.
fn start<S, const N: usize>(
    py: Python<'_>,
    side: S,
    place: Place,
) -> PyResult<Started<<S::Record as Rowed>::Rows>>
where
    S: Side<N, Record: Rowed> + Send + 'static,
{
    py.detach(|| {
        // Before the loop: it locks what memory there is.
        let (newest, recorder) = (place.newest()?, place.recorder()?);
        let (run, watch, reader) =
            run_live(side, place.socket, place.settings, place.security, recorder).map_err(not_begun)?;
        Ok(Started { run: Mutex::new(run), watched: Watched::new(watch, reader, newest) })
    })
}

/// Time between two looks at whether a loop has ended.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// Ends a loop and returns its rows and report. Others may look at it meanwhile, so that nothing is locked while it
/// ends.
fn join<Rows>(
    py: Python<'_>,
    run: &Mutex<LiveRun>,
    watched: &Watched<Rows>,
) -> PyResult<(Rows, PyLoopReport)> {
    watched.handle.stop();
    while !locked(run).is_finished() {
        py.detach(|| std::thread::sleep(LOOK_EVERY));
    }
    let (report, flight) = locked(run).join().ok_or_else(finished_before)?;
    watched.watch().ended(flight);
    Ok((watched.rows(), report.into()))
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveMaster {
    run: Mutex<LiveRun>,
    pub(crate) watched: Watched<MasterRows>,
}

#[pymethods]
impl LiveMaster {
    #[new]
    #[pyo3(signature = (scene, *, peer, run_id, key=None, insecure=false, listen=None, duration_s=None,
        patience_s=None, started_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        scene: &[u8],
        peer: &str,
        run_id: u64,
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
        let Started { run, watched } = of_axes!(scene_axes(scene)?, N => {
            let scene = scene_spec::<N>(scene)?;
            let place = place(live_periods(&scene)?[0])?;
            start(py, simulated_master::<N>(&scene, run_id).map_err(refuse)?, place)?
        });
        Ok(Self { run, watched })
    }

    #[getter]
    fn finished(&self) -> bool {
        locked(&self.run).is_finished()
    }

    #[getter]
    fn realtime(&self) -> String {
        locked(&self.run).realtime().to_string()
    }

    fn press_clutch(&self) {
        self.watched.handle.press_clutch();
    }

    fn set_force_scale(&self, scale: f64) -> PyResult<()> {
        self.command(OperatorCommand::ForceScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(MasterTrace, PyLoopReport)> {
        let (rows, report) = join(py, &self.run, &self.watched)?;
        Ok((MasterTrace { rows }, report))
    }
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveSlave {
    run: Mutex<LiveRun>,
    pub(crate) watched: Watched<SlaveRows>,
}

#[pymethods]
impl LiveSlave {
    #[new]
    #[pyo3(signature = (scene, *, listen, run_id, key=None, insecure=false, duration_s=None,
        patience_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        scene: &[u8],
        listen: &str,
        run_id: u64,
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
        let Started { run, watched } = of_axes!(scene_axes(scene)?, N => {
            let scene = scene_spec::<N>(scene)?;
            let place = place(live_periods(&scene)?[1])?;
            start(py, simulated_slave::<N>(&scene, run_id).map_err(refuse)?, place)?
        });
        Ok(Self { run, watched })
    }

    #[getter]
    fn finished(&self) -> bool {
        locked(&self.run).is_finished()
    }

    #[getter]
    fn realtime(&self) -> String {
        locked(&self.run).realtime().to_string()
    }

    fn allow_takeover(&self) {
        self.watched.handle.allow_takeover();
    }

    fn set_position_scale(&self, scale: f64) -> PyResult<()> {
        self.command(OperatorCommand::PositionScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(SlaveTrace, PyLoopReport)> {
        let (rows, report) = join(py, &self.run, &self.watched)?;
        Ok((SlaveTrace { rows }, report))
    }
}

watch_methods!(LiveMaster);
watch_methods!(LiveSlave);
