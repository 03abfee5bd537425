//! Diagnosis: why two sides are not coupled, as one of them knows it, with location, text and ordered
//! remedies.

use std::fmt::Write as _;

use haptether_safety::Fault;
use serde::Serialize;

use super::table::{LadderState, Reason};
use crate::{fault_text::FaultText, wire::Role};

/// Last report of the peer about itself. Its codes may come from a newer version.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerCause {
    /// State of the peer.
    pub state: LadderState,
    /// Reason of its last hold as [`Reason::code`].
    pub reason: u8,
    /// Its fault as [`Fault::code`]; 0 without one.
    pub fault: u8,
    /// Its driver's text on the fault.
    pub text: FaultText,
}

/// Diagnosis by one side: why the two are not coupled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Diagnosis {
    /// Role of the side.
    pub role: Role,
    /// State of the side.
    pub state: LadderState,
    /// Reason of its state; in HOLD and STOP, of the first hold:
    /// [`History::cause`](super::History::cause).
    pub reason: Option<Reason>,
    /// Its fault as [`Fault::code`]; 0 without one.
    pub fault: u8,
    /// Its driver's text on the fault.
    pub text: FaultText,
    /// Report of the peer; none before its first frame.
    pub peer: Option<PeerCause>,
    /// True if the peer has ended in an orderly way.
    pub ended: bool,
    /// True if the peer is not heard at present.
    pub silent: bool,
    /// True if this side ends because of its fault, so that nothing is left to acknowledge.
    pub ends: bool,
}

/// Action required before the two couple again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Remedy {
    /// Repair the cause of the fault and acknowledge it.
    Acknowledge,
    /// Start the side that has ended.
    Start,
    /// Wait until both sides hear each other.
    Wait,
    /// Turn the device towards the arm.
    Turn,
    /// Release the clutch and press it again.
    Press,
}

/// Step of the remedy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Step {
    /// "master", "slave" or "link".
    pub at: &'static str,
    /// Kind of action.
    pub remedy: Remedy,
    /// Sentence for the operator.
    pub text: String,
}

/// Diagnosis in the operator's words.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Explanation {
    /// State of the side that diagnosed.
    pub state: LadderState,
    /// Location of the cause: "master", "slave" or "link".
    pub at: &'static str,
    /// Cause, with the driver's own text if there is one.
    pub text: String,
    /// Steps to take, in this order.
    pub steps: Vec<Step>,
}

impl Explanation {
    /// Write as JSON.
    pub fn to_json(&self) -> String {
        // Plain names and texts: serialisation cannot fail.
        serde_json::to_string(self).unwrap_or_default()
    }
}

const LINK: &str = "link";

/// Text of a fault: the driver's own, or the meaning of its code.
fn describe_fault(code: u8, text: &FaultText) -> String {
    match Fault::from_code(code) {
        _ if !text.is_empty() => text.as_str().to_owned(),
        Some(fault) => fault.to_string(),
        None => format!("of a kind that this version does not know, code {code}"),
    }
}

impl Diagnosis {
    /// Return whether `other` is the same case, apart from more text or a link that is back.
    pub fn is_same_case(&self, other: &Self) -> bool {
        let bare = |one: &Self| Self {
            silent: false,
            text: FaultText::EMPTY,
            peer: one.peer.map(|peer| PeerCause { text: FaultText::EMPTY, ..peer }),
            ..*one
        };
        bare(self) == bare(other)
    }

    /// Return whether something else must be done before a press of the clutch can couple.
    pub fn is_before_press(&self) -> bool {
        let failed = |state| state == LadderState::Fault;
        failed(self.state)
            || self.peer.is_some_and(|peer| failed(peer.state))
            || self.ended
            || self.silent && self.state.is_held()
    }

