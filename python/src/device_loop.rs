//! `haptether.bridge`: loops that a driver in Python steps, one call a tick.

use std::{
    path::PathBuf,
    sync::{Mutex, MutexGuard},
};

use haptether_bridge::{
    DrivenMaster, DrivenSlave, FaultText, MasterSide, OperatorCommand, Side, SlaveOrder, SlaveSide,
    live::{DriverLoop, Ineffective, PacedLoop, paced_by_device},
    scene::{Timed, driven_master, driven_slave},
};
use haptether_safety::Axes;
use pyo3::{
    exceptions::{PyRuntimeError, PyTypeError, PyValueError},
    prelude::*,
    types::{PyString, PyTuple},
};

use crate::{
    axes::{of_axes, refuse},
    bridge_trace::{MasterRows, MasterTrace, PyLoopReport, PyRecordingReport, Rowed, SlaveRows, SlaveTrace},
    live::{
        How, Place, Watched, finished_before, not_begun, realtime_settings, recorder_settings, security,
        watch_methods,
    },
    scene::{live_periods, scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<MasterLoop>()?;
    module.add_class::<SlaveLoop>()
}

/// What a master's driver has read.
struct MasterRead<'a, 'py> {
    position: &'a Bound<'py, PyAny>,
    velocity: Option<&'a Bound<'py, PyAny>>,
    clutch: Option<bool>,
    fault: Option<&'a str>,
}

/// What a slave's driver has read.
struct SlaveRead<'a, 'py> {
    position: &'a Bound<'py, PyAny>,
    velocity: &'a Bound<'py, PyAny>,
    force: &'a Bound<'py, PyAny>,
    fault: Option<&'a str>,
}

trait MasterSteps: DriverLoop + Send {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: MasterRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>>;
}

trait SlaveSteps: DriverLoop + Send {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: SlaveRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>>;
}

/// A fault that the device reports with its sample, with its own text.
fn report_fault<const N: usize>(side: &mut impl Side<N>, fault: Option<&str>) {
    if let Some(text) = fault {
        side.exchange_mut().device_failed(Some(&FaultText::new(text)));
    }
}

/// A number for one axis, or one for each axis.
fn read_axes<const N: usize>(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Axes<N>> {
    if let Ok(values) = value.extract::<[f64; N]>() {
        return Ok(Axes::from(values));
    }
    if N == 1
        && let Ok(value) = value.extract::<f64>()
    {
        return Ok(Axes::repeat(value));
    }
    let of = if N == 1 { "a number".to_owned() } else { format!("a sequence of {N} numbers") };
    Err(PyTypeError::new_err(format!("{name} = {value}: must be {of}")))
}

fn written<'py, const N: usize>(py: Python<'py>, value: &Axes<N>) -> PyResult<Bound<'py, PyTuple>> {
    PyTuple::new(py, value.iter())
}

impl<const N: usize> MasterSteps for PacedLoop<Timed<MasterSide<DrivenMaster<N>, N>>, N> {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: MasterRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let position = read_axes("position", read.position)?;
        let velocity = read.velocity.map(|velocity| read_axes("velocity", velocity)).transpose()?;
        let force = PacedLoop::step(
            self,
            |side| {
                report_fault(side, read.fault);
                let plant = &mut side.side.plant;
                (plant.position, plant.velocity, plant.clutch) = (position, velocity, read.clutch);
            },
            |side| side.side.plant.force,
        );
        force.map(|force| written(py, &force)).transpose()
    }
}

