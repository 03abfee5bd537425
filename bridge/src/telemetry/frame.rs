//! Content of a telemetry frame: ranges of numbers, and changes of all other signals.

use serde_json::json;

use super::Counts;
use crate::{
    coupling::CouplingKind,
    ladder::{Diagnosis, Explanation},
    recorder::{Recorded, SecurityMark, Value},
};
use std::sync::atomic::Ordering;

/// Version of the lines, raised when older readers would misread them.
const SCHEMA: u32 = 1;
/// Maximum number of changes sent per frame; further ones are counted.
const MAX_EVENTS: usize = 256;
/// Maximum bytes of a scene that is sent; a reader takes lines of a megabyte.
const MAX_SCENE: usize = 1 << 18;

/// First line to a reader: the side, and name, kind, size and meaning of each signal.
///
/// A scene longer than [`MAX_SCENE`], such as one with embedded recordings, is omitted.
pub(super) fn hello(any: &dyn Recorded, security: SecurityMark, scene: &str) -> Vec<u8> {
    let mut signals = Vec::new();
    any.fields(&mut |(name, meaning, value)| {
        if name != TIME {
            signals.push(json!({
                "name": name, "kind": kind(&value), "size": size(&value), "meaning": meaning,
            }));
        }
    });
    let scene: Option<serde_json::Value> =
        (scene.len() <= MAX_SCENE).then(|| serde_json::from_str(scene).ok()).flatten();
    line(&json!({
        "kind": "hello", "schema": SCHEMA, "version": env!("CARGO_PKG_VERSION"), "side": any.side(),
        "process": std::process::id(), "security": security.name(), "scene": scene, "signals": signals,
    }))
}

/// Line with the reason why the sides are not coupled.
pub(super) fn cause(time_ns: u64, diagnosis: &Diagnosis) -> Vec<u8> {
    #[derive(serde::Serialize)]
    struct Cause {
        kind: &'static str,
        time_ns: u64,
        #[serde(flatten)]
        explanation: Explanation,
    }
    line(&Cause { kind: "cause", time_ns, explanation: diagnosis.explain() })
}

/// Line that ends the previous cause.
pub(super) fn cleared(time_ns: u64) -> Vec<u8> {
    line(&json!({"kind": "cleared", "time_ns": time_ns}))
}

/// Line with the reason why a reader is refused.
pub(super) fn refused(text: &str) -> Vec<u8> {
    line(&json!({"kind": "refused", "text": text}))
}

fn line(of: &impl serde::Serialize) -> Vec<u8> {
    // Writing to a vector cannot fail, and JSON has all these values.
    let mut out = serde_json::to_vec(of).unwrap_or_default();
    out.push(b'\n');
    out
}

/// Name of the time field, which is no signal.
const TIME: &str = "time_ns";

