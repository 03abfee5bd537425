//! `haptether.bridge`: settings of both sides, and the runner in virtual time.

use std::ops::ControlFlow;

use haptether_bridge::{
    Clutch, Event, Exchange, LadderSettings, LadderState, MasterEndpoint, MasterSettings, MasterSide, Reason,
    Side, SlaveEndpoint, SlaveSettings, SlaveSide, VirtualSettings, coupling::CommandBounds,
    live::LoopReport, run_virtual, session::Rejections,
};
use haptether_master::{Hand, SimulatedMaster};
use haptether_safety::LimiterSettings;
use haptether_slave::SimulatedSlave;
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    axes::refuse,
    bridge_trace::{MasterRows, MasterTrace, PyLoopReport, SlaveRows, SlaveTrace},
    local::{MAX_TICKS, PyArm, PyHand, PyHapticDevice, PyPusher, PyWall},
    netsim::link_settings,
    safety::{PyEstimatorKind, PyLimiterSettings, PySafetySettings},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLadderSettings>()?;
    module.add_class::<PyMasterSettings>()?;
    module.add_class::<PySlaveSettings>()?;
    module.add_function(wrap_pyfunction!(run_bridge, module)?)?;
    module.add_function(wrap_pyfunction!(ladder_state_name, module)?)?;
    module.add_function(wrap_pyfunction!(ladder_reason, module)?)
}

/// A positive time in s as ns.
pub(crate) fn nanoseconds(key: &str, seconds: f64) -> PyResult<u64> {
    if seconds.is_finite() && (0.0..=1e9).contains(&seconds) {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
        return Ok((seconds * 1e9).round() as u64);
    }
    Err(PyValueError::new_err(format!("{key} = {seconds}: must be between 0 and 1e9 s")))
}

/// The text of a reason's code.
#[pyfunction]
fn ladder_reason(code: u8) -> PyResult<&'static str> {
    Reason::from_code(code)
        .map(Reason::text)
        .ok_or_else(|| PyValueError::new_err(format!("reason {code}: must be 1 to {}", Reason::ALL.len())))
}

/// The name of a ladder state's code.
#[pyfunction]
fn ladder_state_name(code: u8) -> PyResult<&'static str> {
    LadderState::from_code(code)
        .map(LadderState::name)
        .ok_or_else(|| PyValueError::new_err(format!("state {code}: must be 0 to 6")))
}

pub(crate) type SimulatedMasterSide = MasterSide<SimulatedMaster<1>, 1>;
pub(crate) type SimulatedSlaveSide = SlaveSide<SimulatedSlave<1>, 1>;

/// A name, or press and release times in s.
#[derive(FromPyObject)]
enum PyClutch {
    Named(String),
    Times(Vec<(f64, f64)>),
}

impl PyClutch {
    fn build(self, reaction_s: f64) -> PyResult<Clutch> {
        Ok(match self {
            Self::Named(name) => match name.as_str() {
                "once" => Clutch::Once,
                "auto" => Clutch::Auto { reaction_ns: nanoseconds("clutch_reaction_s", reaction_s)? },
                _ => {
                    let text = format!("clutch = {name:?}: must be \"once\", \"auto\" or times in s");
                    return Err(PyValueError::new_err(text));
                }
            },
            Self::Times(times) => Clutch::Schedule(
                times
                    .into_iter()
                    .map(|(press, release)| {
                        Ok((nanoseconds("clutch", press)?, nanoseconds("clutch", release)?))
                    })
                    .collect::<PyResult<_>>()?,
            ),
        })
    }
}

#[pyclass(name = "LadderSettings", module = "haptether.bridge", frozen)]
#[derive(Clone, Copy)]
pub(crate) struct PyLadderSettings {
    inner: LadderSettings,
}