impl<const N: usize> SlaveSteps for PacedLoop<Timed<SlaveSide<DrivenSlave<N>, N>>, N> {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: SlaveRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let sample = [
            read_axes("position", read.position)?,
            read_axes("velocity", read.velocity)?,
            read_axes("force", read.force)?,
        ];
        let order = PacedLoop::step(
            self,
            |side| {
                report_fault(side, read.fault);
                side.side.plant.sample = sample;
            },
            |side| *side.side.plant.order(),
        );
        let Some(order) = order else { return Ok(None) };
        let named = match order {
            SlaveOrder::Wait => (pyo3::intern!(py, "wait"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Stop => (pyo3::intern!(py, "stop"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Move { position, velocity } => {
                (pyo3::intern!(py, "move"), written(py, &position)?, written(py, &velocity)?)
            }
        };
        let named: (&Bound<'py, PyString>, _, _) = named;
        named.into_pyobject(py).map(Some)
    }
}

/// What belongs to the thread of the driver; it waits here with the GIL released, so that nobody else may wait for it.
fn own<T: ?Sized>(of: &Mutex<Box<T>>) -> PyResult<MutexGuard<'_, Box<T>>> {
    of.try_lock().map_err(|_| PyRuntimeError::new_err("the loop is turned by another thread"))
}

/// Ends a loop and returns its rows and report.
fn finish<T: DriverLoop + Send + ?Sized, Rows>(
    py: Python<'_>,
    paced: &Mutex<Box<T>>,
    watched: &Watched<Rows>,
) -> PyResult<(Rows, PyLoopReport)> {
    let mut paced = own(paced)?;
    let paced = &mut **paced;
    let (report, flight) = py.detach(|| paced.end()).ok_or_else(finished_before)?;
    watched.watch().ended(flight);
    Ok((watched.rows(), report.into()))
}

macro_rules! loop_methods {
    ($class:ident) => {
        #[pymethods]
        impl $class {
            fn begin(&self, py: Python<'_>) -> PyResult<String> {
                let mut paced = own(&self.paced)?;
                let paced = &mut **paced;
                // Memory is locked here, which takes its time where much is mapped.
                py.detach(|| paced.begin()).map(|realtime| realtime.to_string()).map_err(not_begun)
            }

            fn wait(&self, py: Python<'_>) -> PyResult<()> {
                let mut paced = own(&self.paced)?;
                let paced = &mut **paced;
                py.detach(|| paced.wait());
                Ok(())
            }

            #[pyo3(signature = (text=""))]
            fn fail(&self, py: Python<'_>, text: &str) -> PyResult<()> {
                let text = FaultText::new(text);
                let mut paced = own(&self.paced)?;
                let paced = &mut **paced;
                py.detach(|| paced.fail(&text));
                Ok(())
            }

            fn announce_end(&self, py: Python<'_>) -> PyResult<()> {
                let mut paced = own(&self.paced)?;
                let paced = &mut **paced;
                py.detach(|| paced.announce_end());
                Ok(())
            }

            #[getter]
            fn finished(&self) -> bool {
                self.watched.handle.is_stopped()
            }
        }
    };
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct MasterLoop {
    paced: Mutex<Box<dyn MasterSteps>>,
    pub(crate) watched: Watched<MasterRows>,
}

#[pymethods]
impl MasterLoop {
    #[new]
    #[pyo3(signature = (scene, *, peer, run_id, key=None, insecure=false, listen=None, clutch="once",
        duration_s=None, patience_s=None, started_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        scene: &[u8],
        peer: &str,
        run_id: u64,
        key: Option<&Bound<'_, PyAny>>,
        insecure: bool,
        listen: Option<&str>,
        clutch: &str,
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
        let simulated_clutch = match clutch {
            "once" => false,
            "auto" => true,
            _ => {
                let text = format!("clutch = {clutch:?}: must be \"once\" or \"auto\"");
                return Err(PyValueError::new_err(text));
            }
        };
        of_axes!(scene_axes(scene)?, N => {
            let scene = scene_spec::<N>(scene)?;
            let how = How {
                security: security(key, insecure)?,
                period_ns: live_periods(&scene)?[0],
                duration_s,
                patience_s,
                started_s,
                keep_s,
                realtime: realtime_settings(realtime, priority, cpu)?,
                record: recorder_settings(record, min_free_bytes, insecure),
            };
            let side = driven_master::<N>(&scene, run_id, simulated_clutch).map_err(refuse)?;
            let (paced, watched) = prepare(py, side, Place::of_master(peer, listen, how)?)?;
            Ok(Self { paced: Mutex::new(Box::new(paced)), watched })
        })
    }

    #[pyo3(signature = (position, velocity=None, clutch=None, *, fault=None))]
    fn step<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: Option<&Bound<'py, PyAny>>,
        clutch: Option<bool>,
        fault: Option<&str>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        own(&self.paced)?.step(py, MasterRead { position, velocity, clutch, fault })
    }

    fn press_clutch(&self) {
        self.watched.handle.press_clutch();
    }

    fn set_force_scale(&self, scale: f64) -> PyResult<()> {
        self.command(OperatorCommand::ForceScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(MasterTrace, PyLoopReport)> {
        let (rows, report) = finish(py, &self.paced, &self.watched)?;
        Ok((MasterTrace { rows }, report))
    }
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SlaveLoop {
    paced: Mutex<Box<dyn SlaveSteps>>,
    pub(crate) watched: Watched<SlaveRows>,
}

#[pymethods]
impl SlaveLoop {
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
        of_axes!(scene_axes(scene)?, N => {
            let scene = scene_spec::<N>(scene)?;
            let how = How {
                security: security(key, insecure)?,
                period_ns: live_periods(&scene)?[1],
                duration_s,
                patience_s,
                started_s: None,
                keep_s,
                realtime: realtime_settings(realtime, priority, cpu)?,
                record: recorder_settings(record, min_free_bytes, insecure),
            };
            let side = driven_slave::<N>(&scene, run_id).map_err(refuse)?;
            let (paced, watched) = prepare(py, side, Place::of_slave(listen, how)?)?;
            Ok(Self { paced: Mutex::new(Box::new(paced)), watched })
        })
    }

    #[pyo3(signature = (position, velocity, force, *, fault=None))]
    fn step<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: &Bound<'py, PyAny>,
        force: &Bound<'py, PyAny>,
        fault: Option<&str>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        own(&self.paced)?.step(py, SlaveRead { position, velocity, force, fault })
    }

    fn allow_takeover(&self) {
        self.watched.handle.allow_takeover();
    }

    fn set_position_scale(&self, scale: f64) -> PyResult<()> {
        self.command(OperatorCommand::PositionScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(SlaveTrace, PyLoopReport)> {
        let (rows, report) = finish(py, &self.paced, &self.watched)?;
        Ok((SlaveTrace { rows }, report))
    }
}

/// The loop of a side, and what watches it.
type Prepared<S, const N: usize> = (PacedLoop<S, N>, Watched<<<S as Side<N>>::Record as Rowed>::Rows>);

/// Without the interpreter, as `start` of `LiveMaster`.
fn prepare<S, const N: usize>(py: Python<'_>, side: S, place: Place) -> PyResult<Prepared<S, N>>
where
    S: Side<N, Record: Rowed> + Send,
{
    py.detach(|| {
        let (newest, recorder) = (place.newest()?, place.recorder()?);
        let (paced, watch, reader) =
            paced_by_device(side, place.socket, place.settings, place.security, recorder)
                .map_err(not_begun)?;
        Ok((paced, Watched::new(watch, reader, newest)))
    })
}

loop_methods!(MasterLoop);
loop_methods!(SlaveLoop);
watch_methods!(MasterLoop);
watch_methods!(SlaveLoop);