    /// Explain cause, location and remedy to the operator.
    pub fn explain(&self) -> Explanation {
        let (own, other) = (self.role.name(), self.role.peer().name());
        if self.state == LadderState::Fault {
            return self.own_fault(own, other);
        }
        if let Some(peer) = self.peer.filter(|peer| peer.state == LadderState::Fault) {
            let fault = describe_fault(peer.fault, &peer.text);
            let (and_ended, first) = if self.ended {
                (", and has ended", start(other, "mend the cause, then start"))
            } else {
                ("", acknowledge(other))
            };
            let text = format!("the {other} has a fault{and_ended}: {fault}");
            return self.explanation(other, text, vec![first]);
        }
        if self.ended {
            let text = format!("the {other} has ended");
            return self.explanation(other, text, vec![start(other, "start")]);
        }
        let (at, text) = match self.turn_end() {
            Some(Reason::TurnRefused) => {
                let text = "the angle between slave and master is larger than the slave may turn to align";
                let turn = "turn the master's device until it points as the arm does".to_owned();
                let step = Step { at: Role::Master.name(), remedy: Remedy::Turn, text: turn };
                return self.explanation(Role::Slave.name(), text.to_owned(), vec![step]);
            }
            Some(_) => {
                let text = "the slave stopped turning to the master: the two did not hear one another, or the press was over";
                (LINK, text.to_owned())
            }
            None => self.hold(own, other),
        };
        let steps = if at == LINK || self.silent {
            let text = format!(
                "wait until master and slave hear one another: is the {other} running, and the link up?"
            );
            vec![Step { at: LINK, remedy: Remedy::Wait, text }]
        } else {
            Vec::new()
        };
        self.explanation(at, text, steps)
    }

    /// Reason for which the slave did not rotate to the master's orientation, or stopped; either side may
    /// know it.
    fn turn_end(&self) -> Option<Reason> {
        let reason = match self.role {
            Role::Slave => self.reason,
            Role::Master => match self.state {
                LadderState::Aligning | LadderState::Disengaged => {
                    self.peer.and_then(|peer| Reason::from_code(peer.reason))
                }
                _ => None,
            },
        };
        reason.filter(|reason| matches!(reason, Reason::TurnRefused | Reason::TurnCut))
    }

    fn own_fault(&self, own: &'static str, other: &'static str) -> Explanation {
        let mut text = format!("the {own} has a fault: {}", describe_fault(self.fault, &self.text));
        let mut steps =
            vec![if self.ends { start(own, "mend the cause, then start") } else { acknowledge(own) }];
        if let Some(peer) = self.peer.filter(|peer| peer.state == LadderState::Fault) {
            let _ = write!(text, "; the {other} has one, too: {}", describe_fault(peer.fault, &peer.text));
            steps.push(acknowledge(other));
        }
        if self.ended {
            let _ = write!(text, "; the {other} has ended");
            steps.push(start(other, "start"));
        }
        self.explanation(own, text, steps)
    }

    /// Location and text of a hold or stop that neither a fault nor an end explains.
    fn hold(&self, own: &'static str, other: &'static str) -> (&'static str, String) {
        match self.reason {
            Some(Reason::PeerHolds | Reason::PeerStopped | Reason::PeerFaulted) => self.peer_hold(own, other),
            Some(Reason::PeerDisengaged) => self.peer_left(own, other),
            Some(Reason::AlignTimedOut) => {
                (other, format!("the {other} did not answer the press of the clutch in time"))
            }
            Some(Reason::PeerEnded) => (other, format!("the {other} had ended")),
            Some(Reason::OwnDelay) => (own, format!("the {own}'s own loop was late")),
            Some(Reason::PeerRestarted) => (other, format!("the {other} was restarted")),
            Some(Reason::PeerSilent | Reason::SilentTooLong) => (LINK, format!("the {other} fell silent")),
            Some(Reason::PeerDeaf) => (LINK, format!("the {other} does not hear the {own}")),
            Some(Reason::NewsOld) => {
                (LINK, format!("the newest state from the {other} is older than normal for this link"))
            }
            Some(reason) => (own, reason.text().to_owned()),
            None => (own, format!("the {own} is in {}", self.state.name())),
        }
    }

    /// Location and text for a peer that is disengaged while this side is coupled.
    fn peer_left(&self, own: &'static str, other: &'static str) -> (&'static str, String) {
        match self.peer.and_then(|peer| Reason::from_code(peer.reason)) {
            Some(Reason::PeerEnded) => {
                (LINK, format!("the {other} received a message that the {own} has ended"))
            }
            _ => (other, format!("the {other} is disengaged")),
        }
    }

