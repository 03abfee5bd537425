//! `haptether.bridge`: live sides, each with a socket and a loop on its own thread.

use std::{path::PathBuf, sync::Mutex, time::Duration};

use haptether_bridge::{
    OperatorCommand, SideKind, Trace,
    live::{Ineffective, LiveRun},
    scene::{run_scene_side, scene_outline},
};
use pyo3::{exceptions::PyRuntimeError, prelude::*};

use crate::{
    axes::refuse,
    bridge_trace::{MasterTrace, PyLoopReport, PyRecordingReport, SlaveTrace},
    live::{
        How, Place, Watched, constructor, finished_before, locked, master_methods, realtime_settings,
        recorder_settings, refused, security, slave_methods, telemetry_settings, watch_methods,
    },
    scene::live_periods,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LiveMaster>()?;
    module.add_class::<LiveSlave>()
}

/// Start a loop on its own thread. Releases the GIL, because touching all memory for records takes long.
fn start(py: Python<'_>, scene: &[u8], run_id: u64, place: Place) -> PyResult<(Mutex<LiveRun>, Watched)> {
    py.detach(|| {
        let (parts, control) = place.open()?;
        let (run, watch, records) = run_scene_side(scene, run_id, parts).map_err(refused)?;
        Ok((Mutex::new(run), Watched::new(watch, records, control, false)?))
    })
}

/// Period at which `join` polls for the end of a loop.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// End a loop and return its trace and report. Holds no lock while the loop ends, so that other threads can
/// use it.
fn join(py: Python<'_>, run: &Mutex<LiveRun>, watched: &Watched) -> PyResult<(Trace, PyLoopReport)> {
    watched.handle.stop();
    while !locked(run).is_finished() {
        py.detach(|| std::thread::sleep(LOOK_EVERY));
    }
    let (report, flight) = locked(run).join().ok_or_else(finished_before)?;
    watched.watch().ended(flight);
    Ok((py.detach(|| watched.trace()), report.into()))
}

/// Methods shared by both classes, on their fields `run` and `watched`.
macro_rules! live_methods {
    ($class:ident) => {
        #[documented]
        #[pymethods]
        impl $class {
            #[getter]
            fn finished(&self) -> bool {
                locked(&self.run).is_finished()
            }

            #[getter]
            fn realtime(&self) -> String {
                locked(&self.run).realtime().to_string()
            }
        }

        impl $class {
            fn end(&self, py: Python<'_>) -> PyResult<(Trace, PyLoopReport)> {
                join(py, &self.run, &self.watched)
            }
        }
    };
}

#[documented]
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveMaster {
    run: Mutex<LiveRun>,
    pub(crate) watched: Watched,
    kind: SideKind,
}

constructor!(
    LiveMaster, peer, [listen: Option<&str> = None, started_s: Option<f64> = None],
    |py, scene, outline, run_id, how| {
        let place = Place::of_master(peer, listen, started_s, live_periods(&outline)?[0], how)?;
        let (run, watched) = start(py, scene, run_id, place)?;
        Ok(Self { run, watched, kind: outline.kind })
    }
);

#[documented]
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveSlave {
    run: Mutex<LiveRun>,
    pub(crate) watched: Watched,
    kind: SideKind,
}

constructor!(LiveSlave, listen, [], |py, scene, outline, run_id, how| {
    let place = Place::of_slave(listen, live_periods(&outline)?[1], how)?;
    let (run, watched) = start(py, scene, run_id, place)?;
    Ok(Self { run, watched, kind: outline.kind })
});

live_methods!(LiveMaster);
live_methods!(LiveSlave);
master_methods!(LiveMaster);
slave_methods!(LiveSlave);
watch_methods!(LiveMaster);
watch_methods!(LiveSlave);
