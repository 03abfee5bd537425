//! `haptether.bridge`: loops that a driver in Python steps, one call a tick.

use std::{
    path::PathBuf,
    sync::{Mutex, MutexGuard},
};

use haptether_bridge::{
    ButtonWord, DrivenMaster, DrivenSlave, FaultText, Feeling, GripperOrder, MasterRecord, MasterSide,
    MasterTurn, OperatorCommand, Side, SideKind, SlaveOrder, SlaveSide, SlaveTurn, Trigger,
    coupling::{RotationState, measured, quat_wxyz},
    live::{DriverLoop, Ineffective, PacedLoop, paced_by_device},
    scene::{Timed, as_pose, driven_master, driven_slave},
};
use haptether_master::RotationSample;
use haptether_safety::Axes;
use haptether_slave::{GripperCommand, GripperSample};
use pyo3::{
    conversion::FromPyObjectOwned,
    exceptions::{PyRuntimeError, PyTypeError, PyValueError},
    prelude::*,
    pybacked::PyBackedStr,
    types::{PyString, PyTuple},
};

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
    module.add_class::<MasterLoop>()?;
    module.add_class::<SlaveLoop>()
}

/// What a master's driver has read.
struct MasterRead<'a, 'py> {
    position: &'a Bound<'py, PyAny>,
    velocity: Option<&'a Bound<'py, PyAny>>,
    clutch: Option<bool>,
    fault: Option<&'a str>,
    trigger: Option<f64>,
    orientation: Option<[f64; 4]>,
    angular_velocity: Option<[f64; 3]>,
    buttons: Option<u32>,
}

/// What a slave's driver has read.
struct SlaveRead<'a, 'py> {
    position: &'a Bound<'py, PyAny>,
    velocity: &'a Bound<'py, PyAny>,
    force: &'a Bound<'py, PyAny>,
    fault: Option<&'a str>,
    gripper: Option<GripperSample>,
    orientation: Option<[f64; 4]>,
    angular_velocity: Option<[f64; 3]>,
    torque: Option<[f64; 3]>,
}

/// What else a tick of a slave says: what the gripper is to do, and the buttons of the master.
#[derive(Clone, Copy)]
struct Beside {
    gripper: GripperOrder,
    buttons: Option<u32>,
}

impl Beside {
    const NOTHING: Self = Self { gripper: GripperOrder::Hold, buttons: None };
}

trait MasterSteps: DriverLoop + Send {
    /// `trigger_force` in N becomes what the trigger is to exert, of one that the finger feels.
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: MasterRead<'_, 'py>,
        trigger_force: &mut Option<f64>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>>;
}

trait SlaveSteps: DriverLoop + Send {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: SlaveRead<'_, 'py>,
        beside: &mut Beside,
    ) -> PyResult<Option<Bound<'py, PyTuple>>>;
}

/// A fault that the device reports with its sample, with its own text.
fn report_fault(side: &mut impl Side, fault: Option<&str>) {
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

/// What a driver may leave out of a sample.
fn read_optional<'py, T: FromPyObjectOwned<'py>>(
    name: &str,
    value: Option<&Bound<'py, PyAny>>,
    of: &str,
) -> PyResult<Option<T>> {
    let wrong = |value| PyTypeError::new_err(format!("{name} = {value}: must be {of}"));
    value.map(|value| value.extract().map_err(|_| wrong(value))).transpose()
}

const TEXT: &str = "a text, or None";
const NUMBER: &str = "a number, or None";
const SWITCH: &str = "True, False or None";
const QUATERNION: &str = "a sequence of 4 numbers, w, x, y, z, or None";
const VECTOR: &str = "a sequence of 3 numbers, or None";
const WORD: &str = "a whole number from 0 to 2^32 - 1, or None";

/// What a driver of poses must read at each tick.
fn read_part<T>(name: &str, value: Option<T>) -> PyResult<T> {
    let missing = || {
        PyTypeError::new_err(format!(
            "{name} is missing: a driver in a scene of kind \"pose\" reads it at each tick"
        ))
    };
    value.ok_or_else(missing)
}

fn written<'py, const N: usize>(py: Python<'py>, value: &Axes<N>) -> PyResult<Bound<'py, PyTuple>> {
    PyTuple::new(py, value.iter())
}

