//! `haptether.bridge`: loops that a driver in Python turns, one call a tick.

use std::{
    path::PathBuf,
    sync::{Mutex, MutexGuard, PoisonError},
};

use haptether_bridge::{
    DrivenMaster, DrivenSlave, FaultText, FlightRecorder, MasterSide, OperatorCommand, Side, SlaveOrder,
    SlaveSide,
    live::{LiveHandle, LiveWatch, LoopReport, PacedLoop, paced_by_device},
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
    live_options::{realtime_settings, recorder_settings},
    live_watch::{How, Live, Place, Watching, ended, finished_before, not_begun, security, watch_methods},
    scene::{live_periods, scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<MasterLoop>()?;
    module.add_class::<SlaveLoop>()
}

type Ended = (LoopReport, Option<Box<FlightRecorder>>);

/// The loop of any side.
trait Paced: Send {
    fn begin(&mut self) -> PyResult<String>;
    fn wait(&mut self);
    fn fail(&mut self, text: &FaultText);
    fn announce_end(&mut self);
    fn end(&mut self) -> Option<Ended>;
}

impl<S: Side + Send> Paced for PacedLoop<S>
where
    PacedLoop<S>: Send,
{
    fn begin(&mut self) -> PyResult<String> {
        PacedLoop::begin(self).map(|realtime| realtime.to_string()).map_err(not_begun)
    }

    fn wait(&mut self) {
        PacedLoop::wait(self);
    }

    fn fail(&mut self, text: &FaultText) {
        PacedLoop::fail(self, text);
    }

    fn announce_end(&mut self) {
        PacedLoop::announce_end(self);
    }

    fn end(&mut self) -> Option<Ended> {
        PacedLoop::end(self)
    }
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

trait MasterTurns: Paced {
    fn turn<'py>(
        &mut self,
        py: Python<'py>,
        read: MasterRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>>;
}

trait SlaveTurns: Paced {
    fn turn<'py>(
        &mut self,
        py: Python<'py>,
        read: SlaveRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>>;
}

/// A fault that the device told with its sample, in its own words.
fn failed(side: &mut impl Side, fault: Option<&str>) {
    if let Some(text) = fault {
        side.describe_failure(&FaultText::new(text));
        side.device_failed();
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

impl<const N: usize> MasterTurns for PacedLoop<Timed<MasterSide<DrivenMaster<N>, N>>>
where
    Self: Paced,
{
    fn turn<'py>(
        &mut self,
        py: Python<'py>,
        read: MasterRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let position = read_axes("position", read.position)?;
        let velocity = read.velocity.map(|velocity| read_axes("velocity", velocity)).transpose()?;
        let force = PacedLoop::turn(
            self,
            |side| {
                failed(side, read.fault);
                let plant = &mut side.side.plant;
                (plant.position, plant.velocity, plant.clutch) = (position, velocity, read.clutch);
            },
            |side| side.side.plant.force,
        );
        force.map(|force| written(py, &force)).transpose()
    }
}

impl<const N: usize> SlaveTurns for PacedLoop<Timed<SlaveSide<DrivenSlave<N>, N>>>
where
    Self: Paced,
{
    fn turn<'py>(
        &mut self,
        py: Python<'py>,
        read: SlaveRead<'_, 'py>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let sample = [
            read_axes("position", read.position)?,
            read_axes("velocity", read.velocity)?,
            read_axes("force", read.force)?,
        ];
        let order = PacedLoop::turn(
            self,
            |side| {
                failed(side, read.fault);
                side.side.plant.sample = sample;
            },
            |side| *side.side.plant.order(),
        );
        let Some(order) = order else { return Ok(None) };
        let told = match order {
            SlaveOrder::Wait => (pyo3::intern!(py, "wait"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Stop => (pyo3::intern!(py, "stop"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Move { position, velocity } => {
                (pyo3::intern!(py, "move"), written(py, &position)?, written(py, &velocity)?)
            }
        };
        let told: (&Bound<'py, PyString>, _, _) = told;
        told.into_pyobject(py).map(Some)
    }
}

fn locked<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What belongs to the thread of the driver; it waits here with the GIL released, so that nobody else may wait for it.
fn turned<T>(of: &Mutex<T>) -> PyResult<MutexGuard<'_, T>> {
    of.try_lock().map_err(|_| PyRuntimeError::new_err("the loop is turned by another thread"))
}

/// Ends a loop and gives its report.
fn finish<T: Paced + ?Sized, Rows>(
    py: Python<'_>,
    turns: &Mutex<Box<T>>,
    watch: &Mutex<Box<dyn Watching<Rows>>>,
) -> PyResult<(Rows, PyLoopReport)> {
    let mut turns = turned(turns)?;
    let loop_of = &mut **turns;
    let (report, flight) = py.detach(|| loop_of.end()).ok_or_else(finished_before)?;
    let mut watch = locked(watch);
    watch.ended(flight);
    Ok((watch.rows(), report.into()))
}

macro_rules! loop_methods {
    ($class:ident, $rows:ident) => {
        impl $class {
            fn watch(&self) -> MutexGuard<'_, Box<dyn Watching<$rows>>> {
                locked(&self.watch)
            }

            pub(crate) fn handle(&self) -> LiveHandle {
                self.watch().handle()
            }

            fn act(&self, act: OperatorCommand) -> PyResult<()> {
                let mut watch = self.watch();
                if watch.is_stopped() { Err(ended()) } else { watch.act(act) }
            }
        }

        #[pymethods]
        impl $class {
            fn begin(&self, py: Python<'_>) -> PyResult<String> {
                let mut turns = turned(&self.turns)?;
                let turns = &mut **turns;
                // Memory is locked here, which takes its time where much is mapped.
                py.detach(|| turns.begin())
            }

            fn wait(&self, py: Python<'_>) -> PyResult<()> {
                let mut turns = turned(&self.turns)?;
                let turns = &mut **turns;
                py.detach(|| turns.wait());
                Ok(())
            }

            #[pyo3(signature = (text=""))]
            fn fail(&self, py: Python<'_>, text: &str) -> PyResult<()> {
                let text = FaultText::new(text);
                let mut turns = turned(&self.turns)?;
                let turns = &mut **turns;
                py.detach(|| turns.fail(&text));
                Ok(())
            }

            fn announce_end(&self, py: Python<'_>) -> PyResult<()> {
                let mut turns = turned(&self.turns)?;
                let turns = &mut **turns;
                py.detach(|| turns.announce_end());
                Ok(())
            }

            #[getter]
            fn finished(&self) -> bool {
                self.watch().is_stopped()
            }
        }
    };
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct MasterLoop {
    turns: Mutex<Box<dyn MasterTurns>>,
    watch: Mutex<Box<dyn Watching<MasterRows>>>,
}

#[pymethods]
impl MasterLoop {
    #[new]
    #[pyo3(signature = (scene, *, peer, session, key=None, insecure=false, listen=None, clutch="once",
        duration_s=None, patience_s=None, started_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        scene: &[u8],
        peer: &str,
        session: u64,
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
            let side = driven_master::<N>(&scene, session, simulated_clutch).map_err(refuse)?;
            let (turns, watch) = prepare(py, side, Place::of_master(peer, listen, how)?)?;
            Ok(Self { turns: Mutex::new(Box::new(turns)), watch: Mutex::new(watch) })
        })
    }

    #[pyo3(signature = (position, velocity=None, clutch=None, *, fault=None))]
    fn turn<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: Option<&Bound<'py, PyAny>>,
        clutch: Option<bool>,
        fault: Option<&str>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        turned(&self.turns)?.turn(py, MasterRead { position, velocity, clutch, fault })
    }

    fn press_clutch(&self) {
        self.watch().press_clutch();
    }

    fn set_force_scale(&self, scale: f64) -> PyResult<()> {
        self.act(OperatorCommand::ForceScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(MasterTrace, PyLoopReport)> {
        let (rows, report) = finish(py, &self.turns, &self.watch)?;
        Ok((MasterTrace { rows }, report))
    }
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SlaveLoop {
    turns: Mutex<Box<dyn SlaveTurns>>,
    watch: Mutex<Box<dyn Watching<SlaveRows>>>,
}

#[pymethods]
impl SlaveLoop {
    #[new]
    #[pyo3(signature = (scene, *, listen, session, key=None, insecure=false, duration_s=None,
        patience_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    fn new(
        py: Python<'_>,
        scene: &[u8],
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
            let side = driven_slave::<N>(&scene, session).map_err(refuse)?;
            let (turns, watch) = prepare(py, side, Place::of_slave(listen, how)?)?;
            Ok(Self { turns: Mutex::new(Box::new(turns)), watch: Mutex::new(watch) })
        })
    }

    #[pyo3(signature = (position, velocity, force, *, fault=None))]
    fn turn<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: &Bound<'py, PyAny>,
        force: &Bound<'py, PyAny>,
        fault: Option<&str>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        turned(&self.turns)?.turn(py, SlaveRead { position, velocity, force, fault })
    }

    fn allow_takeover(&self) {
        self.watch().allow_takeover();
    }

    fn set_position_scale(&self, scale: f64) -> PyResult<()> {
        self.act(OperatorCommand::PositionScale(scale))
    }

    fn finish(&self, py: Python<'_>) -> PyResult<(SlaveTrace, PyLoopReport)> {
        let (rows, report) = finish(py, &self.turns, &self.watch)?;
        Ok((SlaveTrace { rows }, report))
    }
}

type Prepared<S> = (PacedLoop<S>, Box<dyn Watching<<<S as Side>::Record as Rowed>::Rows>>);

/// Without the interpreter, as `start` of `LiveMaster`.
fn prepare<S>(py: Python<'_>, side: S, place: Place) -> PyResult<Prepared<S>>
where
    S: Side<Record: Rowed> + Send,
{
    py.detach(|| {
        let (newest, recorder) = (place.newest()?, place.recorder()?);
        let (turns, watch): (_, LiveWatch<S::Record>) =
            paced_by_device(side, place.socket, place.settings, place.security, recorder)
                .map_err(not_begun)?;
        Ok((turns, Box::new(Live::new(Box::new(watch), newest)) as Box<dyn Watching<_>>))
    })
}

loop_methods!(MasterLoop, MasterRows);
loop_methods!(SlaveLoop, SlaveRows);
watch_methods!(MasterLoop);
watch_methods!(SlaveLoop);
