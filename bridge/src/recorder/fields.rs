//! Fields of a recording and their meanings.

use haptether_safety::controller::ControllerKind;
use serde_json::json;

use super::SecurityMark;
use crate::{
    ladder::{LadderState, Reason},
    record::{MasterRecord, MasterTurn, SlaveRecord, SlaveTurn},
};

/// A value of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// One number for each axis.
    Axes(&'a [f64]),
    /// Number; a value that is not finite becomes null.
    Number(f64),
    /// Count or code.
    Count(u64),
    /// Set of bits.
    Bits(u64),
    /// Name.
    Name(&'static str),
    /// Name with its code.
    Code(u8, &'static str),
    /// Boolean.
    Flag(bool),
}

impl Value<'_> {
    /// Return the type in JSON Schema.
    fn schema(self) -> serde_json::Value {
        match self {
            Self::Axes(_) => json!({"type": "array", "items": {"type": ["number", "null"]}}),
            Self::Number(_) => json!({"type": ["number", "null"]}),
            Self::Count(_) | Self::Bits(_) => json!({"type": "integer"}),
            Self::Name(_) | Self::Code(..) => json!({"type": "string"}),
            Self::Flag(_) => json!({"type": "boolean"}),
        }
    }

    fn write(self, out: &mut Vec<u8>) {
        // A write to a vector never fails, and JSON can represent all these values.
        let _ = match self {
            Self::Axes(values) => serde_json::to_writer(out, values),
            Self::Number(value) => serde_json::to_writer(out, &value),
            Self::Count(value) | Self::Bits(value) => serde_json::to_writer(out, &value),
            Self::Name(value) | Self::Code(_, value) => serde_json::to_writer(out, value),
            Self::Flag(value) => serde_json::to_writer(out, &value),
        };
    }
}

/// Field of a record: name, meaning with unit, value.
pub type Field<'a> = (&'static str, &'static str, Value<'a>);

/// Record that can be recorded.
pub trait Recorded: Send + 'static {
    /// Return the side of the record.
    fn side(&self) -> &'static str;

    /// Return any record, which shows the fields.
    fn any() -> Self
    where
        Self: Sized;

    /// Return the time since the run began, in ns.
    fn time_ns(&self) -> u64;

    /// Pass each field to `take`, always the same fields in the same order.
    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>));
}

/// Return the JSON Schema of a record.
pub(super) fn schema(record: &dyn Recorded) -> String {
    let mut properties = serde_json::Map::new();
    record.fields(&mut |(name, meaning, value)| {
        let mut field = value.schema();
        field["description"] = meaning.into();
        properties.insert(name.to_owned(), field);
    });
    let security =
        json!({"type": "string", "description": "\"secure\" or \"insecure\": whether frames were sealed"});
    properties.insert("security".to_owned(), security);
    json!({"title": format!("haptether.{}", record.side()), "type": "object", "properties": properties})
        .to_string()
}

/// Write a record as one JSON object.
pub(super) fn write_json(record: &dyn Recorded, security: SecurityMark, out: &mut Vec<u8>) {
    let mut before = b'{';
    record.fields(&mut |(name, _, value)| {
        out.push(before);
        before = b',';
        Value::Name(name).write(out);
        out.push(b':');
        value.write(out);
    });
    out.extend_from_slice(b",\"security\":");
    Value::Name(security.name()).write(out);
    out.push(b'}');
}

/// Return a time in s; null if it never occurred.
fn seconds(ns: u64) -> Value<'static> {
    Value::Number(if ns == u64::MAX { f64::NAN } else { ns as f64 * 1e-9 })
}

fn reason(code: u8) -> Value<'static> {
    Value::Code(code, Reason::from_code(code).map_or("", Reason::text))
}

fn peer_state(code: u8) -> Value<'static> {
    Value::Code(code, LadderState::from_code(code).map_or("", LadderState::name))
}

