//! Shared parts of the live classes: settings, observation and commands of a loop.

use std::{
    net::SocketAddr,
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
};

use haptether_bridge::{
    OperatorCommand, Trace,
    live::{
        CommandError, Control, ControlSocket, LiveHandle, LiveSettings, LiveWatch, PeerAddress, PeerSocket,
        RealtimeDemand, RealtimeSettings, Security, StartError, local_address, now_ns,
    },
    recorder::{RecorderSettings, SecurityMark},
    scene::{KeptRecords, LiveError, LiveParts},
    session::{KeyError, PreSharedKey},
    telemetry::TelemetrySettings,
    wire::Role,
};
use pyo3::{
    exceptions::{PyMemoryError, PyOSError, PyRuntimeError, PyValueError},
    prelude::*,
    types::{PyByteArray, PyBytes},
};

use crate::{
    axes::refuse,
    bridge::nanoseconds,
    netsim::{addresses, first_of, peer_addresses},
    reserve,
};

/// Longest history kept of a live run in s: one hour.
const MAX_KEPT_S: f64 = 3600.0;

/// Read the shared key from a `bytearray`, which its owner can wipe, or from `bytes`.
fn shared_key(key: &Bound<'_, PyAny>) -> PyResult<PreSharedKey> {
    let read = if let Ok(bytes) = key.cast::<PyByteArray>() {
        PreSharedKey::of_vec(bytes.to_vec())
    } else {
        PreSharedKey::new(key.cast::<PyBytes>()?.as_bytes())
    };
    read.map_err(|error| match error {
        KeyError::Length(seen) => {
            PyValueError::new_err(format!("key: {seen} bytes, must be the 32 of read_key"))
        }
        KeyError::Weak(_) => refuse(error),
    })
}

/// Return the security of frames: a key, or explicitly none.
pub(crate) fn security(key: Option<&Bound<'_, PyAny>>, insecure: bool) -> PyResult<Security> {
    match (key, insecure) {
        (Some(key), false) => shared_key(key).map(Security::Secure),
        (None, true) => Ok(Security::Insecure),
        (Some(_), true) => Err(PyValueError::new_err("key, insecure: give one of the two")),
        (None, false) => Err(PyValueError::new_err(
            "key: is missing: read_key() reads one, insecure=True goes without, in the clear",
        )),
    }
}

/// Address, peer and settings of a side.
pub(crate) struct Place {
    pub(crate) parts: LiveParts,
    control: Option<PathBuf>,
}

impl Place {
    /// Bind a master; without `listen`, to the local address of the route to the peer and any free port.
    pub(crate) fn of_master(
        peer: &str,
        listen: Option<&str>,
        started_s: Option<f64>,
        period_ns: u64,
        how: How,
    ) -> PyResult<Self> {
        let known = peer_addresses("peer", peer)?;
        let own = listen.map(|listen| addresses("listen", listen)).transpose()?;
        let local = |known: SocketAddr| match &own {
            Some(own) => {
                let same = own.iter().find(|own| own.is_ipv6() == known.is_ipv6());
                same.copied().ok_or_else(|| {
                    let listen = listen.unwrap_or_default();
                    PyValueError::new_err(format!(
                        "listen = {listen:?}: must be of the same kind, IPv4 or IPv6, as peer = {peer:?}"
                    ))
                })
            }
            None => local_address(known).map_err(|error| {
                let text = format!(
                    "peer = {peer:?}: no way to {known} ({error}): connect the network, or give listen"
                );
                PyOSError::new_err(text)
            }),
        };
        let (ends, refused): (Vec<_>, Vec<_>) =
            known.into_iter().map(|known| local(known).map(|local| (local, known))).partition(Result::is_ok);
        let ends: Vec<_> = ends.into_iter().flatten().collect();
        if let (true, Some(Err(error))) = (ends.is_empty(), refused.into_iter().next_back()) {
            return Err(error);
        }
        let cannot = |error| cannot_listen(ends.first().map(|end| end.0), error);
        Self::new(Role::Master, || PeerSocket::bind_each(&ends).map_err(cannot), started_s, period_ns, how)
    }