impl<R: MasterTurn, const N: usize> MasterSteps for PacedLoop<Timed<MasterSide<DrivenMaster<N>, N, R>>> {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: MasterRead<'_, 'py>,
        trigger_force: &mut Option<f64>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let position = read_axes("position", read.position)?;
        let velocity = read.velocity.map(|velocity| read_axes("velocity", velocity)).transpose()?;
        let rotation = if R::TURNS {
            let orientation = measured(read_part("orientation", read.orientation)?);
            Some(RotationSample { orientation, angular_velocity: read.angular_velocity.map(Axes::from) })
        } else {
            None
        };
        let force = PacedLoop::step(
            self,
            |side| {
                report_fault(side, read.fault);
                let plant = &mut side.side.plant;
                (plant.position, plant.velocity, plant.clutch) = (position, velocity, read.clutch);
                // What a device says beside a fault is not known.
                let buttons = ButtonWord(read.buttons.filter(|_| read.fault.is_none()));
                (plant.rotation, plant.buttons) = (rotation, buttons);
                if let Some(trigger) = &mut side.side.trigger {
                    *trigger = Trigger::Driven(read.trigger);
                }
            },
            |side| {
                let felt = side.side.felt().map(|tick| tick.device_force[0]);
                (side.side.plant.force, side.side.plant.torque, felt)
            },
        );
        let Some((force, torque, felt)) = force else { return Ok(None) };
        *trigger_force = felt;
        if R::TURNS {
            return PyTuple::new(py, [written(py, &force)?, written(py, &torque)?]).map(Some);
        }
        written(py, &force).map(Some)
    }
}