const TIME: &str = "time since the run began, in ns";
const TRIGGER: &str = "what leads the gripper, 0 open to 1 closed; null where it is not known";
const STATE: &str = "state of the ladder";
const REASON: &str = "why the ladder stands there; empty where it began";
const PEER_STATE: &str = "state of the peer's ladder, by its newest frame; empty before the first";
const PEER_REASON: &str = "code of why the peer's ladder stands there, by its newest frame; 0 where it began";
const PEER_FAULT: &str = "code of the peer's fault, by its newest frame; 0 without";
const CLUTCH: &str = "whether the clutch is closed, as far as this side knows";
const AGE: &str = "silence of the peer in s; null before its first frame";
const ROUND_TRIP: &str =
    "round trip of the newest echo in s, waits for ticks included; null before the first";
const OVERSHOOT: &str = "how late the loop woke, in s";
const MEASURED_VELOCITY: &str = "V in m/s as measured; null of a device that measures none";
const RECEIVED_FORCE: &str = "F_e in N of the newest frame; zero before the first";
const REQUESTED_FORCE: &str = "F_v in N that the coupling requests of it, before the ladder's share";
const PAST: &str =
    "what the tick took over from the last: kept, stalled (nothing but a fault), acknowledged (nothing)";
const GIVEN_FAULT: &str = "code of a fault that device or trigger gave the safety layer, 0 without";
const OUTLIERS: &str =
    "samples so far that left the path of the others and were replaced by their prediction";
const RENEWAL: &str = "share of the ticks with a new sample of the device; null before it is measured, and of a simulated device";
const PORT_IN: &str = "energy in J that hand or arm has put into the coupling since the engagement";
const LEFT: &str = "energy in J that the coupling may still give; below 0 a deficit; null if it counts none";
const PORT_OUT: &str = "energy in J that it has drawn from the coupling since the engagement";
const FAULT: &str = "code of the fault, 0 without";

impl<const N: usize, R: MasterTurn> Recorded for MasterRecord<N, R> {
    fn side(&self) -> &'static str {
        "master"
    }

    fn any() -> Self {
        Self::default()
    }

    fn time_ns(&self) -> u64 {
        self.time_ns
    }

    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        let observed = ControllerKind::ALL.map(|kind| {
            let about = kind.observed();
            (about.column, about.meaning, Value::Number(self.observers[kind]))
        });
        let signals = [
            ("time_ns", TIME, Value::Count(self.time_ns)),
            ("position", "x in m, as measured", Value::Axes(self.position.as_slice())),
            ("true_position", "x in m of a modelled device", Value::Axes(self.true_position.as_slice())),
            ("measured_velocity", MEASURED_VELOCITY, Value::Axes(self.measured_velocity.as_slice())),
            ("received_force", RECEIVED_FORCE, Value::Axes(self.received_force.as_slice())),
            ("requested_force", REQUESTED_FORCE, Value::Axes(self.requested_force.as_slice())),
            ("velocity", "V in m/s", Value::Axes(self.velocity.as_slice())),
            ("hand_force", "force of a modelled hand in N", Value::Axes(self.hand_force.as_slice())),
            ("rendered_force", "F_v in N", Value::Axes(self.rendered_force.as_slice())),
            ("grasp_force", "F_h in N, as estimated", Value::Axes(self.grasp_force.as_slice())),
            ("safety_force", "F_c in N", Value::Axes(self.safety_force.as_slice())),
            ("device_force", "F_device in N", Value::Axes(self.device_force.as_slice())),
            ("trigger", TRIGGER, Value::Number(self.trigger)),
        ];
        let state = [
            ("tripped", "bits of the controllers that tripped", Value::Bits(self.tripped.into())),
            ("acted", "bits of the limiter's bounds that acted", Value::Bits(self.acted.into())),
            ("state", STATE, Value::Code(self.state.code(), self.state.name())),
            ("reason", REASON, reason(self.reason)),
            ("peer_state", PEER_STATE, peer_state(self.peer[0])),
            ("peer_reason", PEER_REASON, Value::Count(self.peer[1].into())),
            ("peer_fault", PEER_FAULT, Value::Count(self.peer[2].into())),
            ("clutch", CLUTCH, Value::Flag(self.clutch)),
            ("age_s", AGE, seconds(self.age_ns)),
            ("round_trip_s", ROUND_TRIP, seconds(self.round_trip_ns)),
            ("overshoot_s", OVERSHOOT, seconds(self.overshoot_ns)),
            ("outliers", OUTLIERS, Value::Count(self.outliers)),
            ("renewal", RENEWAL, Value::Number(self.renewal.into())),
            ("port_in_j", PORT_IN, Value::Number(self.port.in_j)),
            ("port_out_j", PORT_OUT, Value::Number(self.port.out_j)),
            ("left_j", LEFT, Value::Number(self.left_j.into())),
            ("fault", FAULT, Value::Count(self.fault.into())),
            ("gain", "the ladder's share of the requested force, 0 to 1", Value::Number(self.gain)),
            ("missed", "ticks that were left out since the last", Value::Count(self.missed)),
            ("past", PAST, Value::Name(self.past.name())),
            ("given_fault", GIVEN_FAULT, Value::Count(self.given_fault.into())),
        ];
        for field in signals.into_iter().chain(observed).chain(state) {
            take(field);
        }
        self.rotation.fields(take);
    }
}

