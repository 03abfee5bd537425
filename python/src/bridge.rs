//! `haptether.bridge`: both runners.

use std::{
    ops::ControlFlow,
    path::PathBuf,
    sync::{Mutex, PoisonError},
};

use haptether_bridge::{
    Act, Clutch, Event, LadderSettings, LadderState, MasterEndpoint, MasterRecord, MasterSettings,
    MasterSide, PathReport, Reason, Side, SideCounts, SlaveEndpoint, SlaveRecord, SlaveSettings, SlaveSide,
    VirtualSettings,
    coupling::CommandBounds,
    live::{
        LiveRun, LiveSettings, LoopReport, PeerAddress, PeerSocket, RealtimeSettings, Security,
        SecurityEvent, StartError, run_live,
    },
    recorder::{Recorded, Recorder, RecorderSettings},
    run_virtual,
    session::{PreSharedKey, Rejections},
    wire::Role,
};
use haptether_master::{Hand, SimulatedMaster};
use haptether_safety::LimiterSettings;
use haptether_slave::SimulatedSlave;
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError, PyValueError},
    prelude::*,
};

use crate::{
    axes::refuse,
    bridge_trace::{MasterTrace, PyLoopReport, PyRecordingReport, SlaveTrace},
    live_options::{realtime_settings, recorder_settings},
    local::{MOST_TICKS, PyArm, PyHand, PyHapticDevice, PyPusher, PyWall},
    netsim::{address, link_settings},
    safety::{PyEstimatorKind, PyLimiterSettings, PySafetySettings},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLadderSettings>()?;
    module.add_class::<PyMasterSettings>()?;
    module.add_class::<PySlaveSettings>()?;
    module.add_class::<LiveMaster>()?;
    module.add_class::<LiveSlave>()?;
    module.add_function(wrap_pyfunction!(run_bridge, module)?)?;
    module.add_function(wrap_pyfunction!(ladder_state_name, module)?)?;
    module.add_function(wrap_pyfunction!(ladder_reason, module)?)
}

/// A positive time in s as ns.
fn nanoseconds(key: &str, seconds: f64) -> PyResult<u64> {
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

type SimulatedMasterSide = MasterSide<SimulatedMaster<1>, 1>;
type SimulatedSlaveSide = SlaveSide<SimulatedSlave<1>, 1>;

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
    endpoint: MasterSettings<1>,
}

#[pymethods]
impl PyMasterSettings {
    #[new]
    #[pyo3(signature = (device, hand, *, safety=None, estimator=None, limiter=None, force_scale=1.0,
        period_s=1e-3, clutch=None, clutch_reaction_s=0.5, ladder=None))]
    #[allow(clippy::too_many_arguments)] // they have names in Python
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
                session: 0,
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
    fn side(&self, session: u64) -> PyResult<SimulatedMasterSide> {
        let endpoint = MasterEndpoint::new(&MasterSettings { session, ..self.endpoint }).map_err(refuse)?;
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
    endpoint: SlaveSettings,
}

#[pymethods]
impl PySlaveSettings {
    #[new]
    #[pyo3(signature = (arm, wall, *, pusher=None, position=0.0, position_scale=1.0, period_s=1e-3,
        command_speed=3.0, command_reach=None, ladder=None))]
    #[allow(clippy::too_many_arguments)] // they have names in Python
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
                session: 0,
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
    fn side(&self, session: u64) -> PyResult<SimulatedSlaveSide> {
        let endpoint = SlaveEndpoint::new(&SlaveSettings { session, ..self.endpoint }).map_err(refuse)?;
        let pusher = self.pusher.as_ref().map(|pusher| pusher.inner.clone());
        let plant =
            SimulatedSlave::new(self.arm.inner, self.wall.inner, pusher, self.position, 0).map_err(refuse)?;
        Ok(SlaveSide::new(plant, endpoint))
    }
}

/// Runs both sides in virtual time.
#[pyfunction]
#[pyo3(signature = (master, slave, *, forward, backward, duration_s, seed=0, secure=false))]
#[allow(clippy::too_many_arguments)] // they have names in Python
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
    if ticks > MOST_TICKS as u64 {
        let text = format!("duration_s = {duration_s}: {ticks} ticks, must be at most {MOST_TICKS}");
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
    let report = |(counts, path): (SideCounts, PathReport),
                  rejections: Rejections,
                  mut states: Box<dyn Iterator<Item = (u64, LadderState)> + '_>| {
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
        (master.counts(), master.path(end_ns)),
        at_master,
        Box::new(master_records.iter().map(|record| (record.time_ns, record.state))),
    );
    let slave_report = report(
        (slave.counts(), slave.path(end_ns)),
        at_slave,
        Box::new(slave_records.iter().map(|record| (record.time_ns, record.state))),
    );
    Ok((
        MasterTrace { records: master_records },
        SlaveTrace { records: slave_records },
        master_report.into(),
        slave_report.into(),
    ))
}