#[pymethods]
impl PyLadderSettings {
    #[new]
    #[pyo3(signature = (*, stale_after_s=0.005, hold_after_s=0.02, stop_after_s=0.2, extrapolate_s=0.015,
        fade_out_s=0.075, fade_in_s=0.2))]
    fn new(
        stale_after_s: f64,
        hold_after_s: f64,
        stop_after_s: f64,
        extrapolate_s: f64,
        fade_out_s: f64,
        fade_in_s: f64,
    ) -> PyResult<Self> {
        let inner = LadderSettings {
            stale_after_ns: nanoseconds("stale_after_s", stale_after_s)?,
            hold_after_ns: nanoseconds("hold_after_s", hold_after_s)?,
            stop_after_ns: nanoseconds("stop_after_s", stop_after_s)?,
            extrapolate_ns: nanoseconds("extrapolate_s", extrapolate_s)?,
            fade_out_ns: nanoseconds("fade_out_s", fade_out_s)?,
            fade_in_ns: nanoseconds("fade_in_s", fade_in_s)?,
            ..LadderSettings::default()
        };
        inner.check().map_err(refuse)?;
        Ok(Self { inner })
    }
}

#[pyclass(name = "MasterSettings", module = "haptether.bridge", frozen)]
#[derive(Clone)]
pub(crate) struct PyMasterSettings {
    device: PyHapticDevice,
    hand: Hand<1>,
    clutch: Clutch,
    pub(crate) endpoint: MasterSettings<1>,
}

#[pymethods]
impl PyMasterSettings {
    #[new]
    #[pyo3(signature = (device, hand, *, safety=None, estimator=None, limiter=None, force_scale=1.0,
        period_s=1e-3, clutch=None, clutch_reaction_s=0.5, ladder=None))]
    fn new(
        device: &PyHapticDevice,
        hand: &PyHand,
        safety: Option<&PySafetySettings>,
        estimator: Option<&PyEstimatorKind>,
        limiter: Option<&PyLimiterSettings>,
        force_scale: f64,
        period_s: f64,
        clutch: Option<PyClutch>,
        clutch_reaction_s: f64,
        ladder: Option<&PyLadderSettings>,
    ) -> PyResult<Self> {
        let settings = Self {
            device: *device,
            hand: hand.inner.clone(),
            clutch: clutch.unwrap_or(PyClutch::Named("once".into())).build(clutch_reaction_s)?,
            endpoint: MasterSettings {
                period_ns: nanoseconds("period_s", period_s)?,
                run_id: 0,
                device: device.model()?,
                estimator: estimator.map_or_else(|| device.estimator(), |kind| kind.inner),
                safety: safety.map(|safety| safety.inner).unwrap_or_default(),
                limiter: limiter.map_or_else(LimiterSettings::default, |limiter| limiter.inner),
                force_scale,
                ladder: ladder.map(|ladder| ladder.inner).unwrap_or_default(),
            },
        };
        settings.side(0)?;
        Ok(settings)
    }
}

impl PyMasterSettings {
    pub(crate) fn side(&self, session: u64) -> PyResult<SimulatedMasterSide> {
        let endpoint =
            MasterEndpoint::new(&MasterSettings { run_id: session, ..self.endpoint }).map_err(refuse)?;
        let mut plant = SimulatedMaster::new(self.device.inner, self.hand.clone(), 0).map_err(refuse)?;
        plant.set_waiting(true);
        MasterSide::new(plant, endpoint, self.clutch.clone()).map_err(refuse)
    }
}

#[pyclass(name = "SlaveSettings", module = "haptether.bridge", frozen)]
#[derive(Clone)]
pub(crate) struct PySlaveSettings {
    arm: PyArm,
    wall: PyWall,
    pusher: Option<PyPusher>,
    position: f64,
    pub(crate) endpoint: SlaveSettings,
}

#[pymethods]
impl PySlaveSettings {
    #[new]
    #[pyo3(signature = (arm, wall, *, pusher=None, position=0.0, position_scale=1.0, period_s=1e-3,
        command_speed=3.0, command_reach=None, ladder=None))]
    fn new(
        arm: &PyArm,
        wall: &PyWall,
        pusher: Option<&PyPusher>,
        position: f64,
        position_scale: f64,
        period_s: f64,
        command_speed: f64,
        command_reach: Option<f64>,
        ladder: Option<&PyLadderSettings>,
    ) -> PyResult<Self> {
        let settings = Self {
            arm: *arm,
            wall: *wall,
            pusher: pusher.cloned(),
            position,
            endpoint: SlaveSettings {
                period_ns: nanoseconds("period_s", period_s)?,
                run_id: 0,
                position_scale,
                bounds: CommandBounds { speed: command_speed, reach: command_reach.unwrap_or(f64::INFINITY) },
                ladder: ladder.map(|ladder| ladder.inner).unwrap_or_default(),
            },
        };
        settings.side(0)?;
        Ok(settings)
    }
}

