//! What can be seen of a live loop, and done to it, from outside.

use std::{
    net::SocketAddr,
    sync::{Arc, atomic::Ordering},
};

use super::{
    clock,
    handshakes::SecurityEvent,
    run::{Ineffective, Shared},
};
use crate::{
    act::OperatorCommand,
    ladder::{Diagnosis, FlightRecorder, LadderState},
    recorder::{Recording, RecordingReport},
};

/// What ends a loop or acts on it from any thread, without a lock.
#[derive(Clone, Debug)]
pub struct LiveHandle(Arc<Shared>);

impl LiveHandle {
    /// Asks the loop to end after its current tick.
    pub fn stop(&self) {
        self.0.stop.store(true, Ordering::Relaxed);
    }

    /// [`LiveWatch::press_clutch`].
    pub fn press_clutch(&self) {
        self.0.press_clutch();
    }

    /// [`LiveWatch::allow_takeover`].
    pub fn allow_takeover(&self) {
        self.0.allow_takeover();
    }

    /// Whether the loop has ended: no force, no motion, and the peer has been sent the end.
    pub fn is_at_rest(&self) -> bool {
        self.0.at_rest.load(Ordering::Relaxed)
    }
}

/// The outer ends of a loop's rings; the loop never waits for them.
#[derive(Debug)]
pub struct LiveWatch<R> {
    pub(super) records: rtrb::Consumer<R>,
    pub(super) events: rtrb::Consumer<SecurityEvent>,
    pub(super) flights: rtrb::Consumer<FlightRecorder>,
    /// The newest that was taken.
    pub(super) flight: Option<Box<FlightRecorder>>,
    pub(super) diagnoses: rtrb::Consumer<Option<Diagnosis>>,
    /// The newest that was taken.
    pub(super) diagnosis: Option<Diagnosis>,
    pub(super) acts: rtrb::Producer<(u64, OperatorCommand)>,
    pub(super) shared: Arc<Shared>,
    pub(super) address: SocketAddr,
    pub(super) recording: Option<Recording>,
}

impl<R> LiveWatch<R> {
    /// Takes the records that wait.
    pub fn drain(&mut self, mut take: impl FnMut(R)) {
        while let Ok(record) = self.records.pop() {
            take(record);
        }
    }

    /// Takes what happened to the session.
    pub fn drain_events(&mut self, mut take: impl FnMut(SecurityEvent)) {
        while let Ok(event) = self.events.pop() {
            take(event);
        }
    }

    /// Lets another master begin, if the one before has been silent for 2 s: the act of a person at the slave. Void as
    /// [`Self::press_clutch`].
    pub fn allow_takeover(&self) {
        self.shared.allow_takeover();
    }

    /// For threads that must not wait for whoever reads the rings.
    pub fn handle(&self) -> LiveHandle {
        LiveHandle(Arc::clone(&self.shared))
    }

    /// Where the socket listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        LadderState::from_code(self.shared.state.load(Ordering::Relaxed)).unwrap_or(LadderState::Disengaged)
    }

    /// Whether the peer has answered a frame of this side.
    pub fn is_answered(&self) -> bool {
        self.shared.answered.load(Ordering::Relaxed)
    }

    /// How the recording stands; none if there is none.
    pub fn recording(&self) -> Option<RecordingReport> {
        self.recording.as_ref().map(Recording::report)
    }

    /// Ticks done so far.
    pub fn ticks(&self) -> u64 {
        self.shared.ticks.load(Ordering::Relaxed)
    }

    /// Lets go of the clutch for a moment and presses it again: the act of a person at this side. Void if the loop does
    /// not come to it within 0.25 s, or was late within 0.25 s before: nobody knows then when it was done.
    pub fn press_clutch(&self) {
        self.shared.press_clutch();
    }

    /// How often a press did nothing, and why the last one did not: [`Self::press_clutch`], or a start that was too old.
    pub fn ineffective_presses(&self) -> (u64, Option<Ineffective>) {
        let count = self.shared.ineffective_presses.load(Ordering::Acquire);
        (count, Ineffective::from_code(self.shared.ineffective.load(Ordering::Relaxed)))
    }

    /// Hands an act to the loop, which does it at its next tick; gives it back where too many wait. An acknowledgement is
    /// void if the loop does not come to it within 0.25 s.
    pub fn act(&mut self, act: OperatorCommand) -> Result<(), OperatorCommand> {
        self.acts.push((clock::now_ns(), act)).map_err(|rtrb::PushError::Full((_, act))| act)
    }

    /// The last states and commands as JSON, as of the last STOP or FAULT, or of the end; none before.
    pub fn flight(&mut self) -> Option<String> {
        while let Ok(flight) = self.flights.pop() {
            self.flight = Some(Box::new(flight));
        }
        self.flight.as_ref().map(|flight| flight.to_json())
    }

    /// Why the two sides are not coupled, where it happened and what to do; none where nothing is wrong.
    pub fn diagnosis(&mut self) -> Option<&Diagnosis> {
        while let Ok(diagnosis) = self.diagnoses.pop() {
            self.diagnosis = diagnosis;
        }
        self.diagnosis.as_ref()
    }

    /// Asks the loop to end after its current tick.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }

    /// Whether the loop was asked to end, or has ended by itself where somebody else turns it.
    pub fn is_stopped(&self) -> bool {
        self.shared.stop.load(Ordering::Relaxed)
    }

    /// The loop is over: what it said last counts.
    pub fn ended(&mut self, flight: Option<Box<FlightRecorder>>) {
        while self.flights.pop().is_ok() {}
        self.flight = flight.or(self.flight.take());
        while self.diagnoses.pop().is_ok() {}
        if let Some(flight) = &self.flight {
            self.diagnosis = self.shared.diagnosis(flight);
        }
    }
}
