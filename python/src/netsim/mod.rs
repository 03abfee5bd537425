//! `haptether.netsim`.

mod live;
mod probe;

use std::net::SocketAddr;

use haptether_netsim::{
    DelayTrace, Direction, DropCause, ExtraCause, IrttDelay, Judgement, Link, LinkSettings, Packet, Verdict,
    netem, parse_delay_csv, parse_dist, parse_irtt, parse_mahimahi, unsuited_peer,
};
use numpy::{PyReadonlyArray1, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};

use serde_json::json;

use crate::{
    arrays::{column, is_aligned},
    axes::refuse,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(check_link, module)?)?;
    module.add_function(wrap_pyfunction!(link_bounds, module)?)?;
    module.add_function(wrap_pyfunction!(read_link_file, module)?)?;
    module.add_function(wrap_pyfunction!(translate_netem, module)?)?;
    module.add_function(wrap_pyfunction!(verdict_causes, module)?)?;
    module.add_function(wrap_pyfunction!(judge_packets, module)?)?;
    live::register(module)?;
    probe::register(module)
}

/// Resolve a text `HOST:PORT` to all its addresses.
pub(crate) fn addresses(key: &str, text: &str) -> PyResult<Vec<SocketAddr>> {
    haptether_netsim::addresses(text).map_err(|why| {
        PyValueError::new_err(format!("{key} = {text:?}: {why}; must be HOST:PORT, such as 127.0.0.1:9100"))
    })
}

/// Resolve a text `HOST:PORT` to all addresses of a peer; one machine answers at each.
pub(crate) fn peer_addresses(key: &str, text: &str) -> PyResult<Vec<SocketAddr>> {
    let mut found = addresses(key, text)?;
    let unsuited = found.iter().find_map(|&address| unsuited_peer(address).map(|why| (address, why)));
    found.retain(|&address| unsuited_peer(address).is_none());
    match unsuited {
        Some((address, why)) if found.is_empty() => Err(PyValueError::new_err(format!(
            "{key} = {text:?}: {address} {why}; must be the address of the machine that listens, such as 192.0.2.7:9000"
        ))),
        _ => Ok(found),
    }
}

/// Return the result of `open` for the first address at which it succeeds, or its error at the last.
pub(crate) fn first_of<T>(
    addresses: &[SocketAddr],
    mut open: impl FnMut(SocketAddr) -> PyResult<T>,
) -> PyResult<T> {
    let mut opened = Err(PyValueError::new_err("no address"));
    for &address in addresses {
        opened = open(address);
        if opened.is_ok() {
            break;
        }
    }
    opened
}

/// Read the JSON settings of a link; the rules check the numbers.
pub(crate) fn link_settings(json: &str) -> PyResult<LinkSettings> {
    serde_json::from_str(json).map_err(|error| PyValueError::new_err(format!("link: {error}")))
}

pub(crate) fn direction_named(key: &str, name: &str) -> PyResult<Direction> {
    match name {
        "forward" => Ok(Direction::Forward),
        "backward" => Ok(Direction::Backward),
        other => {
            let text = format!("{key} = {other:?}: must be \"forward\" or \"backward\"");
            Err(PyValueError::new_err(text))
        }
    }
}

#[documented]
#[pyfunction]
fn check_link(settings: &str) -> PyResult<()> {
    link_settings(settings)?.validate().map_err(refuse)
}

#[documented]
#[pyfunction]
fn link_bounds(settings: &str) -> PyResult<(f64, f64)> {
    let settings = link_settings(settings)?;
    settings.validate().map_err(refuse)?;
    Ok((settings.longest_delay_s(), settings.last_change_s()))
}

#[documented]
#[pyfunction]
fn read_link_file(form: &str, data: &[u8], direction: &str) -> PyResult<String> {
    let direction = direction_named("direction", direction)?;
    let recorded = |trace: DelayTrace| json!({ "time_s": trace.time_s, "delay_s": trace.delay_s });
    let setting = match form {
        "csv" => parse_delay_csv(data, direction).map(recorded),
        "irtt" => parse_irtt(data, direction).map(|recording| {
            let mut setting = recorded(recording.delays);
            setting["half_round_trips"] = json!(recording.measured == IrttDelay::HalfRoundTrip);
            setting
        }),
        "mahimahi" => parse_mahimahi(data).map(|opportunities| json!({ "time_ms": opportunities.time_ms })),
        "dist" => parse_dist(data).map(|table| json!({ "table": table })),
        other => {
            return Err(PyValueError::new_err(format!(
                "form = {other:?}: must be csv, irtt, mahimahi or dist"
            )));
        }
    };
    Ok(setting.map_err(refuse)?.to_string())
}

#[documented]
#[pyfunction]
fn translate_netem(text: &str) -> PyResult<String> {
    let settings = netem::translate(text).map_err(refuse)?;
    let asked = netem::Asked::read(text).map_err(refuse)?;
    Ok(json!({ "settings": settings, "asked": asked }).to_string())
}

/// Code of a packet that arrives unchanged.
const DELIVERED: u8 = 0;
/// Code of a packet that arrives with bits flipped.
const CORRUPTED: u8 = 1;
/// Code of a packet that arrives truncated.
const TRUNCATED: u8 = 2;
/// Code of the first cause of a drop; the codes of extra packets follow those of drops.
const DROPPED: u8 = 3;

