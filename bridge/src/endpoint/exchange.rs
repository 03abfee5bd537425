//! What both endpoints have: a link, a ladder, and what goes out next.

use haptether_safety::Axes;

use crate::{
    ladder::{Ladder, LadderSettings, LadderState},
    link::{FrameLink, LinkStatistics, Refusal},
    wire::{Frame, MAX_FRAME, Role},
};

/// The part of an endpoint that talks to the peer.
#[derive(Clone, Debug)]
pub struct Exchange<const N: usize> {
    pub(super) ladder: Ladder,
    /// Whether a new session of the peer ends a STOP.
    resumes: bool,
    link: FrameLink<N>,
    /// Position, velocity and force of the next frame.
    pub(super) outgoing: [Axes<N>; 3],
}

impl<const N: usize> Exchange<N> {
    pub(super) fn new(role: Role, session: u64, settings: LadderSettings) -> Self {
        Self {
            ladder: Ladder::new(settings),
            // Whoever starts a master means to engage, so a slave may follow a new one. A hand is never coupled again
            // by what arrives from the network: a stopped master must be started anew.
            resumes: role == Role::Slave,
            link: FrameLink::new(role, session, settings.stop_after_ns),
            outgoing: [Axes::zeros(); 3],
        }
    }

    /// Takes a datagram that arrived by `now_ns`; says whether it began a session.
    pub(super) fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<bool, Refusal> {
        let begins = self.link.receive(now_ns, datagram)?;
        if begins && self.resumes {
            self.ladder.new_session();
        }
        Ok(begins)
    }

    /// Steps the ladder; gives its state and the silence of the peer in ns.
    pub(super) fn advance(&mut self, now_ns: u64) -> (LadderState, Option<u64>) {
        let age_ns = self.link.age_ns(now_ns);
        let ready = self.link.is_heard() && self.newest().is_some_and(has_not_stopped);
        (self.ladder.step(now_ns, age_ns, ready), age_ns)
    }

    /// The newest frame of the peer.
    pub(super) fn newest(&self) -> Option<&Frame<N>> {
        self.link.newest()
    }

    /// Writes the frame of this tick.
    pub fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let status = (self.ladder.state().code(), self.ladder.hears_peer());
        self.link.send(now_ns, status, self.outgoing, buffer)
    }

    /// The loop was late by more than the ladder allows, until `now_ns`.
    pub(super) fn stalled(&mut self, now_ns: u64) {
        self.ladder.stalled(now_ns);
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        self.ladder.state()
    }

    /// Counts of the link, and how often the ladder went to HOLD.
    pub fn counts(&self) -> (LinkStatistics, u64) {
        (self.link.statistics(), self.ladder.holds())
    }
}

/// Whether the sender of this frame can be coupled with.
fn has_not_stopped<const N: usize>(frame: &Frame<N>) -> bool {
    let state = LadderState::from_code(frame.state);
    state.is_some_and(|state| !matches!(state, LadderState::Stop | LadderState::Fault))
}
