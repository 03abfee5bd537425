//! Result of a run: signals, events and measures.

use haptether_safety::{Axes, controller::Tripped};

use super::{measures::Outcome, spec::SceneSpec};
use crate::live::LoopReport;

/// Result of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneRun {
    /// Signals; empty if the scene records none.
    pub signals: Vec<Signal>,
    /// Events.
    pub events: Vec<SceneEvent>,
    /// Measured values.
    pub outcome: Outcome,
    /// dT of the master in s.
    pub period_s: f64,
    /// Reports of the loops of master and slave; none without an arm.
    pub reports: Option<[LoopReport; 2]>,
}

/// One signal over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Signal {
    /// Name.
    pub name: &'static str,
    /// Values per sample: 1 for a scalar.
    pub width: usize,
    /// Samples in order of time.
    pub values: Vec<f64>,
}

/// Signals of one loop, sampled at a fixed interval of ticks.
#[derive(Clone, Debug)]
pub(crate) struct Recorder {
    every: u64,
    /// Largest number of ticks of the run; memory is reserved for all of them at once.
    max_ticks: u64,
    ticks: u64,
    signals: Vec<Signal>,
}

/// A sample of one signal.
pub(crate) enum Sample<'a, const N: usize> {
    Vector(&'a Axes<N>),
    Scalar(f64),
}

impl Recorder {
    /// Record every `every`-th of at most `max_ticks` ticks; 0 records nothing.
    pub(crate) fn new(every: u64, max_ticks: u64) -> Self {
        Self { every, max_ticks, ticks: 0, signals: Vec::new() }
    }

    /// Count a tick that is not recorded. Returns true if the tick is recorded instead: then [`take`](Self::take) must
    /// follow.
    #[inline]
    pub(crate) fn begin_tick(&mut self) -> bool {
        if self.every == 0 {
            return false;
        }
        let is_recorded = self.ticks.is_multiple_of(self.every);
        self.ticks += u64::from(!is_recorded);
        is_recorded
    }

    /// Take a tick, with the same signals in the same order each time.
    #[inline]
    pub(crate) fn take<'a, const N: usize>(
        &mut self,
        samples: impl Iterator<Item = (&'static str, Sample<'a, N>)>,
    ) {
        if self.every == 0 {
            return;
        }
        if self.ticks.is_multiple_of(self.every) {
            for (place, (name, sample)) in samples.enumerate() {
                if place == self.signals.len() {
                    let width = if matches!(sample, Sample::Vector(_)) { N } else { 1 };
                    let room = usize::try_from(self.max_ticks.div_ceil(self.every)).unwrap_or(0);
                    self.signals.push(Signal { name, width, values: Vec::with_capacity(room * width) });
                }
                let values = &mut self.signals[place].values;
                match sample {
                    Sample::Vector(vector) => values.extend_from_slice(vector.as_slice()),
                    Sample::Scalar(scalar) => values.push(scalar),
                }
            }
        }
        self.ticks += 1;
    }

    /// Add further signals to the tick taken last, the same in the same order each time.
    pub(crate) fn also(&mut self, add: impl FnOnce(&mut dyn FnMut(&'static str, &[f64]))) {
        if self.every == 0 || !(self.ticks - 1).is_multiple_of(self.every) {
            return;
        }
        let room = usize::try_from(self.max_ticks.div_ceil(self.every)).unwrap_or(0);
        // Further signals come after those that already have a value for this tick.
        let ticks = self.signals.first().map_or(0, |first| first.values.len() / first.width);
        let has_tick = |signal: &Signal| signal.values.len() == ticks * signal.width;
        let mut place = self.signals.iter().take_while(|signal| has_tick(signal)).count();
        add(&mut |name, values| {
            if place == self.signals.len() {
                let width = values.len();
                self.signals.push(Signal { name, width, values: Vec::with_capacity(room * width) });
            }
            self.signals[place].values.extend_from_slice(values);
            place += 1;
        });
    }

    pub(crate) fn into_signals(self) -> Vec<Signal> {
        self.signals
    }
}

/// Event of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneEvent {
    /// Time in s.
    pub time_s: f64,
    /// Kind of event:
    ///
    /// - ladder: `disengaged`, `aligning`, `engaged`, `hold`, `stop`, `fault`;
    /// - hand: `release`, with the largest speed until the next grip in the detail for one by an aim; `regrasp`;
    /// - contact: `contact`, `free`;
    /// - gripper: `grip`, `drop`;
    /// - controllers: `trip`, `recover`, with `trigger` in the detail for those of a trigger with force feedback;
    /// - run: `settled`, `diverged`, `coarse`, `lost`, `refused`, `never-engaged`, `overflow`, `truncated`.
    pub kind: &'static str,
    /// Further detail.
    pub detail: String,
}