#[documented]
#[pyfunction]
fn verdict_causes() -> Vec<&'static str> {
    ["", "corrupt", "truncate"]
        .into_iter()
        .chain(DropCause::ALL.map(DropCause::name))
        .chain(ExtraCause::ALL.map(ExtraCause::name))
        .collect()
}

#[allow(clippy::cast_possible_truncation)] // fewer than 256 causes
fn code<T: PartialEq>(of: &T, all: &[T]) -> u8 {
    all.iter().position(|one| one == of).unwrap_or(0) as u8
}

/// Return an aligned array, copied if necessary.
fn aligned(array: PyReadonlyArray1<'_, i64>) -> PyResult<PyReadonlyArray1<'_, i64>> {
    if is_aligned(&array)? { Ok(array) } else { Ok(array.call_method0("copy")?.extract()?) }
}

/// Packets and extra packets as columns: index, sending time, arrival time (-1 if never), cause.
struct Rows {
    index: Vec<i64>,
    sent_ns: Vec<i64>,
    due_ns: Vec<i64>,
    cause: Vec<u8>,
}

impl Rows {
    /// Capacity for `packets` packets; few have extra packets.
    fn of(packets: usize) -> Self {
        Self {
            index: Vec::with_capacity(packets),
            sent_ns: Vec::with_capacity(packets),
            due_ns: Vec::with_capacity(packets),
            cause: Vec::with_capacity(packets),
        }
    }

    fn add(&mut self, index: usize, sent_ns: i64, due_ns: Option<u64>, cause: u8) {
        #[allow(clippy::cast_possible_wrap)] // an array has fewer elements
        self.index.push(index as i64);
        self.sent_ns.push(sent_ns);
        self.due_ns.push(due_ns.map_or(-1, |due_ns| i64::try_from(due_ns).unwrap_or(i64::MAX)));
        self.cause.push(cause);
    }
}

/// Arrays of index, sending time, arrival time and code of the cause.
type Columns = (Py<PyAny>, Py<PyAny>, Py<PyAny>, Py<PyAny>);

#[documented]
#[pyfunction]
#[pyo3(signature = (settings, sent_ns, sizes, direction, seed))]
fn judge_packets(
    py: Python<'_>,
    settings: &str,
    sent_ns: PyReadonlyArray1<'_, i64>,
    sizes: Option<PyReadonlyArray1<'_, i64>>,
    direction: &str,
    seed: u64,
) -> PyResult<Columns> {
    let direction = direction_named("direction", direction)?;
    let (sent_ns, sizes) = (aligned(sent_ns)?, sizes.map(aligned).transpose()?);
    if let Some(sizes) = &sizes
        && sizes.len() != sent_ns.len()
    {
        let text = format!("sizes: {} of them, must be {}, one per packet", sizes.len(), sent_ns.len());
        return Err(PyValueError::new_err(text));
    }
    let mut link = Link::new(direction, seed, &link_settings(settings)?).map_err(refuse)?;
    let mut rows = Rows::of(sent_ns.len());
    let mut latest = 0;
    let sizes = sizes.as_ref().map(PyReadonlyArray1::as_array);
    for (index, sent) in sent_ns.as_array().iter().enumerate() {
        let at_least_0 = |key: &str, value: i64| {
            u64::try_from(value)
                .map_err(|_| PyValueError::new_err(format!("{key}[{index}] = {value}: must be 0 or more")))
        };
        let size = sizes.as_ref().map_or(Ok(0), |sizes| at_least_0("sizes", sizes[index]))?;
        let sent_ns = at_least_0("sent_ns", *sent)?;
        if sent_ns < latest {
            let text = format!("sent_ns[{index}] = {sent}: must be at least the one before it, {latest}");
            return Err(PyValueError::new_err(text));
        }
        latest = sent_ns;
        let packet = Packet {
            direction,
            sent_ns,
            size: usize::try_from(size).unwrap_or(usize::MAX),
            index: index as u64,
        };
        let Judgement { verdict, damage, extras } = link.judge(&packet);
        match verdict {
            Verdict::Deliver { at_ns } => {
                let cut = damage.truncates_to().is_some_and(|left| left < packet.size);
                let cause = match (cut, damage.is_none()) {
                    (true, _) => TRUNCATED,
                    (false, false) if damage.corrupts() => CORRUPTED,
                    _ => DELIVERED,
                };
                rows.add(index, *sent, Some(at_ns), cause);
            }
            Verdict::Drop { cause } => rows.add(index, *sent, None, DROPPED + code(&cause, &DropCause::ALL)),
        }
        for extra in extras {
            #[allow(clippy::cast_possible_truncation)] // fewer than 256 causes
            let first = DROPPED + DropCause::ALL.len() as u8;
            rows.add(index, *sent, Some(extra.at_ns), first + code(&extra.cause, &ExtraCause::ALL));
        }
    }
    Ok((column(py, rows.index), column(py, rows.sent_ns), column(py, rows.due_ns), column(py, rows.cause)))
}
