//! What happens in a run, as it would be told.

use haptether_safety::controller::Tripped;

/// Something that happened.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneEvent {
    /// When, in s.
    pub time_s: f64,
    /// `disengaged`, `aligning`, `engaged`, `hold`, `stop` and `fault` of the ladder, `release` and `regrasp` of the hand, `contact`
    /// and `free` of what is touched, `trip` and `recover` of the controllers, `settled`, `diverged`, `coarse`, `lost`
    /// or `refused`.
    pub kind: &'static str,
    /// What more there is to say.
    pub detail: String,
}

/// Events of a run, told apart from tick to tick.
#[derive(Clone, Debug, Default)]
pub(crate) struct EventLog {
    events: Vec<SceneEvent>,
    tripped: u8,
    /// Trips and contacts beyond the most that are kept.
    dropped: u64,
    touches: bool,
}

/// Most events that are kept; a loop that chatters would fill the memory.
const MAX_EVENTS: usize = 10_000;

impl EventLog {
    pub(crate) fn add(&mut self, time_s: f64, kind: &'static str, detail: impl Into<String>) {
        let chatters = matches!(kind, "trip" | "recover" | "contact" | "free");
        if chatters && self.events.len() >= MAX_EVENTS {
            self.dropped += 1;
        } else {
            self.events.push(SceneEvent { time_s, kind, detail: detail.into() });
        }
    }

    /// How many steps of the environment were too stiff to be followed to the usual accuracy, if any.
    pub(crate) fn coarse(&mut self, time_s: f64, steps: u64) {
        if steps > 0 {
            self.add(time_s, "coarse", format!("{steps} steps of the environment were too stiff"));
        }
    }

    /// Who intervenes at this tick.
    #[inline]
    pub(crate) fn tripped(&mut self, time_s: f64, tripped: Tripped) {
        let (before, now) = (self.tripped, tripped.bits());
        if before == now {
            return;
        }
        self.tripped = now;
        if before == 0 {
            let who: Vec<_> = tripped.names().collect();
            self.add(time_s, "trip", who.join(" "));
        } else if now == 0 {
            self.add(time_s, "recover", "");
        }
    }

    /// Whether there is contact at this tick.
    #[inline]
    pub(crate) fn touches(&mut self, time_s: f64, touches: bool) {
        if touches != self.touches {
            self.touches = touches;
            self.add(time_s, if touches { "contact" } else { "free" }, "");
        }
    }

    /// All events in the order of their times.
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