impl PySlaveSettings {
    pub(crate) fn side(&self, session: u64) -> PyResult<SimulatedSlaveSide> {
        let endpoint =
            SlaveEndpoint::new(&SlaveSettings { run_id: session, ..self.endpoint }).map_err(refuse)?;
        let pusher = self.pusher.as_ref().map(|pusher| pusher.inner.clone());
        let plant =
            SimulatedSlave::new(self.arm.inner, self.wall.inner, pusher, self.position, 0).map_err(refuse)?;
        Ok(SlaveSide::new(plant, endpoint))
    }
}

/// Runs both sides in virtual time.
#[pyfunction]
#[pyo3(signature = (master, slave, *, forward, backward, duration_s, seed=0, secure=false))]
fn run_bridge(
    py: Python<'_>,
    master: &PyMasterSettings,
    slave: &PySlaveSettings,
    forward: &str,
    backward: &str,
    duration_s: f64,
    seed: u64,
    secure: bool,
) -> PyResult<(MasterTrace, SlaveTrace, PyLoopReport, PyLoopReport)> {
    let period_ns = master.endpoint.period_ns;
    if slave.endpoint.period_ns != period_ns {
        return Err(PyValueError::new_err("period_s: master and slave must have the same in virtual time"));
    }
    let ticks = nanoseconds("duration_s", duration_s)? / period_ns;
    if ticks > MAX_TICKS as u64 {
        let text = format!("duration_s = {duration_s}: {ticks} ticks, must be at most {MAX_TICKS}");
        return Err(PyValueError::new_err(text));
    }
    let settings = VirtualSettings {
        period_ns,
        slave_period_ns: period_ns,
        ticks,
        forward: link_settings(forward)?,
        backward: link_settings(backward)?,
        seed,
        secure,
        master_clock: None,
        slave_clock: None,
    };
    let (mut master, mut slave) = (master.side(1)?, slave.side(2)?);
    let (mut master_records, mut slave_records) = (Vec::new(), Vec::new());
    let counted = py.detach(|| {
        run_virtual(&settings, &mut master, &mut slave, |event, _| {
            match event {
                Event::Master(record) => master_records.push(record),
                Event::Slave(record) => slave_records.push(record),
            }
            ControlFlow::Continue(())
        })
    });
    let [at_master, at_slave] = counted.map_err(refuse)?.rejections;
    let end_ns = settings.ticks.saturating_sub(1) * settings.period_ns;
    let report = |exchange: &Exchange<1>,
                  rejections: Rejections,
                  mut states: Box<dyn Iterator<Item = (u64, LadderState)> + '_>| {
        let (counts, path) = (exchange.counts(), exchange.link().path().report(end_ns));
        let engaged = states.find(|(_, state)| state.is_coupled());
        LoopReport {
            ticks: settings.ticks,
            link: counts.link.with(&rejections),
            path,
            secure,
            holds: counts.holds,
            limited: counts.limited,
            rejections,
            engaged_ns: engaged.map_or(u64::MAX, |(time_ns, _)| time_ns),
            ..LoopReport::default()
        }
    };
    let master_report = report(
        master.exchange(),
        at_master,
        Box::new(master_records.iter().map(|record| (record.time_ns, record.state))),
    );
    let slave_report = report(
        slave.exchange(),
        at_slave,
        Box::new(slave_records.iter().map(|record| (record.time_ns, record.state))),
    );
    Ok((
        MasterTrace { rows: MasterRows::One(master_records) },
        SlaveTrace { rows: SlaveRows::One(slave_records) },
        master_report.into(),
        slave_report.into(),
    ))
}
