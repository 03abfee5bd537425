//! `haptether.bridge`: loops stepped by a Python driver, one call per tick.

use std::{
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard, TryLockError},
    time::Duration,
};

use haptether_bridge::{
    FaultText, GripperOrder, OperatorCommand, SideKind, SlaveOrder, Trace,
    coupling::{RotationState, measured, quat_wxyz},
    live::{DriverCall, DriverCalls, Ineffective, watch_driver},
    scene::{
        MasterDriverLoop, MasterInput, SlaveDriverLoop, SlaveInput, pace_scene_master, pace_scene_slave,
        scene_outline,
    },
    wire::{Padded, padded},
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
    bridge_trace::{MasterTrace, PyLoopReport, PyRecordingReport, SlaveTrace},
    live::{
        How, Place, Watched, constructor, finished_before, locked, master_methods, not_begun,
        realtime_settings, recorder_settings, refused, security, slave_methods, telemetry_settings,
        watch_methods,
    },
    scene::live_periods,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<MasterLoop>()?;
    module.add_class::<SlaveLoop>()
}

/// Further results of a slave's tick: gripper order and buttons of the master.
#[derive(Clone, Copy)]
struct Extras {
    gripper: GripperOrder,
    buttons: Option<u32>,
}

impl Extras {
    const NOTHING: Self = Self { gripper: GripperOrder::Hold, buttons: None };
}

/// Read a number for one axis, or a sequence with one number per axis.
fn read_axes<const N: usize>(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Padded> {
    if let Ok(values) = value.extract::<[f64; N]>() {
        return Ok(padded(&Axes::from(values)));
    }
    if N == 1
        && let Ok(value) = value.extract::<f64>()
    {
        return Ok(padded(&Axes::<1>::repeat(value)));
    }
    let of = if N == 1 { "a number".to_owned() } else { format!("a sequence of {N} numbers") };
    Err(PyTypeError::new_err(format!("{name} = {value}: must be {of}")))
}

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

/// Require a part that a pose driver must read at each tick.
fn read_part<T>(name: &str, value: Option<T>) -> PyResult<T> {
    let missing = || {
        PyTypeError::new_err(format!(
            "{name} is missing: a driver in a scene of kind \"pose\" reads it at each tick"
        ))
    };
    value.ok_or_else(missing)
}

fn read_vector(axes: usize, name: &str, value: &Bound<'_, PyAny>) -> PyResult<Padded> {
    of_axes!(axes, N => read_axes::<N>(name, value))
}

fn written<'py>(py: Python<'py>, values: &[f64]) -> PyResult<Bound<'py, PyTuple>> {
    PyTuple::new(py, values)
}

/// Wait for a loop in use by another thread: duration of each retry, and number of retries.
const WAIT: Duration = Duration::from_micros(100);
const MAX_WAITS: u32 = 1000;

/// A loop, and the call that its driver's thread is in.
struct Driven<T: ?Sized> {
    paced: Arc<Mutex<Box<T>>>,
    calls: Arc<DriverCalls>,
}

impl<T: ?Sized> Driven<T> {
    fn new(paced: Box<T>) -> Self {
        Self { paced: Arc::new(Mutex::new(paced)), calls: Arc::default() }
    }