/// How much of a live run is kept at most, in s: an hour.
const MOST_KEPT_S: f64 = 3600.0;

/// A socket, a loop on its own thread, and its newest records.
struct Live<R> {
    /// Never contended: the mutex only tells Python that the reader of the ring may move between threads.
    run: Mutex<LiveRun<R>>,
    records: Vec<R>,
    /// So many of the newest stay, up to twice as many are held.
    kept: usize,
}

/// How frames travel: a key, or the explicit wish to go without.
fn security(key: Option<&[u8]>, insecure: bool) -> PyResult<Security> {
    match (key, insecure) {
        (Some(key), false) => {
            let bytes = key.try_into().map_err(|_| {
                PyValueError::new_err(format!("key: {} bytes, must be the 32 of read_key", key.len()))
            })?;
            Ok(Security::Secure(PreSharedKey::new(bytes)))
        }
        (None, true) => Ok(Security::Insecure),
        (Some(_), true) => Err(PyValueError::new_err("key, insecure: give one of the two")),
        (None, false) => Err(PyValueError::new_err(
            "key: is missing: read_key() reads one, insecure=True goes without, in the clear",
        )),
    }
}

/// Where a side is and whom it talks to.
struct Place<'a> {
    role: Role,
    local: &'a str,
    peer: Option<&'a str>,
}

impl<R: Recorded> Live<R> {
    #[allow(clippy::too_many_arguments)] // they have names in Python
    fn start<S: Side<Record = R> + Send + 'static>(
        side: S,
        Place { role, local, peer }: Place<'_>,
        security: Security,
        period_ns: u64,
        [duration_s, patience_s]: [Option<f64>; 2],
        keep_s: f64,
        realtime: RealtimeSettings,
        record: Option<RecorderSettings>,
    ) -> PyResult<Self> {
        if !(keep_s > 0.0 && keep_s <= MOST_KEPT_S) {
            let text = format!("keep_s = {keep_s}: must be above 0 and at most {MOST_KEPT_S} s");
            return Err(PyValueError::new_err(text));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // in range, as checked
        let kept = (keep_s * 1e9 / period_ns as f64).ceil() as usize;
        let peer = match peer {
            Some(peer) => PeerAddress::Known(address("peer", peer)?),
            None => PeerAddress::Learned,
        };
        let local = address("listen", local)?;
        let cannot = |error: std::io::Error| PyOSError::new_err(format!("cannot listen on {local}: {error}"));
        let socket = PeerSocket::bind(local, peer).map_err(cannot)?;
        let settings = LiveSettings {
            role,
            period_ns,
            duration_ns: duration_s.map(|time| nanoseconds("duration_s", time)).transpose()?,
            patience_ns: patience_s.map(|time| nanoseconds("patience_s", time)).transpose()?,
            ring: 1 << 16,
            realtime,
        };
        // After the socket, so that a run that cannot be replaces no file.
        let recorder = record
            .map(|to| {
                let path = to.path.display();
                Recorder::begin(&to).map_err(|error| PyOSError::new_err(format!("record = {path}: {error}")))
            })
            .transpose()?;
        let run = run_live(side, socket, settings, security, recorder).map_err(|error| match error {
            StartError::Session(error) => PyValueError::new_err(error.to_string()),
            StartError::System(error) => PyOSError::new_err(error.to_string()),
        })?;
        Ok(Self { run: Mutex::new(run), records: Vec::new(), kept })
    }

    fn run(&mut self) -> &mut LiveRun<R> {
        self.run.get_mut().unwrap_or_else(PoisonError::into_inner)
    }

    fn act(&mut self, act: Act) -> PyResult<()> {
        act.check::<1>().map_err(refuse)?;
        let run = self.run();
        let full =
            |_| PyRuntimeError::new_err("the loop has not done what it was told before: is it running?");
        if run.is_finished() {
            Err(PyRuntimeError::new_err("the loop has ended"))
        } else {
            run.act(act).map_err(full)
        }
    }

    fn poll(&mut self) -> usize {
        let Self { run, records, kept } = self;
        let run = run.get_mut().unwrap_or_else(PoisonError::into_inner);
        run.drain(|record| records.push(record));
        // A run without an end must not fill the memory: the older half goes.
        if records.len() > 2 * *kept {
            records.drain(..records.len() - *kept);
        }
        records.len()
    }

    fn events(&mut self) -> Vec<String> {
        let mut events = Vec::new();
        self.run().drain_events(|event: SecurityEvent| events.push(event.to_string()));
        events
    }

    fn finish(&mut self, py: Python<'_>) -> PyResult<(Vec<R>, PyLoopReport)> {
        let report = {
            let run = self.run();
            py.detach(|| run.join())
        };
        self.poll();
        let report =
            report.ok_or_else(|| PyRuntimeError::new_err("the loop was finished before, or it panicked"))?;
        Ok((std::mem::take(&mut self.records), report.into()))
    }
}