fn kind(value: &Value<'_>) -> &'static str {
    match value {
        Value::Axes(_) => "axes",
        Value::Number(_) => "number",
        Value::Count(_) => "count",
        Value::Bits(_) => "bits",
        Value::Name(_) | Value::Code(..) => "name",
        Value::Flag(_) => "flag",
    }
}

fn size(value: &Value<'_>) -> usize {
    if let Value::Axes(values) = value { values.len() } else { 1 }
}

/// Range of a number over a frame; NaN does not change the bounds.
#[derive(Clone, Copy)]
struct Range {
    min: f64,
    max: f64,
    last: f64,
}

impl Range {
    const EMPTY: Self = Self { min: f64::INFINITY, max: f64::NEG_INFINITY, last: f64::NAN };

    fn take(&mut self, value: f64) {
        *self = Self { min: self.min.min(value), max: self.max.max(value), last: value };
    }

    /// Write minimum, maximum and last value. Non-finite ones become null: all three without a number.
    fn write(&self, out: &mut Vec<u8>) {
        let _ = serde_json::to_writer(out, &[self.min, self.max, self.last]);
    }
}

/// A value that is not a number.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Discrete {
    Count(u64),
    /// Union over the frame, and value at the last tick.
    Bits([u64; 2]),
    Name(&'static str),
    Flag(bool),
}

impl Discrete {
    fn write(self, out: &mut Vec<u8>) {
        let _ = match self {
            Self::Count(count) => serde_json::to_writer(out, &count),
            Self::Bits(bits) => serde_json::to_writer(out, &bits),
            Self::Name(name) => serde_json::to_writer(out, name),
            Self::Flag(flag) => serde_json::to_writer(out, &flag),
        };
    }

    fn last(self) -> serde_json::Value {
        match self {
            Self::Count(count) | Self::Bits([_, count]) => count.into(),
            Self::Name(name) => name.into(),
            Self::Flag(flag) => flag.into(),
        }
    }
}

enum Content {
    Ranges(Vec<Range>),
    Number(Range),
    Discrete(Option<Discrete>),
}

struct Signal {
    name: &'static str,
    content: Content,
}

/// Ticks since the last sample.
pub(super) struct Frame {
    signals: Vec<Signal>,
    time_ns: u64,
    ticks: u64,
    events: Vec<u8>,
    count: usize,
    /// Changes not sent, over the run.
    unsent: u64,
    sample: Vec<u8>,
}

impl Frame {
    pub(super) fn of(any: &dyn Recorded) -> Self {
        let mut signals = Vec::new();
        any.fields(&mut |(name, _, value)| {
            let content = match value {
                Value::Axes(values) => Content::Ranges(vec![Range::EMPTY; values.len()]),
                Value::Number(_) => Content::Number(Range::EMPTY),
                _ => Content::Discrete(None),
            };
            signals.push(Signal { name, content });
        });
        Self {
            signals,
            time_ns: 0,
            ticks: 0,
            events: Vec::with_capacity(4096),
            count: 0,
            unsent: 0,
            sample: Vec::with_capacity(4096),
        }
    }

    pub(super) fn take(&mut self, record: &dyn Recorded) {
        let Self { signals, events, count, unsent, .. } = self;
        let time_ns = record.time_ns();
        let mut signals = signals.iter_mut();
        record.fields(&mut |(name, _, value)| {
            let Some(signal) = signals.next() else { return };
            match (&mut signal.content, value) {
                (Content::Ranges(ranges), Value::Axes(values)) => {
                    ranges.iter_mut().zip(values).for_each(|(range, value)| range.take(*value));
                }
                (Content::Number(range), Value::Number(value)) => range.take(value),
                (Content::Discrete(before), value) => {
                    let now = match value {
                        Value::Count(count) => Discrete::Count(count),
                        Value::Bits(bits) => Discrete::Bits([bits, bits]),
                        Value::Name(name) | Value::Code(_, name) => Discrete::Name(name),
                        Value::Flag(flag) => Discrete::Flag(flag),
                        Value::Axes(_) | Value::Number(_) => return,
                    };
                    if let (Some(before), true) = (*before, name != TIME)
                        && !matches!(now, Discrete::Count(_))
                        && before.last() != now.last()
                    {
                        if *count < MAX_EVENTS {
                            *count += 1;
                            let change = json!({
                                "kind": "change", "time_ns": time_ns, "signal": name, "from": before.last(),
                                "to": now.last(),
                            });
                            events.extend(line(&change));
                        } else {
                            *unsent += 1;
                        }
                    }
                    *before = Some(match (*before, now) {
                        (Some(Discrete::Bits([any, _])), Discrete::Bits([bits, _])) => {
                            Discrete::Bits([any | bits, bits])
                        }
                        _ => now,
                    });
                }
                _ => {}
            }
        });
        self.time_ns = time_ns;
        self.ticks += 1;
    }

    /// Pass the changes since the last call, one line each.
    pub(super) fn events(&mut self, take: impl FnOnce(&[u8])) {
        take(&self.events);
        self.events.clear();
        self.count = 0;
    }

    /// Take the sample of the frame and its number of ticks; `None` without a tick.
    pub(super) fn sample(&mut self, counts: &Counts) -> Option<(&[u8], u64)> {
        if self.ticks == 0 {
            return None;
        }
        let Self { signals, time_ns, ticks, sample: out, unsent, .. } = self;
        out.clear();
        let Counts { dropped, sent, fresh, late, missing, coupling } = counts;
        let [dropped, sent, fresh, late, missing] =
            [dropped, sent, fresh, late, missing].map(|count| count.load(Ordering::Relaxed));
        let coupling = CouplingKind::from_code(coupling.load(Ordering::Relaxed)).unwrap_or_default().name();
        let head = format!(
            r#"{{"kind":"sample","time_ns":{time_ns},"ticks":{ticks},"dropped":{dropped},"unsent_changes":{unsent}"#
        );
        out.extend_from_slice(head.as_bytes());
        let link = format!(
            r#","link":{{"sent":{sent},"fresh":{fresh},"late":{late},"missing":{missing},"coupling":"{coupling}"}}"#
        );
        out.extend_from_slice(link.as_bytes());
        out.extend_from_slice(br#","signals":{"#);
        let mut is_first = true;
        for signal in signals.iter_mut().filter(|signal| signal.name != TIME) {
            if !std::mem::replace(&mut is_first, false) {
                out.push(b',');
            }
            Discrete::Name(signal.name).write(out);
            out.push(b':');
            match &mut signal.content {
                Content::Ranges(ranges) => {
                    out.push(b'[');
                    for (index, range) in ranges.iter_mut().enumerate() {
                        if index > 0 {
                            out.push(b',');
                        }
                        std::mem::replace(range, Range::EMPTY).write(out);
                    }
                    out.push(b']');
                }
                Content::Number(range) => std::mem::replace(range, Range::EMPTY).write(out),
                Content::Discrete(Some(value)) => {
                    value.write(out);
                    if let Discrete::Bits([any, last]) = value {
                        *any = *last;
                    }
                }
                Content::Discrete(None) => out.extend_from_slice(b"null"),
            }
        }
        out.extend_from_slice(b"}}\n");
        let ticks = std::mem::take(&mut self.ticks);
        Some((&self.sample, ticks))
    }

    pub(super) fn end_line(&self) -> Vec<u8> {
        line(&json!({"kind": "end", "time_ns": self.time_ns}))
    }
}
