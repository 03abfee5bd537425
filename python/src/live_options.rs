//! What the live classes are asked for beside their side: real time and a recording.

use std::path::PathBuf;

use haptether_bridge::{
    live::{RealtimeDemand, RealtimeSettings},
    recorder::{RecorderSettings, SecurityMark},
};
use pyo3::{exceptions::PyValueError, prelude::*};

/// What to ask of the system.
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

/// Where to record, if anywhere.
pub(crate) fn recorder_settings(
    path: Option<PathBuf>,
    min_free_bytes: u64,
    insecure: bool,
) -> Option<RecorderSettings> {
    let security = if insecure { SecurityMark::Insecure } else { SecurityMark::Secure };
    path.map(|path| RecorderSettings { path, min_free_bytes, security })
}