impl<R: SlaveTurn, const N: usize> SlaveSteps for PacedLoop<Timed<SlaveSide<DrivenSlave<N>, N, R>>> {
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        read: SlaveRead<'_, 'py>,
        beside: &mut Beside,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let sample = [
            read_axes("position", read.position)?,
            read_axes("velocity", read.velocity)?,
            read_axes("force", read.force)?,
        ];
        let rotation = if R::TURNS {
            Some(RotationState {
                orientation: measured(read_part("orientation", read.orientation)?),
                angular_velocity: Axes::from(read_part("angular_velocity", read.angular_velocity)?),
                torque: Axes::from(read_part("torque", read.torque)?),
            })
        } else {
            None
        };
        let order = PacedLoop::step(
            self,
            |side| {
                report_fault(side, read.fault);
                (side.side.plant.sample, side.side.plant.rotation) = (sample, rotation);
                if let (Some(jaws), Some(read)) = (&mut side.side.gripper, read.gripper) {
                    jaws.take(read);
                }
            },
            |side| {
                let led = side.side.gripper.as_ref().map_or(GripperOrder::Hold, |jaws| *jaws.order());
                (*side.side.plant.order(), Beside { gripper: led, buttons: side.exchange().peer_buttons() })
            },
        );
        let Some((order, said)) = order else { return Ok(None) };
        *beside = said;
        let named = match order {
            SlaveOrder::Wait => (pyo3::intern!(py, "wait"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Stop => (pyo3::intern!(py, "stop"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Move { position, velocity, rotation: None } => {
                (pyo3::intern!(py, "move"), written(py, &position)?, written(py, &velocity)?)
            }
            SlaveOrder::Move { position, velocity, rotation: Some((orientation, angular_velocity)) } => {
                let turn = (PyTuple::new(py, quat_wxyz(&orientation))?, written(py, &angular_velocity)?);
                let named = (pyo3::intern!(py, "move"), written(py, &position)?, written(py, &velocity)?);
                return (named.0, named.1, named.2, turn.0, turn.1).into_pyobject(py).map(Some);
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

/// What both classes share, as their fields `paced` and `watched`.
macro_rules! loop_methods {
    ($class:ident, $rows:ident) => {
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

            fn take_acknowledgement(&self) -> bool {
                self.watched.handle.take_acknowledgement()
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

        impl $class {
            fn end(&self, py: Python<'_>) -> PyResult<($rows, PyLoopReport)> {
                let mut paced = own(&self.paced)?;
                let paced = &mut **paced;
                let (report, flight) = py.detach(|| paced.end()).ok_or_else(finished_before)?;
                self.watched.watch().ended(flight);
                Ok((self.watched.rows(), report.into()))
            }
        }
    };
}

/// What a master's loop keeps from one tick for the next.
#[derive(Clone, Copy, Default)]
struct LastTick {
    /// In N; none of a trigger that is not felt.
    trigger_force: Option<f64>,
    /// Whether the device measures them; none before the first sample.
    has_velocity: Option<bool>,
    has_angular_velocity: Option<bool>,
}

/// Refuses a sample that has what the others have not, or lacks it: an estimate in between would jump.
fn steadily(name: &str, before: Option<bool>, is_given: bool) -> PyResult<()> {
    if before.is_none_or(|before| before == is_given) {
        return Ok(());
    }
    let now = if is_given { "given" } else { "missing" };
    let text = format!("{name} is {now}, and was not so far: must be in every sample or in none");
    Err(PyTypeError::new_err(text))
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct MasterLoop {
    paced: Mutex<Box<dyn MasterSteps>>,
    last: Mutex<LastTick>,
    pub(crate) watched: Watched<MasterRows>,
    kind: SideKind,
}

constructor!(MasterLoop, peer,
    [listen: Option<&str> = None, clutch: &str = "once", started_s: Option<f64> = None],
    |py, scene, run_id, how| {
        let simulated_clutch = match clutch {
            "once" => false,
            "auto" => true,
            _ => {
                let text = format!("clutch = {clutch:?}: must be \"once\" or \"auto\"");
                return Err(PyValueError::new_err(text));
            }
        };
        let place = Place::of_master(peer, listen, started_s, live_periods(&scene)?[0], how)?;
        let is_felt = scene.master.gripper.is_some();
        let (paced, watched) = if let Some(scene) = as_pose(&scene).map_err(refuse)? {
            let side = driven_master(scene, run_id, simulated_clutch).map_err(refuse)?.turning();
            prepare_master(py, side, place, is_felt)?
        } else {
            let side = driven_master::<N>(&scene, run_id, simulated_clutch).map_err(refuse)?;
            prepare_master(py, side, place, is_felt)?
        };
        let last = LastTick { trigger_force: is_felt.then_some(0.0), ..LastTick::default() };
        Ok(Self { paced: Mutex::new(paced), last: Mutex::new(last), watched, kind: scene.master.kind })
    }
);

#[pymethods]
impl MasterLoop {
    #[pyo3(signature = (position, velocity=None, clutch=None, *, fault=None, trigger=None, orientation=None,
        angular_velocity=None, buttons=None))]
    #[allow(clippy::too_many_arguments)] // those of a sample, by name
    fn step<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: Option<&Bound<'py, PyAny>>,
        clutch: Option<&Bound<'py, PyAny>>,
        fault: Option<&Bound<'py, PyAny>>,
        trigger: Option<&Bound<'py, PyAny>>,
        orientation: Option<&Bound<'py, PyAny>>,
        angular_velocity: Option<&Bound<'py, PyAny>>,
        buttons: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let fault: Option<PyBackedStr> = read_optional("fault", fault, TEXT)?;
        let mut trigger_force = {
            let mut last = locked(&self.last);
            // What a step that fails leaves is no force.
            last.trigger_force = last.trigger_force.map(|_| 0.0);
            if fault.is_none() {
                steadily("velocity", last.has_velocity, velocity.is_some())?;
                steadily("angular_velocity", last.has_angular_velocity, angular_velocity.is_some())?;
            }
            last.trigger_force
        };
        let read = MasterRead {
            position,
            velocity,
            clutch: read_optional("clutch", clutch, SWITCH)?,
            fault: fault.as_deref(),
            trigger: read_optional("trigger", trigger, NUMBER)?,
            orientation: read_optional("orientation", orientation, QUATERNION)?,
            angular_velocity: read_optional("angular_velocity", angular_velocity, VECTOR)?,
            buttons: read_optional("buttons", buttons, WORD)?,
        };
        let force = own(&self.paced)?.step(py, read, &mut trigger_force)?;
        let mut last = locked(&self.last);
        last.trigger_force = trigger_force;
        if fault.is_none() {
            last.has_velocity = Some(velocity.is_some());
            last.has_angular_velocity = Some(angular_velocity.is_some());
        }
        Ok(force)
    }

    #[getter]
    fn trigger_force(&self) -> Option<f64> {
        locked(&self.last).trigger_force
    }
}

#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SlaveLoop {
    paced: Mutex<Box<dyn SlaveSteps>>,
    /// After the last tick.
    beside: Mutex<Beside>,
    pub(crate) watched: Watched<SlaveRows>,
    kind: SideKind,
}

constructor!(SlaveLoop, listen, [], |py, scene, run_id, how| {
    let place = Place::of_slave(listen, live_periods(&scene)?[1], how)?;
    let (paced, watched): (Box<dyn SlaveSteps>, _) = if let Some(scene) = as_pose(&scene).map_err(refuse)? {
        let side = driven_slave(scene, run_id).map_err(refuse)?.turning();
        let (paced, watched) = prepare(py, side, place)?;
        (Box::new(paced), watched)
    } else {
        let side = driven_slave::<N>(&scene, run_id).map_err(refuse)?;
        let (paced, watched) = prepare(py, side, place)?;
        (Box::new(paced), watched)
    };
    let beside = Mutex::new(Beside::NOTHING);
    Ok(Self { paced: Mutex::new(paced), beside, watched, kind: scene.master.kind })
});

#[pymethods]
impl SlaveLoop {
    #[pyo3(signature = (position, velocity, force, *, fault=None, gripper=None, orientation=None,
        angular_velocity=None, torque=None))]
    #[allow(clippy::too_many_arguments)] // those of a sample, by name
    fn step<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: &Bound<'py, PyAny>,
        force: &Bound<'py, PyAny>,
        fault: Option<&Bound<'py, PyAny>>,
        gripper: Option<(f64, f64, f64, bool)>,
        orientation: Option<&Bound<'py, PyAny>>,
        angular_velocity: Option<&Bound<'py, PyAny>>,
        torque: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let gripper = gripper.map(|(position, velocity, force_n, holds_object)| GripperSample {
            position,
            velocity,
            force_n,
            holds_object,
        });
        let fault: Option<PyBackedStr> = read_optional("fault", fault, TEXT)?;
        let mut beside = Beside::NOTHING;
        let read = SlaveRead {
            position,
            velocity,
            force,
            fault: fault.as_deref(),
            gripper,
            orientation: read_optional("orientation", orientation, QUATERNION)?,
            angular_velocity: read_optional("angular_velocity", angular_velocity, VECTOR)?,
            torque: read_optional("torque", torque, VECTOR)?,
        };
        let order = own(&self.paced)?.step(py, read, &mut beside);
        *locked(&self.beside) = beside;
        order
    }