/// What the classes of both sides share.
macro_rules! live_methods {
    ($class:ident) => {
        #[pymethods]
        impl $class {
            fn poll(&mut self) -> usize {
                self.live.poll()
            }

            #[getter]
            fn address(&mut self) -> String {
                self.live.run().address().to_string()
            }

            #[getter]
            fn state(&mut self) -> &'static str {
                self.live.run().state().name()
            }

            #[getter]
            fn ticks(&mut self) -> u64 {
                self.live.run().ticks()
            }

            #[getter]
            fn finished(&mut self) -> bool {
                self.live.run().is_finished()
            }

            #[getter]
            fn realtime(&mut self) -> String {
                self.live.run().realtime().to_string()
            }

            #[getter]
            fn recording(&mut self) -> Option<PyRecordingReport> {
                self.live.run().recording().map(Into::into)
            }

            fn stop(&mut self) {
                self.live.run().stop();
            }

            fn security_events(&mut self) -> Vec<String> {
                self.live.events()
            }

            fn flight(&mut self) -> Option<String> {
                self.live.run().flight()
            }

            fn acknowledge(&mut self) -> PyResult<()> {
                self.live.act(Act::Acknowledge)
            }
        }
    };
}

#[pyclass(module = "haptether.bridge")]
pub(crate) struct LiveMaster {
    live: Live<MasterRecord<1>>,
}

#[pymethods]
impl LiveMaster {
    #[new]
    #[pyo3(signature = (settings, *, peer, session, key=None, insecure=false, listen=None, duration_s=None,
        patience_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    #[allow(clippy::too_many_arguments)] // they have names in Python
    fn new(
        settings: &PyMasterSettings,
        peer: &str,
        session: u64,
        key: Option<&[u8]>,
        insecure: bool,
        listen: Option<&str>,
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
        let (side, period_ns) = (settings.side(session)?, settings.endpoint.period_ns);
        let is_v6 = address("peer", peer)?.is_ipv6();
        let listen = listen.unwrap_or(if is_v6 { "[::]:0" } else { "0.0.0.0:0" });
        if address("listen", listen)?.is_ipv6() != is_v6 {
            let text =
                format!("listen = {listen:?}: must be of the same kind, IPv4 or IPv6, as peer = {peer:?}");
            return Err(PyValueError::new_err(text));
        }
        let place = Place { role: Role::Master, local: listen, peer: Some(peer) };
        let security = security(key, insecure)?;
        let ends = [duration_s, patience_s];
        Ok(Self { live: Live::start(side, place, security, period_ns, ends, keep_s, realtime, record)? })
    }

    fn press_clutch(&mut self) {
        self.live.run().press_clutch();
    }

    fn set_force_scale(&mut self, scale: f64) -> PyResult<()> {
        self.live.act(Act::ForceScale(scale))
    }

    fn finish(&mut self, py: Python<'_>) -> PyResult<(MasterTrace, PyLoopReport)> {
        let (records, report) = self.live.finish(py)?;
        Ok((MasterTrace { records }, report))
    }
}

#[pyclass(module = "haptether.bridge")]
pub(crate) struct LiveSlave {
    live: Live<SlaveRecord<1>>,
}

#[pymethods]
impl LiveSlave {
    #[new]
    #[pyo3(signature = (settings, *, listen, session, key=None, insecure=false, duration_s=None,
        patience_s=None, keep_s=600.0, realtime="auto", priority=80, cpu=None, record=None,
        min_free_bytes=1_000_000_000))]
    #[allow(clippy::too_many_arguments)] // they have names in Python
    fn new(
        settings: &PySlaveSettings,
        listen: &str,
        session: u64,
        key: Option<&[u8]>,
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
        let (side, period_ns) = (settings.side(session)?, settings.endpoint.period_ns);
        let place = Place { role: Role::Slave, local: listen, peer: None };
        let security = security(key, insecure)?;
        let ends = [duration_s, patience_s];
        Ok(Self { live: Live::start(side, place, security, period_ns, ends, keep_s, realtime, record)? })
    }

    fn allow_takeover(&mut self) {
        self.live.run().allow_takeover();
    }

    fn set_position_scale(&mut self, scale: f64) -> PyResult<()> {
        self.live.act(Act::PositionScale(scale))
    }

    fn finish(&mut self, py: Python<'_>) -> PyResult<(SlaveTrace, PyLoopReport)> {
        let (records, report) = self.live.finish(py)?;
        Ok((SlaveTrace { records }, report))
    }
}

live_methods!(LiveMaster);
live_methods!(LiveSlave);