    pub(crate) fn of_slave(listen: &str, period_ns: u64, how: How) -> PyResult<Self> {
        let own = addresses("listen", listen)?;
        let bind = |own| {
            PeerSocket::bind(own, PeerAddress::Learned).map_err(|error| cannot_listen(Some(own), error))
        };
        Self::new(Role::Slave, || first_of(&own, bind), None, period_ns, how)
    }

    fn new(
        role: Role,
        bind: impl FnOnce() -> PyResult<PeerSocket>,
        started_s: Option<f64>,
        period_ns: u64,
        how: How,
    ) -> PyResult<Self> {
        let How { security, duration_s, patience_s, keep_s, realtime, record, telemetry, control } = how;
        if let Some(keep_s) = keep_s
            && !(keep_s > 0.0 && keep_s <= MAX_KEPT_S)
        {
            let text = format!("keep_s = {keep_s}: must be above 0 and at most {MAX_KEPT_S} s");
            return Err(PyValueError::new_err(text));
        }
        let settings = LiveSettings {
            role,
            period_ns,
            duration_ns: duration_s.map(|time| nanoseconds("duration_s", time)).transpose()?,
            patience_ns: patience_s.map(|time| nanoseconds("patience_s", time)).transpose()?,
            started_ns: started_s.map(started).transpose()?,
            realtime,
        };
        let socket = bind()?;
        if !reserve::fill() {
            return Err(PyMemoryError::new_err("no memory can be set aside for the end of a run"));
        }
        Ok(Self { parts: LiveParts { socket, settings, security, keep_s, record, telemetry }, control })
    }

    /// Return the parts and the control socket, if any. Called before the loop, which must not start without
    /// it.
    pub(crate) fn open(self) -> PyResult<(LiveParts, (Role, Option<ControlSocket>))> {
        let refused = |path: &Path, error: std::io::Error| {
            PyOSError::new_err(format!("control = {}: {error}", path.display()))
        };
        let listen = |path: &PathBuf| ControlSocket::listen(path).map_err(|error| refused(path, error));
        let control = self.control.as_ref().map(listen).transpose()?;
        let role = self.parts.settings.role;
        Ok((self.parts, (role, control)))
    }
}

/// Error for a side without a socket.
fn cannot_listen(local: Option<SocketAddr>, error: std::io::Error) -> PyErr {
    let local = local.map(|local| format!(" on {local}")).unwrap_or_default();
    PyOSError::new_err(format!("cannot listen{local}: {error}"))
}

/// Convert the start time of a side to ns; it must not be in the future.
fn started(time_s: f64) -> PyResult<u64> {
    let (started_ns, now_ns) = (nanoseconds("started_s", time_s)?, now_ns());
    if started_ns > now_ns {
        #[allow(clippy::cast_precision_loss)] // for a message
        let now_s = now_ns as f64 * 1e-9;
        let text = format!("started_s = {time_s}: must not be after now, {now_s:.3} s by time.monotonic()");
        return Err(PyValueError::new_err(text));
    }
    Ok(started_ns)
}

/// Options shared by all sides.
pub(crate) struct How {
    pub(crate) security: Security,
    pub(crate) duration_s: Option<f64>,
    pub(crate) patience_s: Option<f64>,
    pub(crate) keep_s: Option<f64>,
    pub(crate) realtime: RealtimeSettings,
    pub(crate) record: Option<RecorderSettings>,
    pub(crate) telemetry: Option<TelemetrySettings>,
    pub(crate) control: Option<PathBuf>,
}

pub(crate) fn not_begun(error: StartError) -> PyErr {
    match error {
        StartError::Session(error) => PyValueError::new_err(error.to_string()),
        StartError::System(error) => PyOSError::new_err(error.to_string()),
    }
}

/// Error for a side of a scene that did not begin.
pub(crate) fn refused(error: LiveError) -> PyErr {
    match error {
        LiveError::Start(error) => not_begun(error),
        LiveError::Output { .. } => PyOSError::new_err(error.to_string()),
        LiveError::Memory(_) => PyMemoryError::new_err(error.to_string()),
        LiveError::Scene(error) => refuse(error),
    }
}

/// Observation and commands of a loop. Its mutexes are never contended; they only let threads share it.
pub(crate) struct Watched {
    pub(crate) handle: LiveHandle,
    watch: Mutex<LiveWatch>,
    records: Mutex<Box<dyn KeptRecords>>,
    /// Stops when dropped.
    _control: Option<Control>,
}