    fn peer_hold(&self, own: &'static str, other: &'static str) -> (&'static str, String) {
        let code = self.peer.map_or(0, |peer| peer.reason);
        match Reason::from_code(code) {
            Some(Reason::BadNumber) => (other, format!("the {other} had a fault")),
            Some(Reason::OwnDelay) => (other, format!("the {other} held: its own loop was late")),
            Some(Reason::PeerRestarted) => (other, format!("the {other} held: the {own} was restarted")),
            Some(Reason::PeerSilent | Reason::SilentTooLong) => {
                (LINK, format!("the {other} held: it no longer heard the {own}"))
            }
            Some(Reason::PeerDeaf) => (LINK, format!("the {other} held: the {own} did not hear it")),
            Some(Reason::NewsOld) => (
                LINK,
                format!(
                    "the {other} held: the newest state from the {own} is older than normal for this link"
                ),
            ),
            Some(reason) => (other, format!("the {other} held: {}", reason.text())),
            None if code == 0 => (other, format!("the {other} held")),
            None => {
                (other, format!("the {other} held for a reason that this version does not know, code {code}"))
            }
        }
    }

    /// Build the explanation and add the last step. The start of a master without a button counts as a press,
    /// so no press follows it.
    fn explanation(&self, at: &'static str, text: String, mut steps: Vec<Step>) -> Explanation {
        let is_started = |step: &Step| step.remedy == Remedy::Start && step.at == Role::Master.name();
        if !steps.iter().any(is_started) {
            let text = "release the clutch at the master and press it again".to_owned();
            steps.push(Step { at: Role::Master.name(), remedy: Remedy::Press, text });
        }
        Explanation { state: self.state, at, text, steps }
    }
}

fn acknowledge(at: &'static str) -> Step {
    Step { at, remedy: Remedy::Acknowledge, text: format!("mend the cause, then acknowledge it at the {at}") }
}

