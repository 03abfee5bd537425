//! `haptether.bridge`: both sides live, each with a socket and a loop on its own thread.

use std::{path::PathBuf, sync::Mutex, time::Duration};

use haptether_bridge::{
    Feeling, MasterRecord, MasterSide, MasterTurn, OperatorCommand, Side, SideKind,
    live::{Ineffective, LiveRun, run_live},
    scene::{
        SimulatedDevice, Timed, as_pose, simulated_master, simulated_pose_master, simulated_pose_slave,
        simulated_slave,
    },
};
use pyo3::{exceptions::PyRuntimeError, prelude::*};

use crate::{
    axes::{of_axes, refuse},
    bridge_trace::{MasterRows, MasterTrace, PyLoopReport, PyRecordingReport, Rowed, SlaveRows, SlaveTrace},
    live::{
        How, Place, Watched, constructor, finished_before, locked, master_methods, not_begun,
        realtime_settings, recorder_settings, security, slave_methods, telemetry_settings, watch_methods,
    },
    scene::{live_periods, scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LiveMaster>()?;
    module.add_class::<LiveSlave>()
}

/// A loop on a thread of its own, and what watches it.
type Started<Rows> = (Mutex<LiveRun>, Watched<Rows>);

/// Without the interpreter: once a first loop has locked the process's memory, the rings of the next take 100 ms to
/// map.
fn start<S>(
    py: Python<'_>,
    side: S,
    place: Place,
) -> PyResult<Started<<S::Record as Rowed>::Rows>>
where
    S: Side<Record: Rowed> + Send + 'static,
{
    py.detach(|| {
        // Before the loop: it locks what memory there is.
        let outputs = place.outputs()?;
        let control = (place.settings.role, place.control()?);
        let (run, watch, reader) =
            run_live(side, place.socket, place.settings, place.security, outputs).map_err(not_begun)?;
        Ok((Mutex::new(run), Watched::new(watch, reader, control, false)?))
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

/// What both classes share, as their fields `run` and `watched`.
macro_rules! live_methods {
    ($class:ident, $rows:ident) => {
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
            fn end(&self, py: Python<'_>) -> PyResult<($rows, PyLoopReport)> {
                join(py, &self.run, &self.watched)
            }
        }
    };
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveMaster {
    run: Mutex<LiveRun>,
    pub(crate) watched: Watched<MasterRows>,
    kind: SideKind,
}

constructor!(LiveMaster, peer, [listen: Option<&str> = None, started_s: Option<f64> = None], |py, scene, run_id, how| {
    let place = Place::of_master(peer, listen, started_s, live_periods(&scene)?[0], how)?;
    let is_felt = scene.master.gripper.is_some();
    let (run, watched) = match as_pose(&scene).map_err(refuse)? {
        Some(scene) => start_master(py, simulated_pose_master(scene, run_id).map_err(refuse)?, place, is_felt)?,
        None => start_master(py, simulated_master::<N>(&scene, run_id).map_err(refuse)?, place, is_felt)?,
    };
    Ok(Self { run, watched, kind: scene.master.kind })
});

/// With records of what the finger feels where it does.
fn start_master<R: MasterTurn, const N: usize>(
    py: Python<'_>,
    side: Timed<MasterSide<SimulatedDevice<N>, N, R>>,
    place: Place,
    is_felt: bool,
) -> PyResult<Started<MasterRows>>
where
    MasterRecord<N, R>: Rowed<Rows = MasterRows>,
    MasterRecord<N, Feeling<R>>: Rowed<Rows = MasterRows>,
{
    if is_felt { start(py, side.feeling(), place) } else { start(py, side, place) }
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LiveSlave {
    run: Mutex<LiveRun>,
    pub(crate) watched: Watched<SlaveRows>,
    kind: SideKind,
}

constructor!(LiveSlave, listen, [], |py, scene, run_id, how| {
    let place = Place::of_slave(listen, live_periods(&scene)?[1], how)?;
    let (run, watched) = match as_pose(&scene).map_err(refuse)? {
        Some(scene) => start(py, simulated_pose_slave(scene, run_id).map_err(refuse)?, place)?,
        None => start(py, simulated_slave::<N>(&scene, run_id).map_err(refuse)?, place)?,
    };
    Ok(Self { run, watched, kind: scene.master.kind })
});

live_methods!(LiveMaster, MasterRows);
live_methods!(LiveSlave, SlaveRows);
master_methods!(LiveMaster);
slave_methods!(LiveSlave);
watch_methods!(LiveMaster);
watch_methods!(LiveSlave);