/// Events of a run, from changes between ticks.
#[derive(Clone, Debug, Default)]
pub(crate) struct EventLog {
    events: Vec<SceneEvent>,
    /// Bits of the tripped controllers: of the hand, and of a trigger with force feedback.
    tripped: [u8; 2],
    /// Trips, contacts and grips that were not stored because the log was full.
    dropped: u64,
    touches: bool,
    grips: bool,
}

/// Largest number of stored events; a loop that chatters would otherwise fill the memory.
const MAX_EVENTS: usize = 10_000;

impl EventLog {
    pub(crate) fn add(&mut self, time_s: f64, kind: &'static str, detail: impl Into<String>) {
        let chatters = matches!(kind, "trip" | "recover" | "contact" | "free" | "grip" | "drop");
        if chatters && self.events.len() >= MAX_EVENTS {
            self.dropped += 1;
        } else {
            self.events.push(SceneEvent { time_s, kind, detail: detail.into() });
        }
    }

    /// Add the number of environment steps that were too stiff for full accuracy, if any.
    pub(crate) fn coarse(&mut self, time_s: f64, steps: u64) {
        if steps > 0 {
            self.add(time_s, "coarse", format!("{steps} steps of the environment were too stiff"));
        }
    }

    /// Take the controllers that intervene on force and torque of the hand at this tick.
    #[inline]
    pub(crate) fn tripped(&mut self, time_s: f64, tripped: Tripped) {
        self.changed(time_s, 0, tripped);
    }

    /// Take the controllers that intervene on the force of a trigger with force feedback at this tick.
    #[inline]
    pub(crate) fn trigger_tripped(&mut self, time_s: f64, tripped: Tripped) {
        self.changed(time_s, 1, tripped);
    }

    #[inline(always)]
    fn changed(&mut self, time_s: f64, which: usize, tripped: Tripped) {
        if self.tripped[which] != tripped.bits() {
            self.note_change(time_s, which, tripped);
        }
    }

    #[cold]
    fn note_change(&mut self, time_s: f64, which: usize, tripped: Tripped) {
        let (before, now) = (self.tripped[which], tripped.bits());
        self.tripped[which] = now;
        let at = if which == 0 { "" } else { "trigger" };
        if before == 0 {
            let who: Vec<_> = (!at.is_empty()).then_some(at).into_iter().chain(tripped.names()).collect();
            self.add(time_s, "trip", who.join(" "));
        } else if now == 0 {
            self.add(time_s, "recover", at);
        }
    }

    /// Take the state of contact at this tick.
    #[inline]
    pub(crate) fn touches(&mut self, time_s: f64, touches: bool) {
        if touches != self.touches {
            self.touches = touches;
            self.add(time_s, if touches { "contact" } else { "free" }, "");
        }
    }

    /// Take the state of the grip at this tick.
    #[inline]
    pub(crate) fn grips(&mut self, time_s: f64, grips: bool) {
        if grips != self.grips {
            self.grips = grips;
            self.add(time_s, if grips { "grip" } else { "drop" }, "");
        }
    }

    /// Add the scene's scheduled events up to the end of the run, counted from `engaged_s`, and the divergence.
    pub(crate) fn schedule<const N: usize>(
        &mut self,
        scene: &SceneSpec<N>,
        engaged_s: f64,
        outcome: &Outcome,
    ) {
        let end_s = outcome.ticks as f64 * scene.run.period_s;
        if let Some(operator) = &scene.operator
            && let Some(release) = &operator.release
        {
            let at_s = release.at_s + engaged_s;
            let ends = at_s + release.decay_s;
            let mut scheduled = vec![(at_s, "release")];
            if let Some(regrasp) = &operator.regrasp {
                scheduled.push((ends + regrasp.reaction_s, "regrasp"));
            }
            for (time_s, kind) in scheduled {
                if time_s <= end_s {
                    self.add(time_s, kind, "");
                }
            }
        }
        if let Some(divergence) = &outcome.diverged {
            self.add(divergence.time_s, "diverged", divergence.to_string());
        }
    }

    /// Return all events in order of time.
    pub(crate) fn into_events(mut self) -> Vec<SceneEvent> {
        if self.dropped > 0 {
            let last = self.events.iter().map(|event| event.time_s).fold(0.0, f64::max);
            let text = format!("{} more trips and contacts are not listed", self.dropped);
            self.add(last, "truncated", text);
        }
        self.events.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        self.events
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_third_tick_is_recorded() {
        let mut recorder = Recorder::new(3, 10);
        for tick in 0..10 {
            let x = Axes::<2>::new(f64::from(tick), -1.0);
            recorder.take([("t", Sample::Scalar(f64::from(tick))), ("x", Sample::Vector(&x))].into_iter());
        }
        let signals = recorder.into_signals();
        assert_eq!(signals[0].values, [0.0, 3.0, 6.0, 9.0]);
        assert_eq!((signals[1].width, signals[1].values.len()), (2, 8));
        let mut nothing = Recorder::new(0, 10);
        nothing.take::<1>([("t", Sample::Scalar(0.0))].into_iter());
        assert!(nothing.into_signals().is_empty());
    }
}