impl Watched {
    pub(crate) fn new(
        mut watch: LiveWatch,
        records: Box<dyn KeptRecords>,
        (role, control): (Role, Option<ControlSocket>),
        has_driver: bool,
    ) -> PyResult<Self> {
        let handle = watch.handle().clone();
        let port = watch.port();
        let control =
            control.zip(port).map(|(socket, port)| socket.serve(role, port, has_driver)).transpose()?;
        Ok(Self { handle, watch: Mutex::new(watch), records: Mutex::new(records), _control: control })
    }

    pub(crate) fn watch(&self) -> MutexGuard<'_, LiveWatch> {
        locked(&self.watch)
    }

    pub(crate) fn kept(&self) -> usize {
        locked(&self.records).kept()
    }

    pub(crate) fn trace(&self) -> Trace {
        locked(&self.records).take()
    }

    pub(crate) fn command(&self, command: OperatorCommand) -> PyResult<()> {
        self.watch().command(command).map_err(|error| match error {
            CommandError::Full => PyRuntimeError::new_err(error.to_string()),
            _ => PyValueError::new_err(error.to_string()),
        })
    }
}

pub(crate) fn locked<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Defines the constructor of a side's class: address, own options, and options shared by all sides.
macro_rules! constructor {
    ($class:ident, $place:ident, [$($own:ident: $own_type:ty = $default:tt),*],
        |$py:ident, $scene:ident, $outline:ident, $run_id:ident, $how:ident| $begin:block) => {
        #[documented]
        #[pymethods]
        impl $class {
            #[new]
            #[pyo3(signature = (scene, *, $place, run_id, key=None, insecure=false, $($own=$default,)*
                duration_s=None, patience_s=None, keep_s=None, realtime="auto", priority=80, cpu=None,
                record=None, min_free_bytes=1_000_000_000, telemetry=None, control=None))]
            fn new(
                $py: Python<'_>,
                scene: &[u8],
                $place: &str,
                run_id: u64,
                key: Option<&Bound<'_, PyAny>>,
                insecure: bool,
                $($own: $own_type,)*
                duration_s: Option<f64>,
                patience_s: Option<f64>,
                keep_s: Option<f64>,
                realtime: &str,
                priority: u8,
                cpu: Option<u16>,
                record: Option<PathBuf>,
                min_free_bytes: u64,
                telemetry: Option<PathBuf>,
                control: Option<PathBuf>,
            ) -> PyResult<Self> {
                let $run_id = run_id;
                let $how = How {
                    security: security(key, insecure)?,
                    duration_s,
                    patience_s,
                    keep_s,
                    realtime: realtime_settings(realtime, priority, cpu)?,
                    record: recorder_settings(record, min_free_bytes, insecure, scene),
                    telemetry: telemetry_settings(telemetry, insecure, scene),
                    control,
                };
                let ($scene, $outline) = (scene, scene_outline(scene).map_err(refuse)?);
                $begin
            }
        }
    };
}
pub(crate) use constructor;

/// Methods shared by the classes of a master; `end` ends the loop.
macro_rules! master_methods {
    ($class:ident) => {
        #[documented]
        #[pymethods]
        impl $class {
            fn press_clutch(&self) {
                self.watched.handle.press_clutch();
            }

            fn set_force_scale(&self, scale: f64) -> PyResult<()> {
                self.command(OperatorCommand::ForceScale(scale))
            }

            fn switch_coupling(&self, kind: &str) -> PyResult<()> {
                self.command(OperatorCommand::Coupling(crate::bridge::coupling_kind(kind)?))
            }

            fn finish(&self, py: Python<'_>) -> PyResult<(MasterTrace, PyLoopReport)> {
                let (trace, report) = self.end(py)?;
                Ok((MasterTrace { trace }, report))
            }
        }
    };
}
pub(crate) use master_methods;

/// Methods shared by the classes of a slave; `end` ends the loop.
macro_rules! slave_methods {
    ($class:ident) => {
        #[documented]
        #[pymethods]
        impl $class {
            fn allow_takeover(&self) {
                self.watched.handle.allow_takeover();
            }

            fn set_position_scale(&self, scale: f64) -> PyResult<()> {
                self.command(OperatorCommand::PositionScale(scale))
            }

            fn finish(&self, py: Python<'_>) -> PyResult<(SlaveTrace, PyLoopReport)> {
                let (trace, report) = self.end(py)?;
                Ok((SlaveTrace { trace }, report))
            }
        }
    };
}
pub(crate) use slave_methods;