impl<const N: usize, R: SlaveTurn> Recorded for SlaveRecord<N, R> {
    fn side(&self) -> &'static str {
        "slave"
    }

    fn any() -> Self {
        Self::default()
    }

    fn time_ns(&self) -> u64 {
        self.time_ns
    }

    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        for field in [
            ("time_ns", TIME, Value::Count(self.time_ns)),
            ("position", "of the tool, in m", Value::Axes(self.position.as_slice())),
            ("command", "commanded position in m", Value::Axes(self.command.as_slice())),
            ("environment_force", "F_e in N", Value::Axes(self.environment_force.as_slice())),
            (
                "exerted_force",
                "F_c in N on an arm that takes forces; null while it follows a position",
                Value::Axes(self.exerted_force.as_slice()),
            ),
            ("gripper", "0 open to 1 closed; null without a gripper", Value::Number(self.gripper)),
            (
                "gripper_command",
                "its last command; null before the first",
                Value::Number(self.gripper_command),
            ),
            ("gripper_force", "between its jaws in N", Value::Number(self.gripper_force)),
            ("holds_object", "whether something stops its jaws", Value::Flag(self.holds_object)),
            ("limited", "bits of the bounds that acted on the command", Value::Bits(self.limited.into())),
            ("state", STATE, Value::Code(self.state.code(), self.state.name())),
            ("reason", REASON, reason(self.reason)),
            ("peer_state", PEER_STATE, peer_state(self.peer[0])),
            ("peer_reason", PEER_REASON, Value::Count(self.peer[1].into())),
            ("peer_fault", PEER_FAULT, Value::Count(self.peer[2].into())),
            ("clutch", CLUTCH, Value::Flag(self.clutch)),
            ("age_s", AGE, seconds(self.age_ns)),
            ("round_trip_s", ROUND_TRIP, seconds(self.round_trip_ns)),
            ("overshoot_s", OVERSHOOT, seconds(self.overshoot_ns)),
            ("outliers", OUTLIERS, Value::Count(self.outliers)),
            ("renewal", RENEWAL, Value::Number(self.renewal.into())),
            ("port_in_j", PORT_IN, Value::Number(self.port.in_j)),
            ("port_out_j", PORT_OUT, Value::Number(self.port.out_j)),
            ("left_j", LEFT, Value::Number(self.left_j.into())),
            ("fault", FAULT, Value::Count(self.fault.into())),
        ] {
            take(field);
        }
        self.rotation.fields(take);
    }
}
