//! `haptether.bridge`: both sides live, each with a socket and a loop on its own thread.

use std::{
    path::PathBuf,
    sync::{Mutex, PoisonError},
};

use haptether_bridge::{
    Act, MasterRecord, Side, SlaveRecord,
    live::{
        LiveRun, LiveSettings, PeerAddress, PeerSocket, RealtimeSettings, Security, SecurityEvent,
        StartError, run_live,
    },
    recorder::{Recorded, Recorder, RecorderSettings},
    session::PreSharedKey,
    wire::Role,
};
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError, PyValueError},
    prelude::*,
};

use crate::{
    axes::refuse,
    bridge::{PyMasterSettings, PySlaveSettings, nanoseconds},
    bridge_trace::{MasterTrace, PyLoopReport, PyRecordingReport, SlaveTrace},
    live_options::{realtime_settings, recorder_settings},
    netsim::address,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<LiveMaster>()?;
    module.add_class::<LiveSlave>()
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