/// Methods shared by the classes that watch a loop, on their field `watched`; `finished` tells whether it has
/// ended.
macro_rules! watch_methods {
    ($class:ident) => {
        impl $class {
            fn command(&self, command: OperatorCommand) -> PyResult<()> {
                if self.finished() {
                    return Err(PyRuntimeError::new_err("the loop has ended"));
                }
                self.watched.command(command)
            }
        }

        #[documented]
        #[pymethods]
        impl $class {
            fn poll(&self) -> usize {
                self.watched.kept()
            }

            #[getter]
            fn address(&self) -> String {
                self.watched.watch().address().to_string()
            }

            #[getter]
            fn state(&self) -> &'static str {
                self.watched.handle.state().name()
            }

            #[getter]
            fn kind(&self) -> &'static str {
                self.kind.name()
            }

            #[getter]
            fn ticks(&self) -> u64 {
                self.watched.handle.ticks()
            }

            #[getter]
            fn is_answered(&self) -> bool {
                self.watched.handle.is_answered()
            }

            #[getter]
            fn recording(&self) -> Option<PyRecordingReport> {
                self.watched.watch().recording().map(Into::into)
            }

            fn stop(&self) {
                self.watched.handle.stop();
            }

            fn security_events(&self) -> Vec<String> {
                let mut events = Vec::new();
                self.watched.watch().drain_events(|event| events.push(event.to_string()));
                events
            }

            fn flight(&self) -> Option<String> {
                self.watched.watch().flight()
            }

            #[getter]
            fn ineffective_presses(&self) -> (u64, Option<&'static str>) {
                let (count, why) = self.watched.handle.ineffective_presses();
                (count, why.and_then(Ineffective::text))
            }

            #[getter]
            fn start_is_void(&self) -> bool {
                self.watched.handle.is_start_void()
            }

            fn cause(&self) -> Option<String> {
                self.watched.watch().diagnosis().map(|diagnosis| diagnosis.explain().to_json())
            }

            fn acknowledge(&self) -> PyResult<()> {
                self.command(OperatorCommand::Acknowledge)
            }
        }
    };
}
pub(crate) use watch_methods;

/// Error for a second call of `finish`.
pub(crate) fn finished_before() -> PyErr {
    PyRuntimeError::new_err("the loop was finished before, or it panicked")
}

/// Read the real-time request to the system.
pub(crate) fn realtime_settings(demand: &str, priority: u8, cpu: Option<u16>) -> PyResult<RealtimeSettings> {
    let demand = match demand {
        "auto" => RealtimeDemand::Auto,
        "off" => RealtimeDemand::Off,
        "require" => RealtimeDemand::Require,
        _ => {
            let text = format!("realtime = {demand:?}: must be \"auto\", \"off\" or \"require\"");
            return Err(PyValueError::new_err(text));
        }
    };
    if !(1..=99).contains(&priority) {
        return Err(PyValueError::new_err(format!("priority = {priority}: must be 1 to 99")));
    }
    if cpu.is_some() && demand == RealtimeDemand::Off {
        return Err(PyValueError::new_err("cpu: must not be given with realtime = \"off\""));
    }
    Ok(RealtimeSettings { demand, priority, cpu })
}

fn mark(insecure: bool) -> SecurityMark {
    if insecure { SecurityMark::Insecure } else { SecurityMark::Secure }
}

pub(crate) fn recorder_settings(
    path: Option<PathBuf>,
    min_free_bytes: u64,
    insecure: bool,
    scene: &[u8],
) -> Option<RecorderSettings> {
    let scene = String::from_utf8_lossy(scene).into_owned();
    path.map(|path| RecorderSettings { path, min_free_bytes, security: mark(insecure), scene })
}

pub(crate) fn telemetry_settings(
    path: Option<PathBuf>,
    insecure: bool,
    scene: &[u8],
) -> Option<TelemetrySettings> {
    let scene = String::from_utf8_lossy(scene).into_owned();
    path.map(|path| TelemetrySettings { path, security: mark(insecure), scene })
}