    /// Lock the loop for the driver's thread. Waits without the GIL, so that no other thread waits for it.
    /// The watch of a driver that does not return holds the lock for a tick at a time.
    fn own(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, Box<T>>> {
        for _ in 0..MAX_WAITS {
            match self.paced.try_lock() {
                Ok(paced) => return Ok(paced),
                Err(TryLockError::WouldBlock) => py.detach(|| std::thread::sleep(WAIT)),
                Err(TryLockError::Poisoned(_)) => break,
            }
        }
        Err(PyRuntimeError::new_err("the loop is turned by another thread"))
    }
}

/// Methods shared by both classes, on their fields `driven` and `watched`.
macro_rules! loop_methods {
    ($class:ident) => {
        #[documented]
        #[pymethods]
        impl $class {
            #[pyo3(signature = (driver=None))]
            fn begin(&self, py: Python<'_>, driver: Option<&str>) -> PyResult<String> {
                let mut paced = self.driven.own(py)?;
                let paced = &mut **paced;
                // This locks memory, which takes long if much is mapped.
                let realtime = py.detach(|| paced.begin()).map_err(not_begun)?;
                if let Some(driver) = driver {
                    watch_driver(&self.driven.paced, &self.driven.calls, driver.to_owned())?;
                }
                Ok(realtime.to_string())
            }

            fn wait(&self, py: Python<'_>) -> PyResult<()> {
                self.driven.calls.enter(DriverCall::None);
                let mut paced = self.driven.own(py)?;
                let paced = &mut **paced;
                py.detach(|| paced.wait());
                Ok(())
            }

            #[pyo3(signature = (text=""))]
            fn fail(&self, py: Python<'_>, text: &str) -> PyResult<()> {
                let text = FaultText::new(text);
                self.driven.calls.enter(DriverCall::None);
                let mut paced = self.driven.own(py)?;
                let paced = &mut **paced;
                py.detach(|| paced.fail(&text));
                Ok(())
            }

            fn take_acknowledgement(&self) -> bool {
                // A turn of the driver begins here.
                self.driven.calls.enter(DriverCall::Read);
                self.watched.handle.take_acknowledgement()
            }

            fn announce_end(&self, py: Python<'_>) -> PyResult<()> {
                self.driven.calls.enter(DriverCall::None);
                let mut paced = self.driven.own(py)?;
                let paced = &mut **paced;
                py.detach(|| paced.announce_end());
                Ok(())
            }

            #[getter]
            fn finished(&self) -> bool {
                self.watched.handle.is_stopped()
            }

            #[getter]
            fn is_blocked(&self) -> bool {
                self.driven.calls.is_blocked()
            }

            #[getter]
            fn axes(&self) -> usize {
                self.axes
            }
        }

        impl $class {
            fn end(&self, py: Python<'_>) -> PyResult<(Trace, PyLoopReport)> {
                let mut paced = self.driven.own(py)?;
                let paced = &mut **paced;
                let (report, flight) = py.detach(|| paced.end()).ok_or_else(finished_before)?;
                self.watched.watch().ended(flight);
                Ok((py.detach(|| self.watched.trace()), report.into()))
            }
        }
    };
}

/// Clock of a device, from sample to sample.
#[derive(Clone, Copy, Default)]
struct DeviceClock {
    /// True if the samples have a time; none before the first.
    is_given: Option<bool>,
    last_s: f64,
}

impl DeviceClock {
    /// Refuse a time that is not finite, that goes back, or that other samples lack.
    fn take(&mut self, time_s: Option<f64>) -> PyResult<()> {
        require_steady("time_s", self.is_given, time_s.is_some())?;
        if let Some(time_s) = time_s {
            if !time_s.is_finite() {
                return Err(PyValueError::new_err(format!("time_s = {time_s}: must be finite, or None")));
            }
            if self.is_given.is_some() && time_s < self.last_s {
                let text = format!(
                    "time_s = {time_s} s: is before the last sample's, {} s: must not go back; report a fault where the \
                     device was restarted",
                    self.last_s
                );
                return Err(PyValueError::new_err(text));
            }
            self.last_s = time_s;
        }
        self.is_given = Some(time_s.is_some());
        Ok(())
    }
}

/// State of a master's loop that the next tick needs.
#[derive(Clone, Copy, Default)]
struct LastTick {
    /// Force in N; None for a trigger without feedback.
    trigger_force: Option<f64>,
    /// True if the device measures its velocity; None before the first sample.
    has_velocity: Option<bool>,
    has_angular_velocity: Option<bool>,
    clock: DeviceClock,
}

/// Require a field to be in every sample or in none, because an estimate in between would jump.
fn require_steady(name: &str, before: Option<bool>, is_given: bool) -> PyResult<()> {
    if before.is_none_or(|before| before == is_given) {
        return Ok(());
    }
    let now = if is_given { "given" } else { "missing" };
    let text = format!("{name} is {now}, and was not so far: must be in every sample or in none");
    Err(PyTypeError::new_err(text))
}

#[documented]
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct MasterLoop {
    driven: Driven<dyn MasterDriverLoop>,
    last: Mutex<LastTick>,
    pub(crate) watched: Watched,
    kind: SideKind,
    axes: usize,
}

constructor!(MasterLoop, peer,
    [listen: Option<&str> = None, clutch: &str = "once", started_s: Option<f64> = None],
    |py, scene, outline, run_id, how| {
        let simulated_clutch = match clutch {
            "once" => false,
            "auto" => true,
            _ => {
                let text = format!("clutch = {clutch:?}: must be \"once\" or \"auto\"");
                return Err(PyValueError::new_err(text));
            }
        };
        let place = Place::of_master(peer, listen, started_s, live_periods(&outline)?[0], how)?;
        // Without the GIL, as in `start` of `LiveMaster`.
        let (paced, watched) = py.detach(|| {
            let (parts, control) = place.open()?;
            let (paced, watch, records) =
                pace_scene_master(scene, run_id, simulated_clutch, parts).map_err(refused)?;
            PyResult::Ok((paced, Watched::new(watch, records, control, true)?))
        })?;
        let trigger_force = outline.feels_trigger.then_some(0.0);
        let last = LastTick { trigger_force, ..LastTick::default() };
        let (kind, axes) = (outline.kind, outline.axes);
        Ok(Self { driven: Driven::new(paced), last: Mutex::new(last), watched, kind, axes })
    }
);

#[documented]
#[pymethods]
impl MasterLoop {
    #[pyo3(signature = (position, velocity=None, clutch=None, *, fault=None, trigger=None, orientation=None,
        angular_velocity=None, buttons=None, time_s=None))]
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
        time_s: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let fault: Option<PyBackedStr> = read_optional("fault", fault, TEXT)?;
        let time_s: Option<f64> = read_optional("time_s", time_s, NUMBER)?;
        let mut trigger_force = {
            let mut last = locked(&self.last);
            // A failed step must leave zero force.
            last.trigger_force = last.trigger_force.map(|_| 0.0);
            if fault.is_none() {
                require_steady("velocity", last.has_velocity, velocity.is_some())?;
                require_steady("angular_velocity", last.has_angular_velocity, angular_velocity.is_some())?;
                last.clock.take(time_s)?;
            } else {
                // A device that was restarted has another clock.
                last.clock = DeviceClock::default();
            }
            last.trigger_force
        };
        let turns = self.kind == SideKind::Pose;
        let orientation: Option<[f64; 4]> = read_optional("orientation", orientation, QUATERNION)?;
        let rate: Option<[f64; 3]> = read_optional("angular_velocity", angular_velocity, VECTOR)?;
        let input = MasterInput {
            position: read_vector(self.axes, "position", position)?,
            velocity: velocity.map(|velocity| read_vector(self.axes, "velocity", velocity)).transpose()?,
            clutch: read_optional("clutch", clutch, SWITCH)?,
            fault: fault.as_deref(),
            trigger: read_optional("trigger", trigger, NUMBER)?,
            rotation: if turns {
                let orientation = measured(read_part("orientation", orientation)?);
                Some(RotationSample { orientation, angular_velocity: rate.map(Axes::from) })
            } else {
                None
            },
            buttons: read_optional("buttons", buttons, WORD)?,
            time_s,
        };
        let output = self.driven.own(py)?.step(&input);
        self.driven.calls.enter(DriverCall::Write);
        let force = match &output {
            None => None,
            Some(output) => {
                trigger_force = output.trigger_force;
                let force = written(py, &output.force.as_slice()[..self.axes])?;
                Some(match &output.torque {
                    Some(torque) => PyTuple::new(py, [force, written(py, torque.as_slice())?])?,
                    None => force,
                })
            }
        };
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