    #[getter]
    fn buttons(&self) -> Option<u32> {
        locked(&self.beside).buttons
    }

    #[getter]
    fn gripper_command(&self) -> Option<(f64, f64, f64)> {
        match locked(&self.beside).gripper {
            GripperOrder::Hold => None,
            GripperOrder::Move(GripperCommand { position, speed, force_n }) => {
                Some((position, speed, force_n))
            }
        }
    }
}

/// The loop of a side, and what watches it.
type Prepared<S> = (PacedLoop<S>, Watched<<<S as Side>::Record as Rowed>::Rows>);

/// Without the interpreter, as `start` of `LiveMaster`.
fn prepare<S>(py: Python<'_>, side: S, place: Place) -> PyResult<Prepared<S>>
where
    S: Side<Record: Rowed> + Send,
{
    py.detach(|| {
        let outputs = place.outputs()?;
        let control = (place.settings.role, place.control()?);
        let (paced, watch, reader) =
            paced_by_device(side, place.socket, place.settings, place.security, outputs)
                .map_err(not_begun)?;
        Ok((paced, Watched::new(watch, reader, control, true)?))
    })
}

/// With records of what the finger feels where it does.
fn prepare_master<R: MasterTurn, const N: usize>(
    py: Python<'_>,
    side: Timed<MasterSide<DrivenMaster<N>, N, R>>,
    place: Place,
    is_felt: bool,
) -> PyResult<(Box<dyn MasterSteps>, Watched<MasterRows>)>
where
    MasterRecord<N, R>: Rowed<Rows = MasterRows>,
    MasterRecord<N, Feeling<R>>: Rowed<Rows = MasterRows>,
{
    if is_felt {
        let (paced, watched) = prepare(py, side.feeling(), place)?;
        return Ok((Box::new(paced), watched));
    }
    let (paced, watched) = prepare(py, side, place)?;
    Ok((Box::new(paced), watched))
}

loop_methods!(MasterLoop, MasterRows);
loop_methods!(SlaveLoop, SlaveRows);
master_methods!(MasterLoop);
slave_methods!(SlaveLoop);
watch_methods!(MasterLoop);
watch_methods!(SlaveLoop);