fn start(at: &'static str, how: &str) -> Step {
    let then = if at == Role::Master.name() {
        ", and press the clutch if its device has a button for it"
    } else {
        ""
    };
    Step { at, remedy: Remedy::Start, text: format!("{how} the {at} again{then}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HELD: Diagnosis = Diagnosis {
        role: Role::Master,
        state: LadderState::Stop,
        reason: Some(Reason::PeerSilent),
        fault: 0,
        text: FaultText::EMPTY,
        peer: None,
        ended: false,
        silent: true,
        ends: false,
    };

    #[allow(clippy::unnecessary_wraps)] // matches the type of the field
    fn peer(state: LadderState, reason: u8, fault: u8, text: &str) -> Option<PeerCause> {
        Some(PeerCause { state, reason, fault, text: FaultText::new(text) })
    }

    fn explained(diagnosis: &Diagnosis) -> (&'static str, String, Vec<(&'static str, Remedy)>) {
        let Explanation { at, text, steps, .. } = diagnosis.explain();
        (at, text, steps.iter().map(|step| (step.at, step.remedy)).collect())
    }

    /// Location, text and ordered steps of each cause, written by hand.
    #[test]
    #[allow(clippy::too_many_lines)] // a table
    fn each_cause_has_location_text_and_steps() {
        use LadderState::{Aligning, Fault, Hold};
        use Remedy::{Acknowledge, Press, Start, Turn, Wait};
        let bus = "Arm: OSError: the bus is down (arm.py:7)";
        let cases = [
            (HELD, "link", "the slave fell silent", vec![("link", Wait), ("master", Press)]),
            (
                Diagnosis { peer: peer(Fault, 1, 11, bus), silent: false, ..HELD },
                "slave",
                "the slave has a fault: Arm: OSError: the bus is down (arm.py:7)",
                vec![("slave", Acknowledge), ("master", Press)],
            ),
            (
                Diagnosis {
                    state: Aligning,
                    reason: None,
                    peer: peer(Fault, 1, 1, ""),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the slave has a fault: position is not a finite number",
                vec![("slave", Acknowledge), ("master", Press)],
            ),
            (
                Diagnosis { peer: peer(Fault, 99, 99, ""), ..HELD },
                "slave",
                "the slave has a fault: of a kind that this version does not know, code 99",
                vec![("slave", Acknowledge), ("master", Press)],
            ),
            (
                Diagnosis { peer: peer(Fault, 1, 11, bus), ended: true, ..HELD },
                "slave",
                "the slave has a fault, and has ended: Arm: OSError: the bus is down (arm.py:7)",
                vec![("slave", Start), ("master", Press)],
            ),
            (
                Diagnosis { role: Role::Slave, peer: peer(Fault, 1, 11, bus), ended: true, ..HELD },
                "master",
                "the master has a fault, and has ended: Arm: OSError: the bus is down (arm.py:7)",
                vec![("master", Start)],
            ),
            (
                Diagnosis {
                    state: Fault,
                    fault: 11,
                    text: FaultText::new(bus),
                    peer: peer(Hold, 8, 0, ""),
                    ..HELD
                },
                "master",
                "the master has a fault: Arm: OSError: the bus is down (arm.py:7)",
                vec![("master", Acknowledge), ("master", Press)],
            ),
            (
                Diagnosis { state: Fault, fault: 11, text: FaultText::new(bus), ends: true, ..HELD },
                "master",
                "the master has a fault: Arm: OSError: the bus is down (arm.py:7)",
                vec![("master", Start)],
            ),
            (
                Diagnosis {
                    role: Role::Slave,
                    state: Fault,
                    fault: 11,
                    text: FaultText::new(bus),
                    ends: true,
                    ..HELD
                },
                "slave",
                "the slave has a fault: Arm: OSError: the bus is down (arm.py:7)",
                vec![("slave", Start), ("master", Press)],
            ),
            (
                Diagnosis { state: Fault, fault: 2, peer: peer(Fault, 1, 11, "off"), silent: false, ..HELD },
                "master",
                "the master has a fault: velocity is not a finite number; the slave has one, too: off",
                vec![("master", Acknowledge), ("slave", Acknowledge), ("master", Press)],
            ),
            (
                Diagnosis { role: Role::Slave, reason: None, ended: true, ..HELD },
                "master",
                "the master has ended",
                vec![("master", Start)],
            ),
            (
                Diagnosis {
                    reason: Some(Reason::PeerHolds),
                    peer: peer(Hold, 2, 0, ""),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the slave held: its own loop was late",
                vec![("master", Press)],
            ),
            (
                Diagnosis {
                    reason: Some(Reason::PeerHolds),
                    peer: peer(Hold, 4, 0, ""),
                    silent: false,
                    ..HELD
                },
                "link",
                "the slave held: it no longer heard the master",
                vec![("link", Wait), ("master", Press)],
            ),
            (
                Diagnosis {
                    reason: Some(Reason::PeerHolds),
                    peer: peer(Hold, 0, 0, ""),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the slave held",
                vec![("master", Press)],
            ),
            (
                Diagnosis {
                    reason: Some(Reason::PeerHolds),
                    peer: peer(Hold, 200, 0, ""),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the slave held for a reason that this version does not know, code 200",
                vec![("master", Press)],
            ),
            (
                Diagnosis {
                    reason: Some(Reason::PeerDisengaged),
                    peer: peer(LadderState::Disengaged, Reason::PeerEnded.code(), 0, ""),
                    silent: false,
                    ..HELD
                },
                "link",
                "the slave received a message that the master has ended",
                vec![("link", Wait), ("master", Press)],
            ),
            (
                Diagnosis {
                    state: LadderState::Disengaged,
                    reason: Some(Reason::AlignTimedOut),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the slave did not answer the press of the clutch in time",
                vec![("master", Press)],
            ),
            (
                Diagnosis {
                    state: Aligning,
                    reason: Some(Reason::ClutchPressed),
                    peer: peer(LadderState::Disengaged, Reason::TurnRefused.code(), 0, ""),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the angle between slave and master is larger than the slave may turn to align",
                vec![("master", Turn), ("master", Press)],
            ),
            (
                Diagnosis {
                    role: Role::Slave,
                    state: LadderState::Disengaged,
                    reason: Some(Reason::TurnRefused),
                    peer: peer(Aligning, Reason::ClutchPressed.code(), 0, ""),
                    silent: false,
                    ..HELD
                },
                "slave",
                "the angle between slave and master is larger than the slave may turn to align",
                vec![("master", Turn), ("master", Press)],
            ),
            (
                Diagnosis {
                    state: Aligning,
                    reason: Some(Reason::ClutchPressed),
                    peer: peer(LadderState::Disengaged, Reason::TurnCut.code(), 0, ""),
                    silent: false,
                    ..HELD
                },
                "link",
                "the slave stopped turning to the master: the two did not hear one another, or the press was over",
                vec![("link", Wait), ("master", Press)],
            ),
            (
                // The peer's reason is from an earlier press; the reason of the hold counts.
                Diagnosis {
                    state: Hold,
                    reason: Some(Reason::OwnDelay),
                    peer: peer(Hold, Reason::TurnRefused.code(), 0, ""),
                    silent: false,
                    ..HELD
                },
                "master",
                "the master's own loop was late",
                vec![("master", Press)],
            ),
            (
                Diagnosis { reason: Some(Reason::OwnDelay), silent: false, ..HELD },
                "master",
                "the master's own loop was late",
                vec![("master", Press)],
            ),
        ];
        for (diagnosis, at, text, steps) in cases {
            assert_eq!(explained(&diagnosis), (at, text.to_owned(), steps), "{diagnosis:?}");
        }
    }

    #[test]
    fn more_text_or_recovered_link_is_the_same_case() {
        let held = Diagnosis { peer: peer(LadderState::Hold, 1, 2, "a"), ..HELD };
        for (other, is_same) in [
            (held, true),
            (Diagnosis { silent: false, ..held }, true),
            (Diagnosis { text: FaultText::new("b"), ..held }, true),
            (Diagnosis { peer: peer(LadderState::Hold, 1, 2, "more words"), ..held }, true),
            (Diagnosis { role: Role::Slave, ..held }, false),
            (Diagnosis { state: LadderState::Hold, ..held }, false),
            (Diagnosis { reason: Some(Reason::PeerDeaf), ..held }, false),
            (Diagnosis { reason: None, ..held }, false),
            (Diagnosis { fault: 1, ..held }, false),
            (Diagnosis { peer: None, ..held }, false),
            (Diagnosis { peer: peer(LadderState::Stop, 1, 2, "a"), ..held }, false),
            (Diagnosis { peer: peer(LadderState::Hold, 3, 2, "a"), ..held }, false),
            (Diagnosis { peer: peer(LadderState::Hold, 1, 3, "a"), ..held }, false),
            (Diagnosis { ended: true, ..held }, false),
            (Diagnosis { ends: true, ..held }, false),
        ] {
            assert_eq!(held.is_same_case(&other), is_same, "{other:?}");
            assert_eq!(other.is_same_case(&held), is_same, "{other:?}");
        }
    }

    #[test]
    fn a_press_comes_after_faults_ends_and_silence() {
        use LadderState::{Aligning, Disengaged, Engaged, Fault, Hold, Stale, Stop};
        for state in [Disengaged, Aligning, Engaged, Stale, Hold, Stop, Fault] {
            for peer_state in [None, Some(Engaged), Some(Hold), Some(Fault)] {
                for (ended, silent) in [(false, false), (false, true), (true, false), (true, true)] {
                    let peer = peer_state.and_then(|state| peer(state, 0, 0, ""));
                    let diagnosis = Diagnosis { state, peer, ended, silent, ..HELD };
                    let is_first = state == Fault
                        || peer_state == Some(Fault)
                        || ended
                        || (silent && (state == Hold || state == Stop));
                    assert_eq!(diagnosis.is_before_press(), is_first, "{diagnosis:?}");
                }
            }
        }
    }

    #[test]
    fn json_has_all_of_an_explanation() {
        let json = HELD.explain().to_json();
        let read: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!(read["state"], "stop");
        assert_eq!(read["at"], "link");
        assert_eq!(read["text"], "the slave fell silent");
        assert_eq!(read["steps"][0]["remedy"], "wait");
        assert_eq!(read["steps"][1]["at"], "master");
        assert_eq!(read["steps"][1]["text"], "release the clutch at the master and press it again");
    }

    /// Every case has one line of text, and its last step is a press or the start of a master.
    #[test]
    fn every_diagnosis_has_text_and_a_last_step() {
        let reasons = Reason::ALL.into_iter().map(Some).chain([None]);
        for reason in reasons {
            for state in LadderState::ALL {
                for code in [0, 1, 2, 4, 8, 17, 21, 200] {
                    for (role, ended, silent) in [
                        (Role::Master, false, false),
                        (Role::Slave, false, true),
                        (Role::Slave, true, true),
                        (Role::Master, true, false),
                    ] {
                        for peer_state in LadderState::ALL {
                            let peer = peer(peer_state, code, code, "");
                            let all = Diagnosis { role, state, reason, peer, ended, silent, ..HELD };
                            let (_, text, steps) = explained(&all);
                            assert!(!text.is_empty() && !text.contains('\n'));
                            let last = steps.last().copied();
                            assert!(
                                last == Some(("master", Remedy::Press))
                                    || last == Some(("master", Remedy::Start)),
                                "{all:?}"
                            );
                        }
                    }
                }
            }
        }
    }
}
