//! Request at the control socket, and its answer: a line of JSON each.

use serde::{Deserialize, Serialize};

/// A request. Times are whole ms, exact in a browser up to 2^53. A token is from a recent `status`, so a queued
/// request has an old one.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Request {
    Stop {},
    Status {},
    Hold {
        held_ms: u32,
        token: Option<u64>,
    },
    LetGo {},
    Release {},
    Acknowledge {
        token: u64,
    },
    ForceScale {
        scale: f64,
        token: u64,
    },
    PositionScale {
        scale: f64,
        token: u64,
    },
    TorqueScale {
        scale: f64,
        token: u64,
    },
    RotationScale {
        scale: f64,
        token: u64,
    },
    Coupling {
        kind: String,
        token: u64,
    },
    Aim {
        target: Vec<f64>,
        #[serde(default = "between_aims")]
        over_s: f64,
        stiffness: f64,
        damping: f64,
        strength_n: f64,
        token: u64,
    },
    Push {
        force: Vec<f64>,
        duration_s: f64,
        token: u64,
    },
}

/// Default time in s of the leg to an aim: two pictures of a screen at 60 Hz.
const fn between_aims() -> f64 {
    1.0 / 30.0
}

/// Names of all requests, for the error text.
const REQUESTS: &str = "stop, status, hold, let_go, release, acknowledge, force_scale, position_scale, torque_scale, \
                        rotation_scale, coupling, aim, push";

impl Request {
    pub(super) fn of(line: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(line).map_err(|error| {
            // The error's text repeats the input, which may be anything.
            let at = error.column();
            format!("no request (at column {at}): must be {{\"do\": NAME, ...}} with NAME one of {REQUESTS}")
        })
    }

    pub(super) fn name(&self) -> &'static str {
        match self {
            Self::Stop {} => "stop",
            Self::Status {} => "status",
            Self::Hold { .. } => "hold",
            Self::LetGo {} => "let_go",
            Self::Release {} => "release",
            Self::Acknowledge { .. } => "acknowledge",
            Self::ForceScale { .. } => "force_scale",
            Self::PositionScale { .. } => "position_scale",
            Self::TorqueScale { .. } => "torque_scale",
            Self::RotationScale { .. } => "rotation_scale",
            Self::Coupling { .. } => "coupling",
            Self::Aim { .. } => "aim",
            Self::Push { .. } => "push",
        }
    }
}

/// Answer: the action, or the reason for none.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Answer {
    /// Name of the request; empty if invalid.
    #[serde(rename = "to")]
    pub(super) request: &'static str,
    pub(super) done: bool,
    pub(super) text: String,
    /// Token for the next beat, or for the request after a `status`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) token: Option<u64>,
    /// True if this beat has pressed the clutch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) pressed: Option<bool>,
    /// Time of an aim or a push, in periods since the start of the loop.
    #[serde(rename = "ticks", skip_serializing_if = "Option::is_none")]
    pub(super) acts_at: Option<u64>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub(super) status: Option<Status>,
}

/// State of a loop.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Status {
    pub(super) side: &'static str,
    pub(super) state: &'static str,
    pub(super) ticks: u64,
    pub(super) is_stopped: bool,
    pub(super) is_at_rest: bool,
    /// Ineffective presses and reason of the last; `None` if the diagnosis has it.
    pub(super) ineffective_presses: u64,
    pub(super) ineffective: Option<&'static str>,
}

impl Answer {
    pub(super) fn line(&self) -> Vec<u8> {
        // Texts and whole numbers only.
        let mut line = serde_json::to_vec(self).unwrap_or_default();
        line.push(b'\n');
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_request_is_refused() {
        for line in [
            "",
            "stop",
            "{}",
            r#"{"do":"press"}"#,
            r#"{"do":"stop","now":true}"#,
            r#"{"do":"acknowledge"}"#,
            r#"{"do":"force_scale","token":1}"#,
            r#"{"do":"force_scale","scale":1.0}"#,
            r#"{"do":"force_scale","scale":"1","token":1}"#,
            r#"{"do":"hold","held_ms":-1}"#,
            r#"{"do":"hold","held_ms":1e9}"#,
            r#"{"do":"aim","target":0.1,"stiffness":300,"damping":5,"strength_n":6,"token":1}"#,
            r#"{"do":"aim","target":[0.1],"stiffness":300,"damping":5,"token":1}"#,
            r#"{"do":"push","force":[1e999],"duration_s":0.1,"token":1}"#,
            r#"[{"do":"stop"}]"#,
            r#"{"do":"stop"} {"do":"stop"}"#,
        ] {
            let refused = Request::of(line.as_bytes()).expect_err(line);
            assert!(refused.contains("must be"), "{line}: {refused}");
        }
        assert_eq!(Request::of(br#"{"do":"stop"}"#), Ok(Request::Stop {}));
        let beat = Request::Hold { held_ms: 200, token: Some(7) };
        assert_eq!(Request::of(br#"{"do":"hold","held_ms":200,"token":7}"#), Ok(beat));
    }
}