#[documented]
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct SlaveLoop {
    driven: Driven<dyn SlaveDriverLoop>,
    /// After the last tick.
    extras: Mutex<Extras>,
    clock: Mutex<DeviceClock>,
    pub(crate) watched: Watched,
    kind: SideKind,
    axes: usize,
}

constructor!(SlaveLoop, listen, [], |py, scene, outline, run_id, how| {
    let place = Place::of_slave(listen, live_periods(&outline)?[1], how)?;
    let (paced, watched) = py.detach(|| {
        let (parts, control) = place.open()?;
        let (paced, watch, records) = pace_scene_slave(scene, run_id, parts).map_err(refused)?;
        PyResult::Ok((paced, Watched::new(watch, records, control, true)?))
    })?;
    let extras = Mutex::new(Extras::NOTHING);
    let clock = Mutex::default();
    Ok(Self { driven: Driven::new(paced), extras, clock, watched, kind: outline.kind, axes: outline.axes })
});

#[documented]
#[pymethods]
impl SlaveLoop {
    #[pyo3(signature = (position, velocity, force, *, fault=None, gripper=None, orientation=None,
        angular_velocity=None, torque=None, time_s=None))]
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
        time_s: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Option<Bound<'py, PyTuple>>> {
        let gripper = gripper.map(|(position, velocity, force_n, holds_object)| GripperSample {
            position,
            velocity,
            force_n,
            holds_object,
        });
        // A failed step must leave no gripper command.
        *locked(&self.extras) = Extras::NOTHING;
        let fault: Option<PyBackedStr> = read_optional("fault", fault, TEXT)?;
        let orientation: Option<[f64; 4]> = read_optional("orientation", orientation, QUATERNION)?;
        let rate: Option<[f64; 3]> = read_optional("angular_velocity", angular_velocity, VECTOR)?;
        let torque: Option<[f64; 3]> = read_optional("torque", torque, VECTOR)?;
        let time_s: Option<f64> = read_optional("time_s", time_s, NUMBER)?;
        if fault.is_none() {
            locked(&self.clock).take(time_s)?;
        } else {
            *locked(&self.clock) = DeviceClock::default();
        }
        let input = SlaveInput {
            position: read_vector(self.axes, "position", position)?,
            velocity: read_vector(self.axes, "velocity", velocity)?,
            force: read_vector(self.axes, "force", force)?,
            fault: fault.as_deref(),
            gripper,
            rotation: if self.kind == SideKind::Pose {
                Some(RotationState {
                    orientation: measured(read_part("orientation", orientation)?),
                    angular_velocity: Axes::from(read_part("angular_velocity", rate)?),
                    torque: Axes::from(read_part("torque", torque)?),
                })
            } else {
                None
            },
            time_s,
        };
        let output = self.driven.own(py)?.step(&input);
        self.driven.calls.enter(DriverCall::Write);
        *locked(&self.extras) = output
            .as_ref()
            .map_or(Extras::NOTHING, |output| Extras { gripper: output.gripper, buttons: output.buttons });
        let Some(output) = output else { return Ok(None) };
        let out = |values: &Padded| written(py, &values.as_slice()[..self.axes]);
        let named = match output.order {
            SlaveOrder::Wait => (pyo3::intern!(py, "wait"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Stop => (pyo3::intern!(py, "stop"), PyTuple::empty(py), PyTuple::empty(py)),
            SlaveOrder::Exert { force, torque, .. } => {
                let (name, force) = (pyo3::intern!(py, "exert"), out(&force)?);
                return match torque {
                    Some(torque) => {
                        (name, force, written(py, torque.as_slice())?).into_pyobject(py).map(Some)
                    }
                    None => (name, force).into_pyobject(py).map(Some),
                };
            }
            SlaveOrder::Move { position, velocity, rotation: None } => {
                (pyo3::intern!(py, "move"), out(&position)?, out(&velocity)?)
            }
            SlaveOrder::Move { position, velocity, rotation: Some((orientation, rate)) } => {
                let turn = (PyTuple::new(py, quat_wxyz(&orientation))?, written(py, rate.as_slice())?);
                let named = (pyo3::intern!(py, "move"), out(&position)?, out(&velocity)?);
                return (named.0, named.1, named.2, turn.0, turn.1).into_pyobject(py).map(Some);
            }
        };
        let named: (&Bound<'py, PyString>, _, _) = named;
        named.into_pyobject(py).map(Some)
    }

    #[getter]
    fn buttons(&self) -> Option<u32> {
        locked(&self.extras).buttons
    }

    #[getter]
    fn gripper_command(&self) -> Option<(f64, f64, f64)> {
        match locked(&self.extras).gripper {
            GripperOrder::Hold => None,
            GripperOrder::Move(GripperCommand { position, speed, force_n }) => {
                Some((position, speed, force_n))
            }
        }
    }
}

loop_methods!(MasterLoop);
loop_methods!(SlaveLoop);
master_methods!(MasterLoop);
slave_methods!(SlaveLoop);
watch_methods!(MasterLoop);
watch_methods!(SlaveLoop);
