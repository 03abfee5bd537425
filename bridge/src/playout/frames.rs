//! Play-out of the frames for a coupling.

use super::{Arrival, Playout, PlayoutError, PlayoutSettings};
use crate::wire::Frame;

/// Play-out of a coupling. It is empty if the coupling needs no constant delay.
#[derive(Clone, Debug, Default)]
pub(crate) struct PlayOut(Option<Box<PlayedFrames>>);

/// Frames that wait for their time, and the one whose time is now.
#[derive(Clone, Debug)]
pub(crate) struct PlayedFrames {
    waiting: Playout<Frame>,
    now: Option<Frame>,
}

impl PlayOut {
    /// Let frames wait until their delay is constant: that of the largest jitter, up to `most_ns`. The peer sends at most
    /// one frame per `period_ns`.
    pub(crate) fn new(most_ns: u64, period_ns: u64) -> Result<Self, PlayoutError> {
        // Room for a burst, too.
        let capacity =
            usize::try_from(2 * most_ns / period_ns.max(1)).unwrap_or(usize::MAX).saturating_add(64);
        let settings = PlayoutSettings { adapts: true, capacity, ..PlayoutSettings::new(most_ns) };
        Ok(Self(Some(Box::new(PlayedFrames { waiting: Playout::new(settings)?, now: None }))))
    }

    /// Frames of the play-out; None if it is empty.
    #[inline]
    pub(crate) fn frames(&mut self) -> Option<&mut PlayedFrames> {
        self.0.as_deref_mut()
    }

    /// Frame whose time is now; without a play-out, the newest.
    #[inline]
    pub(crate) fn now<'a>(&'a self, newest: Option<&'a Frame>) -> Option<&'a Frame> {
        self.0.as_ref().map_or(newest, |frames| frames.now.as_ref())
    }

    /// Forget all frames.
    pub(crate) fn clear(&mut self) {
        if let Some(frames) = &mut self.0 {
            frames.clear();
        }
    }
}

impl PlayedFrames {
    /// Take a frame that arrived at `now_ns`. Its time is now if it is late: a path that has become slower must not leave an
    /// old force on a hand.
    pub(crate) fn take(&mut self, now_ns: u64, frame: &Frame) {
        let arrival = self.waiting.arrived(frame.sequence, frame.sent_ns, now_ns, *frame);
        if arrival == Arrival::Late {
            self.advance(frame);
        }
    }

    /// Take the frames that are due at `now_ns`.
    pub(crate) fn play(&mut self, now_ns: u64) {
        while let Some(due) = self.waiting.next_due(now_ns) {
            self.advance(&due.payload);
        }
    }

    /// Take the frame if it is newer than the present one.
    fn advance(&mut self, frame: &Frame) {
        if self.now.as_ref().is_none_or(|now| frame.sequence > now.sequence) {
            self.now = Some(*frame);
        }
    }

    /// Present wait in ns of a frame with the least delay; 0 before the first.
    pub(crate) fn wait_ns(&self) -> u64 {
        self.waiting.wait_ns().unwrap_or(0)
    }

    /// Forget all frames.
    pub(crate) fn clear(&mut self) {
        self.waiting.restart();
        self.now = None;
    }
}
